"""Current and peak resident memory of this process (Linux)."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from pathlib import Path

__all__ = ["PeakMemory"]


class PeakMemory:
    """Measures the growth of the resident memory from its creation; ``growth()`` returns the maximum [B]."""

    def __init__(self) -> None:
        gc.collect()
        _trim()
        # reset the kernel's peak; if that is not permitted, the peak since the start of the process counts
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
        self.base = _status("VmRSS")

    def growth(self) -> float:
        """Return the peak resident memory since the start minus that at the start [B]."""
        return max(_status("VmHWM") - self.base, 0.0)


def _trim() -> None:
    """Return freed memory to the system, so that earlier use does not hide later growth."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _status(name: str) -> float:
    """Return a value of /proc/self/status [B]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024.0 * float(line.split()[1])
    raise OSError(f"/proc/self/status has no {name}: memory is measured on Linux only")
