"""Supports: prescribed components of node positions, fixed or moving, along axes or other directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .directions import Directions, Prescribed, directions_of
from .motion import Motion, motion_of

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh

__all__ = ["Supports"]


class Supports:
    """Prescribed components on this rank.

    Values (k,) of all prescribed components have those along axes first, in the order of :attr:`nodes` and
    :attr:`components`, then those along the directions of :attr:`inclined`.

    Attributes
    ----------
    fixed : (owned, 3) bool, prescribed components along axes, of nodes that have no other directions
    any : whether any component of the whole model is prescribed
    moves : whether any of them moves; moving : whether their values are set in each balance, because one moves or is
        along no axis
    at : (nodes, components), an index into arrays (owned, 3)
    nodes, components : (a,) indices of the prescribed components along axes, sorted by node
    inclined : Directions of the nodes with others; None if the whole model has none
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        self.fixed = np.zeros((mesh.n_owned, 3), dtype=bool)
        self._named: dict[str, tuple[np.ndarray, list[int]]] = {}
        self._all: list[tuple[str | None, Prescribed]] = []
        self._origin = mesh.points[: mesh.n_owned]
        motions: list[tuple[np.ndarray, list[int], Motion]] = []
        given = [directions_of(support) for support in case.support]
        turned = np.zeros(mesh.n_owned, dtype=bool)
        for support, (_, axes) in zip(case.support, given, strict=True):
            turned[nodes[support.node_set]] |= axes is None
        for index, (support, (directions, axes)) in enumerate(zip(case.support, given, strict=True)):
            members = nodes[support.node_set]
            # one that stays in force from the stage before holds its nodes where they are
            motion = None if case.holds("support") else motion_of(support)
            self._all.append((support.name, Prescribed(members, directions, motion)))
            members, axes = members[~turned[members]], axes or []
            if support.name is not None:
                self._named[support.name] = members, axes
            for axis in axes:
                if motion is not None and self.fixed[members, axis].any():
                    node = mesh.node_ids[members[self.fixed[members, axis]][0]]
                    raise InputError(
                        f"{case.source}: support[{index}]: the {'xyz'[axis]} component of node {node} is already "
                        "prescribed by an earlier support; give each component one support"
                    )
                self.fixed[members, axis] = True
            if motion is not None:
                motions.append((members, axes, motion))
        self._motions = motions
        self._index()
        self._start = self._origin[self.fixed]
        self._gone: set[str] = set()
        self._turned = np.flatnonzero(turned)
        self.inclined: Directions | None = None
        if any(axes is None for _, axes in given):
            self.inclined = self._directions()
            if self.inclined.twice is not None:
                index, node = self.inclined.twice
                raise InputError(
                    f"{case.source}: support[{index}]: a direction of node {mesh.node_ids[node]} is already prescribed "
                    "by earlier supports; give each direction one support"
                )
        self.moves = any(each.motion is not None for _, each in self._all)
        self.moving = self.moves or self.inclined is not None
        self.any = bool(case.support)

    def _directions(self) -> Directions:
        left = [each if name not in self._gone else each._replace(nodes=each.nodes[:0]) for name, each in self._all]
        return Directions(left, self._turned, self._origin)

    def hold(self, x: np.ndarray) -> None:
        """Take the positions (owned, 3) [m] at the start of a stage for those that motions start from."""
        self._start = x[self.fixed]
        self._origin = x
        if self.inclined is not None:
            self.inclined = self._directions()

    def of_name(self, name: str) -> np.ndarray:
        """Return which components (owned, 3) bool along axes a support of the case prescribes."""
        mine = np.zeros_like(self.fixed)
        members, axes = self._named[name]
        for axis in axes:
            mine[members, axis] = True
        return mine

    def release(self, names: list[str]) -> None:
        """Prescribe the components of some supports no longer."""
        mask = self._mask(names)
        keep = ~mask[self.fixed]
        self._start = self._start[keep]
        self.fixed &= ~mask  # in place: contact holds the array
        self._index()
        if self.inclined is not None:
            self._gone |= set(names)
            self.inclined = self._directions()

    def freed(self, names: list[str], forces: np.ndarray) -> np.ndarray:
        """Return the parts of forces (owned, 3) along the components that :meth:`release` of some supports frees."""
        parts = np.where(self._mask(names), forces, 0.0)
        if self.inclined is not None:
            before, gone = self.inclined, self._gone
            self._gone = gone | set(names)
            after, self._gone = self._directions(), gone
            parts[before.nodes] += before.part(forces)
            parts[after.nodes] -= after.part(forces)
        return parts

    def _mask(self, names: list[str]) -> np.ndarray:
        mask = np.zeros_like(self.fixed)
        for name in names:
            mask |= self.of_name(name)
        return mask & self.fixed

    def hold_nodes(self, nodes: np.ndarray, x: np.ndarray) -> None:
        """Prescribe all components of nodes (k,), where they are at positions ``x`` (owned, 3) [m]."""
        start = x.copy()
        start[self.fixed] = self._start
        self.fixed[nodes] = True
        self._start = start[self.fixed]
        self.any = True
        self._index()
        if self.inclined is not None:
            self._turned = np.setdiff1d(self._turned, nodes)
            self.inclined = self._directions()

    def _index(self) -> None:
        self.nodes, self.components = np.nonzero(self.fixed)
        self.at = (self.nodes, self.components)
        # where the components of each motion stand among those prescribed, as far as they still are
        keys = 3 * self.nodes + self.components
        self._places = [
            [np.flatnonzero(np.isin(keys, 3 * members + axis)) for axis in axes] for members, axes, _ in self._motions
        ]

    @property
    def every_node(self) -> np.ndarray:
        """Owned node (k,) of each prescribed component."""
        return self.nodes if self.inclined is None else np.concatenate([self.nodes, self.inclined.at])

    def held_nodes(self) -> np.ndarray:
        """Return nodes (owned,) bool with all components prescribed."""
        held = self.fixed.all(axis=1)
        if self.inclined is not None:
            held[self.inclined.nodes] = np.trace(self.inclined.free, axis1=1, axis2=2) < 0.5
        return held

    def spans(self) -> np.ndarray:
        """Return the projections (owned, 3, 3) of the nodes on their prescribed directions."""
        held = np.eye(3) * self.fixed[:, :, None]
        if self.inclined is not None:
            held[self.inclined.nodes] = np.eye(3) - self.inclined.free
        return held

    def positions(self, time: float) -> np.ndarray:
        """Return prescribed :meth:`coordinates` (k,) [m] at a time [s]."""
        if not self._motions and self.inclined is None:
            return self._start
        return self._joined(self._start, 0.0) + self._at(time, 0.0)[0]

    def _joined(self, along_axes: np.ndarray, others: np.ndarray | float) -> np.ndarray:
        if self.inclined is None:
            return along_axes
        return np.append(along_axes, np.broadcast_to(others, len(self.inclined.at)))

    def rates(self, time: float, span: float) -> tuple[np.ndarray, np.ndarray]:
        """Return prescribed velocities (k,) [m/s] and accelerations (k,) [m/s2] at a time [s], the exact derivatives.

        At velocity jumps (linear interpolation) the acceleration is the mean over the preceding ``span`` [s].
        """
        _, v, a = self._at(time, span)
        return v, a

    def _at(self, time: float, span: float) -> np.ndarray:
        along_axes = np.zeros((3, len(self.nodes)))  # displacements, velocities, accelerations
        for (_, axes, motion), places in zip(self._motions, self._places, strict=True):
            moved = motion.at(time, span)
            for axis, of_axis in zip(axes, places, strict=True):
                along_axes[:, of_axis] = moved[:, axis, None]
        if self.inclined is None:
            return along_axes
        return np.concatenate([along_axes, self.inclined.displacements(time, span)], axis=1)

    def coordinates(self, x: np.ndarray) -> np.ndarray:
        """Return the prescribed components (k,) of positions ``x`` (owned, 3): coordinates along axes, displacements
        along other directions."""
        return self._joined(x[self.at], 0.0 if self.inclined is None else self.inclined.coordinates(x))

    def place(self, x: np.ndarray, values: np.ndarray) -> None:
        """Set the prescribed components of positions ``x`` (owned, 3) to values (k,) of :meth:`coordinates`."""
        along_axes = len(self.nodes)
        if self.inclined is not None:
            self.inclined.add(x, values[along_axes:] - self.inclined.coordinates(x))
        x[self.at] = values[:along_axes]

    def lacking(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return how far prescribed components of ``x`` (owned, 3) are from their values at a time, (k,) [m].

        Differences along directions that are rounding are zero: divided by the square of a step they are none.
        """
        way = self.positions(time) - self.coordinates(x)
        if self.inclined is not None:
            others = way[len(self.nodes) :]
            others[np.abs(others) <= self.inclined.rounding(x)] = 0.0
        return way

    def get(self, vectors: np.ndarray) -> np.ndarray:
        """Return the prescribed components (k,) of vectors (owned, 3)."""
        return self._joined(vectors[self.at], 0.0 if self.inclined is None else self.inclined.get(vectors))

    def put(self, vectors: np.ndarray, values: np.ndarray) -> None:
        """Set the prescribed components of vectors (owned, 3) to values (k,)."""
        along_axes = len(self.nodes)
        if self.inclined is not None:
            self.inclined.clear(vectors)
            self.inclined.add(vectors, values[along_axes:])
        vectors[self.at] = values[:along_axes]

    def clear(self, vectors: np.ndarray) -> None:
        """Set the prescribed components of vectors (owned, 3) to zero."""
        vectors[self.fixed] = 0.0
        if self.inclined is not None:
            self.inclined.clear(vectors)

    def part(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors (owned, 3) without components that are not prescribed."""
        parts = np.zeros_like(vectors)
        parts[self.fixed] = vectors[self.fixed]
        if self.inclined is not None:
            parts[self.inclined.nodes] = self.inclined.part(vectors)
        return parts

    @property
    def number(self) -> int:
        """Prescribed components of this rank."""
        return len(self.every_node)
