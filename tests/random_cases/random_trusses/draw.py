"""Draws a valid case by its number, over the documented keys and their combinations.

Bodies are aimed at walls so that they hit them within the run. Combinations that the documentation excludes are not
drawn, except in a few percent of the cases, which must be refused with a message.
"""

from __future__ import annotations

import importlib
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from pfem_petsc.mesh.slab import MeshSlab

ODD = 0.03
"""Fraction of the cases in which a rule of combination is violated on purpose."""


def vector(chance: random.Random, length: float) -> np.ndarray:
    """Return a vector (3,) of this length in a random direction."""
    vector = np.array([chance.gauss(0, 1) for _ in range(3)])
    return length * vector / np.linalg.norm(vector)


def draw_prestress(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Prescribe rest lengths of a section."""
    section = case["section"][chance.choice(sorted(case["section"]))]
    material, key = case["material"][section["material"]], chance.choice(STRESSING)
    unit = {"pretension": section["area"], "prestress": 1.0, "force_density": section["area"] / body.size}

    def value() -> float:
        strain = _strains(chance, material, 1)[0]
        return material["young_modulus"] * strain * unit[key] if key in unit else 1.0 - strain

    rows = sorted(chance.random() for _ in range(chance.randint(1, 4)))
    section[key] = value() if chance.random() < 0.4 else [[row * motion.end, value()] for row in rows]


def draw_bar_law(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Replace the law of a material."""
    name = chance.choice(sorted(case["material"]))
    table = {key: value for key, value in case["material"][name].items() if not key.endswith(("_hardening", "_stress"))}
    young, law = table["young_modulus"], chance.choice(("cable", "strut", "strut", "damage", "compaction"))
    table["law"], strong = law, young * 10 ** chance.uniform(-3, -1.7)
    if law == "damage":
        energy = 0.5 * strong**2 / young * (1.8 * body.size) * 10 ** chance.uniform(0.05, 1.0)
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
            length = chance.choice((1.0, 0.7, 0.5))
            if law != "cable":  # refused where no bar of the section is checked for buckling
                section["effective_length"] = length


def draw_loads_over_time(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Wind, gravity over time and smooth tables."""

    def rows(values: Any) -> list[list[float]]:
        times = sorted(chance.random() for _ in range(chance.randint(1, 5)))
        return [[t * motion.end, *(chance.uniform(-1.0, 1.0) * np.array(values))] for t in times]

    smooth = {"interpolation": "smooth"} if chance.random() < 0.5 else {}
    if not any(wall.get("gravity") for wall in case.get("wall", ())) and chance.random() < 0.5:
        strength = motion.speed / motion.end * vector(chance, chance.uniform(0.1, 2.0))
        case["gravity"] = {"acceleration": rows(strength), **smooth}
    for load in case.get("load", ()):
        load |= smooth if "table" in load else {}
    # nodes without mass cannot follow wind, which is refused
    massless = case.get("contact", {}).get("treatment") == "mass_redistribution" and chance.random() > ODD
    if ("gravity" not in case or chance.random() < 0.6) and not massless:
        wind = motion.speed * vector(chance, chance.uniform(0.3, 1.5))
        # drag that stops the lightest bars at twice the motion.speed of the body in some part of the run
        section = min(case["section"].values(), key=lambda s: case["material"][s["material"]]["density"] * s["area"])
        line = case["material"][section["material"]]["density"] * section["area"]
        widest = max(2.0 * np.sqrt(s["area"] / np.pi) for s in case["section"].values())
        density = chance.uniform(0.02, 0.8) * line / (1.2 * widest * 2.0 * motion.speed * motion.end)
        steady = chance.random() < 0.4
        case["wind"] = {"velocity": wind if steady else rows(wind), "density": density, **({} if steady else smooth)}
        if chance.random() < 0.3:
            section["drag_coefficient"] = chance.uniform(0.0, 1.2)


def draw_stiffness_damping(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Damp a material in proportion to its stiffness; rest lengths that change exclude it."""
    if any(isinstance(value, list) for s in case["section"].values() for value in s.values()):
        return
    material = case["material"][chance.choice(sorted(case["material"]))]
    material["stiffness_damping"] = body.limit * 10 ** chance.uniform(-3.0, -1.0)


LAWS = ("voce", "ludwik", "ramberg_osgood", "multilinear", "cowper_symonds", "perzyna", "johnson_cook")
HARDENING = ("isotropic_hardening", "kinematic_hardening")


def draw_laws(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Change the law of a material or let it soften."""
    table = case["material"][chance.choice(sorted(case["material"]))]
    if "law" in table:  # drawn elsewhere
        return
    if "temperature" not in case and chance.random() < 0.3:
        rows = [[0.0, 0.0], [motion.end * chance.uniform(0.1, 1.0), chance.uniform(-60.0, 60.0)]]
        case["temperature"] = [{"table": rows}]
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


def draw_rupture(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Let bars break, or remove a support."""
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
        removal = {"supports": "held", "time": chance.uniform(0.0, 1.0) * motion.end}
        case["remove"] = [removal | ({"duration": 0.3 * motion.end} if chance.random() < 0.5 else {})]


def _largest(case: dict[str, Any], body: Body) -> tuple[float, float]:
    """Largest stiffness [N/m] and mass [kg] of a bar of the size of the truss."""
    sections = [(section["area"], case["material"][section["material"]]) for section in case["section"].values()]
    stiffness = max(area * material["young_modulus"] for area, material in sections) / body.size
    return stiffness, max(area * material["density"] for area, material in sections) * body.size


def draw_points(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Give nodes masses, springs and dashpots; a mass is a part of that of a bar of the size of the truss."""
    stiffness, bar = _largest(case, body)
    if bar and math.isfinite(bar) and chance.random() < 0.15:
        node_sets = [chance.choice(sorted(case["node_set"])) for _ in range(chance.randint(1, 2))]
        case["mass"] = [{"node_set": name, "value": bar * 10 ** chance.uniform(-2, 1)} for name in node_sets]
    if any("damping" in material for material in case["material"].values()) and chance.random() < 0.3:
        end = case["time"]["end"]
        case["time"]["damping_table"] = [[0.0, chance.uniform(0.0, 2.0)], [chance.uniform(0.1, 1.0) * end, 0.0]]
    if case.get("contact", {}).get("treatment") == "mass_redistribution":
        return  # refuses both
    if stiffness and math.isfinite(stiffness) and chance.random() < 0.15:
        parts = [stiffness * 10 ** chance.uniform(-3, 1) if chance.random() < 0.7 else 0.0 for _ in range(3)]
        case["spring"] = [{"node_set": chance.choice(sorted(case["node_set"])), "stiffness": parts}]
    if stiffness and math.isfinite(stiffness) and chance.random() < 0.1:
        coefficient = 10 ** chance.uniform(-3, -0.5) * math.sqrt(stiffness * bar)
        case["dashpot"] = [{"node_set": chance.choice(sorted(case["node_set"])), "coefficient": coefficient}]
    if "spring" in case and chance.random() < 0.5:
        case["spring"][0]["frame"] = [[chance.uniform(-1.0, 1.0) for _ in range(3)] for _ in range(2)]


def draw_inclined(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Turn supports, or add a roller."""
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


def draw_rubbing_pairs(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Let pairs rub, and in explicit steps rebound, and the walls beside them as well."""
    time, smooth, leaps = case["time"], True, False
    scheme = case.get("contact", {}).get("treatment", "scheme") == "scheme"
    explicit = time["integrator"] in EXPLICIT and time.get("mass") != "consistent" and scheme
    for pair in case.get("contact_pair", ()):
        if scheme and chance.random() < 0.7:
            pair["friction"], smooth = chance.choice((0.1, 0.3, 0.6)), False
            if chance.random() < 0.3:
                pair["static_friction"] = pair["friction"] * chance.uniform(1.0, 2.0)
        leaps = explicit and time["integrator"] == "central_differences"
        jumps = smooth and not case.get("wall") and time.get("mass") != "consistent"
        if chance.random() < 0.4 and (
            leaps or (jumps and time["integrator"] not in ("noh_bathe", "central_differences"))
        ):
            pair["restitution"] = chance.choice((0.3, 0.8, 1.0))
    for wall in case.get("wall", ()) if case.get("contact_pair") and scheme else ():
        if "mass" not in wall and not wall.get("tied"):
            wall |= {"friction": chance.choice((0.0, 0.2, 0.5))} if "friction" not in wall else {}
            wall |= {"restitution": chance.choice((0.0, 0.6))} if leaps and "restitution" not in wall else {}


def draw_connectors(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Connect nodes."""
    stiffness, bar = _largest(case, body)
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


PROFILES, RECORD = (str(Path(__file__).resolve().parent / name) for name in ("profiles.csv", "record.csv"))
NAMES = [line.split(",")[0] for line in Path(PROFILES).read_text().splitlines()[1:]]
SHAPES = ("round", "tube", "angle", "box", "I", "channel")
STRESSING = ("pretension", "prestress", "rest_length", "force_density")


def closed_area(shape: str, sizes: dict[str, float]) -> float:
    """Area of a shape by its sizes."""
    d, b, t = (sizes.get(key, 0.0) for key in ("diameter", "width", "thickness"))
    h, w = sizes.get("height", b), sizes.get("web_thickness", t)
    solid = {"round": 0.25 * math.pi * d * d, "tube": math.pi * t * (d - t), "angle": t * (b + h - t)}
    return (solid | {"box": 2.0 * t * (b + h - 2.0 * t)}).get(shape, 2.0 * b * t + (h - 2.0 * t) * w)


def draw_sections(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Give sections a shape by sizes of about the same area, or a profile of a catalogue."""
    for section in case["section"].values():
        if chance.random() < 0.2 or {"shape", "second_moment", "area_field"} & set(section):
            continue
        area, shape = section.pop("area"), chance.choice(SHAPES)
        alike = "time" not in case or len(case["section"]) == 1
        if chance.random() < 0.25 and alike and not {"pretension", "force_density"} & set(section):
            section |= {"catalogue": PROFILES, "profile": chance.choice(NAMES)}
            continue
        more = {"thickness": 1.0, "height": 0.5, "web_thickness": 0.5}
        allowed = {"round": 0, "tube": 1, "angle": 2, "box": 2}.get(shape, 3)
        sizes = {"diameter" if allowed < 2 else "width": 1.0}
        for key in [key for key in list(more)[:allowed] if chance.random() < more[key]]:
            sizes[key] = chance.uniform(0.7, 1.5) if key == "height" else chance.uniform(0.04, 0.3)
        scale = math.sqrt(area / closed_area(shape, sizes))
        section |= {"shape": shape, **{key: scale * size for key, size in sizes.items()}}
        if chance.random() < 0.3:  # the area in the place of a size
            section["area"] = area
            del section[chance.choice([key for key in ("diameter", "thickness") if key in section])]
        if chance.random() < 0.3 and case["material"][section["material"]].get("law") != "cable":
            section["effective_length"] = 0.8


def draw_fields(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Give the bars of a section an area and a prestress each."""
    if any(key.removesuffix("_field") in STRESSING for section in case["section"].values() for key in section):
        return
    section, count = case["section"][chance.choice(sorted(case["section"]))], len(body.bars)
    material, steps = case["material"][section["material"]], case.get("time", {"step": "auto"})
    fields: dict[str, Any] = {}
    sizes, fits = np.full(count, section["area"]), steps["step"] == "auto" or steps["integrator"] not in EXPLICIT
    if section.get("shape", "round") == "round" and "second_moment" not in section and fits and chance.random() < 0.5:
        sizes *= [chance.uniform(0.7, 1.4) for _ in body.bars]
        section["area_field"], fields["sizes"] = "sizes", sizes
        del section["area"]
    if "area" in section or chance.random() < 0.7:
        key, strains = chance.choice(("pretension", "rest_length", "force_density")), _strains(chance, material, count)
        lengths = np.linalg.norm(body.points[body.bars[:, 1]] - body.points[body.bars[:, 0]], axis=1)
        force = material["young_modulus"] * sizes * strains
        fields[key] = {"pretension": force, "rest_length": 1.0 - strains, "force_density": force / lengths}[key]
        section[f"{key}_field"] = key
    if case["mesh"]["generator"] != "arrays":
        groups = {"node_groups": body.node_groups, "bar_groups": body.bar_groups}
        case["mesh"] = {"generator": "arrays", "points": body.points, "bars": body.bars, **groups}
        if case.get("solver", {}).get("linear") == "multigrid":  # of generated lattices
            case["solver"]["linear"] = "auto"
    case["mesh"]["bar_fields"] = fields


def _strains(chance: random.Random, material: dict[str, Any], count: int) -> np.ndarray:
    """Strains that a material bears."""
    young = material["young_modulus"]
    strong = [material.get(key, young) for key in ("yield_stress", "tensile_strength", "proof_stress")]
    most = min(3e-3, 0.9 * min(strong) / young, 0.9 * material.get("curve", [[1.0]])[0][0])
    least = 0.0 if material.get("law") == "cable" else -1.0  # cables are not pressed
    return np.array([most * chance.uniform(least, 1.0) for _ in range(count)])


def draw_damping(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Damp the whole truss by a ratio at one or two frequencies, or nodal masses alone."""
    highest, ratio = 1.0 / (math.pi * body.limit), 10 ** chance.uniform(-3, -1)
    frequencies = sorted(highest * 10 ** chance.uniform(-2, -0.3) for _ in range(chance.randint(1, 2)))
    if case.get("mass") and chance.random() < 0.5:
        case["mass"][0]["damping"] = 2.0 * math.pi * ratio * frequencies[0]
        if chance.random() < 0.4:
            return
    for name, material in case["material"].items():
        case["material"][name] = {key: value for key, value in material.items() if not key.endswith("damping")}
    if case.get("time", {"step": "auto"})["step"] != "auto":  # the critical step stays about the same
        ratio = min(ratio, 0.02 * math.pi * body.limit * (frequencies[0] + frequencies[-1]))
    case["damping"] = {"ratio": ratio, "frequencies": frequencies}


def draw_velocities(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Move supports by records of velocity."""
    for support in case.get("support", ()):
        by_velocity(chance, support, motion.end * motion.speed * chance.uniform(-0.4, 0.4), motion.end)


def by_velocity(chance: random.Random, support: dict[str, Any], way: float, end: float) -> None:
    """Move a support by some way, with rows of velocity or a file that has them."""
    for key in ("motion", "velocity", "interpolation"):
        support.pop(key, None)
    moves = ["frame" in support or axis in support.get("fix", "xyz") for axis in "xyz"]
    columns = ["t", *(name if moved else "" for name, moved in zip(("vx", "vy", "vz"), moves, strict=True))]
    times = sorted(chance.uniform(0.0, 1.0) for _ in range(chance.randint(1, 4)))
    rows = [[t * end, *(way / end * chance.uniform(-1.0, 1.0) * moved for moved in moves)] for t in times]
    file = {"file": RECORD, "columns": columns, "scale": way / end, "time_scale": end}
    support |= {"velocity_file": file} if chance.random() < 0.4 else {"velocity": rows}


CELLS = ((1, 1, 1), (2, 1, 1), (1, 2, 1), (1, 1, 2), (2, 2, 1), (2, 1, 2), (1, 2, 2), (3, 1, 1))
PLAIN_KINDS = ("cubic", "octet", "bcc")
OPEN_KINDS = ("fcc", "bcc_diagonals", "kelvin", "diamond", "gyroid", "auxetic", "tetrahedral_octahedral")


@dataclass
class Body:
    """A truss at rest.

    Attributes
    ----------
    tables : the tables mesh, material, section and, where bars are heated, temperature
    points : (nodes, 3) [m]
    bars : (bars, 2)
    node_groups : of the mesh
    limit : estimate of the stable step of central differences with lumped mass [s]
    wave : speed of waves in the fastest material [m/s]
    length : of the shortest bar [m]
    size : largest extent [m]
    mass : of the truss [kg]
    stiffness : largest young_modulus times area [N]
    """

    tables: dict[str, Any]
    points: np.ndarray
    bars: np.ndarray
    node_groups: dict[str, np.ndarray]
    limit: float = 0.0
    wave: float = 0.0
    length: float = 0.0
    size: float = 0.0
    mass: float = 0.0
    stiffness: float = 0.0
    bar_groups: dict[str, np.ndarray] = field(default_factory=dict)


def draw_body(chance: random.Random) -> Body:
    """A mesh of a generator with materials and sections."""
    table = _mesh(chance)
    plain = dict(table)
    if table["generator"] == "lattice":
        table |= _varied(table)
    slab = generated(table)
    groups = {name: members for name, members in slab.node_groups.items() if len(members)}
    body = Body({"mesh": table}, slab.points, np.asarray(slab.bars), groups)
    if table["generator"] != "lattice" or table != plain:
        body.bar_groups = {name: members for name, members in slab.bar_groups.items() if len(members)}
    vectors = body.points[body.bars[:, 1]] - body.points[body.bars[:, 0]]
    lengths = np.linalg.norm(vectors, axis=1)
    body.length = float(lengths.min())
    body.size = float(np.ptp(body.points, axis=0).max())
    materials = {"m0": _material(chance, body.size)}
    sections: dict[str, Any] = {"s0": {"area": 10 ** chance.uniform(-4, -2), "material": "m0"}}
    stiffness = np.full(len(lengths), materials["m0"]["young_modulus"] * sections["s0"]["area"])
    weight = np.full(len(lengths), materials["m0"]["density"] * sections["s0"]["area"])
    if len(body.bar_groups) > 1 and chance.random() < 0.4:
        group = chance.choice(sorted(body.bar_groups))
        name = "m0"
        if chance.random() < 0.5:
            name, materials["m1"] = "m1", _material(chance, body.size)
        sections["s1"] = {"area": 10 ** chance.uniform(-4, -2), "material": name, "bars": group}
        members = body.bar_groups[group]
        stiffness[members] = materials[name]["young_modulus"] * sections["s1"]["area"]
        weight[members] = materials[name]["density"] * sections["s1"]["area"]
    body.tables |= {"material": materials, "section": sections}
    body.wave = float(np.sqrt((stiffness / weight).max()))
    body.mass = float((weight * lengths).sum())
    body.stiffness = float(stiffness.max())
    body.limit = _limit(body, vectors, lengths, stiffness, weight)
    if chance.random() < 0.15:
        body.tables["temperature"] = [_temperature(chance, body)]
    return body


def _mesh(chance: random.Random) -> dict[str, Any]:
    kind = chance.choices(("rod", "two_rods", "ring", "lattice"), (25, 18, 22, 35))[0]
    if kind == "rod":
        return {"generator": "rod", "length": chance.uniform(0.5, 2.0), "elements": chance.randint(1, 20)}
    if kind == "two_rods":
        length = chance.uniform(0.5, 1.5)
        gap = length * 10 ** chance.uniform(-3, -1.3)
        return {"generator": kind, "length": length, "elements": chance.randint(1, 9), "gap": gap}
    if kind == "ring":
        outer = chance.uniform(0.5, 2.0)
        return {
            "generator": "ring",
            "outer_radius": outer,
            "inner_radius": outer * chance.uniform(0.6, 0.9),
            "bays": chance.randint(3, 10),
            "bracing": chance.choice(("x", "single")),
            "orientation": chance.choice(("vertex", "flat")),
        }
    cells, shape = chance.choice(CELLS), chance.choice(PLAIN_KINDS)
    return {"generator": "lattice", "kind": shape, "cells": cells, "pitch": chance.uniform(0.1, 0.5)}


def generated(table: dict[str, Any]) -> MeshSlab:
    """Return the whole mesh of a table ``[mesh]``."""
    module = importlib.import_module(f"pfem_petsc.mesh.generators.{table['generator']}")
    keys = module.Parameters(**{key: value for key, value in table.items() if key != "generator"})
    if hasattr(module, "generate_on"):
        return module.generate_on(keys, MPI.COMM_SELF, {}, None)
    return module.generate(keys, 0, 1)


def _varied(table: dict[str, Any]) -> dict[str, Any]:
    """Return other keys of a quarter of the lattices, by a chance of their own: other cases stay as they were."""
    chance = random.Random(repr(table))
    if chance.random() < 0.75:
        return {}
    keys: dict[str, Any] = {}
    if chance.random() < 0.7:
        keys["kind"] = chance.choice(OPEN_KINDS)
    if chance.random() < 0.4:
        keys["perturbation"] = chance.uniform(0.005, 0.04)
    if chance.random() < 0.3:
        keys |= {"missing": chance.uniform(0.02, 0.15), "dangling": "keep"}
    if chance.random() < 0.3:
        factor = chance.uniform(0.5, 2.0)
        keys["grading"] = chance.choice(([1, 1, factor], [1, f"1 + {factor:.3g}*y", 1]))
    elif chance.random() < 0.2:
        keys["curved"] = {"shape": chance.choice(("cylinder", "sphere")), "radius": chance.uniform(3.0, 5.0)}
    return keys


def _material(chance: random.Random, size: float) -> dict[str, Any]:
    young, density = 10 ** chance.uniform(5, 8), 10 ** chance.uniform(2.5, 4)
    table: dict[str, Any] = {"young_modulus": young, "density": density}
    table["strain"] = chance.choices(("engineering", "green", "logarithmic"), (2, 1, 1))[0]
    if chance.random() < 0.3:
        table["yield_stress"] = young * 10 ** chance.uniform(-3, -1.7)
        hardening = chance.choice(((1,), (0,), (1, 0), (0, 1), (1, 0)))
        for key, used in zip(("isotropic_hardening", "kinematic_hardening"), (*hardening, 1), strict=False):
            if used:
                table[key] = young * 10 ** chance.uniform(-2, -0.3)
    if chance.random() < 0.25:
        table["damping"] = density * np.sqrt(young / density) / size * 10 ** chance.uniform(-2, 0)
    if chance.random() < 0.4:
        table["thermal_expansion"] = chance.choice((1, 1, -1)) * 10 ** chance.uniform(-6, -4)
    return {key: value if isinstance(value, str) else float(value) for key, value in table.items()}


def _limit(body: Body, vectors: np.ndarray, lengths: np.ndarray, stiffness: np.ndarray, weight: np.ndarray) -> float:
    """2 / omega of the highest mode with lumped mass, from the dense matrices."""
    n = len(body.points)
    mass, matrix = np.zeros(n), np.zeros((n, 3, n, 3))
    for (i, j), vector, length, ea, w in zip(body.bars, vectors, lengths, stiffness, weight, strict=True):
        block = ea / length**3 * np.outer(vector, vector)
        mass[[i, j]] += 0.5 * w * length
        matrix[i, :, i] += block
        matrix[j, :, j] += block
        matrix[i, :, j] -= block
        matrix[j, :, i] -= block
    root = 1.0 / np.sqrt(np.repeat(mass, 3))
    scaled = matrix.reshape(3 * n, 3 * n) * root[:, None] * root[None, :]
    return float(2.0 / np.sqrt(np.linalg.eigvalsh(scaled)[-1]))


def _temperature(chance: random.Random, body: Body) -> dict[str, Any]:
    table: dict[str, Any] = {}
    if body.bar_groups and chance.random() < 0.5:
        table["bars"] = chance.choice(sorted(body.bar_groups))
    if chance.random() < 0.4:
        return {**table, "value": chance.uniform(-60.0, 60.0)}
    # rows over the duration, which is not known yet: fractions of it
    rows = sorted(chance.random() for _ in range(chance.randint(1, 4)))
    return {**table, "table": [[row, chance.uniform(-60.0, 60.0)] for row in rows]}


def draw_walls(
    chance: random.Random,
    body: Body,
    motion: Any,
    sets: dict[str, Any],
    treatment: str,
    time: dict[str, Any],
    pair: dict[str, Any] | None,
) -> list[dict[str, Any]]:
    """Return tables of zero to three walls; the first ones are in the path of the body."""
    count = chance.choices((0, 1, 2, 3), (5, 55, 28, 12) if pair is None else (40, 45, 15, 0))[0]
    if treatment == "mass_redistribution":
        count = min(count, 1) or 1
    walls = []
    for k in range(count):
        aimed = k == 0 or chance.random() < 0.4
        name, members = _members(chance, body, motion, sets, treatment, pair)
        simple = pair is not None and chance.random() > ODD
        wall: dict[str, Any] = {"name": f"wall {k}" if chance.random() < 0.9 else f"Wand-{k}"}
        if name is not None:
            wall["node_set"] = name
        way = motion.way if aimed else _tilted(chance, motion.way, 2.0)
        if pair is not None and chance.random() < 0.5:
            way = np.array([1.0, 0.0, 0.0])
        tilt = chance.choice((0.0, 0.0, 0.2))
        gap = motion.speed * motion.end * chance.choice((0.0, *(chance.uniform(0.02, 0.6) for _ in range(5))))
        if chance.random() < 0.07:
            # nodes that start beyond the wall
            wall["adjust"], gap = True, -0.02 * body.length * chance.random()
        _shape(chance, wall, body, members, _tilted(chance, way, tilt), gap, simple or treatment[0] == "m")
        _move(chance, wall, body, motion, way, treatment, simple)
        if not simple:
            _law(chance, wall, treatment, time)
        walls.append(wall)
    return walls


def _members(
    chance: random.Random, body: Body, motion: Any, sets: dict[str, Any], treatment: str, pair: Any
) -> tuple[str | None, np.ndarray]:
    """A node set, None for every node, and the positions of its nodes."""
    if pair is not None and chance.random() < 0.7:
        name = chance.choice(("g_start", "g_end") if pair["first"] == "g_first_end" else ("g_bottom", "g_top"))
    elif treatment == "mass_redistribution" or chance.random() < 0.5:
        # the group that is farthest ahead
        ahead = {name: float((body.points[members_of(body, sets[name])] @ motion.way).mean()) for name in sorted(sets)}
        groups = [name for name in ahead if name.startswith("g_")]
        name = max(groups, key=ahead.get) if chance.random() < 0.8 else chance.choice(sorted(sets))
    else:
        return None, body.points
    return name, body.points[members_of(body, sets[name])]


def members_of(mesh: MeshSlab | Body, table: dict[str, Any]) -> np.ndarray:
    """Numbers of the nodes of a node set."""
    points = mesh.points
    if "group" in table:
        return np.asarray(mesh.node_groups[table["group"]])
    if "indices" in table:
        return np.asarray(table["indices"])
    if "nearest" in table:
        return np.array([np.linalg.norm(points - table["nearest"], axis=1).argmin()])
    if "box" in table:
        low, high = np.array(table["box"])
        return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    return np.arange(len(points))


def _shape(
    chance: random.Random,
    wall: dict[str, Any],
    body: Body,
    members: np.ndarray,
    way: np.ndarray,
    gap: float,
    flat: bool,
) -> None:
    """Kind and place: the nearest of the members is ``gap`` [m] before the wall, along ``way``."""
    kind = chance.choices(("plane", "rectangle", "sphere", "cylinder"), (45, 12, 22, 21))[0]
    first = members[(members @ way).argmax()]
    if flat and kind in ("sphere", "cylinder") and chance.random() > ODD:
        kind = "plane"
    wall["type"] = kind
    if kind in ("plane", "rectangle"):
        sideways = np.cross(way, vector(chance, 1.0)) * body.size * (chance.uniform(0, 0.3) if kind == "plane" else 0.1)
        wall |= {"point": first + gap * way + sideways, "normal": -way * chance.choice((1.0, 0.5, 3.0))}
        if kind == "rectangle":
            wall["along"] = np.cross(way, vector(chance, 1.0)) + 0.1 * way
            wall["size"] = [body.size * chance.uniform(0.4, 4.0) for _ in range(2)]
        return
    axis = np.zeros(3)
    if kind == "cylinder":
        axis = np.cross(way, vector(chance, 1.0)) if chance.random() < 0.8 else vector(chance, 1.0)
        axis /= np.linalg.norm(axis)
        wall["axis"] = axis * chance.choice((1.0, 2.0))

    def distance(centre: np.ndarray) -> np.ndarray:
        arm = members - centre
        return np.linalg.norm(arm - np.multiply.outer(arm @ axis, axis), axis=1)

    if chance.random() < 0.4:
        centre = members.mean(axis=0) + 0.2 * gap * way
        wall |= {
            "point": centre,
            "side": "inside",
            "radius": max(float(distance(centre).max()) + gap, 0.0) + 1e-9 * body.size,
        }
        return
    radius = body.size * chance.uniform(0.15, 1.5)
    centre = first + (gap + radius) * way
    for _ in range(200):
        lack = gap + radius - float(distance(centre).min())
        if lack <= 0.0:
            break
        centre = centre + (lack + 1e-9 * body.size) * way
    wall |= {"point": centre, "radius": radius}
    if chance.random() < 0.5:
        wall["side"] = "outside"


def _move(
    chance: random.Random,
    wall: dict[str, Any],
    body: Body,
    motion: Any,
    way: np.ndarray,
    treatment: str,
    simple: bool,
) -> None:
    kind = chance.random()
    towards = -motion.speed * chance.uniform(-0.3, 0.7) * _tilted(chance, way, chance.choice((0.0, 0.3)))
    if kind < 0.15:
        wall["velocity"] = towards
    elif kind < 0.25:
        times = [0.0, *sorted(chance.uniform(0.05, 0.95) for _ in range(chance.randint(1, 3)))]
        factors = [0.0, *(chance.uniform(-0.3, 1.0) * fraction for fraction in times[1:])]
        rows = zip(times, factors, strict=True)
        wall["motion"] = [[t * motion.end, *(f * motion.end * towards)] for t, f in rows]
    elif kind < 0.4 and not simple and (treatment == "scheme" or chance.random() < ODD):
        wall["mass"] = body.mass * 10 ** chance.uniform(-1.0, 1.5)
        if chance.random() < 0.3:
            wall["velocity"] = towards
        if chance.random() < 0.3:
            wall["gravity"] = True


def _law(chance: random.Random, wall: dict[str, Any], treatment: str, time: dict[str, Any]) -> None:
    """Friction, restitution, a tie, or none of them."""
    kind = chance.choices(("smooth", "friction", "restitution", "tied"), (45, 27, 15, 13))[0]
    odd = chance.random() < ODD
    jumps = time["integrator"] != "noh_bathe"  # are known
    if kind == "friction" and (odd or treatment == "scheme" or treatment == "stick" and jumps):
        wall["friction"] = 10 ** chance.uniform(-1.3, 0.3)
        if chance.random() < 0.4:
            wall["static_friction"] = wall["friction"] * chance.uniform(1.0, 1.6)
    solves_next_position = time["integrator"] == "central_differences"
    fits = "mass" not in time and jumps and (treatment == "scheme" or treatment == "stick" and not solves_next_position)
    if kind == "restitution" and (odd or fits and (solves_next_position or "mass" not in wall)):
        wall["restitution"] = chance.choice((0.3, 0.7, 1.0, chance.random()))
        if solves_next_position and chance.random() < 0.2:
            wall["friction"] = 0.3
    if kind == "tied" and (odd or treatment in ("scheme", "stick")):
        wall["tied"] = True


def _tilted(chance: random.Random, way: np.ndarray, amount: float) -> np.ndarray:
    tilted = way + amount * vector(chance, 1.0) if amount else way
    return tilted / np.linalg.norm(tilted)


EXPLICIT = {"central_differences": 2.0, "chung_lee": 1.85, "hulbert_chung": 1.5, "souza_moura": 1.7, "noh_bathe": 3.4}
"""Explicit integrators, with a limit of Omega that is safe for all their parameters without damping."""
IMPLICIT = ("newmark", "houbolt", "wilson", "generalized_alpha", "energy_momentum")
CONSERVING = ("newmark", "houbolt", "energy_momentum")
POINT = ("displacement", "velocity", "acceleration", "contact_force")
CELL = ("strain", "stress", "axial_force", "plastic_strain")


@dataclass
class Motion:
    """Motion of the body: direction (3,), speed [m/s], steps, step and duration [s]."""

    way: np.ndarray
    speed: float
    steps: int
    step: float
    end: float


def draw_case(seed: int, changes: Sequence[tuple[str, float | None, Callable[..., None]]] = ()) -> dict[str, Any]:
    """Return the case of a number as nested tables with the keys of a case file and plain numbers only.

    ``changes``: what is drawn besides, as :data:`CHANGES`, which is the default.
    """
    chance = random.Random(f"truss {seed}")
    body = draw_body(chance)
    time = _time(chance, body)
    motion = _motion(chance, body, time)
    case: dict[str, Any] = {"title": f"random case {seed}", **body.tables}
    case["node_set"] = _node_sets(chance, body)
    case |= _initial(chance, body, motion, case["node_set"])
    treatment = _treatment(chance, time)
    pair = _pair(chance, body, treatment)
    if pair is not None:
        case["contact_pair"] = [pair]
    walls = draw_walls(chance, body, motion, case["node_set"], treatment, time, pair)
    if walls:
        case["wall"] = walls
    case |= _supports(chance, motion, case["node_set"])
    case |= _loads(chance, body, motion, case["node_set"])
    for entry in case.get("temperature", ()):
        if "table" in entry:
            entry["table"] = [[fraction * motion.end, value] for fraction, value in entry["table"]]
    if treatment != "scheme" or chance.random() < 0.2:
        case["contact"] = {"treatment": treatment}
    case["time"] = time
    case["output"] = _output(chance, motion, case["node_set"])
    case |= _solver(chance, time)
    for name, share, change in changes or CHANGES:
        own = random.Random(f"{name} {seed}")
        if share is None or own.random() <= share:
            change(own, case, body, motion)
    return plain(case)


CHANGES = (
    ("bar law", 0.12, draw_bar_law),
    ("laws", 0.12, draw_laws),
    ("prestress", 0.12, draw_prestress),
    ("loads", 0.12, draw_loads_over_time),
    ("stiffness damping", 0.08, draw_stiffness_damping),
    ("rupture", 0.12, draw_rupture),
    ("points", None, draw_points),
    ("inclined", 0.1, draw_inclined),
    ("connectors", 0.08, draw_connectors),
    ("rubbing pairs", 0.7, draw_rubbing_pairs),
    ("velocities", 0.3, draw_velocities),
    ("damping", 0.1, draw_damping),
    ("fields", 0.12, draw_fields),
    ("sections", 0.2, draw_sections),
)
"""What some cases have besides, with its share of them, drawn on its own so that other cases stay as they are."""


def _time(chance: random.Random, body: Body) -> dict[str, Any]:
    explicit = chance.random() < 0.45
    name = chance.choices(tuple(EXPLICIT), (5, 2, 2, 1, 2))[0] if explicit else chance.choice(IMPLICIT)
    time: dict[str, Any] = {"integrator": name}
    if chance.random() < 0.15:
        time["mass"] = "consistent"
    limit = body.limit * (0.55 if "mass" in time else 1.0)
    if explicit:
        steps, safety = chance.randint(40, 100), chance.uniform(0.3, 0.95)
        step = safety * limit * EXPLICIT[name] / 2.0
        damped = any("damping" in material for material in body.tables["material"].values())
        if chance.random() < 0.5:
            # no whole number of steps, or rounding would decide how many there are
            time |= {"step": "auto", "safety": safety, "end": (steps - 0.25) * step}
        else:
            step *= 0.7 if damped else 0.95
            time |= {"step": step, "end": steps * step}
    else:
        steps, step = chance.randint(12, 32), body.limit * 10 ** chance.uniform(-0.7, 1.0)
        # an end that is not a whole number of steps, too
        time |= {"step": step, "end": step * (steps - chance.choice((0.0, 0.0, 0.5)))}
    time |= _parameters(chance, name)
    return time


def _parameters(chance: random.Random, name: str) -> dict[str, Any]:
    if chance.random() < 0.4:
        return {}
    if name == "newmark":
        if chance.random() < 0.5:
            return {"beta": 0.25, "gamma": 0.5}
        gamma = chance.uniform(0.5, 1.5)
        return {"gamma": gamma, "beta": 0.25 * (gamma + 0.5) ** 2}
    if name == "wilson":
        return {"theta": chance.choice((1.5, 1.6, 2.0, chance.uniform(1.37, 2.2)))}
    if name == "generalized_alpha":
        rho = chance.uniform(0.0, 1.0)
        if rho > 0.6:
            return {"integrator": "hht_alpha", "alpha": (rho - 1.0) / (rho + 1.0)}
        return {"rho_inf": rho} if rho > 0.2 else {"integrator": "bathe", "rho_inf": 5.0 * rho}
    if name == "chung_lee":
        return {"beta": chance.uniform(1.0, 28.0 / 27.0)}
    if name == "noh_bathe":
        return {"p": chance.uniform(0.51, 0.7)}
    if name == "hulbert_chung":
        return {"rho_b": chance.uniform(0.0, 1.0)}
    return {}


def _motion(chance: random.Random, body: Body, time: dict[str, Any]) -> Motion:
    kind = body.tables["mesh"]["generator"]
    way = np.array([chance.gauss(0, 1) for _ in range(3)])
    if kind in ("rod", "two_rods") and chance.random() < 0.75:
        way = np.array([chance.choice((1.0, -1.0)), 0.0, 0.0])
    elif kind == "ring" and chance.random() < 0.8:
        way[2] = 0.0
    elif chance.random() < 0.4:
        way = np.eye(3)[chance.randrange(3)] * chance.choice((1.0, -1.0))
    way /= np.linalg.norm(way)
    end = time["end"]
    speed = body.wave * 10 ** chance.uniform(-2.7, -1.4)
    # not farther than two lengths in the whole run
    speed = min(speed, 2.0 * body.size / end)
    step = 0.5 * body.limit if time["step"] == "auto" else time["step"]
    return Motion(way, speed, max(round(end / step), 1), step, end)


def _node_sets(chance: random.Random, body: Body) -> dict[str, Any]:
    sets: dict[str, Any] = {
        f"g_{name}": {"group": name} for name in sorted(body.node_groups) if len(body.node_groups[name])
    }
    sets["every"] = {"all": True}
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    sets["near"] = {"nearest": [chance.uniform(a, b) for a, b in zip(low, high, strict=True)]}
    axis, margin = chance.randrange(2 if body.tables["mesh"]["generator"] == "ring" else 1), 1e-6 * body.size
    corner = high.copy()
    corner[axis] = 0.5 * (low + high)[axis]
    sets["half"] = {"box": [(low - margin).tolist(), (corner + margin).tolist()]}
    count = chance.randint(1, max(1, len(body.points) // 3))
    sets["some"] = {"indices": sorted(chance.sample(range(len(body.points)), count))}
    return sets


def _initial(chance: random.Random, body: Body, motion: Motion, sets: dict[str, Any]) -> dict[str, Any]:
    velocity = motion.speed * motion.way
    initial: dict[str, Any] = {}
    if body.tables["mesh"]["generator"] == "two_rods" and chance.random() < 0.75:
        # the first rod flies at the second
        entry = {"node_set": "half", "velocity": [motion.speed, 0.0, 0.0]}
        return {"initial": {"on": [entry]}}
    if chance.random() < 0.95:
        initial["velocity"] = velocity
    if chance.random() < 0.25:
        rate = motion.speed / body.size * chance.uniform(0.1, 0.6)
        initial["angular_velocity"] = [0.0, 0.0, rate] if chance.random() < 0.5 else vector(chance, rate)
        if chance.random() < 0.3:
            initial["centre"] = body.points[chance.randrange(len(body.points))]
    if chance.random() < 0.15:
        initial["on"] = [{"node_set": chance.choice(sorted(sets)), "velocity": velocity * chance.uniform(0.5, 1.2)}]
    return {"initial": initial} if initial else {}


def _treatment(chance: random.Random, time: dict[str, Any]) -> str:
    odd = chance.random() < ODD
    known = ["scheme", "scheme", "scheme", "stick"]
    if odd or time["integrator"] in CONSERVING:
        known.append("conserving")
    if odd or time["integrator"] not in EXPLICIT or time["integrator"] in ("central_differences", "noh_bathe"):
        known.append("mass_redistribution")
    return "scheme" if "mass" in time and not odd else chance.choice(known)


def _pair(chance: random.Random, body: Body, treatment: str) -> dict[str, Any] | None:
    kind = body.tables["mesh"]["generator"]
    if treatment == "mass_redistribution" and chance.random() > ODD:
        return None
    if kind == "two_rods" and chance.random() < 0.85:
        table: dict[str, Any] = {"name": "faces", "first": "g_first_end", "second": "g_second_start"}
        gap = 0.0 if chance.random() < 0.6 else body.tables["mesh"]["gap"] * chance.uniform(0.2, 0.999)
        return table | {"direction": [chance.choice((1.0, 2.5)), 0.0, 0.0], "gap": gap}
    if kind == "lattice" and chance.random() < 0.12:
        mesh = body.tables["mesh"]
        if set(mesh) != {"generator", "kind", "cells", "pitch"} or mesh["kind"] in OPEN_KINDS:
            return None  # nodes of its faces do not face each other
        width = body.tables["mesh"]["cells"][0] * body.tables["mesh"]["pitch"]
        gap = width * (1.0 - 10 ** chance.uniform(-4, -2))
        return {"name": "faces", "first": "g_left", "second": "g_right", "direction": [1.0, 0.0, 0.0], "gap": gap}
    return None


def _supports(chance: random.Random, motion: Motion, sets: dict[str, Any]) -> dict[str, Any]:
    if chance.random() > 0.28:
        return {}
    table: dict[str, Any] = {"node_set": chance.choice([name for name in sorted(sets) if name != "every"])}
    table["fix"] = chance.choice(("xyz", "xyz", "x", "y", "z", "xy", "yz", "xz"))
    speeds = [motion.speed * chance.uniform(-0.4, 0.4) if axis in table["fix"] else 0.0 for axis in "xyz"]
    kind = chance.random()
    if kind < 0.2:
        table["velocity"] = speeds
    elif kind < 0.45:
        times = [0.0, *sorted(chance.uniform(0.05, 1.0) for _ in range(chance.randint(1, 3)))]
        factors = [0.0, *(chance.uniform(-0.5, 1.0) * fraction for fraction in times[1:])]
        rows = zip(times, factors, strict=True)
        table["motion"] = [[t * motion.end, *(f * motion.end * speed for speed in speeds)] for t, f in rows]
    supports = [table]
    if chance.random() < 0.15 and "z" not in table["fix"]:
        supports.append({"node_set": "every", "fix": "z"})
    return {"support": supports}


def _loads(chance: random.Random, body: Body, motion: Motion, sets: dict[str, Any]) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    if chance.random() < 0.3:
        names = sorted(sets) if chance.random() < 0.2 else ["near", "some"]
        force = body.stiffness * 10 ** chance.uniform(-5, -3)
        load = {"node_set": chance.choice(names), "force": force * (motion.way + vector(chance, 0.3))}
        if chance.random() < 0.6:
            times = sorted(chance.random() for _ in range(chance.randint(1, 4)))
            load["table"] = [[t * motion.end, chance.uniform(-1.0, 1.0)] for t in times]
        tables["load"] = [load]
    if chance.random() < 0.35:
        way = motion.way if chance.random() < 0.5 else vector(chance, 1.0)
        tables["gravity"] = {"acceleration": motion.speed / motion.end * chance.uniform(0.1, 2.0) * way}
    return tables


def _output(chance: random.Random, motion: Motion, sets: dict[str, Any]) -> dict[str, Any]:
    table: dict[str, Any] = {"fields_every": chance.choice((0, 1, 1, 2, 5, 10))}
    if chance.random() < 0.3:
        table["history_every"] = chance.randint(2, 7)
    if chance.random() < 0.3:
        table["fields"] = chance.sample((*POINT, *CELL), chance.randint(0, 5))
    if chance.random() < 0.2:
        table["precision"] = chance.choice(("float32", "float64"))
    if chance.random() < 0.2:
        table["checkpoint_every"] = max(motion.steps // chance.randint(2, 5), 1)
    if chance.random() < 0.05:
        table["checkpoint_minutes"] = 0.5
    names = chance.sample(sorted(sets), chance.choice((0, 1, 1, 2)))
    if names:
        table["probe"] = [{"name": f"at {name}", "node_set": name} for name in names]
    own = random.Random(repr(table))  # so that other cases stay as they are
    if own.random() < 0.4:
        table["bar_probe"] = [{"name": "first bar", "indices": [0]}]
        near = [own.uniform(-1.0, 1.0) * motion.speed * motion.end for _ in range(3)]
        table["bar_probe"] += [{"name": "some-bar", "nearest": near}] if own.random() < 0.5 else []
    return table


def _solver(chance: random.Random, time: dict[str, Any]) -> dict[str, Any]:
    if time["integrator"] in EXPLICIT and "mass" not in time:
        return {}
    table: dict[str, Any] = {"rtol": 1e-12} if chance.random() < 0.7 else {}
    if chance.random() < 0.5:
        table["linear"] = chance.choice(("auto", "cg", "gamg", "mumps"))
        table["operator"] = chance.choice(("auto", "assembled", "matrix_free"))
        # half of these, without a draw, so that other cases stay as they are
        if table["linear"] == "gamg" and random.Random(repr(time)).random() < 0.5:
            fits = table["operator"] != "assembled" and time["integrator"] != "energy_momentum"
            table["linear"] = "multigrid" if fits else "gamg"
    if chance.random() < 0.1:
        table["max_newton"] = chance.choice((20, 80))
    return {"solver": table} if table else {}


def plain(value: Any) -> Any:
    """Tables and lists of Python's own numbers and texts."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
