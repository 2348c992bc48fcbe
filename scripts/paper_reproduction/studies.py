"""Every run of the comparison: a built-in case, an integrator, a time step."""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

from .schemes import PAPER, READINGS, SCHEMES, Reading

ROD_STEP = 0.01  # [s]
BAR_STEPS = {"0.5": 0.5e-6, "2": 2e-6}  # by name in microseconds [s]
RING_STEPS = {"0.5": 5e-4, "0.05": 5e-5}  # by name in milliseconds [s]
INSTANTS = (5e-5, 0.04, 0.08, 0.12, 0.16, 0.2)  # of figure 14 [s]
REFINED = (20, 40, 80, 160, 320)  # bars of the rod
BAR_ELEMENTS = (20, 80, 320)  # of each of the two bars
PHASES = 14  # impacts spread evenly over a time step
PHASE_SPEED = 0.1  # of the rods of that study: no bar comes near inversion [m/s]
QUIET = "output.fields_every=0"
TWIN = 1e-9  # relative change of the ring's speed that identifies chaotic runs
# Further rings whose first contact ends near 35 ms and that hit again near 120 ms: outer and inner radius [m], bays,
# bracing, orientation.
OTHER_RINGS = {
    "12 bays, one diagonal": (16.0, 15.52, 12, "single", "vertex"),
    "8 bays, two diagonals": (13.73, 13.04, 8, "x", "vertex"),
    "16 bays, two diagonals, flat side first": (20.24, 19.63, 16, "x", "flat"),
}
OTHER_SCHEMES = ("central_differences", "newmark", "houbolt", "wilson")


class Study(NamedTuple):
    """A run: its name, the built-in case and what is set in it."""

    key: str
    case: str
    overrides: tuple[str, ...]


def _of(scheme: str, reading: Reading) -> str:
    """Name of a scheme with its mass matrix; explicit schemes are the same in all readings."""
    return f"{scheme}_consistent" if reading.mass(scheme) == "consistent" else scheme


def rod_key(scheme: str, reading: Reading) -> str:
    """Example 5.1 with a scheme."""
    return f"rod/{_of(scheme, reading)}"


def phase_key(scheme: str, reading: Reading, phase: int) -> str:
    """Example 5.1, slower, with an impact ``phase`` parts of :data:`PHASES` after a step."""
    return f"phases/{_of(scheme, reading)}_{phase}"


def bar_key(scheme: str, reading: Reading, step: str, plastic: bool) -> str:
    """Example 5.2 with a scheme and a step."""
    return f"bars_{'plastic' if plastic else 'elastic'}/{_of(scheme, reading)}_{step}us"


def ring_key(scheme: str, reading: Reading, step: str) -> str:
    """Example 5.3 with a scheme and a step."""
    return f"ring/{_of(scheme, reading)}_{step}ms"


def ring_twin_key(scheme: str, reading: Reading) -> str:
    """Example 5.3 at the large step with a speed that differs in the tenth digit."""
    return f"ring_twins/{_of(scheme, reading)}"


def refined_key(case: str, scheme: str, reading: Reading, elements: int) -> str:
    """A rod or bar of more elements; the step is divided by as much."""
    return f"refined/{case}_{_of(scheme, reading)}_{elements}"


def other_ring_key(ring: str, scheme: str, reading: Reading) -> str:
    """Example 5.3 with another of the geometries, at the large step."""
    return f"other_rings/{list(OTHER_RINGS).index(ring)}_{_of(scheme, reading)}"


def ring_overrides(outer: float, inner: float, bays: int, bracing: str, orientation: str) -> tuple[str, ...]:
    """Settings of the case ``ring_impact`` for another ring; radii in m."""
    half = pi / bays if orientation == "flat" else 0.0
    x, y = outer * cos(half), outer * sin(half)
    return (
        f"mesh.outer_radius={outer!r}",
        f"mesh.inner_radius={inner!r}",
        f"mesh.bays={bays}",
        f"mesh.bracing={bracing}",
        f"mesh.orientation={orientation}",
        f"node_set.impact.nearest=[{x!r}, {y!r}, 0.0]",
        f"node_set.opposite.nearest=[{-x!r}, {-y!r}, 0.0]",
        f"wall.0.point=[{x + 0.1!r}, 0.0, 0.0]",
    )


