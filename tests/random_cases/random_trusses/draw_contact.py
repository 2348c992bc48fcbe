"""Adds to cases of :mod:`draw` the contact of surfaces of triangles, of walls that turn, also freely, of pairs that rub
and rebound, and of bars with bars.

Surfaces are closed and open, convex or not, of one face to some dozens, and are placed so that every node is in front
of them. What the documentation excludes is not drawn.
"""

from __future__ import annotations

import hashlib
import os
import random
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from helpers.triangles import ball, box

from .draw import CHANGES, EXPLICIT, Body, Motion, draw_case, members_of, vector

FOLDER = Path(tempfile.gettempdir()) / "random-surfaces"
"""Where the files of surfaces are; their names are those of their content."""

_TYPES = ("type", "point", "normal", "along", "size", "axis", "radius", "side")
"""Keys of a wall that go with its type."""


def draw_touching(seed: int) -> dict[str, Any]:
    """Return the case of a number with contact, as nested tables with the keys of a case file."""
    return draw_case(seed, (*CHANGES, *CONTACT))


def surface_file(points: np.ndarray, corners: np.ndarray) -> str:
    """Write an OBJ file of points (n, 3) and the corners (t, 3) of triangles, and return where it is."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    text = "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (corners + 1).tolist()), ""])
    FOLDER.mkdir(exist_ok=True)
    file = FOLDER / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.obj"
    if not file.exists():  # several ranks write the same
        made = file.with_suffix(f".{os.getpid()}")
        made.write_text(text)
        made.replace(file)
    return str(file)


def _treatment(case: dict[str, Any]) -> str:
    return case.get("contact", {}).get("treatment", "scheme")


def draw_surface(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Replace walls by surfaces of triangles in the path of the body."""
    if _treatment(case) == "mass_redistribution" or (case.get("contact_pair") and _treatment(case) != "scheme"):
        return  # for planes alone
    for k, wall in enumerate(case.get("wall", ())):
        if chance.random() < 0.25:
            continue
        members = body.points
        if "node_set" in wall:
            members = body.points[members_of(body, case["node_set"][wall["node_set"]])]
        gap = motion.speed * motion.end * chance.choice((0.0, chance.uniform(0.02, 0.5)))
        closed = bool(case.get("contact_pair"))
        shape = _shape(chance, body.size, members, motion.way + vector(chance, chance.choice((0.0, 0.2))), gap, closed)
        case["wall"][k] = {key: value for key, value in wall.items() if key not in _TYPES} | shape
        case["wall"][k].pop("adjust", None)


def _lumped_explicit(case: dict[str, Any]) -> bool:
    return case["time"]["integrator"] in EXPLICIT and "mass" not in case["time"]


def _shape(
    chance: random.Random, size: float, members: np.ndarray, way: np.ndarray, gap: float, closed: bool
) -> dict[str, Any]:
    """Return the keys of a surface that the members (m, 3) are in front of, the nearest by ``gap`` [m], in the
    direction ``way``."""
    n = -way / np.linalg.norm(way)
    across = np.cross(n, vector(chance, 1.0))
    axes = np.array([across / np.linalg.norm(across), np.cross(n, across / np.linalg.norm(across)), n])
    local = members @ axes.T  # the body flies along -z
    middle, wide = 0.5 * (local.min(axis=0) + local.max(axis=0)), size * chance.uniform(0.6, 3.0)
    at = np.array([*(middle[:2] + chance.uniform(-0.2, 0.2) * size), local[:, 2].min() - gap])
    kind = chance.choice(("box", "ball", "room") if closed else ("box", "ball", "room", "groove", "ridge", "sheet"))
    keys: dict[str, Any] = {}
    if kind == "box":
        points, corners = box([-wide, -wide, -wide], [wide, wide, 0.0])
    elif kind == "ball":
        points, corners = ball(chance.randint(0, 2))
        points = wide * (points - [0.0, 0.0, 1.0])
    elif kind == "room":
        room = np.maximum(gap, 1e-6 * size) + 1e-9 * size
        points, corners = box(local.min(axis=0) - room, local.max(axis=0) + room)
        at, keys["flip"] = np.zeros(3), True
    else:  # two rectangles, or four, that meet at lines along y
        slope = {"groove": 1.0, "ridge": -1.0, "sheet": 0.0}[kind] * chance.uniform(0.1, 1.5)
        lines = np.array([-3.0, -1.0, 0.0, 2.0, 3.0] if chance.random() < 0.5 else [-3.0, 0.0, 3.0]) * wide
        x, y = np.repeat(lines, 2), np.tile([-4.0 * wide, 4.0 * wide], len(lines))
        points, rows = np.column_stack([x, y, slope * np.abs(x)]), 2 * np.arange(len(lines) - 1)[:, None]
        corners = np.concatenate([rows + [0, 2, 3], rows + [0, 3, 1]])
        heights = local[:, 2] - slope * np.abs(local[:, 0] - at[0])
        at[2] = heights.min() - gap * np.hypot(1.0, slope)
        if chance.random() < 0.4:
            keys["side"] = "both"
            keys |= {"thickness": gap} if gap and chance.random() < 0.5 else {}
            at[2] -= 1e-5 * 8.0 * wide
        elif chance.random() < 0.3:
            corners, keys["flip"] = corners[:, ::-1], True
    scale = chance.choice((1.0, 1e-3, 2.0))
    file = surface_file(points @ axes / scale, corners)
    return {"type": "surface", "file": file, "scale": scale, "point": at @ axes, **keys}


