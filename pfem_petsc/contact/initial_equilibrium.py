"""Initial contact equilibrium: accelerations and contact forces of nodes that rest on walls or on each other.

A node that touches a wall and does not move along its normal is not accelerated into it: with the walls' forces r and
accelerations a_w,

    M a = f + r,   0 <= n . (a - a_w)  complementary to  the normal force in r,

and likewise with n . (a_2 - a_1) of closed pairs. r includes friction: opposite to the velocity of a node that slides,
else the force that prevents sliding, up to the limit of the wall. Without r a truss at rest on a floor would start with
a velocity error of h g, which decays slowly with some schemes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..tolerances import ON_BOUND
from .friction import planes_at_rest
from .node_walls import WallForces
from .projection import NodesAtPlanes, pressed

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..mechanics.mass import Inertia
    from .constraint_set import ConstraintSet

_ROUNDS = 60  # each at least halves the error


def start_at_rest(
    links: ConstraintSet,
    inertia: Inertia,
    state: State,
    accelerate: Callable[[np.ndarray], np.ndarray],
    load: np.ndarray,
    still: float,
) -> WallForces | None:
    """Set acceleration and contact forces of resting nodes in the state; return the forces per wall. Collective.

    The forces follow from projections with the lumped mass, in one iteration if the mass is lumped. The eigenvalues of
    a consistent mass are between one third and one times the lumped one, so projections with half the lumped mass
    halve the error in every iteration.

    Parameters
    ----------
    links : ConstraintSet, with the walls of the case
    inertia : Inertia
    state : with ``state.a`` without walls
    accelerate : returns the acceleration (owned, 3) with M a = load. Collective
    load : (owned, 3) without walls [N]
    still : velocity that counts as none [m/s]

    Returns
    -------
    WallForces or None
        None if no node of any rank rests on a wall or on another node, or if no contact force is needed.
    """
    contact, comm, mass = links.contact, links.contact.mesh.comm, inertia.mass
    x, v = state.position, state.v
    poses = contact.motion.poses(state.time)
    slack = ON_BOUND * contact.size
    nodes = np.flatnonzero(contact.near(x, poses, np.array([slack])))
    applicable = contact.members[nodes]
    normals, gaps = contact.distances(applicable, x[nodes], poses)
    rates = contact.rates(x[nodes], state.time, ahead=True)
    away = np.einsum("mwi,mwi->mw", normals, v[nodes][:, None, :] - rates)
    resting = applicable & (np.abs(gaps) <= slack) & (np.abs(away) <= still)
    partial = np.array([wall.partial for wall in contact.walls], dtype=bool)
    resting[:, partial[contact.wall_of]] = False  # the plane of a partial wall extends beyond the wall
    resting[:, np.isin(contact.wall_of, contact.motion.bodies.at)] = False  # walls with mass are not fixed
    kept = resting.any(axis=1)
    nodes, resting = nodes[kept], resting[kept]
    share = 0.5 if inertia.consistent else 1.0
    weight = share * mass[nodes]
    closed = links.resting(x, v, slack, still)
    held = np.zeros(contact.members.shape, dtype=bool)
    held[nodes] = resting

    hold = np.zeros((len(nodes), 3))  # free components of the walls' forces
    between = np.zeros_like(load)  # likewise for the links
    for _ in range(_ROUNDS if inertia.consistent else 1):
        apart = state.a - between / (share * mass[:, None])
        apart[nodes] -= hold / weight[:, None]
        earlier = between
        # links first, as in a step: they account for the walls
        between = links.rest(apart, share * mass, closed, held, still)
        free = apart[nodes] + between[nodes] / weight[:, None]
        planes = planes_at_rest(contact, resting, (x[nodes], v[nodes], free), still)
        found = pressed(NodesAtPlanes(free, contact.fixed[nodes], weight, planes), 0.0)
        before, hold = hold, weight[:, None] * (found.x - free)
        sizes = [np.abs(part).max(initial=0.0) for part in (hold - before, between - earlier, hold, between)]
        last_hold, last_between, *largest = np.max(comm.allgather(sizes), axis=0)
        if max(last_hold, last_between) <= 1e-13 * max(largest):
            break
        total = load + between
        total[nodes] += hold
        state.a = accelerate(total)
    if max(largest) == 0.0:
        return None
    force = found.normal[:, :, None] * planes.normals + found.drag
    state.contact = np.zeros_like(load)
    state.contact[nodes] = force.sum(axis=1)
    links.add_forces(state.contact)
    return contact.sums(nodes, force, (x[nodes], x[nodes]), found.normal > 0.0)
