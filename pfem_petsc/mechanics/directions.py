"""Prescribed components along directions that are not axes: frames of single nodes.

The prescribed directions of a node are made orthonormal in the order of its supports (Gram-Schmidt). Displacements
along them are prescribed, and P = I - sum d d^T projects a vector of the node on what is left free: matrices are
projected from both sides, and the unknowns remain those along the axes of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..tolerances import RANK
from .motion import vanishes

if TYPE_CHECKING:
    from ..case.tables import Support
    from .motion import Motion

__all__ = ["Directions", "Prescribed", "axes_of", "directions_of"]

_ROUNDING = 16.0 * np.finfo(float).eps  # relative to positions: of displacements along directions


class Prescribed(NamedTuple):
    """What one support prescribes: owned nodes (m,), unit directions (k, 3) and their motion, if they have one."""

    nodes: np.ndarray
    directions: np.ndarray
    motion: Motion | None


class Directions:
    """The prescribed directions of nodes that have any along no axis.

    Parameters
    ----------
    supports : that prescribe components of these nodes, in the order of the case
    nodes : (m,) owned nodes, distinct
    origin : (owned, 3) positions from which displacements count [m]

    Attributes
    ----------
    nodes : (m,), those of them with prescribed directions
    free : (m, 3, 3) projections on the free directions
    at : (r,) owned node of each direction; axes : (r, 3) directions, orthonormal at each node
    contradiction : (support, owned node) of the first direction that depends on those of earlier supports, with another
        motion than theirs; or None
    """

    def __init__(self, supports: Sequence[Prescribed], nodes: np.ndarray, origin: np.ndarray) -> None:
        self.contradiction: tuple[int, int] | None = None
        self._motions = [each.motion for each in supports if each.motion is not None]
        bases = self._bases(supports, nodes)
        counts = np.array([len(basis[0]) for basis in bases], dtype=np.int64)
        self.at = np.repeat(nodes, counts)
        self.axes = np.concatenate([np.zeros((0, 3)), *(basis[0] for basis in bases)])
        # displacement of row r: the sum over j of weights[r, j] times the motion sources[r, j]; -1: at rest
        self._sources = np.concatenate([np.zeros((0, 3), dtype=np.int64), *(basis[1] for basis in bases)])
        self._weights = np.concatenate([np.zeros((0, 3, 3)), *(basis[2] for basis in bases)])
        self.nodes = nodes[counts > 0]
        spans = [basis[0].T @ basis[0] for basis in bases if len(basis[0])]
        self.free = np.eye(3) - np.array(spans).reshape(-1, 3, 3)
        self._origin = origin[self.at].copy()
        self._moved = self._sources >= 0

    def _bases(self, supports: Sequence[Prescribed], nodes: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        """Return directions, sources and weights of each node; nodes with the same supports share them."""
        of_node: dict[int, list[int]] = {node: [] for node in nodes.tolist()}
        for k, each in enumerate(supports):
            for node in each.nodes.tolist():
                if node in of_node:
                    of_node[node].append(k)
        number = np.cumsum([each.motion is not None for each in supports]) - 1
        known: dict[tuple[int, ...], tuple[np.ndarray, ...]] = {}
        found = []
        for node, some in of_node.items():
            key = tuple(some)
            if key not in known:
                known[key] = self._basis([(k, supports[k], int(number[k])) for k in some], node)
            found.append(known[key])
        return found

    def _basis(self, some: list[tuple[int, Prescribed, int]], node: int) -> tuple[np.ndarray, ...]:
        axes, sources, weights = np.zeros((0, 3)), np.full((3, 3), -1), np.zeros((3, 3, 3))
        for k, each, number in some:
            for direction in each.directions:
                along = axes @ direction
                rest = direction - along @ axes
                rest -= (axes @ rest) @ axes
                size = float(np.linalg.norm(rest))
                row = len(axes)
                if size <= RANK:
                    terms = [
                        (self._motions[sources[r, j]], along[r] * weights[r, j])
                        for r, j in np.argwhere(sources[:row] >= 0)
                    ]
                    if self.contradiction is None and not vanishes(
                        [(each.motion, direction), *((m, -w) for m, w in terms)]
                    ):
                        self.contradiction = k, node
                    continue
                # direction . u is given, and so are the parts of u along the axes found before
                sources[row, :row] = sources[np.arange(row), np.arange(row)]
                weights[row] = -np.einsum("i,ijc->jc", along, weights[:row]) / size
                if each.motion is not None:
                    sources[row, row], weights[row, row] = number, direction / size
                axes = np.vstack([axes, rest / size])
        return axes, sources[: len(axes)], weights[: len(axes)]

    def displacements(self, time: float, span: float) -> np.ndarray:
        """Return prescribed displacements [m], velocities [m/s] and accelerations [m/s2], (3, r); see Supports."""
        out = np.zeros((3, len(self.at)))
        if self._moved.any():
            motions = np.stack([motion.at(time, span) for motion in self._motions])
            moved = np.where(self._moved[:, :, None, None], motions[self._sources], 0.0)
            out += np.einsum("rjdc,rjc->dr", moved, self._weights)
        return out

    def coordinates(self, x: np.ndarray) -> np.ndarray:
        """Return displacements (r,) along the directions of positions ``x`` (owned, 3)."""
        return ((x[self.at] - self._origin) * self.axes).sum(axis=1)

    def rounding(self, x: np.ndarray) -> np.ndarray:
        """Return (r,) rounding errors of :meth:`coordinates` at positions ``x`` (owned, 3) [m]."""
        return _ROUNDING * np.maximum(np.abs(x[self.at]), np.abs(self._origin)).max(axis=1, initial=0.0)

    def get(self, vectors: np.ndarray) -> np.ndarray:
        """Return components (r,) of vectors (owned, 3) along the directions."""
        return (vectors[self.at] * self.axes).sum(axis=1)

    def add(self, vectors: np.ndarray, values: np.ndarray) -> None:
        """Add values (r,) along the directions to vectors (owned, 3)."""
        np.add.at(vectors, self.at, values[:, None] * self.axes)

    def clear(self, vectors: np.ndarray) -> None:
        """Set components of vectors (owned or local, 3) along the directions to zero."""
        vectors[self.nodes] = np.einsum("mij,mj->mi", self.free, vectors[self.nodes])

    def part(self, vectors: np.ndarray) -> np.ndarray:
        """Return the parts (m, 3) of vectors (owned, 3) along the directions at :attr:`nodes`."""
        at = vectors[self.nodes]
        return at - np.einsum("mij,mj->mi", self.free, at)


def directions_of(support: Support) -> tuple[np.ndarray, list[int] | None]:
    """Return the unit directions (k, 3) of a support, and the axes that they are, None if one is no axis."""
    if support.normal is not None:
        rows = np.array([support.normal])
        rows = rows / np.abs(rows).max()
        rows /= np.linalg.norm(rows)
    elif support.frame is not None:
        rows = axes_of(*np.array(support.frame))[["xyz".index(letter) for letter in support.fix]]
    else:
        rows = np.eye(3)[["xyz".index(letter) for letter in support.fix]]
    axes = np.abs(rows).argmax(axis=1)
    if (np.abs(rows)[np.arange(len(rows)), axes] == 1.0).all() and (np.count_nonzero(rows, axis=1) == 1).all():
        return np.abs(rows), axes.tolist()
    return rows, None


def axes_of(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the axes (3, 3) of a frame: x along ``first``, y in the plane of both, on the side of ``second``."""
    x = first / np.abs(first).max()
    x /= np.linalg.norm(x)
    y = second / np.abs(second).max()
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])
