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
from numba.extending import register_jitable

__all__ = ["Compilation", "inlined", "kernel"]

# Neither contraction to fused multiply-add nor reassociation: what a loop gives must not depend on how it was compiled,
# alone or into a loop over steps, for one bar or for eight at once, so that a bar evaluated on two ranks has the same
# bits on both and a restarted run those of the run that was not stopped (contraction would save 5 %). Assuming "no NaN"
# would hide a blow-up.
_FAST = {"nsz"}


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


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop into the loops that call it, as :func:`kernel` would."""
    return register_jitable(fastmath=_FAST, error_model="numpy")(function)


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
