"""What compiled loops of a law need to know of the data of a bar: numbers at compile time."""

from __future__ import annotations

from .materials.base import Law

__all__ = ["last_row", "no_bar_data", "no_variables"]


def no_variables(law: Law) -> tuple[float, ...]:
    """Return a tuple of zeros, one for each internal variable of a law."""
    return (0.0,) * len(law.internal)


def no_bar_data(law: Law) -> tuple[float, ...]:
    """Return a tuple of zeros, one for each number that a law reads of a bar."""
    return (0.0,) * len(law.bar_data)


def last_row(law: Law) -> int:
    """Return the row of the history with the strain at the end of the last step; the stress is in the next row."""
    return len(law.internal)
