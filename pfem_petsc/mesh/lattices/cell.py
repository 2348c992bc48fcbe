"""The unit cell of a lattice: points and struts that repeat in three directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

__all__ = ["UnitCell", "cell_of", "neighbours"]

_SAME = 1e-9
"""Points of a cell closer than this, in cell edges, are one; coordinates this close to a face are on it."""


@dataclass(frozen=True)
class UnitCell:
    """Points and struts of one cell; those on a face belong to the neighbours too and occur once."""

    points: np.ndarray
    """(points, 3) float64: coordinates in [0, 1), in cell edges."""
    ends: np.ndarray
    """(struts, 2) int64: the points that each strut joins."""
    offsets: np.ndarray
    """(struts, 2, 3) int64: cells, relative to that of the strut, in which the ends are; the smaller one is 0."""
    groups: dict[str, np.ndarray]
    """(members,) int64: struts of each kind, by name."""
    aspect: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Cell edges over the pitch."""
    layers: tuple[int, int, int] = (1, 1, 1)
    """Parts of a cell along each axis that ``cells`` counts."""
    item_by_item: bool = False
    """Whether nodes and bars are numbered point by point and strut by strut, else cell by cell."""
    skin: tuple[str, ...] = field(default=())
    """Names of axes: struts within the outer faces normal to these are of the group ``skin`` alone."""

    @property
    def edges(self) -> np.ndarray:
        """(3,) Cell edges over the pitch."""
        return np.array(self.aspect)

    def vectors(self) -> np.ndarray:
        """Return the struts as vectors (struts, 3), from first to second end, over the pitch."""
        place = self.points[self.ends] + self.offsets
        return (place[:, 1] - place[:, 0]) * self.edges

    def lengths(self) -> np.ndarray:
        """Return the lengths (struts,) of the struts over the pitch."""
        return np.linalg.norm(self.vectors(), axis=1)

    @property
    def density(self) -> float:
        """Relative density over (bar area / pitch^2) of the infinite lattice of slender bars: length over volume."""
        return float(self.lengths().sum() / np.prod(self.edges))


def cell_of(
    points: Sequence[Sequence[float]] | np.ndarray,
    struts: Sequence[Sequence[int]] | np.ndarray,
    groups: Mapping[str, Sequence[int]] | None = None,
    **other: object,
) -> UnitCell:
    """Return a unit cell; points and struts that are given on both sides of it are merged by their integer offsets.

    Parameters
    ----------
    points : (points, 3)
        Coordinates in the cell, in cell edges; 0 and 1 are the same place of two neighbouring cells.
    struts : (struts, 2) or (struts, 5)
        The two points that each strut joins, and the cell in which the second one is, relative to that of the first.
    groups : struts of each name
    **other
        ``aspect``, ``layers``, ``item_by_item``, ``skin`` of :class:`UnitCell`.

    Raises
    ------
    ValueError
        For a strut without length, or a group member that does not exist.
    """
    places = np.asarray(points, dtype=float).reshape(-1, 3)
    whole = np.floor(places + _SAME).astype(np.int64)
    inside = np.where(places - whole < _SAME, 0.0, places - whole)
    first = np.array([np.argmax(np.abs(inside - place).max(axis=1) < _SAME) for place in inside], dtype=np.int64)
    kept = np.unique(first)
    number = np.searchsorted(kept, first)

    found: dict[tuple[int, ...], int] = {}
    strut_of = []
    for row in struts:
        p, q = int(row[0]), int(row[1])
        at = np.array([whole[p], whole[q] + np.array(row[2:5] if len(row) > 2 else (0, 0, 0), dtype=np.int64)])
        at -= at.min(axis=0)
        one, two = (int(number[p]), *at[0].tolist()), (int(number[q]), *at[1].tolist())
        if one == two:
            raise ValueError(f"strut {len(strut_of)} ({list(row)}) has no length: its ends coincide")
        key = next((k for k in ((*one, *two), (*two, *one)) if k in found), (*one, *two))
        strut_of.append(found.setdefault(key, len(found)))
    rows = np.array(list(found), dtype=np.int64).reshape(-1, 2, 4)
    named = {name: np.unique([strut_of[m] for m in members]) for name, members in (groups or {}).items()}
    return UnitCell(inside[kept], rows[:, :, 0], rows[:, :, 1:], named, **other)  # type: ignore[arg-type]


def neighbours(points: Sequence[Sequence[float]], length: float, aspect: Sequence[float] = (1.0, 1.0, 1.0)) -> list:
    """Return struts [p, q, i, j, k] between all points of a periodic cell at a distance, in pitches."""
    places, struts = np.asarray(points, dtype=float), []
    for offset in np.ndindex(3, 3, 3):
        shift = np.array(offset) - 1
        for p in range(len(places)):
            apart = np.linalg.norm((places + shift - places[p]) * np.asarray(aspect), axis=1)
            for q in np.flatnonzero(np.abs(apart - length) < _SAME).tolist():
                struts.append([p, q, *shift.tolist()])
    return struts
