"""What PETSc still holds when Python ends: objects that it could not call any more."""

from __future__ import annotations

import weakref

from petsc4py import PETSc

__all__ = ["outlive"]


def outlive(reference: weakref.ref) -> None:
    """Keep PETSc from freeing operators that are Python objects; to be called when Python ends.

    Parameters
    ----------
    reference : to a matrix, or to a SNES, whose operators are meant: the last restriction to inactive unknowns is one
    """
    thing = reference()
    if not thing:
        return
    for matrix in thing.getKSP().getOperators() if isinstance(thing, PETSc.SNES) else (thing,):
        if matrix and matrix.getType() == "python":
            matrix.incRef()
