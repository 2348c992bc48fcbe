"""A grid of boxes behind the truss, whose trilinear functions are the coarse space of multigrid.

Displacements of nodes are interpolated from those of the corners of their boxes. The functions depend on the positions
of the mesh only and reproduce all fields that are linear in them, so rigid motions of the truss in any position that is
an affine map of the mesh are among them: the grid is made once and never changes. Bars are in the order of their
boxes, each counted on one rank; those whose ends need the corners of two boxes belong to the pair of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mechanics.compiled import inlined, kernel
from ..mesh.exchange import GhostExchange, Router
from .grid_planes import grid_coordinates, grid_planes

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["BackgroundGrid", "Elements", "corner_weights"]

_RECENT = 8192  # boxes that are remembered while bars are visited, a power of two
_TAG = 7500  # of the messages of corners, beside those of nodes


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


@inlined
def _box(low, shape):
    """Return the number of the box that starts at the planes ``low`` (3,)."""
    return (low[0] * shape[1] + low[1]) * shape[2] + low[2]


@kernel
def _node_boxes(t, shape, out):
    low = np.zeros(3, np.int64)
    for k in range(len(t)):
        for i in range(3):
            low[i] = max(min(int(t[k, i]), shape[i] - 2), 0)
        out[k] = _box(low, shape)


@kernel
def _bar_boxes(t, shape, bars, start, stop, out):
    """Write the box with all corners that have a weight at either end of each bar, -1 if there is none."""
    low = np.zeros(3, np.int64)
    for k in range(start, stop):
        fits = True
        for i in range(3):
            p, q = t[bars[k, 0], i], t[bars[k, 1], i]
            low[i] = max(min(int(min(p, q)), shape[i] - 2), 0)
            fits &= max(p, q) <= low[i] + 1.0
        out[k] = _box(low, shape) if fits else -1


@kernel
def _distinct(values, out):
    """Return the number of values >= 0 without those seen shortly before; write them unless ``out`` is empty."""
    seen = np.full(_RECENT, -1, np.int64)
    count = 0
    for value in values:
        if value >= 0 and seen[value % _RECENT] != value:
            seen[value % _RECENT] = value
            if len(out) > 0:
                out[count] = value
            count += 1
    return count


@kernel
def _find(sorted_values, values, out):
    """Write the places of values among sorted ones, -1 for negative values."""
    seen = np.full(_RECENT, -1, np.int64)
    places = np.zeros(_RECENT, np.int64)
    for k in range(len(values)):
        value = values[k]
        if value < 0:
            out[k] = -1
            continue
        at = value % _RECENT
        if seen[at] != value:
            seen[at] = value
            places[at] = np.searchsorted(sorted_values, value)
        out[k] = places[at]


@kernel
def _pair_keys(bars, own, boxes, n, out):
    """Write the key of the pair of boxes of each bar that has no own one, else -1."""
    for k in range(len(bars)):
        out[k] = -1
        if own[k] == -1:
            one, other = boxes[bars[k, 0]], boxes[bars[k, 1]]
            out[k] = min(one, other) * n + max(one, other)


@kernel
def _sort(numbers, starts, order):
    """Sort by counting: write the indices of numbers 0, 1, ..., without negative ones, and where each starts."""
    for number in numbers:
        if number >= 0:
            starts[number + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    for k in range(len(numbers)):
        if numbers[k] >= 0:
            order[starts[numbers[k]]] = k
            starts[numbers[k]] += 1
    for k in range(len(starts) - 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[0] = 0


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


class BackgroundGrid:
    """The grid of one model and the numbering of its corners. Construction is collective.

    Attributes
    ----------
    t : (local, 3) positions of nodes counted in planes
    base : (boxes, 3) int32, first planes of each box on this rank; corners : (boxes, 8) int32, their local numbers
    box : (owned,) int32, box of each node
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
        node_box = np.empty(mesh.n_local, np.int64)
        _node_boxes(self.t, shape, node_box)
        bar_box = np.full(len(mesh.bars), -2, np.int64)  # not counted here
        for block in mesh.blocks:
            _bar_boxes(self.t, shape, mesh.bars, block.start, block.counted, bar_box)
        boxes = np.unique(np.concatenate([_few(node_box), _few(bar_box)]))
        self._make_elements(mesh, boxes, node_box, bar_box)
        low = np.stack([boxes // (shape[1] * shape[2]), boxes // shape[2] % shape[1], boxes % shape[2]], axis=1)
        self.base = low.astype(np.int32)
        corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
        at = np.minimum(low[:, None, :] + corner, shape - 1)
        keys = (at[:, :, 0] * shape[1] + at[:, :, 1]) * shape[2] + at[:, :, 2]
        self._number(keys, int(np.prod(shape)))
        pairs = self.elements.boxes
        both = self.corners[pairs]
        both[pairs < 0] = -1
        self.elements = self.elements._replace(corners=both.reshape(len(pairs), 16))
        key = self._keys
        along = key // (shape[1] * shape[2]), key // shape[2] % shape[1], key % shape[2]
        self.positions = np.stack([planes[i][along[i]] for i in range(3)], axis=1)

    def _make_elements(
        self, mesh: DistributedMesh, boxes: np.ndarray, node_box: np.ndarray, bar_box: np.ndarray
    ) -> None:
        place = np.empty(len(node_box), np.int32)
        _find(boxes, node_box, place)
        self.box = place[: mesh.n_owned].copy()
        n = max(len(boxes), 1)
        keys = np.empty(len(bar_box), np.int64)
        _pair_keys(mesh.bars, bar_box, place, n, keys)
        pairs = np.unique(_few(keys))
        element = np.empty(len(bar_box), np.int32)
        _find(boxes, bar_box, element)
        second = np.empty(len(bar_box), np.int32)
        _find(pairs, keys, second)
        crossing = second >= 0
        element[crossing] = len(boxes) + second[crossing]
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


def _few(values: np.ndarray) -> np.ndarray:
    """Return the distinct values >= 0, some of them several times."""
    out = np.empty(_distinct(values, np.empty(0, np.int64)), np.int64)
    if len(out):
        _distinct(values, out)
    return np.unique(out)


def _sorted(numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    starts = np.zeros(count + 1, np.int64)
    order = np.empty(int(np.count_nonzero(numbers >= 0)), np.int32)
    _sort(numbers, starts, order)
    return order, starts

