"""Compiled loops over bars for products with their stiffness, from two numbers for each bar.

The stiffness of a bar with end difference d is c d d^T + g I. ``stored`` (2, b) holds c and g, see
:meth:`~pfem_petsc.mechanics.bars.Bars.stiffnesses`; the loops take d from the positions ``x`` (local, 3), because nodes
are in the cache while their bars pass, and nothing has to be normalised.
"""

from __future__ import annotations

from ..mechanics.compiled import inlined, kernel
from ..mechanics.product_strips import add_stiffness_diagonals, add_stiffness_products

__all__ = ["add_blocks", "add_diagonals", "add_products", "drop_negative", "inertia_products"]


@kernel
def inertia_products(nodal, u, out):
    """Write the products of nodal inertia (owned,) to ``out`` (local, 3), zeros for ghosts."""
    owned = len(nodal)
    for k in range(owned):
        for i in range(3):
            out[k, i] = nodal[k] * u[k, i]
    for k in range(owned, len(out)):
        for i in range(3):
            out[k, i] = 0.0


@kernel
def add_products(sweep, far, x, stored, u, out):
    """Add K u to ``out``, chunk by chunk of a :class:`~pfem_petsc.mechanics.sweep.Sweep`."""
    heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
    for chunk in range(len(sweep.diagonal)):
        if not sweep.diagonal[chunk]:
            _stars(chunk, heads, starts, chunks, far, x, stored, u, out)
            continue
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            add_stiffness_products(x, u, out, heads[run], fars[run], starts[run + 1] - at, stored[0], stored[1], at)


@inlined
def _stars(chunk, heads, starts, chunks, far, x, stored, u, out):
    """Add the products of a chunk whose runs are stars."""
    for run in range(chunks[chunk], chunks[chunk + 1]):
        a = heads[run]
        ax = x[a, 0]
        ay = x[a, 1]
        az = x[a, 2]
        px = u[a, 0]
        py = u[a, 1]
        pz = u[a, 2]
        sx = 0.0
        sy = 0.0
        sz = 0.0
        for k in range(starts[run], starts[run + 1]):
            b = far[k]
            dx = x[b, 0] - ax
            dy = x[b, 1] - ay
            dz = x[b, 2] - az
            ux = u[b, 0] - px
            uy = u[b, 1] - py
            uz = u[b, 2] - pz
            c = stored[0, k] * (dx * ux + dy * uy + dz * uz)
            g = stored[1, k]
            fx = c * dx + g * ux
            fy = c * dy + g * uy
            fz = c * dz + g * uz
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
def add_diagonals(sweep, far, x, stored, minus, plus):
    """Add the diagonal of K at the upper ends of bars to ``plus``, and subtract that at the lower ends from ``minus``,
    both (local nodes, 3)."""
    heads, fars, starts, chunks = sweep.heads, sweep.fars, sweep.starts, sweep.chunks
    for chunk in range(len(sweep.diagonal)):
        for run in range(chunks[chunk], chunks[chunk + 1]):
            at = starts[run]
            if sweep.diagonal[chunk]:
                count = starts[run + 1] - at
                add_stiffness_diagonals(x, minus, plus, heads[run], fars[run], count, stored[0], stored[1], at)
                continue
            a = heads[run]
            for k in range(at, starts[run + 1]):
                b = far[k]
                for i in range(3):
                    d = x[b, i] - x[a, i]
                    part = stored[0, k] * (d * d) + stored[1, k]
                    plus[b, i] += part
                    minus[a, i] -= part


@kernel
def add_blocks(bars, x, stored, blocks):
    """Add the diagonal blocks (local nodes, 6): xx, xy, xz, yy, yz, zz."""
    for k in range(len(bars)):
        a, b = bars[k, 0], bars[k, 1]
        dx = x[b, 0] - x[a, 0]
        dy = x[b, 1] - x[a, 1]
        dz = x[b, 2] - x[a, 2]
        c = stored[0, k]
        g = stored[1, k]
        for i in (a, b):
            blocks[i, 0] += c * dx * dx + g
            blocks[i, 1] += c * dx * dy
            blocks[i, 2] += c * dx * dz
            blocks[i, 3] += c * dy * dy + g
            blocks[i, 4] += c * dy * dz
            blocks[i, 5] += c * dz * dz + g


@kernel
def drop_negative(bars, x, stored):
    """Replace negative eigenvalues of the bars' stiffness, g and c d.d + g, by zero."""
    for k in range(len(bars)):
        c = stored[0, k]
        g = stored[1, k]
        if c >= 0.0 and g >= 0.0:
            continue
        a, b = bars[k, 0], bars[k, 1]
        square = (x[b, 0] - x[a, 0]) ** 2 + (x[b, 1] - x[a, 1]) ** 2 + (x[b, 2] - x[a, 2]) ** 2
        left = max(g, 0.0)
        stored[0, k] = (max(c * square + g, 0.0) - left) / square if square > 0.0 else 0.0
        stored[1, k] = left
