"""Statements of the paper, and the measurements by which they are judged."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from .exact import BAR, PLASTIC_BAR, ROD
from .measures import RingImpact, RodImpact, measure_ring, measure_rod
from .running import Run
from .schemes import PAPER, SCHEMES, Reading
from .studies import (
    BAR_ELEMENTS,
    BAR_STEPS,
    OTHER_RINGS,
    OTHER_SCHEMES,
    PHASE_SPEED,
    PHASES,
    REFINED,
    RING_STEPS,
    ROD_STEP,
    bar_key,
    other_ring_key,
    phase_key,
    refined_key,
    ring_key,
    ring_twin_key,
    rod_key,
)

REPRODUCED, PARTLY, NOT, OPEN = "reproduced", "partly", "not reproduced", "not checkable"
FITTED = "fitted"  # a result used to choose missing data cannot count as reproduced
SHORT = {
    "central_differences": "CD",
    "newmark": "Newmark",
    "chung_lee": "Chung & Lee",
    "souza_moura": "stand-in",
    "houbolt": "Houbolt",
    "wilson": "Wilson",
}
EXPLICIT = ("central_differences", "chung_lee", "souza_moura")  # of the paper
SMOOTH = ("central_differences", "newmark", "chung_lee")  # recommended by the paper, except the unavailable one
ROUGH = ("houbolt", "wilson")  # unsatisfactory according to the paper


class Claim(NamedTuple):
    """A statement of the paper, with what was measured and the verdict."""

    where: str
    statement: str
    measured: str
    verdict: str


@dataclass
class Measures:
    """All runs under a reading, and their measures.

    Rods by scheme, bars by (scheme, step, plastic), rings by (scheme, step); for the study of phases a list over the
    phases by scheme, None for a run that did not reach its end.

    Attributes
    ----------
    chaotic : schemes whose ring at the large step diverges from one with a speed that differs in the tenth digit
    """

    runs: dict[str, Run]
    reading: Reading
    rod: dict[str, RodImpact] = field(default_factory=dict)
    phases: dict[str, list[RodImpact | None]] = field(default_factory=dict)
    bars: dict[tuple[str, str, bool], RodImpact] = field(default_factory=dict)
    ring: dict[tuple[str, str], RingImpact] = field(default_factory=dict)
    chaotic: set[str] = field(default_factory=set)
    other_ring: dict[tuple[str, str], RingImpact] = field(default_factory=dict)
    refined_rod: dict[tuple[str, int], RodImpact] = field(default_factory=dict)
    refined_bar: dict[tuple[bool, int], RodImpact] = field(default_factory=dict)


def measure_all(runs: dict[str, Run], reading: Reading) -> Measures:
    """Measure every run that has a history."""
    found = Measures(runs, reading)
    for scheme in SCHEMES:
        found.rod[scheme] = measure_rod(runs[rod_key(scheme, reading)], ROD)
        for step in BAR_STEPS:
            for plastic in (False, True):
                run = runs[bar_key(scheme, reading, step, plastic)]
                if run.history:
                    found.bars[scheme, step, plastic] = measure_rod(run, PLASTIC_BAR if plastic else BAR)
        for step in RING_STEPS:
            found.ring[scheme, step] = measure_ring(runs[ring_key(scheme, reading, step)])
        if _parts(runs[ring_key(scheme, reading, "0.5")], runs[ring_twin_key(scheme, reading)]):
            found.chaotic.add(scheme)
        if phase_key(scheme, reading, 0) in runs:
            found.phases[scheme] = [_phase(runs, scheme, reading, phase) for phase in range(PHASES)]
    for ring in OTHER_RINGS:
        for scheme in OTHER_SCHEMES:
            found.other_ring[ring, scheme] = measure_ring(runs[other_ring_key(ring, scheme, reading)])
    for n in REFINED:
        for scheme in PAPER:
            found.refined_rod[scheme, n] = measure_rod(runs[refined_key("rod", scheme, reading, n)], ROD)
    for n in BAR_ELEMENTS:
        for plastic, case in ((False, "bar_collision"), (True, "bar_collision_plastic")):
            run = runs[refined_key(case, "central_differences", reading, n)]
            found.refined_bar[plastic, n] = measure_rod(run, PLASTIC_BAR if plastic else BAR)
    return found


def _phase(runs: dict[str, Run], scheme: str, reading: Reading, phase: int) -> RodImpact | None:
    run = runs[phase_key(scheme, reading, phase)]
    gap = ROD.gap + phase / PHASES * PHASE_SPEED * ROD_STEP
    return None if run.failure else measure_rod(run, replace(ROD, speed=PHASE_SPEED, gap=gap))


def _parts(run: Run, twin: Run) -> bool:
    """Return whether node 1 of two rings is ever more than a millimetre apart."""
    first, second = (part.history["probe/impact/position"][:, 0, 0] for part in (run, twin))
    rows = min(len(first), len(second))
    return bool(np.abs(first[:rows] - second[:rows]).max() > 1e-3)


def listed(values: dict[str, float], form: str = ".2f", unit: str = "") -> str:
    """Return numbers by scheme as text."""
    return ", ".join(f"{SHORT[scheme]} {value:{form}}{unit}" for scheme, value in values.items())


def pick(measures: dict, schemes: Iterable[str], name: str) -> dict[str, float]:
    """Return one measure of some schemes."""
    return {scheme: getattr(measures[scheme], name) for scheme in schemes}


def verdict(parts: Iterable[bool]) -> str:
    """Return the verdict on a statement from those on its parts, which are its claims, schemes or steps."""
    found = list(parts)
    return REPRODUCED if all(found) else PARTLY if any(found) else NOT
