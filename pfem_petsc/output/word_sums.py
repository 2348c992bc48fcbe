"""Compiled loops over the words of arrays: their checksums, and rows in another order."""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import kernel

__all__ = ["gather_rows", "sum_of_words"]

_ODD = np.uint64(0x9E3779B97F4A7C15)
_SHIFT, _ONE = np.uint64(29), np.uint64(1)


@kernel
def sum_of_words(words: np.ndarray, start: int) -> np.uint64:
    """Return the sum, modulo 2^64, of unsigned words (n,) times the factors of their indices from ``start``."""
    total = np.uint64(0)
    for i in range(len(words)):
        factor = np.uint64(start + i + 1) * _ODD
        total += np.uint64(words[i]) * ((factor ^ (factor >> _SHIFT)) | _ONE)
    return total


@kernel
def gather_rows(words: np.ndarray, rows: np.ndarray, out: np.ndarray) -> None:
    """Copy rows (n,) of words (m, k) to ``out`` (n, k)."""
    if words.shape[1] == 1:
        for i in range(len(rows)):
            out[i, 0] = words[rows[i], 0]
    else:
        for i in range(len(rows)):
            for k in range(words.shape[1]):
                out[i, k] = words[rows[i], k]
