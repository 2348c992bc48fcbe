"""Steps that need a system solved: implicit schemes, and explicit ones with consistent mass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..contact.contact import WallForces
from ..contact.frames import NodalFrames
from ..integrators.base import Balance
from ..solvers.linear import LinearChoice
from ..solvers.matrix import HessianMatrix
from ..solvers.newton import NewtonReport, NewtonSolver, zero_tolerance
from .problem import StepProblem
from .stepper import NotConverged, Solution, Stepper

__all__ = ["ImplicitStepper"]

_HALVINGS = 10  # most halvings of a step: to 1/1024
_ROUNDS = 20  # re-solves of a step because a wall was reached that the step had not expected


class ImplicitStepper(Stepper):
    """Newton's method on the free step; a variational inequality once a node can reach a wall."""

    kept_numbers = (*Stepper.kept_numbers, "level")
    kept_arrays = ("held",)

    def __init__(self, model, scheme, h: float, choice: LinearChoice) -> None:
        super().__init__(model, scheme, h)
        self.hessian = HessianMatrix(model.mesh, model.supports.fixed, model.supports.any, scheme.symmetric)
        self.newton = NewtonSolver(model.mesh, self.hessian, choice, model.case.solver.max_newton, model.length)
        self.level = 0  # the next step is made in 2**level parts
        self.message: Callable[[str], None] = lambda text: None
        self.held = np.zeros(model.mesh.n_owned, dtype=bool)  # nodes held by walls in the last step

    def step(self) -> None:
        """Advance by one step; where it does not converge, in halves of halves, which grow back step by step.

        Raises
        ------
        NotConverged
            On all ranks, when the smallest part does not converge either.
        """
        state, ticks = self.state, 2**_HALVINGS
        start, done = state.time, 0
        end = (state.step + 1) * self.h
        size = ticks >> self.level
        self.smallest = self.h
        while done < ticks:
            self._set_part(self.h * (size / ticks))
            try:
                self._make_part(end if done + size == ticks else start + self.h * ((done + size) / ticks))
            except NotConverged as failure:
                if size == 1:
                    raise NotConverged(f"{failure} (the step was halved {_HALVINGS} times)") from failure
                size //= 2
                self.level += 1
                self.message(f"{failure}; halving the step to {self.h * size / ticks:.4g} s")
                continue
            done += size
        self.level = max(self.level - 1, 0)
        state.step += 1

    def _set_part(self, part: float) -> None:
        if part != self.part:
            self.scheme.step_changed(self.state)
            self.part = part
        self.smallest = min(self.smallest, part)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        self.newton.destroy()
        self.hessian.destroy()

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        inertia, fixed = self.model.inertia, self.model.supports.fixed
        if not inertia.consistent:
            a = load / inertia.mass[:, None]
            a[fixed] = 0.0
            return a
        mass = HessianMatrix(self.model.mesh, fixed, self.model.supports.any)
        mass.fill(lambda values: self._mass_matrix(mass, values))
        b, a = mass.mat.createVecs()
        right = load.copy()
        right[fixed] = 0.0
        b.array[:] = right.ravel()
        ksp = PETSc.KSP().create(self.model.comm)
        ksp.setType("cg")
        ksp.getPC().setType("pbjacobi")
        ksp.setTolerances(rtol=1e-14, max_it=1000)
        ksp.setOperators(mass.mat)
        ksp.solve(b, a)
        result = a.array.reshape(load.shape).copy()
        for thing in (ksp, a, b):
            thing.destroy()
        mass.destroy()
        return result

    def _mass_matrix(self, matrix: HessianMatrix, values: np.ndarray) -> None:
        model = self.model
        model.bars.tangents(self.state.x, 0.0, model.inertia.coefficients(1.0, 0.0), matrix.pattern, values)
        matrix.constrain(float(model.inertia.mass.max(initial=1.0)), values)

    def solve(self, balance: Balance) -> Solution:
        model, state = self.model, self.state
        if model.temperatures.varying:
            model.temperatures.apply(balance.time)
        tolerance = self._tolerance(balance)
        guess = self._guess(balance)
        candidates = self._candidates(balance)
        newton = linear = 0
        for _ in range(_ROUNDS):
            frames = (
                None
                if candidates is None
                else model.contact.frames(candidates, balance.predictor + guess, balance.time)
            )
            problem = StepProblem(model, self.hessian, state, balance, state.external, frames)
            w, bounds = problem.coordinates(guess), None
            if frames is not None:
                bounds = self._bounds(frames, balance)
                np.clip(w, *bounds, out=w)
            report = self.newton.solve(problem, w, tolerance, model.rounding, bounds)
            if frames is not None:
                self._snap(w, bounds)
            newton += report.newton
            linear += report.linear
            if not report.converged:
                raise NotConverged(self._failure(problem, w, report, tolerance))
            u = problem.increment(w).copy()
            broken = self._broken(balance, u, candidates)
            if broken is None:
                break
            candidates = broken
            guess = u
        else:
            raise NotConverged(
                f"step {state.step + 1}, t = {balance.time:.6g} s: the nodes that touch walls could not be settled in "
                f"{_ROUNDS} solves; take a smaller time step"
            )
        walls, contacts = self._forces(problem, frames, bounds, w, u, report.norm)
        return Solution(u, problem.f if balance.weight else state.f, walls, newton, linear, contacts)

    def _tolerance(self, balance: Balance) -> float:
        """Of the residual's 2-norm [N]: relative to the forces at work (momentum per step, loads, internal forces)."""
        model, state, solver = self.model, self.state, self.model.case.solver
        owned = model.mesh.n_owned
        sums = np.array(
            [
                ((model.inertia.mass[:, None] * state.v) ** 2).sum() / self.part**2,
                (state.external**2).sum(),
                (state.f[:owned] ** 2).sum(),
            ]
        )
        model.comm.Allreduce(MPI.IN_PLACE, sums)
        return max(solver.rtol * float(np.sqrt(sums.max())), solver.atol or 0.0)

    def _guess(self, balance: Balance) -> np.ndarray:
        """The acceleration goes on as it was; prescribed components where they will be."""
        guess = self.state.a / balance.alpha
        supports = self.model.supports
        if supports.any:
            at = (supports.nodes, supports.components)
            guess[at] = supports.positions(balance.time) - balance.predictor[at]
        return guess

    def _candidates(self, balance: Balance) -> np.ndarray | None:
        """Owned nodes that may touch a wall in this step; None where no rank has any (free flight). Collective."""
        model, state = self.model, self.state
        if not model.contact.any:
            return None
        ahead = balance.time - state.time
        move = ahead * state.v
        reach = 0.5 * np.linalg.norm(move, axis=1) + 1e-9 * model.length
        near = self.held.copy()
        if len(move):
            near |= (model.contact.gaps(state.position + move, balance.time) <= reach[:, None]).any(axis=1)
        if model.comm.allreduce(int(near.any()), op=MPI.MAX) == 0:
            return None
        return np.flatnonzero(near)

    def _bounds(self, frames: NodalFrames, balance: Balance) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on w: those of the frames less B predictor."""
        shape = (self.model.mesh.n_owned, 3)
        lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
        at = frames.nodes
        base = np.einsum("nij,nj->ni", frames.basis, balance.predictor[at])
        lower[at] = frames.lower - base
        upper[at] = frames.upper - base
        return lower, upper

    def _broken(self, balance: Balance, u: np.ndarray, candidates: np.ndarray | None) -> np.ndarray | None:
        """Candidates joined by nodes that ended beyond a wall; None where there are none. Collective."""
        model = self.model
        if not model.contact.any:
            return None
        known = np.empty(0, dtype=np.int64) if candidates is None else candidates
        gaps = model.contact.gaps(balance.predictor + u, balance.time)
        beyond = np.flatnonzero((gaps < -1e-12 * model.length).any(axis=1))
        joined = np.union1d(known, beyond)
        if model.comm.allreduce(int(len(joined) > len(known)), op=MPI.MAX) == 0:
            return None
        return joined

    def _snap(self, w: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> None:
        """Put unknowns that the solver counts as on a bound exactly there."""
        within = 2.0 * zero_tolerance(self.model.length)
        for bound in bounds:
            near = np.abs(w - bound) <= within
            w[near] = bound[near]

    def _forces(
        self, problem: StepProblem, frames, bounds, w: np.ndarray, u: np.ndarray, noise: float
    ) -> tuple[WallForces, int]:
        """Contact and support forces from the balance at the solution; ``noise`` [N] is what a free node has left."""
        model, state = self.model, self.state
        g = np.empty_like(u)
        problem.imbalance(u, g)
        state.contact = np.zeros_like(u)
        walls, contacts = model.contact.none(), 0
        self.held[:] = False
        if frames is not None:
            at = frames.nodes
            lower, upper = bounds
            active = np.zeros((len(at), 3), dtype=np.int8)
            turned = np.einsum("nji,nj->ni", frames.inverse, g[at])
            active[(w[at] <= lower[at]) & (turned > noise)] = -1
            active[(w[at] >= upper[at]) & (turned < -noise)] = 1
            force, walls = model.contact.forces(frames, turned, active)
            state.contact[at] = force
            touching = (active != 0).any(axis=1)
            self.held[at] = touching
            contacts = int(touching.sum())
        state.support = np.zeros_like(u)
        fixed = model.supports.fixed
        state.support[fixed] = g[fixed] - state.contact[fixed]
        return walls, contacts

    def _failure(self, problem: StepProblem, w: np.ndarray, report: NewtonReport, tolerance: float) -> str:
        """What to tell about a step that did not converge: worst node and residual, reasons, ways out. Collective."""
        model = self.model
        g = np.empty_like(w)
        problem.residual(w, g)
        size = np.linalg.norm(np.nan_to_num(g, nan=np.inf), axis=1)
        worst = (0.0, -1)
        if len(size):
            at = int(np.argmax(size))
            worst = (float(size[at]), int(model.mesh.node_ids[at]))
        residual, node = max(model.comm.allgather(worst))
        return (
            f"step {self.state.step + 1}, t = {problem.balance.time:.6g} s: no convergence after {report.newton} Newton "
            f"iterations: {report.why}; residual {report.norm:.3g} N, asked {tolerance:.3g} N; worst at node {node} "
            f'({residual:.3g} N). Take a smaller time.step, or solver.linear = "mumps"'
        )
