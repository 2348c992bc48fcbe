"""Steps that solve a system of equations, bisected where they do not converge."""

from __future__ import annotations

import atexit
import gc
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..contact.active_set import ActiveSet
from ..contact.contact import Candidates
from ..contact.transform import RowCoordinates
from ..errors import NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..solvers.lagged import LaggedPreconditioner
from ..solvers.linear import LinearChoice, MassSolver, unsymmetric
from ..solvers.matrix import HessianMatrix, StepProblem, extend, extrapolate
from ..solvers.matrix_free import MatrixFreeHessian
from ..solvers.newton import Forcing, NewtonSolver, Tolerance, zero_tolerance
from ..tolerances import ON_BOUND
from .guard import StepGuard
from .stepper import AttributeOf, Solution, Stepper

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .model import Model


_WITHIN = 0.99  # of the way that is free, so that rounding does not make that shorter again
_APPROACHES = 5  # guesses, of which only supports move bars through others in the last
_HALVINGS = 10  # most halvings of a step: to 1/1024


_MASS_RTOL = 1e-3  # factor on solver.rtol for systems with the mass matrix only
_DOUBTFUL = 1e-3  # share of the forces in a residual due to rounding, from which on users are told


class Resolution:
    """Whether the forces of a run are larger than what rounding of positions leaves of them out of balance.

    Attributes
    ----------
    numbers : largest 2-norms [N] so far, of forces and of residuals that rounding has left
    """

    def __init__(self) -> None:
        self.numbers = [0.0, 0.0]

    def note(self, model: Model, x: np.ndarray, scale: float, residual: float, tolerance: float) -> None:
        """Take account of a balance at local positions (nodes, 3), with a scale of its forces, the 2-norm of its
        residual, and the tolerance of that [N]. Collective."""
        forces, left = self.numbers
        lacking = residual if residual > tolerance else 0.0
        if lacking > _DOUBTFUL * max(scale, forces):  # the forces of bars may balance each other
            bars = model.bars.state_stiffness(x)[1] * model.bars.lengths(x)
            scale = max(scale, float(np.sqrt(model.comm.allreduce(float((bars[model.mesh.counted] ** 2).sum())))))
        self.numbers = [max(forces, scale), max(left, lacking)]

    def doubts(self, model: Model) -> list[str]:
        """Return a text if the residuals are a noticeable share of the forces."""
        forces, residual = self.numbers
        if not residual > _DOUBTFUL * forces:
            return []
        share = f"{100.0 * residual / forces:.2g} % of" if forces else "all"
        return [
            f"forces of {forces:.3g} N are balanced to {residual:.2g} N only, {share} the forces: coordinates of "
            f"{model.reach:.3g} m are rounded to {np.finfo(float).eps * model.reach:.1g} m, which strains the stiffest "
            "bars as much as the forces do, and smaller displacements are not resolved. Scale the forces up, make very "
            "stiff bars less stiff, or move the truss to the origin"
        ]


# PETSc is finalised after Python and can no longer call it, so matrices and preconditioners written in Python that are
# held by reference cycles are freed first.
atexit.register(gc.collect)