def _settings(scheme: str, reading: Reading) -> tuple[str, ...]:
    return (*SCHEMES[scheme].overrides, *reading.overrides(scheme))


def _other_rings(reading: Reading) -> list[Study]:
    step = (f"time.step={RING_STEPS['0.5']!r}", "output.fields_every=2")
    return [
        Study(
            other_ring_key(ring, scheme, reading),
            "ring_impact",
            (*_settings(scheme, reading), *ring_overrides(*geometry), *step),
        )
        for ring, geometry in OTHER_RINGS.items()
        for scheme in OTHER_SCHEMES
    ]


def _rings(reading: Reading) -> list[Study]:
    studies = []
    for name, step in sorted(RING_STEPS.items(), key=lambda entry: entry[1]):
        every = round(1e-3 / step)
        for scheme in SCHEMES:
            settings = (*_settings(scheme, reading), f"time.step={step!r}", f"output.fields_every={every}")
            studies.append(Study(ring_key(scheme, reading, name), "ring_impact", settings))
    for scheme in SCHEMES:
        settings = (*_settings(scheme, reading), f"time.step={RING_STEPS['0.5']!r}", "output.fields_every=0")
        speed = f"initial.velocity=[{20.0 * (1.0 + TWIN)!r}, 0.0, 0.0]"
        studies.append(Study(ring_twin_key(scheme, reading), "ring_impact", (*settings, speed)))
    return studies


def _refined(reading: Reading) -> list[Study]:
    studies = []
    for elements in REFINED:
        refined = (f"mesh.elements={elements}", f"time.step={ROD_STEP * 20 / elements!r}", "time.end=3.0", QUIET)
        for scheme in PAPER:
            settings = (*_settings(scheme, reading), *refined)
            studies.append(Study(refined_key("rod", scheme, reading, elements), "rod_impact", settings))
    for case in ("bar_collision", "bar_collision_plastic"):
        for elements in BAR_ELEMENTS:
            step = BAR_STEPS["0.5"] * 20 / elements
            settings = (f"mesh.elements={elements}", f"time.step={step!r}", QUIET)
            studies.append(Study(refined_key(case, "central_differences", reading, elements), case, settings))
    return studies


def _rods(reading: Reading) -> list[Study]:
    studies = []
    for scheme in SCHEMES:
        settings = _settings(scheme, reading)
        studies.append(Study(rod_key(scheme, reading), "rod_impact", (*settings, f"time.step={ROD_STEP!r}", QUIET)))
        for plastic in (False, True):
            case = "bar_collision_plastic" if plastic else "bar_collision"
            for name, step in BAR_STEPS.items():
                key = bar_key(scheme, reading, name, plastic)
                studies.append(Study(key, case, (*settings, f"time.step={step!r}", QUIET)))
        if scheme in PAPER or scheme.startswith("wilson"):
            studies += [_phase(scheme, reading, phase) for phase in range(PHASES)]
    return studies


def _phase(scheme: str, reading: Reading, phase: int) -> Study:
    wall = 1.05 + phase / PHASES * PHASE_SPEED * ROD_STEP
    settings = (
        *_settings(scheme, reading),
        f"time.step={ROD_STEP!r}",
        f"initial.velocity=[{PHASE_SPEED!r}, 0.0, 0.0]",
        f"wall.0.point=[{wall!r}, 0.0, 0.0]",
        "time.end=4.0",
        QUIET,
    )
    return Study(phase_key(scheme, reading, phase), "rod_impact", settings)


def all_studies() -> list[Study]:
    """The runs, the longest first."""
    first_step = (f"time.end={INSTANTS[0]!r}", "time.step=5e-5", "output.fields_every=1")
    studies = [study for reading in READINGS for study in _rings(reading)]
    studies += [study for reading in READINGS for study in _other_rings(reading)]
    studies.append(Study("ring/first_step", "ring_impact", first_step))
    studies += [study for reading in READINGS for study in (*_refined(reading), *_rods(reading))]
    # the explicit schemes are the same in all readings
    return list({study.key: study for study in studies}.values())
