"""Dynamic relaxation: nodes with fictitious mass move to equilibrium, the last digits come from Newton's method."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..contact.active_set import ActiveSet
from ..contact.contact import Candidates, expected_candidates
from ..errors import InputError, NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..mechanics.bars import StrainEnergy
from ..mechanics.compiled import kernel
from ..mechanics.elements import end_difference
from ..parallel.agreement import agreed
from ..solvers.matrix_free import add_blocks
from ..solvers.newton import Tolerance, largest_at_node
from ..stepping.stepper import Solution
from ..tolerances import TIME
from .stability import LARGEST, Stability
from .stepper import StaticStepper

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..solvers.linear import LinearChoice
    from ..stepping.model import Model


RESIDUAL, KINETIC, SUPPORTS, WALLS, BARS, FAILED, WIDTH = range(7)
"""Sums over all nodes: squares of the residual [N2], twice the kinetic energy, squares of the forces of supports, of
walls, of bars [N2], ranks that failed."""


@kernel
def add_up(r, v, mass):
    """Sums of r.r [N2] and m v.v over the nodes."""
    square = kinetic = 0.0
    for i in range(len(r)):
        square += r[i, 0] * r[i, 0] + r[i, 1] * r[i, 1] + r[i, 2] * r[i, 2]
        kinetic += mass[i] * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
    return square, kinetic


@kernel
def push(r, mass, factor, reach, v):
    """v = v + factor r/m (owned, 3), which is the displacement in a pseudo-step: of a node at most ``reach`` (owned,)
    [m]."""
    for i in range(len(r)):
        share = factor / mass[i]
        square = 0.0
        for c in range(3):
            v[i, c] += share * r[i, c]
            square += v[i, c] * v[i, c]
        if square > reach[i] * reach[i]:
            shorter = reach[i] / square**0.5
            for c in range(3):
                v[i, c] *= shorter


@kernel
def bound_stiffness(x, bars, counted, axial, stored):
    """Replace the stiffness ``stored`` (2, b) of bars, see ``Bars.stiffnesses``, by a larger one: along the bar that of
    the law at most, ``axial`` (b,), if that is larger, and N/l across it where it is under tension. Gives the sum of
    N.N over the bars ``counted`` here [N2]."""
    forces = 0.0
    for k in range(len(bars)):
        dx, dy, dz = end_difference(x, bars, k)
        square, c, g = dx * dx + dy * dy + dz * dz, stored[0, k], stored[1, k]
        forces += g * g * square if counted[k] else 0.0
        geometric = max(g, 0.0)
        stored[0, k] = max(max(c * square + g, axial[k]) - geometric, 0.0) / square if square > 0.0 else 0.0
        stored[1, k] = geometric
    return forces


@kernel
def bound_blocks(blocks, bound):
    """Write upper bounds of the eigenvalues of ``blocks`` (local, 6): xx, xy, xz, yy, yz, zz, to ``bound`` (owned,)."""
    for i in range(len(bound)):
        xx, yy, zz = blocks[i, 0], blocks[i, 3], blocks[i, 5]
        xy, xz, yz = abs(blocks[i, 1]), abs(blocks[i, 2]), abs(blocks[i, 4])
        rows = max(xx + xy + xz, yy + xy + yz, zz + yz + xz)
        squares = xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + yz * yz + xz * xz)
        bound[i] = min(rows, squares**0.5)


_SAFETY = 1.1  # s of the mass: bars turn and tighten between two estimates
_ESTIMATE_EVERY = 10  # pseudo-steps
_REACH = 0.1  # of its shortest bar: no node moves farther in a pseudo-step, so that none passes through another
_UNHURRIED = 10.0  # pseudo-steps in which a support moves as far as a node may in one: bars must turn out of its way
_SELF_STRESS = 1e-6  # of bar forces: smaller loads and reactions are none, the structure stresses itself


class PseudoMotion:
    """Moves a copy of the positions towards an equilibrium of the model. Construction is collective.

    Nodes go on from rest wherever the kinetic energy has passed a peak (kinetic damping).

    Attributes
    ----------
    x : (local, 3) positions with ghosts [m]
    f : (local, 3) internal force there [N]
    v : (owned, 3) pseudo-velocity [m per step]
    residual : (owned, 3) unbalanced force [N]
    contact : (owned, 3) force of walls [N]; ``walls`` their sums, ``held`` the nodes in contact
    mass : (owned,) [N/m]: the pseudo-step is 1
    energy : StrainEnergy at ``x``
    sums : (7,) see :data:`~pfem_petsc.statics.relaxation.RESIDUAL`
    steps : pseudo-steps since :meth:`begin`
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        mesh = model.mesh
        owned, local = mesh.n_owned, mesh.n_local
        self.x, self.f = np.zeros((local, 3)), np.zeros((local, 3))
        self.v, self.residual = np.zeros((owned, 3)), np.zeros((owned, 3))
        self.contact, self.walls = np.zeros((owned, 3)), model.contact.nothing
        self.held = np.empty(0, dtype=np.int64)
        self.external = np.zeros((owned, 3))
        self.mass = np.ones(owned)
        self.energy = StrainEnergy()
        self.steps = 0
        self.time = 0.0
        self.sums = np.zeros(WIDTH)
        self._before = np.zeros((owned, 3))  # residual of the pseudo-step before
        self._kinetic = -1.0  # its sum of the kinetic energy, negative at rest
        self._stored, self._blocks = np.zeros((2, len(mesh.bars))), np.zeros((local, 6))
        self._axial = model.bars.stiffness
        self._counted = np.zeros(len(mesh.bars), dtype=bool)
        self._counted[mesh.counted] = True
        reach = np.full(local, np.inf)
        np.minimum.at(reach, mesh.bars.ravel(), np.repeat(_REACH * model.bars.rest, 2))
        self._reach = reach[:owned].copy()
        self._failure: SimulationFailure | None = None
        self._external_norm = 0.0

    def begin(self, state: State, time: float, external: np.ndarray) -> None:
        """Start from the positions of a state, at rest, for the loads (owned, 3) [N] of a load factor. Collective."""
        owned, supports = self.model.mesh.n_owned, self.model.supports
        self.x[:owned] = state.position
        self.time, self.external, self.steps = time, external, 0
        self._lead_supports(supports.coordinates(state.position), supports.positions(time))
        self.v[:] = 0.0
        self._external_norm = float(np.sqrt(self.model.comm.allreduce(float((external**2).sum()))))
        self._kinetic = -1.0
        self._evaluate()

    def _lead_supports(self, start: np.ndarray, end: np.ndarray) -> None:
        """Move prescribed components (k,) to their positions in enough pseudo-steps to avoid crushed bars."""
        supports = self.model.supports
        self._start, self._end = start, end
        needed = float((np.abs(end - start) / self._reach[supports.every_node]).max(initial=0.0))
        self._arrival = int(np.ceil(_UNHURRIED * self.model.comm.allreduce(needed, op=MPI.MAX)))
        self._place_supports()

    def _place_supports(self) -> None:
        part = min(self.steps / self._arrival, 1.0) if self._arrival else 1.0
        places = self._end if part == 1.0 else self._start + part * (self._end - self._start)
        self.model.supports.place(self.x[: self.model.mesh.n_owned], places)

    @property
    def load(self) -> float:
        """Reference of the residual [N]: 2-norm of loads or reactions, or of bar forces if there are none."""
        acting = max(self._external_norm, float(np.sqrt(self.sums[SUPPORTS] + self.sums[WALLS])))
        bars = float(np.sqrt(self.sums[BARS]))
        return acting if acting > _SELF_STRESS * bars else bars

    @property
    def norm(self) -> float:
        """2-norm of the residual [N]."""
        return float(np.sqrt(self.sums[RESIDUAL]))

    def balanced(self, tolerance: float) -> bool:
        """Return whether the residual is at most a fraction of the load, or rounding. Collective."""
        model, required = self.model, tolerance * self.load
        if self.norm <= required:
            return True
        rounding = Tolerance(required, required, model.node_rounding, model.rounding)
        return rounding.rounded(self.norm, self.residual, 1.0, model.comm)

    def relax(self, tolerance: float, most: int) -> bool:
        """Move until the residual is ``tolerance`` of the load, or ``most`` pseudo-steps are made. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, for collapsed bars, infeasible walls, or positions that are not finite.
        """
        while self.steps < self._arrival or not self.balanced(tolerance):
            if self.steps >= most:
                return False
            self._move()
            self.steps += 1
            if self.steps <= self._arrival:
                self._place_supports()
            self._evaluate()
        return True

    def _move(self) -> None:
        """Make one pseudo-step of length one within the walls, or return to the peak of the kinetic energy.

        Velocities are those half a step before the positions.
        """
        x, energy = self.x[: self.model.mesh.n_owned], self.sums[KINETIC]
        if energy < self._kinetic:
            # x - 3/2 v + r/(2 m) of the previous step: the peak, by a parabola through three energies
            x -= 1.5 * self.v - 0.5 * self._before / self.mass[:, None]
            self.v[:] = 0.0
            self._kinetic = -1.0
            return
        self._before[:] = self.residual
        push(self.residual, self.mass, 0.5 if self._kinetic < 0.0 else 1.0, self._reach, self.v)
        self._kinetic = energy
        if self.model.contact.any:
            self._project(self.v)
        x += self.v

    def _project(self, u: np.ndarray) -> None:
        """Project increments (owned, 3) from ``x`` onto the walls, and store the forces."""
        owned, contact = self.model.mesh.n_owned, self.model.contact
        try:
            self.held, force, self.walls = contact.explicit(self.x[:owned], u, self.mass, self.time)
        except SimulationFailure as failure:
            self._failure = self._failure or failure
            return
        self.contact[:] = 0.0
        self.contact[self.held] = force

    def _evaluate(self) -> None:
        """Compute forces, residual and sums at the positions."""
        model = self.model
        model.mesh.update_ghosts(self.x)
        self.energy = model.bars.forces(self.x, self.f, commit=False)
        sums = np.zeros(WIDTH)
        if self.steps % _ESTIMATE_EVERY == 0:
            self._estimate()
        sums[BARS] = self._bar_forces
        np.subtract(self.external, self.f[: len(self.external)], out=self.residual)
        sums[SUPPORTS] = (model.supports.get(self.residual) ** 2).sum()
        model.supports.clear(self.residual)
        if model.contact.any:
            u = self.residual / self.mass[:, None]
            self._project(u)
            np.multiply(u, self.mass[:, None], out=self.residual)
            sums[WALLS] = (self.contact**2).sum()
        sums[RESIDUAL], sums[KINETIC] = add_up(self.residual, self.v, self.mass)
        sums[FAILED] = self.energy.failed >= 0 or self._failure is not None or not np.isfinite(sums).all()
        if model.comm.size > 1:
            model.comm.Allreduce(MPI.IN_PLACE, sums)
        self.sums = sums
        if sums[FAILED]:
            self._fail()

    def _estimate(self) -> None:
        """Compute masses at the current positions, from an upper bound of the eigenvalues of each node's diagonal block
        of the stiffness.

        The largest row sum bounds them, and so does the Frobenius norm, which does not depend on the axes. A bar counts
        with the larger of its present axial stiffness and that of its law at most, and with its geometric stiffness N/l
        where it is under tension.
        """
        bars, stored, blocks = self.model.bars, self._stored, self._blocks
        bars.stiffnesses(self.x, 1.0, stored)
        self._bar_forces = bound_stiffness(self.x, bars.ends, self._counted, self._axial, stored)
        blocks[:] = 0.0
        add_blocks(bars.ends, self.x, stored, blocks)
        bound_blocks(blocks, self.mass)
        self.mass *= 0.5 * _SAFETY
        # a node without bars has no stiffness of its own
        self.mass[self.mass == 0.0] = 1.0

    def _fail(self) -> None:
        """Raise on all ranks a failure of any rank."""
        model, when = self.model, f"load factor {self.time:.6g}, pseudo-step {self.steps}"
        with agreed(model.comm):
            if self._failure is not None:
                raise SimulationFailure(f"{when}: {self._failure}")
            if self.energy.failed >= 0:
                bar = model.mesh.bar_ids[self.energy.failed]
                raise SimulationFailure(
                    f"{when}: bar {bar} collapsed to zero length: the load crushes it; reduce the load or static.step"
                )
            if not np.isfinite(self.x).all() or not np.isfinite(self.f).all():
                raise SimulationFailure(f"{when}: positions or forces are not finite; reduce static.step")
        raise SimulationFailure(f"{when}: sums of forces overflow double precision; correct loads and stiffness")

    def potential(self, x: np.ndarray, energy: StrainEnergy) -> tuple[float, float]:
        """Return the strain energy minus the work of the loads from the current positions to ``x`` (owned, 3), and the
        sum of their magnitudes [J]. Collective."""
        works = self.external * (x - self.x[: len(x)])
        sums = np.array([energy.total - works.sum(), abs(energy.total) + np.abs(works).sum()])
        self.model.comm.Allreduce(MPI.IN_PLACE, sums)
        return float(sums[0]), float(sums[1])


