"""Candidates for contact with walls in an implicit step: nodes, the walls that may stop them, and their order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..integrators.base import Balance, State
from ..tolerances import BEYOND

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .contact import Contact

__all__ = ["Candidates", "expected_candidates"]


@dataclass(frozen=True)
class Candidates:
    """Nodes whose unknowns have bounds.

    Attributes
    ----------
    nodes : (m,) owned local indices, ascending; applicable : (m, walls) bool, walls that may stop them
    priority : (m, walls) order of the walls, lowest first; None: by distance
    anywhere : whether any rank has candidates
    """

    nodes: np.ndarray
    applicable: np.ndarray
    priority: np.ndarray | None = None
    anywhere: bool = True

    def join(
        self,
        contact: Contact,
        displacements: np.ndarray,
        joined: np.ndarray,
        broken: np.ndarray,
        x: np.ndarray,
        strengths: np.ndarray,
        largest_rank: float,
    ) -> Candidates:
        """Return the candidates of the next solve: violated walls first, then those that press, then by distance.

        Parameters
        ----------
        contact : Contact
        displacements : (walls, 3) of walls [m]
        joined, broken : (k,) nodes beyond walls, and (k, walls) bool, which walls
        x : (owned, 3) positions [m]
        strengths : (m, walls) normal forces on the present candidates [N]
        largest_rank : offset that orders walls that press before all open ones [m]
        """
        nodes = np.union1d(self.nodes, joined)
        applicable = np.zeros((len(nodes), len(contact.walls)), dtype=bool)
        applicable[np.searchsorted(nodes, joined)] = broken
        place = np.searchsorted(nodes, self.nodes)
        applicable[place] |= self.applicable
        normals, offsets = contact.planes(applicable, x[nodes], displacements)
        priority = np.einsum("iwk,ik->iw", normals, x[nodes]) - offsets
        normal_forces = strengths > 0.0
        largest = max(float(strengths.max(initial=0.0)), 1e-300)
        held = priority[place]
        held[normal_forces] = -largest_rank * (1.0 + strengths[normal_forces] / largest)
        priority[place] = held
        return Candidates(nodes, applicable, priority)

    def without(self, held: np.ndarray) -> Candidates:
        """Return the candidates with no applicable walls at tied nodes, ``held`` (owned,) bool."""
        return replace(self, applicable=self.applicable & ~held[self.nodes][:, None])


def expected_candidates(
    model: Model, state: State, balance: Balance, held: np.ndarray, displacements: np.ndarray
) -> Candidates:
    """Return the owned nodes that may touch a wall in a step, among them those in contact before it. Collective.

    ``held`` (owned,) bool : nodes in contact before the step; ``displacements`` (walls, 3) : of the walls at the time
    of the balance [m]
    """
    contact, walls = model.contact, len(model.contact.walls)
    nobody = Candidates(np.empty(0, dtype=np.int64), np.zeros((0, walls), dtype=bool), anywhere=False)
    if not contact.any:
        return nobody
    move = (balance.time - state.time) * state.v
    reach = 0.5 * np.linalg.norm(move, axis=1) + BEYOND * model.size
    near = held | contact.near(state.position + move, displacements, reach) | contact.ties.held
    if model.comm.allreduce(int(near.any()), op=MPI.MAX) == 0:
        return nobody
    nodes = np.flatnonzero(near)
    return Candidates(
        nodes, _within_reach(model, state, nodes, (state.position + move)[nodes], displacements, reach[nodes])
    )


def _within_reach(
    model: Model, state: State, nodes: np.ndarray, x: np.ndarray, displacements: np.ndarray, reach: np.ndarray
) -> np.ndarray:
    """Return (m, walls) bool: walls that nodes (m,) moving to (m, 3) touch or come within reach (m,) [m] of."""
    contact = model.contact
    applicable = contact.applicable(nodes, x, displacements)
    within = np.zeros_like(applicable)
    starts = state.position[nodes], contact.motion.displacements(state.time), BEYOND * model.size
    for place, there, distance in ((x, displacements, reach[:, None]), starts):
        normals, offsets = contact.planes(applicable, place, there)
        within |= np.einsum("mwi,mi->mw", normals, place) - offsets < distance
    return within & applicable
