"""The highest frequency of a model, which limits explicit steps."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from .model import Model

__all__ = ["Frequency", "highest_frequency"]

_LARGEST = 1e150  # squared frequencies [rad2/s2] whose squares do not overflow


class Frequency(NamedTuple):
    """Bounds on the highest angular frequency [rad/s]: ``lower`` is rigorous, ``upper`` is based on Lanczos' residual.

    Infinite if stiffness over mass overflows double precision.
    """

    lower: float
    upper: float


@np.errstate(over="ignore", invalid="ignore")
def highest_frequency(model: Model, x: np.ndarray, steps: int = 60, accuracy: float = 1e-4) -> Frequency:
    """Compute the highest natural frequency at positions ``x`` by Lanczos' method on M^-1/2 K_t M^-1/2. Collective.

    M is the lumped mass. The limit l/c of a single bar is a safe bound on the critical step for unstressed bars only,
    and often too small. The largest Ritz value is a lower bound of the squared frequency, and its residual bounds the
    distance to an eigenvalue. With consistent mass the element matrix of a bar is at least a third of its lumped one,
    so the squared frequency is at most three times as high; it is at least the Rayleigh quotient of the Ritz vector.

    Parameters
    ----------
    model : Model
    x : (local, 3) positions with ghosts [m]
    steps : maximum number of Lanczos steps
    accuracy : relative residual at which the iteration stops
    """
    mesh, comm = model.mesh, model.comm
    owned = mesh.n_owned
    supports = model.supports
    with np.errstate(divide="ignore"):
        scale = np.where(supports.fixed, 0.0, 1.0 / np.sqrt(model.inertia.mass)[:, None])
    # the start vector is a hash of node and component: independent of the number of ranks, with all wave lengths
    ids = mesh.node_ids[:owned, None].astype(np.uint64) * np.uint64(3) + np.arange(3, dtype=np.uint64)
    hashed = (ids + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    hashed ^= hashed >> np.uint64(29)
    q = (hashed >> np.uint64(11)).astype(np.float64) / 2.0**53 - 0.5
    supports.clear(q)

    def norm(u: np.ndarray) -> float:
        return float(np.sqrt(comm.allreduce(float((u * u).sum()))))

    size = norm(q)
    if size == 0.0:
        return Frequency(0.0, 0.0)
    q /= size
    previous = np.zeros_like(q)
    local, product = np.zeros((mesh.n_local, 3)), np.zeros((mesh.n_local, 3))
    diagonal: list[float] = []
    beside: list[float] = []
    low = high = 0.0
    basis: list[np.ndarray] = []
    for _ in range(min(steps, 3 * mesh.n_nodes)):
        if model.inertia.consistent:
            basis.append(q)
        local[:owned] = scale * q
        mesh.update_ghosts(local)
        model.bars.product(x, local, product)
        w = scale * product[:owned]
        supports.clear(w)
        alpha = comm.allreduce(float((w * q).sum()))
        w -= alpha * q
        if beside:
            w -= beside[-1] * previous
        beta = norm(w)
        diagonal.append(alpha)
        matrix = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
        if not np.isfinite(matrix).all() or np.abs(matrix).max() > _LARGEST:
            return Frequency(np.inf, np.inf)
        values, vectors = np.linalg.eigh(matrix)
        ritz, residual = values[-1], beta * abs(vectors[-1, -1])
        low, high = max(ritz, 0.0), max(ritz + residual, 0.0)
        if residual <= accuracy * max(ritz, 0.0) or beta <= 1e-14 * max(abs(ritz), 1e-300):
            break
        beside.append(beta)
        previous, q = q, w / beta
    if model.inertia.consistent and low > 0.0:
        shape = scale * sum(weight * vector for weight, vector in zip(vectors[:, -1], basis))
        low /= comm.allreduce(float((shape * model.inertia.mass_times(shape, np.empty_like(shape))).sum()))
        high *= 3.0
    return Frequency(float(np.sqrt(low)), float(np.sqrt(high)))
