"""Surfaces that represent walls in pictures, one function per wall type."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..contact.wall_motion import WallMotion
from ..contact.walls.base import Surface, slab
from ..errors import InputError
from ..registry import lookup


def plane(wall: Any, bounds: np.ndarray) -> Surface:
    """Return a slab behind a plane wall, as wide as the projection of the structure on it plus a margin.

    Parameters
    ----------
    wall : has ``name``, ``point`` (3,) [m] and ``normal`` (3,), which points to the allowed side
    bounds : (2, 3) [m], lower and upper corner of the structure's motion
    """
    normal = np.asarray(wall.normal, dtype=float)
    normal = normal / np.linalg.norm(normal)
    # two tangents, the first one in the plane of least normal component, so that axis-aligned walls get such edges
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    size = np.linalg.norm(bounds[1] - bounds[0]) or 1.0
    spans = []
    for tangent in (first, second):
        along = corners @ tangent
        # a structure without extent in this direction still gets a visible wall
        margin = 0.04 * size + 0.5 * max(0.0, 0.2 * size - np.ptp(along))
        spans.append((along.min() - margin, along.max() + margin))
    foot = normal * (np.asarray(wall.point, dtype=float) @ normal)
    (a, b), (c, d) = spans
    face = np.array([foot + u * first + v * second for u, v in ((a, c), (b, c), (b, d), (a, d))])
    return slab(wall.name, face, normal, 0.05 * size)


_OWN: dict[str, Callable[[Any, np.ndarray], Surface]] = {"plane": plane}


def _drawing_of(kind: str) -> Callable[[Any, np.ndarray], Any] | None:
    """Return the drawing function of a wall type: ``surface`` of its module if it exists, else the one here."""
    try:
        module = lookup("pfem_petsc.contact.walls", kind, "wall.type")
    except InputError:
        return _OWN.get(kind)
    return getattr(module, "surface", None) or _OWN.get(kind)


def wall_surfaces(walls: Iterable[Any], bounds: np.ndarray, note: Callable[[str], None] = print) -> list[Surface]:
    """Return the surfaces of a case's walls; a wall whose type has no drawing is skipped with a message to ``note``.

    A wall module may define ``surface(parameters, bounds)``, which returns a :class:`Surface`, or points (n, 3) and
    quadrilaterals (f, 4).
    """
    drawn = []
    for wall in walls:
        draw = _drawing_of(wall.type)
        if draw is None:
            note(f"wall '{wall.name}' is left out of the picture: type '{wall.type}' has no drawing")
            continue
        shape = draw(wall, bounds)
        if not isinstance(shape, Surface):
            points, faces = (np.asarray(part) for part in shape)
            edge = np.zeros((0, 2), dtype=int)
            shape = Surface(wall.name, points, faces, depth=np.zeros(len(points)), edge=edge)
        drawn.append(shape)
    return drawn


def wall_shifts(result: Any, times: Sequence[float]) -> np.ndarray:
    """Return displacements (times, walls, 3) [m] of a result's walls from their initial positions.

    Positions of walls with mass are interpolated linearly between rows of the history; others follow from the case.
    A wall that a stage no longer has remains at its last position; :func:`walls_present` says which are there.
    """
    walls = result.case.every_wall
    if result.case.stage:
        return np.array([_shifts_in_stages(result, time) for time in times]).reshape(len(times), len(walls), 3)
    motion = WallMotion(walls)
    displacements = np.array([motion.displacements(time) for time in times]).reshape(len(times), len(walls), 3)
    for k, wall in enumerate(walls):
        if wall.mass is not None:
            when = np.asarray(result.history["time"], dtype=float)
            places = np.asarray(result.history[f"wall/{wall.name}/position"], dtype=float)
            for axis in range(3):
                displacements[:, k, axis] = np.interp(times, when, places[:, axis] - places[0, axis])
    return displacements


def walls_present(result: Any, times: Sequence[float]) -> np.ndarray:
    """Return which of a result's walls are there (times, walls) bool: with stages, those of the stage at that time."""
    walls = result.case.every_wall
    if not result.case.stage:
        return np.ones((len(times), len(walls)), dtype=bool)
    present = np.zeros((len(times), len(walls)), dtype=bool)
    for row, time in enumerate(times):
        *_, (stage, _, _) = _stages_until(result, time)
        names = [wall.name for wall in stage.wall]
        present[row] = [wall.name in names for wall in walls]
    return present


def _stages_until(result: Any, time: float) -> Iterator[tuple[Any, float, float]]:
    """Yield the stages that have begun before a time, each with its beginning and its end, at most this time.

    The end of a stage belongs to it, and not to the next one.
    """
    times, numbers = np.asarray(result.history["time"]), np.asarray(result.history["stage"])
    for stage in result.case.stage:
        rows = times[numbers == stage.number]
        begin = times[numbers < stage.number].max(initial=0.0)
        if stage.number and (not len(rows) or begin >= time):
            return
        yield stage, begin, min(time, rows[-1]) if len(rows) else begin


def _shifts_in_stages(result: Any, time: float) -> np.ndarray:
    """Displacements (walls, 3) [m] at a time, from the place where a wall is first given."""
    walls = result.case.every_wall
    times, numbers = np.asarray(result.history["time"]), np.asarray(result.history["stage"])
    shifts = np.zeros((len(walls), 3))
    for stage, begin, end in _stages_until(result, time):
        for wall, moved in zip(stage.wall, WallMotion(stage.wall).displacements(end - begin), strict=True):
            k = [each.name for each in walls].index(wall.name)
            if wall.mass is not None:
                places = np.asarray(result.history[f"wall/{wall.name}/position"])
                shifts[k] = [np.interp(time, times, places[:, axis]) for axis in range(3)]
                shifts[k] -= places[numbers == stage.number][0]
            elif not stage.holds("wall"):
                shifts[k] = _place(wall) - _place(walls[k]) + moved
    return shifts


def _place(wall: Any) -> np.ndarray:
    """A point that the keys of a wall give (3,) [m]."""
    return np.asarray(lookup("pfem_petsc.contact.walls", wall.type, "wall.type").Wall(wall).centre, dtype=float)
