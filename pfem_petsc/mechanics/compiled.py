"""The one way in which loops over bars and nodes are compiled."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import event

__all__ = ["Compilation", "kernel"]

# Contraction to fused multiply-add is the same in every compiled copy of a loop, so a bar evaluated on two ranks gives
# the same bits on both; reassociation would not, and assuming "no NaN" would hide a blow-up.
_FAST = {"contract", "nsz"}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop; the machine code is cached on disk where a folder for it can be written."""
    options: dict[str, Any] = {"fastmath": _FAST, "error_model": "numpy", "nogil": True}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "no locator" not in str(error):
            raise
        warnings.warn(
            "compiled code cannot be cached (neither the package folder nor the home folder is writable), so every "
            "start compiles anew; set NUMBA_CACHE_DIR to a writable folder",
            stacklevel=2,
        )
        return numba.njit(**options)(function)
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if file is not None:
        file._source_stamp = (file._source_stamp, _stamp())
    return compiled


@cache
def _stamp() -> tuple[float, int]:
    """Newest time and total size of the files whose functions are compiled into loops of other files: Numba itself asks
    only for the file of the loop, and would go on with what was compiled before those changed."""
    package = Path(__file__).resolve().parent.parent
    states = [path.stat() for folder in ("mechanics", "contact") for path in (package / folder).rglob("*.py")]
    return max(state.st_mtime for state in states), sum(state.st_size for state in states)


class Compilation(event.Listener):
    """Notices loops that are compiled by this process, not those whose machine code is on disk, while it is a context.

    Parameters
    ----------
    begun : called before the first
    took : called with the time that each took [s]
    """

    def __init__(self, begun: Callable[[], None], took: Callable[[float], None]) -> None:
        self._begun, self._took = begun, took
        self._told = False
        self._nested = 0  # loops that are compiled for one that calls them
        self._begin = 0.0

    def __enter__(self) -> Compilation:
        event.register("numba:compile", self)
        return self

    def __exit__(self, *_: object) -> None:
        event.unregister("numba:compile", self)
        self._nested = 0

    def on_start(self, event: event.Event) -> None:
        """A loop is about to be compiled."""
        if self._nested == 0:
            self._begin = time.perf_counter()
            if not self._told:
                self._told = True
                self._begun()
        self._nested += 1

    def on_end(self, event: event.Event) -> None:
        """It is compiled, or refused."""
        self._nested -= 1
        if self._nested == 0:
            self._took(time.perf_counter() - self._begin)
