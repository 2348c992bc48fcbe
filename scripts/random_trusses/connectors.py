"""Springs and dashpots between nodes for random cases."""

from __future__ import annotations

import math
import random
from typing import Any

__all__ = ["draw_connectors"]


def draw_connectors(chance: random.Random, case: dict[str, Any], size: float) -> None:
    """Connect nodes, drawn on their own so that other cases stay as they are; ``size`` of the truss [m]."""
    if chance.random() > 0.08:
        return
    sections = [
        (section.get("area", 0.0), case["material"][section["material"]]) for section in case["section"].values()
    ]
    stiffness = max(area * material["young_modulus"] for area, material in sections) / size
    bar = max(area * material["density"] for area, material in sections) * size
    names = [name for name, chosen in case["node_set"].items() if "nearest" in chosen or "indices" in chosen]
    if not stiffness or not math.isfinite(stiffness + bar) or len(names) < 2:
        return
    between = chance.sample(sorted(names), 2)
    if chance.random() < 0.8:
        table = {"between": between, "stiffness": stiffness * 10 ** chance.uniform(-3, 0)}
        case.setdefault("spring", []).append(table)
    if chance.random() < 0.6:
        coefficient = 10 ** chance.uniform(-3, -1) * math.sqrt(stiffness * bar)
        case.setdefault("dashpot", []).append({"between": between, "coefficient": coefficient})
