"""The guard of implicit steps, which rejects converged solutions that are unrelated to the previous state.

The equations of a large step have many solutions, such as a dome turned inside out or a mirrored layer of cells.
Newton's method finds one of them, and residual, energy ledger and bar lengths look plausible in all. Three checks
distinguish them. They use only the positions before and after the step, the positions predicted from the previous
motion, and the available energy, so they apply to time steps and load steps alike:

1. **Unpredicted turns.** The vector d of a bar changes by |d1 - d0| and differs from the prediction d_p by |d1 - d_p|.
   If the smaller of both exceeds :data:`LARGEST` times the length of the bar, the step is too large to follow the
   motion. A rotation by the angle phi per step gives phi^2/2, so 40 degrees per step are accepted; an impact gives
   v h/l. A mirrored bar gives up to 2, even if its length, and thus its energy, is unchanged.
2. **Energy.** The bars store much more energy than before, and more than was available: the kinetic energy at the start
   plus the work of loads, supports and walls.
3. **Barriers.** Between the positions before and after, the bars store more energy than at either, and more than was
   available: the kinetic energy at the start plus the work up to that point. No motion can follow such a path. The
   lowest of three paths counts: the straight line, the parabola that starts as predicted, and the lower of both after
   its nodes have given way, see below. Only this check finds shallow arches and domes that snap through.

A bar that turns by phi is shorter by phi^2/8 of its length at the middle of the straight line. On the parabola it is so
by 0.003 phi^4 if the velocities are those of the rotation; those of stiff bars contain the noise of their vibration.
This energy grows with the stiffness of the bar, although nodes that are free to do so go around on an arc. The third
path lets them: its displacements w at mid-path minimise

    sum of k [(n . d - (mean length - length))^2 + e d . d],    e = :data:`SIDEWAYS`

with the difference d of the displacements of both ends of a bar, its stiffness k and direction n. A bar on an arc gets
the mean of its lengths before and after; the bars of a flat arch, in line with each other, cannot. The second term
prevents that nodes slide down from the barrier: a bar of inclination s gets s^2/(s^2 + e) of the length that it lacks
by turning. As this term also slows down the correction on an arc, by e/(1 + e), the minimisation is repeated.

Energies are evaluated only if the unpredicted change of a bar exceeds :data:`NOTICEABLE` times its length.

The limits are based on measurements. The built-in cases with all implicit schemes at their steps stay below 0.1 in the
first check (bars next to an impact, v h/l = 0.1), below 0.03 of the available energy in the second, and have no
barrier; Wilson's chatter at theta = 1.4 reaches 0.2 and 0.16. Observed jumps have 0.39 lengths, 120 times the energy,
or barriers of two to seven times the available energy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import kernel
from ..solvers.matrix import largest_distance

if TYPE_CHECKING:
    from .model import Model

__all__ = ["GAIN", "LARGEST", "NOTICEABLE", "OVER", "StepGuard"]

LARGEST = 0.25
"""Largest accepted unpredicted change of a bar's vector in a step, relative to its rest length."""
NOTICEABLE = 0.01
"""Unpredicted change above which energies along the path are checked."""
GAIN = 4.0
"""Largest energy gain of the bars relative to that available up to mid-path; the trapezoidal rule from rest has 2."""
OVER = 1.0
"""Largest accepted height of a barrier relative to the available energy."""
SIDEWAYS = 0.05
"""Stiffness of a bar, relative to that along it, against the displacements of nodes that give way at mid-path."""
_ROUNDS = 4  # of corrections of mid-path
_ITERATIONS = 200  # of conjugate gradients for each of them
_SOLVED = 1e-8  # reduction of the residual, squared


