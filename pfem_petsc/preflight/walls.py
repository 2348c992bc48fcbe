"""Gaps to the walls, and whether the truss moves towards them."""

from __future__ import annotations

import numpy as np

from ..output.units import engineering

__all__ = ["wall_gaps"]


def wall_gaps(model) -> tuple[dict[str, str], list[str]]:
    """Wall name to the nearest node, gap and approach at the start; and warnings. Collective."""
    contact, mesh, comm = model.contact, model.mesh, model.comm
    told: dict[str, str] = {}
    warnings: list[str] = []
    if not contact.any:
        return told, warnings
    points = mesh.points[: mesh.n_owned]
    v = model.initial_velocity()
    # a short way ahead, a thousandth of the model's size: the rate of the gap along it
    fastest = max(comm.allgather(float(np.abs(v).max(initial=0.0))))
    ahead = 1e-6 * model.length / fastest if fastest > 0.0 else 1e-9
    now, then = contact.gaps(points, 0.0), contact.gaps(points + ahead * v, ahead)
    with np.errstate(invalid="ignore"):
        rate = (then - now) / ahead
    pushed = model.external.active or contact.moving.any()  # a wall that moves may push the truss against another
    for k, name in enumerate(contact.names):
        at = int(np.argmin(now[:, k])) if len(now) else -1
        mine = (float(now[at, k]), int(mesh.node_ids[at])) if at >= 0 else (np.inf, -1)
        gap, node = min(comm.allgather(mine))
        closing = -min(comm.allgather(float(np.nanmin(rate[:, k], initial=np.inf))))
        if not np.isfinite(gap):
            told[name] = "concerns no node"
            warnings.append(f"wall {name!r} concerns no node: name a node_set with nodes, or leave node_set out")
            continue
        told[name] = f"gap {engineering(gap, 'm')} at node {node}"
        if closing > 0.0:
            told[name] += f", closing at up to {engineering(closing, 'm/s')}"
        elif not pushed and not model.supports.any:
            told[name] += ", not approached"
            warnings.append(
                f"no node moves towards wall {name!r}, and no force does anything about it: is its normal, or the "
                "initial velocity, the wrong way round?"
            )
    return told, warnings