def draw_turn(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Turn walls about axes near the body and far from it, so that they move about as fast as the body."""
    if _treatment(case) == "mass_redistribution" or (case.get("contact_pair") and _treatment(case) != "scheme"):
        return
    for wall in case.get("wall", ()):
        if chance.random() < 0.4 or wall.get("adjust") or "inertia" in wall:
            continue
        arm = body.size * chance.choice((chance.uniform(0.1, 2.0), 50.0))
        turn = {
            "centre": body.points.mean(axis=0) + vector(chance, arm),
            "axis": vector(chance, chance.uniform(0.5, 3)),
        }
        rate = chance.uniform(-1.0, 1.0) * motion.speed / (arm + 2.0 * body.size)
        if chance.random() < 0.5:
            turn["angular_velocity"] = rate
        else:
            times = sorted(chance.uniform(0.05, 1.1) for _ in range(chance.randint(1, 3)))
            turn["angles"] = [
                [0.0, 0.0],
                *([t * motion.end, rate * motion.end * chance.uniform(-1, 1) * t] for t in times),
            ]
            if chance.random() < 0.3:
                turn["interpolation"] = "linear"
        wall["rotation"] = turn


def draw_inertia(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Let walls with mass turn freely, or about a hinge."""
    for wall in case.get("wall", ()):
        if "mass" not in wall:
            continue
        width = body.size * chance.uniform(0.2, 1.0)
        squares = width * width * np.array([chance.uniform(0.2, 1.0) for _ in range(3)])
        moments = wall["mass"] / 12.0 * (squares.sum() - squares)  # of a box with these edges
        wall["inertia"] = moments
        if chance.random() < 0.4:
            axes = np.linalg.qr(np.array([vector(chance, 1.0) for _ in range(3)]))[0]
            matrix = axes @ np.diag(moments) @ axes.T
            wall["inertia"] = 0.5 * (matrix + matrix.T)
        if wall["type"] == "surface" or chance.random() < 0.3:
            wall["centre_of_mass"] = np.array(wall["point"]) + vector(chance, 0.3 * width)
        axis = vector(chance, chance.uniform(0.5, 3.0))
        if "velocity" not in wall and chance.random() < 0.3:
            wall["hinge"] = {"centre": np.array(wall["point"]) + vector(chance, 0.5 * width), "axis": axis}
        if chance.random() < 0.5:
            rate = chance.uniform(-0.5, 0.5) * motion.speed / body.size
            wall["angular_velocity"] = rate * axis / np.linalg.norm(axis)


def draw_rough_pair(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Give pairs and their walls friction, and restitution where steps are explicit."""
    rubs, scheme = _treatment(case) == "scheme", case["time"]["integrator"]
    for pair in case.get("contact_pair", ()):
        if rubs and chance.random() < 0.7:
            pair["friction"] = 10 ** chance.uniform(-1.3, 0.3)
            pair.pop("static_friction", None)
            if chance.random() < 0.4:
                pair["static_friction"] = pair["friction"] * chance.uniform(1.0, 1.6)
        if scheme == "central_differences" and "mass" not in case["time"] and chance.random() < 0.6:
            pair["restitution"] = chance.choice((0.3, 1.0, chance.random()))
        for wall in case.get("wall", ()) if rubs else ():
            if not wall.get("tied") and "friction" not in wall and chance.random() < 0.5:
                wall["friction"] = 10 ** chance.uniform(-1.3, 0.3)
            if (
                scheme == "central_differences"
                and _lumped_explicit(case)
                and not wall.get("tied")
                and chance.random() < 0.3
            ):
                wall["restitution"] = chance.random()


def draw_bars_touch(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion) -> None:
    """Let bars touch, and shoot a bar at the body from behind."""
    explicit, scheme = case["time"]["integrator"] in EXPLICIT, case["time"]["integrator"]
    if "mass" in case["time"] or _treatment(case) == "mass_redistribution":
        return
    if scheme == "energy_momentum" and any(w["type"] not in ("plane", "rectangle") for w in case.get("wall", ())):
        return  # which bars could cross between their nodes
    if not explicit:
        solver = case.setdefault("solver", {})
        solver["operator"] = chance.choice(("auto", "assembled"))
        if solver.get("linear") == "multigrid":
            solver["linear"] = "auto"
    elif case["time"]["step"] != "auto":  # keep clear of the critical step
        case["time"]["step"] *= 0.6
        case["time"]["end"] *= 0.6
    table: dict[str, Any] = {}
    lossy = scheme != "energy_momentum"
    if lossy and chance.random() < 0.5:
        table["friction"] = 10 ** chance.uniform(-1.3, 0.0)
    if lossy and chance.random() < 0.5:
        table["restitution"] = chance.choice((1.0, chance.uniform(0.3, 1.0)))
    if chance.random() < 0.5:
        table["radius"] = body.length * chance.uniform(0.01, 0.08)
    case["self_contact"] = table
    if "bar_fields" not in case["mesh"] and chance.random() < 0.7:
        _shoot(chance, case, body, motion, table)


def _shoot(chance: random.Random, case: dict[str, Any], body: Body, motion: Motion, table: dict[str, Any]) -> None:
    """Add a bar that flies after the body and hits it in the first half of the run."""
    radius = table.setdefault("radius", body.length * chance.uniform(0.01, 0.05))
    middles = body.points[body.bars].mean(axis=1)
    last = int((middles @ motion.way).argmin())
    along = body.points[body.bars[last, 1]] - body.points[body.bars[last, 0]]
    across = np.cross(along, motion.way)
    if np.linalg.norm(across) < 1e-3 * np.linalg.norm(along):
        across = np.cross(along, vector(chance, 1.0))
    across *= body.length * chance.uniform(0.4, 0.9) / np.linalg.norm(across)
    faster = motion.speed * chance.uniform(0.5, 1.5)
    away = 3.0 * radius + faster * motion.end * chance.uniform(0.02, 0.3)
    lowest = (body.points @ motion.way).min()
    middle = middles[last] + motion.way * (lowest - middles[last] @ motion.way - away)
    count = len(body.points)
    points = np.concatenate([body.points, [middle - across, middle + 1.1 * across]])
    groups = {"node_groups": body.node_groups, "bar_groups": body.bar_groups}
    case["mesh"] = {"generator": "arrays", "points": points, **groups}
    case["mesh"]["bars"] = np.concatenate([body.bars, [[count, count + 1]]])
    if case.get("solver", {}).get("linear") == "multigrid":  # of generated lattices
        case["solver"]["linear"] = "auto"
    case["node_set"]["shot"] = {"indices": [count, count + 1]}
    shot = {"node_set": "shot", "velocity": (motion.speed + faster) * motion.way}
    case.setdefault("initial", {}).setdefault("on", []).append(shot)
    for wall in case.get("wall", ()):  # those behind the body would begin beyond the walls around it
        wall.setdefault("node_set", "flying")
    case["node_set"]["flying"] = {"indices": list(range(count))}


CONTACT = (
    ("surface", 0.6, draw_surface),
    ("inertia", 0.7, draw_inertia),
    ("turn", 0.5, draw_turn),
    ("rough pair", 0.9, draw_rough_pair),
    ("bars touch", 0.5, draw_bars_touch),
)
"""As :data:`draw.CHANGES`."""
