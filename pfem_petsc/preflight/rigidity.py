"""Bracing of a truss: a test for each node, and for small models a global one by the equilibrium matrix.

Mechanisms are not an error in dynamics: chains and cables consist of them. They are reported because unintended ones
are a common mistake in a truss.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["LARGEST", "Rigidity", "global_rigidity", "model_directions", "unbraced_nodes"]

LARGEST = 600
"""Maximum number of unknowns for the global test, a singular value decomposition of a dense matrix."""

_RANK = 1e-9


class Rigidity(NamedTuple):
    """Results of the global test: free unknowns, rank of the equilibrium matrix, rigid motions, mechanisms, states of
    self-stress; all within the line or plane of the truss, and the free unknowns out of it."""

    unknowns: int
    rank: int
    rigid_motions: int
    mechanisms: int
    self_stresses: int
    outside: int


@kernel
def _directions(points, bars, owned, total):
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        d = points[b] - points[a]
        d = d / np.sqrt((d * d).sum())
        for end in (a, b):
            if end < owned:
                for i in range(3):
                    for j in range(3):
                        total[end, i, j] += d[i] * d[j]


def model_directions(model: Model) -> np.ndarray:
    """Return orthonormal directions (r, 3) that the bars span: r = 1 for a rod, 2 for a plane truss. Collective."""
    tensors = np.zeros((model.mesh.n_owned, 3, 3))
    _directions(model.mesh.points, model.mesh.bars, model.mesh.n_owned, tensors)
    values, vectors = np.linalg.eigh(model.comm.allreduce(tensors.sum(axis=0)))
    return vectors[:, values > 1e-12 * values[-1]].T


def unbraced_nodes(model: Model) -> tuple[int, int]:
    """Return the number of nodes that can move freely, to first order, and the first of them. Collective.

    Only directions within the line or plane of the whole truss count: a plane truss is never braced out of its plane.
    """
    mesh, owned = model.mesh, model.mesh.n_owned
    held = np.zeros((owned, 3, 3))
    _directions(mesh.points, mesh.bars, owned, held)
    held += model.supports.spans()
    span = model_directions(model)
    inside = np.einsum("ri,nij,sj->nrs", span, held, span)
    # det / trace^(r-1) is a lower bound of the smallest eigenvalue; if it is well above zero, no more work is needed
    trace = np.trace(inside, axis1=1, axis2=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        doubtful = np.flatnonzero(~(np.linalg.det(inside) / trace ** (len(span) - 1) > _RANK))
    weakest = np.linalg.eigvalsh(inside[doubtful])[:, 0] if len(doubtful) else np.empty(0)
    bad = mesh.node_ids[doubtful[weakest < _RANK]]
    first = min(bad.tolist(), default=mesh.n_nodes)
    return model.comm.allreduce(len(bad)), min(model.comm.allgather(first))


def global_rigidity(model: Model) -> Rigidity | None:
    """Count mechanisms and states of self-stress; None for models beyond :data:`LARGEST` unknowns. Collective.

    The equilibrium matrix A (free unknowns, bars) maps bar forces to nodal forces. With rank r there are b - r states
    of self-stress and n - r free motions (Maxwell, Calladine); rigid-body motions of the truss are not mechanisms.
    """
    mesh, comm = model.mesh, model.comm
    if 3 * mesh.n_nodes > LARGEST:
        return None
    span = model_directions(model)
    owned = mesh.n_owned
    ends = [(int(n), int(a), int(b)) for n, (a, b) in zip(mesh.bar_ids, mesh.node_ids[mesh.bars], strict=True)]
    bars = sorted({bar for some in comm.allgather(ends) for bar in some})
    points, held = np.zeros((mesh.n_nodes, 3)), np.zeros((mesh.n_nodes, 3, 3))
    points[mesh.node_ids[:owned]] = mesh.points[:owned]
    held[mesh.node_ids[:owned]] = model.supports.spans()
    points, held = comm.allreduce(points), comm.allreduce(held)
    matrix = np.zeros((mesh.n_nodes, 3, len(bars)))
    for column, (_, a, b) in enumerate(bars):
        direction = (points[b] - points[a]) / np.linalg.norm(points[b] - points[a])
        matrix[a, :, column], matrix[b, :, column] = -direction, direction
    # unknowns: directions within the span that are not prescribed
    bases = [_free(span, held[node]) for node in range(mesh.n_nodes)]
    reduced = np.concatenate([basis @ rows for basis, rows in zip(bases, matrix, strict=True)])
    rank = int(np.linalg.matrix_rank(reduced, tol=_RANK)) if reduced.size else 0
    rigid = _rigid_motions(points - points.mean(axis=0), held, span)
    outside = sum(len(_free(np.eye(3), held[node])) for node in range(mesh.n_nodes)) - len(reduced)
    return Rigidity(len(reduced), rank, rigid, len(reduced) - rank - rigid, len(bars) - rank, outside)


def _free(span: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return orthonormal directions within the span that supports with the projection ``held`` leave free."""
    _, values, vectors = np.linalg.svd(held @ span.T, full_matrices=True)
    rank = int((values > 1e-12).sum())
    return vectors[rank:] @ span


def _rigid_motions(arms: np.ndarray, held: np.ndarray, span: np.ndarray) -> int:
    """Return the number of unsupported rigid-body motions within the span."""
    size = max(float(np.abs(arms).max()), np.finfo(float).tiny)
    axes = np.eye(3)
    motions = np.stack(
        [np.tile(axis, (len(arms), 1)) for axis in axes] + [np.cross(axis, arms / size) for axis in axes], axis=2
    )
    outside = np.einsum("ij,njk->nik", axes - span.T @ span, motions)
    stopped = np.concatenate([outside, held @ motions]).reshape(-1, 6)
    _, values, vectors = np.linalg.svd(stopped, full_matrices=True)
    allowed = vectors[int((values > 1e-9).sum()) :].T
    return int(np.linalg.matrix_rank(motions.reshape(-1, 6) @ allowed, tol=1e-9)) if allowed.size else 0
