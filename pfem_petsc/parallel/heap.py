"""Memory that a set-up frees goes back to the system.

SuperLU_DIST, which a PETSc may be linked to, tells the C library as it is loaded to keep all freed memory. A run would
then hold the largest temporary arrays of its set-up to its end.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator

__all__ = ["return_freed_memory", "returning_freed_memory"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # of mallopt(3) of the GNU C library

_LARGE = 1 << 20
"""Size [B] from which an array has memory of its own, which goes back as the array is freed."""


@contextlib.contextmanager
def returning_freed_memory() -> Iterator[None]:
    """Have the C library return the memory of large arrays as they are freed; elsewhere than with glibc nothing.

    Afterwards it keeps what is freed: requesting pages again in every step would make implicit steps 4 % slower.
    """
    library = _glibc()
    if library is None:
        yield
        return
    library.mallopt(_MMAP_THRESHOLD, _LARGE)
    library.mallopt(_MMAP_MAX, 1 << 16)
    library.mallopt(_TRIM_THRESHOLD, 16 * _LARGE)
    try:
        yield
    finally:
        library.malloc_trim(0)
        library.mallopt(_MMAP_MAX, 0)
        library.mallopt(_TRIM_THRESHOLD, -1)


def return_freed_memory() -> None:
    """Return what is free now, for example before steps that need less than those before."""
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.gnu_get_libc_version  # noqa: B018 - other libraries number the parameters differently
        return library
    return None
