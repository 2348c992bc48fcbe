"""Draws rest lengths, laws of bars, loads over time and damping, each with random numbers of its own.

So the other parts of a case stay as they are.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np

__all__ = ["ODD", "draw_bar_law", "draw_loads_over_time", "draw_prestress", "draw_stiffness_damping", "vector"]

ODD = 0.03
"""Fraction of the cases in which a rule of combination is violated on purpose."""


def vector(chance: random.Random, length: float) -> np.ndarray:
    """Return a vector (3,) of this length in a random direction."""
    vector = np.array([chance.gauss(0, 1) for _ in range(3)])
    return length * vector / np.linalg.norm(vector)


def draw_prestress(chance: random.Random, case: dict[str, Any], end: float) -> None:
    """Prescribe rest lengths of a section, drawn on its own so that cases without them stay as they are."""
    if chance.random() > 0.12:
        return
    section = case["section"][chance.choice(sorted(case["section"]))]
    material = case["material"][section["material"]]
    young = material["young_modulus"]
    most = min(3e-3, 0.9 * material.get("yield_stress", young) / young)
    key = chance.choice(("pretension", "prestress", "rest_length"))

    def value() -> float:
        strain = most * chance.uniform(-1.0, 1.0)
        return {"pretension": young * strain * section["area"], "prestress": young * strain}.get(key, 1.0 - strain)

    rows = sorted(chance.random() for _ in range(chance.randint(1, 4)))
    section[key] = value() if chance.random() < 0.4 else [[row * end, value()] for row in rows]


def draw_bar_law(chance: random.Random, case: dict[str, Any], longest: float) -> None:
    """Replace the law of a material, drawn on its own so that cases without it stay as they are."""
    if chance.random() > 0.12:
        return
    name = chance.choice(sorted(case["material"]))
    table = {key: value for key, value in case["material"][name].items() if not key.endswith(("_hardening", "_stress"))}
    young, law = table["young_modulus"], chance.choice(("cable", "strut", "strut", "damage", "compaction"))
    table["law"], strong = law, young * 10 ** chance.uniform(-3, -1.7)
    if law == "damage":
        energy = 0.5 * strong**2 / young * longest * 10 ** chance.uniform(0.05, 1.0)
        table |= {"tensile_strength": strong, "fracture_energy": energy}
    elif law == "strut" or chance.random() < 0.6:
        table["yield_stress"] = strong
    if law == "strut":
        table["imperfection"] = chance.choice((0.0, 10 ** chance.uniform(-4, -2)))
    if law == "cable" and "yield_stress" in table and chance.random() < 0.7:
        table["isotropic_hardening"] = young * 10 ** chance.uniform(-2, -0.3)
    if law == "compaction":
        table |= {"compaction_strain": 10 ** chance.uniform(-3, -1.5), "compaction_modulus": 0.2 * young}
    case["material"][name] = table
    for section in case["section"].values():
        if section["material"] == name:
            shape = {"shape": "tube", "thickness": 0.1 * section["area"] ** 0.5}
            section |= chance.choice(({"shape": "round"}, shape, {"second_moment": 0.05 * section["area"] ** 2}))
            section["effective_length"] = chance.choice((1.0, 0.7, 0.5))


def draw_loads_over_time(chance: random.Random, case: dict[str, Any], speed: float, end: float) -> None:
    """Wind, gravity over time and smooth tables, drawn on their own so that cases without them stay as they are."""
    if chance.random() > 0.12:
        return

    def rows(values: Any) -> list[list[float]]:
        times = sorted(chance.random() for _ in range(chance.randint(1, 5)))
        return [[t * end, *(chance.uniform(-1.0, 1.0) * np.array(values))] for t in times]

    smooth = {"interpolation": "smooth"} if chance.random() < 0.5 else {}
    if not any(wall.get("gravity") for wall in case.get("wall", ())) and chance.random() < 0.5:
        strength = speed / end * vector(chance, chance.uniform(0.1, 2.0))
        case["gravity"] = {"acceleration": rows(strength), **smooth}
    for load in case.get("load", ()):
        load |= smooth if "table" in load else {}
    # nodes without mass cannot follow wind, which is refused
    massless = case.get("contact", {}).get("treatment") == "mass_redistribution" and chance.random() > ODD
    if ("gravity" not in case or chance.random() < 0.6) and not massless:
        wind = speed * vector(chance, chance.uniform(0.3, 1.5))
        # drag that stops the lightest bars at twice the speed of the body in some part of the run
        section = min(case["section"].values(), key=lambda s: case["material"][s["material"]]["density"] * s["area"])
        line = case["material"][section["material"]]["density"] * section["area"]
        widest = max(2.0 * np.sqrt(s["area"] / np.pi) for s in case["section"].values())
        density = chance.uniform(0.02, 0.8) * line / (1.2 * widest * 2.0 * speed * end)
        steady = chance.random() < 0.4
        case["wind"] = {"velocity": wind if steady else rows(wind), "density": density, **({} if steady else smooth)}
        if chance.random() < 0.3:
            section["drag_coefficient"] = chance.uniform(0.0, 1.2)


def draw_stiffness_damping(chance: random.Random, case: dict[str, Any], limit: float) -> None:
    """Damp a material in proportion to its stiffness, drawn on its own; rest lengths that change exclude it."""
    if chance.random() > 0.08 or any(isinstance(value, list) for s in case["section"].values() for value in s.values()):
        return
    material = case["material"][chance.choice(sorted(case["material"]))]
    material["stiffness_damping"] = limit * 10 ** chance.uniform(-3.0, -1.0)
