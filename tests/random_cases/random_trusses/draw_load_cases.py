"""Forms found by force densities before the stages of a case, and load cases with combinations after them."""

from __future__ import annotations

import random
from typing import Any

from .draw import ODD, STRESSING, Body, Motion, by_velocity, draw_damping, draw_fields, draw_sections, vector


def draw_form(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Find the form of the net first, with nodes that hold it; what forms cannot have comes after it."""
    mesh, stages = case["mesh"], case["stage"]
    mesh["node_groups"]["pegs"] = [6, 7, 8, 9] if len(mesh["points"]) > 8 else [6, 7]
    case["node_set"]["pegs"] = {"group": "pegs"}
    held = any(support["name"] == "base2" and support["fix"] == "x" for support in case["support"])
    case["support"].append({"name": "pegs", "node_set": "pegs", "fix": "yz" if held else "xyz"})
    stages[0] |= {key: case.pop(key) for key in ("initial", "wall", "temperature", "remove") if key in case}
    for key in ("spring", "dashpot", "contact_pair"):
        case.pop(key, None)
    for name, section in case["section"].items():
        forces = (
            ("pretension", "pretension_field") if "bars" in section else ()
        )  # where most bars have one, some shrink
        key = chance.choice(("force_density", "force_density", "force_density_field", *forces))
        size = (
            body.stiffness
            * 1e-3
            * section["area"]
            / 1e-3
            * chance.uniform(0.2, 0.8)
            / (0.9 if key.startswith("force") else 1.0)
        )
        if key.endswith("_field"):
            mesh.setdefault("bar_fields", {})[name] = [size * chance.uniform(0.6, 1.0) for _ in mesh["bars"]]
        kept = {of: value for of, value in section.items() if of not in STRESSING}
        case["section"][name] = kept | {key: name if key.endswith("_field") else size}
    built = [{"name": "built", "static": {"method": "newton", "step": 0.5}}] if chance.random() < 0.6 else []
    later = stages if chance.random() < 0.7 else []  # load cases may start from the net
    case["stage"] = [{"name": "form", "static": {"method": "force_density"}}, *built, *later]


def draw_load_cases(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
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
    case["load_case"] = [_load_case(chance, case, 1e-3 * body.stiffness, f"lc{k}") for k in range(chance.randint(1, 3))]
    names = [row["name"] for row in case["load_case"]]
    combined = [{"name": "same", "factors": {chance.choice(names): 1.0}}] if chance.random() < 0.6 else []
    for k in range(chance.randint(0, 2)):
        taken = {name: row for name, row in zip(names, case["load_case"], strict=True) if chance.random() < 0.8}
        if chance.random() > ODD:  # at most one of what is not added
            for key in ("wind", "temperature", "support"):
                others = [name for name, row in taken.items() if key in row][1:]
                taken = {name: row for name, row in taken.items() if name not in others}
        signs = {name: (1.0,) if "wind" in row else (1.0, 1.0, 1.0, -1.0) for name, row in taken.items()}
        factors = {name: chance.choice((1.35, 1.0, 0.5, 0.0)) * chance.choice(signs[name]) for name in taken}
        combined += [{"name": f"co{k}", "factors": factors}] if factors else []
    case |= {"combination": combined} if combined else {}


def _load_case(chance: random.Random, case: dict[str, Any], size: float, name: str) -> dict[str, Any]:
    hot = any(material.get("thermal_expansion") for material in case["material"].values())
    kinds = ["load", "load", "gravity", "support", "wind", *(["temperature"] * 2 if hot else [])]
    force, way, heat = (
        vector(chance, size * chance.uniform(0.1, 0.8)),
        vector(chance, 2e-3),
        chance.uniform(-20.0, 30.0),
    )
    over = {"table": [[0.2, 0.3], [0.6, chance.uniform(-1.0, 1.5)]], "interpolation": "smooth"}
    load = {"node_set": chance.choice(("one", "top")), "force": force}
    support = {"node_set": "left", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [chance.uniform(0.3, 1.0), *way]]}
    hot_bars = {"value": heat} if chance.random() < 0.6 else {"table": [[0.1, 0.3 * heat], [0.7, heat]]}
    tables = {
        "load": [load | (over if chance.random() < 0.3 else {})],
        "gravity": {"acceleration": vector(chance, 1.0)},
        "support": [support | ({"name": "base"} if chance.random() < 0.7 else {})],
        "temperature": [hot_bars | ({"bars": "some"} if chance.random() < 0.3 else {})],
        "wind": {"velocity": vector(chance, 5.0), "density": chance.uniform(0.1, 0.5)},
    }
    return {"name": name, **{kind: tables[kind] for kind in chance.sample(kinds, chance.randint(1, 3))}}


def draw_records(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Move supports of stages by records of velocity."""
    for k, stage in enumerate(case["stage"]):
        for support in (stage if k else case).get("support", ()):
            by_velocity(chance, support, 1e-3, stage.get("time", {"end": 1.0})["end"])


CHANGES = (
    ("records", 0.15, draw_records),
    ("form", 0.2, draw_form),
    ("load cases", 0.45, draw_load_cases),
    ("damping", 0.2, draw_damping),
    ("fields", 0.2, draw_fields),
    ("sections", 0.4, draw_sections),
)
"""What some cases of stages have besides, as in ``draw.CHANGES``."""
