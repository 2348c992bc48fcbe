"""No mass on contact nodes along the walls' normals, after Khenous, Laborde and Renard (2008).

The mass m of a contact node moves, for motions along its wall's normal n, to the neighbours that its bars lead to away
from the wall: the mass of a node becomes a matrix, m I - m n n^T at the contact node and m_j I + w m n n^T at its
neighbours, with the total kept. A contact node then follows its neighbours by equilibrium along n: its force is
continuous in time, no spike grows as 1/h, and impact loses no energy. Needs plane walls
with a node set, each node in one wall only.
"""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from ...parallel.agreement import agreed
from .base import Jump
from .base import Treatment as Base

__all__ = ["Redistribution", "Treatment", "redistribute"]


class Redistribution:
    """The masses moved, on this rank.

    Attributes
    ----------
    nodes, normals : (m,), (m, 3) owned contact nodes and their walls' unit normals
    touched : (k,) owned nodes whose mass is a matrix, ascending
    tensors : (k, 3, 3) what the matrix is beyond mass times identity [kg]
    """

    def __init__(self, nodes: np.ndarray, normals: np.ndarray, touched: np.ndarray, tensors: np.ndarray) -> None:
        self.nodes = nodes
        self.normals = normals
        self.touched = touched
        self.tensors = tensors


def redistribute(model) -> Redistribution:
    """Work out the masses to move. Collective.

    Raises
    ------
    InputError
        On all ranks: walls that are not plane or name no node set, nodes of several walls, nodes without neighbours.
    """
    contact, mesh, inertia = model.contact, model.mesh, model.inertia
    source = model.case.source
    key = f'{source}: contact.treatment = "mass_redistribution"'
    for k, wall in enumerate(contact.walls):
        if not wall.flat or contact.everyone[k]:
            raise InputError(f"{key}: wall {contact.names[k]!r} must be plane and name a node_set: its nodes lose mass")
    if inertia.damped:
        raise InputError(f"{key}: a node without mass cannot be damped; take a material without damping")
    owned = mesh.n_owned
    members = contact.members
    with agreed(mesh.comm):
        several = np.flatnonzero(members.sum(axis=1) > 1)
        if len(several):
            raise InputError(f"{key}: node {mesh.node_ids[several[0]]} belongs to several walls; give it one")
    # normal, mass and sum of weights of contact nodes, known to all ranks that see them
    info = np.zeros((mesh.n_local, 5))
    nodes = np.flatnonzero(members.any(axis=1))
    info[nodes, :3] = contact.normals[members[nodes].argmax(axis=1)]
    info[nodes, 3] = inertia.mass[nodes]
    mesh.update_ghosts(info)
    is_contact = info[:, 3] > 0.0
    a, b = mesh.bars.T
    weights = []
    for here, there in ((a, b), (b, a)):
        way = mesh.points[there] - mesh.points[here]
        squared = np.einsum("bi,bi->b", way, info[here, :3]) ** 2 / (way * way).sum(axis=1)
        weights.append(np.where(is_contact[here] & ~is_contact[there], squared, 0.0))
        np.add.at(info[:, 4], here, weights[-1])
    mesh.update_ghosts(info)
    with agreed(mesh.comm):
        lone = nodes[info[nodes, 4] <= 1e-6]
        if len(lone):
            raise InputError(
                f"{key}: node {mesh.node_ids[lone[0]]} has no bar that leads away from its wall, so its mass has "
                "nowhere to go; leave it out of the wall's node_set"
            )
    tensors = np.zeros((owned, 3, 3))
    normals = info[:, :3]
    tensors[nodes] -= info[nodes, 3, None, None] * normals[nodes, :, None] * normals[nodes, None, :]
    for (here, there), weight in zip(((a, b), (b, a)), weights, strict=True):
        give = np.flatnonzero((weight > 0.0) & (there < owned))
        share = weight[give] / info[here[give], 4] * info[here[give], 3]
        n = normals[here[give]]
        np.add.at(tensors, there[give], share[:, None, None] * n[:, :, None] * n[:, None, :])
    touched = np.flatnonzero(np.abs(tensors).max(axis=(1, 2), initial=0.0) > 0.0)
    return Redistribution(nodes, normals[nodes].copy(), touched, tensors[touched])


class Treatment(Base):
    """No mass on contact nodes along the walls' normals."""

    elastic = True

    def before(self) -> None:
        """Keep where nodes start."""
        self._start = self.stepper.state.position.copy()

    def after(self) -> None:
        """What has no mass has no velocity and acceleration of its own: the secant's, so that nothing grows unseen."""
        stepper, state = self.stepper, self.stepper.state
        if stepper.scheme.explicit:
            return
        moved = stepper.model.inertia.redistribution
        nodes, n = moved.nodes, moved.normals
        # no momentum jumps along the normals, but the scheme's memory is made anew
        self.jump = Jump(nodes, state.v[nodes], state.a[nodes], 0.0, self.remembered(nodes))
        secant = (state.position[nodes] - self._start[nodes]) / stepper.part
        state.v, state.a = state.v.copy(), state.a.copy()
        state.v[nodes] += np.einsum("mi,mi->m", secant - state.v[nodes], n)[:, None] * n
        state.a[nodes] -= np.einsum("mi,mi->m", state.a[nodes], n)[:, None] * n
        stepper.scheme.restart(state, nodes, stepper.part)
