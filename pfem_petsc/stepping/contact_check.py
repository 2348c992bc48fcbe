"""Check before the first step whether contact gains energy with the settings of a case, by impacts of a small rod."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from ..contact.impact_phases import KNOWN, PHASES, Asked, scan_impacts
from ..registry import lookup

if TYPE_CHECKING:
    from ..case.model import Time
    from ..case.schema import Case

__all__ = ["BOUND", "contact_gain", "overshoots", "warn_of_gain"]

BOUND = 0.005
"""Relative energy gain in impacts of the small rod above which a warning is given."""

_RODS = 1, 20
"""Smallest and largest number of bars of the rods: in some trusses a wave passes within a step, as in short rods."""
_STEPS = 0.1, 50.0  # relative to the explicit limit; smaller and larger steps behave like these


@cache
def contact_gain(integrator: str, parameters: str, asked: Asked) -> float:
    """Return the largest relative energy gain of impacts over all phases, at this step and at a quarter of it.

    The smaller step represents nodes that are slower than the fastest one, because chatter depends on the step.
    ``parameters`` are those of the integrator as JSON.
    """
    module = lookup("pfem_petsc.integrators", integrator, "time.integrator")
    scheme = module.Scheme(module.Parameters.model_validate_json(parameters))
    low, high = _STEPS
    sizes = sorted({min(max(size, low), high) for size in (asked.step, 0.25 * asked.step)})
    return max(scan_impacts(scheme, replace(asked, step=size)).gain for size in sizes)


def overshoots(integrator: str, step: float) -> bool:
    """Return whether impacts may gain energy by an overshoot that the small rod does not show.

    ``wilson`` treats the force that stops a node at t + theta h as an acceleration that grows linearly up to that time.
    Beyond the explicit limit the first steps after such a jump overshoot for any theta, and more so for larger steps;
    whether a truss gains energy depends on the motion of its nodes in these steps.
    """
    return integrator == "wilson" and step > 1.0


def warn_of_gain(case: Case, step: float, across: float = np.inf) -> str:
    """Return the warning about a case whose contact gains energy beyond :data:`BOUND`; empty if it does not, and for
    treatments that the small rods do not implement.

    ``step`` : relative to the limit of central differences with lumped mass; ``across`` : time in which a wave crosses
    the truss, in units of that limit.
    """
    if case.contact.treatment not in KNOWN:
        return ""
    time = case.time
    step = float(f"{step:.2g}")  # rounded, so that similar cases share one scan
    elements = int(np.clip(np.round(across), *_RODS))
    gains = {}
    for restitution in sorted({0.0, *(float(f"{wall.restitution:.2g}") for wall in case.wall)}):
        asked = Asked(case.contact.treatment, time.mass == "consistent", step, restitution, elements)
        gains[contact_gain(time.integrator, time.scheme.model_dump_json(), asked)] = asked
    gain = max(gains)
    asked = gains[gain]
    if gain <= BOUND and not overshoots(time.integrator, step):
        return ""
    named = ", ".join(f"{name} = {value:.4g}" for name, value in time.scheme.model_dump().items())
    size = f"by {100.0 * gain:.2g} % of the energy" if gain < 10.0 else "by more than ten times the energy"
    restitution = f"restitution {asked.restitution:g}, " if asked.restitution else ""
    if gain <= BOUND:
        return (
            f"contact: wilson{f' ({named})' if named else ''} with contact and steps of {step:.2g} times the explicit "
            "limit gains energy in impacts: its first steps after a node is stopped overshoot, by more the larger the "
            f"step, at any theta; use {_remedies(time, asked)}"
        )
    return (
        f'contact: {time.integrator}{f" ({named})" if named else ""} with contact.treatment = "{asked.treatment}", '
        f'{restitution}time.mass = "{time.mass}" and steps of {step:.2g} times the explicit limit gains energy in '
        f"impacts: {size} in the worst of {PHASES} phases of a step at which a rod meets a wall; use "
        f"{_remedies(time, asked)}"
    )


def _remedies(time: Time, asked: Asked) -> str:
    """Return at most two settings that do not gain energy, closest to the case first."""
    parameters = time.scheme.model_dump_json()
    tries = []
    for other in ("stick", "scheme"):
        if other != asked.treatment and not asked.restitution:
            lumped = other == "stick" and asked.consistent
            text = f'contact.treatment = "{other}"' + (' and time.mass = "lumped"' if lumped else "")
            changed = replace(asked, treatment=other, consistent=asked.consistent and not lumped)
            tries.append((text, time.integrator, parameters, changed))
    if time.integrator == "wilson":
        tries.append(("time.theta = 2", "wilson", '{"theta": 2.0}', asked))
    for size in (1.0, 0.2):
        if asked.step > size:
            text = f"a time.step of at most {size:g} times the explicit limit"
            tries.append((text, time.integrator, parameters, replace(asked, step=size)))
    newmark = 'time.integrator = "newmark" with its default parameters'
    tries.append((newmark, "newmark", "{}", asked))
    if asked.restitution:
        tries.append(('time.integrator = "energy_momentum"', "energy_momentum", "{}", asked))
        for less in (0.9, 0.5):
            if asked.restitution > less:
                text = f"a restitution of at most {less:g}"
                tries.append((text, time.integrator, parameters, replace(asked, restitution=less)))
    found = [text for text, *what in tries if contact_gain(*what) <= BOUND and not overshoots(what[0], what[2].step)]
    smaller = [text for text in found if text.startswith("a time.step")]
    found = [text for text in found if text not in smaller[1:]]  # of several step sizes keep the largest
    return ", or ".join(found[:2]) if found else newmark
