"""Supports: prescribed components of node positions, fixed or moving, along axes or directions of single nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError
from ..tolerances import RANK
from .motion import motion_of, vanishes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import Support
    from ..mesh.distribution import DistributedMesh
    from .motion import Motion


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
    origins : (a,) positions from which their displacements count [m]
    columns : (a,) of these components in what :meth:`schedule` returns, -1 for those at rest
    inclined : Directions of the nodes with others; None if the whole model has none
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        self.fixed = np.zeros((mesh.n_owned, 3), dtype=bool)
        self._detached = np.zeros(mesh.n_owned, dtype=bool)
        self._gone: set[str] = set()
        self._origin = mesh.points[: mesh.n_owned]
        given = [directions_of(support) for support in case.support]
        turned = np.zeros(mesh.n_owned, dtype=bool)
        for support, (_, axes) in zip(case.support, given, strict=True):
            turned[nodes[support.node_set]] |= axes is None
        self._turned = np.flatnonzero(turned)
        self._all: list[tuple[str | None, Prescribed]] = []
        self._along_axes: list[tuple[np.ndarray, list[int]]] = []  # nodes and axes of each support, without turned ones
        for support, (directions, axes) in zip(case.support, given, strict=True):
            members = nodes[support.node_set]
            # one that stays in force from the stage before holds its nodes where they are
            motion = None if case.holds("support") else motion_of(support)
            self._all.append((support.name, Prescribed(members, directions, motion)))
            self._along_axes.append((members[~turned[members]], axes or []))
        self.inclined: Directions | None = None
        if any(axes is None for _, axes in given):
            self.inclined = self._directions()
        self._refuse_contradictions(case, mesh, self._index())
        self.moves = any(each.motion is not None for _, each in self._all)
        self.moving = self.moves or self.inclined is not None
        self.any = bool(case.support)

    def _refuse_contradictions(self, case: Case, mesh: DistributedMesh, first: np.ndarray) -> None:
        """Refuse supports that prescribe one component, whatever their order and axes, unless their motions agree."""
        remedy = "by an earlier support with another motion; give both the same motion, or each component one support"
        for index, ((_, each), (members, axes)) in enumerate(zip(self._all, self._along_axes, strict=True)):
            for axis in axes:
                others, unit = first[members, axis], np.eye(3)[axis]
                for other in np.unique(others[others != index]):
                    if not vanishes([(each.motion, unit), (self._all[other][1].motion, -unit)]):
                        node = mesh.node_ids[members[others == other][0]]
                        raise InputError(
                            f"{case.source}: support[{index}]: the {'xyz'[axis]} component of node {node} is already "
                            f"prescribed {remedy}"
                        )
        if self.inclined is not None and self.inclined.contradiction is not None:
            index, node = self.inclined.contradiction
            raise InputError(
                f"{case.source}: support[{index}]: a direction of node {mesh.node_ids[node]} is already prescribed "
                f"{remedy}"
            )

    def _directions(self) -> Directions:
        left = [each if name not in self._gone else each._replace(nodes=each.nodes[:0]) for name, each in self._all]
        return Directions(left, self._turned, self._origin)

    def hold(self, x: np.ndarray) -> None:
        """Take the positions (owned, 3) [m] at the start of a stage for those that motions start from."""
        self._origin = x
        self._update()

    def release(self, names: list[str]) -> None:
        """Remove supports; components that another support prescribes too remain prescribed."""
        self._gone |= set(names)
        self._update()

    def hold_nodes(self, nodes: np.ndarray, x: np.ndarray) -> None:
        """Prescribe all components of nodes (k,), where they are at positions ``x`` (owned, 3) [m]."""
        origin = self._origin.copy()
        origin[nodes] = np.where(self.fixed[nodes], origin[nodes], x[nodes])
        self._origin = origin
        self._detached[nodes] = True
        self._turned = np.setdiff1d(self._turned, nodes)
        self.any = True
        self._update()

    def _update(self) -> None:
        self._index()
        if self.inclined is not None:
            self.inclined = self._directions()

    def _index(self) -> np.ndarray:
        """Find the prescribed components along axes; return the first support (owned, 3) of each, or -1."""
        first = np.full(self.fixed.shape, -1, dtype=np.int32)
        for k, ((name, _), (members, axes)) in enumerate(zip(self._all, self._along_axes, strict=True)):
            for axis in axes if name not in self._gone else []:
                first[members[first[members, axis] < 0], axis] = k
        self.fixed[:] = (first >= 0) | self._detached[:, None]  # in place: contact holds the array
        # contiguous, as empty ones are: loops would be compiled anew for the columns of one array
        self.nodes, self.components = map(np.ascontiguousarray, np.nonzero(self.fixed))
        self.at = (self.nodes, self.components)
        self.origins = self._origin[self.at]
        moves = [k for k, (_, each) in enumerate(self._all) if each.motion is not None]
        self._motions = [self._all[k][1].motion for k in moves]
        begins = np.full(len(self._all) + 1, -1)  # of the columns of each support; the last one is no support
        begins[moves] = 3 * np.arange(len(moves))
        own = begins[first[self.at]]
        self.columns = np.where(own >= 0, own + self.components, -1)
        return first

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
            return self.origins
        return self._joined(self.origins, 0.0) + self._at(time, 0.0)[0]

    def _joined(self, along_axes: np.ndarray, others: np.ndarray | float) -> np.ndarray:
        if self.inclined is None:
            return along_axes
        return np.append(along_axes, np.broadcast_to(others, len(self.inclined.at)))

    def rates(self, time: float, span: float) -> tuple[np.ndarray, np.ndarray]:
        """Return prescribed velocities (k,) [m/s] and accelerations (k,) [m/s2] at a time [s], the exact derivatives.

        At velocity jumps (linear interpolation) the acceleration is the mean over the preceding ``span`` [s].
        """
        return tuple(self._at(time, span)[1:])

    def schedule(self, times: np.ndarray, span: float) -> np.ndarray:
        """Return the displacements [m], velocities [m/s] and accelerations [m/s2] of all m motions along axes at times
        (t,) [s], (t, 3, 3 m), see :attr:`columns`. ``span``: see :meth:`rates`."""
        moved = [motion.at(times, span) for motion in self._motions]
        return np.concatenate([np.zeros((len(times), 3, 0)), *moved], axis=2)

    def _at(self, time: float, span: float) -> np.ndarray:
        along_axes, moved = np.zeros((3, len(self.nodes))), self.columns >= 0
        along_axes[:, moved] = self.schedule(np.array([time]), span)[0][:, self.columns[moved]]
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
        if not self.any:
            return
        vectors[self.at] = 0.0
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
