"""Data of the energy ledger at an instant: motion and forces of this rank's nodes, energies of its bars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.bars import StrainEnergy

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["Moment", "balanced", "moment_of"]


@dataclass
class Moment:
    """Data of the ledger at an instant; arrays (owned, 3).

    With lumped mass ``momentum``, ``a`` and ``v`` are velocity, acceleration and velocity; with consistent mass they
    are M v [kg m/s], M a and C v [N], and ``v`` also with damping over time. ``velocity`` and ``acceleration`` are
    always velocity and acceleration.
    """

    momentum: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    a: np.ndarray
    v: np.ndarray
    internal: np.ndarray
    external: np.ndarray
    support: np.ndarray
    contact: np.ndarray
    kinetic: float = 0.0
    energy: StrainEnergy = StrainEnergy()


def moment_of(stepper: Stepper) -> Moment:
    """Return the data at the present state of a stepper."""
    state, inertia = stepper.state, stepper.model.inertia
    owned = stepper.model.mesh.n_owned
    a, v, momentum = state.a, state.v, state.v
    contact = state.contact
    if "contact_change" in state.memory:  # changes of accelerations by a treatment of impact
        contact = contact + state.memory["contact_change"]
    if inertia.products:
        momentum = inertia.mass_times(state.v, np.empty_like(state.v))
        a = inertia.mass_times(state.a, np.empty_like(state.a))
    if inertia.products or inertia.varies:
        v = inertia.damping_times(state.v, np.empty_like(state.v))
    internal = state.f[:owned]
    return Moment(
        momentum=momentum,
        velocity=state.v,
        acceleration=state.a,
        a=a,
        v=v,
        internal=internal if stepper.renews_forces else internal.copy(),
        external=state.external,
        support=state.support,
        contact=contact,
        energy=stepper.energy,
    )


def balanced(stepper: Stepper, before: Moment) -> Moment:
    """Return the forces of the last balance, for schemes whose balance does not hold at the ends of steps."""
    inertia, balance = stepper.model.inertia, stepper.balance
    state, u = stepper.state, stepper.solution.u
    owned = stepper.model.mesh.n_owned
    a = balance.alpha * u
    if balance.a_hat is not None:
        a += balance.a_hat
    v = balance.eta * u + balance.v_hat if inertia.damped else u
    if inertia.products:
        a = inertia.mass_times(a, np.empty_like(a))
    if inertia.products or inertia.varies:
        v = inertia.damping_times(v, np.empty_like(v))
    internal = before.internal
    if balance.weight == 1.0:
        internal = stepper.solution.internal[:owned]
    elif balance.weight:
        internal = (1.0 - balance.weight) * internal + balance.weight * stepper.solution.internal[:owned]
    return Moment(
        before.momentum,
        before.velocity,
        before.acceleration,
        a,
        v,
        internal,
        state.external,
        state.support,
        state.contact,
    )
