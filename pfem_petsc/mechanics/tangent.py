"""Products of the tangent stiffness at fixed positions with many vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .compiled import inlined, kernel
from .strips import add_tangent_products

if TYPE_CHECKING:
    from .bars import Bars

__all__ = ["Tangent"]


class Tangent:
    """K_t(x) of the bars of a rank and its springs, applied bar by bar; 24 B a bar.

    Parameters
    ----------
    bars : Bars
    x : (local, 3) positions with ghosts [m], which are kept and must not change
    """

    def __init__(self, bars: Bars, x: np.ndarray) -> None:
        self._bars, self._x = bars, x
        self._stored = np.empty((3, len(bars.ends)))
        bars.factors(x, self._stored)

    def product(self, u: np.ndarray, out: np.ndarray) -> None:
        """Compute ``out`` = K_t u for local arrays (nodes, 3); valid for owned nodes."""
        out[:] = 0.0
        for block in self._bars.blocks:
            _add_products(block.sweep, self._bars.ends, self._x, self._stored, u, out)
        for family in self._bars.families:
            family.add_product(1.0, u, out)


@kernel
def _add_products(sweep, ends, x, stored, u, out):
    """Add K_t u to ``out``, chunk by chunk of a :class:`~pfem_petsc.mechanics.runs.Sweep`."""
    heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
    for chunk in range(len(sweep.diagonal)):
        if not sweep.diagonal[chunk]:
            _add_one_by_one(starts[chunks[chunk]], starts[chunks[chunk + 1]], ends, x, stored, u, out)
            continue
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            count = starts[run + 1] - at
            add_tangent_products(x, u, out, heads[run], fars[run], count, stored[0], stored[1], stored[2], at)


@inlined
def _add_one_by_one(first, last, ends, x, stored, u, out):
    """Add the products of some bars."""
    for k in range(first, last):
        a, b = ends[k, 0], ends[k, 1]
        inverse = stored[2, k]
        nx, ny, nz = (x[b, 0] - x[a, 0]) * inverse, (x[b, 1] - x[a, 1]) * inverse, (x[b, 2] - x[a, 2]) * inverse
        wx, wy, wz = u[b, 0] - u[a, 0], u[b, 1] - u[a, 1], u[b, 2] - u[a, 2]
        along, across = stored[0, k] * (nx * wx + ny * wy + nz * wz), stored[1, k]
        fx, fy, fz = along * nx + across * wx, along * ny + across * wy, along * nz + across * wz
        out[a, 0] -= fx
        out[a, 1] -= fy
        out[a, 2] -= fz
        out[b, 0] += fx
        out[b, 1] += fy
        out[b, 2] += fz
