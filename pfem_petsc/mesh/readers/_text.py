"""Numbers in texts, fast for large files."""

from __future__ import annotations

import warnings

import numpy as np

__all__ = ["numbers_of"]


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
        except DeprecationWarning as error:
            raise ValueError(str(error)) from None
