"""Handling of Python objects that PETSc still refers to when Python exits and that it can no longer call."""

from __future__ import annotations

import weakref

from petsc4py import PETSc

__all__ = ["outlive"]


def outlive(reference: weakref.ref) -> None:
    """Prevent PETSc from freeing operators that are Python objects; to be called when Python exits.

    Parameters
    ----------
    reference : to a matrix, or to a SNES, whose operators include the last restriction to inactive unknowns
    """
    thing = reference()
    if not thing:
        return
    for matrix in thing.getKSP().getOperators() if isinstance(thing, PETSc.SNES) else (thing,):
        if matrix and matrix.getType() == "python":
            matrix.incRef()
