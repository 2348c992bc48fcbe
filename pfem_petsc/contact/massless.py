"""Contact nodes without mass along the normals of their walls: in equilibrium, or on the wall."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..tolerances import ON_BOUND, ROUNDING
from .node_walls import WallForces

if TYPE_CHECKING:
    from ..stepping.model import Model


_ITERATIONS = 200
_CALMER, _BOLDER = 0.7, 1.3  # factors that shorten moves while they oscillate, and lengthen them up to full moves
_FARTHEST = 0.25  # longest single move, relative to the shortest bar of the node
_STEEPEST = 0.05  # minimum squared cosine between bars and the normal in the stiffness
_SOFTEST = 1e-4  # smallest accepted ratio between secant and elastic stiffness, either way; below it is rounding


class MasslessNodes:
    """Contact nodes whose mass is redistributed."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.moved = model.inertia.redistribution
        self._force = np.zeros((model.mesh.n_local, 3))

    def settle(self, x: np.ndarray, time: float, now: float) -> float:
        """Move nodes of ``x`` (local, 3), in place, along their normals into equilibrium or onto the wall.

        Forces, walls and bars are those of ``time``; afterwards bars are reset to ``now`` [s]. Returns
        the largest of the last moves, which is rounding of the model's length unless no equilibrium was found.
        Collective.
        """
        model, moved = self.model, self.moved
        owned, nodes, n = model.mesh.n_owned, moved.nodes, moved.normals
        external = np.zeros((owned, 3))
        if model.external.active:
            model.external.at(time, external)
        model.change_bars(time)
        model.mesh.update_ghosts(x)  # a scheme predicts owned nodes alone
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
            # where bars yield or rotate, the elastic stiffness would need hundreds of moves
            stiffness = np.where((secant > _SOFTEST * elastic) & (secant < elastic / _SOFTEST), secant, elastic)
            swings = step * force < 0.0  # massless neighbours may push each other back and forth
            part = np.where(swings, _CALMER * part, np.minimum(_BOLDER * part, 1.0))
            move = np.clip(part * force / stiffness, -farthest, farthest)
            step = np.maximum(move, -np.maximum(gap, 0.0))
            x[nodes] += step[:, None] * n
            # with a bar perpendicular to the normal, forces within rounding may leave the position undetermined
            open_way = np.minimum(np.abs(step), np.abs(force) / elastic)
            largest = model.comm.allreduce(float(open_way.max(initial=0.0)), op=MPI.MAX)
            if largest <= ROUNDING * model.size:
                break
        model.mesh.update_ghosts(x)
        model.change_bars(now)
        return largest

    def gaps(self, x: np.ndarray, time: float) -> np.ndarray:
        """Return the distances (m,) of the nodes from the wall along their vectors [m]."""
        gaps = self.model.contact.gaps(x[self.moved.nodes], time, self.moved.nodes)
        return gaps[np.arange(len(gaps)), self.model.contact.wall_of[self.moved.walls]] / self.moved.across

    def press(self, x: np.ndarray, load: np.ndarray, time: float) -> tuple[np.ndarray, WallForces]:
        """Return wall forces (owned, 3) that balance a load on nodes at x (owned, 3), and their sums.

        The residual force on a massless node in equilibrium is the force of its wall.
        """
        moved, contact = self.moved, self.model.contact
        n, nodes = moved.normals, moved.nodes
        strength = -np.einsum("mi,mi->m", load[nodes], n)
        touching = self.gaps(x, time) <= ON_BOUND * self.model.size
        strength = np.where(touching, np.maximum(strength, 0.0), 0.0) / moved.across
        full = contact.normals[moved.walls]
        force = np.zeros_like(load)
        force[nodes] = strength[:, None] * full
        if not len(nodes):
            return force, contact.nothing
        touched = np.zeros((len(nodes), len(contact.wall_of)), dtype=bool)
        touched[np.arange(len(nodes)), moved.walls] = strength > 0.0
        each = touched[:, :, None] * (strength[:, None] * full)[:, None, :]
        return force, contact.sums(nodes, each, (x[nodes], x[nodes]), touched)

    def _stiffness(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return stiffness (m,) of nodes along their normals at fixed neighbours [N/m], and their longest moves [m].

        A bar perpendicular to the normal has geometric stiffness only, so a minimum inclination is assumed.
        """
        mesh, model = self.model.mesh, self.model
        a, b = mesh.bars.T
        total = np.zeros(mesh.n_local)
        shortest = np.full(mesh.n_local, np.inf)
        normal = np.zeros((mesh.n_local, 3))
        normal[self.moved.nodes] = self.moved.normals
        way = x[b] - x[a]
        length = np.linalg.norm(way, axis=1)
        stiffness = model.bars.of_blocks(lambda block: block.area * block.modulus) / model.bars.rest
        for end in (a, b):
            along = np.einsum("bi,bi->b", way, normal[end]) / length
            np.add.at(total, end, stiffness * np.maximum(along * along, _STEEPEST))
            np.minimum.at(shortest, end, model.bars.rest)
        return total[self.moved.nodes], _FARTHEST * shortest[self.moved.nodes]
