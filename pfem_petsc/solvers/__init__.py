"""Linear and nonlinear solution on PETSc: matrix pattern, Newton and variational-inequality solvers."""
