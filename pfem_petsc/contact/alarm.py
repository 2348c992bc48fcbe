"""Check of contact when results are written: a node beyond a wall is an error, whatever the treatment.

The positions that a step solves for satisfy every wall to rounding, with all schemes and treatments, so these are
checked. With Wilson's method they are x_tau at t + theta h, not x1, which may be beyond a wall by at most the
displacement between the two, (theta - 1) h v. Walls whose ``node_set`` does not contain the node are skipped, and so
are rectangles, which nodes can pass beside. Supports that prescribe a node along the normal override the wall. If they
move a node beyond it, the input contradicts itself and is reported too, for rectangles by the step that crosses them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..tolerances import BEYOND
from .free_parts import held_by_supports

if TYPE_CHECKING:
    from ..stepping.stepper import Stepper
    from .contact import Contact

__all__ = ["CarriedNodes", "check_positions"]


def check_positions(stepper: Stepper) -> None:
    """Check that no node lies beyond a wall, with one pass over the nodes and one reduction. Collective.

    Parameters
    ----------
    stepper : Stepper
        At the end of a step.

    Raises
    ------
    SimulationFailure
        On all ranks, with the wall, its deepest node and depth, the number of nodes, the step, and the remedy.
    """
    model, state, balance = stepper.model, stepper.state, stepper.balance
    contact, comm = model.contact, model.comm
    if not contact.any:
        return
    x, time = state.position, state.time
    if not stepper.scheme.solves_end:
        if balance is None:  # at the start, or right after a restart: checked before
            return
        x, time = balance.predictor + stepper.solution.u, balance.time
    gaps = contact.gaps(x, time)
    gaps[:, [wall.partial for wall in contact.walls]] = np.inf
    tolerance = BEYOND * max(model.size, model.reach)
    # a NaN has its own message elsewhere
    suspects = np.flatnonzero((gaps < -tolerance).any(axis=1))
    if comm.allreduce(len(suspects), op=MPI.MAX) == 0:
        return
    deepest = (0.0, -1, -1)
    if len(suspects):
        at, wall = np.unravel_index(int(gaps[suspects].argmin()), (len(suspects), len(contact.walls)))
        deepest = (float(gaps[suspects[at], wall]), int(model.mesh.node_ids[suspects[at]]), int(wall))
    depth, node, wall = min(comm.allgather(deepest))
    count = comm.allreduce(int((gaps[:, wall] < -tolerance).sum()))
    carried = comm.allreduce(deepest == (depth, node, wall) and _prescribed(contact, suspects[at], wall, x, time))
    where = f"step {stepper.number}, t = {stepper.place:.6g} s"
    if carried:
        raise SimulationFailure(_told(where, node, -depth, contact.names[wall], count))
    case = model.case
    others = "another contact.treatment or time.integrator"
    if case.contact.treatment != "scheme":
        others = f'contact.treatment = "scheme" instead of "{case.contact.treatment}"'
    raise SimulationFailure(
        f"{where}: node {node} is {-depth:.3g} m beyond wall {contact.names[wall]!r} "
        f"({count} node{'s' if count > 1 else ''} in all), which contact did not prevent: results since it "
        f"passed the wall are wrong; reduce time.step, or use {others}"
    )


def _told(where: str, node: int, depth: float, wall: str, count: int) -> str:
    """Return the message about nodes that supports move beyond a wall."""
    return (
        f"{where}: node {node} is {depth:.3g} m beyond wall {wall!r} "
        f"({count} node{'s' if count > 1 else ''} in all), moved there by its supports; let the wall move with "
        "the supports, name the nodes that it stops with 'node_set', or do not tie them"
    )


class CarriedNodes:
    """Nodes of this rank whose motion along the normal of a rectangle is prescribed, so that contact cannot stop them.

    Only the step in which a node crosses shows that it did not come from beside or behind, so every step is checked.

    Attributes
    ----------
    of : index of each rectangle that applies to such nodes, to these nodes (k,)
    """

    def __init__(self, contact: Contact) -> None:
        self._contact = contact
        self._before: dict[int, np.ndarray] = {}
        self.of: dict[int, np.ndarray] = {}
        for k, wall in enumerate(contact.walls):
            if wall.partial:
                nodes = np.flatnonzero(contact.members[:, k] & held_by_supports(contact.fixed, wall.normal))
                self.of |= {k: nodes} if len(nodes) else {}

    def start(self, x: np.ndarray, time: float) -> None:
        """Keep where they are at the start of a step, from all positions (owned, 3) [m] at a time [s]."""
        if self.of:
            self._before = self._places(x, time)

    def _places(self, x: np.ndarray, time: float) -> dict[int, np.ndarray]:
        """Return their positions (k, 3) [m] relative to the rectangles, from all positions (owned, 3)."""
        displacements = self._contact.motion.displacements(time)
        return {k: x[nodes] - displacements[k] for k, nodes in self.of.items()}

    def crossing(self, x: np.ndarray, time: float, where: str) -> str | None:
        """Return the message about nodes that have crossed a rectangle since :meth:`start`, None if there are none."""
        contact, tolerance = self._contact, BEYOND * self._contact.size
        after = self._places(x, time)
        for k, nodes in self.of.items():
            wall = contact.walls[k]
            depth = wall.offset - after[k] @ wall.normal
            crossed = (depth > tolerance) & wall.stops(self._before[k], after[k], np.full(len(nodes), tolerance))
            if crossed.any():
                at = int(np.argmax(np.where(crossed, depth, 0.0)))
                node = int(contact.mesh.node_ids[nodes[at]])
                return _told(where, node, float(depth[at]), contact.names[k], int(crossed.sum()))
        return None


def _prescribed(contact: Contact, node: int, wall: int, x: np.ndarray, time: float) -> bool:
    """Return whether supports prescribe an owned node along a wall's normal, or some components of a tied node.

    ``x`` (owned, 3) : positions [m]
    """
    if contact.ties.any and contact.ties.held[node] and contact.fixed[node].any():
        return True
    normals, _ = contact.planes(
        np.ones((1, len(contact.walls)), dtype=bool), x[[node]], contact.motion.displacements(time)
    )
    return bool(held_by_supports(contact.fixed[node], normals[0, wall]))
