"""Increments of the load factor, each an equilibrium found by Newton's method; equilibria after bars have broken; the
stepper and the plan of a case with a table ``[static]``."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError, NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..mechanics.materials.base import law_name, law_of
from ..output.units import LOAD_FACTOR, POINT
from ..registry import lookup
from ..solvers.background_grid import fills_block
from ..solvers.linear import DIRECT, Demand, LinearChoice, choose_linear
from ..solvers.newton import Tolerance
from ..stepping.implicit import ImplicitStepper
from ..stepping.plan import Plan, refuse_motion
from ..stepping.stepper import Solution
from ..tolerances import TIME
from .critical import Jump, JumpSearch, Place
from .equilibrium import Equilibrium, problem_at_rest
from .path_points import Arc, BorderedSystem, Metric, PointSolver, dot
from .stability import (
    LARGEST,
    LARGEST_WITH_MUMPS,
    SUPPORTS,
    ZERO,
    Stability,
    free_motions,
    held_nodes,
    is_indefinite,
    stiffest,
)

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .methods import Increments


_FEW = 5  # maximum number of Newton iterations after which the next increment is larger
_GROWTH = 1.5
_LEAST = 1e-3  # of ``stabilise``: viscosity of increments that converge without more
_STRONGER = 10.0  # factor on the viscosity where an increment fails
_TRIED = 0.1  # of an increment, to which it is halved before the viscosity grows
_WEAKER = 0.5  # the same after an increment
_RELEASES = 20  # attempts to find the equilibrium at the end
NEVER = 2**62
UNCOUNTED = -2
"""Of negative eigenvalues: there are some, whose number is unknown."""
_RESISTANCE = 1e-3  # viscosity over stiffness with which a truss that nothing holds yet is moved against walls
_AHEAD = 2.0, 0.5, 0.1, 0.02  # of an increment: near a limit point the response to a whole one is too large
_LENGTHS = 2.0 ** np.arange(10)  # of an increment, within which the path beyond it is looked at
_SOFT = 0.05  # stiffness along the path over that of the state, below which bars yield up to a limit load
_EXCEEDED = (
    "nodes moved far without load, as in a snap-through, and forces from there on contain the viscous force; compare "
    "with a smaller static.stabilise, or use a dynamic stage"
)


class StaticStepper(ImplicitStepper):
    """Advances the equilibrium from one load factor to the next; the state's time is the load factor.

    An increment that does not converge, or that the guard rejects, is halved; after an increment with few Newton
    iterations the next one is larger, up to ``largest``. With ``stabilise``, the viscosity is a thousandth of this. If
    an increment fails down to a tenth of its size, it grows up to this value, and decreases again from then on.

    Parameters
    ----------
    model : Model
    choice : LinearChoice
    limits : first, smallest and largest increment of the load factor, and the last load factor
    stabilise : largest viscosity of the nodes over their stiffness
    share : largest share of the viscosity in the energy that the truss has absorbed, beyond which users are warned

    Attributes
    ----------
    increment : the next increment
    viscosity : of the next increment, relative to ``stabilise``
    dissipated : energy dissipated by the viscosity of ``stabilise`` [J]
    exceeded : whether its share has exceeded the largest
    negatives : number of negative eigenvalues of the stiffness at the last load factor, -1 if unknown, UNCOUNTED
    finds_jumps : whether increments follow a path, and jumps are told
    """

    kept_numbers = (*ImplicitStepper.kept_numbers, "increment", "viscosity", "dissipated", "exceeded", "negatives")
    columns = ("load_factor",)
    finds_jumps = True
    remedy = "reduce static.step"

    def __init__(
        self, model: Model, choice: LinearChoice, limits: Increments, stabilise: float = 0.0, share: float = 1.0
    ) -> None:
        model.inertia.damp(stabilise * model.nodal_stiffness)  # that of materials has no meaning without time
        lack = np.empty_like(model.inertia.mass) if stabilise else None
        super().__init__(model, Equilibrium(lack), limits.step, choice)
        model.bars.step = np.inf  # laws that depend on the rate are at their limit of slow loading
        self.stabilise, self.share = stabilise, share
        self.viscosity, self.dissipated, self.exceeded = _LEAST, 0.0, False
        self.negatives = -1
        self._external = self.state.external  # of the last load factor
        self._jumps: list[Jump] = []  # in the last increment
        self.limits, self.increment, self.end = limits, limits.step, limits.end

    @property
    def load_factor(self) -> float:
        """Load factor of the state."""
        return self.state.time

    @property
    def of_case(self) -> str:
        """Beginning of a message about a load case, which names it; empty for others."""
        case = self.model.case
        return f"load case {case.name!r}: " if case.starts_from is not None else ""

    @property
    def done(self) -> bool:
        """Whether the last load factor is reached."""
        return self.state.time >= self.end * (1.0 - TIME)

    @property
    def last_step(self) -> int:
        """Number of the last step once it is reached, before that a number larger than any step."""
        return self.state.step if self.done else NEVER

    def when(self, balance: Balance) -> str:
        return f"step {self.number + 1}, load factor {balance.time:.6g}"

    def arrived(self) -> str:
        return f"step {self.number + 1}, load factor {self.state.time:.6g}"

    def start(self) -> None:
        """Initialise the state at load factor zero; the first increment is equilibrated. Collective."""
        state, model = self.state, self.model
        model.bars.step = 0.0
        if model.bars.can_break:
            self.hold_detached()
        self.start_without_motion()
        model.bars.step = np.inf
        # the force that the state lacks to equilibrium (heat, a stage before) does work in the first increment, which
        # the ledger books as that of inertia
        lack = state.external - state.f[: model.mesh.n_owned] + state.contact + state.support
        state.a = lack / model.inertia.mass[:, None]
        self.totals_at_start = self.totals()
        self.scheme.start(state, self.h)
        model.contact.motion.bodies.start(self.h)

    def recorded(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`; without acceleration."""
        return np.zeros_like(self.state.a), self.state.support

    def step(self) -> None:
        """Find the equilibrium at the next load factor.

        Raises
        ------
        NotConverged
            On all ranks, if the smallest increment does not converge.
        """
        state, reached = self.state, min(self.end, self.removals.ends(self.state.time))
        self._external = state.external
        left = reached - state.time
        size = first = self.increment if self.increment < left * (1.0 - TIME) else left
        while True:
            self._set_part(size)
            self.smallest = size
            end = reached if size == left else state.time + size
            self._resist(self.viscosity)
            try:
                self._make_part(end)
                break
            except NotConverged as failure:
                self.name_obstacle(failure)
                # the failed solve has applied the temperatures and rest lengths of its end
                self.model.change_bars(state.time)
                smallest = 0.5 * size < self.limits.smallest
                if self.stabilise and self.viscosity < 1.0 and (smallest or size < first * _TRIED):
                    self.viscosity = min(_STRONGER * self.viscosity, 1.0)
                    continue
                if smallest:
                    raise self._no_further(failure) from failure
                size *= 0.5
                self.tell_failure(failure, f"halving the increment, to {size:.4g}")
        self._tell_jumps()
        self.increment = size
        if self.solution.newton <= _FEW:
            self.increment = max(size, min(_GROWTH * size, self.limits.largest))
        if self.stabilise:
            self._count_dissipation(size)
            self.viscosity = max(_WEAKER * self.viscosity, _LEAST)
            if self.done:
                self._release(size)
        self.leave()
        state.step += 1

    def leave(self) -> None:
        """Remove what is due, and redistribute the forces of bars that break. Collective."""
        self._redistribute()
        if self.done:
            self.negatives = self._falling()

    def _redistribute(self) -> None:
        """Remove what is due at the load factor, and find equilibria there until no further bar breaks. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if the rest of the truss finds no equilibrium.
        """
        changed = self.remove_due()
        if not self.model.bars.can_break and not changed:
            return
        while self.model.comm.allreduce(changed or self.energy.changed > 0, op=MPI.LOR):
            changed = False
            self.hold_detached()
            self._solve_again()

    def hold_detached(self) -> None:
        """Hold nodes that no bar holds any more where they are. Collective."""
        model, owned = self.model, self.model.mesh.n_owned
        left = np.zeros(model.mesh.n_local, dtype=bool)
        left[model.mesh.bars[np.abs(model.bars.rupture()) < 1.0].ravel()] = True
        loose = np.flatnonzero(~left[:owned] & ~model.supports.held_nodes())
        if not model.links and model.comm.allreduce(len(loose)):
            model.supports.hold_nodes(loose, self.state.position)
            self.supports_changed()

    def _solve_again(self) -> None:
        """Find the equilibrium at the present load factor with the bars that are left. Collective.

        The guard is not used: what moves when bars go has nothing to do with the increments before.
        """
        guard, self.guard, self.scheme.releases = self.guard, None, True
        try:
            self._make_part(self.state.time)
        except NotConverged as failure:
            raise SimulationFailure(
                f"{self.arrived()}: the rest of the truss finds no equilibrium after bars or supports went: it "
                f'collapses, or a part of it is a mechanism; static.method = "relaxation" finds distant equilibria, '
                f"[time] follows the motion. The last attempt: {failure}{free_motions(self.model, self.state)}"
            ) from failure
        finally:
            self.guard, self.scheme.releases = guard, False

    def _falling(self) -> int:
        """Return the number of directions in which the potential falls at the state, see :attr:`negatives`. Collective.

        Bars that yield resist with the stiffness of unloading, so that only the geometry and softening elastic laws
        are found.
        """
        model, state, walls = self.model, self.state, self.solution.walls
        if model.self_contact is not None:  # whose stiffness is not part of that of bars
            return -1
        direct, bars = self._choice.krylov == "preonly", model.bars.state_stiffness(state.x)
        check = Stability(model, largest=LARGEST_WITH_MUMPS if direct else LARGEST)
        try:
            if check.refusal is None:
                return check.falling(state.x, walls, state.time, bars)
        finally:
            check.destroy()
        if direct:
            return -1
        self.hessian.put(problem_at_rest(model, state, state.external), bars)
        held = held_nodes(model, walls)
        held[walls.nodes[walls.touching.any(axis=1)]] = True
        return UNCOUNTED if is_indefinite(model, self.hessian, self.lagged, held) else -1

    def doubts(self) -> list[str]:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`."""
        return [*super().doubts(), *self._instability(self.state.time)]

    def _instability(self, load_factor: float) -> list[str]:
        """Return what to tell about an unstable equilibrium."""
        count = int(self.negatives)
        if count in (-1, 0):
            return []
        many = "at least one" if count == UNCOUNTED else str(count)
        return [
            f"load factor {load_factor:.6g}: the equilibrium is unstable, with {many} negative "
            f"eigenvalue{'s' * (count > 1)} of the stiffness: nothing perturbs the truss, which would not rest there "
            "under constant loads. A bifurcation or limit point lies before it, which static.method = "
            '"arc_length" locates; add a small perturbing load to reach a stable equilibrium'
        ]

    def obstacle(self) -> str:
        """Return a message about motions that nothing resists at the start; empty if there are none. Collective.

        Nor where increments of any size may give the truss a stiffness, or need none.
        """
        model = self.model
        if self.stabilise or model.bars_vary or model.supports.moves or self._choice.preconditioner not in DIRECT:
            return ""
        found = free_motions(model, self.state)
        if not found:
            return ""
        others = '; static.method = "relaxation" and [time] do not need them' if found.endswith(SUPPORTS) else ""
        return f"{model.case.source}: static: the stiffness is singular at the start{found}{others}"

    def name_obstacle(self, failure: NotConverged) -> None:
        """Raise an error about motions without stiffness if the first increment has failed by them. Collective."""
        obstacle = "" if self.state.step else self.obstacle()
        if obstacle:
            raise SimulationFailure(obstacle) from failure

    def _solve(self, balance: Balance, guess: np.ndarray) -> Solution:
        """Solve; a truss that nothing holds before contact forces act is first moved against walls and links.

        Their forces, and whether nodes stick, are not known before the first contact, and the stiffness may be
        singular without them. A viscous force makes it regular; its solution is the guess.
        """
        try:
            return super()._solve(balance, guess)
        except NotConverged:
            if balance.eta or not self._untouched():
                raise
        inertia = self.model.inertia
        damping = inertia.damping
        inertia.damp(_RESISTANCE * self.model.nodal_stiffness)
        try:
            approach = super()._solve(replace(balance, eta=1.0), guess)
        finally:
            inertia.damp(damping)
        return super()._solve(balance, approach.u)

    def _tolerance(self, required: float) -> Tolerance:
        """As for implicit steps; the guess must also be accurate relative to the load that the increment adds, which
        may be much smaller than the forces of a prestress."""
        change = self.model.comm.allreduce(float(((self.state.external - self._external) ** 2).sum()))
        guess = self.model.case.solver.rtol * float(np.sqrt(change)) if change else required
        return super()._tolerance(required)._replace(guess=min(guess, required))

    def solve(self, balance: Balance) -> Solution:
        """See :meth:`~pfem_petsc.stepping.stepper.Stepper.solve`; jumps of an increment are found. Collective."""
        begun, touch = self._solved, self.model.self_contact
        solution = super().solve(balance)
        # what friction of bars loses depends on the steps that are made
        looks = self.finds_jumps and balance.time > self.state.time and (touch is None or touch.symmetric)
        self._jumps = self._jumps_to(balance, solution, begun) if looks else []
        return solution

    @property
    def _solved(self) -> tuple:
        """What a solve changes."""
        state = self.state
        return state.external, state.contact, state.support, self.held, self.model.links.state, self.resolution.numbers

    @_solved.setter
    def _solved(self, values: tuple) -> None:
        state = self.state
        state.external, state.contact, state.support, self.held, self.model.links.state, self.resolution.numbers = (
            values
        )

    def _jumps_to(self, balance: Balance, solution: Solution, begun: tuple) -> list[Jump]:
        """Return the jumps between the state and the solution of a balance; ``begun``: :attr:`_solved` before it.
        Collective."""
        state, solved = self.state, self._solved
        after = self.with_ghosts(balance.predictor + solution.u).copy()

        def between(part: float, guess: np.ndarray) -> Place | None:
            inner = self.scheme.balance(state, part * (balance.time - state.time))
            self._solved = begun
            state.external = self.load_of(inner)
            u = guess[: len(inner.predictor)] - inner.predictor
            self.model.supports.put(u, self.model.supports.lacking(inner.predictor, inner.time))
            try:
                found = self._solve(inner, u)
            except NotConverged:
                return None
            return Place(part, inner.time, self.with_ghosts(inner.predictor + found.u).copy())

        try:
            found = JumpSearch(self.model, between).look(
                Place(0.0, state.time, state.x), Place(1.0, balance.time, after)
            )
        finally:
            self._solved = solved
        # a later stage may begin with a state that is not in equilibrium, from which no path leads
        begins = self.model.start is not None and state.step == 0
        return [jump for jump in found if not (begins and jump.first == state.time)]

    def _tell_jumps(self) -> None:
        """Warn of the jumps of the last increment."""
        for jump in self._jumps:
            follow = "[time] follows the motion"
            if not self.model.touches:
                follow = f'static.method = "arc_length" or "displacement" follows the path in between, and {follow}'
            self.message(
                f"step {self.number + 1}: {jump}: it is beyond a limit point or a bifurcation, and at rest again after "
                f"the motion that the released energy drives; {follow}"
            )

    def _untouched(self) -> bool:
        """Return whether contact is possible and nothing is in contact at the start of the increment. Collective."""
        model = self.model
        touched = self.state.contact.any() or (model.self_contact is not None and model.self_contact.touches)
        return model.touches and not model.comm.allreduce(int(touched), op=MPI.MAX)

    def resume(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        super().resume()
        if self.model.bars.can_break:
            kept = self.lagged_count, self.lagged_place, self.lagged_history
            self.hold_detached()
            self.lagged_count, self.lagged_place, self.lagged_history = kept

    def _resist(self, viscosity: float) -> None:
        """Set the viscosity of nodes, relative to that of ``stabilise``; in place, as the ledger uses the array."""
        if self.stabilise:
            inertia = self.model.inertia
            np.multiply(viscosity * self.stabilise, self.model.nodal_stiffness, out=inertia.damping)
            np.divide(inertia.damping, inertia.mass, out=self.scheme.lack)

    def _count_dissipation(self, size: float) -> None:
        """Add the dissipation of an increment, and warn once if its share is too large. Collective."""
        u = self.solution.u
        local = float((self.model.inertia.damping[:, None] * u * u).sum()) / size
        self.dissipated += self.model.comm.allreduce(local)
        share = self._share()
        if share > self.share and not self.exceeded:
            self.exceeded = True
            self.message(
                f"step {self.number + 1}, load factor {self.state.time:.6g}: static.stabilise has dissipated "
                f"{self.dissipated:.3g} J, {100.0 * share:.3g} % of the energy that the truss has absorbed, more than "
                f"static.stabilise_share = {self.share:g}: {_EXCEEDED}"
            )

    def _share(self) -> float:
        """Return the share of the viscosity in the energy that bars and viscosity have absorbed. Collective."""
        absorbed = self.model.comm.allreduce(self.energy.total) + self.dissipated
        return self.dissipated / absorbed if absorbed > 0.0 else 0.0

    def _release(self, size: float) -> None:
        """Find the equilibrium at the last load factor without the viscosity. Collective.

        If there is none close to the state, the truss moves on against the viscous force, as in an increment of this
        size in which the loads stay.
        """
        for _ in range(_RELEASES):
            try:
                self._stay("releases", 0.0)
                return
            except NotConverged as failure:
                reason = failure
            try:
                self._stay("creeps", self.viscosity)
                self._count_dissipation(size)
            except NotConverged:
                self.viscosity = min(_STRONGER * self.viscosity, 1.0)
        raise SimulationFailure(
            f"load factor {self.end:.6g} was reached with static.stabilise, but there is no equilibrium "
            f"nearby without it: reduce static.stabilise or static.step. The last attempt: {reason}"
        ) from reason

    def _stay(self, how: str, viscosity: float) -> None:
        """Solve at the load factor of the state with a viscosity relative to ``stabilise``. Collective."""
        setattr(self.scheme, how, True)
        self._resist(viscosity)
        try:
            self._make_part(self.end)
        finally:
            setattr(self.scheme, how, False)

    def remarks(self) -> list[str]:
        """Return how many bars are slack, what the viscosity has dissipated, and how many solves failed. Collective."""
        failures, bars = super().remarks(), self.model.bars
        slack = self.model.comm.allreduce(bars.slack_count()) if bars.slackens else 0
        if slack:
            failures.insert(
                0, f"load factor {self.state.time:.6g}: {slack:,} of {self.model.mesh.n_bars:,} bars are slack"
            )
        if not self.stabilise:
            return failures
        share = 100.0 * self._share()
        text = f"static.stabilise has dissipated {self.dissipated:.6g} J (damping_dissipation)"
        text += f", {share:.3g} % of the energy that the truss has absorbed"
        if self.exceeded:
            text += f"; static.stabilise_share = {self.share:g} was exceeded: {_EXCEEDED}"
        return [text, *failures]

    def settle(self) -> None:
        """Solve once more at the load factor that is reached, to rounding: motion that begins there begins at rest."""
        state, guard = self.state, self.guard
        balance = Equilibrium().balance(state, 0.0)
        self.accuracy, self.guard = 0.0, None
        try:
            self.solution = ImplicitStepper.solve(self, balance)
        except NotConverged:
            return
        finally:
            self.accuracy, self.guard = 1.0, guard
        state.position[:] = balance.predictor + self.solution.u
        self.evaluate(commit=True)

    def _no_further(self, failure: NotConverged) -> SimulationFailure:
        """Return the message about the load factor beyond which no equilibrium was found."""
        others = (
            'static.method = "arc_length" follows the path beyond a limit point, up to static.end or '
            "static.displacement if these are given; static.stabilise and dynamic stages pass jumps, such as struts "
            'that snap, and "relaxation" finds the equilibrium of slack structures'
        )
        model, smallest = self.model, self.limits.smallest
        free = free_motions(model, self.state)
        cause = "part of the truss is a mechanism" if free else self._limit_point(2.0 * smallest)
        if model.touches:
            cause += ", or part of the truss is a mechanism"
            others = "static.stabilise, or supports that move the truss instead of loads, pass a limit point"
            if model.contact.any and not model.contact.has_friction:
                others = f"walls without friction do not hold nodes along them: add supports; {others}"
            elif model.contact.any:
                cause += ", or the friction of walls does not hold it"
        touch = model.self_contact
        if touch is not None and touch.between:
            cause = (
                f"{touch.between} would pass through each other, as no contact bears more than its stiffness times the "
                f"radius or half the thickness; or {cause}"
            )
        # smaller increments have been tried
        attempt = re.sub(rf"[.;] {re.escape(self.remedy)}", "", str(failure), flags=re.IGNORECASE)
        return SimulationFailure(
            f"{self.of_case}no equilibrium found beyond load factor {self.state.time:.6g} with increments down to "
            f"{smallest:.3g}: {cause}; {others}. The last attempt: {attempt}{free}"
        )

    def _limit_point(self, size: float) -> str:
        """What the tangent stiffness shows about the load factors up to ``size`` beyond the equilibrium. Collective.

        The response to the load becomes infinite at a limit point. If one is nearer than an increment, twice this
        increment times the response is a displacement to states beyond it, where eigenvalues are negative, or zero in
        plastic mechanisms.
        """
        model, state = self.model, self.state
        if model.touches:
            return "it may be a limit point, which is not examined where contact is possible"
        stability = Stability(model, largest=LARGEST)
        if stability.refusal is not None:
            return f"it may be a limit point, which is not examined: {stability.refusal}"
        choice = LinearChoice("preonly", DIRECT[not stability.dense], "of the response")
        system = BorderedSystem(model, stability.matrix, choice, None, Equilibrium(), size)
        try:
            system.begin(state)
            rest = np.zeros_like(state.position)
            system.linearise(rest)
            here = stability.look().negatives
            if here:
                many = f"{here} negative eigenvalue{'s' * (here > 1)}"
                return f"the equilibrium is unstable there, with {many} of the stiffness"
            move, zero = size * system.response(rest, state.time), ZERO * stiffest(model)
            for part in _AHEAD:
                stability.matrix.update(system.problem, part * move)
                there = stability.look()
                if there.negatives or there.nearest < zero:
                    return "it is a limit point: the stiffness becomes singular there"
            if model.bars.kept_names:
                cause = self._beyond(system, size)
                if cause:
                    return cause
        except (NotConverged, np.linalg.LinAlgError, PETSc.Error):
            return "it may be a limit point: the stiffness cannot be factorised there"
        finally:
            system.destroy()
            stability.destroy()
        return "the stiffness shows no limit point: a smaller static.min_step or a larger solver.max_newton may help"

    def _beyond(self, system: BorderedSystem, size: float) -> str:
        """What the path of equilibria shows within some lengths of the increment ``size`` beyond the state, where bars
        yield or unload; empty if the load rises. Collective."""
        state, rest = self.state, np.zeros_like(self.state.position)
        system.linearise(rest)
        response = system.response(rest, state.time)
        square = dot(self.model.comm, response, response)
        if not square:  # nothing changes with the load factor
            return ""
        metric = Metric(self.model.comm, 1.0 / square)
        points, softest = PointSolver(state, system, metric, False), 1.0
        for length in size * _LENGTHS:
            try:
                point = points.find(Arc(metric, length), length * response, state.time + length)
            except NotConverged:
                continue
            if point.slope < 0.0:
                return "it is a limit point: beyond it the load falls, as bars yield or unload"
            if point.load_factor - state.time > size:
                return ""
            softest = min(softest, point.slope)
        if not softest < _SOFT:
            return ""
        return (
            f"it is close to a limit load: bars yield, and the truss moves {1.0 / max(softest, 1e-9):.2g} times as far "
            "with the load as where they unload"
        )

    def _free_guess(self, balance: Balance) -> np.ndarray:
        """Return the increment proportional to the last one."""
        return self.scheme.expected_move(self.state, balance.time - self.state.time)


METHODS = "pfem_petsc.statics.methods"

_DIRECT_UP_TO = 30_000  # unknowns; beyond, multigrid takes less time and memory than a factorisation
# 101,376 octet bars that yield: up to 300 conjugate gradient iterations a Newton step, and none that converges at 2 %
_DIRECT_YIELDING_UP_TO = 200_000


def make_stepper(model: Model) -> StaticStepper:
    """Create the stepper of a case, which goes from equilibrium to equilibrium, with its plan. Collective.

    Raises
    ------
    InputError
        On all ranks, if the case has features that a static analysis does not support.
    """
    _check(model)
    case = model.case
    parameters, choice = case.static.parameters, _linear(model)
    stepper = lookup(METHODS, case.static.method, "static.method").make_stepper(model, parameters, choice)
    if model.self_contact is not None:
        model.self_contact.begin_implicit(stepper.scheme)
    points = getattr(parameters, "max_points", None)
    words = ", ".join(f"{key} = {value}" for key, value in parameters.model_dump(exclude_none=True).items())
    stepper.plan = Plan(
        stepper.scheme,
        LOAD_FACTOR if points is None else POINT,
        {"static analysis": f"{case.static.method} ({words})", "linear solver": choice.why},
        parameters.step,
        stepper.end,
        choice,
        points,
    )
    return stepper


def _linear(model: Model) -> LinearChoice:
    """Choose the linear solver: a factorisation, which needs no definiteness, if affordable, else multigrid.

    Collective.
    """
    solver, unknowns = model.case.solver, 3 * model.mesh.n_nodes
    request = solver.linear
    if request == "auto":
        smooth = all(law_of(material).smooth for material in model.case.material.values())
        most = _DIRECT_UP_TO if smooth else _DIRECT_YIELDING_UP_TO
        free = solver.operator != "assembled" and model.self_contact is None
        multigrid = "multigrid" if free and fills_block(model.mesh) else "gamg"
        request = "mumps" if unknowns <= most and solver.operator != "matrix_free" else multigrid
    touch = model.self_contact
    operator, symmetric = (solver.operator, True) if touch is None else (touch.operator(), touch.symmetric)
    choice = choose_linear(request, operator, Demand(unknowns, np.inf, symmetric))
    if solver.linear == "auto":
        choice = replace(choice, why=choice.why.removesuffix(" (asked for)"))
    return choice


def _check(model: Model) -> None:
    """Refuse features that need time."""
    case = model.case
    source = case.source
    refuse_motion(case, "a static analysis")
    if model.bars.springs is not None and case.static.method != "newton":
        raise InputError(
            f'{source}: spring: static.method = "{case.static.method}" does not support springs to the ground; '
            'use "newton", or bars to supported nodes as springs'
        )
    if model.external.wind is not None and case.starts_from is None and model.external.wind.fastest():
        raise InputError(
            f"{source}: wind: drag turns with the bars, which a static analysis does not follow; use [time] with "
            "damping, or the forces as [[load]]; a stage may have [stage.wind]"
        )
    for wall in case.wall:
        if wall.mass is not None:
            raise InputError(
                f"{source}: wall {wall.name!r}: mass: a wall with mass moves over time; remove mass, or give the wall "
                "a motion"
            )
    model.links.check("scheme", False, model.size)
    for name, material in case.material.items():
        law = law_of(material)
        if law.rate and not law.static_limit:
            raise InputError(
                f'{source}: material.{name}.law = "{law_name(dict(material))}" depends on the rate of strain, and a '
                "static analysis has no time; use another law"
            )
    if not model.supports.any and not model.can_touch and model.bars.springs is None:
        raise InputError(
            f"{source}: static: nothing holds the truss: its rigid-body motions are free; give a [[support]] or "
            "[[spring]]"
        )
