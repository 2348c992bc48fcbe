"""What a run checks of contact: nodes beyond walls, bars through walls, crossing bars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..fields import STATUS
from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..tolerances import BEYOND
from .contact import Contact
from .forces import held_by_supports

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.stepper import Stepper
    from .walls.base import BaseWall


def check_positions(stepper: Stepper) -> None:
    """Check that no node lies beyond a wall, with one pass over the nodes and one reduction. Collective.

    Parameters
    ----------
    stepper : Stepper
        At the end of a step.

    Raises
    ------
    SimulationFailure
        On all ranks, with the wall, its deepest node and depth, the number of nodes, the step, and the remedy.
    """
    model, state, balance = stepper.model, stepper.state, stepper.balance
    contact, comm = model.contact, model.comm
    if not contact.any:
        return
    x, time = state.position, state.time
    if not stepper.scheme.solves_end:
        if balance is None:  # at the start, or right after a restart: checked before
            return
        x, time = balance.predictor + stepper.solution.u, balance.time
    gaps = contact.gaps(x, time)
    gaps[:, [wall.partial for wall in contact.walls]] = np.inf
    tolerance = BEYOND * max(model.size, model.reach)
    # a NaN has its own message elsewhere
    suspects = np.flatnonzero((gaps < -tolerance).any(axis=1))
    if comm.allreduce(len(suspects), op=MPI.MAX) == 0:
        return
    deepest = (0.0, -1, -1)
    if len(suspects):
        at, wall = np.unravel_index(int(gaps[suspects].argmin()), (len(suspects), len(contact.walls)))
        deepest = (float(gaps[suspects[at], wall]), int(model.mesh.node_ids[suspects[at]]), int(wall))
    depth, node, wall = min(comm.allgather(deepest))
    count = comm.allreduce(int((gaps[:, wall] < -tolerance).sum()))
    carried = comm.allreduce(deepest == (depth, node, wall) and _prescribed(contact, suspects[at], wall, x, time))
    where = f"step {stepper.number}, t = {stepper.place:.6g} s"
    if carried:
        raise SimulationFailure(_told(where, node, -depth, contact.names[wall], count))
    case = model.case
    others = "another contact.treatment or time.integrator"
    if case.contact.treatment != "scheme":
        others = f'contact.treatment = "scheme" instead of "{case.contact.treatment}"'
    raise SimulationFailure(
        f"{where}: node {node} is {-depth:.3g} m beyond wall {contact.names[wall]!r} "
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
                nodes = np.flatnonzero(contact.members[:, k] & held_by_supports(contact.fixed, wall.normal))
                self.of |= {k: nodes} if len(nodes) else {}

    def start(self, x: np.ndarray, time: float) -> None:
        """Keep where they are at the start of a step, from all positions (owned, 3) [m] at a time [s]."""
        if self.of:
            self._before = self._places(x, time)

    def _places(self, x: np.ndarray, time: float) -> dict[int, np.ndarray]:
        """Return their positions (k, 3) [m] relative to the rectangles, from all positions (owned, 3)."""
        displacements = self._contact.motion.displacements(time)
        return {k: x[nodes] - displacements[k] for k, nodes in self.of.items()}

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
    normals, _ = contact.planes(
        np.ones((1, len(contact.walls)), dtype=bool), x[[node]], contact.motion.displacements(time)
    )
    return bool(held_by_supports(contact.fixed[node], normals[0, wall]))


DEEP = 0.25
"""Depth, as a fraction of the radius, beyond which a bar inside a curved wall is reported."""


def small_walls(walls: Sequence[BaseWall]) -> list[int]:
    """Return the indices of the walls that a bar can cross while its nodes satisfy them."""
    return [k for k, wall in enumerate(walls) if wall.partial or getattr(wall, "sign", -1.0) > 0.0]


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
    first : wall to the time [s] of the first snapshot with a bar across it
    seen : wall to the number of snapshots with bars across it
    looks : number of snapshots checked
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.walls = small_walls(model.contact.walls)
        self.first: dict[int, float] = {}
        self.seen = dict.fromkeys(self.walls, 0)
        self.looks = 0
        if not self.walls:
            return
        mesh = model.mesh
        members = np.zeros((mesh.n_local, len(self.walls)))
        members[: mesh.n_owned] = model.contact.members[:, self.walls]
        mesh.update_ghosts(members)
        self._bars = mesh.bars[mesh.counted]
        self._applicable = (members[self._bars[:, 0]] > 0.0) & (members[self._bars[:, 1]] > 0.0)

    def look(self, x: np.ndarray, time: float) -> list[str]:
        """Return new messages about bars at positions (local, 3), ghosts included. Collective."""
        if not self.walls:
            return []
        self.looks += 1
        displacements = self._model.contact.motion.displacements(time)
        found = np.array([self._across(i, k, x, displacements[k]) for i, k in enumerate(self.walls)])
        counts, lowest = found[:, 0].copy(), found[:, 1].copy()
        comm = self._model.comm
        comm.Allreduce(MPI.IN_PLACE, counts, op=MPI.SUM)
        comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        told = []
        for count, bar, k in zip(counts.tolist(), lowest.tolist(), self.walls, strict=True):
            self.seen[k] += count > 0
            if count and k not in self.first:
                self.first[k] = time = self._model.origin + time
                bars = f"bar {bar} intersects" if count == 1 else f"{count} bars, including bar {bar}, intersect"
                told.append(
                    f"t = {time:.6g} s: {bars} wall {self._model.contact.names[k]!r}: only nodes touch walls; "
                    "use shorter bars or a larger wall"
                )
        return told

    def _across(self, i: int, k: int, x: np.ndarray, shift: np.ndarray) -> tuple[int, int]:
        """Return the number of this rank's bars across wall ``k``, and the lowest of their mesh numbers."""
        mesh, wall = self._model.mesh, self._model.contact.walls[k]
        rows = np.flatnonzero(self._applicable[:, i])
        starts, ends = x[self._bars[rows, 0]] - shift, x[self._bars[rows, 1]] - shift
        if wall.partial:
            across = _crossing(wall, starts, ends, 1e-6 * self._model.length)
        else:
            across = distances(starts, ends, wall.centre, getattr(wall, "axis", None)) < (1.0 - DEEP) * wall.radius
        ids = mesh.bar_ids[mesh.counted][rows[across]]
        return len(ids), int(ids.min()) if len(ids) else int(np.iinfo(np.int64).max)

    def summary(self) -> list[str]:
        """Return messages for the end of the run."""
        names = self._model.contact.names
        return [
            f"bars intersected wall {names[k]!r} in {self.seen[k]} of {self.looks} snapshots, first at t = "
            f"{self.first[k]:.6g} s: only nodes touch walls"
            for k in self.walls
            if k in self.first
        ]


