"""Limits of rupture and removals for random cases."""

from __future__ import annotations

import random
from typing import Any

__all__ = ["draw_rupture"]


def draw_rupture(chance: random.Random, case: dict[str, Any], end: float) -> None:
    """Let bars break, or remove a support, drawn on its own so that other cases stay as they are."""
    if chance.random() > 0.12:
        return
    table = case["material"][chance.choice(sorted(case["material"]))]
    small = 10 ** chance.uniform(-4, -2)
    limits = {"strain": small, "compressive_strain": small * chance.uniform(0.5, 2.0)}
    limits |= {"stress": small * table["young_modulus"]}
    plastic = "yield_stress" in table or "proof_stress" in table or "curve" in table
    if plastic:
        limits["plastic_strain"] = small
    keys = chance.sample(sorted(limits), chance.randint(1, 2))
    table["rupture"] = {key: limits[key] for key in keys}
    if chance.random() < 0.3:
        table["rupture"]["steps"] = chance.randint(2, 8)
    if case.get("support") and "contact_pair" not in case and chance.random() < 0.5:
        case["support"][0]["name"] = "held"
        removal = {"supports": "held", "time": chance.uniform(0.0, 1.0) * end}
        case["remove"] = [removal | ({"duration": 0.3 * end} if chance.random() < 0.5 else {})]
