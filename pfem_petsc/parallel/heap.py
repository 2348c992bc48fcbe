"""Freed memory goes back to the system.

SuperLU_DIST, which a PETSc may be linked to, tells the C library as it is loaded to keep all freed memory. A run would
then hold the largest temporary arrays of its set-up to its end.
"""

from __future__ import annotations

import contextlib
import ctypes

__all__ = ["return_freed_memory"]

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # of mallopt(3) of the GNU C library

_LARGE = 4 << 20
"""Size [B] from which an array has memory of its own, which goes back as the array is freed. Smaller ones are reused,
as getting their pages again in every step would take time."""


def return_freed_memory() -> None:
    """Have the C library return the memory of large arrays once they are freed; elsewhere than with glibc nothing."""
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.gnu_get_libc_version  # noqa: B018 - other libraries number the parameters differently
        library.mallopt(_MMAP_MAX, 65536)  # the default of the library
        library.mallopt(_MMAP_THRESHOLD, _LARGE)
        library.mallopt(_TRIM_THRESHOLD, 16 * _LARGE)
