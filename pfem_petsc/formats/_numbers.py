"""Numbers in texts, fast for large files."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable

import numpy as np

from ..errors import InputError

_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE)


def numbers_of(text: bytes) -> np.ndarray:
    """Return all numbers of a text, separated by white space, as float64: whole numbers are exact up to 2^53.

    Raises
    ------
    ValueError
        If there is anything else.
    """
    if not text.strip():
        return np.empty(0)
    with warnings.catch_warnings():
        # text other than numbers ends the parsing, with a warning in older NumPy and an error in newer versions
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            other = next((word for word in text.split() if not _NUMBER.fullmatch(word)), text.strip())
            raise ValueError(f"{shown(other)!r} is not a number") from None


def number_of(text: str) -> float:
    """Return a number, NaN for another text; Fortran's exponents (1.D+3) are known."""
    try:
        return float(text.upper().replace("D", "E"))
    except ValueError:
        return float("nan")


def whole_numbers(values: np.ndarray, first: int, end: int, refused: Callable[[str], str]) -> np.ndarray:
    """Return numbers as int64, from ``first`` to ``end`` - 1; ``refused`` makes a message about another one."""
    wrong = values[~((values >= first) & (values < end) & (values == np.rint(values)))]
    if wrong.size:
        raise InputError(refused("nothing" if np.isnan(wrong.flat[0]) else f"{wrong.flat[0]:.15g}"))
    return values.astype(np.int64)


def places_of(known: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where labels are among ascending ones, and whether they are there."""
    place = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    return place, known[place] == wanted if len(known) else np.zeros(wanted.shape, bool)


def shown(text: bytes) -> str:
    """Return the beginning of a text for messages."""
    return text[:60].decode("utf-8", "replace")
