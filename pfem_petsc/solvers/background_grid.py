"""A grid of boxes behind the truss, whose trilinear functions are the coarse space of multigrid."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import GhostExchange, Router

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh


@inlined
def corner_weights(t, node, base, box, weights, first):
    """Write the eight weights of a node in a box to ``weights`` from ``first``; z varies fastest."""
    fx = t[node, 0] - base[box, 0]
    fy = t[node, 1] - base[box, 1]
    fz = t[node, 2] - base[box, 2]
    for i in range(8):
        w = fx if i & 4 else 1.0 - fx
        w *= fy if i & 2 else 1.0 - fy
        w *= fz if i & 1 else 1.0 - fz
        weights[first + i] = w


def _first_planes(t: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the planes (n, 3) at which the boxes of positions (n, 3) counted in planes start."""
    return np.maximum(np.minimum(t.astype(np.int64), shape - 2), 0)


def _numbers(low: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return the numbers of the boxes or corners at planes ``low`` (..., 3)."""
    return (low[..., 0] * shape[1] + low[..., 1]) * shape[2] + low[..., 2]


# Spacing of the planes over the mean length of the bars. Lattices of 10^5 bars, iterations to 1e-6 and time: 2 is best
# of 1.5, 2, 2.5, 3.
_SPACING = 2.0
_FINEST = 4  # nodes for a box of a filled block: more boxes would make the coarse problem as large as the fine one
_CLOSE = 1e-6  # distance of coordinates that are one layer, and of nodes that are on a plane, over the spacing
_LAYERS = 8  # most layers between two planes
_PIECE = 1 << 16  # bars at a time, so that temporary arrays stay small
# A block has this extent in mean lengths of bars, and this many nodes in a cube of this length; lattices have 1.3 to 2.
_THICK = 4.0
_FILLED = 0.5


def grid_planes(mesh: DistributedMesh) -> list[np.ndarray]:
    """Return the coordinates [m] of the planes along x, y and z, ascending. Collective."""
    low, high = mesh.extremes()
    spacing = max(_SPACING * _mean_length(mesh), _least(high - low, mesh.n_nodes))
    points = mesh.points[: mesh.n_owned]
    return [_planes(mesh.comm, points[:, axis], low[axis], high[axis], spacing) for axis in range(3)]


def fills_block(mesh: DistributedMesh) -> bool:
    """Whether a truss is several bars thick in all directions and has nodes everywhere between its extremes, so that
    the functions of the grid describe its soft motions. Slender and hollow trusses bend within a box. Collective."""
    low, high = mesh.extremes()
    length = _mean_length(mesh)
    extents = high - low
    return bool(extents.min() >= _THICK * length and mesh.n_nodes * length**3 >= _FILLED * np.prod(extents))


def _mean_length(mesh: DistributedMesh) -> float:
    """Return the mean length of the bars [m], rounded, because the sum depends on the number of ranks. Collective."""
    counted = mesh.bars[mesh.counted]
    total = 0.0
    for first in range(0, len(counted), _PIECE):
        some = counted[first : first + _PIECE]
        total += float(np.linalg.norm(mesh.points[some[:, 1]] - mesh.points[some[:, 0]], axis=1).sum())
    return float(f"{mesh.comm.allreduce(total) / mesh.n_bars:.3g}")


def _least(extents: np.ndarray, n_nodes: int) -> float:
    """Return the spacing [m] with which the boxes that fill the extents are fewer than the nodes."""
    filled = extents[extents > 0.0]
    if not len(filled):
        return 0.0
    # a truss that fills little of its extents has fewer boxes than these
    return 0.5 * float((np.prod(filled) / (n_nodes / _FINEST)) ** (1.0 / len(filled)))


def _planes(comm: MPI.Comm, x: np.ndarray, low: float, high: float, spacing: float) -> np.ndarray:
    if not high - low > _CLOSE * spacing:
        return np.array([low])
    count = max(int(round((high - low) / spacing)), 1)
    even = np.linspace(low, high, count + 1)
    layers = _layers(comm, x, low, spacing, _LAYERS * count + 1)
    if layers is None:
        return even
    # the planes nearest to equidistant ones among the layers: bars of a lattice end on them and do not cross them
    at = np.round(np.linspace(0, len(layers) - 1, min(count, len(layers) - 1) + 1)).astype(int)
    return layers[at]


def _layers(comm: MPI.Comm, x: np.ndarray, low: float, spacing: float, most: int) -> np.ndarray | None:
    """Return the coordinates that nodes have, None if they are more than ``most``. Collective."""
    close = _CLOSE * spacing
    mine = _merged(np.unique(x), close)
    if comm.allreduce(len(mine), op=MPI.MAX) > most:
        return None
    layers = _merged(np.sort(np.concatenate(comm.allgather(mine))), close)
    return layers if len(layers) <= most else None


def _merged(ascending: np.ndarray, close: float) -> np.ndarray:
    """Return the first one of values that are close."""
    return ascending[np.diff(ascending, prepend=-np.inf) > close]


def grid_coordinates(points: np.ndarray, planes: list[np.ndarray]) -> np.ndarray:
    """Return positions (n, 3) counted in planes: the number of the plane before a point, and the part of the way to the
    next; whole numbers on planes."""
    t = np.zeros_like(points)
    for axis, at in enumerate(planes):
        if len(at) > 1:
            box = np.clip(np.searchsorted(at, points[:, axis], side="right") - 1, 0, len(at) - 2)
            part = (points[:, axis] - at[box]) / (at[box + 1] - at[box])
            whole = np.round(part)
            t[:, axis] = box + np.where(np.abs(part - whole) < 10.0 * _CLOSE, whole, np.clip(part, 0.0, 1.0))
    return t


_TAG = 7500  # of the messages of corners, beside those of nodes


class Elements(NamedTuple):
    """What adds to the coarse matrix: boxes, then pairs of boxes of bars that leave theirs.

    Attributes
    ----------
    boxes : (m, 2) int32, one box or two; -1 for none
    corners : (m, 16) int32, local corners of both; -1 for none
    bars : indices of bars in the order of the elements; bar_starts : (m + 1,)
    nodes : owned nodes in the order of the boxes; node_starts : (m + 1,)
    """

    boxes: np.ndarray
    corners: np.ndarray
    bars: np.ndarray
    bar_starts: np.ndarray
    nodes: np.ndarray
    node_starts: np.ndarray


class Summands(NamedTuple):
    """What the coarse matrix is summed of: bars with ends ``ends`` (b, 2) at positions ``x`` (local, 3) and with the
    numbers ``stored`` (2, b) of a product; inertia ``nodal`` (owned,); and ``place`` (local,) of nodes among those with
    matrices ``turned`` (k, 3, 3) and further stiffness ``extra`` (k, 3, 3), -1 for others."""

    ends: np.ndarray
    x: np.ndarray
    stored: np.ndarray
    nodal: np.ndarray
    place: np.ndarray
    turned: np.ndarray
    extra: np.ndarray


class BackgroundGrid:
    """The grid of one model and the numbering of its corners. Construction is collective.

    Attributes
    ----------
    t : (local, 3) positions of nodes counted in planes
    base : (boxes, 3) int32, first planes of each box on this rank; corners : (boxes, 8) int32, their local numbers
    box : (owned,) int32, box of each node
    prolongation : (owned, local corners) sparse matrix of the weights of corners
    elements : Elements
    numbers : (local corners,) int64, numbers of the corners, first the ``n_owned`` owned ones, then those of other
        ranks, ascending; first, total : first number owned, and how many there are
    positions : (local corners, 3) in the mesh [m]
    """

    def __init__(self, mesh: DistributedMesh) -> None:
        self.comm = mesh.comm
        planes = grid_planes(mesh)
        self.t = grid_coordinates(mesh.points, planes)
        shape = np.array([len(each) for each in planes], dtype=np.int64)
        node_box = _numbers(_first_planes(self.t, shape), shape)
        bar_box = np.full(len(mesh.bars), -2, np.int64)  # not counted here
        for block in mesh.blocks:
            ends = self.t[mesh.bars[block.start : block.counted]]
            low = _first_planes(ends.min(axis=1), shape)
            fits = (ends.max(axis=1) <= low + 1.0).all(axis=1)
            bar_box[block.start : block.counted] = np.where(fits, _numbers(low, shape), -1)  # -1: in no box
        boxes = np.unique(np.concatenate([np.unique(node_box), np.unique(bar_box[bar_box >= 0])]))
        self._make_elements(mesh, boxes, node_box, bar_box)
        low = np.stack([boxes // (shape[1] * shape[2]), boxes // shape[2] % shape[1], boxes % shape[2]], axis=1)
        self.base = low.astype(np.int32)
        corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
        at = np.minimum(low[:, None, :] + corner, shape - 1)
        self._number(_numbers(at, shape), int(np.prod(shape)))
        self.prolongation = self._prolong(corner)
        pairs = self.elements.boxes
        both = self.corners[pairs]
        both[pairs < 0] = -1
        self.elements = self.elements._replace(corners=both.reshape(len(pairs), 16))
        key = self._keys
        along = key // (shape[1] * shape[2]), key // shape[2] % shape[1], key % shape[2]
        self.positions = np.stack([planes[i][along[i]] for i in range(3)], axis=1)

    def _prolong(self, corner: np.ndarray) -> csr_array:
        """Return the sparse matrix (owned, local corners) from values of corners to those of nodes."""
        owned = len(self.box)
        parts = (self.t[:owned] - self.base[self.box])[:, None]
        weights = np.where(corner, parts, 1.0 - parts).prod(axis=2)
        starts = np.arange(0, weights.size + 1, len(corner))
        entries = weights.ravel(), self.corners[self.box].ravel(), starts
        return csr_array(entries, shape=(owned, len(self.numbers)))

    def _make_elements(
        self, mesh: DistributedMesh, boxes: np.ndarray, node_box: np.ndarray, bar_box: np.ndarray
    ) -> None:
        place = np.searchsorted(boxes, node_box).astype(np.int32)
        self.box = place[: mesh.n_owned].copy()
        n = max(len(boxes), 1)
        element = np.where(bar_box >= 0, np.searchsorted(boxes, bar_box), -1).astype(np.int32)
        crossing = np.flatnonzero(bar_box == -1)
        ends = np.sort(place[mesh.bars[crossing]], axis=1).astype(np.int64)
        pairs, second = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True)
        element[crossing] = len(boxes) + second
        both = np.full((len(boxes) + len(pairs), 2), -1, np.int32)
        both[: len(boxes), 0] = np.arange(len(boxes))
        both[len(boxes) :, 0], both[len(boxes) :, 1] = pairs // n, pairs % n
        bars, bar_starts = _sorted(element, len(both))
        nodes, node_starts = _sorted(self.box, len(both))
        self.elements = Elements(both, np.empty((0, 16), np.int32), bars, bar_starts, nodes, node_starts)

    def _number(self, keys: np.ndarray, most: int) -> None:
        """Number the corners: the lowest rank that has one owns it. Collective."""
        comm = self.comm
        mine = np.unique(keys)
        # a directory of corners: each rank knows the owners of a range of keys
        router = Router(comm, np.minimum((mine / most * comm.size).astype(np.int64), comm.size - 1))
        asked = router.send(mine)
        senders = np.repeat(np.arange(comm.size), router._arriving)
        _, first, inverse = np.unique(asked, return_index=True, return_inverse=True)
        owner = router.reply(senders[first][inverse])
        own = owner == comm.rank
        self.n_owned = int(np.count_nonzero(own))
        starts = np.concatenate([[0], np.cumsum(comm.allgather(self.n_owned))]).astype(np.int64)
        self.first, self.total = int(starts[comm.rank]), int(starts[-1])
        number = np.full(len(mine), -1, np.int64)
        number[own] = self.first + np.arange(self.n_owned)
        known = np.full(len(first), -1, np.int64)
        np.maximum.at(known, inverse, router.send(number))
        number = router.reply(known[inverse])
        order = np.concatenate([np.flatnonzero(own), np.flatnonzero(~own)[np.argsort(number[~own], kind="stable")]])
        place = np.empty(len(mine), np.int32)
        place[order] = np.arange(len(mine))
        self.numbers, self._keys = number[order], mine[order]
        self.owners = owner[order]
        self.corners = place[np.searchsorted(mine, keys)].astype(np.int32)
        self._share(starts)

    def _share(self, starts: np.ndarray) -> None:
        """Prepare the exchange of values of corners, in both directions. Collective."""
        comm, ghosts = self.comm, self.numbers[self.n_owned :]
        self._bring = GhostExchange(comm, starts, ghosts, _TAG)
        # the other direction: slots of ghosts have numbers of their own, which their owners know
        slots = np.concatenate([[0], np.cumsum(comm.allgather(len(ghosts)))]).astype(np.int64)
        router = Router(comm, self.owners[self.n_owned :])
        mine = slots[comm.rank] + np.arange(len(ghosts), dtype=np.int64)
        self._targets = router.send(ghosts) - self.first
        self._give = GhostExchange(comm, slots, router.send(mine), _TAG + 100)

    def bring(self, values: np.ndarray) -> None:
        """Fill the rows of other ranks' corners in values (local corners, 3). Collective."""
        self._bring.update(values)

    def give(self, values: np.ndarray) -> None:
        """Add the rows of other ranks' corners to those of their owners, in the order of ranks. Collective."""
        arrived = self._give.bring(values[self.n_owned :][self._give.rows])
        np.add.at(values, self._targets, arrived)

    def destroy(self) -> None:
        """Free the requests of messages."""
        self._bring.close()
        self._give.close()


def _sorted(numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of numbers 0, 1, ... ``count`` - 1 in their order, without negative ones, and where each
    number starts."""
    order = np.argsort(numbers, kind="stable")[np.count_nonzero(numbers < 0) :].astype(np.int32)
    return order, np.searchsorted(numbers[order], np.arange(count + 1))


@inlined
def _add_square(v, factor, n, dense):
    """Add factor v v^T."""
    for i in range(n):
        scaled = factor * v[i]
        if scaled != 0.0:
            for j in range(n):
                dense[i, j] += scaled * v[j]


@inlined
def _flush(corners, element, m, dense, ptr, columns, blocks):
    """Add the dense matrix of an element to the blocks, and clear it."""
    for i in range(m):
        row = corners[element, i]
        low, high = ptr[row], ptr[row + 1]
        for j in range(m):
            at = low + np.searchsorted(columns[low:high], corners[element, j])
            for p in range(3):
                for q in range(3):
                    blocks[at, p, q] += dense[3 * i + p, 3 * j + q]
                    dense[3 * i + p, 3 * j + q] = 0.0


@inlined
def _turned_difference(difference, ends, direction, place, turned, w, v):
    """Write to ``v`` (3 m,) how a component of the end difference of a bar depends on the corners."""
    v[:] = 0.0
    for end in range(2):
        at = place[ends[end]]
        for q in range(3):
            part = 0.0
            for p in range(3):
                along = difference[p] if direction == 3 else (1.0 if p == direction else 0.0)
                part += along * (turned[at, p, q] if at >= 0 else (1.0 if p == q else 0.0))
            if end == 0:
                part = -part
            for i in range(len(v) // 3):
                v[3 * i + q] += part * w[end, i]


@inlined
def _add_turned_node(extra, nodal, turn, w, dense):
    """Add the inertia and further stiffness of a node with a matrix."""
    inner = np.zeros((3, 3))
    for p in range(3):
        for q in range(3):
            for i in range(3):
                for j in range(3):
                    inner[p, q] += turn[i, p] * (extra[i, j] + (nodal if i == j else 0.0)) * turn[j, q]
    for i in range(8):
        for j in range(8):
            for p in range(3):
                for q in range(3):
                    dense[3 * i + p, 3 * j + q] += w[i] * w[j] * inner[p, q]


@kernel
def assemble(t, base, elements, parts, pattern, blocks):
    """Add the Summands ``parts`` of all Elements to ``blocks``; ``pattern``: pointers and columns of these."""
    boxes, corners, bar_order, bar_starts = elements.boxes, elements.corners, elements.bars, elements.bar_starts
    ends, x, stored, place, turned = parts.ends, parts.x, parts.stored, parts.place, parts.turned
    dense = np.zeros((48, 48))
    same = np.zeros((16, 16))
    d = np.zeros(16)
    w = np.zeros((2, 16))
    v = np.zeros(48)
    difference = np.zeros(3)
    for element in range(len(boxes)):
        m = 8 if boxes[element, 1] < 0 else 16
        for k in range(bar_starts[element], bar_starts[element + 1]):
            bar = bar_order[k]
            c, g = stored[0, bar], stored[1, bar]
            if c == 0.0 and g == 0.0:
                continue
            a, b = ends[bar, 0], ends[bar, 1]
            w[:] = 0.0
            if m == 8:
                corner_weights(t, a, base, boxes[element, 0], w[0], 0)
                corner_weights(t, b, base, boxes[element, 0], w[1], 0)
            else:
                first = 0 if _is_inside(t, a, base, boxes[element, 0]) else 1
                if first == 0 and not _is_inside(t, b, base, boxes[element, 1]):
                    first = 1
                corner_weights(t, a, base, boxes[element, first], w[0], 8 * first)
                corner_weights(t, b, base, boxes[element, 1 - first], w[1], 8 - 8 * first)
            difference[0] = x[b, 0] - x[a, 0]
            difference[1] = x[b, 1] - x[a, 1]
            difference[2] = x[b, 2] - x[a, 2]
            if place[a] < 0 and place[b] < 0:
                for i in range(m):
                    d[i] = w[1, i] - w[0, i]
                    v[3 * i] = d[i] * difference[0]
                    v[3 * i + 1] = d[i] * difference[1]
                    v[3 * i + 2] = d[i] * difference[2]
                _add_square(v, c, 3 * m, dense)
                if g != 0.0:
                    _add_square(d, g, m, same)
                continue
            # in the three directions of space with g, and along the bar with c
            for direction in range(4):
                _turned_difference(difference, (a, b), direction, place, turned, w, v[: 3 * m])
                _add_square(v, c if direction == 3 else g, 3 * m, dense)
        for k in range(elements.node_starts[element], elements.node_starts[element + 1]):
            node = elements.nodes[k]
            w[:] = 0.0
            corner_weights(t, node, base, boxes[element, 0], w[0], 0)
            if place[node] < 0:
                _add_square(w[0], parts.nodal[node], m, same)
                continue
            _add_turned_node(parts.extra[place[node]], parts.nodal[node], turned[place[node]], w[0], dense)
        for i in range(m):
            for j in range(m):
                for p in range(3):
                    dense[3 * i + p, 3 * j + p] += same[i, j]
                same[i, j] = 0.0
        _flush(corners, element, m, dense, *pattern, blocks)


@inlined
def _is_inside(t, node, base, box):
    for i in range(3):
        part = t[node, i] - base[box, i]
        if part < 0.0 or part > 1.0:
            return False
    return True
