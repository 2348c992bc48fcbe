"""Compiled loops over nodes of multigrid's smoothing."""

from __future__ import annotations

from ..mechanics.compiled import kernel

__all__ = ["invert", "smooth"]


@kernel
def invert(blocks):
    """Invert symmetric matrices (n, 6): xx, xy, xz, yy, yz, zz, in place; singular ones become zero."""
    for k in range(len(blocks)):
        a, b, c, d, e, f = blocks[k]
        xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
        determinant = a * xx + b * xy + c * xz
        inverse = 1.0 / determinant if determinant > 0.0 else 0.0
        blocks[k, 0] = xx * inverse
        blocks[k, 1] = xy * inverse
        blocks[k, 2] = xz * inverse
        blocks[k, 3] = (a * f - c * c) * inverse
        blocks[k, 4] = (b * c - a * e) * inverse
        blocks[k, 5] = (a * d - b * b) * inverse


@kernel
def smooth(inverse, product, of_last, of_residual, r, z, x):
    """Subtract the product from the residual r, and make a step z of the polynomial: all (n, 3)."""
    for k in range(len(r)):
        r0 = r[k, 0] - product[k, 0]
        r1 = r[k, 1] - product[k, 1]
        r2 = r[k, 2] - product[k, 2]
        r[k, 0] = r0
        r[k, 1] = r1
        r[k, 2] = r2
        z0 = of_last * z[k, 0] + of_residual * (inverse[k, 0] * r0 + inverse[k, 1] * r1 + inverse[k, 2] * r2)
        z1 = of_last * z[k, 1] + of_residual * (inverse[k, 1] * r0 + inverse[k, 3] * r1 + inverse[k, 4] * r2)
        z2 = of_last * z[k, 2] + of_residual * (inverse[k, 2] * r0 + inverse[k, 4] * r1 + inverse[k, 5] * r2)
        z[k, 0] = z0
        z[k, 1] = z1
        z[k, 2] = z2
        x[k, 0] += z0
        x[k, 1] += z1
        x[k, 2] += z2
