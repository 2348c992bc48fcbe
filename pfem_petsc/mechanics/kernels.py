"""Loops over bars, made once for each material law.

Bar from node a to node b with d = x_b - x_a, l = |d|, n = d/l (Greco & Coda's positional bar; design equations):
internal force on a is -N n, on b is +N n; the Hessian block is (dN/dl) n n^T + (N/l)(I - n n^T), added to the diagonal
blocks of both ends and subtracted from the two blocks between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

from numba.extending import register_jitable

from .compiled import kernel

__all__ = ["COLLAPSED_STRETCH", "SHORTENED_STRETCH", "make_kernels"]

COLLAPSED_STRETCH = 1e-3  # a bar below this fraction of its rest length has been crushed: no truss model holds there
SHORTENED_STRETCH = math.sqrt(0.8)  # only a bar shorter than this is looked at for having jumped through zero length


@cache
def make_kernels(response: Callable, remembers: bool, measure: Callable) -> SimpleNamespace:
    """Kernels of a material law and strain measure: ``forces``, ``tangents``, ``product``, ``linearise``, ``fields``.

    Common arguments: ``x`` (local nodes, 3) [m]; ``bars`` (b, 2) local ends; ``rest`` (b,) rest lengths [m];
    ``thermal`` (b,) thermal strains, or (0,) for none; ``p`` the law's parameters; ``area`` [m2]; ``history`` of the
    bars of this block, whose row is ``k - start``: plastic and accumulated plastic strain, (0, 2) for a law that does
    not remember. No array goes into an inner function: counting its references costs more than the bar.
    """

    @kernel
    def forces(x, bars, rest, thermal, p, area, history, start, counted, stop, commit, f):
        """Add internal forces to ``f``; sums over counted bars: elastic, heat, hardening [J]; first failed or -1;
        whether any bar is so short that it may have turned over."""
        elastic = 0.0
        heat = 0.0
        hardening = 0.0
        failed = -1
        shortened = False
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            stretch = length / rest[k]
            if not (stretch > COLLAPSED_STRETCH):  # NaN fails this test too
                if failed < 0:
                    failed = k
                if not commit:  # a trial position: the solver's norms must see that it is out of bounds
                    f[a, 0] = math.nan
                    f[b, 0] = math.nan
                continue
            if stretch < SHORTENED_STRETCH:
                shortened = True
            strain, slope, _ = measure(stretch)
            if warm:
                strain -= thermal[k]
            plastic = history[k - start, 0] if remembers else 0.0
            accumulated = history[k - start, 1] if remembers else 0.0
            stress, _, plastic, new, u, q, w = response(strain, p, plastic, accumulated)
            if remembers and commit and new != accumulated:
                history[k - start, 0] = plastic
                history[k - start, 1] = new
            if k < counted:
                volume = area * rest[k]
                elastic += volume * u
                if remembers:
                    heat += volume * q
                    hardening += volume * w
            c = area * stress * slope / length
            f[a, 0] -= c * dx
            f[a, 1] -= c * dy
            f[a, 2] -= c * dz
            f[b, 0] += c * dx
            f[b, 1] += c * dy
            f[b, 2] += c * dz
        return elastic, heat, hardening, failed, shortened

    @register_jitable
    def stiffness(dx, dy, dz, rest, shift, p, area, plastic, accumulated):
        """dN/dl [N/m], N/l [N/m] and 1/l of one bar."""
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        strain, slope, curvature = measure(length / rest)
        stress, modulus, _, _, _, _, _ = response(strain - shift, p, plastic, accumulated)
        axial = area * (modulus * slope * slope + stress * curvature) / rest
        return axial, area * stress * slope / length, 1.0 / length

    @kernel
    def tangents(x, bars, rest, thermal, p, area, history, start, stop, inertia, weight, ptr, slots, values):
        """Add ``weight`` K_t, and ``inertia`` l0 (2 on the diagonal, 1 beside it), to the block rows of owned nodes.

        ``slots`` (b, 4): index among all blocks of (a, a), (a, b), (b, b), (b, a), -1 where the row is not owned;
        ``ptr`` (owned + 1,) first block of a row; ``values``: the matrix in scalar compressed rows.
        """
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift = thermal[k] if warm else 0.0
            nx = x[b, 0] - x[a, 0]
            ny = x[b, 1] - x[a, 1]
            nz = x[b, 2] - x[a, 2]
            plastic = history[k - start, 0] if remembers else 0.0
            accumulated = history[k - start, 1] if remembers else 0.0
            axial, geometric, inverse = stiffness(nx, ny, nz, rest[k], shift, p, area, plastic, accumulated)
            nx *= inverse
            ny *= inverse
            nz *= inverse
            axial = weight * (axial - geometric)
            geometric = weight * geometric
            mass = inertia * rest[k]
            for side in range(4):
                slot = slots[k, side]
                if slot < 0:
                    continue
                row = a if side < 2 else b
                sign = 1.0 if side % 2 == 0 else -1.0
                m = 2.0 * mass if side % 2 == 0 else mass
                at = 6 * ptr[row] + 3 * slot
                wide = 3 * (ptr[row + 1] - ptr[row])
                c = sign * axial
                d = sign * geometric + m
                values[at] += c * nx * nx + d
                values[at + 1] += c * nx * ny
                values[at + 2] += c * nx * nz
                at += wide
                values[at] += c * ny * nx
                values[at + 1] += c * ny * ny + d
                values[at + 2] += c * ny * nz
                at += wide
                values[at] += c * nz * nx
                values[at + 1] += c * nz * ny
                values[at + 2] += c * nz * nz + d

    @kernel
    def product(x, bars, rest, thermal, p, area, history, start, stop, u, out):
        """Add K_t u to ``out``; both (local nodes, 3), ``u`` with ghosts."""
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift = thermal[k] if warm else 0.0
            nx = x[b, 0] - x[a, 0]
            ny = x[b, 1] - x[a, 1]
            nz = x[b, 2] - x[a, 2]
            plastic = history[k - start, 0] if remembers else 0.0
            accumulated = history[k - start, 1] if remembers else 0.0
            axial, geometric, inverse = stiffness(nx, ny, nz, rest[k], shift, p, area, plastic, accumulated)
            nx *= inverse
            ny *= inverse
            nz *= inverse
            dx = u[b, 0] - u[a, 0]
            dy = u[b, 1] - u[a, 1]
            dz = u[b, 2] - u[a, 2]
            along = (axial - geometric) * (nx * dx + ny * dy + nz * dz)
            fx = along * nx + geometric * dx
            fy = along * ny + geometric * dy
            fz = along * nz + geometric * dz
            out[a, 0] -= fx
            out[a, 1] -= fy
            out[a, 2] -= fz
            out[b, 0] += fx
            out[b, 1] += fy
            out[b, 2] += fz

    @kernel
    def linearise(x, bars, rest, thermal, p, area, history, start, stop, weight, stored):
        """What a product with ``weight`` K_t needs of each bar: n, dN/dl - N/l and N/l, to ``stored`` (b, 5)."""
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            shift = thermal[k] if warm else 0.0
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            plastic = history[k - start, 0] if remembers else 0.0
            accumulated = history[k - start, 1] if remembers else 0.0
            axial, geometric, inverse = stiffness(dx, dy, dz, rest[k], shift, p, area, plastic, accumulated)
            stored[k, 0] = dx * inverse
            stored[k, 1] = dy * inverse
            stored[k, 2] = dz * inverse
            stored[k, 3] = weight * (axial - geometric)
            stored[k, 4] = weight * geometric

    @kernel
    def fields(x, bars, rest, thermal, p, area, history, start, stop, strain_out, stress_out, force_out):
        """Total strain, stress [Pa] and axial force [N] of each bar."""
        warm = len(thermal) > 0
        for k in range(start, stop):
            a = bars[k, 0]
            b = bars[k, 1]
            dx = x[b, 0] - x[a, 0]
            dy = x[b, 1] - x[a, 1]
            dz = x[b, 2] - x[a, 2]
            strain, slope, _ = measure(math.sqrt(dx * dx + dy * dy + dz * dz) / rest[k])
            shift = thermal[k] if warm else 0.0
            plastic = history[k - start, 0] if remembers else 0.0
            accumulated = history[k - start, 1] if remembers else 0.0
            stress, _, _, _, _, _, _ = response(strain - shift, p, plastic, accumulated)
            strain_out[k] = strain
            stress_out[k] = stress
            force_out[k] = area * stress * slope

    return SimpleNamespace(forces=forces, tangents=tangents, product=product, linearise=linearise, fields=fields)
