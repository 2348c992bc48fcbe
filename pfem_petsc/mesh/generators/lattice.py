"""A block of a space lattice: cubic, octet or body-centred cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...case.base import PositiveFloat, PositiveInts3, StrictModel
from ..slab import MeshSlab, check_length, check_size, index_type, slab_range

__all__ = ["Parameters", "generate"]

# Number of nodes or bars generated at a time, to keep temporary arrays small.
_PIECE = 1 << 19

Triple = tuple[int, int, int]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "lattice"``."""

    kind: Literal["cubic", "octet", "bcc"] = "cubic"
    """``cubic``: edges and both diagonals of every face of the cubes. ``octet``: face-centred nodes, every pair of
    nearest neighbours. ``bcc``: corners and centres, the eight half diagonals of each cube and the cube edges
    (without which it would be a mechanism)."""
    cells: PositiveInts3
    """Number of cubic cells along x, y and z."""
    pitch: PositiveFloat
    """Edge of the cubic cell [m]."""


@dataclass(frozen=True)
class _Lattice:
    """Nodes on a box-shaped grid, numbered from ``base`` with z varying fastest."""

    shape: Triple
    origin: Triple
    """Position of the first node in half pitches."""
    base: int

    @property
    def count(self) -> int:
        return self.shape[0] * self.shape[1] * self.shape[2]

    def number(self, i: np.ndarray, j: np.ndarray, k: np.ndarray, offset: Triple) -> np.ndarray:
        _, ny, nz = self.shape
        return ((i + offset[0]) * ny + (j + offset[1])) * nz + (k + (offset[2] + self.base))


