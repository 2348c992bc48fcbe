"""What a run checks of contact: nodes beyond walls, bars through walls, crossing bars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..columns import STATUS
from ..errors import SimulationFailure
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..parallel.heap import returning_freed_memory
from ..tolerances import BEYOND
from .contact import Contact
from .neighbours import Points, Segments, find_pairs, largest_change
from .node_walls import held_by_supports
from .wall_motion import Poses

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .walls.base import BaseWall


def check_positions(model: Model, x: np.ndarray, time: float, where: str) -> None:
    """Check that no node lies beyond a wall, with one pass over the nodes and one reduction. Collective.

    Parameters
    ----------
    model : Model
    x : (owned, 3) positions [m] at a time [s] at which contact holds
    where : the step, for the message

    Raises
    ------
    SimulationFailure
        On all ranks, with the wall, its deepest node and depth, the number of nodes, the step, and the remedy.
    """
    contact, comm = model.contact, model.comm
    if not contact.any:
        return
    found = contact.deepest(x, time, BEYOND * max(model.size, model.reach))
    if found is None:
        return
    depth, node, wall, count = found
    own = np.flatnonzero(model.mesh.node_ids[: len(x)] == node)
    carried = comm.allreduce(len(own) > 0 and _prescribed(contact, own[0], wall, x, time))
    if carried:
        raise SimulationFailure(_told(where, node, depth, contact.names[wall], count))
    case = model.case
    treatment = case.contact.treatment
    others = f'contact.treatment = "scheme" instead of "{treatment}"'
    others = others if treatment != "scheme" else "another contact.treatment or time.integrator"
    raise SimulationFailure(
        f"{where}: node {node} is {depth:.3g} m beyond wall {contact.names[wall]!r} "
        f"({count} node{'s' if count > 1 else ''} in all), which contact did not prevent: results since it "
        f"passed the wall are wrong; reduce time.step, or use {others}"
    )


def _told(where: str, node: int, depth: float, wall: str, count: int) -> str:
    """Return the message about nodes that supports move beyond a wall."""
    return (
        f"{where}: node {node} is {depth:.3g} m beyond wall {wall!r} "
        f"({count} node{'s' if count > 1 else ''} in all), moved there by its supports; let the wall move with "
        "the supports, name the nodes that it stops with 'node_set', or do not tie them"
    )


class CarriedNodes:
    """Nodes of this rank whose motion along the normal of a rectangle is prescribed, so that contact cannot stop them.

    Only the step in which a node crosses shows that it did not come from beside or behind, so every step is checked.

    Attributes
    ----------
    of : index of each rectangle that applies to such nodes, to these nodes (k,)
    """

    def __init__(self, contact: Contact) -> None:
        self._contact = contact
        self._before: dict[int, np.ndarray] = {}
        self.of: dict[int, np.ndarray] = {}
        for k, wall in enumerate(contact.walls):
            if wall.partial:
                held = held_by_supports(contact.fixed, wall.normal) | (
                    contact.fixed.any(axis=1) & contact.motion.turning[k]
                )
                nodes = np.flatnonzero(contact.members[:, contact.first[k]] & held)
                self.of |= {k: nodes} if len(nodes) else {}

    def start(self, x: np.ndarray, time: float) -> None:
        """Keep where they are at the start of a step, from all positions (owned, 3) [m] at a time [s]."""
        if self.of:
            self._before = self._places(x, time)

    def _places(self, x: np.ndarray, time: float) -> dict[int, np.ndarray]:
        """Return their positions (k, 3) [m] relative to the rectangles, from all positions (owned, 3)."""
        poses = self._contact.motion.poses(time)
        return {k: poses.rest(k, x[nodes]) for k, nodes in self.of.items()}

    def crossing(self, x: np.ndarray, time: float, where: str) -> str | None:
        """Return the message about nodes that have crossed a rectangle since :meth:`start`, None if there are none."""
        contact, tolerance = self._contact, BEYOND * self._contact.size
        after = self._places(x, time)
        for k, nodes in self.of.items():
            wall = contact.walls[k]
            depth = wall.offset - after[k] @ wall.normal
            crossed = (depth > tolerance) & wall.stops(self._before[k], after[k], np.full(len(nodes), tolerance))
            if crossed.any():
                at = int(np.argmax(np.where(crossed, depth, 0.0)))
                node = int(contact.mesh.node_ids[nodes[at]])
                return _told(where, node, float(depth[at]), contact.names[k], int(crossed.sum()))
        return None


def _prescribed(contact: Contact, node: int, wall: int, x: np.ndarray, time: float) -> bool:
    """Return whether supports prescribe an owned node along a wall's normal, or some components of a tied node.

    ``x`` (owned, 3) : positions [m]
    """
    if contact.ties.any and contact.ties.held[node] and contact.fixed[node].any():
        return True
    normals, _ = contact.planes(np.ones((1, len(contact.wall_of)), dtype=bool), x[[node]], contact.motion.poses(time))
    return bool(held_by_supports(contact.fixed[node], normals[0, contact.first[wall]]))


DEEP = 0.25
"""Depth, as a fraction of the radius, beyond which a bar inside a curved wall is reported."""


def small_walls(walls: Sequence[BaseWall]) -> list[int]:
    """Return the indices of the walls that a bar can cross while its nodes satisfy them."""
    return [k for k, wall in enumerate(walls) if np.isfinite(wall.width)]


def distances(starts: np.ndarray, ends: np.ndarray, point: np.ndarray, axis: np.ndarray | None) -> np.ndarray:
    """Return distances (m,) [m] of segments (m, 3) from a point, or from the line through it along a unit ``axis``."""
    first, way = starts - point, ends - starts
    if axis is not None:
        first, way = first - np.outer(first @ axis, axis), way - np.outer(way @ axis, axis)
    squares = np.einsum("ij,ij->i", way, way)
    part = -np.einsum("ij,ij->i", first, way) / np.maximum(squares, np.finfo(float).tiny)
    return np.linalg.norm(first + np.clip(part, 0.0, 1.0)[:, None] * way, axis=1)


def _crossing(wall: BaseWall, starts: np.ndarray, ends: np.ndarray, slack: float) -> np.ndarray:
    """Return (m,) bool: segments, relative to the rectangle at rest, that cross it."""
    first, second = starts @ wall.normal - wall.offset, ends @ wall.normal - wall.offset
    across = np.minimum(first, second) < -slack
    across &= np.maximum(first, second) > slack
    part = np.where(across, first / np.where(across, first - second, 1.0), 0.0)
    point = starts + part[:, None] * (ends - starts) - wall.centre
    return across & (np.abs(point @ wall.first) < wall.half[0]) & (np.abs(point @ wall.second) < wall.half[1])


class Piercing:
    """Detects bars across walls in each snapshot. Construction is collective.

    Attributes
    ----------
    walls : indices of the walls that are checked
    first : wall to the step and time of the first snapshot with a bar across it, as texts
    seen : wall to the number of snapshots with bars across it
    looks : number of snapshots checked
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.walls = small_walls(model.contact.walls)
        self.first: dict[int, str] = {}
        self.seen = dict.fromkeys(self.walls, 0)
        self.looks = 0
        if not self.walls:
            return
        mesh = model.mesh
        members = np.zeros((mesh.n_local, len(self.walls)))
        members[: mesh.n_owned] = model.contact.members[:, model.contact.first[self.walls]]
        mesh.update_ghosts(members)
        self._bars = mesh.bars[mesh.counted]
        self._applicable = (members[self._bars[:, 0]] > 0.0) & (members[self._bars[:, 1]] > 0.0)

    def look(self, x: np.ndarray, time: float, at: str) -> list[str]:
        """Return new messages about bars at positions (local, 3), ghosts included. Collective.

        ``time`` is that of the stage [s], ``at`` the step and the time for messages.
        """
        if not self.walls:
            return []
        self.looks += 1
        poses = self._model.contact.motion.poses(time)
        found = np.array([self._across(i, k, x, poses) for i, k in enumerate(self.walls)])
        counts, lowest = found[:, 0].copy(), found[:, 1].copy()
        comm = self._model.comm
        comm.Allreduce(MPI.IN_PLACE, counts, op=MPI.SUM)
        comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        told = []
        for count, bar, k in zip(counts.tolist(), lowest.tolist(), self.walls, strict=True):
            self.seen[k] += count > 0
            if count and k not in self.first:
                self.first[k] = at
                bars = f"bar {bar} intersects" if count == 1 else f"{count} bars, including bar {bar}, intersect"
                told.append(
                    f"{at}: {bars} wall {self._model.contact.names[k]!r}: only nodes touch walls; "
                    "use shorter bars or a larger wall"
                )
        return told

    def _across(self, i: int, k: int, x: np.ndarray, poses: Poses) -> tuple[int, int]:
        """Return the number of this rank's bars across wall ``k``, and the lowest of their mesh numbers."""
        mesh, wall = self._model.mesh, self._model.contact.walls[k]
        rows = np.flatnonzero(self._applicable[:, i])
        starts, ends = (poses.rest(k, x[self._bars[rows, end]]) for end in (0, 1))
        if wall.partial:
            across = _crossing(wall, starts, ends, 1e-6 * self._model.length)
        elif hasattr(wall, "crossed"):
            across = wall.crossed(starts, ends)
        else:
            across = distances(starts, ends, wall.centre, getattr(wall, "axis", None)) < (1.0 - DEEP) * wall.radius
        ids = mesh.bar_ids[mesh.counted][rows[across]]
        return len(ids), int(ids.min()) if len(ids) else int(np.iinfo(np.int64).max)

    def summary(self) -> list[str]:
        """Return messages for the end of the run, about walls that bars intersected again after the first message."""
        names = self._model.contact.names
        return [
            f"bars intersected wall {names[k]!r} in {self.seen[k]} of {self.looks} snapshots, first at "
            f"{self.first[k]}: only nodes touch walls"
            for k in self.walls
            if self.seen[k] > 1
        ]


