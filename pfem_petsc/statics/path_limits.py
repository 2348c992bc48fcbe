"""Limits at which a path ends: the load factor, and the displacement of a node set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..tolerances import TIME
from .path_constraints import Component, Constraint, LoadFactor

if TYPE_CHECKING:
    from .path_stepper import PathStepper
    from .points import Point

__all__ = ["end_at_limit"]


def end_at_limit(stepper: PathStepper, point: Point) -> tuple[Point, str]:
    """Return a point and an empty text, or the point at the first limit before it and that limit. Collective.

    Raises
    ------
    NotConverged
        On all ranks, if there is no point at the limit.
    """
    limits = _exceeded(stepper, point)
    if not limits:
        return point, ""
    time = stepper.state.time
    share, constraint, reached = min(limits, key=lambda limit: limit[0])
    change = share * (point.load_factor - time)
    return stepper.points.find(constraint, share * point.u, time + change), reached


def _exceeded(stepper: PathStepper, point: Point) -> list[tuple[float, Constraint, str]]:
    """Return the limits that a point exceeds: share of the step at which they are, constraint, and text. Collective."""
    state, keys, direction = stepper.state, stepper.keys, stepper.direction
    limits: list[tuple[float, Constraint, str]] = []
    change = point.load_factor - state.time
    if keys.end is not None and point.load_factor >= keys.end * (1.0 - TIME):
        left = keys.end - state.time
        limits.append((left / change, LoadFactor(left, abs(change)), f"static.end = {keys.end:g}"))
    if keys.displacement is not None:
        start, way = direction.at(state.position), direction.of(point.u)
        if start + way >= keys.displacement * (1.0 - TIME):
            left = keys.displacement - start
            constraint = Component(direction, left, stepper.control.scale or abs(way))
            limits.append((left / way, constraint, f"static.displacement = {keys.displacement:g} m"))
    return limits
