"""Equilibria at the same load factor after bars have broken, or after bars and supports are removed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import NotConverged, SimulationFailure
from .free_motions import free_motions

if TYPE_CHECKING:
    from .stepper import StaticStepper

__all__ = ["hold_detached", "redistribute"]


def redistribute(stepper: StaticStepper) -> None:
    """Remove what is due at the load factor, and find equilibria there until no further bar breaks. Collective.

    Raises
    ------
    SimulationFailure
        On all ranks, if the rest of the truss finds no equilibrium.
    """
    changed = stepper.removals.apply()
    if not stepper.model.bars.can_break and not changed:
        return
    while stepper.model.comm.allreduce(changed or stepper.energy.changed > 0, op=MPI.LOR):
        changed = False
        hold_detached(stepper)
        _solve_again(stepper)


def hold_detached(stepper: StaticStepper) -> None:
    """Hold nodes that no bar holds any more where they are. Collective."""
    model, owned = stepper.model, stepper.model.mesh.n_owned
    left = np.zeros(model.mesh.n_local, dtype=bool)
    left[model.mesh.bars[np.abs(model.bars.rupture()) < 1.0].ravel()] = True
    loose = np.flatnonzero(~left[:owned] & ~model.supports.held_nodes())
    if not model.links and model.comm.allreduce(len(loose)):
        model.supports.hold_nodes(loose, stepper.state.position)
        stepper.supports_changed()


def _solve_again(stepper: StaticStepper) -> None:
    """Find the equilibrium at the present load factor with the bars that are left. Collective.

    The guard is not used: what moves when bars go has nothing to do with the increments before.
    """
    guard, stepper.guard, stepper.scheme.releases = stepper.guard, None, True
    try:
        stepper._make_part(stepper.state.time)
    except NotConverged as failure:
        raise SimulationFailure(
            f"{stepper.arrived()}: the rest of the truss finds no equilibrium after bars or supports went: it "
            f'collapses, or a part of it is a mechanism; static.method = "relaxation" finds distant equilibria, '
            f"[time] follows the motion. The last attempt: {failure}{free_motions(stepper.model, stepper.state)}"
        ) from failure
    finally:
        stepper.guard, stepper.scheme.releases = guard, False
