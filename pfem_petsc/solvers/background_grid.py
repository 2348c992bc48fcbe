"""A grid of boxes behind the truss, whose trilinear functions are the coarse space of multigrid.

Displacements of nodes are interpolated from those of the corners of their boxes. The functions depend on the positions
of the mesh only and reproduce all fields that are linear in them, so rigid motions of the truss in any position that is
an affine map of the mesh are among them: the grid is made once and never changes. Bars are in the order of their
boxes, each counted on one rank; those whose ends need the corners of two boxes belong to the pair of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mesh.exchange import GhostExchange, Router
from .grid_kernels import bar_boxes, distinct, find, node_boxes, pair_keys, sort_by_count
from .grid_planes import grid_coordinates, grid_planes

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["BackgroundGrid", "Elements"]

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
        node_boxes(self.t, shape, node_box)
        bar_box = np.full(len(mesh.bars), -2, np.int64)  # not counted here
        for block in mesh.blocks:
            bar_boxes(self.t, shape, mesh.bars, block.start, block.counted, bar_box)
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
        find(boxes, node_box, place)
        self.box = place[: mesh.n_owned].copy()
        n = max(len(boxes), 1)
        keys = np.empty(len(bar_box), np.int64)
        pair_keys(mesh.bars, bar_box, place, n, keys)
        pairs = np.unique(_few(keys))
        element = np.empty(len(bar_box), np.int32)
        find(boxes, bar_box, element)
        second = np.empty(len(bar_box), np.int32)
        find(pairs, keys, second)
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
    out = np.empty(distinct(values, np.empty(0, np.int64)), np.int64)
    if len(out):
        distinct(values, out)
    return np.unique(out)


def _sorted(numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    starts = np.zeros(count + 1, np.int64)
    order = np.empty(int(np.count_nonzero(numbers >= 0)), np.int32)
    sort_by_count(numbers, starts, order)
    return order, starts
