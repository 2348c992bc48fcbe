"""Walls of a random case, placed where the body hits them."""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from .body import Body

ODD = 0.02


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
        ahead = {name: float((members_of(body, sets[name]) @ motion.way).mean()) for name in sorted(sets)}
        groups = [name for name in ahead if name.startswith("g_")]
        name = max(groups, key=ahead.get) if chance.random() < 0.8 else chance.choice(sorted(sets))
    else:
        return None, body.points
    return name, members_of(body, sets[name])


def members_of(body: Body, table: dict[str, Any]) -> np.ndarray:
    """Positions (m, 3) of the nodes of a node set."""
    if "group" in table:
        return body.points[body.groups[table["group"]]]
    if "indices" in table:
        return body.points[table["indices"]]
    if "nearest" in table:
        return body.points[[np.linalg.norm(body.points - table["nearest"], axis=1).argmin()]]
    if "box" in table:
        low, high = np.array(table["box"])
        return body.points[((body.points >= low) & (body.points <= high)).all(axis=1)]
    return body.points


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
        sideways = np.cross(way, _unit(chance)) * body.size * (chance.uniform(0, 0.3) if kind == "plane" else 0.1)
        wall |= {"point": first + gap * way + sideways, "normal": -way * chance.choice((1.0, 0.5, 3.0))}
        if kind == "rectangle":
            wall["along"] = np.cross(way, _unit(chance)) + 0.1 * way
            wall["size"] = [body.size * chance.uniform(0.4, 4.0) for _ in range(2)]
        return
    axis = np.zeros(3)
    if kind == "cylinder":
        axis = np.cross(way, _unit(chance)) if chance.random() < 0.8 else _unit(chance)
        axis /= np.linalg.norm(axis)
        wall["axis"] = axis * chance.choice((1.0, 2.0))

    def distance(centre: np.ndarray) -> np.ndarray:
        arm = members - centre
        return np.linalg.norm(arm - np.multiply.outer(arm @ axis, axis), axis=1)

    if chance.random() < 0.4:
        centre = members.mean(axis=0) + 0.2 * gap * way
        wall |= {"point": centre, "side": "inside", "radius": float(distance(centre).max()) + gap + 1e-9 * body.size}
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
    if kind == "friction" and (odd or treatment in ("scheme", "stick")):
        wall["friction"] = 10 ** chance.uniform(-1.3, 0.3)
        if chance.random() < 0.4:
            wall["static_friction"] = wall["friction"] * chance.uniform(1.0, 1.6)
    solves_next_position = time["integrator"] == "central_differences"
    fits = "mass" not in time and (treatment == "scheme" or treatment == "stick" and not solves_next_position)
    if kind == "restitution" and (odd or fits and (solves_next_position or "mass" not in wall)):
        wall["restitution"] = chance.choice((0.3, 0.7, 1.0, chance.random()))
        if solves_next_position and chance.random() < 0.2:
            wall["friction"] = 0.3
    if kind == "tied" and (odd or treatment in ("scheme", "stick")):
        wall["tied"] = True


def _unit(chance: random.Random) -> np.ndarray:
    vector = np.array([chance.gauss(0, 1) for _ in range(3)])
    return vector / np.linalg.norm(vector)


def _tilted(chance: random.Random, way: np.ndarray, amount: float) -> np.ndarray:
    vector = way + amount * _unit(chance) if amount else way
    return vector / np.linalg.norm(vector)