def _vectors(bars: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the vectors (b, 3) from first to second ends of bars at positions (local, 3) [m]."""
    return x[bars[:, 1]] - x[bars[:, 0]]


@kernel
def _largest_miss(bars, rest, before, after, predicted):
    """Largest change of a bar's vector that is not predicted, over its rest length, and the number of that bar."""
    worst, at = -1.0, 0
    for k in range(len(bars)):
        a, b = bars[k, 0], bars[k, 1]
        changed = missed = 0.0
        for c in range(3):
            end = after[b, c] - after[a, c]
            changed += (end - (before[b, c] - before[a, c])) ** 2
            missed += (end - (predicted[b, c] - predicted[a, c])) ** 2
        value = np.sqrt(min(changed, missed)) / rest[k] if rest[k] > 0.0 else 0.0  # a bar that has left the model
        if not value <= worst:
            worst, at = value, k
            if value != value:  # what is not a number is the worst of all
                break
    return worst, at


@kernel
def _pull(bars, axes, stiffness, lacking, w, out):
    """Add to ``out`` the forces on nodes (n, 3) by bars of some ``stiffness`` (b,) with directions ``axes`` (b, 3) that
    lack lengths (b,) and turn by displacements w (n, 3)."""
    for k in range(len(bars)):
        a, b, along = bars[k, 0], bars[k, 1], -lacking[k]
        for c in range(3):
            along += axes[k, c] * (w[b, c] - w[a, c])
        for c in range(3):
            force = stiffness[k] * (along * axes[k, c] + SIDEWAYS * (w[b, c] - w[a, c]))
            out[a, c] += force
            out[b, c] -= force


class StepGuard:
    """Checks solutions before they become the state; has no memory of its own.

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
        """Return why a step is rejected, None if it is accepted; the same on all ranks. Collective.

        Parameters
        ----------
        before, after : (local, 3) positions with ghosts at its start and end [m]
        predicted : (owned, 3) positions at its end if the motion continues unchanged; for a load step, if the last step
            is repeated
        energy : this rank's share of the available energy [J]: kinetic energy at the start, and half of the work done
            on the truss, as up to mid-path
        """
        comm, mesh = self.model.comm, self.model.mesh
        self._predicted[: mesh.n_owned] = predicted
        mesh.update_ghosts(self._predicted)
        worst = self._unpredicted(before, after)
        largest = comm.allreduce(worst[0], op=MPI.MAX)
        if not largest > NOTICEABLE:
            return None
        if largest > LARGEST:
            value, bar, nodes, change, turn = max(comm.allgather(worst))
            return (
                f"the solution is too far from the previous state: bar {bar} between nodes {nodes[0]} and {nodes[1]} "
                f"changes by {change:.3g} of its length and turns by {turn:.3g} degrees, {value:.3g} lengths from the "
                "predicted position"
            )
        return self._barrier(before, after, energy)

    def _unpredicted(self, before: np.ndarray, after: np.ndarray) -> tuple[float, int, tuple[int, int], float, float]:
        """Return the largest unpredicted change of a bar of this rank, and of that bar number, nodes, change and turn:
        changes in lengths, turn in degrees."""
        mesh, rest = self.model.mesh, self.model.bars.rest
        if len(mesh.bars) == 0:
            return 0.0, -1, (-1, -1), 0.0, 0.0
        watched = self.model.bars.watched
        if 2.0 * largest_distance(after, self._predicted) <= NOTICEABLE * watched.min():  # the ends of any bar
            return 0.0, -1, (-1, -1), 0.0, 0.0
        value, k = _largest_miss(mesh.bars, watched, before, after, self._predicted)
        start, end = (_vectors(mesh.bars[k : k + 1], x)[0] for x in (before, after))
        lengths = np.linalg.norm(start) * np.linalg.norm(end)
        turn = np.degrees(np.arccos(np.clip(start @ end / max(lengths, 1e-300), -1.0, 1.0)))
        nodes = int(mesh.node_ids[mesh.bars[k, 0]]), int(mesh.node_ids[mesh.bars[k, 1]])
        change = float(np.linalg.norm(end - start) / rest[k])
        return float(value), int(mesh.bar_ids[k]), nodes, change, float(turn)

    def _barrier(self, before: np.ndarray, after: np.ndarray, energy: float) -> str | None:
        """Check energies of bars at both ends and at mid-path, with the initial internal variables. Collective."""
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
        if straight < curved:
            np.add(before, after, out=middle)
            middle *= 0.5
        top, allowed = min(straight, curved), max(start, end) + OVER * energy
        for _ in range(_ROUNDS):
            if not top > allowed:
                return None
            self._give_way(before, after)
            top = min(top, self.model.comm.allreduce(self._stored(middle)))
        if not top > allowed:
            return None
        return (
            f"the solution lies beyond an energy barrier: on the way there the bars hold {top:.3g} J, before and after "
            f"{start:.3g} and {end:.3g} J, and {energy:.3g} J were available to pass it"
        )

    def _give_way(self, before: np.ndarray, after: np.ndarray) -> None:
        """Move the nodes at mid-path so that bars keep the mean of their lengths before and after. Collective.

        Supports hold nodes, and walls those in contact, along the contact force. Conjugate gradients need not converge:
        any path will do.
        """
        model, middle, bars = self.model, self._middle, self.model.mesh.bars
        owned = model.mesh.n_owned
        axes = _vectors(bars, middle)
        lengths, *ends = (np.linalg.norm(_vectors(bars, x), axis=1) for x in (middle, before, after))
        lacking = 0.5 * (ends[0] + ends[1]) - lengths
        axes /= np.maximum(lengths, 1e-300)[:, None]
        push = model.contact.state.contact
        held = np.linalg.norm(push, axis=1, keepdims=True)
        push = push / np.where(held > 0.0, held, 1.0)

        def forces(w: np.ndarray, lacking: np.ndarray) -> np.ndarray:
            """Return the forces on owned nodes along their free directions, by displacements of owned nodes."""
            shift = np.zeros_like(middle)
            shift[:owned] = w
            model.mesh.update_ghosts(shift)
            out = np.zeros_like(middle)
            _pull(bars, axes, model.bars.stiffness, lacking, shift, out)
            free = out[:owned]
            free -= push * (free * push).sum(axis=1, keepdims=True)
            model.supports.clear(free)
            return free

        def product(a: np.ndarray, b: np.ndarray) -> float:
            return model.comm.allreduce(float((a * b).sum()))

        w = np.zeros((owned, 3))
        none, inverse = np.zeros_like(lacking), 1.0 / np.maximum(model.nodal_stiffness, 1e-300)[:, None]
        residual = forces(w, lacking)
        ahead = inverse * residual
        size = first = product(residual, ahead)
        for _ in range(_ITERATIONS):
            if not size > _SOLVED * first:
                break
            image = -forces(ahead, none)
            step = size / product(ahead, image)
            w += step * ahead
            residual -= step * image
            scaled = inverse * residual
            size, last = product(residual, scaled), size
            ahead = scaled + (size / last) * ahead
        middle[:owned] += w
        model.mesh.update_ghosts(middle)

    def _stored(self, x: np.ndarray) -> float:
        """Return the energy of this rank's bars, including plastic dissipation [J]; infinite if a bar has no length."""
        found = self.model.bars.forces(x, self._force, commit=False)
        return found.total if np.isfinite(found.total) else np.inf
