"""Whether contact gains energy with the settings of a case, from a table of impacts of elastic rods.

``impact_gains.npz`` has the largest gains over the phases of a step at which rods meet a wall, by integrator and its
parameters, treatment, mass matrix, restitution, number of bars and step; scripts/impact_phases.py writes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..registry import lookup

if TYPE_CHECKING:
    from ..case.model import Time
    from ..case.schema import Case

TABLE = Path(__file__).with_name("impact_gains.npz")

CASES = (
    ("scheme", False),
    ("scheme", True),
    ("stick", False),
    ("conserving", False),
    ("mass_redistribution", False),
)
"""Treatments of the table, and whether the mass is consistent."""
RESTITUTIONS = (0.0, 0.2, 0.5, 0.8, 0.9, 1.0)
BARS = (1, 2, 3, 5, 7, 10, 20)
STEPS = (0.1, 0.15, 0.2, 0.25, 0.35, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.25, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 50.0)
"""Relative to the explicit limit of the lumped rod, l/c; smaller and larger steps behave like these."""
PHASES = 14
BOUND = 0.005
"""Relative energy gain of the rods above which a warning is given."""


@dataclass(frozen=True)
class RodImpact:
    """An impact of rods on a wall.

    Attributes
    ----------
    treatment : ``contact.treatment``
    consistent : whether the mass matrix is consistent; else lumped
    step : relative to the explicit limit of the lumped rod, l/c
    restitution : of the wall
    bars : along a rod
    """

    treatment: str
    consistent: bool
    step: float
    restitution: float = 0.0
    bars: int = 20


@cache
def _gains_of(integrator: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters (p, k) of an integrator in the table, and gains (p, cases, restitutions, bars, steps)."""
    with np.load(TABLE) as table:
        if f"{integrator}.gains" not in table:
            return np.empty((0, 0)), np.empty((0, len(CASES), len(RESTITUTIONS), len(BARS), len(STEPS)))
        return table[f"{integrator}.parameters"], table[f"{integrator}.gains"].astype(float)


def _nearest(values: tuple[float, ...], value: float) -> int:
    return min(range(len(values)), key=lambda k: abs(values[k] - value))


def impact_gain(integrator: str, parameters: tuple[float, ...], impact: RodImpact) -> float:
    """Return the largest relative energy gain of impacts over all phases, at this step and at a quarter of it.

    The smaller step represents nodes that are slower than the fastest one, because chatter depends on the step. Values
    between those of the table are rounded to them; integrators and treatments that it does not have gain nothing.
    """
    known, gains = _gains_of(integrator)
    case = impact.treatment, impact.consistent
    if case not in CASES or not len(known):
        return 0.0
    of_steps = gains[
        np.abs(known - np.array(parameters)).sum(axis=1).argmin(),
        CASES.index(case),
        _nearest(RESTITUTIONS, impact.restitution),
        _nearest(BARS, impact.bars),
    ]
    return max(float(of_steps[_nearest(STEPS, size)]) for size in (impact.step, 0.25 * impact.step))


def overshoots(integrator: str, step: float) -> bool:
    """Return whether impacts may gain energy by an overshoot that the rods do not show.

    ``wilson`` treats the force that stops a node at t + theta h as an acceleration that grows linearly up to that time.
    Beyond the explicit limit the first steps after such a jump overshoot for any theta, and more so for larger steps;
    whether a truss gains energy depends on the motion of its nodes in these steps.
    """
    return integrator == "wilson" and step > 1.0


def warn_of_gain(case: Case, step: float, across: float = np.inf) -> str:
    """Return the warning about a case whose contact gains energy beyond :data:`BOUND`; empty if it does not.

    ``step`` : relative to the limit of central differences with lumped mass; ``across`` : time in which a wave crosses
    the truss, in units of that limit.
    """
    time, treatment = case.time, case.contact.treatment
    if not any(treatment == known for known, _ in CASES):
        return ""
    step, parameters = float(f"{step:.2g}"), time.scheme.model_dump()
    bars = max(round(across), BARS[0]) if across < BARS[-1] else BARS[-1]
    gain, worst = -1.0, RodImpact(treatment, time.mass == "consistent", step, 0.0, bars)
    for restitution in sorted({0.0, *(keys.restitution for keys in (*case.wall, *case.contact_pair))}):
        impact = replace(worst, restitution=restitution)
        found = impact_gain(time.integrator, tuple(parameters.values()), impact)
        if found > gain:
            gain, worst = found, impact
    if gain <= BOUND and not overshoots(time.integrator, step):
        return ""
    named = ", ".join(f"{name} = {value:.4g}" for name, value in parameters.items())
    size = f"by {100.0 * gain:.2g} % of the energy" if gain < 10.0 else "by more than ten times the energy"
    restitution = f"restitution {worst.restitution:g}, " if worst.restitution else ""
    if gain <= BOUND:
        return (
            f"contact: wilson{f' ({named})' if named else ''} with contact and steps of {step:.2g} times the explicit "
            "limit gains energy in impacts: its first steps after a node is stopped overshoot, by more the larger the "
            f"step, at any theta; use {_remedies(time, worst)}"
        )
    return (
        f'contact: {time.integrator}{f" ({named})" if named else ""} with contact.treatment = "{treatment}", '
        f'{restitution}time.mass = "{time.mass}" and steps of {step:.2g} times the explicit limit gains energy in '
        f"impacts: {size} in the worst of {PHASES} phases of a step at which a rod meets a wall; use "
        f"{_remedies(time, worst)}"
    )


def _remedies(time: Time, impact: RodImpact) -> str:
    """Return at most two settings that do not gain energy, closest to the case first."""
    own = time.integrator, tuple(time.scheme.model_dump().values())
    lumped = ' and time.mass = "lumped"' if impact.consistent else ""
    newmark = 'time.integrator = "newmark" with its default parameters'
    defaults = lookup("pfem_petsc.integrators", "newmark", "").Parameters().model_dump()
    stick, scheme = replace(impact, treatment="stick", consistent=False), replace(impact, treatment="scheme")
    plain, shorter = not impact.restitution, "a time.step of at most {:g} times the explicit limit"
    tries = [
        (plain and impact.treatment != "stick", f'contact.treatment = "stick"{lumped}', *own, stick),
        (plain and impact.treatment != "scheme", 'contact.treatment = "scheme"', *own, scheme),
        (time.integrator == "wilson", "time.theta = 2", "wilson", (2.0,), impact),
        *((impact.step > size, shorter.format(size), *own, replace(impact, step=size)) for size in (1.0, 0.2)),
        (True, newmark, "newmark", tuple(defaults.values()), impact),
        (not plain, 'time.integrator = "energy_momentum"', "energy_momentum", (), impact),
        *(
            (impact.restitution > less, f"a restitution of at most {less:g}", *own, replace(impact, restitution=less))
            for less in (0.9, 0.5)
        ),
    ]
    found = [
        text
        for applies, text, *what in tries
        if applies and impact_gain(*what) <= BOUND and not overshoots(what[0], what[2].step)
    ]
    smaller = [text for text in found if text.startswith("a time.step")]
    found = [text for text in found if text not in smaller[1:]]  # of several step sizes keep the largest
    return ", or ".join(found[:2]) if found else newmark
