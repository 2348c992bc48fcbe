"""Checks of the nodes and bars of a truss: parts, nodes on bars, bracing.

Mechanisms are not an error in dynamics: chains and cables consist of them. They are reported because unintended ones
are a common mistake in a truss.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..contact.neighbours import Points, Segments, find_pairs
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..mesh.tools import components
from ..solvers.matrix_free import add_blocks, full_blocks

if TYPE_CHECKING:
    from ..stepping.model import Model

_NEAR = 1e-6
"""A node whose distance from a bar is less than this fraction of its length lies on it. Coordinates saved in single
precision have this accuracy."""

_SHOWN = 5
_RANK = 1e-9

_LARGEST = 600
"""Maximum number of unknowns for the global test, a singular value decomposition of a dense matrix."""


class Geometry:
    """The nodes and bars of a model, and what is odd about them. All methods are collective."""

    def __init__(self, model: Model) -> None:
        self._model, self._mesh, self._comm = model, model.mesh, model.comm

    @cached_property
    def _held(self) -> np.ndarray:
        """(owned, 3, 3) Sums of d d^T over the directions d of the bars of each node."""
        mesh, stored = self._mesh, np.zeros((2, len(self._mesh.bars)))
        stored[0] = self._model.bars.mesh_lengths**-2.0
        blocks = np.zeros((mesh.n_local, 6))
        add_blocks(mesh.bars, mesh.points, stored, blocks)
        return full_blocks(blocks[: mesh.n_owned])

    @cached_property
    def span(self) -> np.ndarray:
        """Orthonormal directions (r, 3) that the bars span: r = 1 for a rod, 2 for a plane truss."""
        values, vectors = np.linalg.eigh(self._comm.allreduce(self._held.sum(axis=0)))
        return vectors[:, values > 1e-12 * values[-1]].T

    def _lowest(self, nodes: np.ndarray) -> tuple[int, int]:
        """Return how many nodes are marked (owned,) on all ranks, and the lowest of their mesh numbers."""
        ids = self._mesh.node_ids[: self._mesh.n_owned][nodes]
        lowest = self._comm.allreduce(int(ids.min(initial=self._mesh.n_nodes)), op=MPI.MIN)
        return self._comm.allreduce(len(ids)), lowest

    def parts(self) -> tuple[int, int, int]:
        """Return the number of connected parts, and the size and lowest node number of the smallest one.

        Every node gets the lowest mesh number that it is connected to: within a rank at once, between ranks by the
        exchange of ghosts, repeated until no rank changes anything.
        """
        mesh, comm, owned = self._mesh, self._comm, self._mesh.n_owned
        label = mesh.node_ids[: mesh.n_local].astype(np.float64).reshape(-1, 1)  # whole numbers, exact to 2^53
        part, changed = components(mesh.n_local, mesh.bars), True
        while changed:
            before = label[:owned].copy()
            np.minimum.at(label, part, label.copy())
            label = label[part]
            mesh.update_ghosts(label)
            # a ghost may have a lower number, and this rank's own numbers may still have to propagate
            changed = comm.allreduce(not np.array_equal(before, label[:owned]), op=MPI.LOR)
        names, sizes = np.unique(label[:owned, 0].astype(np.int64), return_counts=True)
        # a rank adds up the parts whose lowest node is in its range of the mesh numbers, however many there are
        router = Router(comm, slab_of(names, mesh.n_nodes, comm.size))
        own, places = np.unique(router.send(names), return_inverse=True)
        total = np.bincount(places.ravel(), weights=router.send(sizes), minlength=len(own)).astype(np.int64)
        smallest = min(zip(total.tolist(), own.tolist()), default=(mesh.n_nodes + 1, -1))
        return comm.allreduce(len(own)), *min(comm.allgather(smallest))

    def nodes_on_bars(self) -> tuple[int, list[str], int, list[str]] | None:
        """Return the number of nodes on bars between their ends, and of coinciding nodes, each with the lowest few as
        texts; None if the search would take too long, as lengths of bars differ too much."""
        mesh, comm = self._mesh, self._comm
        bars = np.arange(len(mesh.bars))[mesh.counted]
        bars = bars[mesh.bar_ids[bars] < mesh.n_bars - mesh.n_connectors]
        own = np.arange(mesh.n_owned, dtype=np.int32)
        segments = Segments(
            np.concatenate([mesh.bar_ids[bars], mesh.node_ids[own]]),
            np.concatenate([mesh.bars[bars], np.stack([own, own], axis=1)]),
            np.concatenate([_NEAR * self._model.bars.mesh_lengths[bars], np.zeros(len(own))]),
            np.repeat(np.array([1, 2], np.uint8), [len(bars), len(own)]),
        )
        pairs = find_pairs(comm, Points(mesh.points, mesh.node_ids), segments)
        if pairs is None:
            return None
        part = pairs.at[:, 0]
        inner = (part > _NEAR) & (part < 1.0 - _NEAR)
        between = int(inner.sum())
        rows = np.concatenate([pairs.ids, pairs.names[:, 0]], axis=1)[inner]
        on_bars = sorted(rows.tolist())[:_SHOWN]
        end = pairs.names[np.arange(len(part)), 0, (part > 0.5).astype(np.int64)]
        # one for each bar of its nodes
        twins = np.unique(np.sort(np.stack([end, pairs.ids[:, 1]], axis=1)[~inner], axis=1), axis=0)
        alike = np.unique(twins)
        alike = np.unique(Router(comm, slab_of(alike, mesh.n_nodes, comm.size)).send(alike))
        every = sorted(row for some in comm.allgather(on_bars) for row in some)[:_SHOWN]
        shown = [f"node {node} on {_bar(bar, a, b)}" for bar, node, a, b in every]
        together = sorted({tuple(pair) for some in comm.allgather(twins[:_SHOWN].tolist()) for pair in some})
        twins_shown = [f"nodes {a} and {b}" for a, b in together[:_SHOWN]]
        return comm.allreduce(between), shown, comm.allreduce(len(alike)), twins_shown

    def unbraced(self) -> tuple[int, int]:
        """Return the number of nodes that can move freely, to first order, and the lowest of them.

        Only directions within the line or plane of the whole truss count: a plane truss is never braced out of its
        plane.
        """
        span, inside = self.span, self._held
        if self._model.supports.any:
            inside = inside + self._model.supports.spans()
        if len(span) < 3:  # else it would only be turned
            inside = np.einsum("ri,nij,sj->nrs", span, inside, span)
        # det / trace^(r-1) is a lower bound of the smallest eigenvalue: well above zero, no more work is needed
        trace = np.trace(inside, axis1=1, axis2=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            doubtful = ~(np.linalg.det(inside) / trace ** (len(span) - 1) > _RANK)
        if doubtful.any():
            doubtful[doubtful] = np.linalg.eigvalsh(inside[doubtful])[:, 0] < _RANK
        return self._lowest(doubtful)

    def rigidity(self) -> str:
        """Return the counts of mechanisms and states of self-stress as text; empty for large models.

        The equilibrium matrix A (free unknowns, bars) maps bar forces to nodal forces. With rank r there are b - r
        states of self-stress and n - r free motions (Maxwell, Calladine); rigid-body motions of the truss are not
        mechanisms.
        """
        mesh, comm, span = self._mesh, self._comm, self.span
        n, owned = mesh.n_nodes, mesh.n_owned
        if 3 * n > _LARGEST:
            return ""
        numbered = np.column_stack([mesh.bar_ids, mesh.node_ids[mesh.bars]]).tolist()
        bars = np.array(sorted({tuple(bar) for some in comm.allgather(numbered) for bar in some}))[:, 1:]
        points, held = np.zeros((n, 3)), np.zeros((n, 3, 3))
        points[mesh.node_ids[:owned]] = mesh.points[:owned]
        held[mesh.node_ids[:owned]] = self._model.supports.spans()
        points, held = comm.allreduce(points), comm.allreduce(held)
        direction = points[bars[:, 1]] - points[bars[:, 0]]
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        matrix, columns = np.zeros((n, 3, len(bars))), np.arange(len(bars))
        matrix[bars[:, 0], :, columns], matrix[bars[:, 1], :, columns] = -direction, direction
        # unknowns: directions within the span that are not prescribed
        reduced = np.concatenate([_free(span, some) @ rows for some, rows in zip(held, matrix, strict=True)])
        rank = int(np.linalg.matrix_rank(reduced, tol=_RANK)) if reduced.size else 0
        rigid = _rigid_motions(points - points.mean(axis=0), held, span)
        outside = sum(len(_free(np.eye(3), some)) for some in held) - len(reduced)
        where = {1: " along its line", 2: " in its plane", 3: ""}[len(span)]
        label = components(n, bars)
        parts = [np.flatnonzero(label == name) for name in np.unique(label)]
        every = sum(_rigid_motions(points[part] - points[part].mean(axis=0), held[part], span) for part in parts)
        # parts that no bar connects move against each other, and turn about axes of their own
        apart = f", {every - rigid} of parts against each other" if every > rigid else ""
        text = (
            f"{len(reduced)} free directions{where}, {rigid} rigid motions{apart}, {len(reduced) - rank - every} "
            f"mechanisms, {len(bars) - rank} states of self-stress"
        )
        return text + (f"; {outside} free directions out of it, which no bar resists" if outside else "")


def _bar(number: int, a: int, b: int) -> str:
    return f"bar {number} (nodes {a} and {b})"


def _free(span: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return orthonormal directions within the span that supports with the projection ``held`` leave free."""
    _, values, vectors = np.linalg.svd(held @ span.T, full_matrices=True)
    return vectors[int((values > 1e-12).sum()) :] @ span


def _rigid_motions(arms: np.ndarray, held: np.ndarray, span: np.ndarray) -> int:
    """Return the number of unsupported rigid-body motions within the span."""
    axes, arms = np.eye(3), arms / max(float(np.abs(arms).max()), np.finfo(float).tiny)
    turns = np.cross(axes, arms[:, None]).swapaxes(1, 2)
    motions = np.concatenate([np.broadcast_to(axes, turns.shape), turns], axis=2)
    stopped = np.concatenate([(axes - span.T @ span) @ motions, held @ motions]).reshape(-1, 6)
    _, values, vectors = np.linalg.svd(stopped, full_matrices=True)
    allowed = vectors[int((values > 1e-9).sum()) :].T
    return int(np.linalg.matrix_rank(motions.reshape(-1, 6) @ allowed, tol=1e-9)) if allowed.size else 0
