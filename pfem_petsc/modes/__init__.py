"""Natural vibrations and linear buckling of a state: matrices, eigenvalue solvers, shapes."""