STOUT = 0.25
"""Radius of a bar over its length beyond which it has no axis that others could cross."""

# Bars this much closer to each other in the mesh, relative to their radii, touch there: it may be rounding.
_NEAR = 0.01

# Distance between bars up to which the search knows it, over their mean length. No search is needed before it has
# changed.
_SKIN = 0.1

# Coordinate beyond which a node is not searched [m].
_STRAY = 1e100


class Crossing(NamedTuple):
    """Pairs of bars that pass through each other, number of bars among them, and the lowest pair of numbers."""

    pairs: int
    bars: int
    lowest: tuple[int, int]


class CrossingBars:
    """Finds bars that pass through each other and did not in the mesh. Collective, with results for any ranks alike.

    Bars with an end in contact pairs or constraints may meet, by which others of this kind come close: such pairs are
    left out, and so are springs, dashpots, broken bars, and bars that are less than twice as long as thick.

    Attributes
    ----------
    applicable : whether there are bars to be searched
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        mesh = model.mesh
        self._n_bars = mesh.n_bars - mesh.n_connectors
        radius = model.bars.radii()[mesh.counted]
        slender = radius < STOUT * model.bars.mesh_lengths[mesh.counted]
        slender &= mesh.bar_ids[mesh.counted] < self._n_bars
        self._bars = mesh.counted
        if not (isinstance(self._bars, slice) and slender.all()):
            self._bars = np.arange(len(mesh.bars), dtype=np.int32)[self._bars][slender]
        self.applicable = model.comm.allreduce(int(np.count_nonzero(slender))) > 1 and model.self_contact is None
        self._thick = 2.0 * model.comm.allreduce(float(radius[slender].max(initial=0.0)), op=MPI.MAX)
        self._kind = self._linked_bars()
        self._last: _Search | None = None

    def _linked_bars(self) -> np.ndarray:
        """Return (bars,) uint8: 1 for those with an end in contact pairs or constraints, else 0; (0,) without any.
        Collective."""
        case, mesh = self._model.case, self._model.mesh
        tables = (*case.contact_pair, *case.constraint)
        if not tables:
            return np.empty(0, np.uint8)
        linked = np.zeros((mesh.n_local, 1))
        for table in tables:
            for value in table.model_dump().values():
                for name in value if isinstance(value, list | tuple) else [value]:
                    if isinstance(name, str) and name in self._model.nodes:
                        linked[self._model.nodes[name]] = 1.0
        mesh.update_ghosts(linked)
        return (linked[mesh.bars[self._bars], 0] > 0.0).any(axis=1).astype(np.uint8)

    def find(self, x: np.ndarray) -> Crossing | None:
        """Return the bars at positions (local, 3) [m] that pass through each other; None if the search would take too
        long, because too many bars are in one place."""
        if self._last is None:  # in the mesh, no bar does
            self._last = _Search(Crossing(0, 0, (-1, -1)), 0.0, self._model.mesh.points, self._intact())
        comm, last, owned = self._model.comm, self._last, self._model.mesh.n_owned
        motion = last.x[:owned], x[:owned]
        change = largest_change(comm, motion, self._model.mesh.n_nodes, self._thick + last.gap)
        if comm.allreduce(bool((self._intact() != last.intact).any()), op=MPI.LOR):
            change = np.inf
        if change > 0.0 and change >= 0.998 * self._last.gap:
            with returning_freed_memory():
                found, gap = self._search(x)
            self._last = _Search(found, gap, x.copy(), self._intact())
        return self._last.found

    def _intact(self) -> np.ndarray:
        """Return (bars,) bool: those that are not broken; (0,) if none can break."""
        if not self._model.bars.can_break:
            return np.empty(0, dtype=bool)
        return self._model.bars.status()[self._bars] != STATUS.index("broken")

    def _count(self, pairs: np.ndarray) -> Crossing:
        """Return the number of pairs and bars from the pairs (m, 2) that this rank has found. Collective."""
        comm, n = self._model.comm, self._n_bars
        both = np.unique(pairs)
        bars = np.unique(Router(comm, slab_of(both, n, comm.size)).send(both))
        lowest = int((pairs[:, 0] * n + pairs[:, 1]).min(initial=np.iinfo(np.int64).max))
        lowest = comm.allreduce(lowest, op=MPI.MIN)
        return Crossing(comm.allreduce(len(pairs)), comm.allreduce(len(bars)), (lowest // n, lowest % n))

    def _search(self, x: np.ndarray) -> tuple[Crossing | None, float]:
        """Return the pairs at positions (local, 3) [m], and by how much the distance of any two bars differs at least
        from the sum of their radii [m]."""
        comm, mesh, bars = self._model.comm, self._model.mesh, self._model.bars
        ids, ends, radius, kind = mesh.bar_ids[self._bars], mesh.bars[self._bars], bars.radii()[self._bars], self._kind
        # stray nodes may be anywhere, and squares of distances must be finite; a NaN has its own message elsewhere
        near = (np.abs(x) < _STRAY).all(axis=1)
        if bars.can_break or not near.all():
            kept = near[ends].all(axis=1)
            if bars.can_break:
                kept &= self._intact()
            ids, ends, radius, kind = ids[kept], ends[kept], radius[kept], kind[kept] if len(kind) else kind
        segments = Segments(ids, ends, radius, kind)
        found = find_pairs(comm, Points(x, mesh.node_ids, mesh.points), segments, _SKIN, 1.0 + _NEAR)
        return (None, 0.0) if found is None else (self._count(found.ids), found.gap)


class _Search(NamedTuple):
    """The last search: its result, the smallest distance at which that would change [m], positions (local, 3), and
    which bars were intact."""

    found: Crossing | None
    gap: float
    x: np.ndarray
    intact: np.ndarray
