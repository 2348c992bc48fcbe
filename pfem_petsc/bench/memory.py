"""Resident memory of this process, now and at its highest (Linux)."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from pathlib import Path

__all__ = ["PeakMemory"]


class PeakMemory:
    """Growth of the resident memory from here on: ``growth()`` gives its highest value [B]."""

    def __init__(self) -> None:
        gc.collect()
        _trim()
        # the kernel's own peak starts anew; where that is not allowed, the highest ever seen counts
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        self.base = _status("VmRSS")

    def growth(self) -> float:
        """Highest resident memory since the start, over that at the start [B]."""
        return max(_status("VmHWM") - self.base, 0.0)


def _trim() -> None:
    """Give freed memory back to the system, so that what was used before does not hide what is used now."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _status(name: str) -> float:
    """A value of /proc/self/status [B]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024.0 * float(line.split()[1])
    raise OSError(f"/proc/self/status has no {name}: memory is measured on Linux only")
