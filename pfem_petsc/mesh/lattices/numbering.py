"""Numbers of the nodes and bars of a block of cells, by arithmetic in both directions.

An *item* is a point or a strut of the unit cell. It repeats at the places (i, j, k) of a box whose shape depends on the
item: a point on the lower face of its cell occurs once more than there are cells along that axis.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

__all__ = ["CellByCell", "ItemByItem", "Numbering", "Places"]

# Number of nodes or bars generated at a time, to keep temporary arrays small.
_PIECE = 1 << 17


class Places(NamedTuple):
    """Items and their places: one item for all places, or arrays of one length."""

    item: int | np.ndarray
    i: np.ndarray
    j: np.ndarray
    k: np.ndarray

    def chosen(self, mask: np.ndarray) -> Places:
        """Return the chosen places."""
        item, i, j, k = self
        return Places(item if np.ndim(item) == 0 else item[mask], i[mask], j[mask], k[mask])


class Numbering:
    """Numbers of items in a block.

    Parameters
    ----------
    shapes : (items, 3) int64
        Number of places of each item along x, y and z.
    """

    total: int
    """How many there are."""

    def __init__(self, shapes: np.ndarray) -> None:
        self.shapes = shapes
        self.total = int(shapes.astype(object).prod(axis=1).sum())

    def encode(self, item: int | np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the numbers of items at places."""
        raise NotImplementedError

    def decode(self, numbers: np.ndarray) -> Places:
        """Return the items of numbers (int64), with their places."""
        raise NotImplementedError

    def pieces(self, first: int, last: int) -> Iterator[tuple[np.ndarray, Places]]:
        """Divide the range [first, last) into numbers and what they are."""
        for start in range(first, last, _PIECE):
            numbers = np.arange(start, min(start + _PIECE, last))
            yield numbers, self.decode(numbers)


class ItemByItem(Numbering):
    """All places of the first item, z fastest, then all of the next."""

    def __init__(self, shapes: np.ndarray) -> None:
        super().__init__(shapes)
        self._starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])

    def encode(self, item: int | np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the numbers of items at places."""
        return (i * self.shapes[item, 1] + j) * self.shapes[item, 2] + (k + self._starts[item])

    def decode(self, numbers: np.ndarray) -> Places:
        """Return the items of numbers (int64), with their places."""
        item = np.searchsorted(self._starts, numbers, side="right") - 1
        row, k = np.divmod(numbers - self._starts[item], self.shapes[item, 2])
        return Places(item, *np.divmod(row, self.shapes[item, 1]), k)

    def pieces(self, first: int, last: int) -> Iterator[tuple[np.ndarray, Places]]:
        """Divide the range [first, last) into numbers and what they are, one item at a time."""
        for item, (base, end) in enumerate(zip(self._starts[:-1].tolist(), self._starts[1:].tolist())):
            for start in range(max(first, base), min(last, end), _PIECE):
                numbers = np.arange(start, min(start + _PIECE, last, end))
                yield numbers, Places(item, *np.unravel_index(numbers - base, tuple(self.shapes[item])))


class CellByCell(Numbering):
    """All items of the first cell, then those of the next, z fastest.

    Far from the faces of the block, bars that are copies of one strut join nodes whose numbers differ by the same.
    """

    def __init__(self, shapes: np.ndarray) -> None:
        super().__init__(shapes)
        lengths = shapes.max(axis=0, initial=0)
        # Cells along an axis are of one class if they have the same items: those whose shape reaches that far.
        self._class = [
            np.searchsorted(np.unique(shapes[:, axis]), np.arange(lengths[axis]), side="right") for axis in range(3)
        ]
        present = [
            [shapes[:, axis] > np.argmax(self._class[axis] == c) for c in range(self._class[axis].max(initial=0) + 1)]
            for axis in range(3)
        ]
        # (classes of x, of y, of z, items): which items a cell has, and their order within it
        has = (
            np.stack(present[0])[:, None, None]
            & np.stack(present[1])[None, :, None]
            & np.stack(present[2])[None, None, :]
        )
        self._order = np.cumsum(has, axis=3) - 1
        self._items = np.argsort(~has, axis=3, kind="stable")
        counts = has.sum(axis=3)
        self._along_z = _starts(counts[:, :, self._class[2]])
        self._along_y = _starts(self._along_z[:, self._class[1], -1])
        self._along_x = _starts(self._along_y[self._class[0], -1])

    def encode(self, item: int | np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the numbers of items at places."""
        cx, cy, cz = self._class[0][i], self._class[1][j], self._class[2][k]
        numbers = self._along_x[i] + self._along_y[cx, j]
        numbers += self._along_z[cx, cy, k]
        numbers += self._order[cx, cy, cz, item]
        return numbers

    def decode(self, numbers: np.ndarray) -> Places:
        """Return the items of numbers (int64), with their places."""
        i = np.searchsorted(self._along_x, numbers, side="right") - 1
        cx, rest = self._class[0][i], numbers - self._along_x[i]
        j = _found(self._along_y, cx, rest)
        rest = rest - self._along_y[cx, j]
        cy = self._class[1][j]
        k = _found(self._along_z.reshape(-1, self._along_z.shape[2]), cx * self._along_z.shape[1] + cy, rest)
        rest = rest - self._along_z[cx, cy, k]
        return Places(self._items[cx, cy, self._class[2][k], rest], i, j, k)

    def row(self, i: int, j: int) -> int:
        """Return the number of the first item in the row of cells (i, j), or after the block."""
        i, j = (i, j) if j + 1 < self._along_y.shape[1] else (i + 1, 0)
        if i + 1 >= len(self._along_x):
            return self.total
        return int(self._along_x[i] + self._along_y[self._class[0][i], j])


def _starts(counts: np.ndarray) -> np.ndarray:
    """Return sums of what comes before along the last axis, and of all."""
    return np.concatenate([np.zeros((*counts.shape[:-1], 1), np.int64), np.cumsum(counts, axis=-1)], axis=-1)


def _found(starts: np.ndarray, row: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the last column of each row of ``starts`` (rows, n) that is not above the value."""
    beyond = int(starts[:, -1].max(initial=0)) + 1
    length = starts.shape[1]
    flat = (starts + beyond * np.arange(len(starts))[:, None]).ravel()
    return np.searchsorted(flat, value + beyond * row, side="right") - 1 - length * row
