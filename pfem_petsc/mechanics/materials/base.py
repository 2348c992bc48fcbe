"""Base of material laws: the keys of their tables, a :class:`Law` for the loops over bars, softening and damping of
laws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator

from ...case.base import Finite, NonNegativeFloat, PositiveFloat, StrictModel, listed
from ...case.tables import Rupture
from ...columns import BAR_ENERGIES
from ...errors import raised
from ...registry import lookup
from ..compiled import inlined


@dataclass(frozen=True)
class Softening:
    """How a law softens.

    Attributes
    ----------
    scale : compiled function of (p, factor of modulus, factor of yield stress) that returns p at a temperature; p[0] is
        the modulus of the elastic strain
    dissipated : compiled function of (p, q): the densities [J/m3] of all energies of the law except the elastic one, in
        their order, if they are functions of state; None if there are none or if the law accumulates them itself
    """

    scale: Callable
    dissipated: Callable | None = None


@inlined
def factors(temperature, table):
    """Return the factors of modulus and yield stress at a temperature: linear between rows, constant outside.

    ``table`` (rows, 3): temperature above reference [K] and both factors.
    """
    last = len(table) - 1
    if not (temperature > table[0, 0]):  # NaN takes the first row
        return table[0, 1], table[0, 2]
    for k in range(last):
        if temperature < table[k + 1, 0]:
            share = (temperature - table[k, 0]) / (table[k + 1, 0] - table[k, 0])
            modulus = table[k, 1] + share * (table[k + 1, 1] - table[k, 1])
            return modulus, table[k, 2] + share * (table[k + 1, 2] - table[k, 2])
    return table[last, 1], table[last, 2]


@cache
def softened(law: Law) -> Law:
    """Return the law with p = (p of the law, table of factors); see :func:`factors`."""
    response, mean_stress, interpolate = law.response, law.mean_stress, factors
    scale, dissipated, n = law.softening.scale, law.softening.dissipated, len(law.internal)

    @inlined
    def at_temperature(strain, rate, step, temperature, p, q):
        modulus, strength = interpolate(temperature, p[1])
        return response(strain, rate, step, temperature, scale(p[0], modulus, strength), q)

    @inlined
    def accumulated(strain, rate, step, temperature, p, q):
        modulus, strength = interpolate(temperature, p[1])
        scaled = scale(p[0], modulus, strength)
        before, kept = q[:n], q[n:]
        stress, tangent, after, densities = response(strain, rate, step, temperature, scaled, before)
        if after != before:
            old, new = dissipated(scaled, before), dissipated(scaled, after)
            kept = (kept[0] + (new[0] - old[0]), kept[1] + (new[1] - old[1]))
        return stress, tangent, after + kept, (densities[0],) + kept

    @inlined
    def mean_at_temperature(stress0, strain0, strain, step, temperature, p, q):
        modulus, strength = interpolate(temperature, p[1])
        return mean_stress(stress0, strain0, strain, step, temperature, scale(p[0], modulus, strength), q)

    def modulus(p: tuple, temperatures: np.ndarray) -> np.ndarray:
        base, table = p
        return base[0] * np.interp(temperatures, table[:, 0], table[:, 1])

    elastic = not law.internal
    return replace(
        law,
        response=at_temperature if dissipated is None else accumulated,
        internal=law.internal if dissipated is None else (*law.internal, *DENSITIES),
        smooth=False,
        mean_stress=mean_at_temperature if elastic else None,
        mean_of_work=False,  # a change of the modulus changes energies too
        no_mean_stress="" if elastic else _REASON,
        modulus=modulus,
    )


DENSITIES = (("plastic_heat_density", "J/m³"), ("hardening_energy_density", "J/m³"))
"""Internal variables of laws that accumulate their dissipation."""

_REASON = (
    "its stress yields at a temperature that changes within the step (softening), so its mean over a step, which this "
    "scheme needs, has no closed form"
)


VARIABLES = (("viscous_dissipation_density", "J/m³"), ("viscous_stress", "Pa"), ("known_rate", "1/s"))
"""Internal variables that follow those of the law."""

EXTRAPOLATED = 1.5
"""Factor of the mean rate over a step in the rate at its end, extrapolated from the last two steps."""


@cache
def damped(law: Law) -> Law:
    """Return the law with p = (p of the law, E beta [Pa s], factor of the mean rate, data of the bar)."""
    response, mean_stress, n, has_data = law.response, law.mean_stress, len(law.internal), bool(law.bar_data)

    @inlined
    def own(p):
        return p[0] + p[3:] if has_data else p[0]

    @inlined
    def with_damping(strain, rate, step, temperature, p, q):
        stress, tangent, after, densities = response(strain, rate, step, temperature, own(p), q[:n])
        lost, viscous, known = q[n], 0.0, q[n + 2]
        if step < math.inf:  # it is infinite in static analyses
            viscous = p[1] * (p[2] * rate + known)
            lost += p[1] * rate * rate * step
        if step > 0.0:
            tangent += p[1] * p[2] / step
            known = (1.0 - p[2]) * rate
        return stress + viscous, tangent, after + (lost, viscous, known), densities + (lost,)

    @inlined
    def mean_with_damping(stress0, strain0, strain, step, temperature, p, q):
        elastic = stress0 - q[n + 1]
        mean, modulus = mean_stress(elastic, strain0, strain, step, temperature, own(p), q[:n])
        if step > 0.0:
            modulus += p[1] / step
        return mean + p[1] * mean_rate(strain0, strain, step), modulus

    return replace(
        law,
        response=with_damping,
        internal=(*law.internal, *VARIABLES),
        energies=(*law.energies, "viscous_dissipation"),
        rate=True,
        mean_stress=None if mean_stress is None else mean_with_damping,
        # energies are functions of strain and internal variables, unless the law itself depends on the rate
        mean_of_work=law.mean_of_work or (not law.rate and law.modulus is None),
        modulus=_of_own(law.modulus),
        static_limit=law.static_limit or not law.rate,
        known_rate=n + 2,
    )


def _of_own(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
    """Return a function of the parameters of the law as one of those of the damped law."""
    return None if function is None else lambda p, *arguments: function(p[0], *arguments)


class BarShapes(NamedTuple):
    """Bars of one section, for laws that depend on their shape; arrays (b,), in SI units.

    ``second_moment`` and ``plastic_modulus`` are zero if the section has neither a shape nor a second moment.
    """

    length: np.ndarray
    area: np.ndarray
    second_moment: np.ndarray
    plastic_modulus: np.ndarray
    radius: np.ndarray
    effective_length: np.ndarray


class UnsuitableBarError(ValueError):
    """A law cannot describe a bar: its index in :class:`BarShapes`, and why, with the remedy."""

    def __init__(self, bar: int, reason: str) -> None:
        super().__init__(bar, reason)
        self.bar, self.reason = int(bar), reason


SofteningRow = Annotated[tuple[Finite, PositiveFloat, PositiveFloat], listed]


class MaterialKeys(StrictModel):
    """Keys that all materials share.

    A law whose bars buckle sets ``describes_buckling``; others are compared with Euler's load during a run. One that is
    documented up to a shortening, relative to the rest length, sets ``largest_shortening``.
    """

    describes_buckling: ClassVar[bool] = False
    largest_shortening: ClassVar[float] = math.inf

    law: str | None = None
    """name of a material law; default: "elastoplastic" with a yield_stress, else "elastic\""""
    young_modulus: PositiveFloat
    """Young's modulus [Pa]"""
    density: PositiveFloat
    """mass density [kg/m3]"""
    thermal_expansion: Finite = 0.0
    """coefficient of thermal expansion [1/K]"""
    damping: NonNegativeFloat = 0.0
    """damping c_m proportional to mass density [kg/(m3 s)]"""
    stiffness_damping: NonNegativeFloat = 0.0
    """factor beta of a damping C = beta K proportional to stiffness [s]: a viscous stress of E beta times the rate"""
    strain: Literal["engineering", "green", "logarithmic"] = "engineering"
    """strain measure"""
    softening: Annotated[tuple[SofteningRow, ...], listed, Field(min_length=1)] | None = None
    """rows [temperature above reference, factor of the modulus, factor of the yield stress and hardening] [K, -, -]:
    linear between rows, constant outside; elastic laws ignore the last factor"""

    @field_validator("softening")
    @classmethod
    def _warmer_from_row_to_row(cls, rows: tuple[Any, ...] | None) -> tuple[Any, ...] | None:
        for k in range(1, len(rows or ())):
            if not rows[k][0] > rows[k - 1][0]:
                raise ValueError(f"row {k}: the temperature must increase from row to row")
        return rows

    design_strength: PositiveFloat | None = None
    """stress to which tables of members compare that of a bar [Pa]; no result depends on it; default: yield_stress"""
    rupture: Rupture | None = None
    """limits beyond which a bar breaks"""

    def pack(self) -> tuple[float, ...]:
        """Return the numbers that the response of the law reads as ``p``; at least one."""
        return (float(self.young_modulus),)

    def pack_bars(self, bars: BarShapes) -> tuple[np.ndarray, ...]:
        """Return the ``bar_data`` of the law: arrays (b,), which the response reads after the numbers of :meth:`pack`.

        Raises
        ------
        UnsuitableBarError
            If the law cannot describe one of the bars.
        """
        return ()

    def largest_modulus(self) -> float:
        """Largest tangent modulus of a bar [Pa], for wave speeds and the rounding of forces."""
        return float(self.young_modulus)

    def numbers(self) -> tuple[Any, ...]:
        """Return what the response of :meth:`choose` reads as ``p``."""
        own = self.pack() if self.softening is None else (self.pack(), np.array(self.softening, dtype=float))
        beta = self.stiffness_damping
        return (own, self.young_modulus * beta, EXTRAPOLATED) if beta else own

    def choose(self, law: Law) -> Law:
        """Return the variant of the law that the keys select: the law itself, softened by temperature, or with damping
        proportional to its stiffness."""
        chosen = law if self.softening is None else softened(law)
        return damped(chosen) if self.stiffness_damping else chosen

    def upper_modulus(self) -> float:
        """:meth:`largest_modulus` at any temperature [Pa]."""
        return self.largest_modulus() * max((1.0, *(row[1] for row in self.softening or ())))

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about suspicious values, for the check before a run.

        Parameters
        ----------
        key : of the table, ``material.NAME``
        hint : text for a value that may be in a wrong unit
        """
        return []


def yield_texts(key: str, hint: str, name: str, stress: float, young: float) -> list[str]:
    """Return a message about a yield stress that is reached at an unrealistic strain, if it is."""
    if stress <= 0.2 * young:
        return []
    return [f"{key}.{name} = {stress:g} Pa is reached at a strain of {stress / young:.3g}; {hint}"]


@dataclass(frozen=True)
class Law:
    """A material law.

    Attributes
    ----------
    response : compiled (``register_jitable``) function of (strain, rate, step, temperature, p, q): strain minus the
        thermal strain; its rate over the step [1/s]; the step [s], 0 at the start of a run; temperature above reference
        [K]; the packed parameters, with the data of the bar; and the internal variables at the start of the step, a
        tuple. It returns (stress [Pa], tangent [Pa], internal variables at the end of the step, energy densities
        [J/m3]). The tangent is the total derivative of the stress with respect to the strain at the end, including that
        of the rate (1/step)
    internal : name and unit of each internal variable of a bar, zero at the start; the unit ``""`` is a pure number.
        They are fields of the snapshots if a case selects them, and arrays of the checkpoints. A variable named
        ``slack`` is 1 while the bar is slack: it is counted in the history and shown in the field ``status``
    energies : names of the energy densities, of :data:`~pfem_petsc.columns.BAR_ENERGIES`: functions of strain and
        internal variables. If the dissipation is not such a function, the law stores it in a further internal variable
    bar_data : names of the numbers that differ from bar to bar and that ``Parameters.pack_bars`` gives; the response
        reads them after the packed parameters, ``p = (*pack(), *pack_bars())``
    rate : whether the law depends on the rate or on the step; strain and stress at the end of the last step are then
        kept as well. Otherwise rate and step are zero
    smooth : whether the tangent is constant
    mean_stress : compiled function of (stress0, strain0, strain, step, temperature, p, q): returns the mean stress
        [Pa] over the step from stress0 and strain0 to strain, whose work is the change of energies, and its derivative
        with respect to strain; the rate over the step is :func:`mean_rate`. The energy-momentum scheme requires it;
        None: the scheme rejects the law
    mean_of_work : whether ``mean_stress`` is the change of all energies over that of the strain, as by the function
        :func:`mean_of_work`; it then holds for the work of changing temperatures too
    static_limit : for a law with ``rate``: whether it has a limit at the rate zero, which static analyses use; the
        step is then infinite
    softening : how the law softens by the key ``softening``; None: the key is rejected
    modulus : function of p and temperatures (bars,) that returns the modulus of the elastic strain (bars,) [Pa], if it
        depends on the temperature
    no_mean_stress : why there is no ``mean_stress``, for the message
    rupture : index of the internal variable with the fraction of a bar that has left the model, see
        :mod:`~pfem_petsc.mechanics.rupture`; -1 for laws whose bars cannot break
    known_rate : index of the internal variable with the known part of the strain rate of a viscous stress, whose factor
        is the last packed parameter, see :func:`damped`; -1 for laws without
    whole : the law of intact bars from which this one is derived, if any
    """

    response: Callable[..., Any]
    internal: tuple[tuple[str, str], ...] = ()
    energies: tuple[str, ...] = ("elastic_energy",)
    bar_data: tuple[str, ...] = ()
    rate: bool = False
    smooth: bool = False
    mean_stress: Callable[..., Any] | None = None
    mean_of_work: bool = False
    static_limit: bool = False
    softening: Softening | None = None
    modulus: Callable[[tuple[Any, ...], np.ndarray], np.ndarray] | None = None
    no_mean_stress: str = ""
    rupture: int = -1
    known_rate: int = -1
    whole: Law | None = None

    def __post_init__(self) -> None:
        for name in self.energies:
            if name not in BAR_ENERGIES:
                raise ValueError(f"a law gives {name!r}, which is none of {', '.join(BAR_ENERGIES)} (columns.py)")

    @property
    def rows(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of all data kept from step to step, internal variables first."""
        return (*self.internal, ("last_strain", ""), ("last_stress", "Pa")) if self.rate else self.internal

    @property
    def slack_row(self) -> int:
        """Row of the internal variable ``slack``, -1 for laws whose bars cannot be slack."""
        names = [name for name, _ in self.internal]
        return names.index("slack") if "slack" in names else -1

    def flaw(self, material: MaterialKeys, file: str) -> str:
        """Return how what the functions in a file give of an unstrained bar differs from what they must give; empty if
        it does not."""
        p, q = material.pack(), (0.0,) * len(self.internal)
        if not _are_numbers(p):
            return f"Parameters.pack returned {p!r:.80}; it must return a tuple of numbers"
        try:
            given = self.response(0.0, 0.0, 0.0, 0.0, (*p, *(1.0 for _ in self.bar_data)), q)
        except ArithmeticError:  # compiled code has infinite numbers instead
            return ""
        except Exception as error:  # noqa: BLE001 - of a user
            return "" if "math domain error" in str(error) else f"the function response {raised(error, file)}"
        fits = isinstance(given, tuple) and len(given) == 4 and _are_numbers(given[:2])
        if fits and _are_numbers(given[2], len(q)) and _are_numbers(given[3], len(self.energies)):
            return ""
        return (
            f"the function response returned {given!r:.80}; it must return (stress, tangent, internal variables, "
            f"energies), the last two as tuples of the lengths that LAW has: {len(q)} and {len(self.energies)}"
        )

    def refuses(self, scheme: Any) -> str | None:
        """Return why a :class:`~pfem_petsc.integrators.base.Scheme` cannot use the law, None if it can."""
        if scheme.discrete_gradient and self.mean_stress is None:
            return self.no_mean_stress or "it has no mean stress over a step (mean_stress), which this scheme needs"
        return None


