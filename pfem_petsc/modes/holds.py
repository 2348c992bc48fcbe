"""What does not move in a mode: components that supports prescribe, and what walls that press on nodes hold.

A wall that presses on a node holds it along the normal, one with friction, or to which the node is tied, in all
directions. A wall that a node touches without a force does not hold it. Where the wall is curved, its force turns with
the node: -F dn/dx is part of the stiffness there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..errors import SimulationFailure
from ..parallel.agreement import agreed
from ..tolerances import BEYOND, RANK

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["Holds"]

_PRESSES = (
    1e-9  # of the sum of the axial stiffnesses at a node times the model's length: a force of contact that counts
)
_DIFFERENCE = 1e-6  # of the model's length: half the distance over which normals of curved walls are compared


class Holds:
    """The directions held at this rank's nodes. Construction is collective.

    Parameters
    ----------
    model : Model
    state : State

    Attributes
    ----------
    held : (owned, 3) bool, components in each node's own directions, which are x, y, z but for nodes at walls
    number : of held components in the whole model
    at_walls : number of nodes of the whole model that walls hold
    curvature : owned nodes (m,) and blocks (m, 3, 3) [N/m] by which forces of curved walls change the stiffness; None
        where there are none

    Raises
    ------
    SimulationFailure
        On all ranks, where contact between nodes or a wall with mass holds what modes do not know.
    """

    def __init__(self, model: Model, state: State) -> None:
        self._mesh, self._comm = model.mesh, model.comm
        self.held = model.supports.fixed.copy()
        self.curvature: tuple[np.ndarray, np.ndarray] | None = None
        self._nodes, self._turns = np.empty(0, dtype=np.int64), np.empty((0, 3, 3))
        walls = None
        with agreed(model.comm):
            walls = _Walls(model, state) if model.can_touch else None
        if walls is not None:
            self._take(walls)
        self.at_walls = model.comm.allreduce(len(self._nodes))
        self.number = model.comm.allreduce(int(self.held.sum()))
        self._turn: PETSc.Mat | None = None
        if self.at_walls:
            self._turn = self._turning()

    def _take(self, walls: _Walls) -> None:
        nodes = walls.nodes
        directions = np.concatenate([walls.directions, np.einsum("mi,ij->mij", self.held[nodes], np.eye(3))], axis=1)
        # right singular vectors: orthonormal, those that are held first
        _, values, self._turns = np.linalg.svd(directions)
        self._nodes = nodes
        self.held[nodes] = values > RANK * values[:, :1]
        if model_wide(self._comm, len(walls.curved[0])):
            self.curvature = walls.curved

    def _turning(self) -> PETSc.Mat:
        """Block-diagonal: from each node's own directions to x, y, z."""
        owned, first = self._mesh.n_owned, 3 * self._mesh.first_node
        blocks = np.broadcast_to(np.eye(3), (owned, 3, 3)).copy()
        blocks[self._nodes] = self._turns.transpose(0, 2, 1)
        turn = PETSc.Mat().createAIJ(((3 * owned, None), (3 * owned, None)), bsize=3, nnz=3, comm=self._comm)
        columns = first + (3 * np.arange(owned)[:, None, None] + np.arange(3)).repeat(3, axis=1)
        pointers = 3 * np.arange(3 * owned + 1, dtype=PETSc.IntType)
        turn.setValuesCSR(pointers, columns.ravel().astype(PETSc.IntType), blocks.ravel())
        turn.assemble()
        return turn

    def taken_out(self, matrix: PETSc.Mat, diagonal: float | np.ndarray) -> PETSc.Mat:
        """A matrix in the nodes' own directions, with ``diagonal`` (owned,) at held components and no coupling of them
        to others; the one given may be changed. Collective."""
        if self._turn is not None:
            matrix = matrix.ptap(self._turn)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        if self.number:
            matrix.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
            rows = np.flatnonzero(self.held) + 3 * self._mesh.first_node
            matrix.zeroRowsColumns(rows.astype(PETSc.IntType), 0.0)
            values = matrix.getDiagonal()
            at = np.broadcast_to(np.reshape(diagonal, (-1, 1)), self.held.shape)
            values.array[self.held.ravel()] = at[self.held]
            matrix.setDiagonal(values)
        return matrix

    def to_axes(self, shapes: np.ndarray) -> np.ndarray:
        """Shapes (k, owned, 3) from the nodes' own directions to x, y, z; what is held is zero."""
        shapes = np.where(self.held, 0.0, shapes)
        shapes[:, self._nodes] = np.einsum("mij,kmi->kmj", self._turns, shapes[:, self._nodes])
        return shapes

    def to_own(self, shapes: np.ndarray) -> np.ndarray:
        """The other way round, what is held left out."""
        shapes = shapes.copy()
        shapes[:, self._nodes] = np.einsum("mij,kmj->kmi", self._turns, shapes[:, self._nodes])
        return np.where(self.held, 0.0, shapes)


