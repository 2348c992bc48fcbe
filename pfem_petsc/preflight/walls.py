"""Gaps to the walls, and whether the truss moves towards them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..output.units import engineering

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["idle_walls", "wall_gaps"]


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
    points = mesh.points[: mesh.n_owned]
    v = model.initial_velocity()
    # the rate of the gap over a short displacement, a thousandth of the model's size
    fastest = max(comm.allgather(float(np.abs(v).max(initial=0.0))))
    ahead = 1e-6 * model.length / fastest if fastest > 0.0 else 1e-9
    now, then = contact.gaps(points, 0.0), contact.gaps(points + ahead * v, ahead)
    bodies = contact.motion.bodies  # not moving yet: displacements of nodes relative to these walls
    for k, speed in zip(bodies.at, bodies.state.v, strict=True):
        seen = contact.gap(k, points + ahead * (v - speed), contact.motion.displacements(0.0))
        then[:, k] = np.where(contact.members[:, k], seen, np.inf)
    with np.errstate(invalid="ignore"):
        rate = (then - now) / ahead
    # a moving wall, or the other node of a link, may push the truss against this wall
    pushed = model.external.active or contact.moving.any() or bool(model.links)
    for k, name in enumerate(contact.names):
        at = int(np.argmin(now[:, k])) if len(now) else -1
        mine = (float(now[at, k]), int(mesh.node_ids[at])) if at >= 0 else (np.inf, -1)
        gap, node = min(comm.allgather(mine))
        closing = -min(comm.allgather(float(np.nanmin(rate[:, k], initial=np.inf))))
        if not np.isfinite(gap):
            told[name] = "applies to no node"
            continue
        told[name] = f"gap {engineering(gap, 'm')} at node {node}"
        if closing > 0.0:
            told[name] += f", closing at up to {engineering(closing, 'm/s')}"
        elif not pushed and not model.supports.any:
            told[name] += ", not approached"
            warnings.append(
                f"no node moves towards wall {name!r}, and no force drives one there: check the direction of its "
                "normal and of the initial velocity"
            )
    return told, warnings
