"""The guard of implicit steps: a converged step may be a solution that has nothing to do with the state before it.

The equations of a large step have many solutions: a dome turned inside out, a layer of cells that is mirrored. Newton's
method gives one of them, and residual, energy ledger and bar lengths look the same in all. Three checks tell them
apart, on nothing but the positions before and after, those that the motion so far predicts, and the energy at hand, so
that they serve steps in time and steps of load alike:

1. **Unpredicted turns.** The vector d of a bar changes by |d1 - d0|, and differs from the prediction d_p by |d1 - d_p|.
   Where the smaller of both is more than :data:`LARGEST` of the bar's length, the step is not small enough to follow
   the motion. A rotation by the angle phi in a step leaves phi^2/2, so that 40 degrees a step pass; an impact leaves
   v h/l. A mirrored bar leaves up to 2, also where its length, and with it its energy, is what it was.
2. **Energy.** The bars hold much more energy than before, and more than there was to give: kinetic energy at the start
   and the work of loads, supports and walls on the way.
3. **Barriers.** Between the positions before and after, the bars hold more energy than at either, and more than there
   was to give: kinetic energy at the start and the work to there. A motion cannot have
   come that way. The lower of two ways counts, the straight one and the parabola that starts as predicted, which a
   rotation follows but for 0.003 phi^4. Shallow arches and domes that snap are found by this alone.

Energies are only looked at where a bar has changed by more than :data:`NOTICEABLE` of its length without being
predicted.

Chosen by measurement: the built-in cases with all implicit schemes at their steps stay below 0.1 in the first (bars
next to an impact, v h/l = 0.1), below 0.03 of the energy at hand in the second, and have no barrier at all; Wilson's
chatter at theta = 1.4 reaches 0.2 and 0.16. The jumps seen have 0.39 lengths, 120 times the energy, or barriers of
two to seven times.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

if TYPE_CHECKING:
    from .model import Model

__all__ = ["GAIN", "LARGEST", "NOTICEABLE", "OVER", "StepGuard"]

LARGEST = 0.25
"""Unpredicted change of a bar's vector over its rest length that is too much for a step."""
NOTICEABLE = 0.01
"""Unpredicted change from which on the energy on the way is looked at."""
GAIN = 4.0
"""Energy that the bars gain over that at hand up to the middle of the way; the trapezoidal rule from rest has 2."""
OVER = 1.0
"""Height of a barrier over the energy at hand that no motion passes."""


class _Worst(NamedTuple):
    """The bar of a rank with the largest unpredicted change: in lengths, number, nodes, change, turn [degrees]."""

    value: float
    bar: int = -1
    nodes: tuple[int, int] = (-1, -1)
    change: float = 0.0
    turn: float = 0.0


class StepGuard:
    """Looks at solutions before they become the state. It remembers nothing.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        mesh = model.mesh
        self._predicted = np.zeros((mesh.n_local, 3))
        self._middle = np.zeros((mesh.n_local, 3))
        self._force = np.zeros((mesh.n_local, 3))

    def check(self, before: np.ndarray, after: np.ndarray, predicted: np.ndarray, energy: float) -> str | None:
        """What is wrong with a step, None for nothing; the same on all ranks. Collective.

        Parameters
        ----------
        before, after : (local, 3) positions with ghosts at its start and end [m]
        predicted : (owned, 3) positions at its end if the motion went on as it was; of a step of load as the last one
        energy : this rank's share of the energy at hand [J]: kinetic at the start, and half of the
            work done on the truss, as up to the middle of the way
        """
        comm, mesh = self.model.comm, self.model.mesh
        self._predicted[: mesh.n_owned] = predicted
        mesh.update_ghosts(self._predicted)
        worst = self._unpredicted(before, after)
        largest = comm.allreduce(worst.value, op=MPI.MAX)
        if not largest > NOTICEABLE:
            return None
        if largest > LARGEST:
            worst = max(comm.allgather(worst))
            return (
                f"the solution is too far from the previous state: bar {worst.bar} between nodes "
                f"{worst.nodes[0]} and {worst.nodes[1]} changes by {worst.change:.3g} of its length and turns by "
                f"{worst.turn:.3g} degrees, {worst.value:.3g} lengths from where its motion leads"
            )
        return self._barrier(before, after, energy)

    def _unpredicted(self, before: np.ndarray, after: np.ndarray) -> _Worst:
        """The bar of this rank that is least where its motion leads."""
        mesh, rest = self.model.mesh, self.model.bars.rest
        a, b = mesh.bars.T
        if len(a) == 0:
            return _Worst(0.0)
        start, end = before[b] - before[a], after[b] - after[a]
        change = np.linalg.norm(end - start, axis=1)
        missed = np.linalg.norm(end - (self._predicted[b] - self._predicted[a]), axis=1)
        values = np.minimum(change, missed) / rest
        k = int(np.argmax(values))
        lengths = np.linalg.norm(start[k]) * np.linalg.norm(end[k])
        turn = np.degrees(np.arccos(np.clip(start[k] @ end[k] / max(lengths, 1e-300), -1.0, 1.0)))
        nodes = int(mesh.node_ids[a[k]]), int(mesh.node_ids[b[k]])
        return _Worst(float(values[k]), int(mesh.bar_ids[k]), nodes, float(change[k] / rest[k]), float(turn))

    def _barrier(self, before: np.ndarray, after: np.ndarray, energy: float) -> str | None:
        """Energies of the bars at both ends and half way, all from the internal variables at the start. Collective."""
        middle = self._middle
        np.add(before, after, out=middle)
        middle *= 0.5
        straight = self._stored(middle)
        middle += 0.25 * (self._predicted - after)
        sums = np.array([self._stored(before), self._stored(after), straight, self._stored(middle), energy])
        self.model.comm.Allreduce(MPI.IN_PLACE, sums)
        start, end, straight, curved, energy = sums.tolist()
        if end - start > GAIN * energy:
            return (
                f"the solution has gained energy without a source: the bars hold {end:.3g} J instead of {start:.3g} J "
                f"before, and {2.0 * energy:.3g} J were available"
            )
        top = min(straight, curved)
        height = top - max(start, end)
        if not height > OVER * energy:
            return None
        return (
            f"the solution lies beyond an energy barrier: on the way there the bars hold {top:.3g} J, before and after "
            f"{start:.3g} and {end:.3g} J, and {energy:.3g} J were available to pass it"
        )

    def _stored(self, x: np.ndarray) -> float:
        """Energy of this rank's bars, what yielding takes included [J]; infinite where a bar has no length."""
        found = self.model.bars.forces(x, self._force, commit=False)
        return found.total if np.isfinite(found.total) else np.inf
