"""The one way in which loops over bars and nodes are compiled."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numba

__all__ = ["kernel"]

# Contraction to fused multiply-add is the same in every compiled copy of a loop, so a bar evaluated on two ranks gives
# the same bits on both; reassociation would not, and assuming "no NaN" would hide a blow-up.
_FAST = {"contract", "nsz"}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a loop; the machine code is cached on disk where a folder for it can be written."""
    options: dict[str, Any] = {"fastmath": _FAST, "error_model": "numpy", "nogil": True}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError as error:
        if "no locator" not in str(error):
            raise
        warnings.warn(
            "compiled code cannot be cached (neither the package folder nor the home folder is writable), so every "
            "start compiles anew; set NUMBA_CACHE_DIR to a writable folder",
            stacklevel=2,
        )
        return numba.njit(**options)(function)
