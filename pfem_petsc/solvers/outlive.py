"""Handling of Python objects that PETSc still refers to when Python exits and that it can no longer call."""

from __future__ import annotations

import atexit
import itertools
import weakref
from collections.abc import Callable

from petsc4py import PETSc

__all__ = ["at_exit", "outlive"]

_NUMBERS = itertools.count()
_ALIVE: dict[int, tuple[Callable[[weakref.ref], None], weakref.ref]] = {}


def at_exit(function: Callable[[weakref.ref], None], thing: object) -> None:
    """Call a function with a reference to a PETSc object when Python exits, if the object still exists then.

    Unlike ``atexit.register``, it keeps nothing of an object that is gone, of which a program that makes many runs has
    many.
    """
    number = next(_NUMBERS)
    if not number:
        atexit.register(_call_all)
    _ALIVE[number] = function, weakref.ref(thing, lambda _: _ALIVE.pop(number, None))


def _call_all() -> None:
    for function, reference in reversed(list(_ALIVE.values())):
        function(reference)


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
