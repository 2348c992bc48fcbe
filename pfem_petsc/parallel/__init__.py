"""Parallel utilities: collective errors, arrays in different numberings, logging stages of PETSc."""
