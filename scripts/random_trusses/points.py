"""Masses of nodes, springs and dashpots to the ground for random cases."""

from __future__ import annotations

import math
import random
from typing import Any

__all__ = ["draw_points"]


def draw_points(chance: random.Random, case: dict[str, Any], size: float) -> None:
    """Give nodes masses, springs and dashpots, drawn on their own so that other cases stay as they are.

    ``size`` : of the truss [m]; a mass is a part of that of a bar of this length.
    """
    sections = [
        (section.get("area", 0.0), case["material"][section["material"]]) for section in case["section"].values()
    ]
    bar = max(area * material["density"] for area, material in sections) * size
    if bar and math.isfinite(bar) and chance.random() < 0.15:
        node_sets = [chance.choice(sorted(case["node_set"])) for _ in range(chance.randint(1, 2))]
        case["mass"] = [{"node_set": name, "value": bar * 10 ** chance.uniform(-2, 1)} for name in node_sets]
    if any("damping" in material for material in case["material"].values()) and chance.random() < 0.3:
        end = case["time"]["end"]
        case["time"]["damping_table"] = [[0.0, chance.uniform(0.0, 2.0)], [chance.uniform(0.1, 1.0) * end, 0.0]]
    if case.get("contact", {}).get("treatment") == "mass_redistribution":
        return  # refuses both
    stiffness = max(area * material["young_modulus"] for area, material in sections) / size
    if stiffness and math.isfinite(stiffness) and chance.random() < 0.15:
        parts = [stiffness * 10 ** chance.uniform(-3, 1) if chance.random() < 0.7 else 0.0 for _ in range(3)]
        case["spring"] = [{"node_set": chance.choice(sorted(case["node_set"])), "stiffness": parts}]
    if stiffness and math.isfinite(stiffness) and chance.random() < 0.1:
        coefficient = 10 ** chance.uniform(-3, -0.5) * math.sqrt(stiffness * bar)
        case["dashpot"] = [{"node_set": chance.choice(sorted(case["node_set"])), "coefficient": coefficient}]
    if "spring" in case and chance.random() < 0.5:
        case["spring"][0]["frame"] = [[chance.uniform(-1.0, 1.0) for _ in range(3)] for _ in range(2)]