class ImplicitStepper(Stepper):
    """Solves steps by Newton's method, or as a variational inequality if contact is possible; a step whose solve fails
    is made in halves of halves.

    Attributes
    ----------
    level : the next step is made in 2**level parts
    differences, orders : (owned, 6) first and second backward differences of accelerations [m/s2], and (owned,) orders
        of the polynomials in time that predict them; for guesses
    message : receives what users are told during a step
    failures : number of failed solves of each kind in this run
    """

    kept_numbers = (*Stepper.kept_numbers, "level", "lagged_count", "resolved", "curvature")
    kept_arrays = (*Stepper.kept_arrays, "held", "lagged_place", "differences", "orders")
    kept_bars = ("lagged_history",)
    resolved = AttributeOf("resolution.numbers")
    curvature = AttributeOf("forcing.curvature")
    lagged_count = AttributeOf("lagged.count", [])
    lagged_place, lagged_history = (AttributeOf(f"lagged.{name}", np.empty((0, 0))) for name in ("place", "history"))

    def __init__(self, model: Model, scheme: Scheme, h: float, choice: LinearChoice) -> None:
        super().__init__(model, scheme, h)
        self.level = 0
        self.message: Callable[[str], None] = lambda text: None
        self.failures: Counter[str] = Counter()
        _free_left_over(model.comm)
        self._choice = choice
        self.forcing = Forcing()
        self._make_solvers()
        self.guard = StepGuard(model) if model.case.solver.guard else None
        self._after = np.zeros_like(self.state.x)
        self.held = np.zeros(model.mesh.n_owned, dtype=bool)  # nodes in contact with walls in the last step
        self.differences = np.zeros((model.mesh.n_owned, 6 if scheme.inertial else 0))
        self.orders = np.zeros(model.mesh.n_owned, dtype=np.uint8)
        self.accuracy = 1.0  # of a solve, as a factor on the tolerance of steps; zero: to rounding
        self.resolution = Resolution()

    def tell_failure(self, failure: NotConverged, remedy: str) -> None:
        """Tell the first failure of each kind and what is done about it; others are counted."""
        self.failures[failure.kind] += 1
        if self.failures[failure.kind] == 1:
            self.message(f"{failure}; {remedy} (later ones of this kind are counted at the end)")

    def remarks(self) -> list[str]:
        """Return how many solves failed, if some were not told. Collective."""
        if max(self.failures.values(), default=0) < 2:
            return []
        kinds = "; ".join(f"{kind}: {count}" for kind, count in self.failures.items())
        return [f"{self.failures.total()} solves failed and were repeated with smaller steps ({kinds}); {self.remedy}"]

    def step(self) -> None:
        """Advance by one step; a part that does not converge is bisected, and parts grow again from step to step.

        Raises
        ------
        NotConverged
            On all ranks, if the smallest part does not converge, or any of a scheme that solves for the next position.
        """
        state, ticks = self.state, 2**_HALVINGS
        start, done = state.time, 0
        end = (state.step + 1) * self.h
        size, between = ticks >> self.level, False
        self.smallest = self.h
        while done < ticks:
            place = end if done + size == ticks else start + self.h * ((done + size) / ticks)
            self._set_part(place - state.time if between else self.h * (size / ticks))
            external, begun = state.external, state.time
            try:
                self._make_substeps(place)
            except NotConverged as failure:
                state.external = external
                if self.scheme.solves_next_position:  # the nodes have left the place of this balance
                    raise
                if size == 1:
                    raise NotConverged(f"{failure} (the step was bisected {_HALVINGS} times)") from failure
                # the failed solve has applied the temperatures and rest lengths of its end
                self.model.change_bars(self.state.time)
                size //= 2
                self.level += 1
                self.tell_failure(failure, f"bisecting the step, to {self.h * size / ticks:.4g} s")
                if state.time > begun:  # a first substep has been made: on to the next of the smaller parts
                    between = True
                    while start + self.h * ((done + size) / ticks) <= state.time:
                        done += size
                continue
            done, between = done + size, False
        self.level = max(self.level - 1, 0)
        self.leave()
        state.step += 1

    def _set_part(self, part: float) -> None:
        if part != self.part:
            self.scheme.step_changed(self.state)
            self.model.contact.motion.bodies.step_changed(self.scheme)
            self.step_changed = True
            self.part = part
            self.differences[:] = 0.0
            self.orders[:] = 0
        self.smallest = min(self.smallest, part)

    def _make_solvers(self) -> None:
        """Create matrices and solvers for the supports as they are. Collective."""
        model, choice = self.model, self._choice
        touch = model.self_contact
        symmetric = self.scheme.symmetric and model.links.symmetric and (touch is None or touch.symmetric)
        if choice.matrix_free:
            self.hessian = MatrixFreeHessian(model)
        else:
            self.hessian = HessianMatrix(model.mesh, model.supports, symmetric, touch is not None)
        self.lagged = None
        if choice.lagged:
            self.lagged = LaggedPreconditioner(
                model, choice.preconditioner, symmetric, self.scheme.symmetric, choice.matrix_free
            )
        bounded = choice if model.links.symmetric else unsymmetric(choice)
        most = model.case.solver.max_newton
        self.newton = NewtonSolver(model.mesh, self.hessian, choice, bounded, most, model.size, self.lagged)
        self.newton.forcing = self.forcing  # which outlasts these solvers
        self.newton.limits = touch is not None
        self._couple_rows()
        self.newton.prepare(model.can_touch)
        self._mass: MassSolver | None = None

    def _couple_rows(self) -> None:
        """Give matrices and solvers the coordinates of the rows that there are. Collective."""
        self.rows = RowCoordinates(self.model.links) if self.model.links else None
        self.newton.forget_bounded()
        self.hessian.couple(self.rows)
        if self.lagged is not None:
            self.lagged.inner.couple(self.rows)

    def supports_changed(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        super().supports_changed()
        self._free_solvers()
        self._make_solvers()

    def resume(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        kept = self.lagged_count, self.lagged_place, self.lagged_history
        super().resume()
        self.lagged_count, self.lagged_place, self.lagged_history = kept

    def destroy(self) -> None:
        self._free_solvers()

    def _free_solvers(self) -> None:
        self.newton.destroy()
        for owner in (self.hessian, self.lagged, self._mass):
            if owner is not None:
                owner.destroy()

    def accelerate(self, load: np.ndarray) -> np.ndarray:
        if not self.model.inertia.consistent:
            return super().accelerate(load)
        if self._mass is None:
            self._mass = MassSolver(self.model)
        return self._mass.solve(load)

    def solve(self, balance: Balance) -> Solution:
        state, links = self.state, self.model.links
        kept = state.contact, state.support, self.held, links.state
        try:
            solution = self._with_walls(balance)
            # an explicit scheme with consistent mass has one solution only
            if self.guard is not None and balance.weight:
                reason = self._suspicion(balance, solution)
                if reason is not None:
                    remedy = f"{self.remedy}; if such jumps are intended, set solver.guard = false"
                    raise NotConverged(f"{self.when(balance)}: {reason}; {remedy}", reason.partition(":")[0])
        except NotConverged:
            state.contact, state.support, self.held, forces = kept
            links.state = forces
            raise
        return solution

    def with_ghosts(self, x: np.ndarray) -> np.ndarray:
        """Return positions (owned, 3) with those of ghosts (local, 3), valid until the next call. Collective."""
        self._after[: len(x)] = x
        self.model.mesh.update_ghosts(self._after)
        return self._after

    def _suspicion(self, balance: Balance, solution: Solution) -> str | None:
        """Return why the guard rejects a solution, None if it accepts it. Collective."""
        state, model = self.state, self.model
        h = balance.time - state.time
        after = self.with_ghosts(balance.predictor + solution.u)
        momentum = model.inertia.mass_times(state.v, np.empty_like(state.v))
        works = (state.external + state.contact + state.support) * (after[: len(state.v)] - state.position)
        energy = 0.5 * float((momentum * state.v).sum() + np.abs(works).sum())
        return self.guard.check(state.x, after, state.position + self.scheme.expected_move(state, h), energy)

    def _with_walls(self, balance: Balance) -> Solution:
        """Solve a balance together with the motion of walls with mass. Collective."""
        bodies, touch = self.model.contact.motion.bodies, self.model.self_contact
        guess = self._guess(balance)
        found: list[Solution] = []

        def forces() -> tuple[np.ndarray, None]:
            found.append(self._solve(balance, found[-1].u if found else guess))
            walls = found[-1].walls
            if touch is not None:
                x = self.with_ghosts(balance.predictor + found[-1].u)
                walls = found[-1].walls = touch.with_walls(walls, x, balance.weight)
                crossing = touch.crossing(x, balance.time)
                if crossing:
                    raise NotConverged(
                        f"{self.when(balance)}: {crossing} pass through each other in the step; {self.remedy}",
                        "bars pass through walls",
                    )
            return np.stack([walls.force, walls.moment])[:, bodies.at], None

        if not bodies.solve(forces, ON_BOUND * self.model.size):
            raise NotConverged(f"{self.when(balance)}: {self.model.contact.unsettled_message()}")
        newton, linear = sum(s.newton for s in found), sum(s.linear for s in found)
        return replace(found[-1], newton=newton, linear=linear)

    def _solve(self, balance: Balance, guess: np.ndarray) -> Solution:
        model, state = self.model, self.state
        if balance.weight:  # else the forces of the balance are those known at its start
            model.change_bars(balance.time)
        if model.bars.viscous and balance.weight and self.scheme.inertial and not balance.discrete_gradient:
            self._set_rates(balance)
        if model.self_contact is not None:
            guess = self._free_way(balance, guess)
        scale = self._force_scale()
        # an explicit scheme's balance is a well-conditioned linear system, and its residual would act as an impulse
        rtol = model.case.solver.rtol * (1.0 if balance.weight else _MASS_RTOL)
        tolerance = self.accuracy * max(rtol * scale, model.case.solver.atol or 0.0)
        ends = self._tolerance(tolerance)
        model.links.expect(state, balance)
        if self.rows is not None and self.rows.rows is not model.links.rows:
            self._couple_rows()
        active_set = ActiveSet(model, self.state, balance, self.held, self.rows, self.remedy)
        active_set.candidates = self._candidates(active_set, balance)
        newton = linear = 0
        near_bound = 2.0 * zero_tolerance(model.size)
        while True:
            try:
                active_set.place(balance.predictor + guess)
            except SimulationFailure as failure:
                raise SimulationFailure(f"{self.when(balance)}: {failure}") from failure
            problem = StepProblem(model, state, balance, state.external, active_set.transform)
            near = active_set.feasible(guess)
            w = problem.coordinates(near)
            bounds = active_set.bounds(near, w)
            w = bounds.clip(w, near_bound)
            report = self.newton.solve(problem, w, ends, bounds.arrays)
            relaxed = not report.converged and active_set.relax()
            if not report.converged and not relaxed and not active_set.transform.identity:
                w = problem.coordinates(active_set.approach(problem, guess))
                w = bounds.clip(w, near_bound)
                report = report.then(self.newton.solve(problem, w, ends, bounds.arrays))
            newton += report.newton
            linear += report.linear
            if relaxed:
                continue
            if not report.converged:
                exact = self._choice.krylov == "preonly"
                remedy = self.remedy if exact else f'{self.remedy}, or set solver.linear = "mumps"'
                text = self.newton.failure_message(w, report, remedy)
                if model.self_contact is not None:
                    text += model.self_contact.hint()
                raise NotConverged(f"{self.when(balance)}: {text}")
            bounds.project(w, near_bound)
            u = problem.increment(w).copy()
            g = np.empty_like(u)
            problem.imbalance(u, g, evaluated=True)
            try:
                settled = active_set.check(bounds, w, u, g, report.norm, tolerance)
            except NotConverged as failure:
                raise NotConverged(f"{self.when(balance)}: {failure}") from failure
            if settled:
                break
            guess = u
        free = not model.supports.any and model.bars.springs is None and self.scheme.inertial
        if free and not active_set.candidates.anywhere:
            self._keep_momentum(problem, u, g)
        state.contact, walls, self.held = active_set.forces(u)
        held = model.links.count_held(np.flatnonzero(self.held))
        state.support = model.supports.part(g - state.contact)
        internal = problem.f if balance.weight else state.f
        if self.accuracy:
            self.resolution.note(model, problem.x, scale, report.norm, tolerance)
        return Solution(u, internal, walls, newton, linear, held)

    def _free_way(self, balance: Balance, guess: np.ndarray) -> np.ndarray:
        """Return a guess (owned, 3) on the way to which no bar passes through another. Collective.

        Raises
        ------
        NotConverged
            On all ranks, if supports move bars through others.
        """
        start, supports, touch = self.state.x, self.model.supports, self.model.self_contact
        back = self.state.position - balance.predictor
        lacking = supports.lacking(balance.predictor, balance.time)
        touch.begin_solve(balance.time)
        for _ in range(_APPROACHES):
            part = touch.free_part(start, self.with_ghosts(balance.predictor + guess))
            if part == 1.0:
                return guess
            guess = back + _WITHIN * part * (guess - back)
            supports.put(guess, lacking)
        raise NotConverged(
            f"{self.when(balance)}: {'supports' if supports.any else 'the motion'} would move {touch.between} through "
            f"each other; {self.remedy}",
            "supports move bars through each other",
        )

    def _force_scale(self) -> float:
        """Return the largest 2-norm [N] of momentum per part of a step, loads and internal forces. Collective."""
        state, model = self.state, self.model
        momenta = np.einsum("i,ic,ic", model.inertia.mass**2, state.v, state.v) / self.part**2
        forces = state.external, state.f[: model.mesh.n_owned]
        sums = np.array([momenta, *((force**2).sum() for force in forces)])
        model.comm.Allreduce(MPI.IN_PLACE, sums)
        return float(np.sqrt(sums.max()))

    def _set_rates(self, balance: Balance) -> None:
        """Give viscous bars the strain rates of a balance, affine in its unknowns like the velocities. Collective.

        The internal force is w f(x_u) + (1 - w) f(x_n), and the velocity of the balance is divided in the same way.
        """
        state, w = self.state, balance.weight
        v = balance.v_hat if w == 1.0 else (balance.v_hat - (1.0 - w) * state.v) / w
        self.model.bars.set_rates(state.x, self.on_all(balance.predictor), self.on_all(v), balance.eta / w)

    def _tolerance(self, required: float) -> Tolerance:
        """Return when a solve ends that requires a residual [N]. Collective."""
        model = self.model
        nodes = model.node_rounding
        if model.links:  # whose coordinates mix the residuals of nodes
            nodes = np.full_like(nodes, model.rounding)
        return Tolerance(required, required, nodes, model.rounding)

    def doubts(self) -> list[str]:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`."""
        return self.resolution.doubts(self.model)

    def _candidates(self, active_set: ActiveSet, balance: Balance) -> Candidates:
        """Return the nodes that walls may stop, for the first solve. Collective."""
        return active_set.candidates

    def _keep_momentum(self, problem: StepProblem, u: np.ndarray, g: np.ndarray) -> None:
        """Remove the net residual of a free truss by a translation, which strains no bar.

        An iterative solution leaves a residual within the tolerance, whose sum would be a drift of linear momentum.
        """
        net = self.model.comm.allreduce(np.append(g.sum(axis=0), problem.nodal.sum()))
        shift = net[:3] / net[3]
        u -= shift
        g -= problem.nodal[:, None] * shift

    def _free_guess(self, balance: Balance) -> np.ndarray:
        """Return increments for the accelerations that those of the last steps let expect."""
        guess = np.empty_like(self.state.a)
        extrapolate(self.state.a, self.differences, self.orders, 1.0 / balance.alpha, guess)
        return guess

    def _make_balance(self, end: float) -> None:
        before = self.state.a
        super()._make_balance(end)
        if self.scheme.inertial:
            extend(before, self.state.a, self.differences, self.orders)

    def _guess(self, balance: Balance) -> np.ndarray:
        """Return the increments with which solves begin, prescribed components at their exact positions."""
        guess = self._free_guess(balance)
        self.model.supports.put(guess, self.model.supports.lacking(balance.predictor, balance.time))
        return guess


def _free_left_over(comm: MPI.Comm) -> None:
    """Free the PETSc objects of earlier steppers that were not destroyed. Collective.

    Python may collect objects at any time; PETSc, whose objects are collective, then only defers their destruction.
    """
    gc.collect()
    if hasattr(PETSc, "garbage_cleanup"):
        PETSc.garbage_cleanup(comm)
