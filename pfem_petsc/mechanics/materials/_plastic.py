"""Plastic bars: with a yield stress R that is any function of the accumulated plastic strain a, and with a flow stress
that depends on a, its rate and the temperature; made by compiled code."""

from __future__ import annotations

import math
from collections.abc import Callable

from ...case.base import NonNegativeFloat, PositiveFloat
from ..compiled import inlined
from .base import DENSITIES, Law, MaterialKeys, Softening, mean_of_work, mean_rate, yield_texts

NOISE = 4.0 * 2.0**-52
"""Residual relative to its terms below which it is rounding."""

_MOST = 200  # iterations; some six are usual, and bisections alone would take a hundred


def make_solver(residual: Callable) -> Callable:
    """Return a compiled function ``solve(start, high, noise, data)``.

    ``residual(x, data)`` returns a value and its derivative; the value is positive at 0 and not at ``high``. ``solve``
    returns the root of (0, high], from ``start``, as soon as the residual is no larger than ``noise``, after a last
    step of Newton's method. Flow stresses may have any slope, and an infinite one at 0. Where a step of Newton's
    method leaves the bracket, the unknown decreases by powers that are squared each time until the residual is
    positive, and is then the geometric mean of the bounds, so that roots of any magnitude are found in a few steps.
    """

    @inlined
    def solve(start, high, noise, data):
        low, x, shrink = 0.0, start, 0.0625
        for _ in range(_MOST):
            value, slope = residual(x, data)
            if value > 0.0:
                low = x
            else:
                high = x
            new = x - value / slope if slope < 0.0 else -1.0
            if abs(value) <= noise:
                return new if low <= new <= high else x
            if not (low < new < high):
                if low == 0.0:
                    new = high * shrink
                    shrink *= shrink
                elif high > 4.0 * low:
                    new = math.sqrt(low) * math.sqrt(high)
                else:
                    new = 0.5 * (low + high)
            if new == x or new == 0.0:
                return new
            x = new
        return x

    return solve


VARIABLES = (("plastic_strain", ""), ("accumulated_plastic_strain", ""))
ENERGIES = ("elastic_energy", "plastic_heat", "hardening_energy")


