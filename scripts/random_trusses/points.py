"""Masses of nodes for random cases."""

from __future__ import annotations

import math
import random
from typing import Any

__all__ = ["draw_points"]


def draw_points(chance: random.Random, case: dict[str, Any], size: float) -> None:
    """Give nodes masses, drawn on their own so that other cases stay as they are.

    ``size`` : of the truss [m]; a mass is a part of that of a bar of this length.
    """
    sections = case["section"]
    bar = max(case["material"][s["material"]]["density"] * s.get("area", 0.0) for s in sections.values()) * size
    if bar and math.isfinite(bar) and chance.random() < 0.15:
        node_sets = [chance.choice(sorted(case["node_set"])) for _ in range(chance.randint(1, 2))]
        case["mass"] = [{"node_set": name, "value": bar * 10 ** chance.uniform(-2, 1)} for name in node_sets]
