"""Forms found by force densities before the stages of a case, and load cases with combinations after them."""

from __future__ import annotations

import random
from typing import Any, NamedTuple

import numpy as np

from .draw import ODD, Body, Motion, by_velocity, draw_damping, draw_fields, draw_sections, vector

NOT_OF_FORMS = ("initial", "wall", "temperature", "remove", "contact")
"""Tables that belong to stages after a form."""
ALONE = ("wind", "temperature", "support")
"""Tables of load cases that are not added."""


class Scale(NamedTuple):
    """Sizes of the numbers of a case of stages."""

    force: float
    strain: float
    length: float
    speed: float
    step: float


def draw_form(chance: random.Random, case: dict[str, Any], scale: Scale) -> None:
    """Find the form of the net first, with nodes that hold it; what forms cannot have comes after it."""
    for key in ("spring", "dashpot", "contact_pair"):
        case.pop(key, None)
    mesh, stages = case["mesh"], case["stage"]
    two = len(mesh["points"]) > 8
    mesh["node_groups"]["pegs"] = [6, 7, 8, 9] if two else [6, 7]
    case["node_set"]["pegs"] = {"group": "pegs"}
    held = any(support["name"] == "base2" and support["fix"] == "x" for support in case["support"])
    case["support"].append({"name": "pegs", "node_set": "pegs", "fix": "yz" if held else "xyz"})
    stages[0] |= {key: case.pop(key) for key in NOT_OF_FORMS if key in case}
    lengths = np.linalg.norm(np.diff(np.array(mesh["points"])[np.array(mesh["bars"])], axis=1)[:, 0], axis=1)
    for name, section in case["section"].items():
        for key in ("pretension", "prestress", "rest_length"):
            section.pop(key, None)
        force = scale.force * section["area"] / 1e-3 * chance.uniform(0.2, 0.8)
        density = force / lengths.max()
        key = chance.choice(("force_density",) * 4 + ("force_density_field", "pretension", "pretension_field"))
        if key.endswith("_field"):
            size = density if key.startswith("force") else force
            mesh.setdefault("bar_fields", {})[name] = [size * chance.uniform(0.6, 1.0) for _ in lengths]
        section[key] = name if key.endswith("_field") else density if key.startswith("force") else force
    built = [{"name": "built", "static": {"method": "newton", "step": 0.5}}] if chance.random() < 0.6 else []
    case["stage"] = [{"name": "form", "static": {"method": "force_density"}}, *built, *stages]
    if chance.random() < 0.3:  # load cases start from the net
        del case["stage"][1 + len(built) :]


def draw_load_cases(chance: random.Random, case: dict[str, Any], scale: Scale) -> None:
    """Load cases and combinations, from the last stage or from what is permanent in a case without stages."""
    rest = {"method": "newton", "step": chance.choice((0.5, 1.0)), "min_step": 0.01}
    if chance.random() < 0.3 and case["stage"][0]["name"] != "form":
        del case["stage"]
        case["static"] = rest
        case.pop("initial", None)
    elif "static" not in case["stage"][-1]:
        case["stage"].append({"name": "rest", "static": rest})
    for table in (case, *case.get("stage", ())):
        table.pop("wind", None)
    case["load_case"] = [_load_case(chance, case, scale, f"lc{k}") for k in range(chance.randint(1, 3))]
    names, combined = [row["name"] for row in case["load_case"]], []
    if chance.random() < 0.6:
        combined.append({"name": "same", "factors": {chance.choice(names): 1.0}})
    for k in range(chance.randint(0, 2)):
        factors: dict[str, float] = {}
        there: set[str] = set()
        for row in case["load_case"]:
            alone = {key for key in ALONE if key in row}
            if chance.random() < 0.2 or (alone & there and chance.random() > ODD):
                continue
            factors[row["name"]] = chance.choice((1.35, 1.5, 0.5, 0.0) + ((-1.0,) if "wind" not in row else ()))
            there |= alone
        if factors:
            combined.append({"name": f"co{k}", "factors": factors})
    if combined:
        case["combination"] = combined


def _load_case(chance: random.Random, case: dict[str, Any], scale: Scale, name: str) -> dict[str, Any]:
    hot = any(material.get("thermal_expansion") for material in case["material"].values())
    kinds = ["load", "load", "gravity", "support", "wind", *(["temperature"] * 2 if hot else [])]
    row: dict[str, Any] = {"name": name}
    for kind in set(chance.sample(sorted(kinds), chance.randint(1, 3))):
        row[kind] = _TABLES[kind](chance, scale)
    return row


def _load(chance: random.Random, scale: Scale) -> list[dict[str, Any]]:
    load = {"node_set": chance.choice(("one", "top")), "force": vector(chance, scale.force * chance.uniform(0.1, 0.8))}
    if chance.random() < 0.3:
        load |= {"table": [[0.2, 0.3], [0.6, chance.uniform(-1.0, 1.5)]], "interpolation": "smooth"}
    return [load]


def _support(chance: random.Random, scale: Scale) -> list[dict[str, Any]]:
    way = vector(chance, scale.strain * scale.length * chance.uniform(0.3, 3.0))
    support = {"node_set": "left", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [chance.uniform(0.3, 1.0), *way]]}
    return [support | ({"name": "base"} if chance.random() < 0.7 else {})]


def _temperature(chance: random.Random, scale: Scale) -> list[dict[str, Any]]:
    value = chance.uniform(-20.0, 30.0)
    heat = {"value": value} if chance.random() < 0.6 else {"table": [[0.1, 0.3 * value], [0.7, value]]}
    return [heat | ({"bars": "some"} if chance.random() < 0.3 else {})]


_TABLES = {
    "load": _load,
    "gravity": lambda chance, scale: {"acceleration": vector(chance, 1.0)},
    "support": _support,
    "temperature": _temperature,
    "wind": lambda chance, scale: {"velocity": vector(chance, 5.0), "density": chance.uniform(0.1, 0.5)},
}


def draw_changes(seed: int, case: dict[str, Any], scale: Scale, ends: list[float]) -> None:
    """Change a case of stages, each kind of change by a chance of its own."""
    chances = {name: random.Random(f"{name} {seed}") for name in SHARES}
    drawn = {name for name, share in SHARES.items() if chances[name].random() <= share}
    if "velocity" in drawn:
        for table, end in zip((case, *case["stage"][1:]), ends, strict=True):
            for support in table.get("support", ()):
                if chances["velocity"].random() < 0.6:
                    by_velocity(chances["velocity"], support, scale.strain * scale.length / end, end)
    if "form" in drawn:
        draw_form(chances["form"], case, scale)
    if "load cases" in drawn:
        draw_load_cases(chances["load cases"], case, scale)
    mesh = case["mesh"]
    body = Body(case, np.array(mesh["points"]), np.array(mesh["bars"]), mesh["node_groups"], limit=2.0 * scale.step)
    motion = Motion(np.zeros(3), scale.speed, 1, scale.step, ends[0])
    for name, change in (("damping", draw_damping), ("fields", draw_fields), ("sections", draw_sections)):
        if name in drawn:
            change(chances[name], case, body, motion)


SHARES = {"velocity": 0.2, "form": 0.2, "load cases": 0.45, "damping": 0.2, "fields": 0.2, "sections": 0.4}
"""Shares of the cases of stages with each kind of change."""
