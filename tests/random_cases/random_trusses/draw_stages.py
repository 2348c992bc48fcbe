"""Draws a valid case of two to four stages by its number: statics, relaxation and motion one after the other.

One or two braced boxes at random places, with bars that yield, flow, soften, are damped, break and are removed, with
rest lengths and temperatures that change within stages and from one to the next, with springs, dashpots, walls and
pairs. What the documentation excludes is not drawn.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from .draw import EXPLICIT, IMPLICIT, Body, Motion, plain, vector
from .draw_load_cases import CHANGES

YOUNG, DENSITY, AREA, PITCH = 1e6, 1000.0, 1e-3, 0.5
STEP = 0.5 * PITCH / (YOUNG / DENSITY) ** 0.5
"""A third to a half of the critical step of all drawn trusses [s]."""
STRAIN = 1e-3
"""Of loads, impacts, yield, rupture and prestress, times a factor around one."""
FORCE, SPEED = YOUNG * AREA * STRAIN, STRAIN * (YOUNG / DENSITY) ** 0.5

STRESS = YOUNG * STRAIN

_YIELDS = {"yield_stress": STRESS, "isotropic_hardening": 0.02 * YOUNG}
_DAMPED = {"stiffness_damping": 0.2 * STEP}
_SOFTENS = {"softening": [[0.0, 1.0, 1.0], [40.0, 0.8, 0.7], [100.0, 0.4, 0.3]]}
_HEATING = {"melting_temperature": 500.0, "thermal_exponent": 1.1, "specific_heat": 0.05}
MATERIALS: tuple[dict[str, Any], ...] = (
    {},
    {"strain": "green", **_DAMPED},
    {"strain": "logarithmic", **_DAMPED, **_SOFTENS},
    {"law": "elastoplastic", **_YIELDS, "kinematic_hardening": 0.05 * YOUNG},
    {"law": "elastoplastic", **_YIELDS, "strain": "green", **_SOFTENS},
    {"law": "perzyna", **_YIELDS, "fluidity": 0.01},
    {"law": "perzyna", **_YIELDS, "fluidity": 1.0, "strain": "green", **_DAMPED, **_SOFTENS},
    {"law": "johnson_cook", "yield_stress": STRESS, "strength_coefficient": 0.1 * YOUNG, "hardening_exponent": 0.4,
     "rate_coefficient": 0.05, "rate_reference": 0.01, **_HEATING},
    {"law": "damage", "tensile_strength": STRESS, "fracture_energy": 5.0 * STRESS * STRAIN * PITCH},
    {"law": "cable", **_YIELDS, **_DAMPED},
)  # fmt: skip
"""Few, as each is compiled: laws and strain measures, with damping and softening; all can break."""


@dataclass
class Stage:
    """One analysis: its integrator or static method, and the end of its tables, a time [s] or a load factor."""

    kind: str
    end: float

    @property
    def static(self) -> bool:
        """Whether tables are over the load factor."""
        return self.kind in ("newton", "relaxation")


def draw_staged(seed: int) -> dict[str, Any]:
    """Return the case of a number as nested tables with the keys of a case file and plain numbers only."""
    chance = random.Random(f"stages {seed}")
    kinds = [_analysis(chance, k) for k in range(chance.randint(2, 4))]
    two = chance.random() < 0.5
    case: dict[str, Any] = {"title": f"random case of stages {seed}", "mesh": _mesh(chance, two)}
    names = [*case["mesh"]["node_groups"]]
    case["node_set"] = {name: {"group": name} for name in names} | {"every": {"all": True}}
    hot = chance.random() < 0.4
    case["material"] = {name: _material(chance, hot) for name in ("m1", "m2")}
    case["section"] = {"s1": {"area": AREA, "material": "m1", "bars": "some"}}
    case["section"]["s2"] = {"area": AREA * chance.choice((0.5, 1.5)), "material": "m2"}
    relaxed = any(stage.kind == "relaxation" for stage in kinds)
    _points(chance, case, two, relaxed)
    case["stage"] = []
    for k, stage in enumerate(kinds):
        table = {"name": f"st{k}"} | _tables(chance, case, stage, k, two, hot)
        if relaxed:  # without friction and ties
            table |= {"wall": [_smooth(wall) for wall in table["wall"]]} if "wall" in table else {}
        if any(later.static for later in kinds[k:]):
            table.pop("wind", None)  # it stays in force
        if k == 0:
            case |= {key: value for key, value in table.items() if key not in ("name", "section", "time", "static")}
            for name, keys in table.get("section", {}).items():
                case["section"][name] |= keys
            table = {key: table[key] for key in ("name", "time", "static") if key in table}
        case["stage"].append(table)
    case["output"] = {"fields_every": chance.choice((1, 4)), "history_every": chance.choice((1, 1, 3))}
    case["output"]["probe"] = [{"name": "pr", "node_set": "one"}]
    if seed % 2:
        case["output"]["bar_probe"] = [{"name": "first bar", "indices": [0]}]
    case["solver"] = {"linear": chance.choice(("auto", "auto", "gamg", "cg", "mumps")), "rtol": 1e-12}
    body = Body(
        {}, *(np.array(case["mesh"][key]) for key in ("points", "bars")), {}, 2.0 * STEP, stiffness=YOUNG * AREA
    )
    for name, share, change in CHANGES:
        own = random.Random(f"{name} of stages {seed}")
        if own.random() <= share:
            change(own, case, body, Motion(np.zeros(3), SPEED, 1, STEP, 1.0))
    return plain(case)


def _analysis(chance: random.Random, k: int) -> Stage:
    if chance.random() < (0.25 if k == 0 else 0.45):
        return Stage(chance.choices(("newton", "relaxation"), (4, 1))[0], 1.0)
    name = chance.choice((*EXPLICIT, "central_differences", "central_differences", *IMPLICIT))
    return Stage(name, STEP * chance.randint(5, 15))


def _mesh(chance: random.Random, two: bool) -> dict[str, Any]:
    """Boxes of eight nodes with all edges and diagonals but three; the second one before the first along x."""
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * PITCH
    points = corners + np.array([[chance.gauss(0.0, 0.02 * PITCH) for _ in range(3)] for _ in corners])
    bars = [pair for pair in combinations(range(8), 2) if pair not in ((1, 6), (2, 5), (3, 4))]
    groups = {
        "left": range(4),
        "right": range(4, 8),
        "top": range(1, 8, 2),
        "one": [chance.randrange(4, 8)],
        "free": range(4, 8),
    }
    if two:
        gap = chance.choice((1e-3, 0.02))
        other = points + [PITCH + gap, 0.0, 0.0]
        other[:4] = points[4:] + [gap, 0.0, 0.0]  # faces that meet
        points, bars = np.concatenate([points, other]), bars + [(a + 8, b + 8) for a, b in bars]
        groups |= {
            "face1": range(4, 8),
            "face2": range(8, 12),
            "right": range(12, 16),
            "body1": range(8),
            "free": range(4, 12),
        }
    some = sorted(chance.sample(range(len(bars)), len(bars) // 3))
    return {
        "generator": "arrays",
        "points": points,
        "bars": bars,
        "node_groups": {name: list(members) for name, members in groups.items()},
        "bar_groups": {"some": some, "cut": some[:5], "few": chance.sample(range(len(bars)), 2)},
    }


def _material(chance: random.Random, hot: bool) -> dict[str, Any]:
    table = {"young_modulus": YOUNG, "density": DENSITY, **chance.choice(MATERIALS)}
    if hot:
        table["thermal_expansion"] = chance.choice((0.0, 1e-4, 1e-4))
    if chance.random() < 0.2:
        table["damping"] = 500.0
    limit = STRAIN * chance.choice((1.0, 2.0, 4.0, 1000.0, 1000.0))  # the last one is never reached
    key = chance.choice(("stress", "strain", "compressive_strain"))
    return table | {"rupture": {key: limit * YOUNG if key == "stress" else limit, "steps": chance.choice((1, 2, 4, 6))}}


def _points(chance: random.Random, case: dict[str, Any], two: bool, relaxed: bool) -> None:
    """Masses, springs, dashpots and pairs; no springs to the ground and pairs where a stage is a relaxation."""
    between = ["body1" if two else "left", "right"]
    if chance.random() < 0.2:
        case["mass"] = [{"node_set": "top", "value": 0.1}]
    for key, what, size in (("spring", "stiffness", YOUNG * AREA), ("dashpot", "coefficient", 10.0)):
        tables = []
        if not relaxed and chance.random() < 0.2:
            value = size * chance.choice((0.01, 0.5))
            tables.append({"node_set": "top", what: [value, 0.0, 0.1 * value] if key == "spring" else value})
        if chance.random() < 0.3:
            tables.append({"between": between, what: size * chance.choice((0.01, 0.2))})
        if tables:
            case[key] = tables
    if two and not relaxed and chance.random() < 0.3:
        pair = {"name": "faces", "first": "face1", "second": "face2", "direction": [1.0, 0.0, 0.0]}
        case["contact_pair"] = [pair]


def _tables(chance: random.Random, case: dict[str, Any], stage: Stage, k: int, two: bool, hot: bool) -> dict[str, Any]:
    """The analysis of stage k, and the tables that it gives."""
    first, table = k == 0, _analysis_keys(chance, stage)
    if first or chance.random() < 0.4:
        table["support"] = _supports(chance, stage, two)
    if not stage.static and (first or chance.random() < 0.3):
        speed = SPEED * chance.choice((0.2, 1.0, 3.0)) * (1.0 if first else 0.3)
        table["initial"] = {"velocity": vector(chance, speed)}
        if two and chance.random() < 0.3:
            table["initial"] = {"on": [{"node_set": "body1", "velocity": [10.0 * speed, 0.0, 0.0]}]}
    if chance.random() < 0.5:
        load = {"node_set": chance.choice(("one", "top")), "force": vector(chance, FORCE * chance.uniform(0.1, 1.0))}
        if chance.random() < 0.5:
            load |= {"table": _rows(chance, stage, (0.0, 1.0, -0.5)), "interpolation": chance.choice(_WAYS)}
        table["load"] = [load] if first or chance.random() < 0.8 else []
    if chance.random() < 0.3:
        table["gravity"] = {"acceleration": vector(chance, 1.0)}
    if chance.random() < 0.1:
        table["wind"] = {"velocity": vector(chance, 5.0), "density": 1.2}
    if hot and (first or chance.random() < 0.5):
        heat = {"table": _rows(chance, stage, (chance.choice((0.0, 20.0)), chance.choice((40.0, 10.0, -20.0))))}
        table["temperature"] = [heat | ({"bars": "some"} if chance.random() < 0.3 else {})]
    stressed = [name for name in ("s1", "s2") if chance.random() < 0.25]
    if stressed:
        table["section"] = {name: _rest(chance, case, case["section"][name], stage) for name in stressed}
    _removals(chance, table, stage, two)
    if chance.random() < 0.25:
        table["wall"] = [_wall(chance, case, stage, table)] if first or chance.random() < 0.7 else []
    return table


_WAYS = ("linear", "smooth")


def _analysis_keys(chance: random.Random, stage: Stage) -> dict[str, Any]:
    if stage.kind == "relaxation":
        # without an equilibrium the default goes on for minutes
        return {"static": {"method": "relaxation", "step": chance.choice((0.5, 1.0)), "max_iterations": 30_000}}
    if stage.static:
        static: dict[str, Any] = {"method": "newton", "step": chance.choice((0.25, 0.34, 0.5)), "min_step": 0.01}
        return {"static": static | ({"stabilise": 1e-4} if chance.random() < 0.3 else {})}
    time: dict[str, Any] = {"integrator": stage.kind, "end": stage.end}
    if stage.kind in EXPLICIT:
        time |= {"step": "auto", "safety": chance.choice((0.3, 0.8))}
    else:
        time["step"] = STEP * chance.choice((0.1, 0.3, 0.6))
        time |= {"mass": "consistent"} if chance.random() < 0.2 else {}
        time |= {"rho_inf": 0.8} if stage.kind == "generalized_alpha" else {}
    return {"time": time}


def _rows(chance: random.Random, stage: Stage, values: tuple[Any, ...]) -> list[list[Any]]:
    """Rows of a table over the first part of a stage."""
    ends = np.linspace(0.0, chance.uniform(0.4, 0.9) * stage.end, len(values))
    return [[float(end), *np.ravel(value)] for end, value in zip(ends, values, strict=True)]


def _supports(chance: random.Random, stage: Stage, two: bool) -> list[dict[str, Any]]:
    base: dict[str, Any] = {"name": "base", "node_set": "left", "fix": "xyz"}
    if chance.random() < 0.4:
        way = vector(chance, STRAIN * PITCH * chance.choice((1.0, 5.0)))
        base |= {"motion": _rows(chance, stage, (0.0 * way, way, 0.3 * way)), "interpolation": chance.choice(_WAYS)}
    if two or chance.random() < 0.3:
        return [base, {"name": "base2", "node_set": "right", "fix": "xyz" if two else "x"}]
    return [base]


def _rest(chance: random.Random, case: dict[str, Any], section: dict[str, Any], stage: Stage) -> dict[str, Any]:
    """A number or rows of one of the keys that set rest lengths."""
    law = case["material"][section["material"]].get("law")
    key = next((key for key in _REST if key in section), chance.choice(_REST))
    least = 0.0 if law == "cable" else -0.5
    strains = [STRAIN * chance.uniform(least, 0.8) for _ in range(3)]
    unit = {"pretension": YOUNG * section["area"], "prestress": YOUNG}
    values = tuple(unit[key] * strain if key in unit else 1.0 - strain for strain in strains)
    return {key: values[0] if chance.random() < 0.5 else _rows(chance, stage, values)}


_REST = ("pretension", "prestress", "rest_length")


def _removals(chance: random.Random, table: dict[str, Any], stage: Stage, two: bool) -> None:
    removed = []
    for name, share in (("cut", 0.2), ("few", 0.15)):
        if chance.random() < share:
            removed.append({"bars": name, "time": stage.end * chance.choice((0.0, 0.3, 0.6))})
    supports = [entry["name"] for entry in table.get("support", ())]
    if "base2" in supports and not (two and stage.static) and chance.random() < 0.2:
        removed.append({"supports": "base2", "time": stage.end * chance.choice((0.3, 0.6))})
    for entry in removed:
        if chance.random() < 0.5:
            entry["duration"] = 0.3 * stage.end
    if removed:
        table["remove"] = removed


def _wall(chance: random.Random, case: dict[str, Any], stage: Stage, table: dict[str, Any]) -> dict[str, Any]:
    """A plane or a ball beside the nodes that no support holds, with friction or restitution, at rest or moving."""
    members = case["mesh"]["node_groups"]["free"]
    ahead = float(np.array(case["mesh"]["points"])[members, 1].max()) + PITCH * chance.choice((0.01, 0.02))
    wall: dict[str, Any] = {"name": "w", "node_set": "free", "type": "plane"}
    wall |= {"point": [0.0, ahead, 0.0], "normal": [0.0, -1.0, 0.0]}
    if "contact_pair" in case:
        return wall
    if chance.random() < 0.3:
        wall = {"name": "w", "node_set": "free", "type": "sphere", "radius": 3.0, "side": "outside"}
        wall["point"] = [PITCH, ahead + 3.0, 0.5 * PITCH]
    kind = chance.choice(("smooth", "friction", "restitution", "tied"))
    wall |= {"friction": 0.3} if kind == "friction" else {"tied": True} if kind == "tied" else {}
    if kind == "restitution" and stage.kind == "central_differences":
        wall["restitution"] = 0.7
    if chance.random() < 0.4:
        way = np.array([0.0, -0.03 * PITCH, 0.0])
        wall |= {"motion": _rows(chance, stage, (0.0 * way, way, 0.3 * way)), "interpolation": chance.choice(_WAYS)}
    return wall


def _smooth(wall: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in wall.items() if key not in ("friction", "tied")}
