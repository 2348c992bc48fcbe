"""Eigenvalue solvers, one per module; ``modes.solver`` names the module.

``Solver(pencil)`` finds the largest theta of A x = theta B x; construction is collective. It has ``definite``, whether
B is positive definite, None if that is unknown; ``largest(count, start, known)``, vectors (k, owned components) of
at least the ``count`` largest theta of the complement of the vectors ``known``; ``iterations``, and ``destroy()``.
"""
