"""Points of a path after bars have broken: the equilibrium of what is left, at the same displacement.

The load factor is what changes: with ``"displacement"`` the displacement of the node set is held, with ``"arc_length"``
the displacement along the tangent of the path. The path goes on from there, in the direction in which this displacement
increases.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import NotConverged, SimulationFailure
from .free_motions import free_motions
from .path_constraints import LoadFactor, Still, dot
from .points import Point
from .redistribution import hold_detached

if TYPE_CHECKING:
    from .path_stepper import PathStepper

__all__ = ["settle_broken"]

PARTED = "no remaining bar carries the load"


def settle_broken(stepper: PathStepper) -> tuple[bool, str]:
    """Find equilibria at the same displacement until no further bar breaks. Collective.

    Returns whether bars broke, and why the path ends there: an empty text if it goes on.

    Raises
    ------
    SimulationFailure
        On all ranks, if the rest of the truss finds no equilibrium.
    """
    broke, ended = False, ""
    if not stepper.model.bars.can_break:
        return broke, ended
    while stepper.model.comm.allreduce(stepper.energy.changed > 0, op=MPI.LOR):
        broke = True
        hold_detached(stepper)
        try:
            point, ended = _again(stepper)
            stepper.commit(point)
        except NotConverged as failure:
            raise SimulationFailure(
                f"{stepper.arrived()}: the rest of the truss finds no equilibrium at this displacement after bars "
                "broke: a part of it is a mechanism, or the next equilibrium is distant; [time] follows the motion. "
                f"The last attempt: {failure}{free_motions(stepper.model, stepper.state)}"
            ) from failure
        stepper.keep(point)
    return broke, ended


def _again(stepper: PathStepper) -> tuple[Point, str]:
    """Return the point of the bars that are left; without a load on them, that at load factor zero, and why."""
    state, system, points, comm = stepper.state, stepper.system, stepper.points, stepper.model.comm
    system.begin(state)
    zero = np.zeros_like(state.position)
    system.linearise(zero)
    gradient = stepper.control.still(state.memory["tangent"])
    response = system.response(zero, state.time)
    size = float(np.sqrt(dot(comm, gradient, gradient) * dot(comm, response, response)))
    along = dot(comm, gradient, response)
    if not abs(along) > 1e-12 * size:
        u, load_factor, newton = points.newton(LoadFactor(-state.time, stepper.arc), zero, state.time)
        return Point(u, load_factor, state.memory["tangent"], stepper.slope, *points.spectrum(u), newton), PARTED
    point = points.find(Still(comm, gradient, stepper.arc), zero, state.time)
    sign = np.sign(dot(comm, gradient, point.tangent))
    return replace(point, tangent=sign * point.tangent, slope=float(sign * point.slope)), ""
