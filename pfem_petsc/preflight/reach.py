"""Walls smaller than the bars near their path, which can pass between the nodes of these bars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..contact.monitoring import distances, small_walls
from ..output.units import engineering

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..contact.wall_motion import WallMotion
    from ..contact.walls.base import WallKeys
    from ..stepping.model import Model

__all__ = ["bars_larger_than_walls"]

_SAMPLES = 64  # positions of a wall along its path that are checked
_LARGEST = 5_000_000  # number of bars of a rank beyond which only their lengths are checked


def bars_larger_than_walls(case: Case, model: Model) -> list[str]:
    """Warn about small walls with longer bars near their expected path. Collective.

    The path follows from the given motion of the wall, relative to the mean initial velocity of the truss, and from
    gravity if it acts on the wall.
    """
    contact, mesh = model.contact, model.mesh
    small = small_walls(contact.walls)
    if not small:
        return []
    starts, ends = mesh.points[mesh.bars[:, 0]], mesh.points[mesh.bars[:, 1]]
    length = np.linalg.norm(ends - starts, axis=1)
    v = model.initial_velocity()
    drift = model.comm.allreduce(model.inertia.mass @ v) / model.total_mass
    gravity = np.zeros(3) if case.gravity is None else np.array(case.gravity.mean)
    times = np.linspace(0.0, case.end, _SAMPLES)
    told = []
    for k in small:
        wall, keys = contact.walls[k], case.wall[k]
        width = 2.0 * (wall.half.min() if wall.partial else wall.radius)
        reach = float(np.linalg.norm(wall.half)) if wall.partial else wall.radius
        longer = np.flatnonzero(length > width)
        if len(longer) <= _LARGEST:
            way = wall.centre + _way(keys, contact.motion, k, times) - np.outer(times, drift)
            way += np.outer(0.5 * times**2, float(keys.gravity) * gravity - (0.0 if model.supports.any else gravity))
            near = np.zeros(len(longer), dtype=bool)
            for place, following in zip(way[:-1], way[1:], strict=True):
                # closer to the middle of a piece than half its length plus the wall's reach
                middle, half = 0.5 * (place + following), 0.5 * float(np.linalg.norm(following - place))
                away = distances(starts[longer], ends[longer], middle, getattr(wall, "axis", None))
                near |= away <= reach + half
            longer = longer[near]
        counted = np.zeros(len(mesh.bars), dtype=bool)
        counted[mesh.counted] = True
        count = model.comm.allreduce(int(counted[longer].sum()))
        longest = max(model.comm.allgather(float(length[longer].max(initial=0.0))))
        if count:
            told.append(
                f"wall {contact.names[k]!r} is {engineering(width, 'm')} wide, and {count} bar{'s' * (count > 1)} near "
                f"its path {'are' if count > 1 else 'is'} longer (up to {engineering(longest, 'm')}): only nodes touch "
                "walls, so that it can pass between the nodes of such a bar; use a larger wall or shorter bars"
            )
    return told


def _way(keys: WallKeys, motion: WallMotion, k: int, times: np.ndarray) -> np.ndarray:
    """Return displacements (times, 3) [m] of a wall by its given motion, or by its initial velocity if it has mass."""
    if keys.mass is not None:
        return np.outer(times, keys.velocity if keys.velocity is not None else (0.0, 0.0, 0.0))
    return np.array([motion.displacements(time)[k] for time in times])
