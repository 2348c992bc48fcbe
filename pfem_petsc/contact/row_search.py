"""Distribution of rows over several nodes: a rank has the rows of its own nodes, and those connected with them.

Rows are tables of integers, identified and sorted by their first two columns; some further columns are the PETSc
numbers of their nodes. Each rank that owns a node of a row has the row. If a node is in several rows, all ranks that
own a node of such a group have the whole group, so they solve the same problem without communication.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..mesh.exchange import Router
from ..mesh.slab import slab_of

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["once", "owner_starts", "petsc_numbers", "to_owners", "with_groups"]


def owner_starts(mesh: DistributedMesh) -> np.ndarray:
    """Return the first PETSc number owned by each rank, and the end, (ranks + 1,). Collective."""
    return np.concatenate([[0], np.cumsum(mesh.comm.allgather(mesh.n_owned))]).astype(np.int64)


def petsc_numbers(mesh: DistributedMesh, numbers: np.ndarray) -> np.ndarray:
    """Return the PETSc numbers of nodes given by mesh numbers (n,), which any rank may own. Collective."""
    comm, ids = mesh.comm, mesh.node_ids[: mesh.n_owned]
    to_slab = Router(comm, slab_of(ids, mesh.n_nodes, comm.size))
    known, at = to_slab.send(ids), to_slab.send(mesh.first_node + np.arange(mesh.n_owned))
    order = np.argsort(known)
    wanted, place = np.unique(numbers, return_inverse=True)
    asking = Router(comm, slab_of(wanted, mesh.n_nodes, comm.size))
    asked = asking.send(wanted)
    return asking.reply(at[order[np.searchsorted(known[order], asked)]])[place.ravel()]


def once(rows: np.ndarray) -> np.ndarray:
    """Return the rows (r, k) without duplicates, sorted by the first two columns, which identify them."""
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    return rows[np.append(True, (np.diff(rows[:, :2], axis=0) != 0).any(axis=1))[: len(rows)]]


def to_owners(rows: np.ndarray, columns: Sequence[int], starts: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Return the rows of all ranks with a node of this rank, without duplicates. Collective.

    Parameters
    ----------
    rows : (r, k) int64
    columns : of PETSc numbers of nodes, negative for none
    starts : see :func:`owner_starts`
    comm : MPI.Comm
    """
    owners = np.searchsorted(starts, rows[:, columns], side="right") - 1
    keys = np.arange(len(rows))[:, None] * comm.size + owners
    row, owner = np.divmod(np.unique(keys[owners >= 0]), comm.size)
    return once(Router(comm, owner).send(rows[row]))


def with_groups(rows: np.ndarray, columns: Sequence[int], starts: np.ndarray, comm: MPI.Comm) -> np.ndarray:
    """Add the rows connected with those of this rank through shared nodes, repeated until complete. Collective.

    ``rows`` (r, k) are all rows with a node of this rank; see :func:`to_owners`.
    """
    own = rows
    order = [np.argsort(own[:, at], kind="stable") for at in columns]
    first, last = starts[comm.rank], starts[comm.rank + 1]
    known = np.empty(0, dtype=np.int64)
    while True:
        ends = np.unique(rows[:, columns])
        asked = np.setdiff1d(ends[(ends >= 0) & ((ends < first) | (ends >= last))], known)
        if comm.allreduce(len(asked), op=MPI.MAX) == 0:
            return rows
        known = np.union1d(known, asked)
        asking = Router(comm, np.searchsorted(starts, asked, side="right") - 1)
        wanted = asking.send(np.column_stack([asked, np.full(len(asked), comm.rank)]))
        answers, ranks = [], []
        for column, at in zip(columns, order, strict=True):
            keys = own[at, column]
            begin = np.searchsorted(keys, wanted[:, 0])
            count = np.searchsorted(keys, wanted[:, 0], side="right") - begin
            place = np.arange(count.sum()) + np.repeat(begin - np.cumsum(count) + count, count)
            answers.append(own[at[place]])
            ranks.append(np.repeat(wanted[:, 1], count))
        answer = Router(comm, np.concatenate(ranks)).send(np.concatenate(answers))
        rows = once(np.concatenate([rows, answer]))
