"""The bare loop: a minimal Numba program for the explicit impact, without history and checks.

usage: run_bare_loop.py CELLS explicit|explicit_contact STEPS. Bars in the order of their ends, forces scattered.
"""

from __future__ import annotations

import math

import model as m
import numba
import numpy as np


@numba.njit(fastmath=True, error_model="numpy")
def fused_loop(steps, x, v, f, bars, rest, mass, plastic, back, contact, h, area, young, hardening, yield_stress):  # noqa: ANN201 - Numba infers
    """Advance by leapfrog; ``plastic`` strain (b,), or (0,) for elastic bars."""
    yields = len(plastic) > 0
    for _ in range(steps):
        f[:] = 0.0
        for k in range(len(bars)):
            a, b = bars[k, 0], bars[k, 1]
            dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            strain = length / rest[k] - 1.0
            stress = young * strain
            if yields:
                stress = young * (strain - plastic[k])
                excess = abs(stress - hardening * plastic[k]) - yield_stress
                if excess > 0.0:
                    rate = math.copysign(excess / (young + hardening), stress - hardening * plastic[k])
                    plastic[k] += rate
                    stress -= young * rate
            c = area * stress / length
            f[a, 0] += c * dx
            f[a, 1] += c * dy
            f[a, 2] += c * dz
            f[b, 0] -= c * dx
            f[b, 1] -= c * dy
            f[b, 2] -= c * dz
        for i in range(len(x)):
            scale = h / mass[i]
            for c in range(3):
                v[i, c] += scale * f[i, c]
            if not contact and back[i]:
                v[i, 2] = 0.0
            for c in range(3):
                x[i, c] += h * v[i, c]
            if contact and x[i, 2] < 0.0:
                x[i, 2] = 0.0
                v[i, 2] = max(v[i, 2], 0.0)


def main() -> None:
    """Run and report."""
    cells, mode, steps, _ = m.arguments()
    contact = mode.endswith("contact")
    points, bars = m.truss(cells)
    order = np.lexsort((bars.max(axis=1), bars.min(axis=1)))
    bars = bars[order].astype(np.int32)
    rest = np.linalg.norm(points[bars[:, 1]] - points[bars[:, 0]], axis=1)
    mass = m.lumped_mass(points, bars)
    foot = points[:, 2] == 0.0
    v = np.zeros_like(points)
    v[:, 2] = m.SPEED
    x, f, plastic = points.copy(), np.zeros_like(points), np.zeros(len(bars) if contact else 0)
    hardening = m.YOUNG_MODULUS * m.HARDENING_RATIO / (1.0 - m.HARDENING_RATIO)
    constants = (m.EXPLICIT_STEP, m.AREA, m.YOUNG_MODULUS, hardening, m.YIELD_STRESS)

    def run(count: int) -> None:
        fused_loop(count, x, v, f, bars, rest, mass, plastic, foot, contact, *constants)

    run(1)  # compiled
    times = m.timed(lambda: run(steps), steps)
    m.report(times, len(bars), float(x[-1, 2] - points[-1, 2]))


main()
