"""Digests of everything that the machine code of a function depends on."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numba.extending import _Intrinsic

__all__ = ["code_digest"]


def code_digest(function: Callable[..., Any]) -> str:
    """Return a digest of the byte code of a function and of all functions, constants and record types it refers to.

    Machine code depends on nothing else in the program. Calls of compiled functions are followed too.
    """
    digest = _Digest()
    digest.add(function)
    return digest.hexdigest()


class _Digest:
    """Digest of objects that machine code can depend on, and of all objects that they refer to."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()
        self._seen: set[int] = set()
        self.hexdigest = self._digest.hexdigest

    def add(self, thing: Any) -> None:
        """Add a function, or an object that functions refer to."""
        update = self._digest.update
        if isinstance(thing, CodeType):
            self._add_code(thing)
        elif isinstance(thing, Dispatcher):
            self.add(thing.py_func)
        elif isinstance(thing, _Intrinsic):
            self.add(thing._defn)
        elif isinstance(thing, FunctionType):
            self._add_function(thing)
        elif isinstance(thing, np.ndarray):
            update(repr((thing.shape, thing.dtype)).encode() + thing.tobytes())
        elif isinstance(thing, ModuleType):
            update(thing.__name__.encode())
        elif isinstance(thing, type):
            update(repr((thing.__qualname__, getattr(thing, "_fields", ()))).encode())
            if thing.__module__.partition(".")[0] == __name__.partition(".")[0]:  # it may generate code
                for part in vars(thing).values():
                    if isinstance(part, FunctionType):
                        self._add_function(part)
        elif isinstance(thing, (tuple, list, frozenset)):
            for part in sorted(thing, key=repr) if isinstance(thing, frozenset) else thing:
                self.add(part)
        elif isinstance(thing, (bool, int, float, complex, str, bytes, type(None), type(...), np.generic)):
            update(repr(thing).encode())
        else:
            update(type(thing).__qualname__.encode())

    def _add_code(self, code: CodeType) -> None:
        self._digest.update(code.co_code)
        self._digest.update(repr((code.co_names, code.co_varnames, code.co_freevars)).encode())
        for constant in code.co_consts:
            self.add(constant)

    def _add_function(self, function: FunctionType) -> None:
        if id(function) in self._seen:
            return
        self._seen.add(id(function))
        self._add_code(function.__code__)
        for cell in function.__closure__ or ():
            self.add(cell.cell_contents)
        # sorted, because the order of a set of names differs between processes
        for name in sorted(_global_names(function.__code__)):
            if name in function.__globals__:
                self._digest.update(name.encode())
                self.add(function.__globals__[name])


def _global_names(code: CodeType) -> set[str]:
    """Return the names that a function and its nested functions may look up globally."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _global_names(constant)
    return names
