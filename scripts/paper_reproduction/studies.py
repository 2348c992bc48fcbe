"""Every run of the comparison: a built-in case, an integrator, a time step."""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

from .schemes import SCHEMES

__all__ = [
    "BAR_ELEMENTS",
    "BAR_STEPS",
    "INSTANTS",
    "OTHER_RINGS",
    "OTHER_SCHEMES",
    "REFINED",
    "REFINED_SCHEMES",
    "RING_STEPS",
    "ROD_STEP",
    "Study",
    "all_studies",
    "bar_key",
    "other_ring_key",
    "refined_key",
    "ring_key",
    "rod_key",
]

ROD_STEP = 0.01  # [s]
BAR_STEPS = {"0.5": 0.5e-6, "2": 2e-6}  # by name in microseconds [s]
RING_STEPS = {"0.5": 5e-4, "0.05": 5e-5}  # by name in milliseconds [s]
INSTANTS = (5e-5, 0.04, 0.08, 0.12, 0.16, 0.2)  # of figure 14 [s]
REFINED = (20, 40, 80, 160, 320)  # bars of the rod
BAR_ELEMENTS = (20, 80, 320)  # of each of the two bars
REFINED_SCHEMES = ("central_differences", "newmark", "chung_lee")
# Further rings whose first contact ends near 35 ms and that hit again near 120 ms: outer and inner radius [m], bays,
# bracing, orientation.
OTHER_RINGS = {
    "12 bays, one diagonal": (16.0, 15.52, 12, "single", "vertex"),
    "8 bays, two diagonals": (13.73, 13.04, 8, "x", "vertex"),
    "16 bays, two diagonals, flat side first": (20.24, 19.63, 16, "x", "flat"),
}
OTHER_SCHEMES = ("central_differences", "newmark", "houbolt", "wilson", "wilson_1.4")


class Study(NamedTuple):
    """A run: its name, the built-in case and what is set in it."""

    key: str
    case: str
    overrides: tuple[str, ...]


def rod_key(scheme: str) -> str:
    """Example 5.1 with a scheme."""
    return f"rod/{scheme}"


def bar_key(scheme: str, step: str, plastic: bool) -> str:
    """Example 5.2 with a scheme and a step."""
    return f"bars_{'plastic' if plastic else 'elastic'}/{scheme}_{step}us"


def ring_key(scheme: str, step: str) -> str:
    """Example 5.3 with a scheme and a step."""
    return f"ring/{scheme}_{step}ms"


def refined_key(case: str, scheme: str, elements: int) -> str:
    """A rod or bar of more elements; the step is divided by as much."""
    return f"refined/{case}_{scheme}_{elements}"


def other_ring_key(ring: str, scheme: str) -> str:
    """Example 5.3 with another of the geometries, at the large step."""
    return f"other_rings/{list(OTHER_RINGS).index(ring)}_{scheme}"


def _other_rings() -> list[Study]:
    studies = []
    for ring, (outer, inner, bays, bracing, orientation) in OTHER_RINGS.items():
        half = pi / bays if orientation == "flat" else 0.0
        x, y = outer * cos(half), outer * sin(half)
        geometry = (
            f"mesh.outer_radius={outer}",
            f"mesh.inner_radius={inner}",
            f"mesh.bays={bays}",
            f"mesh.bracing={bracing}",
            f"mesh.orientation={orientation}",
            f"node_set.impact.nearest=[{x!r}, {y!r}, 0.0]",
            f"node_set.opposite.nearest=[{-x!r}, {-y!r}, 0.0]",
            f"wall.0.point=[{x + 0.1!r}, 0.0, 0.0]",
            f"time.step={RING_STEPS['0.5']!r}",
            "output.fields_every=2",
        )
        for scheme in OTHER_SCHEMES:
            studies.append(Study(other_ring_key(ring, scheme), "ring_impact", (*SCHEMES[scheme].overrides, *geometry)))
    return studies


def all_studies() -> list[Study]:
    """The runs, the longest first."""
    studies = []
    for name, step in sorted(RING_STEPS.items(), key=lambda entry: entry[1]):
        every = round(1e-3 / step)
        for scheme, integrator in SCHEMES.items():
            studies.append(
                Study(
                    ring_key(scheme, name),
                    "ring_impact",
                    (*integrator.overrides, f"time.step={step!r}", f"output.fields_every={every}"),
                )
            )
    studies += _other_rings()
    quiet = "output.fields_every=0"
    studies.append(
        Study(
            "ring/first_step", "ring_impact", (f"time.end={INSTANTS[0]!r}", "time.step=5e-5", "output.fields_every=1")
        )
    )
    for scheme in REFINED_SCHEMES:
        for elements in REFINED:
            refined = (f"mesh.elements={elements}", f"time.step={ROD_STEP * 20 / elements!r}", "time.end=3.0", quiet)
            studies.append(
                Study(refined_key("rod", scheme, elements), "rod_impact", (*SCHEMES[scheme].overrides, *refined))
            )
    for case in ("bar_collision", "bar_collision_plastic"):
        for elements in BAR_ELEMENTS:
            step = BAR_STEPS["0.5"] * 20 / elements
            refined = (f"mesh.elements={elements}", f"time.step={step!r}", quiet)
            studies.append(Study(refined_key(case, "central_differences", elements), case, refined))
    for scheme, integrator in SCHEMES.items():
        studies.append(Study(rod_key(scheme), "rod_impact", (*integrator.overrides, f"time.step={ROD_STEP!r}", quiet)))
        for plastic in (False, True):
            case = "bar_collision_plastic" if plastic else "bar_collision"
            for name, step in BAR_STEPS.items():
                settings = (*integrator.overrides, f"time.step={step!r}", quiet)
                studies.append(Study(bar_key(scheme, name, plastic), case, settings))
    return studies
