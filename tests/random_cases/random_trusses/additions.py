"""What is added to a drawn case, each with random numbers of its own, so that the other parts stay as they are.

Rest lengths, laws of bars, loads over time, damping, rupture, masses of nodes, inclined supports, springs and dashpots.
"""

from __future__ import annotations

import math
import random
from typing import Any

import numpy as np

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


LAWS = ("voce", "ludwik", "ramberg_osgood", "multilinear", "cowper_symonds", "perzyna", "johnson_cook")
HARDENING = ("isotropic_hardening", "kinematic_hardening")


def draw_laws(chance: random.Random, case: dict[str, Any], end: float) -> None:
    """Change the law of a material or let it soften, drawn on its own so that other cases stay as they are."""
    if chance.random() > 0.12:
        return
    table = case["material"][chance.choice(sorted(case["material"]))]
    if "law" in table:  # drawn elsewhere
        return
    if "temperature" not in case and chance.random() < 0.3:
        case["temperature"] = [{"table": [[0.0, 0.0], [end * chance.uniform(0.1, 1.0), chance.uniform(-60.0, 60.0)]]}]
    softens = "temperature" in case and chance.random() < 0.7
    if not softens or chance.random() < 0.5:
        name = chance.choice(LAWS)
        yields = table.pop("yield_stress", None) or table["young_modulus"] * 10 ** chance.uniform(-3, -1.7)
        for key in HARDENING:
            table.pop(key, None)
        table |= {"law": name, **_law_keys(chance, name, table, yields)}
        softens = softens and name != "johnson_cook"
    yields = table.get("law") or "yield_stress" in table
    if softens and not (yields and case["time"]["integrator"] == "energy_momentum"):
        rows = sorted(chance.uniform(-60.0, 60.0) for _ in range(chance.randint(1, 4)))
        table["softening"] = [[row, chance.uniform(0.3, 1.0), chance.uniform(0.3, 1.1)] for row in rows]


def _law_keys(chance: random.Random, name: str, table: dict[str, Any], yields: float) -> dict[str, Any]:
    young = table["young_modulus"]
    power = {"strength_coefficient": yields * chance.uniform(0.5, 5.0), "hardening_exponent": chance.uniform(0.05, 1.0)}
    if name == "ramberg_osgood":
        return {"proof_stress": yields, "exponent": chance.uniform(1.0, 20.0)}
    if name == "multilinear":
        rows, stress, plastic = [[yields / young, yields]], yields, 0.0
        for _ in range(chance.randint(0, 4)):
            stress, plastic = stress + yields * chance.uniform(0.0, 0.3), plastic + chance.uniform(1e-3, 0.02)
            rows.append([plastic + stress / young, stress])
        return {"curve": rows}
    if name == "ludwik":
        return {"yield_stress": yields, **power}
    rate = 10 ** chance.uniform(-2, 3)
    if name == "johnson_cook":
        heating = {"melting_temperature": chance.uniform(100.0, 1500.0), "thermal_exponent": chance.uniform(0.5, 1.5)}
        if chance.random() < 0.6:  # so that a plastic strain of one heats by about the melting temperature
            heating["specific_heat"] = yields / (table["density"] * heating["melting_temperature"])
        rates = {"rate_coefficient": chance.uniform(0.0, 0.1), "rate_reference": rate}
        return {"yield_stress": yields, **power, **rates, **heating}
    keys = {"yield_stress": yields, "saturation_stress": yields * chance.uniform(0.0, 2.0)}
    keys |= {"saturation_rate": 10 ** chance.uniform(0, 2.5)}
    for key in HARDENING:
        if chance.random() < 0.5:
            keys[key] = young * 10 ** chance.uniform(-3, -0.3)
    if name == "cowper_symonds":
        keys |= {"rate_reference": rate, "rate_exponent": chance.uniform(1.0, 8.0)}
    if name == "perzyna":
        keys |= {"fluidity": rate, "overstress_exponent": chance.uniform(1.0, 8.0)}
    return keys


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
