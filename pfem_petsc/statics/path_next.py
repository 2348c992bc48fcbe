"""The next point of a path: predicted along the tangent, corrected, and rejected if it belongs to another path."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import NotConverged
from .critical import Event, find_critical
from .path_constraints import Along
from .path_limits import end_at_limit

if TYPE_CHECKING:
    from .path_stepper import PathStepper
    from .points import Point

__all__ = ["next_point"]

_UNRESOLVED = 2.0**-6  # of the first length, down to which a step is halved if a critical point is not located
_TURN = 0.5  # cosine between tangents of successive points, below which the step is halved if possible


def next_point(stepper: PathStepper, size: float) -> tuple[Point, list[Event], str]:
    """Return the point at a length or at a limit before it, the critical points on the way, and the limit reached.

    Raises
    ------
    NotConverged
        On all ranks.
    """
    state = stepper.state
    if stepper.turning:
        mode = stepper.turning * stepper.mode
        guess, load_factor = size * mode, state.time
        point = stepper.points.find(Along(stepper.metric, mode, size), guess, load_factor)
    else:
        tangent = state.memory["tangent"]
        length = stepper.control.advance(tangent, size)
        guess, load_factor = length * tangent, state.time + length * stepper.slope
        point = stepper.points.find(stepper.control.constraint(size), guess, load_factor)
    _suspect(stepper, point, guess)
    if not stepper.turning:
        _refuse_turn(stepper, point, size)
    point, reached = end_at_limit(stepper, point)
    if stepper.turning or stepper.points.stability is None:
        return point, [], reached
    try:
        events, turn = find_critical(stepper, point)
    except NotConverged as failure:
        # close to an imperfect bifurcation the point may lie on a path that does not pass through it
        if size > _UNRESOLVED * stepper.arc and 0.5 * size >= stepper.keys.smallest:
            raise
        stepper.message(f"a critical point was not located: {failure}")
        events, turn = [], None
    if turn is not None:
        point, reached = turn, ""
    return point, events, reached


def _refuse_turn(stepper: PathStepper, point: Point, size: float) -> None:
    """Refuse a tangent that has turned too far: it belongs to another path, or the step has cut a corner.

    Raises
    ------
    NotConverged
        On all ranks.
    """
    cosine = stepper.metric.product(point.tangent, point.slope, stepper.state.memory["tangent"], stepper.slope)
    if cosine < _TURN and 0.5 * size >= stepper.keys.smallest:
        raise NotConverged(
            f"{stepper.points.place}: the path turns by {np.degrees(np.arccos(max(cosine, -1.0))):.3g} degrees"
        )
    if stepper.control.scale and cosine < 0.0:
        raise NotConverged(
            f"{stepper.points.place}: the displacement along static.direction turns back; static.method = "
            '"arc_length" follows the path'
        )


def _suspect(stepper: PathStepper, point: Point, guess: np.ndarray) -> None:
    """Refuse a point that is unrelated to the last one.

    Raises
    ------
    NotConverged
        On all ranks.
    """
    if stepper.guard is None:
        return
    state = stepper.state
    after = stepper.with_ghosts(state.position + point.u)
    forces = np.maximum(np.abs(stepper.system.external(point.load_factor)), np.abs(stepper.system.external(state.time)))
    energy = 0.5 * float(((forces + np.abs(state.support)) * np.abs(point.u)).sum())
    reason = stepper.guard.check(state.x, after, state.position + guess, energy)
    if reason is not None:
        raise NotConverged(f"{stepper.points.place}: {reason}; {stepper.remedy}", reason.partition(":")[0])
