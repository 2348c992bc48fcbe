"""A plugin: rows between nodes that come and go at random, by the numbers of steps and nodes."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from pfem_petsc.case.base import PositiveFloat, PositiveInt
from pfem_petsc.contact.constraints.base import Constraint as Base
from pfem_petsc.contact.constraints.base import ConstraintKeys, ExpectedNodes

N = np.array([0.6, 0.0, 0.8])


class Parameters(ConstraintKeys):
    """Keys of random rows."""

    interval: PositiveFloat
    """time for which a row is there or not [s]"""
    straight: bool = False
    """true: along a fixed direction, and no two rows share a node; else distances"""
    nodes: PositiveInt = 2
    """of a row"""


class Constraint(Base):
    """Nodes i and i + 7 of a row, or i, i + 7 and so on, are no farther apart than where the row was made.

    Each node counts how often it was found in a row; every third time it is left out.
    """

    dynamic = True

    def __init__(self, parameters, nodes_of) -> None:
        self.interval, self.straight = parameters.interval, parameters.straight
        self.fixed = parameters.straight
        self.steps = 7 * np.arange(parameters.nodes)
        self.nodes, self.data = np.empty((0, parameters.nodes), dtype=np.int64), np.empty((0, 1))
        self.ids = np.empty(0, dtype=np.int64)
        self._counts: np.ndarray | None = None
        self._draw = -1

    def find(self, nodes: ExpectedNodes):
        if self._counts is None:
            self._counts = np.zeros((len(nodes.numbers), 2))
        draw = int(nodes.time / self.interval + 1e-6)
        if draw == int(nodes.comm.allreduce(self._counts[:, 1].max(initial=-1.0), op=MPI.MAX)):
            return self
        n = nodes.comm.allreduce(len(nodes.numbers))
        x, counts = np.zeros((n, 3)), np.zeros(n)
        x[nodes.numbers], counts[nodes.numbers] = nodes.x, self._counts[:, 0]
        nodes.comm.Allreduce(MPI.IN_PLACE, x)
        nodes.comm.Allreduce(MPI.IN_PLACE, counts)
        first = np.arange(n - self.steps[-1])
        first = first[first % 14 < 7] if self.straight else first
        drawn = np.random.default_rng(first[-1] + draw).random(len(first)) < 0.5
        kept = first[drawn & (counts[first] % 3.0 < 2.0)]
        rows = kept[:, None] + self.steps
        longest = self._lengths(x[rows])
        known = {
            int(i): float(length)
            for part in nodes.comm.allgather([self.ids, self.data[:, 0]])
            for i, length in zip(*part, strict=True)
        }
        longest = np.array([known.get(int(i), length) for i, length in zip(kept, longest, strict=True)])
        mine = np.isin(kept, nodes.numbers)
        found = self.with_rows(nodes.comm, rows[mine], longest[mine, None], kept[mine])
        other = found.of(found.nodes, found.data)
        other._counts = self._counts.copy()
        other._counts[:, 0] += drawn[np.minimum(np.searchsorted(first, nodes.numbers), len(first) - 1)]
        other._counts[:, 1] = draw
        return other

    def state(self):
        return {} if self._counts is None else {"counts": self._counts}

    def load_state(self, arrays):
        self._counts = arrays["counts"]

    def _lengths(self, x):
        arms = np.diff(x, axis=1)
        return arms[:, 0] @ N if self.straight else np.sqrt((arms**2).sum(axis=2)).sum(axis=1)

    def values(self, x):
        return self.data[:, 0] - self._lengths(x)

    def gradients(self, x):
        arms = np.diff(x, axis=1)
        along = np.broadcast_to(N, arms.shape) if self.straight else arms / np.linalg.norm(arms, axis=2)[:, :, None]
        nothing = np.zeros_like(along[:, :1])
        return np.concatenate([along, nothing], axis=1) - np.concatenate([nothing, along], axis=1)
