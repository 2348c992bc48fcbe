"""Draws a valid case by its number, over the documented keys and their combinations.

Bodies are aimed at walls so that they hit them within the run. Combinations that the documentation excludes are not
drawn, except in a few percent of the cases, which must be refused with a message.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

import numpy as np

from .additions import (
    ODD,
    draw_bar_law,
    draw_connectors,
    draw_inclined,
    draw_laws,
    draw_loads_over_time,
    draw_points,
    draw_prestress,
    draw_rupture,
    draw_stiffness_damping,
    vector,
)
from .body import OPEN_KINDS, Body, draw_body
from .walls import draw_walls

EXPLICIT = {"central_differences": 2.0, "chung_lee": 1.85, "hulbert_chung": 1.5, "souza_moura": 1.7}
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


def draw_case(seed: int) -> dict[str, Any]:
    """Return the case of a number as nested tables with the keys of a case file and plain numbers only."""
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
    draw_bar_law(random.Random(f"bar law {seed}"), case, 1.8 * body.size)
    draw_laws(random.Random(f"laws {seed}"), case, motion.end)
    draw_prestress(random.Random(f"prestress {seed}"), case, motion.end)
    draw_loads_over_time(random.Random(f"loads {seed}"), case, motion.speed, motion.end)
    draw_stiffness_damping(random.Random(f"stiffness damping {seed}"), case, body.limit)
    draw_rupture(random.Random(f"rupture {seed}"), case, motion.end)
    draw_points(random.Random(f"points {seed}"), case, body.size)
    draw_inclined(random.Random(f"inclined {seed}"), case)
    draw_connectors(random.Random(f"connectors {seed}"), case, body.size)
    return _plain(case)


def _time(chance: random.Random, body: Body) -> dict[str, Any]:
    explicit = chance.random() < 0.45
    name = chance.choices(tuple(EXPLICIT), (5, 2, 2, 1))[0] if explicit else chance.choice(IMPLICIT)
    time: dict[str, Any] = {"integrator": name}
    if chance.random() < 0.15:
        time["mass"] = "consistent"
    limit = body.limit * (0.55 if "mass" in time else 1.0)
    if explicit:
        steps, safety = chance.randint(40, 100), chance.uniform(0.3, 0.95)
        step = safety * limit * EXPLICIT[name] / 2.0
        damped = any("damping" in material for material in body.tables["material"].values())
        if chance.random() < 0.5:
            time |= {"step": "auto", "safety": safety, "end": steps * step}
        else:
            step *= 0.7 if damped else 0.95
            time |= {"step": step, "end": steps * step}
    else:
        steps, step = chance.randint(12, 32), body.limit * 10 ** chance.uniform(-0.7, 1.0)
        # an end that is not a whole number of steps, too
        time |= {"step": step, "end": step * (steps - chance.choice((0.0, 0.0, 0.5)))}
    time |= _parameters(chance, name)
    return time


def _parameters(chance: random.Random, name: str) -> dict[str, float]:
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
        return {"rho_inf": chance.uniform(0.0, 1.0)}
    if name == "chung_lee":
        return {"beta": chance.uniform(1.0, 28.0 / 27.0)}
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
    sets: dict[str, Any] = {f"g_{name}": {"group": name} for name in sorted(body.groups) if len(body.groups[name])}
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
    if odd or time["integrator"] not in EXPLICIT or time["integrator"] == "central_differences":
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


def _plain(value: Any) -> Any:
    """Tables and lists of Python's own numbers and texts."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