class PlasticKeys(MaterialKeys):
    """Keys of materials with an initial yield stress and hardening."""

    yield_stress: PositiveFloat
    """initial yield stress s_Y [Pa]"""
    kinematic_hardening: NonNegativeFloat = 0.0
    """kinematic hardening modulus H [Pa]"""

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return a message about an unrealistic strain at yield."""
        return yield_texts(key, hint, "yield_stress", self.yield_stress, self.young_modulus)


def isotropic_law(curve: Callable, scale: Callable, find: Callable | None = None) -> Law:
    """Make a rate-independent law.

    Parameters
    ----------
    curve : compiled function of (a, p) that returns R [Pa], dR/da [Pa], and the densities of heat and of energy stored
        by isotropic hardening [J/m3], whose sum is the integral of R from 0 to a. p[0] = E, p[1] = H [Pa]
    scale : compiled function of (p, factor of modulus, factor of yield stress) that returns p at a temperature
    find : compiled function of (|s_trial - H e_p|, excess over R(a), E + H, a, p) that returns the plastic strain x of
        a step; None: by Newton's method, with a curve whose slope does not increase
    """

    @inlined
    def residual(x, data):
        size, stiffness, accumulated, p = data
        strength, slope, _, _ = curve(accumulated + x, p)
        return size - stiffness * x - strength, -stiffness - slope

    solve = make_solver(residual)

    @inlined
    def by_newton(size, excess, stiffness, accumulated, p):
        limit = excess / stiffness
        return solve(limit, limit, NOISE * size, (size, stiffness, accumulated, p))

    flow_of = by_newton if find is None else find

    @inlined
    def response(strain, rate, step, temperature, p, q):
        """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (plastic strain, accumulated plastic strain)."""
        young, kinematic = p[0], p[1]
        plastic, accumulated = q
        stress = young * (strain - plastic)
        tangent = young
        relative = stress - kinematic * plastic
        strength, slope, heat, stored = curve(accumulated, p)
        size = abs(relative)
        excess = size - strength
        if excess > 0.0:
            stiffness = young + kinematic
            flow = flow_of(size, excess, stiffness, accumulated, p)
            accumulated += flow
            strength, slope, heat, stored = curve(accumulated, p)
            tangent = young * (1.0 - young / (stiffness + slope))
            if relative < 0.0:
                flow = -flow
            plastic += flow
            stress -= young * flow
        elastic = 0.5 * stress * (strain - plastic)
        return stress, tangent, (plastic, accumulated), (elastic, heat, stored + 0.5 * kinematic * plastic * plastic)

    @inlined
    def dissipated(p, q):
        """Return the densities of heat and hardening energy [J/m3]."""
        _, _, heat, stored = curve(q[1], p)
        return heat, stored + 0.5 * p[1] * q[0] * q[0]

    return Law(
        response,
        internal=VARIABLES,
        energies=ENERGIES,
        mean_stress=mean_of_work(response),
        mean_of_work=True,
        softening=Softening(scale, dissipated),
    )


def viscous_law(
    flow_stress: Callable, stored: Callable, scale: Callable | None, heating: Callable | None = None
) -> Law:
    """Make a rate-dependent law.

    Parameters
    ----------
    flow_stress : compiled function of (a, rate, temperature, p) that returns Y [Pa], dY/da [Pa], rate dY/d(rate) [Pa]
        and dY/dT [Pa/K]. p[0] = E, p[1] = H [Pa]
    stored : compiled function of (a before, a after, p, work) that returns how much of the ``work`` of the isotropic
        part of the stress on the plastic strain of a step is stored [J/m3]
    scale : see :class:`~pfem_petsc.mechanics.materials.base.Softening`; None: no softening by a table
    heating : compiled function of p that returns the rise of temperature over the work of the isotropic part of the
        stress [K m3/J], for a law with the internal variable ``temperature_rise``
    """
    heats = heating is not None
    warming = heating if heats else no_heating

    @inlined
    def residual(x, data):
        size, stiffness, accumulated, step, start, warmth, rise, p = data
        strength, by_strain, by_rate, by_warmth = flow_stress(
            accumulated + x, x / step, warmth + rise * 0.5 * (start + size - stiffness * x) * x, p
        )
        slope = -stiffness - by_strain - by_rate / x
        slope -= by_warmth * rise * 0.5 * (start + size - 2.0 * stiffness * x)
        return size - stiffness * x - strength, slope

    solve = make_solver(residual)

    @inlined
    def onset(strain0, temperature, sign, p, q):
        """Return the stress relative to H e_p at which flow of a sign begins from ``strain0``, times the sign."""
        warmth = temperature + q[4] if heats else temperature
        static, _, _, _ = flow_stress(q[1], 0.0, warmth, p)
        return max(static, sign * (p[0] * (strain0 - q[0]) - p[1] * q[0]))

    @inlined
    def respond(strain, rate, step, temperature, p, q):
        young, kinematic = p[0], p[1]
        plastic, accumulated, heat, kept = q[0], q[1], q[2], q[3]
        tangent, work = young, 0.0
        trial = young * (strain - plastic) - kinematic * plastic
        size = abs(trial)
        sign = 1.0 if trial > 0.0 else -1.0
        warmth = temperature + q[4] if heats else temperature
        static, _, _, _ = flow_stress(accumulated, 0.0, warmth, p)
        excess = size - static
        if excess > 0.0 and step > 0.0:
            start = static
            if step < math.inf:
                start = onset(strain - rate * step, temperature, sign, p, q)
            stiffness = young + kinematic
            rise = warming(p)
            data = (size, stiffness, accumulated, step, start, warmth, rise, p)
            flow = solve(excess / stiffness, size / stiffness, NOISE * size, data)
            if flow > 0.0:
                _, slope = residual(flow, data)
                _, _, _, by_warmth = flow_stress(
                    accumulated + flow, flow / step, warmth + rise * 0.5 * (start + size - stiffness * flow) * flow, p
                )
                tangent = young * (1.0 + young * (1.0 - 0.5 * by_warmth * rise * flow) / slope)
                work = 0.5 * (start + size - stiffness * flow) * flow
                hardening = stored(accumulated, accumulated + flow, p, work)
                heat += work - hardening
                change = sign * flow
                kept += hardening + kinematic * (plastic + 0.5 * change) * change
                accumulated += flow
                plastic += change
        elastic = strain - plastic
        stress = young * elastic
        return stress, tangent, (plastic, accumulated, heat, kept), 0.5 * stress * elastic, work

    if heats:

        @inlined
        def response(strain, rate, step, temperature, p, q):
            """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (e_p, a, densities, rise of temperature)."""
            stress, tangent, new, elastic, work = respond(strain, rate, step, temperature, p, q)
            rise = q[4] + warming(p) * work
            return stress, tangent, (new[0], new[1], new[2], new[3], rise), (elastic, new[2], new[3])

    else:

        @inlined
        def response(strain, rate, step, temperature, p, q):
            """See :class:`~pfem_petsc.mechanics.materials.base.Law`; q = (e_p, a, densities of heat and hardening)."""
            stress, tangent, new, elastic, _ = respond(strain, rate, step, temperature, p, q)
            return stress, tangent, new, (elastic, new[2], new[3])

    @inlined
    def mean_stress(stress0, strain0, strain, step, temperature, p, q):
        """Return the mean stress of the step and its derivative; see the module."""
        stress, modulus, new, _ = response(strain, mean_rate(strain0, strain, step), step, temperature, p, q)
        mean, change = 0.5 * (stress0 + stress), strain - strain0
        modulus *= 0.5
        if new[1] != q[1] and change != 0.0:
            sign = 1.0 if new[0] > q[0] else -1.0
            begin = p[1] * q[0] + sign * onset(strain0, temperature, sign, p, q)
            early = min(max((begin - stress0) / (p[0] * change), 0.0), 1.0)  # clips rounding only
            # (1 - q)(s0 + s_y)/2 + q (s_y + s1)/2 = (s0 + s1)/2 + (s_y - s0) q/2 - (s1 - s_y)(1 - q)/2
            mean += 0.5 * ((begin - stress0) * (1.0 - early) - (stress - begin) * early)
            modulus = (1.0 - early) * modulus + 0.5 * (stress - stress0) * early / change
        return mean, modulus

    rise = (("temperature_rise", "K"),) if heats else ()
    return Law(
        response,
        internal=(*VARIABLES, *DENSITIES, *rise),
        energies=ENERGIES,
        rate=True,
        static_limit=True,
        mean_stress=mean_stress,
        mean_of_work=True,
        softening=None if scale is None else Softening(scale),
    )


@inlined
def no_heating(p):
    """Return zero."""
    return 0.0


@inlined
def curve(accumulated, p):
    """Return R = s_Y + K a + Q (1 - exp(-b a)), dR/da, and the densities s_Y a and int(R - s_Y);
    p = (E, H, s_Y, K, Q, b, ...)."""
    strength, linear, saturation, rate = p[2], p[3], p[4], p[5]
    x = rate * accumulated
    risen = -math.expm1(-x)
    # int(1 - exp(-b a)) = a - (1 - exp(-b a))/b, by its series where the two terms cancel
    part = accumulated * x * (0.5 - x * (1.0 / 6.0 - x / 24.0)) if x < 1e-4 else accumulated - risen / rate
    stored = 0.5 * linear * accumulated * accumulated + saturation * part
    slope = linear + saturation * rate * (1.0 - risen)
    return strength + linear * accumulated + saturation * risen, slope, strength * accumulated, stored


class HardeningKeys(PlasticKeys):
    """Keys of the yield stress at the rate zero: R(a) = s_Y + K a + Q (1 - exp(-b a))."""

    isotropic_hardening: NonNegativeFloat = 0.0
    """isotropic hardening modulus K [Pa]"""
    saturation_stress: NonNegativeFloat = 0.0
    """increase Q of the yield stress at saturation, as in the law voce [Pa]"""
    saturation_rate: NonNegativeFloat = 0.0
    """rate b of saturation over the accumulated plastic strain [-]"""

    def static(self) -> tuple[float, ...]:
        """Return (E, H, s_Y, K, Q [Pa], b)."""
        young, kinematic, first = self.young_modulus, self.kinematic_hardening, self.yield_stress
        return young, kinematic, first, self.isotropic_hardening, self.saturation_stress, self.saturation_rate


@inlined
def stored(before, after, p, work):
    """Return the energy that isotropic hardening stores between two accumulated plastic strains [J/m3]."""
    return curve(after, p)[3] - curve(before, p)[3]


@inlined
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], strength * p[1], strength * p[2], strength * p[3], strength * p[4], p[5], p[6], p[7]
