"""The start of a path: its first equilibrium, the metric of its lengths, and its first tangent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, SimulationFailure
from .path_constraints import LoadFactor, dot
from .points import Point

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .path_keys import PathKeys
    from .path_stepper import PathStepper

__all__ = ["check_path", "first_point"]


def check_path(model: Model, keys: PathKeys) -> None:
    """Refuse what path following does not support.

    Raises
    ------
    InputError
        On all ranks.
    """
    case = model.case
    if case.remove:
        raise InputError(
            f'{case.source}: static.method = "{case.static.method}" can pass a load factor several times or never, '
            'so that [[remove]] has no defined time; remove bars and supports with static.method = "newton"'
        )
    if model.can_touch:
        raise InputError(
            f'{case.source}: static.method = "{case.static.method}" follows paths without contact; remove walls, '
            'contact pairs and constraints, or use static.method = "newton", with static.stabilise beyond limit points'
        )
    if not (model.external.active or model.supports.moves or model.bars_vary):
        raise InputError(f"{case.source}: static: nothing depends on the load factor; give a [[load]] or a table")
    free = 3 * model.mesh.n_nodes - model.comm.allreduce(model.supports.number)
    unknown = [turn for turn in keys.branch_at if abs(turn) > free]
    if unknown:
        raise InputError(
            f"{case.source}: static.branch_at = {unknown}: bifurcations are numbered from 1 along the path, and a "
            f"truss with {free} free components has no more than {free} eigenvalues that can change their sign on it; "
            "run the case without branch_at, which reports the bifurcations and their numbers"
        )
    if keys.node_set is not None and not model.comm.allreduce(len(model.nodes[keys.node_set])):
        raise InputError(f"{case.source}: static.node_set = {keys.node_set!r} has no nodes")


def first_point(stepper: PathStepper) -> tuple[Point, bool]:
    """Return the first point with its tangent, and whether it differs from the state; set the metric. Collective.

    It differs if the state is not an equilibrium at its load factor.

    Raises
    ------
    NotConverged, SimulationFailure
        On all ranks, if there is no equilibrium, or if the load factor moves no node.
    """
    state, system, points, u = stepper.state, stepper.system, stepper.points, np.zeros_like(stepper.zero)
    comm, newton, g = stepper.model.comm, 0, np.empty_like(u)
    system.residual(u, state.time, g)
    norm, tolerance = float(np.sqrt(dot(comm, g, g))), points.tolerance(u, state.time, 0.0)
    moved = not (norm <= tolerance.residual or tolerance.rounded(norm, g, 1.0, comm))
    if moved:
        u, _, newton = points.newton(LoadFactor(0.0, stepper.keys.step), u, state.time)
    system.linearise(u)
    response = system.response(u, state.time)
    size = float(np.sqrt(dot(comm, response, response)))
    if not size > 0.0 or not np.isfinite(size):
        raise SimulationFailure(
            f"{stepper.model.case.source}: static: the load factor moves no node at the start of the path: loads act "
            "on supports only, or tables are constant there"
        )
    stepper.weight = stepper.metric.weight = 1.0 / size**2
    sign = _scale_component(stepper, response, size) if stepper.by_component else 1.0
    length = stepper.metric.length(response, 1.0)
    tangent, slope = sign * response / length, sign / length
    negatives, nearest = points.spectrum(u)
    return Point(u, state.time, tangent, slope, negatives, nearest, newton), moved


def _scale_component(stepper: PathStepper, response: np.ndarray, size: float) -> float:
    """Set the scale of the prescribed displacement; return the sign of load factors that increase it. Collective."""
    along = stepper.direction.of(response)
    if not abs(along) > 1e-12 * size:
        raise SimulationFailure(
            "static.direction: the load does not move the nodes of static.node_set along it at the start of "
            'the path; use another direction, or static.method = "arc_length"'
        )
    stepper.scale = abs(along)
    return float(np.sign(along))
