"""Supports along directions that are no axes for random cases, which then have no contact."""

from __future__ import annotations

import random
from typing import Any

__all__ = ["draw_inclined"]


def draw_inclined(chance: random.Random, case: dict[str, Any]) -> None:
    """Turn supports, or add a roller; drawn on their own so that other cases stay as they are."""
    if chance.random() > 0.1:
        return
    if case.get("wall") or case.get("contact_pair"):
        if chance.random() > 0.4:
            return
        for key in ("wall", "contact_pair", "contact"):
            case.pop(key, None)

    def direction() -> list[float]:
        return [chance.uniform(-1.0, 1.0) for _ in range(3)]

    supports = case.setdefault("support", [])
    for table in supports:
        if chance.random() < 0.7:
            table["frame"] = [direction(), direction()]
    if not supports or chance.random() < 0.5:
        names = [name for name in sorted(case["node_set"]) if name != "every"]
        supports.append({"node_set": chance.choice(names), "normal": direction()})
        if chance.random() < 0.3 and len(supports) == 1 and "remove" not in case:
            supports[0]["name"] = "roller"
            case["remove"] = [{"supports": "roller", "time": chance.random() * case["time"]["end"]}]
