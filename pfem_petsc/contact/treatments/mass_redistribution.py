"""No mass on contact nodes along the walls' normals, after Khenous, Laborde and Renard (2008).

For motions along the normal n of its wall, the mass m of a contact node is moved to the neighbours that its bars
connect it to away from the wall. The mass of a node becomes a matrix, m I - m n n^T at the contact node and
m_j I + w m n n^T at its neighbours; the total is conserved. A contact node then follows its neighbours by equilibrium
along n: its force is continuous in time, no spike grows as 1/h, and impact loses no energy. This requires plane walls
with a node set, and each node in one wall only.

Supports override walls: if they prescribe components of a contact node, n is the free part of the wall's normal, scaled
to a unit vector, and the wall does not apply to a node that it cannot move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ...errors import InputError
from ...integrators.base import Scheme
from ...parallel.agreement import agreed
from ...tolerances import FREE_PART, ON_BOUND, ROUNDING
from ..node_walls import WallForces
from .base import Treatment as Base

if TYPE_CHECKING:
    from ...stepping.model import Model


_ITERATIONS = 200
_CALMER, _BOLDER = 0.7, 1.3  # factors that shorten moves while they oscillate, and lengthen them up to full moves
_FARTHEST = 0.25  # longest single move, relative to the shortest bar of the node
_STEEPEST = 0.05  # minimum squared cosine between bars and the normal in the stiffness
_SOFTEST = 1e-4  # smallest accepted ratio between secant and elastic stiffness, either way; below it is rounding


@dataclass(frozen=True)
class Redistribution:
    """The redistributed masses of this rank. Contact nodes have none along the normals of their walls: there they are
    in equilibrium, or on the wall.

    Attributes
    ----------
    nodes : (m,) owned contact nodes that can move along their walls' normals
    walls : (m,) wall of each
    normals : (m, 3) unit vectors along the free parts of these walls' normals
    across : (m,) lengths of these parts: a node that moves by d along its vector moves away from the wall by
        ``across`` d
    touched : (k,) owned nodes whose mass is a matrix, ascending
    tensors : (k, 3, 3) the matrix minus mass times identity [kg]
    inverses : (k, 3, 3) inverse of the matrix on the free components [1/kg]; zero on others, and where there is no mass
    """

    nodes: np.ndarray
    walls: np.ndarray
    normals: np.ndarray
    across: np.ndarray
    touched: np.ndarray
    tensors: np.ndarray
    inverses: np.ndarray

    def add_times(self, factor: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add the product of the tensors with vectors ``u`` (owned, 3), times a factor."""
        out[self.touched] += factor * np.einsum("kij,kj->ki", self.tensors, u[self.touched])

    def settle(self, model: Model, x: np.ndarray, time: float, now: float) -> float:
        """Move nodes of ``x`` (local, 3), in place, along their normals into equilibrium or onto the wall.

        Forces, walls and bars are those of ``time``; afterwards bars are reset to ``now`` [s]. Returns
        the largest of the last moves, which is rounding of the model's length unless no equilibrium was found.
        Collective.
        """
        owned, nodes, n = model.mesh.n_owned, self.nodes, self.normals
        external, internal = np.zeros((owned, 3)), np.zeros((model.mesh.n_local, 3))
        if model.external.active:
            model.external.at(time, external)
        model.change_bars(time)
        model.mesh.update_ghosts(x)  # a scheme predicts owned nodes alone
        elastic, farthest = self._stiffness(model, x)
        stiffness, force, step = elastic, np.full(len(nodes), np.nan), np.zeros(len(nodes))
        part, largest = np.ones(len(nodes)), 0.0
        for _ in range(_ITERATIONS):
            gap = self.gaps(model, x[:owned], time)
            x[nodes] -= np.minimum(gap, 0.0)[:, None] * n
            model.mesh.update_ghosts(x)
            model.bars.forces(x, internal, commit=False)
            last, force = force, np.einsum("mi,mi->m", external[nodes] - internal[nodes], n)
            with np.errstate(invalid="ignore", divide="ignore"):
                secant = (last - force) / step
            # where bars yield or rotate, the elastic stiffness would need hundreds of moves
            stiffness = np.where((secant > _SOFTEST * elastic) & (secant < elastic / _SOFTEST), secant, elastic)
            swings = step * force < 0.0  # massless neighbours may push each other back and forth
            part = np.where(swings, _CALMER * part, np.minimum(_BOLDER * part, 1.0))
            step = np.maximum(np.clip(part * force / stiffness, -farthest, farthest), -np.maximum(gap, 0.0))
            x[nodes] += step[:, None] * n
            # with a bar perpendicular to the normal, forces within rounding may leave the position undetermined
            open_way = np.minimum(np.abs(step), np.abs(force) / elastic)
            largest = model.comm.allreduce(float(open_way.max(initial=0.0)), op=MPI.MAX)
            if largest <= ROUNDING * model.size:
                break
        model.mesh.update_ghosts(x)
        model.change_bars(now)
        return largest

    def gaps(self, model: Model, x: np.ndarray, time: float) -> np.ndarray:
        """Return the distances (m,) of the nodes from the wall along their vectors [m]."""
        gaps = model.contact.gaps(x[self.nodes], time, self.nodes)
        return gaps[np.arange(len(gaps)), model.contact.wall_of[self.walls]] / self.across

    def press(self, model: Model, x: np.ndarray, load: np.ndarray, time: float) -> tuple[np.ndarray, WallForces]:
        """Return wall forces (owned, 3) that balance a load on nodes at x (owned, 3), and their sums.

        The residual force on a massless node in equilibrium is the force of its wall.
        """
        contact, nodes = model.contact, self.nodes
        strength = -np.einsum("mi,mi->m", load[nodes], self.normals)
        touching = self.gaps(model, x, time) <= ON_BOUND * model.size
        strength = np.where(touching, np.maximum(strength, 0.0), 0.0) / self.across
        force, touched = np.zeros_like(load), np.zeros((len(nodes), len(contact.wall_of)), dtype=bool)
        touched[np.arange(len(nodes)), self.walls] = strength > 0.0
        each = touched[:, :, None] * (strength[:, None] * contact.surfaces.normals[self.walls])[:, None, :]
        force[nodes] = each.sum(axis=1)
        return force, contact.sums(nodes, each, (x[nodes], x[nodes]), touched)

    def _stiffness(self, model: Model, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return stiffness (m,) of nodes along their normals at fixed neighbours [N/m], and their longest moves [m].

        A bar perpendicular to the normal has geometric stiffness only, so a minimum inclination is assumed.
        """
        mesh = model.mesh
        total, shortest = np.zeros(mesh.n_local), np.full(mesh.n_local, np.inf)
        normal = np.zeros((mesh.n_local, 3))
        normal[self.nodes] = self.normals
        way = x[mesh.bars[:, 1]] - x[mesh.bars[:, 0]]
        length = np.linalg.norm(way, axis=1)
        stiffness = model.bars.of_blocks(lambda block: block.area * block.modulus) / model.bars.rest
        for end in mesh.bars.T:
            along = np.einsum("bi,bi->b", way, normal[end]) / length
            np.add.at(total, end, stiffness * np.maximum(along * along, _STEEPEST))
            np.minimum.at(shortest, end, model.bars.rest)
        return total[self.nodes], _FARTHEST * shortest[self.nodes]


def redistribute(model: Model) -> Redistribution:
    """Compute the redistributed masses. Collective.

    Raises
    ------
    InputError
        On all ranks, for walls that are not planes or name no node set, nodes with several walls, and nodes without
        neighbours.
    """
    contact, mesh, inertia = model.contact, model.mesh, model.inertia
    key = f'{model.case.source}: contact.treatment = "mass_redistribution"'
    for k, wall in enumerate(contact.walls):
        if not wall.flat or wall.partial or contact.motion.turning[k] or contact.all_nodes[k]:
            raise InputError(
                f"{key}: wall {contact.names[k]!r} must be a plane, not curved nor a rectangle, must not turn, "
                "and name a node_set: its nodes lose mass; use another contact.treatment"
            )
    other = "use another contact.treatment"
    for applies, text in (
        (inertia.damped, "a node without mass cannot be damped; use a material without damping, no [[dashpot]]"),
        (model.bars.springs is not None, f"a node without mass cannot have a [[spring]]; {other}"),
        (model.supports.inclined is not None, f"normal and frame of a [[support]] must be along axes; or {other}"),
        (
            model.external.state_forces,
            f"a node without mass cannot follow [wind], whose force depends on its velocity; {other}",
        ),
    ):
        if applies:
            raise InputError(f"{key}: {text}")
    owned = mesh.n_owned
    with agreed(mesh.comm):
        several = np.flatnonzero(contact.members.sum(axis=1) > 1)
        if len(several):
            raise InputError(f"{key}: node {mesh.node_ids[several[0]]} belongs to several walls; give it one")
    # normal, mass and sum of weights of contact nodes, known to all ranks that see them
    info = np.zeros((mesh.n_local, 5))
    nodes = np.flatnonzero(contact.members.any(axis=1))
    walls = contact.members[nodes].argmax(axis=1)
    free = np.where(contact.fixed[nodes], 0.0, contact.surfaces.normals[walls])
    across = np.sqrt((free * free).sum(axis=1))
    can = across**2 > FREE_PART  # move off their walls
    nodes, walls, free, across = nodes[can], walls[can], free[can] / across[can, None], across[can]
    info[nodes, :3], info[nodes, 3] = free, inertia.mass[nodes]
    mesh.update_ghosts(info)
    here, there = np.hstack([mesh.bars.T, mesh.bars.T[::-1]])  # of each bar in both directions
    way = mesh.points[there] - mesh.points[here]
    weight = np.einsum("bi,bi->b", way, info[here, :3]) ** 2 / (way * way).sum(axis=1)
    weight[~((info[here, 3] > 0.0) & (info[there, 3] <= 0.0))] = 0.0
    np.add.at(info[:, 4], here, weight)
    mesh.update_ghosts(info)
    with agreed(mesh.comm):
        lone = nodes[info[nodes, 4] <= 1e-6]
        if len(lone):
            raise InputError(
                f"{key}: node {mesh.node_ids[lone[0]]} has no bar that leads away from its wall, so its mass "
                "cannot be redistributed; leave it out of the wall's node_set"
            )
    tensors = np.zeros((owned, 3, 3))
    normals = info[:, :3]
    tensors[nodes] -= info[nodes, 3, None, None] * normals[nodes, :, None] * normals[nodes, None, :]
    give = np.flatnonzero((weight > 0.0) & (there < owned))
    share, n = weight[give] / info[here[give], 4] * info[here[give], 3], normals[here[give]]
    np.add.at(tensors, there[give], share[:, None, None] * n[:, :, None] * n[:, None, :])
    touched = np.flatnonzero(np.abs(tensors).max(axis=(1, 2), initial=0.0) > 0.0)
    movable = ~model.supports.fixed[touched]
    matrices = inertia.mass[touched, None, None] * np.eye(3) + tensors[touched]
    matrices *= movable[:, :, None] & movable[:, None, :]
    inverses = np.linalg.pinv(matrices, rcond=1e-10, hermitian=True)
    return Redistribution(nodes, walls, free, across, touched, tensors[touched], inverses)


class Treatment(Base):
    """Removes the mass of contact nodes along the walls' normals."""

    elastic = True

    @classmethod
    def refuses(cls, scheme: Scheme) -> str | None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        if scheme.explicit and not scheme.solves_next_position:
            return "of the explicit schemes only central_differences and noh_bathe can have nodes without mass"
        return None

    @classmethod
    def prepare(cls, model: Model) -> None:
        """Redistribute the mass of the contact nodes. Collective."""
        if model.links:
            raise InputError(
                f'{model.case.source}: contact.treatment = "mass_redistribution": only walls can have massless nodes; '
                "use another treatment with contact_pair"
            )
        model.inertia.redistribution = redistribute(model)

    def before(self) -> None:
        """Record the initial positions of nodes."""
        self._start = self.stepper.state.position.copy()

    def after(self) -> None:
        """Set velocities and accelerations without inertia to those of the secant, which prevents unseen growth."""
        stepper, state = self.stepper, self.stepper.state
        if stepper.scheme.explicit:
            return
        moved = stepper.model.inertia.redistribution
        nodes, n = moved.nodes, moved.normals
        memory = self.remembered(nodes)
        secant = (state.position[nodes] - self._start[nodes]) / stepper.part
        state.v, state.a = state.v.copy(), state.a.copy()
        state.v[nodes] += np.einsum("mi,mi->m", secant - state.v[nodes], n)[:, None] * n
        state.a[nodes] -= np.einsum("mi,mi->m", state.a[nodes], n)[:, None] * n
        stepper.scheme.restart(state, nodes, stepper.part)
        # along the normals alone, where there is no momentum that jumps
        for name, kept in memory.items():
            state.memory[name][nodes] = kept + np.einsum("mi,mi->m", state.memory[name][nodes] - kept, n)[:, None] * n
