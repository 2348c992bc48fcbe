"""Nodes without mass along their walls' normals: they are in equilibrium there, or on the wall, at all times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..contact.forces import WallForces
from ..tolerances import ON_BOUND, ROUNDING

if TYPE_CHECKING:
    from .model import Model

__all__ = ["MasslessNodes"]

_ITERATIONS = 200
_CALMER, _BOLDER = 0.7, 1.3  # by which moves become smaller while they swing, and larger again, up to whole ones
_FARTHEST = 0.25  # of a node's shortest bar: the longest single move
_STEEPEST = 0.05  # cosine squared to the normal that bars are taken to have at least
_SOFTEST = 1e-4  # secant stiffness over the elastic one, or the other way round, that is taken for more than rounding


class MasslessNodes:
    """The contact nodes of a model whose mass is redistributed."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.moved = model.inertia.redistribution
        self._force = np.zeros((model.mesh.n_local, 3))

    def settle(self, x: np.ndarray, time: float, now: float) -> float:
        """Move nodes of ``x`` (local, 3), in place, along their normals into equilibrium or onto the wall.

        Forces, walls and temperatures are those of ``time``; temperatures are then as they were at ``now`` [s]. Gives
        the last and largest move, which is rounding of the model's length unless they have found no equilibrium.
        Collective.
        """
        model, moved = self.model, self.moved
        owned, nodes, n = model.mesh.n_owned, moved.nodes, moved.normals
        external = np.zeros((owned, 3))
        if model.external.active:
            model.external.at(time, external)
        if model.temperatures.varying:
            model.temperatures.apply(time)
        elastic, farthest = self._stiffness(x)
        stiffness, force, step = elastic, np.full(len(nodes), np.nan), np.zeros(len(nodes))
        part, largest = np.ones(len(nodes)), 0.0
        for _ in range(_ITERATIONS):
            gap = self.gaps(x[:owned], time)
            x[nodes] -= np.minimum(gap, 0.0)[:, None] * n
            model.mesh.update_ghosts(x)
            model.bars.forces(x, self._force, commit=False)
            last, force = force, np.einsum("mi,mi->m", external[nodes] - self._force[nodes], n)
            with np.errstate(invalid="ignore", divide="ignore"):
                secant = (last - force) / step
            # where bars yield or turn, the elastic stiffness would take hundreds of moves
            stiffness = np.where((secant > _SOFTEST * elastic) & (secant < elastic / _SOFTEST), secant, elastic)
            swings = step * force < 0.0  # neighbours that have no mass either push each other to and fro
            part = np.where(swings, _CALMER * part, np.minimum(_BOLDER * part, 1.0))
            move = np.clip(part * force / stiffness, -farthest, farthest)
            step = np.maximum(move, -np.maximum(gap, 0.0))
            x[nodes] += step[:, None] * n
            # a bar square to the normal may leave the place open that a force of rounding decides over
            open_way = np.minimum(np.abs(step), np.abs(force) / elastic)
            largest = model.comm.allreduce(float(open_way.max(initial=0.0)), op=MPI.MAX)
            if largest <= ROUNDING * model.length:
                break
        model.mesh.update_ghosts(x)
        if model.temperatures.varying:
            model.temperatures.apply(now)
        return largest

    def gaps(self, x: np.ndarray, time: float) -> np.ndarray:
        """How far the nodes (m,) can move along their vectors until they are on the wall [m]."""
        gaps = self.model.contact.gaps(x[self.moved.nodes], time, self.moved.nodes)
        return gaps[np.arange(len(gaps)), self.moved.walls] / self.moved.across

    def press(self, x: np.ndarray, load: np.ndarray, time: float) -> tuple[np.ndarray, WallForces]:
        """Forces (owned, 3) of the walls that keep nodes at x (owned, 3) in equilibrium with a load, and their sums.

        A node without mass that is in equilibrium feels its wall alone.
        """
        moved, contact = self.moved, self.model.contact
        n, nodes = moved.normals, moved.nodes
        strength = -np.einsum("mi,mi->m", load[nodes], n)
        touching = self.gaps(x, time) <= ON_BOUND * self.model.length
        strength = np.where(touching, np.maximum(strength, 0.0), 0.0) / moved.across
        full = contact.normals[moved.walls]
        force = np.zeros_like(load)
        force[nodes] = strength[:, None] * full
        if not len(nodes):
            return force, contact.nothing
        touched = np.zeros((len(nodes), len(contact.names)), dtype=bool)
        touched[np.arange(len(nodes)), moved.walls] = strength > 0.0
        each = touched[:, :, None] * (strength[:, None] * full)[:, None, :]
        return force, contact.sums(nodes, each, x[nodes], touched)

    def _stiffness(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness (m,) of the nodes along their normals, their neighbours at rest [N/m], and their longest moves [m].

        A bar that is square to the normal has its force alone to give stiffness: it is taken to lean a little.
        """
        mesh, model = self.model.mesh, self.model
        a, b = mesh.bars.T
        total = np.zeros(mesh.n_local)
        shortest = np.full(mesh.n_local, np.inf)
        normal = np.zeros((mesh.n_local, 3))
        normal[self.moved.nodes] = self.moved.normals
        way = x[b] - x[a]
        length = np.linalg.norm(way, axis=1)
        axial = np.concatenate(
            [np.full(k.stop - k.start, k.area * k.modulus) for k in model.bars.blocks] or [np.zeros(0)]
        )
        for end in (a, b):
            along = np.einsum("bi,bi->b", way, normal[end]) / length
            np.add.at(total, end, axial / model.bars.rest * np.maximum(along * along, _STEEPEST))
            np.minimum.at(shortest, end, model.bars.rest)
        return total[self.moved.nodes], _FARTHEST * shortest[self.moved.nodes]