# residuals relative to the load at which Newton's method is tried; the last one alone for large models
_HANDOVERS = (1e-2, 1e-4, 1e-6)
_NEAR = 0.05  # relative to the model's length: a solution farther from the relaxed positions is another equilibrium
_DOWN = 1e-10  # relative to the energies: allowed rise of the energy above the relaxed positions, by rounding


class RelaxationStepper(StaticStepper):
    """Finds each equilibrium from the positions of the previous one, at any distance, by a pseudo-motion.

    Internal variables of bars are updated once, from the previous equilibrium to the new one; the path of the
    pseudo-motion does not affect them. The solution of Newton's method, tried from the relaxed positions, is accepted
    if it is near, its energy is not higher, and it is a minimum: the residual is small near an unstable equilibrium,
    too. Otherwise relaxation continues to its own tolerance.

    Attributes
    ----------
    pseudo_steps : of the last increment
    residual : relative to the load, at the end of relaxation in the last increment
    """

    kept_numbers = (*StaticStepper.kept_numbers, "pseudo_steps", "residual")
    columns = (*StaticStepper.columns, "pseudo_steps", "residual")
    finds_jumps = False

    def __init__(self, model: Model, choice: LinearChoice, parameters: Any) -> None:
        _check(model)
        super().__init__(model, choice, parameters)
        self.parameters = parameters
        self.guard = None  # relaxation allows large rotations
        self.motion = PseudoMotion(model)
        self.minimum = Stability(model, largest=LARGEST) if parameters.newton else None
        self.pseudo_steps, self.residual = 0, 0.0

    def step(self) -> None:
        """Find the equilibrium at the next load factor.

        Raises
        ------
        SimulationFailure
            On all ranks, if relaxation does not converge in ``max_iterations`` pseudo-steps.
        """
        self.increment = self.limits.step
        super().step()

    def obstacle(self) -> str:
        """See :class:`StaticStepper`: relaxation needs no stiffness. Collective."""
        return ""

    def supports_changed(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        super().supports_changed()
        if self.minimum is not None:
            self.minimum.destroy()
            self.minimum = Stability(self.model, largest=LARGEST)

    def settle(self) -> None:
        """See :class:`StaticStepper`. Collective."""
        self.motion.x[:] = self.state.x
        super().settle()

    def solve(self, balance: Balance) -> Solution:
        """See :meth:`~pfem_petsc.stepping.stepper.Stepper.solve`."""
        model, motion, parameters = self.model, self.motion, self.parameters
        model.change_bars(balance.time)
        motion.begin(self.state, balance.time, self.state.external)
        stages = [share for share in self._handovers if share > parameters.tolerance]
        for share in (*stages, parameters.tolerance):
            done = motion.relax(share, parameters.max_iterations)
            if not done:
                raise self._unfinished()
            self.pseudo_steps, self.residual = motion.steps, motion.norm / (motion.load or 1.0)
            if parameters.newton:
                solution = self._polish(balance)
                if solution is not None:
                    return solution
        solution = self._relaxed(balance)
        if self.minimum is not None and self.minimum.refusal is None and balance.time < self.end * (1.0 - TIME):
            self.negatives = self.minimum.falling(motion.x, solution.walls, motion.time)
            for text in self._instability(motion.time):
                self.message(text)
        return solution

    @property
    def _handovers(self) -> tuple[float, ...]:
        """Residuals relative to the load at which Newton's method is tried."""
        if self.minimum is None:
            return ()
        return _HANDOVERS if self.minimum.refusal is None else _HANDOVERS[-1:]

    def _polish(self, balance: Balance) -> Solution | None:
        """Return the solution of Newton's method from the relaxed positions, None if none is near. Collective."""
        state, model, motion = self.state, self.model, self.motion
        kept = state.contact, state.support, self.held
        self.held = np.zeros_like(self.held)
        self.held[motion.held] = True
        try:
            solution = super().solve(balance)
        except NotConverged:
            state.contact, state.support, self.held = kept
            return None
        x = balance.predictor + solution.u
        away = np.linalg.norm(x - motion.x[: len(x)], axis=1).max(initial=0.0)
        after = self.with_ghosts(x)
        energy = model.bars.forces(after, np.empty_like(after), commit=False)
        here, size = motion.potential(motion.x[: len(x)], motion.energy)
        there, _ = motion.potential(x, energy)
        reached, collapsed = max(model.comm.allgather(float(away))), model.comm.allgather(energy.failed >= 0)
        failed = reached > _NEAR * model.length or there > here + _DOWN * size or sum(collapsed) > 0
        if not failed and self.minimum.refusal is None:
            failed = self.minimum.falling(after, solution.walls, balance.time) > 0
        if failed:
            state.contact, state.support, self.held = kept
            return None
        return solution

    def _relaxed(self, balance: Balance) -> Solution:
        """Return the relaxed positions as the solution."""
        state, model, motion = self.state, self.model, self.motion
        owned = model.mesh.n_owned
        state.contact = motion.contact.copy()
        state.support = model.supports.part(motion.f[:owned] - state.external - state.contact)
        pushed = (motion.contact[motion.held] != 0.0).any(axis=1)
        self.held = np.zeros_like(self.held)
        self.held[motion.held[pushed]] = True
        self.resolution.note(model, motion.x, motion.load, motion.norm, self.parameters.tolerance * motion.load)
        u = motion.x[:owned] - balance.predictor
        return Solution(u, motion.f.copy(), motion.walls, contacts=int(pushed.sum()))

    def _unfinished(self) -> SimulationFailure:
        """Return the message about an increment without convergence."""
        motion, most = self.motion, self.parameters.max_iterations
        size, node = largest_at_node(self.model.mesh, motion.residual)
        where = self.at(self.state.step + 1, motion.time)
        return SimulationFailure(
            f"{self.of_case}{where}: relaxation has not converged in {most} pseudo-steps: residual "
            f"{motion.norm:.3g} N, required {self.parameters.tolerance * motion.load:.3g} N; worst at node {node} "
            f"({size:.3g} N). Increase static.max_iterations or static.tolerance; if the residual does not fall, "
            "nothing balances the load there"
        )

    def _candidates(self, active_set: ActiveSet, balance: Balance) -> Candidates:
        """Return the nodes near walls at the relaxed positions. Collective."""
        model, motion = self.model, self.motion
        relaxed = replace(self.state, x=motion.x, v=np.zeros_like(self.state.v))
        return expected_candidates(model.contact, relaxed, balance, self.held, model.contact.motion.poses(balance.time))

    def destroy(self) -> None:
        super().destroy()
        if self.minimum is not None:
            self.minimum.destroy()

    def _guess(self, balance: Balance) -> np.ndarray:
        """Return the relaxed positions."""
        return self.motion.x[: self.model.mesh.n_owned] - balance.predictor


def _check(model: Model) -> None:
    """Refuse features that relaxation does not support."""
    case = model.case
    if model.links:
        what = "contact_pair" if case.contact_pair else "constraint"
        raise InputError(
            f'{case.source}: static.method = "relaxation" does not support [[{what}]]; use static.method = "newton"'
        )
    for k, name in enumerate(model.contact.names):
        if model.contact.static_friction[model.contact.first[k]]:
            raise InputError(
                f'{case.source}: wall {name!r}: friction: with static.method = "relaxation" walls are frictionless, '
                'because the pseudo-motion is not the path along which friction acts; use static.method = "newton", or '
                "remove friction"
            )
