"""Checks of the walls: gaps, whether the truss moves towards them, and whether bars can pass around them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..contact.monitoring import distances, small_walls
from ..output.units import engineering

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.model import Model
    from ..stepping.plan import Plan

_SAMPLES = 64  # positions of a wall along its path that are checked
_LARGEST = 5_000_000  # number of bars of a rank beyond which only their lengths are checked


def idle_walls(model: Model) -> list[str]:
    """Warn of walls that apply to no node. Collective."""
    members = model.comm.allreduce(model.contact.members.sum(axis=0))
    return [
        f"wall {name!r} applies to no node: name a node_set that has nodes, or omit node_set"
        for name, count in zip(model.contact.names, members, strict=True)
        if not count
    ]


def wall_gaps(model: Model) -> tuple[dict[str, str], list[str]]:
    """Return, by wall name, nearest node, gap and approach velocity at the start; and warnings. Collective."""
    contact, mesh, comm = model.contact, model.mesh, model.comm
    told: dict[str, str] = {}
    warnings = idle_walls(model)
    if not contact.any:
        return told, warnings
    points, v = mesh.points[: mesh.n_owned], model.initial_velocity()
    # the rate of the gap over a short displacement, a thousandth of the model's size
    fastest = comm.allreduce(float(np.abs(v).max(initial=0.0)), op=MPI.MAX)
    ahead = 1e-6 * model.length / fastest if fastest > 0.0 else 1e-9
    now, then = contact.gaps(points, 0.0), contact.gaps(points + ahead * v, ahead)
    bodies = contact.motion.bodies  # not moving yet: displacements of nodes relative to these walls
    for k, speed in zip(bodies.at, bodies.state.v, strict=True):
        seen = contact.gap(k, points + ahead * (v - speed), contact.motion.displacements(0.0))
        then[:, k] = np.where(contact.members[:, k], seen, np.inf)
    with np.errstate(invalid="ignore"):
        rate = np.nanmin((then - now) / ahead, axis=0, initial=np.inf)
    comm.Allreduce(MPI.IN_PLACE, rate, op=MPI.MIN)
    # a moving wall, or the other node of a link, may push the truss against this wall
    pushed = model.external.active or contact.moving.any() or bool(model.links) or model.supports.any
    for k, name in enumerate(contact.names):
        at = int(np.argmin(now[:, k])) if len(now) else -1
        gap, node = min(comm.allgather((float(now[at, k]), int(mesh.node_ids[at])) if at >= 0 else (np.inf, -1)))
        if not np.isfinite(gap):
            told[name] = "applies to no node"
            continue
        told[name] = f"gap {engineering(gap, 'm')} at node {node}"
        if rate[k] < 0.0:
            told[name] += f", closing at up to {engineering(-float(rate[k]), 'm/s')}"
        elif not pushed:
            told[name] += ", not approached"
            warnings.append(
                f"no node moves towards wall {name!r}, and no force drives one there: check the direction of its "
                "normal and of the initial velocity"
            )
    return told, warnings


def bars_larger_than_walls(case: Case, model: Model) -> list[str]:
    """Warn about small walls with longer bars near their expected path. Collective.

    The path follows from the given motion of the wall, or from its initial velocity if it has mass, relative to the
    mean initial velocity of the truss, and from gravity if it acts on the wall.
    """
    contact, mesh = model.contact, model.mesh
    small = small_walls(contact.walls)
    if not small:
        return []
    starts, ends = mesh.points[mesh.bars[:, 0]], mesh.points[mesh.bars[:, 1]]
    length = np.linalg.norm(ends - starts, axis=1)
    drift = model.comm.allreduce(model.inertia.mass @ model.initial_velocity()) / model.total_mass
    gravity = np.zeros(3) if case.gravity is None else np.array(case.gravity.mean)
    times = np.linspace(0.0, case.end, _SAMPLES)
    given = np.array([contact.motion.displacements(time) for time in times])
    told = []
    for k in small:
        wall, keys = contact.walls[k], case.wall[k]
        width = 2.0 * (wall.half.min() if wall.partial else wall.radius)
        reach = float(np.linalg.norm(wall.half)) if wall.partial else wall.radius
        longer = np.flatnonzero(length > width)
        if len(longer) <= _LARGEST:
            free = np.outer(times, keys.velocity if keys.velocity is not None else (0.0, 0.0, 0.0))
            way = wall.centre + (given[:, k] if keys.mass is None else free) - np.outer(times, drift)
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
        longest = model.comm.allreduce(float(length[longer].max(initial=0.0)), op=MPI.MAX)
        if count:
            told.append(
                f"wall {contact.names[k]!r} is {engineering(width, 'm')} wide, and {count} bar{'s' * (count > 1)} near "
                f"its path {'are' if count > 1 else 'is'} longer (up to {engineering(longest, 'm')}): only nodes touch "
                "walls, so that it can pass between the nodes of such a bar; use a larger wall or shorter bars"
            )
    return told


def jumping_motions(case: Case, plan: Plan) -> list[str]:
    """Warn about linear interpolation with a scheme that does not damp the vibrations by its velocity jumps."""
    moved = [(f"support[{k}]", entry) for k, entry in enumerate(case.support)]
    moved += [(f"wall {entry.name!r}", entry) for entry in case.wall]
    return [
        f'{name}: with interpolation = "linear" the velocity jumps at each of the {len(entry.motion)} rows of motion, '
        f"and {case.time.integrator} with these parameters preserves the vibrations that this causes; use "
        'interpolation = "smooth", or a scheme with numerical dissipation'
        for name, entry in moved
        if entry.interpolation == "linear" and not plan.scheme.dissipates
    ]
