"""Compiled loops over bars for products with their stiffness, from five numbers for each bar.

``stored`` (5, b): n, dN/dl - N/l and N/l, see :meth:`~pfem_petsc.mechanics.bars.Bars.linearise`.
"""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import inlined, kernel
from ..mechanics.rows import CHUNK
from ..mechanics.strips import add_strips, differences

__all__ = ["add_blocks", "add_products"]

_2, _3 = 2 * CHUNK, 3 * CHUNK


@kernel
def add_products(sweep, far, stored, u, out):
    """Add K u to ``out``, chunk by chunk of a :class:`~pfem_petsc.mechanics.sweep.Sweep`."""
    heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
    # parts of one array, so that the compiler need not check whether they overlap
    work = np.ones(4 * CHUNK)
    dx, dy, dz, one = work[:CHUNK], work[CHUNK:_2], work[_2:_3], work[_3:]
    for chunk in range(len(sweep.diagonal)):
        if not sweep.diagonal[chunk]:
            _stars(chunk, heads, starts, chunks, far, stored, u, out)
            continue
        first = starts[chunks[chunk]]
        n = starts[chunks[chunk + 1]] - first
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            differences(u, heads[run], fars[run], starts[run + 1] - at, dx, dy, dz, at - first)
        last = first + n
        nx, ny, nz = stored[0, first:last], stored[1, first:last], stored[2, first:last]
        axial, across = stored[3, first:last], stored[4, first:last]
        for i in range(n):
            along = axial[i] * (nx[i] * dx[i] + ny[i] * dy[i] + nz[i] * dz[i])
            dx[i] = along * nx[i] + across[i] * dx[i]
            dy[i] = along * ny[i] + across[i] * dy[i]
            dz[i] = along * nz[i] + across[i] * dz[i]
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            add_strips(out, heads[run], fars[run], starts[run + 1] - at, dx, dy, dz, one, at - first)


@inlined
def _stars(chunk, heads, starts, chunks, far, stored, u, out):
    """Add the products of a chunk whose runs are stars."""
    for run in range(chunks[chunk], chunks[chunk + 1]):
        a = heads[run]
        ux = u[a, 0]
        uy = u[a, 1]
        uz = u[a, 2]
        sx = 0.0
        sy = 0.0
        sz = 0.0
        for k in range(starts[run], starts[run + 1]):
            b = far[k]
            dx = u[b, 0] - ux
            dy = u[b, 1] - uy
            dz = u[b, 2] - uz
            nx = stored[0, k]
            ny = stored[1, k]
            nz = stored[2, k]
            along = stored[3, k] * (nx * dx + ny * dy + nz * dz)
            across = stored[4, k]
            fx = along * nx + across * dx
            fy = along * ny + across * dy
            fz = along * nz + across * dz
            sx += fx
            sy += fy
            sz += fz
            out[b, 0] += fx
            out[b, 1] += fy
            out[b, 2] += fz
        out[a, 0] -= sx
        out[a, 1] -= sy
        out[a, 2] -= sz


@kernel
def add_blocks(bars, stored, blocks):
    """Add the diagonal blocks (local nodes, 6): xx, xy, xz, yy, yz, zz."""
    for k in range(len(bars)):
        c = stored[3, k]
        g = stored[4, k]
        nx = stored[0, k]
        ny = stored[1, k]
        nz = stored[2, k]
        for end in range(2):
            i = bars[k, end]
            blocks[i, 0] += c * nx * nx + g
            blocks[i, 1] += c * nx * ny
            blocks[i, 2] += c * nx * nz
            blocks[i, 3] += c * ny * ny + g
            blocks[i, 4] += c * ny * nz
            blocks[i, 5] += c * nz * nz + g
