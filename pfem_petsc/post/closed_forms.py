"""Closed forms of the histories of cases that have one, for pictures: recognised from the case, whatever its name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_ABSENT = ("load", "support", "temperature", "contact_pair", "constraint", "remove", "point_mass", "spring", "dashpot")


@dataclass
class ClosedForm:
    """Exact values of columns of the history.

    Attributes
    ----------
    name : of the solution
    columns : values at the times of the history, of the shape of the columns; NaN where they are not known
    path : displacement (m,) [m] and load factor (m,) of an equilibrium path
    """

    name: str
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    path: tuple[np.ndarray, np.ndarray] | None = None


def closed_form(result: Any) -> ClosedForm | None:
    """Return the closed form of a result's case, None if none is known.

    Parameters
    ----------
    result : an open result
    """
    if not hasattr(result.case, "mesh") or result.case.stage or len(result.history["time"]) == 0:
        return None
    for find in FORMS:
        found = find(result)
        if found is not None:
            return found
    return None


def rod_on_wall(result: Any) -> ClosedForm | None:
    """An elastic rod that flies along its axis against a rigid wall, or the plateau of one that yields.

    From the contact at t_c = gap/v for 2 L/c the wall exerts F = rho c A v, c = sqrt(E/rho); a wave brings the rod to
    rest and, reflected at the free end, to the velocity -v. With linear hardening and v > v_Y = s_Y/(rho c), the force
    is A (s_Y + rho c_p (v - v_Y)) in the same time, c_p = sqrt(E_t/rho), E_t = E H/(E + H); later it is not known.
    """
    case, history = result.case, result.history
    if case.mesh.generator != "rod" or case.time is None or len(case.wall) != 1 or len(case.initial) != 1:
        return None
    wall, start, section = case.wall[0], case.initial[0], next(iter(case.section.values()))
    if (
        _has_more(case)
        or not _keys(wall) <= {"name", "type", "point", "normal", "node_set"}
        or wall.type != "plane"
        or len(case.section) != 1
        or section.area is None
        or section.prestressed
        or start.node_set is not None
        or any(start.angular_velocity)
        or np.linalg.norm(start.velocity[1:]) > 0.0
        or np.linalg.norm(wall.normal[1:]) > 0.0
        or start.velocity[0] * wall.normal[0] >= 0.0
    ):
        return None
    material = case.material[section.material]
    plastic = {"yield_stress", "isotropic_hardening", "kinematic_hardening"}
    if not _keys(material) <= {"law", "young_modulus", "density"} | plastic:
        return None
    points = np.asarray(result.positions(0), dtype=float)
    axis, speed = math.copysign(1.0, start.velocity[0]), abs(start.velocity[0])
    along = axis * points[:, 0]
    if not _holds_end(case, wall, points, int(np.argmax(along))):
        return None
    modulus, density = material.young_modulus, material.density
    c, length = math.sqrt(modulus / density), float(np.ptp(along))
    impact = (axis * wall.point[0] - float(along.max())) / speed
    time = np.asarray(history["time"], dtype=float)
    since, travel = time - impact, length / c
    touching = (since >= 0.0) & (since <= 2.0 * travel)
    normal = np.asarray(wall.normal, dtype=float) / np.linalg.norm(wall.normal)
    force = f"wall/{wall.name}/force"
    limit = getattr(material, "yield_stress", None)
    if limit is not None and speed > limit / (density * c):
        hardening = material.isotropic_hardening + material.kinematic_hardening
        slow = math.sqrt(modulus * hardening / (modulus + hardening) / density)
        plateau = section.area * (limit + density * slow * (speed - limit / (density * c)))
        known = np.where(touching, plateau, np.where(since < 0.0, 0.0, np.nan))
        return ClosedForm("plastic wave of linear hardening", {force: known[:, None] * normal})
    mass, way = density * section.area * length, np.array([axis, 0.0, 0.0])
    mean = speed * np.clip(1.0 - np.maximum(since, 0.0) / travel, -1.0, 1.0)
    inside = np.clip(since, 0.0, 2.0 * travel)
    centre = speed * (
        np.minimum(time, impact) + inside - inside**2 / (2.0 * travel) - np.maximum(since - 2 * travel, 0)
    )
    kinetic = 0.5 * mass * speed**2 * np.abs(mean) / speed
    columns = {
        force: (density * c * section.area * speed * touching)[:, None] * normal,
        "kinetic_energy": kinetic,
        "elastic_energy": 0.5 * mass * speed**2 - kinetic,
        "momentum": mass * mean[:, None] * way,
        "centre_of_mass": np.asarray(history["centre_of_mass"])[0] + centre[:, None] * way,
    }
    for name in history:
        if name.startswith("probe/") and name.endswith("/position"):
            place = np.asarray(history[name])[0]
            delay = (along.max() - axis * place[:, 0]) / c
            first, last = impact + delay, impact + 2.0 * travel - delay
            moved = np.minimum(time[:, None], first) - np.maximum(time[:, None] - last, 0.0)
            columns[name] = place + speed * moved[..., None] * way
            sign = np.where(time[:, None] < first, 1.0, np.where(time[:, None] < last, 0.0, -1.0))
            columns[name.replace("/position", "/velocity")] = speed * sign[..., None] * way
    return ClosedForm("closed form of the wave in the rod", columns)


def von_mises(result: Any) -> ClosedForm | None:
    """Two bars under a load at the apex: P(z) = 2 E A z (1/sqrt(b^2 + z^2) - 1/L_0) at the height z, half span b."""
    case = result.case
    if case.mesh.generator != "von_mises" or case.static is None or len(case.load) != 1 or len(case.section) != 1:
        return None
    load, section = case.load[0], next(iter(case.section.values()))
    if (
        _has_more(case, ("load", "support"))
        or case.wall
        or not _keys(load) <= {"node_set", "force"}
        or any(load.force[:2])
        or section.area is None
        or section.prestressed
        or not _keys(case.material[section.material]) <= {"law", "young_modulus", "density"}
    ):
        return None
    points = np.asarray(result.positions(0), dtype=float)
    if len(points) != 3:
        return None
    apex = int(np.argmax(np.abs(points[:, 2])))
    feet = np.delete(points, apex, axis=0)
    base, rise = 0.5 * float(np.ptp(feet[:, 0])), float(points[apex, 2])
    heights = [np.asarray(result.positions(i))[apex, 2] for i in range(len(result.times))]
    height = np.linspace(rise, min([*heights, rise]), 400)
    stiff = 2.0 * case.material[section.material].young_modulus * section.area
    load_z = -stiff * height * (1.0 / np.hypot(base, height) - 1.0 / math.hypot(base, rise))
    return ClosedForm("closed form of two bars", path=(rise - height, load_z / load.force[2]))


FORMS: tuple[Callable[[Any], ClosedForm | None], ...] = (rod_on_wall, von_mises)


def _keys(table: Any) -> set[str]:
    """Return the keys of a table that differ from their defaults."""
    return set(table.model_dump(exclude_defaults=True, exclude_none=True))


def _has_more(case: Any, allowed: tuple[str, ...] = ()) -> bool:
    """Whether a case has forces or constraints beside the allowed tables."""
    return (
        case.gravity is not None
        or case.wind is not None
        or any(len(getattr(case, name)) for name in _ABSENT if name not in allowed)
    )


def _holds_end(case: Any, wall: Any, points: np.ndarray, end: int) -> bool:
    """Whether a wall stops the end of a rod."""
    if wall.node_set is None:
        return True
    chosen = case.node_set[wall.node_set]
    if chosen.nearest is not None:
        return int(np.argmin(np.linalg.norm(points - np.array(chosen.nearest), axis=1))) == end
    return bool(chosen.all) or (chosen.indices is not None and end in chosen.indices)
