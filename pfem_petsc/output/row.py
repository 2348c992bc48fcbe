"""A row of the history as one vector of numbers, accessed by column name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

__all__ = ["Row", "RowLayout"]


class RowLayout:
    """Positions of the columns in the vector of a row.

    Parameters
    ----------
    columns : name to shape of a value
    types : name to dtype if it is not float64; integers are stored as floating-point numbers, exact below 2^53

    Attributes
    ----------
    places : name to (first, end, shape, type of a number)
    width : length of the vector
    """

    def __init__(self, columns: Mapping[str, tuple[int, ...]], types: Mapping[str, Any]) -> None:
        self.places: dict[str, tuple[int, int, tuple[int, ...], type]] = {}
        at = 0
        for name, shape in columns.items():
            size = int(np.prod(shape, dtype=np.int64))
            kind = int if np.issubdtype(types.get(name, np.float64), np.integer) else float
            self.places[name] = (at, at + size, tuple(shape), kind)
            at += size
        self.width = at
        self._alike: RowLayout | None = None

    def vector(self, row: Mapping[str, Any]) -> np.ndarray:
        """Return the vector (width,) of a row."""
        if isinstance(row, Row) and self._is_alike(row.layout):
            return row.vector
        if set(row) != set(self.places):
            raise ValueError(f"a history row has the columns {sorted(self.places)}, got {sorted(row)}")
        return np.concatenate([np.ravel(row[name]).astype(np.float64) for name in self.places] or [np.empty(0)])

    def _is_alike(self, other: RowLayout) -> bool:
        if other is not self._alike and list(other.places.items()) == list(self.places.items()):
            self._alike = other
        return other is self._alike


class Row(Mapping):
    """A row of the history: column name to number or array (views of the vector).

    Attributes
    ----------
    layout : RowLayout
    vector : (width,) float64
    """

    __slots__ = ("layout", "vector")

    def __init__(self, layout: RowLayout, vector: np.ndarray) -> None:
        self.layout = layout
        self.vector = vector

    def __getitem__(self, name: str) -> Any:
        first, end, shape, kind = self.layout.places[name]
        return self.vector[first:end].reshape(shape) if shape else kind(self.vector[first])

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.places)

    def __len__(self) -> int:
        return len(self.layout.places)

    def __repr__(self) -> str:
        return repr(dict(self))
