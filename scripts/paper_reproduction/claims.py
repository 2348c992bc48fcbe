"""What a statement of the paper is, and the measurements that statements are judged by."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from .exact import BAR, PLASTIC_BAR, ROD
from .measures import RingImpact, RodImpact, measure_ring, measure_rod
from .running import Run
from .schemes import SCHEMES
from .studies import (
    BAR_ELEMENTS,
    BAR_STEPS,
    OTHER_RINGS,
    OTHER_SCHEMES,
    REFINED,
    REFINED_SCHEMES,
    RING_STEPS,
    bar_key,
    other_ring_key,
    refined_key,
    ring_key,
    rod_key,
)

__all__ = [
    "EXPLICIT",
    "NOT",
    "OPEN",
    "PARTLY",
    "REPRODUCED",
    "ROUGH",
    "SHORT",
    "SMOOTH",
    "Claim",
    "Measures",
    "listed",
    "measure_all",
    "pick",
]

REPRODUCED, PARTLY, NOT, OPEN = "reproduced", "partly", "not reproduced", "not checkable"
SHORT = {
    "central_differences": "CD",
    "newmark": "Newmark",
    "chung_lee": "Chung & Lee",
    "souza_moura": "stand-in",
    "houbolt": "Houbolt",
    "wilson": "Wilson",
}
EXPLICIT = ("central_differences", "chung_lee", "souza_moura")
SMOOTH = ("central_differences", "newmark", "chung_lee")  # that the paper recommends, less the one we do not know
ROUGH = ("houbolt", "wilson")  # that it finds unsatisfactory


class Claim(NamedTuple):
    """A statement of the paper, with what was measured and the verdict."""

    where: str
    statement: str
    measured: str
    verdict: str


@dataclass
class Measures:
    """All runs and their measures: rods by scheme, bars by (scheme, step, plastic), rings by (scheme, step)."""

    runs: dict[str, Run]
    rod: dict[str, RodImpact] = field(default_factory=dict)
    bars: dict[tuple[str, str, bool], RodImpact] = field(default_factory=dict)
    ring: dict[tuple[str, str], RingImpact] = field(default_factory=dict)
    other_ring: dict[tuple[str, str], RingImpact] = field(default_factory=dict)
    refined_rod: dict[tuple[str, int], RodImpact] = field(default_factory=dict)
    refined_bar: dict[tuple[bool, int], RodImpact] = field(default_factory=dict)


def measure_all(runs: dict[str, Run]) -> Measures:
    """Measure every run that has a history."""
    found = Measures(runs)
    for scheme in SCHEMES:
        found.rod[scheme] = measure_rod(runs[rod_key(scheme)], ROD)
        for step in BAR_STEPS:
            for plastic in (False, True):
                run = runs[bar_key(scheme, step, plastic)]
                if run.history:
                    found.bars[scheme, step, plastic] = measure_rod(run, PLASTIC_BAR if plastic else BAR)
        for step in RING_STEPS:
            found.ring[scheme, step] = measure_ring(runs[ring_key(scheme, step)])
    for ring in OTHER_RINGS:
        for scheme in OTHER_SCHEMES:
            found.other_ring[ring, scheme] = measure_ring(runs[other_ring_key(ring, scheme)])
    for scheme in REFINED_SCHEMES:
        for n in REFINED:
            found.refined_rod[scheme, n] = measure_rod(runs[refined_key("rod", scheme, n)], ROD)
    for n in BAR_ELEMENTS:
        for plastic, case in ((False, "bar_collision"), (True, "bar_collision_plastic")):
            run = runs[refined_key(case, "central_differences", n)]
            found.refined_bar[plastic, n] = measure_rod(run, PLASTIC_BAR if plastic else BAR)
    return found


def listed(values: dict[str, float], form: str = ".2f", unit: str = "") -> str:
    """Numbers by scheme as text."""
    return ", ".join(f"{SHORT[scheme]} {value:{form}}{unit}" for scheme, value in values.items())


def pick(measures: dict, schemes: Iterable[str], name: str) -> dict[str, float]:
    """One measure of some schemes."""
    return {scheme: getattr(measures[scheme], name) for scheme in schemes}
