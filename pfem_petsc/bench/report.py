"""The table of the bench and its JSON."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .bandwidth import BYTES_PER_ELEMENT, Bandwidth
from .measure import Record
from .messages import Messages
from .traffic import ASSUMED, OPERATIONS

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = [
    "HEADER",
    "bandwidth_line",
    "document",
    "line",
    "memory_parts",
    "memory_slopes",
    "messages_line",
    "processor",
]

_FORMAT = "{:18} {:>11} {:>9} {:>9} {:>9} {:>8} {:>6} {:>6} {:>6} {:>7} {:>6} {:>6}"
_NAMES = (
    "job",
    "bars",
    "step ms",
    "best ms",
    "cpu ms",
    "bars/s",
    "moved",
    "bound",
    "memory",
    "newton",
    "setup",
    "first",
)
_UNITS = ("", "", "median", "", "", "", "B/bar", "%", "B/bar", "/cg", "s", "step s")
HEADER = f"{_FORMAT.format(*_NAMES)}\n{_FORMAT.format(*_UNITS)}"
"""Two lines over the table."""


def line(record: Record) -> str:
    """Return a row of the table."""
    iterations = f"{record.newton:.1f}/{record.linear:.0f}" if record.newton or record.linear else "-"
    return _FORMAT.format(
        record.job,
        f"{record.bars:,}",
        f"{1e3 * record.median:.4g}",
        f"{1e3 * record.best:.4g}",
        f"{1e3 * record.cpu:.4g}",
        f"{record.rate:.3g}",
        f"{record.traffic / record.bars:.0f}",
        f"{record.share:.0f}" if record.share else "-",
        f"{record.memory / record.bars:.0f}",
        iterations,
        f"{record.setup:.2f}",
        f"{record.first:.2f}",
    )


def bandwidth_line(bandwidth: Bandwidth) -> str:
    """Describe the bandwidth."""
    text = f"STREAM triad ({BYTES_PER_ELEMENT} B an element): one process {bandwidth.alone / 1e9:.1f} GB/s"
    if bandwidth.ranks > 1:
        text += f", {bandwidth.ranks} at once {bandwidth.together / 1e9:.1f} GB/s ({bandwidth.ratio:.2f} x)"
    return text


def messages_line(messages: Messages) -> str:
    """Describe the cost of messages."""
    return (
        f"messages: latency {1e6 * messages.latency:.1f} us, {messages.bandwidth / 1e9:.1f} GB/s, "
        f"a sum over all ranks {1e6 * messages.reduction:.1f} us"
    )


def memory_slopes(records: list[Record]) -> dict[str, float]:
    """Return bytes per bar from the two largest sizes of each job with at least two sizes."""
    slopes = {}
    for name in dict.fromkeys(record.job for record in records):
        sized = sorted((r for r in records if r.job == name), key=lambda r: r.bars)
        if len(sized) > 1 and sized[-1].bars > sized[-2].bars:
            slopes[name] = (sized[-1].memory - sized[-2].memory) / (sized[-1].bars - sized[-2].bars)
    return slopes


def memory_parts(record: Record) -> str:
    """Describe what the parts of a simulation hold, in bytes a bar."""
    held = {part: size / record.bars for part, size in record.held.items()}
    texts = ", ".join(f"{part} {size:.1f}" for part, size in held.items() if size >= 0.05)
    return (
        f"memory of {record.job}, {record.bars:,} bars: arrays {sum(held.values()):.0f} B a bar ({texts}), "
        f"growth at most {record.memory / record.bars:.0f}"
    )


def processor() -> str:
    """Return the name of the processor."""
    try:
        for text in Path("/proc/cpuinfo").read_text().splitlines():
            if text.startswith("model name"):
                return text.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def document(
    comm: MPI.Comm,
    bandwidth: Bandwidth,
    messages: Messages | None,
    records: list[Record],
    tiny: list[Record],
    operations: float | None = None,
) -> str:
    """Return all measurements as JSON."""
    from ..output.layout import describe_run

    content: dict[str, Any] = {
        "machine": {"processor": processor(), "cores": os.cpu_count(), "system": platform.platform()},
        "program": describe_run(comm, {}),
        "ranks": bandwidth.ranks,
        "bandwidth": {
            "alone": bandwidth.alone,
            "together": bandwidth.together,
            "ratio": bandwidth.ratio,
            "bytes_per_element": BYTES_PER_ELEMENT,
        },
        "messages": messages._asdict() if messages is not None else None,
        "bytes_assumed": ASSUMED,
        "operations_assumed": OPERATIONS,
        "operations_a_second": operations,
        "runs": [asdict(record) | {"bars_per_second": record.rate} for record in records],
        "memory_slopes": memory_slopes(records),
        "overhead": [asdict(record) for record in tiny],
    }
    return json.dumps(content, indent=1) + "\n"
