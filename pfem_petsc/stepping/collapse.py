"""The message about a bar that collapsed: the facts and the likely cause."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..output.units import engineering

if TYPE_CHECKING:
    from ..case.schema import Case
    from .stepper import Stepper

__all__ = ["tell_collapse"]

_STRONG = 1.0
"""Ratio of impact speed to the wave speed of bars beyond which it crushes them; the strain behind the wave is v/c."""


def tell_collapse(stepper: Stepper, bar: int) -> str:
    """Return the message about a bar (local index) that failed in the current step. Not collective."""
    model, state = stepper.model, stepper.state
    mesh = model.mesh
    a, b = mesh.bars[bar]
    when = stepper.arrived()
    name = f"bar {mesh.bar_ids[bar]} between nodes {mesh.node_ids[a]} and {mesh.node_ids[b]}"
    way = state.x[b] - state.x[a]
    length, rest = float(np.linalg.norm(way)), float(model.bars.rest[bar])
    if not np.isfinite(length):
        return f"{when}: the positions of {name} are not finite: the motion diverged; {stepper.remedy}"
    how = f"collapsed to {length:.3g} m" if bar == stepper.energy.failed else "gone through zero length"
    past = stepper.before[b] - stepper.before[a]
    speed = float(np.linalg.norm(way - past)) / stepper.part
    block = next(block for block in model.bars.blocks if block.start <= bar < block.stop)
    wave = float(np.sqrt(block.modulus / block.density)) if block.density else model.wave_speed
    return (
        f"{when}: {name} has {how}, from {rest:.3g} m; it had {float(np.linalg.norm(past)) / rest:.3g} of its length a "
        f"step before, and its ends moved at {engineering(speed, 'm/s')} towards each other, waves in it at "
        f"{engineering(wave, 'm/s')}: {_cause(stepper, wave)}"
    )


def _cause(stepper: Stepper, wave: float) -> str:
    """Return the likely cause (impact, load or time integration) and the remedy."""
    model = stepper.model
    case = model.case
    fastest = _speed_of_case(case, model.length)
    if fastest >= _STRONG * wave:
        return (
            f"at {engineering(fastest, 'm/s')} the impact is too strong for a truss model: use a lower speed, a "
            "stronger material, or a smaller time.step"
        )
    others = [stepper.remedy]
    touch = model.can_touch
    if touch and case.contact.treatment == "scheme" and not stepper.scheme.explicit and stepper.scheme.inertial:
        grows = ", which gains energy in impacts" * any("gains energy in impacts" in text for text in model.warnings)
        others.append(
            f'use contact.treatment = "stick" instead of the formulas of {case.time.integrator} at impact{grows}'
        )
    if touch and case.contact.treatment != "scheme":
        others.append(f'use another contact.treatment than "{case.contact.treatment}"')
    ways = ", or ".join(others)
    if model.external.active or any(s.motion is not None or s.velocity is not None for s in case.support):
        return f"loads and supports crush it, or the time integration does not follow the motion: {ways}"
    return (
        f"nothing in the case is faster than {engineering(fastest, 'm/s')}, which does not crush bars, so the time "
        f"integration is the likelier cause: {ways}"
    )


def _speed_of_case(case: Case, length: float) -> float:
    """Return an upper bound on the initial relative speed [m/s] of bodies and walls of a case; ``length`` of the truss
    [m]."""
    found = [float(np.linalg.norm(wall.velocity)) for wall in case.wall if wall.velocity is not None]
    for start in case.initial:
        turning = float(np.linalg.norm(start.angular_velocity)) * length
        found.append(float(np.linalg.norm(start.velocity)) + turning)
    for wall in case.wall:
        if wall.motion is not None:
            rows = np.diff(np.array(wall.motion, dtype=float), axis=0)
            found.append(float((np.linalg.norm(rows[:, 1:], axis=1) / rows[:, 0]).max(initial=0.0)))
    return sum(sorted(found)[-2:])
