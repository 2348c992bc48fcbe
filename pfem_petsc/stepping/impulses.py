"""The impulse ledger: impulses of forces and velocity jumps on the truss, integrated by the scheme itself.

Momentum is linear in the forces, so the scheme integrates a history of forces for the truss as for a single particle of
unit mass that they act on; the velocity of that particle is their impulse. Each source of force has such a particle, so
that

    momentum(t) - momentum(0) = external + support + damping + sum over walls (impulse + jump_impulse)

holds to rounding with any scheme, including multistep schemes and bisected steps. If a treatment of impact changes the
velocity, acceleration or scheme memory of nodes, the same changes, times the nodal masses, are applied to a particle
without forces; its velocity is the impulse of the jumps. The moments of turning walls about their axes have particles
likewise, whose first component is the angular impulse. The forces of contact pairs cancel in the sum; their impulse
is that on the second nodes. Momentum that a jump of a pair removes from a supported node is transferred to the support,
and so is the difference between prescribed velocities and those of the scheme.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..columns import HEAD, PAIR, WALL
from ..integrators.base import State
from ..mechanics.compiled import kernel
from ..tolerances import RANK

if TYPE_CHECKING:
    from ..contact.node_walls import WallForces
    from .stepper import Stepper

__all__ = ["DAMPING", "EXTERNAL", "SUPPORT", "WALLS", "ContactSums", "Impulses", "NoImpulses", "record_forces"]

SUPPORT, EXTERNAL, DAMPING, WALLS = 0, 1, 2, 3
"""Rows of the particles: three in the order of the totals of :class:`~pfem_petsc.stepping.ledger.Ledger`, then walls
and pairs, then the jumps of walls and pairs; then the moments of walls about their axes and those of jumps, if any wall
turns."""

IN_COLUMNS = (EXTERNAL, SUPPORT, DAMPING)
"""The first rows of the particles in the order of the columns of the history."""

_IMPULSES, _CHANGES = HEAD.first("external_impulse"), HEAD.width
_WALL, _PAIR = WALL.width, PAIR.width
_WALL_FORCE, _WALL_MOMENT, _WALL_IMPULSE, _WALL_JUMP, _CONTACTS, _RELEASES = map(
    WALL.first, ("force", "moment", "impulse", "jump_impulse", "contacts", "releases")
)
_PAIR_FORCE, _PAIR_IMPULSE, _PAIR_JUMP = map(PAIR.first, ("force", "impulse", "jump_impulse"))


class ContactSums(NamedTuple):
    """This rank's sums at the end of a step: ``force`` [N] and ``moment`` [N m] of walls (walls, 3), ``contacts`` and
    ``releases`` (walls,) of nodes, ``totals`` (tables, 3) forces of tables of pairs and constraints [N]."""

    force: np.ndarray
    moment: np.ndarray
    contacts: np.ndarray
    releases: np.ndarray
    totals: np.ndarray


@kernel
def record_forces(particles, sums, changes, row):
    """Write all impulses, and the sums of contact, into this rank's share of a row, see
    :class:`~pfem_petsc.columns.Share`; ``particles`` (rows, 3) [N s], ``changes``: of contacts since the last row."""
    w, t = len(sums.contacts), len(sums.totals)
    at, jumps = _CHANGES + (1 if w > 0 else 0), WALLS + w + t
    for k in range(3):
        for c in range(3):
            row[_IMPULSES + 3 * k + c] = particles[IN_COLUMNS[k], c]
    if w > 0:
        row[_CHANGES] = changes
    for k in range(w):
        for c in range(3):
            row[at + _WALL_FORCE + c] = sums.force[k, c]
            row[at + _WALL_MOMENT + c] = sums.moment[k, c]
            row[at + _WALL_IMPULSE + c] = particles[WALLS + k, c]
            row[at + _WALL_JUMP + c] = particles[jumps + k, c]
        row[at + _CONTACTS], row[at + _RELEASES] = sums.contacts[k], sums.releases[k]
        at += _WALL
    for k in range(t):
        for c in range(3):
            row[at + _PAIR_FORCE + c] = sums.totals[k, c]
            row[at + _PAIR_IMPULSE + c] = particles[WALLS + w + k, c]
            row[at + _PAIR_JUMP + c] = particles[jumps + w + k, c]
        at += _PAIR


def _wall_shares(stepper: Stepper, nodes: np.ndarray, touching: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """Divide vectors (m, 3) at nodes (m,) among the walls that they touch, (m, slots) bool; return (m, slots, 3)."""
    contact = stepper.model.contact
    shares = np.where(touching[:, :, None], jumps[:, None, :], 0.0)
    several = np.flatnonzero(touching.sum(axis=1) > 1)
    if len(several):
        at = nodes[several]
        poses = contact.motion.poses(stepper.state.time)
        normals, _ = contact.planes(touching[several], stepper.state.position[at], poses, nodes=at)
        normals = np.where(touching[several][:, :, None], normals, 0.0)
        parts = np.einsum("miw,mi->mw", np.linalg.pinv(normals, rcond=RANK), jumps[several])
        own = parts[:, :, None] * normals
        rest = jumps[several] - own.sum(axis=1)
        count = touching[several].sum(axis=1)[:, None, None]
        shares[several] = own + np.where(touching[several][:, :, None], rest[:, None, :] / count, 0.0)
    return shares


class Impulses:
    """This rank's share of all impulses.

    Attributes
    ----------
    state : of the particles; v (rows, 3) are the impulses [N s]
    force : (rows, 3) of the last balance [N]
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        model = stepper.model
        self.links = model.links
        self.n_walls = len(model.contact.names)
        self.n_links = len(model.links.columns)
        self.jumps = WALLS + self.n_walls + self.n_links
        self.turns = self.jumps + self.n_walls + self.n_links
        self._turning = self.n_walls if model.contact.motion.turning.any() else 0
        rows = self.turns + 2 * self._turning
        self.state = State(*(np.zeros((rows, 3)) for _ in range(7)))
        self.force = np.zeros((rows, 3))

    def start(self, totals: np.ndarray) -> None:
        """Initialise from this rank's sums (3, 3) of support, external and damping force at the start [N]."""
        scheme, h = self.stepper.scheme, self.stepper.part_before_start
        self.state.a = self.forces(totals, self.stepper.walls_at_start, self.stepper.links_at_start).copy()
        scheme.start(self.state, h)

    def forces(self, totals: np.ndarray, walls: WallForces, links: np.ndarray) -> np.ndarray:
        """Write totals (3, 3), the forces of walls and links (tables, 3), and moments of walls that turn, into
        :attr:`force` [N]."""
        self.force[:WALLS] = totals
        self.force[WALLS : WALLS + self.n_walls] = walls.force
        self.force[WALLS + self.n_walls : self.jumps] = links
        if self._turning:
            self.force[self.turns : self.turns + self._turning, 0] = self._torques(walls.force, walls.moment)
        return self.force

    def _torques(self, force: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Return the moments (walls,) of walls about their axes [N m], see
        :meth:`~pfem_petsc.contact.wall_motion.WallMotion.torques`."""
        return self.stepper.model.contact.motion.torques(force, moment, self.stepper.state.time)

    def step(self, totals: np.ndarray, part: float) -> None:
        """Add the forces of the last balance, after a substep of size ``part`` [s]; ``totals`` (3, 3) are support,
        external and damping force [N]."""
        stepper, state = self.stepper, self.state
        walls = stepper.solution.walls
        self._before = self._given()
        if stepper.step_changed:
            stepper.scheme.step_changed(state)
        balance = stepper.scheme.balance(state, part)
        load = self.forces(totals, walls, self.links.totals())
        u = (load if balance.a_hat is None else load - balance.a_hat) / balance.alpha
        stepper.scheme.finish(state, balance, u, part)
        for name, change in stepper.prescribed.change.items():
            state.rates[name][SUPPORT] += change

    def jump(self) -> None:
        """Add the velocity jumps of the treatment in this step."""
        stepper, state, jump = self.stepper, self.state, self.stepper.jump
        for name, before in (("v", jump.v), ("a", jump.a), *jump.memory.items()):
            self._add(state.rates[name], jump.nodes, jump.walls, stepper.state.rates[name][jump.nodes] - before)

    def _given(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the impulses of walls (walls, 3) [N s], and the angular ones about their axes [N m s], (0,) if none
        turns; jumps included."""
        v, n, m = self.state.v, self.n_walls, self._turning
        turns = v[self.turns : self.turns + m, 0] + v[self.turns + m : self.turns + 2 * m, 0]
        return v[WALLS : WALLS + n] + v[self.jumps : self.jumps + n], turns

    def mean_pushes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the momentum that walls gave in the last step over its size, (walls, 3) [N], and the angular momentum
        about their axes, (walls,) [N m], or (0,) if none turns."""
        part, walls, turns = self.stepper.part, *self._given()
        return (walls - self._before[0]) / part, (turns - self._before[1]) / part

    def _add(self, particles: np.ndarray, nodes: np.ndarray, walls: np.ndarray, change: np.ndarray) -> None:
        mass = self.stepper.model.inertia.mass  # treatments that set velocities require lumped mass
        momentum = mass[nodes, None] * change
        first = self.jumps
        if self.n_walls:
            shares = _wall_shares(self.stepper, nodes, walls, momentum)
            given = self.stepper.model.contact.of_walls(shares.sum(axis=0))
            particles[first : first + self.n_walls] += given
            if self._turning:
                arms = self.stepper.state.position[nodes][:, None, :]
                moments = self.stepper.model.contact.of_walls(np.cross(arms, shares).sum(axis=0))
                particles[self.turns + self._turning :, 0] += self._torques(given, moments)
            momentum = momentum - shares.sum(axis=1)
        table = self.links.tables(len(mass))[nodes]
        for k in range(self.n_links):
            particles[first + self.n_walls + k] += momentum[table == k].sum(axis=0)
        # links conserve momentum except for the part that supports at their nodes receive
        particles[SUPPORT] += momentum.sum(axis=0)

    def kept(self) -> dict[str, Any]:
        """Return this rank's share for a checkpoint: numbers that can be summed over ranks."""
        state = self.state
        return {"v": state.v.tolist(), "a": state.a.tolist()} | {
            f"memory.{name}": array.tolist() for name, array in state.memory.items()
        }

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore this rank's share from a checkpoint."""
        shape = self.state.v.shape
        self.state.memory = {}
        for name, values in kept.items():
            array = np.array(values, dtype=float).reshape(shape)
            if name.startswith("memory."):
                self.state.memory[name.removeprefix("memory.")] = array
            else:
                setattr(self.state, name, array)


class NoImpulses(Impulses):
    """For balances without inertia, where no time passes: all impulses are zero."""

    def __init__(self, stepper: Stepper) -> None:
        super().__init__(stepper)
        self._last = self._mean = self._pushes()

    def start(self, totals: np.ndarray) -> None:
        """Nothing."""

    def step(self, totals: np.ndarray, part: float) -> None:
        """Take the forces of walls before and after the step."""
        before, self._last = self._last, self._pushes()
        self._mean = 0.5 * (before[0] + self._last[0]), 0.5 * (before[1] + self._last[1])

    def _pushes(self) -> tuple[np.ndarray, np.ndarray]:
        walls = self.stepper.solution.walls
        torques = self._torques(walls.force, walls.moment) if self._turning else np.zeros(0)
        return walls.force.copy(), torques

    def mean_pushes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the means of forces and moments of walls before and after the last step, (walls, 3) [N] and (walls,)
        [N m]."""
        return self._mean