@dataclass(frozen=True)
class _Family:
    """Parallel bars, one for each place (i, j, k) of a box: from node (i, j, k) + ``a`` to node (i, j, k) + ``b``."""

    shape: Triple
    start: _Lattice
    a: Triple
    end: _Lattice
    b: Triple

    @property
    def count(self) -> int:
        return self.shape[0] * self.shape[1] * self.shape[2]


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part of the lattice by index arithmetic; no rank has the whole lattice.

    Node groups: ``bottom`` and ``top`` (z faces), ``left`` and ``right`` (x faces), ``front`` and ``back`` (y faces).
    """
    lattices, families = _KINDS[parameters.kind](parameters.cells)
    n_nodes = sum(lattice.count for lattice in lattices)
    n_bars = sum(family.count for family in families)
    check_size(n_nodes, "mesh.cells")
    check_length(parameters.pitch, "mesh.pitch")
    first_node, last_node = slab_range(n_nodes, rank, size)
    first_bar, last_bar = slab_range(n_bars, rank, size)
    points, faces = _nodes(lattices, parameters, first_node, last_node)
    return MeshSlab(
        n_nodes=n_nodes,
        n_bars=n_bars,
        first_node=first_node,
        points=points,
        first_bar=first_bar,
        bars=_bars(families, first_bar, last_bar, index_type(n_nodes)),
        node_groups=faces,
        source=f"generator lattice ({parameters.kind})",
        structured=True,
    )


def _pieces(counts: list[int], first: int, last: int) -> Iterator[tuple[int, np.ndarray]]:
    """Divide the range [first, last) of items numbered across several boxes into (box, indices within that box)."""
    base = 0
    for box, count in enumerate(counts):
        for start in range(max(first - base, 0), min(last - base, count), _PIECE):
            yield box, np.arange(start, min(start + _PIECE, last - base, count))
        base += count


def _nodes(
    lattices: list[_Lattice], parameters: Parameters, first: int, last: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    points = np.empty((last - first, 3))
    found: dict[str, list[np.ndarray]] = {name: [] for name in ("bottom", "top", "left", "right", "front", "back")}
    for box, places in _pieces([lattice.count for lattice in lattices], first, last):
        lattice = lattices[box]
        at = places[0] + lattice.base - first
        for axis, index in enumerate(np.unravel_index(places, lattice.shape)):
            half = 2 * index + lattice.origin[axis]
            # An even number of half pitches is a whole number of pitches, with the same rounding as index * pitch.
            points[at : at + len(places), axis] = 0.5 * half * parameters.pitch
            low, high = (("left", "right"), ("front", "back"), ("bottom", "top"))[axis]
            found[low].append(places[half == 0] + lattice.base)
            found[high].append(places[half == 2 * parameters.cells[axis]] + lattice.base)
    return points, {name: np.concatenate([np.empty(0, np.int64), *parts]) for name, parts in found.items()}


def _bars(families: list[_Family], first: int, last: int, dtype: type[np.signedinteger]) -> np.ndarray:
    bars = np.empty((last - first, 2), dtype)
    at = 0
    for box, places in _pieces([family.count for family in families], first, last):
        family = families[box]
        i, j, k = np.unravel_index(places, family.shape)
        bars[at : at + len(places), 0] = family.start.number(i, j, k, family.a)
        bars[at : at + len(places), 1] = family.end.number(i, j, k, family.b)
        at += len(places)
    return bars


def _cubic(cells: Triple) -> tuple[list[_Lattice], list[_Family]]:
    """Return edges along x, y, z, then the two diagonals of the faces normal to z, to y and to x."""
    corners = _corners(cells)
    families = _edges(cells, corners)
    for first, second in ((0, 1), (0, 2), (1, 2)):
        shape = tuple(n if axis in (first, second) else n + 1 for axis, n in enumerate(cells))
        one, two, both = _unit(first), _unit(second), _unit(first, second)
        families.append(_Family(shape, corners, (0, 0, 0), corners, both))
        families.append(_Family(shape, corners, one, corners, two))
    return [corners], families


def _octet(cells: Triple) -> tuple[list[_Lattice], list[_Family]]:
    """Return bars from corners to face centres, then bars between the face centres of every cell."""
    corners = _corners(cells)
    lattices, families = [corners], []
    for axis in range(3):
        shape = tuple(n + 1 if a == axis else n for a, n in enumerate(cells))
        origin = tuple(0 if a == axis else 1 for a in range(3))
        lattices.append(_Lattice(shape, origin, lattices[-1].base + lattices[-1].count))
        first, second = (a for a in range(3) if a != axis)
        for corner in ((0, 0, 0), _unit(first), _unit(second), _unit(first, second)):
            families.append(_Family(shape, corners, corner, lattices[-1], (0, 0, 0)))
    for one, two in ((0, 1), (0, 2), (1, 2)):
        for a in ((0, 0, 0), _unit(one)):
            for b in ((0, 0, 0), _unit(two)):
                families.append(_Family(cells, lattices[1 + one], a, lattices[1 + two], b))
    return lattices, families


def _bcc(cells: Triple) -> tuple[list[_Lattice], list[_Family]]:
    """Return cube edges along x, y, z, then the eight half diagonals of every cell."""
    corners = _corners(cells)
    centres = _Lattice(cells, (1, 1, 1), corners.count)
    families = _edges(cells, corners)
    for corner in np.ndindex(2, 2, 2):
        families.append(_Family(cells, corners, corner, centres, (0, 0, 0)))
    return [corners, centres], families


def _corners(cells: Triple) -> _Lattice:
    nx, ny, nz = cells
    return _Lattice((nx + 1, ny + 1, nz + 1), (0, 0, 0), 0)


def _edges(cells: Triple, corners: _Lattice) -> list[_Family]:
    shapes = [tuple(n if a == axis else n + 1 for a, n in enumerate(cells)) for axis in range(3)]
    return [_Family(shape, corners, (0, 0, 0), corners, _unit(axis)) for axis, shape in enumerate(shapes)]


def _unit(*axes: int) -> Triple:
    return tuple(int(axis in axes) for axis in range(3))


_KINDS = {"cubic": _cubic, "octet": _octet, "bcc": _bcc}
