"""Probes of a history row: each rank fills and sends the numbers of its own probed nodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..integrators.base import State

__all__ = ["PROBED", "Probes"]

PROBED = ("position", "velocity", "acceleration", "reaction")
_NUMBERS = 3 * len(PROBED)


class Probes:
    """Nodes of all probes. Construction is collective.

    The share of a rank are its nodes, one after the other, with the vectors of :data:`PROBED`. A row has them by probe,
    by quantity, and by mesh number.

    Parameters
    ----------
    comm : MPI.Comm
    nodes : name of a probe to its nodes on this rank
    node_ids : (local nodes,) mesh numbers

    Attributes
    ----------
    ids : name to the mesh numbers of its nodes on all ranks, ascending
    nodes : (m,) int64, nodes of all probes on this rank
    size : numbers of this rank's share
    width : numbers of all probes in a row
    """

    def __init__(self, comm: MPI.Comm, nodes: Mapping[str, np.ndarray], node_ids: np.ndarray) -> None:
        self._comm = comm
        self.ids: dict[str, np.ndarray] = {}
        own = [node_ids[local] for local in nodes.values()]
        self.nodes = np.concatenate([np.empty(0), *nodes.values()]).astype(np.int64)
        parts = comm.allgather(own) if nodes else []
        self._counts = np.array([sum(len(ids) for ids in part) for part in parts], dtype=np.int64)
        # for each node in the order of the row, its place among those of all ranks in the order of ranks
        orders = []
        begins = np.concatenate([[0], np.cumsum(self._counts)]).astype(np.int64)[:-1]
        for k, name in enumerate(nodes):
            places = [at + sum(map(len, part[:k])) + np.arange(len(part[k])) for at, part in zip(begins, parts)]
            ids = np.concatenate([part[k] for part in parts])
            order = np.argsort(ids, kind="stable")
            self.ids[name] = ids[order]
            orders.append(np.concatenate(places)[order])
        self._orders = orders
        self.size = _NUMBERS * len(self.nodes)
        self.width = _NUMBERS * int(self._counts.sum())

    def places(self) -> np.ndarray:
        """Return where this rank's nodes begin in its share (m,) int64."""
        return _NUMBERS * np.arange(len(self.nodes), dtype=np.int64)

    def fill(self, share: np.ndarray, state: State, acceleration: np.ndarray, support: np.ndarray) -> None:
        """Write this rank's share (size,), with acceleration and forces of supports (owned, 3) to record."""
        values, nodes = share.reshape(-1, len(PROBED), 3), self.nodes
        values[:, 0], values[:, 1], values[:, 2] = state.x[nodes], state.v[nodes], acceleration[nodes]
        values[:, 3] = support[nodes] + state.contact[nodes]

    def unite(self, share: np.ndarray, out: np.ndarray) -> None:
        """Write the numbers of all probes (width,), as a row has them, from the shares (size,). Collective."""
        if not self._orders:
            return
        values = share
        if self._comm.size > 1:
            values = np.empty(self.width)
            self._comm.Allgatherv(np.ascontiguousarray(share), [values, _NUMBERS * self._counts])
        values, at = values.reshape(-1, len(PROBED), 3), 0
        for order in self._orders:
            end = at + _NUMBERS * len(order)
            out[at:end].reshape(len(PROBED), -1, 3)[:] = values[order].swapaxes(0, 1)
            at = end