STOUT = 0.25
"""Radius of a bar over its length beyond which it has no axis that others could cross."""

# Bars this much closer to each other in the mesh, relative to their radii, touch there: it may be rounding.
_NEAR = 0.01

# Distance between bars up to which the search knows it, over their mean length. Until nodes have moved by half of the
# smallest distance, no search is needed.
_SKIN = 0.1

# Coordinate beyond which a node is not searched [m].
_STRAY = 1e100

# Limits of the work: cells listed and pairs compared, both per bar.
_CELLS, _PAIRS = 64.0, 2000.0

# Cells of 8 x 8 x 8 belong to one rank, so that most bars are sent to one or two.
_BLOCK = 8


class Crossing(NamedTuple):
    """Pairs of bars that pass through each other, number of bars among them, and the lowest pair of numbers."""

    pairs: int
    bars: int
    lowest: tuple[int, int]


class _Segments(NamedTuple):
    """Bars: numbers (n,), those of their end nodes (n, 2), ends (n, 2, 3) [m] and radii (n,) [m]."""

    ids: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray
    radius: np.ndarray


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
        mesh, bars = model.mesh, model.bars
        counted = np.arange(len(mesh.bars))[mesh.counted]
        radius = bars.radii()[counted]
        slender = radius < STOUT * bars.mesh_lengths[counted]
        slender &= mesh.bar_ids[counted] < mesh.n_bars - mesh.n_connectors
        self._bars, self._radius = counted[slender], radius[slender]
        self._n_bars = mesh.n_bars - mesh.n_connectors
        self.applicable = model.comm.allreduce(len(self._bars)) > 1
        self._meeting = self._linked_nodes()
        self._before: np.ndarray | None = None
        self._last: _Search | None = None

    def _linked_nodes(self) -> np.ndarray:
        """Return (local,) 1.0 for nodes in contact pairs and constraints, else 0.0. Collective."""
        case, mesh = self._model.case, self._model.mesh
        linked = np.zeros((mesh.n_local, 1))
        for table in (*case.contact_pair, *case.constraint):
            for value in table.model_dump().values():
                for name in value if isinstance(value, list | tuple) else [value]:
                    if isinstance(name, str) and name in self._model.nodes:
                        linked[self._model.nodes[name]] = 1.0
        mesh.update_ghosts(linked)
        return linked[:, 0]

    def find(self, x: np.ndarray) -> Crossing | None:
        """Return the bars at positions (local, 3) [m] that pass through each other; None if the search would take too
        long, because too many bars are in one place."""
        if self._last is None:
            points = self._model.mesh.points
            self._before, gap = self._pairs(points, 1.0 + _NEAR)
            self._last = _Search(Crossing(0, 0, (-1, -1)), gap, points, self._intact())
        if self._before is None:
            return None
        if self._moved(x) < 0.499 * self._last.gap:
            return self._last.found
        pairs, gap = self._pairs(x, 1.0)
        found = None if pairs is None else self._count(pairs[~np.isin(pairs, self._before)])
        self._last = _Search(found, gap, x.copy(), self._intact())
        return found

    def _intact(self) -> np.ndarray:
        """Return (bars,) bool: those that are not broken."""
        if not self._model.bars.can_break:
            return np.ones(len(self._bars), dtype=bool)
        return self._model.bars.status()[self._bars] != STATUS.index("broken")

    def _moved(self, x: np.ndarray) -> float:
        """Return how far a node has moved relative to the others since the last search [m]; infinite if bars broke."""
        comm, last, owned = self._model.comm, self._last, self._model.mesh.n_owned
        moved = x - last.x
        mean = comm.allreduce(moved[:owned].sum(axis=0)) / self._model.mesh.n_nodes
        moved -= mean
        square = float(np.einsum("ij,ij->i", moved, moved).max(initial=0.0))
        broken = bool((self._intact() != last.intact).any()) or not np.isfinite(square)
        return np.sqrt(comm.allreduce(np.inf if broken else square, op=MPI.MAX))

    def _count(self, new: np.ndarray) -> Crossing:
        """Return the number of pairs and bars from the keys of pairs on this rank. Collective."""
        comm, n = self._model.comm, self._n_bars
        first, second = new // n, new % n
        both = np.unique(np.concatenate([first, second]))
        bars = np.unique(Router(comm, slab_of(both, n, comm.size)).send(both))
        lowest = int(new.min()) if len(new) else np.iinfo(np.int64).max
        lowest = comm.allreduce(lowest, op=MPI.MIN)
        return Crossing(comm.allreduce(len(new)), comm.allreduce(len(bars)), (lowest // n, lowest % n))

    def _pairs(self, x: np.ndarray, factor: float) -> tuple[np.ndarray | None, float]:
        """Return keys of pairs, first number times the number of bars plus second, on the rank of the first, and by how
        much the distance of any two bars differs at least from the sum of their radii [m]; radii are multiplied by a
        factor."""
        comm, mesh = self._model.comm, self._model.mesh
        chosen = self._bars
        kept = self._intact()
        ends = mesh.bars[chosen[kept]]
        # stray nodes may be anywhere, and squares of distances must be finite; a NaN has its own message elsewhere
        fine = (np.abs(x[ends]) < _STRAY).all(axis=(1, 2))
        ends, kept = ends[fine], np.flatnonzero(kept)[fine]
        nodes, points, radius = mesh.node_ids[ends].astype(np.int64), x[ends], factor * self._radius[kept]
        meeting = (self._meeting[ends] > 0.0).any(axis=1)
        turned = nodes[:, 0] > nodes[:, 1]
        nodes[turned], points[turned] = nodes[turned, ::-1], points[turned, ::-1]
        segments = _Segments(mesh.bar_ids[chosen[kept]].astype(np.int64), nodes, points, radius)
        low = np.min(points, axis=(0, 1), initial=np.inf) if len(points) else np.full(3, np.inf)
        comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
        lengths = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
        number, size = comm.allreduce(np.array([len(lengths), float((lengths + 4.0 * radius).sum())]))
        if not number:
            return np.empty(0, np.int64), np.inf
        skin = _SKIN * size / number
        cell = 0.5 * size / number
        while True:
            cells = (lengths // cell + 1.0) * (2.0 + (2.0 * radius + skin) / cell) ** 3
            if comm.allreduce(float(cells.sum())) <= _CELLS * number:
                break
            cell *= 2.0
        grid = _Cells(low, cell, comm.size)
        held = _Held(segments, radius + 0.5 * skin, meeting).sent(comm, grid)
        buckets = _buckets(*held.cells(comm, grid))
        counts = np.diff(buckets[0]).astype(float)
        if comm.allreduce(float((counts * counts).sum())) > 2.0 * _PAIRS * number:
            return None, 0.0
        room = max(1024, len(held.segments.ids))
        while True:
            out = np.empty((room, 2), np.int64)
            found, gap = _compare(buckets, held.segments, held.meeting, grid, skin, out)
            if found <= room:
                break
            room = found
        one, two = out[:found].min(axis=1), out[:found].max(axis=1)
        keys = Router(comm, slab_of(one, self._n_bars, comm.size)).send(one * self._n_bars + two)
        return keys, comm.allreduce(gap, op=MPI.MIN)


class _Search(NamedTuple):
    """The last search: its result, the smallest distance at which that would change [m], positions (local, 3), and
    which bars were intact."""

    found: Crossing | None
    gap: float
    x: np.ndarray
    intact: np.ndarray


class _Cells(NamedTuple):
    """Cells of space: the corner of the first (3,) and the length of their edges [m], and how many ranks hold them."""

    low: np.ndarray
    cell: float
    size: int


class _Held(NamedTuple):
    """Bars of a rank, the distances around them in which others are searched (n,) [m], and which of them are at links
    (n,) bool."""

    segments: _Segments
    margin: np.ndarray
    meeting: np.ndarray

    def sent(self, comm: MPI.Comm, grid: _Cells) -> _Held:
        """Return the bars that pass cells of this rank. Collective."""
        if comm.size == 1:
            return self
        ends, margin = self.segments.ends, self.margin
        count = _list_cells(ends, margin, grid, -1, np.empty(0, np.int64), np.empty(0, np.int64))
        ranks, rows = np.empty(count, np.int64), np.empty(count, np.int64)
        _list_cells(ends, margin, grid, -1, ranks, rows)
        each = np.unique(rows * comm.size + ranks)
        router = Router(comm, each % comm.size, each // comm.size)
        segments = _Segments(*(router.send(array) for array in self.segments))
        return _Held(segments, router.send(self.margin), router.send(self.meeting))

    def cells(self, comm: MPI.Comm, grid: _Cells) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells of this rank that each bar passes: a key of the cell and the row of the bar."""
        ends, margin = self.segments.ends, self.margin
        room = 12 * len(margin)
        while True:
            keys, rows = np.empty(room, np.int64), np.empty(room, np.int64)
            count = _list_cells(ends, margin, grid, comm.rank, keys, rows)
            if count <= room:
                return keys[:count], rows[:count]
            room = count


@inlined
def _key(i, j, k):
    """Return a number of a cell from its numbers along the axes, which wrap around after 2^21 cells."""
    mask = (1 << 21) - 1
    return ((i & mask) << 42) | ((j & mask) << 21) | (k & mask)


@inlined
def _mixed(key):
    """Return a number from 0 to 2^31 - 1 that looks random."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(33))


@inlined
def _piece(ends, begin, end, margin, grid, span):
    """Write the first and last cells (2, 3) of the box around a part of a bar (2, 3) and a margin [m]."""
    for c in range(3):
        p = ends[0, c] + begin * (ends[1, c] - ends[0, c])
        q = ends[0, c] + end * (ends[1, c] - ends[0, c])
        span[0, c] = int(np.floor((min(p, q) - margin - grid.low[c]) / grid.cell))
        span[1, c] = int(np.floor((max(p, q) + margin - grid.low[c]) / grid.cell))


@kernel
def _list_cells(ends, margins, grid, rank, keys, rows):
    """List the cells around bars, as far as there is room: the cell and the row of the bar, for cells of ``rank``; with
    -1, the rank of the cell and the row. Returns the length of the list."""
    cell, size = grid.cell, grid.size
    span = np.empty((2, 3), np.int64)
    first, last = span[0], span[1]
    before = np.empty((2, 3), np.int64)
    count = 0
    for k in range(len(ends)):
        length = np.sqrt(((ends[k, 1] - ends[k, 0]) ** 2).sum())
        margin = margins[k] + 1e-9 * (length + cell)
        pieces = int(length / cell) + 1
        for piece in range(pieces):
            _piece(ends[k], piece / pieces, (piece + 1) / pieces, margin, grid, span)
            for i in range(first[0], last[0] + 1):
                for j in range(first[1], last[1] + 1):
                    for m in range(first[2], last[2] + 1):
                        # pieces follow a line, so that a cell of an earlier piece is also one of the last piece
                        if (
                            piece
                            and before[0, 0] <= i <= before[1, 0]
                            and before[0, 1] <= j <= before[1, 1]
                            and before[0, 2] <= m <= before[1, 2]
                        ):
                            continue
                        holder = 0
                        if size > 1:
                            holder = _mixed(_key(i // _BLOCK, j // _BLOCK, m // _BLOCK)) % size
                        if rank >= 0 and holder != rank:
                            continue
                        if count < len(keys):
                            keys[count] = holder if rank < 0 else _key(i, j, m)
                            rows[count] = k
                        count += 1
            before[:] = span
    return count


@kernel
def _buckets(keys, rows):
    """Sort a list into buckets of cells: returns the start of each bucket (buckets + 1,), and the sorted list."""
    size = 1
    while size < len(keys):
        size *= 2
    start = np.zeros(size + 1, np.int64)
    for key in keys:
        start[(_mixed(key) & (size - 1)) + 1] += 1
    for b in range(size):
        start[b + 1] += start[b]
    at = start[:size].copy()
    cells = np.empty_like(keys)
    bars = np.empty_like(rows)
    for n in range(len(keys)):
        b = _mixed(keys[n]) & (size - 1)
        cells[at[b]] = keys[n]
        bars[at[b]] = rows[n]
        at[b] += 1
    return start, cells, bars


@inlined
def _clip(value):
    return min(max(value, 0.0), 1.0)


@inlined
def _closest(ends, a, b):
    """Return the parameters from 0 to 1 of the closest points of the axes of bars ``a`` and ``b``.

    Source: Ericson, Real-time collision detection (2005), 5.1.9.
    """
    aa = 0.0
    bb = 0.0
    ab = 0.0
    ar = 0.0
    br = 0.0
    for c in range(3):
        u = ends[a, 1, c] - ends[a, 0, c]
        v = ends[b, 1, c] - ends[b, 0, c]
        w = ends[a, 0, c] - ends[b, 0, c]
        aa += u * u
        bb += v * v
        ab += u * v
        ar += u * w
        br += v * w
    if aa <= 0.0:
        return 0.0, _clip(br / bb) if bb > 0.0 else 0.0
    if bb <= 0.0:
        return _clip(-ar / aa), 0.0
    across = aa * bb - ab * ab
    s = _clip((ab * br - ar * bb) / across) if across > 1e-14 * aa * bb else 0.0
    t = (ab * s + br) / bb
    if t < 0.0:
        return _clip(-ar / aa), 0.0
    if t > 1.0:
        return _clip((ab - ar) / aa), 1.0
    return s, t


@kernel
def _compare(buckets, segments, meeting, grid, skin, out):
    """Write the numbers of bars (pairs, 2) that pass through each other, as far as there is room; return how many, and
    by how much a distance differs at least from the sum of radii, at most ``skin`` [m]."""
    start, keys, rows = buckets
    ids, nodes, ends, radius = segments
    low, cell = grid.low, grid.cell
    found = 0
    gap = skin
    place = np.empty(3, np.int64)
    for bucket in range(len(start) - 1):
        for p in range(start[bucket], start[bucket + 1]):
            for q in range(p + 1, start[bucket + 1]):
                if keys[p] != keys[q]:
                    continue
                # rounding must not depend on the order of the bars, which depends on the ranks
                a = rows[p] if ids[rows[p]] < ids[rows[q]] else rows[q]
                b = rows[q] if a == rows[p] else rows[p]
                if nodes[a, 0] == nodes[b, 0] or nodes[a, 1] == nodes[b, 1]:
                    continue
                if nodes[a, 0] == nodes[b, 1] or nodes[a, 1] == nodes[b, 0]:
                    continue
                if meeting[a] and meeting[b]:
                    continue
                reach = radius[a] + radius[b]
                apart = False
                for c in range(3):
                    apart |= min(ends[a, 0, c], ends[a, 1, c]) - max(ends[b, 0, c], ends[b, 1, c]) > reach + gap
                    apart |= min(ends[b, 0, c], ends[b, 1, c]) - max(ends[a, 0, c], ends[a, 1, c]) > reach + gap
                if apart:
                    continue
                s, t = _closest(ends, a, b)
                square = 0.0
                for c in range(3):
                    one = ends[a, 0, c] + s * (ends[a, 1, c] - ends[a, 0, c])
                    two = ends[b, 0, c] + t * (ends[b, 1, c] - ends[b, 0, c])
                    square += (two - one) * (two - one)
                    place[c] = int(np.floor((one + (two - one) * (radius[a] / reach) - low[c]) / cell))
                gap = min(gap, abs(np.sqrt(square) - reach))
                if square >= reach * reach or _key(place[0], place[1], place[2]) != keys[p]:
                    continue
                if found < len(out):
                    out[found, 0] = ids[a]
                    out[found, 1] = ids[b]
                found += 1
    return found, gap
