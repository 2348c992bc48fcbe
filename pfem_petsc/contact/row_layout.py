"""The rows over several nodes on a rank: their nodes, owners, and groups of rows that share nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..mesh.exchange import GhostExchange, Router
from ..parallel.natural import NaturalOrder
from .constraints.base import Constraint
from .row_loops import group_rows
from .row_search import owner_starts, petsc_numbers, to_owners, with_groups

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["Alike", "RowLayout"]

_TAG = 7700  # of messages between ranks with nodes of the same rows, distinct from those of ghosts and pairs


@dataclass(frozen=True)
class Alike:
    """Groups with equal numbers of rows and nodes: rows (g, p), nodes (g, q), and indices (g, p, k) of the rows' nodes
    among these, -1 for none."""

    rows: np.ndarray
    nodes: np.ndarray
    ends: np.ndarray

    def dense(self, gradients: np.ndarray) -> np.ndarray:
        """Return gradients (g, p, 3 q) from those of rows (g, p, k, 3)."""
        dense = np.zeros((*self.rows.shape, self.nodes.shape[1], 3))
        group, row, end = np.nonzero(self.ends >= 0)
        dense[group, row, self.ends[group, row, end]] = gradients[group, row, end]
        return dense.reshape(*self.rows.shape, -1)


class RowLayout:
    """The rows of all sources on this rank: those of its nodes, and those of their groups. Construction is collective.

    Attributes
    ----------
    sources : of the rows here
    source, ids : (r,) index of the source of each row, and the row's number there
    ends : (r, k) indices of its nodes, padded with -1; last : (r,) position of the last node
    numbers : (n,) mesh numbers of the nodes, ascending
    where : (n,) local index of an owned node, else -1 minus its row among those of other ranks
    mine, here : (n,) bool, nodes that this rank owns, and their local indices (m,)
    partners : GhostExchange for values at nodes that other ranks own
    counted : (r,) bool, rows whose last node this rank owns; order : their numbering over all ranks
    last_owners : (r,) rank that owns the last node of each row
    free : (n, 3) 1.0 where a component may move, 0.0 where a support prescribes it
    starts, members, node_starts, nodes : rows and nodes of each group: members[starts[g] : starts[g + 1]]
    """

    def __init__(self, sources: Sequence[Constraint], mesh: DistributedMesh, fixed: np.ndarray) -> None:
        self.mesh = mesh
        self._find(sources)
        self.mine = self.where >= 0
        self.here = self.where[self.mine]
        self._away = np.flatnonzero(~self.mine)
        self._far = -1 - self.where[self._away]
        self.free = self.gather(np.where(fixed, 0.0, 1.0))
        self._gather_groups()
        self.counted = self.mine[self.ends[np.arange(len(self.ends)), self.last]]
        counts = mesh.comm.allreduce(np.bincount(self.source[self.counted], minlength=len(self.sources)))
        numbers = (np.cumsum(counts) - counts)[self.source] + self.ids
        self.order = NaturalOrder(mesh.comm, numbers[self.counted], int(counts.sum()))

    def _find(self, sources: Sequence[Constraint]) -> None:
        """Send the rows of all sources to the ranks of their nodes."""
        mesh, comm = self.mesh, self.mesh.comm
        shapes = np.array([[*source.nodes.shape, source.data.shape[1]] for source in sources])
        before, largest = np.zeros_like(shapes), shapes.copy()
        comm.Exscan(shapes, before)
        comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        self._widths, self._data = largest[:, 1:].T
        k, m = int(self._widths.max()), int(self._data.max())
        every = np.concatenate([source.nodes.ravel() for source in sources]).astype(np.int64)
        at = petsc_numbers(mesh, every)
        tables, first = [], 0
        for s, source in enumerate(sources):
            n, width = len(source.nodes), int(self._widths[s])
            table = np.full((n, 2 + 2 * k + m), -1, dtype=np.int64)
            table[:, 0], table[:, 1] = s, (before[s, 0] if comm.rank else 0) + np.arange(n)
            table[:, 2 : 2 + width] = at[first : first + n * width].reshape(n, width)
            table[:, 2 + k : 2 + k + width] = source.nodes.reshape(n, width)
            table[:, 2 + 2 * k : 2 + 2 * k + source.data.shape[1]] = source.data.view(np.int64)
            tables.append(table)
            first += n * width
        starts, columns = owner_starts(mesh), range(2, 2 + k)
        rows = with_groups(to_owners(np.concatenate(tables), columns, starts, comm), columns, starts, comm)
        self.source, self.ids = rows[:, 0].copy(), rows[:, 1].copy()
        self.last = self._widths[self.source] - 1
        at, number = rows[:, 2 : 2 + k], rows[:, 2 + k : 2 + 2 * k]
        some = at >= 0
        self.numbers, which, place = np.unique(number[some], return_index=True, return_inverse=True)
        self.ends = np.full(at.shape, -1)
        self.ends[some] = place.ravel()
        own = at[some][which]
        mine = (own >= starts[comm.rank]) & (own < starts[comm.rank + 1])
        ghosts = np.unique(own[~mine])
        self.where = np.where(mine, own - starts[comm.rank], -1 - np.searchsorted(ghosts, own))
        self.partners = GhostExchange(comm, starts, ghosts, _TAG)
        end = at[np.arange(len(at)), self.last]
        self.last_owners = np.searchsorted(starts, end, side="right") - 1
        self._first = np.searchsorted(self.source, np.arange(len(sources) + 1))
        self.sources, self._at = [], []
        for s, source in enumerate(sources):
            part, width = slice(self._first[s], self._first[s + 1]), int(self._widths[s])
            data = np.ascontiguousarray(rows[part, 2 + 2 * k : 2 + 2 * k + int(self._data[s])]).view(np.float64)
            self.sources.append(source.of(number[part, :width].copy(), data))
            self._at.append(np.ascontiguousarray(self.ends[part, :width]))

    def _gather_groups(self) -> None:
        label = np.empty(len(self.numbers), dtype=np.int64)
        group_rows(self.ends, len(label), label)
        labels, self.group_of_node = np.unique(label, return_inverse=True)
        self.group_of_row = self.group_of_node[self.ends[:, 0]]
        self.nodes = np.argsort(self.group_of_node, kind="stable")
        self.members = np.argsort(self.group_of_row, kind="stable")
        every = np.arange(len(labels) + 1)
        self.node_starts = np.searchsorted(self.group_of_node[self.nodes], every)
        self.starts = np.searchsorted(self.group_of_row[self.members], every)

    @cached_property
    def alike(self) -> list[Alike]:
        """Return all groups, collected by shape."""
        shapes, found = np.stack([np.diff(self.starts), np.diff(self.node_starts)]), []
        place = np.empty(len(self.numbers), dtype=np.int64)
        place[self.nodes] = np.arange(len(self.nodes)) - self.node_starts[self.group_of_node[self.nodes]]
        for p, q in np.unique(shapes, axis=1).T:
            groups = np.flatnonzero((shapes[0] == p) & (shapes[1] == q))
            rows = self.members[self.starts[groups][:, None] + np.arange(p)]
            nodes = self.nodes[self.node_starts[groups][:, None] + np.arange(q)]
            found.append(Alike(rows, nodes, np.where(self.ends[rows] < 0, -1, place[self.ends[rows]])))
        return found

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, ...) at the nodes from those at owned nodes (owned, ...). Collective."""
        values = np.asarray(values, dtype=float)
        width = int(np.prod(values.shape[1:]))
        far = self.partners.bring(values[self.partners.rows].reshape(-1, width)) if width else np.empty((0, 0))
        return self.spread(values, far.reshape(len(far), *values.shape[1:]))

    def spread(self, values: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Return values (n, ...) at the nodes from those at owned nodes (owned, ...) and those received (m, ...)."""
        if len(self._away) == 0:
            return values.take(self.where, axis=0)
        every = np.empty((len(self.numbers), *values.shape[1:]))
        every[self.mine] = values[self.here]
        if every.size:
            every[self._away] = far[self._far]
        return every

    def of_counted(self, values: np.ndarray) -> np.ndarray:
        """Return values (r, ...) of this rank's rows from those of counted rows (c, ...). Collective."""
        comm, shape = self.mesh.comm, values.shape[1:]
        owners = self.last_owners
        asking = Router(comm, owners)
        asked = asking.send(self.source * (1 << 40) + self.ids)
        own = self.source[self.counted] * (1 << 40) + self.ids[self.counted]
        return asking.reply(values[np.searchsorted(own, asked)].reshape(len(asked), *shape))