def model_wide(comm: object, count: int) -> bool:
    """Whether any rank has some. Collective."""
    return comm.allreduce(count) > 0


class _Walls:
    """Nodes of this rank that walls press on.

    Attributes
    ----------
    nodes : (m,) ascending
    directions : (m, walls + 3, 3) held, zero rows where there are fewer
    curved : nodes (c,) and blocks (c, 3, 3) of :attr:`Holds.curvature`
    """

    def __init__(self, model: Model, state: State) -> None:
        contact, owned = model.contact, model.mesh.n_owned
        weight = np.abs(state.contact).max(axis=1, initial=0.0)
        presses = weight > _PRESSES * 1e-3 * model.nodal_stiffness * model.length
        tied = contact.ties.held if contact.ties.any else np.zeros(owned, dtype=bool)
        self.nodes = nodes = np.flatnonzero(presses | tied)
        x, displacements = state.position[nodes], contact.motion.displacements(state.time)
        applicable = contact.applicable(nodes, x, displacements)
        normals, offsets = contact.planes(applicable, x, displacements)
        gaps = np.einsum("mwi,mi->mw", normals, x) - offsets
        touched = np.abs(gaps) <= 10.0 * BEYOND * contact.length
        unknown = nodes[~touched.any(axis=1) & ~tied[nodes]]
        if len(unknown):
            raise SimulationFailure(
                f"modes: node {model.mesh.node_ids[unknown[0]]} is held by contact with other nodes (contact_pair, "
                "constraint), or its wall has left it in the last step: modes of such states are not available; let "
                "the analysis end in a state without that contact"
            )
        massive = [k for k in contact.motion.bodies.at if touched[:, k].any()]
        if massive:
            raise SimulationFailure(
                f"modes: wall {contact.names[massive[0]]!r} has mass and is in contact: modes of a truss with such a "
                "wall are not available; let the analysis end without that contact, or give the wall no mass"
            )
        rough = (touched & (contact.static_friction > 0.0)).any(axis=1) | tied[nodes]
        self.directions = np.zeros((len(nodes), normals.shape[1] + 3, 3))
        self.directions[:, :-3] = np.where(touched[:, :, None], normals, 0.0)
        self.directions[rough, -3:] = np.eye(3)
        self.curved = self._curved(model, state, touched & ~rough[:, None], normals)

    def _curved(
        self, model: Model, state: State, touched: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Minus the force times the derivative of the normal, for nodes at curved walls."""
        contact, nodes = model.contact, self.nodes
        displacements = contact.motion.displacements(state.time)
        blocks = np.zeros((len(nodes), 3, 3))
        if len(nodes) == 0 or contact.flat.all():
            return np.empty(0, dtype=np.int64), np.empty((0, 3, 3))
        forces = np.zeros(touched.shape)
        for m, node in enumerate(nodes):
            at = np.flatnonzero(touched[m])
            # supports take what they hold; the walls' forces are what is left of the contact force
            forces[m, at] = np.linalg.lstsq(normals[m, at].T, state.contact[node], rcond=None)[0]
        h = _DIFFERENCE * model.length
        for k in np.flatnonzero(~contact.flat):
            x = state.position[nodes] - displacements[k]
            for axis in range(3):
                shift = h * np.eye(3)[axis]
                slope = (contact.walls[k].planes(x + shift)[0] - contact.walls[k].planes(x - shift)[0]) / (2.0 * h)
                blocks[:, :, axis] -= forces[:, k, None] * slope
        at = np.flatnonzero((touched & ~contact.flat).any(axis=1))
        return nodes[at], 0.5 * (blocks + blocks.transpose(0, 2, 1))[at]