def _are_numbers(values: Any, count: int | None = None) -> bool:
    """Whether values are a tuple of numbers, as many as ``count``, if it is given."""
    right = isinstance(values, tuple) and all(isinstance(value, int | float | np.number) for value in values)
    return right and (count is None or len(values) == count)


SMALL = 1e-6  # change of strain over strain, below which the quotient is rounding, and the trapezoidal rule is exact


def mean_of_work(response: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``mean_stress`` of a law without rate: the change of all its energies over the change of strain.

    The response must not depend on the steps in which a strain is reached: its energies are then the integral of the
    stress over the strain.
    """

    @inlined
    def mean_stress(stress0, strain0, strain, step, temperature, p, q):
        stress, tangent, _, after = response(strain, 0.0, step, temperature, p, q)
        change = strain - strain0
        if not abs(change) > SMALL * (abs(strain) + abs(strain0)):
            return 0.5 * (stress0 + stress), 0.5 * tangent
        _, _, _, before = response(strain0, 0.0, 0.0, temperature, p, q)
        work = 0.0
        for k in range(len(after)):
            work += after[k] - before[k]
        mean = work / change
        return mean, (stress - mean) / change

    return mean_stress


@inlined
def mean_rate(strain0, strain, step):
    """Return the rate [1/s] over a step from one strain to another, 0 for the step 0."""
    return (strain - strain0) / step if step > 0.0 else 0.0


LAWS = "pfem_petsc.mechanics.materials"
"""The package of the laws."""


def law_name(keys: Mapping[str, Any]) -> Any:
    """Return the law of a table; without the key ``law`` it depends on whether there is a ``yield_stress``."""
    if keys.get("law") is not None:
        return keys["law"]
    return "elastic" if keys.get("yield_stress") is None else "elastoplastic"


def law_of(material: MaterialKeys) -> Law:
    """Return the law of a material."""
    return material.choose(lookup(LAWS, law_name(dict(material)), "material.law").LAW)


def internal_variables(materials: Mapping[str, MaterialKeys]) -> dict[str, str]:
    """Return name and unit of all internal variables of the laws of materials, in their order."""
    return {name: unit for material in materials.values() for name, unit in law_of(material).internal}
