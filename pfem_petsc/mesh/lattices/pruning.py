"""Lattices of which nodes and bars are left out: the rest is renumbered in the same order."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from ...parallel.agreement import agreed
from ..exchange import Router
from ..slab import MeshSlab, index_type, slab_of, slab_range
from .block import Block
from .numbering import Places
from .region import Region

__all__ = ["Kept", "end_points", "renumbered", "without_dangling"]


@dataclass
class Kept:
    """This rank's bars that are left of its range of a block, in the order of their numbers, and new nodes on them."""

    bars: np.ndarray
    """(b,) int64: numbers in the block; twice where a bar was divided."""
    ends: np.ndarray
    """(b, 2) int64: numbers of nodes in the block, or -1 - m for the new node m of this rank."""
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    """(m, 3) [m]: new nodes, in the order of their bars."""
    cut: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    """Nodes of the block, as often as they have lost a bar to the surface."""

    def chosen(self, mask: np.ndarray) -> Kept:
        """Return the chosen bars, without new nodes that have none."""
        ends = self.ends[mask]
        new = -1 - ends[ends < 0]
        used = np.zeros(len(self.points), bool)
        used[new] = True
        ends[ends < 0] = -1 - (np.cumsum(used) - 1)[new]
        return Kept(self.bars[mask], ends, self.points[used], self.cut)


def bars_of_nodes(kept: Kept, region: Region) -> np.ndarray:
    """Return the number of bars (nodes of the slab,) of each node of the block. Collective."""
    old = kept.ends[kept.ends >= 0] - region.first
    return region.add(np.bincount(old, minlength=region.last - region.first))


def without_dangling(kept: Kept, region: Region, comm: MPI.Comm) -> Kept:
    """Leave out bars that end at a node with no other, until there are none; new nodes count as held. Collective."""
    while True:
        loose = region.fetch(bars_of_nodes(kept, region) == 1)
        old = kept.ends >= 0
        dangling = np.zeros(old.shape, bool)
        dangling[old] = loose[kept.ends[old] - region.first]
        dangling = dangling.any(axis=1)
        if not comm.allreduce(bool(dangling.any()), op=MPI.LOR):
            return kept
        kept = kept.chosen(~dangling)


def renumbered(
    block: Block,
    kept: Kept,
    region: Region,
    comm: MPI.Comm,
    node_groups: Callable[[Places], Mapping[str, np.ndarray]],
    bar_groups: Callable[[Places], Mapping[str, np.ndarray]] | None,
    fields: Callable[[np.ndarray], Mapping[str, np.ndarray]] | None,
    surface: bool,
) -> MeshSlab:
    """Return this rank's part of what is left. Collective.

    Nodes of the block come first, in its order, then new ones in the order of their bars; bars keep their order.

    Parameters
    ----------
    node_groups, bar_groups : memberships (n,) by name, of nodes and bars at places of the block; None: without
    fields : values (n,) by name, at the middles (n, 3) of bars; None: without
    surface : whether there is a node group ``surface``: new nodes, and nodes that have lost a bar
    """
    first, last = slab_range(block.nodes.total, comm.rank, comm.size)
    used = bars_of_nodes(kept, region) > 0
    before, total = _counted(comm, int(used.sum()))
    number = np.where(used, before + np.cumsum(used) - 1, -1)
    new_before, new_total = _counted(comm, len(kept.points))
    n_nodes = total + new_total

    old = first + np.flatnonzero(used)
    places = block.nodes.decode(old)
    masks = dict(node_groups(places))
    if surface:
        lost = region.add(np.bincount(kept.cut - region.first, minlength=region.last - region.first)) > 0
        masks["surface"] = lost[used]
    points = np.concatenate([block.positions(old, places), kept.points])
    numbers = np.concatenate([number[used], total + new_before + np.arange(len(kept.points))])
    nodes = _Moved(comm, numbers, n_nodes)
    new = np.full(len(kept.points), False)
    groups = {
        name: nodes.members(np.concatenate([mask, ~new if name == "surface" else new])) for name, mask in masks.items()
    }

    in_region = region.fetch(number)
    is_new = kept.ends < 0
    ends = np.empty_like(kept.ends)
    ends[is_new] = total + new_before - 1 - kept.ends[is_new]
    ends[~is_new] = in_region[kept.ends[~is_new] - region.first]
    bars_before, n_bars = _counted(comm, len(kept.bars))
    bars = _Moved(comm, bars_before + np.arange(len(kept.bars)), n_bars)
    found = {}
    if bar_groups is not None:
        found = {name: bars.members(mask) for name, mask in bar_groups(block.bars.decode(kept.bars)).items()}
    values: Mapping[str, np.ndarray] = {}
    if fields is not None:
        with agreed(comm):
            values = fields(0.5 * sum(end_points(block, kept, block.bars.decode(kept.bars))))
    return MeshSlab(
        n_nodes=n_nodes,
        n_bars=n_bars,
        first_node=nodes.first,
        points=nodes.rows(points),
        first_bar=bars.first,
        bars=bars.rows(ends.astype(index_type(n_nodes))),
        node_groups=groups,
        bar_groups=found,
        bar_fields={name: bars.rows(each) for name, each in values.items()},
        structured=True,
    )


def end_points(block: Block, kept: Kept, at: Places) -> list[np.ndarray]:
    """Return the positions (b, 3) [m] of the first and the second ends of bars, which are at places of the block."""
    found = []
    for which in (0, 1):
        numbers, places = block.end(at, which)
        points = block.positions(numbers, places)
        is_new = kept.ends[:, which] < 0
        points[is_new] = kept.points[-1 - kept.ends[is_new, which]]
        found.append(points)
    return found


def _counted(comm: MPI.Comm, count: int) -> tuple[int, int]:
    """Return the sum of the counts of lower ranks, and of all. Collective."""
    return comm.scan(count) - count, comm.allreduce(count)


class _Moved:
    """Rows that are sent to the slabs of their new numbers. Collective."""

    def __init__(self, comm: MPI.Comm, numbers: np.ndarray, n: int) -> None:
        self.first, self._last = slab_range(n, comm.rank, comm.size)
        self._router = Router(comm, slab_of(numbers, n, comm.size))
        self._at = self._router.send(numbers) - self.first

    def rows(self, rows: np.ndarray) -> np.ndarray:
        """Return the rows of this rank's slab in the order of their numbers. Collective."""
        arrived = self._router.send(rows)
        found = np.empty_like(arrived)
        found[self._at] = arrived
        return found

    def members(self, mask: np.ndarray) -> np.ndarray:
        """Return the numbers of the rows of this rank's slab that are marked, ascending. Collective."""
        return self.first + np.flatnonzero(self.rows(mask))
