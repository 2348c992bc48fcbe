"""Points along a path of equilibria, on which the load factor may increase and decrease."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..errors import InputError, NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..solvers.linear import LinearChoice
from ..stepping.stepper import AttributeOf, Solution
from ..tolerances import TIME
from .critical import EVENTS, CriticalPoints, Event, JumpSearch, Place
from .equilibrium import PathEquilibrium
from .path_points import (
    Arc,
    ArcControl,
    BorderedSystem,
    Direction,
    DisplacementControl,
    Linear,
    Metric,
    Point,
    PointSolver,
    dot,
)
from .stability import free_motions
from .stepper import StaticStepper

if TYPE_CHECKING:
    from ..stepping.model import Model


_UNRESOLVED = 2.0**-6  # of the first length, down to which a step is halved if a critical point is not located
_TURN = 0.5  # cosine between tangents of successive points, below which the step is halved if possible
_AHEAD = 0.0, 1.0, 2.0, 4.0, 8.0  # smallest lengths, up to which a displacement that turns back is looked for
_JUMPS = "the truss jumps"
_FACTORS = 0.5, 1.5  # of the length from point to point
PARTED = "no remaining bar carries the load"


class PathStepper(StaticStepper):
    """Advances from point to point by a predictor along the tangent and Newton's method with a constraint.

    Parameters
    ----------
    model : Model
    choice : LinearChoice
    keys : of the method
    by_displacement : whether points are asked for by their displacement along the direction, not by an arc length

    Attributes
    ----------
    arc : next length, in units of the load factor
    slope : derivative of the load factor with respect to the length at the state
    negatives : number of negative eigenvalues at the state, -1 if unknown
    events : found with the last point and not recorded yet
    outcome : why the path ended; empty before
    control : by which points are asked for
    """

    kept_numbers = (
        *StaticStepper.kept_numbers,
        "arc",
        "slope",
        "weight",
        "scale",
        "ended",
        "bifurcations",
        "turning",
        "outcome",
    )
    kept_arrays = (*StaticStepper.kept_arrays, "mode")
    scale = AttributeOf("control.scale")
    event_columns = EVENTS
    remedy = "reduce static.max_step or static.step; if such jumps are intended, set solver.guard = false"

    def __init__(self, model: Model, choice: LinearChoice, keys: Any, by_displacement: bool = False) -> None:
        _check_path(model, keys)
        super().__init__(model, choice, keys)
        self.keys = keys
        self.scheme = PathEquilibrium()
        self.end = float(keys.max_points)  # of the clock
        self.metric = Metric(model.comm)
        self.direction = None
        if keys.node_set is not None:
            self.direction = Direction(model, keys.node_set, keys.direction)
        self.control = DisplacementControl(self.metric, self.direction) if by_displacement else ArcControl(self.metric)
        self._make_points()
        self.arc, self.slope, self.negatives = keys.step, 0.0, -1
        self.weight = 0.0  # of the metric; zero before the first point
        self.ended, self.outcome = 0, ""
        self.bifurcations, self.turning = 0, 0  # turning: the next point lies along (1) or against (-1) the mode
        self._turn = 0
        self.mode = np.zeros_like(self.state.position)
        self.events: list[Event] = []
        self._point: Point | None = None
        if self.points.stability is not None and self.points.stability.refusal is not None:
            refusal = self.points.stability.refusal
            self.scheme.notice = f"bifurcations are not searched for, only limit points: {refusal}"

    def _make_points(self) -> None:
        """Create what solves for points, for the supports as they are. Collective."""
        self.system = BorderedSystem(self.model, self.hessian, self._choice, self.lagged, self.scheme, self.keys.step)
        self.points = PointSolver(self.state, self.system, self.metric, self.keys.critical_points)

    def supports_changed(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        self.points.destroy()
        super().supports_changed()
        self._make_points()

    @property
    def clock(self) -> float:
        """Number of the point, as the load factor need not increase."""
        return float(self.state.step)

    @property
    def done(self) -> bool:
        """Whether the path has reached a limit."""
        return bool(self.ended)

    def remarks(self) -> list[str]:
        """Return where and why the path ended."""
        state = self.state
        reached = self.outcome or "stopped"
        text = f"the path ended at point {state.step}, load factor {state.time:.9g}"
        if self.direction is not None:
            text += f", displacement {self.direction.at(state.position):.6g} m"
        text = f"{text}: {reached}"
        if self.negatives > 0:
            text += f"; the equilibrium there is unstable, with {int(self.negatives)} negative eigenvalue"
            text += "s" * (self.negatives > 1) + " of the stiffness under constant loads"
        found = [text, *super().remarks()]
        missed = [turn for turn in self.keys.branch_at if abs(turn) > self.bifurcations]
        if missed:
            found.append(
                f"static.branch_at = {missed}: the path has no such bifurcation, only {self.bifurcations} before "
                "its end"
            )
        return found

    def doubts(self) -> list[str]:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`; unstable parts of a path are no doubt, but in a remark."""
        return self.resolution.doubts(self.model)

    def start(self) -> None:
        """See :class:`StaticStepper`. Collective."""
        super().start()
        self.state.memory.pop("rate", None)

    def step(self) -> None:
        """Find the next point.

        Raises
        ------
        SimulationFailure
            On all ranks, if the path cannot be continued.
        """
        self.metric.weight = self.weight
        self.system.begin(self.state)
        if not self.weight and self._begin_path():
            return
        size = self.arc
        while True:
            self.smallest = size
            try:
                point, events, reached = self._next_point(size)
                break
            except NotConverged as failure:
                self.name_obstacle(failure)
                self.model.change_bars(self.state.time)  # as the failed solve has changed them
                if 0.5 * size < self.keys.smallest:
                    raise self._no_path(failure) from failure
                size *= 0.5
                self.tell_failure(failure, f"halving the length of the step, to {size:.4g}")
        broke, parted = self._accept(point, size)
        self.turning, self._turn = 0 if broke else self._turn, 0
        self.events, self.outcome = events, reached or parted
        self.bifurcations += sum(event.kind == "bifurcation" for event in events)
        low, high = _FACTORS
        factor = np.clip(np.sqrt(self.keys.iterations / max(point.newton, 1)), low, high)
        self.arc = float(np.clip(size * factor, self.keys.smallest, self.keys.largest))
        if not reached and self.state.step >= self.keys.max_points:
            self.outcome = f"static.max_points = {self.keys.max_points} points"
        self.ended = int(bool(self.outcome))

    def destroy(self) -> None:
        """Free the PETSc objects."""
        super().destroy()
        self.points.destroy()

    def solve(self, balance: Balance) -> Solution:
        """Return the point found as the solution of the step."""
        point = self._point
        g = np.empty_like(point.u)
        self.system.imbalance(point.u, point.load_factor, g)
        self.state.support = self.model.supports.part(g)
        # take account of what rounding leaves of the residual
        external = self.system.external(point.load_factor)
        sums = np.array([(array**2).sum() for array in (g - self.state.support, external)])
        norm, force = np.sqrt(self.model.comm.allreduce(sums))
        required = self.points.tolerance(point.u, point.load_factor, 0.0).residual
        self.resolution.note(self.model, self.system.problem.x, float(force), float(norm), required)
        walls = self.model.contact.nothing
        return Solution(point.u, self.system.problem.f, walls, point.newton, self.system.linear)

    def _begin_path(self) -> bool:
        """Take the first point; return whether a step was made, because the start was not in equilibrium."""
        try:
            point, moved = self._first_point()
        except NotConverged as failure:
            self.name_obstacle(failure)
            raise self._no_path(failure) from failure
        if moved:
            self._accept(point, self.keys.step)
        else:
            self.keep(point)
        return moved

    def _accept(self, point: Point, size: float) -> tuple[bool, str]:
        """Advance the state to a point; return whether bars broke there, and why the path ends if none carries the
        load. Collective."""
        self.part = self.smallest = size
        self.commit(point)
        self.keep(point)
        broke, parted = self._settle_broken()
        self.state.step += 1
        return broke, parted

    def commit(self, point: Point) -> None:
        """Make the step to a point. Collective."""
        self._point, self.scheme.reached = point, point.load_factor
        self._make_part(point.load_factor)
        self.system.linear = 0

    def keep(self, point: Point) -> None:
        """Store the tangent at a point and the signs of its eigenvalues."""
        self.state.memory["tangent"] = point.tangent
        self.slope, self.negatives = float(point.slope), point.negatives

    def _turns_at(self, point: Point, events: list[Event]) -> bool:
        """Return whether the path branches off at a bifurcation, the last event, and store its mode. Collective."""
        number = self.bifurcations + sum(event.kind == "bifurcation" for event in events)
        wanted = [turn for turn in self.keys.branch_at if abs(turn) == number]
        if not wanted:
            return False
        choices, chosen = self.points.modes(point, max(events[-1].multiplicity, 1)), self.keys.branch_mode
        if chosen > len(choices):
            many = f"{len(choices)} mode" + "s" * (len(choices) > 1)
            self.message(f"bifurcation {number} has only {many}: static.branch_mode = 1 is used")
            chosen = 1
        self._turn = 1 if wanted[0] > 0 else -1
        self.mode = choices[chosen - 1]
        return True

    def _no_path(self, failure: NotConverged) -> SimulationFailure:
        """Return the message about a path that cannot be continued."""
        hint = "; a smaller static.min_step or another static.step may pass"
        if self.scale:
            if failure.kind == _JUMPS or self._turns_back():
                hint = '; the displacement along static.direction turns back: static.method = "arc_length" continues'
            elif self.model.bars.kept_names:
                hint = f'; bars may begin to yield, unload or slacken there{hint}, or static.method = "arc_length"'
        return SimulationFailure(
            f"the path cannot be followed beyond point {self.state.step} at load factor {self.state.time:.6g} with "
            f"steps down to {self.keys.smallest:.3g}: {failure}{hint}{free_motions(self.model, self.state)}"
        )

    def _turns_back(self) -> bool:
        """Return whether the displacement per load along the direction passes zero on the tangent ahead. Collective."""
        tangent, rates = self.state.memory["tangent"], []
        try:
            length = self.control.length(self.keys.smallest, tangent)
            for lengths in _AHEAD:
                move, load_factor = lengths * length * tangent, self.state.time + lengths * length * self.slope
                self.system.linearise(move)
                rates.append(self.direction.of(self.system.response(move, load_factor)))
        except NotConverged:
            return not rates
        return any(rate * rates[0] < 0.0 and abs(rate) < abs(rates[0]) for rate in rates)

    def _first_point(self) -> tuple[Point, bool]:
        """Return the first point with its tangent, and whether it differs from the state; set the metric. Collective.

        It differs if the state is not an equilibrium at its load factor.

        Raises
        ------
        NotConverged, SimulationFailure
            On all ranks, if there is no equilibrium, or if the load factor moves no node.
        """
        state, system, points, u = self.state, self.system, self.points, np.zeros_like(self.zero)
        comm, newton, g = self.model.comm, 0, np.empty_like(u)
        system.residual(u, state.time, g)
        norm, tolerance = float(np.sqrt(dot(comm, g, g))), points.tolerance(u, state.time, 0.0)
        moved = not (norm <= tolerance.residual or tolerance.rounded(norm, g, 1.0, comm))
        if moved:
            u, _, newton = points.newton(self._load_factor(0.0, self.keys.step), u, state.time)
        system.linearise(u)
        response = system.response(u, state.time)
        size = float(np.sqrt(dot(comm, response, response)))
        if not size > 0.0 or not np.isfinite(size):
            raise SimulationFailure(
                f"{self.model.case.source}: static: the load factor moves no node at the start of the path: loads act "
                "on supports only, or tables are constant there"
            )
        self.weight = self.metric.weight = 1.0 / size**2
        sign = self.control.orient(response, size)
        length = self.metric.length(response)
        tangent, slope = sign * response / length, sign / length
        return Point(u, state.time, tangent, slope, *points.spectrum(u), newton), moved

    def _next_point(self, size: float) -> tuple[Point, list[Event], str]:
        """Return the point at a length or at a limit before it, the critical points on the way, and the limit reached.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        state = self.state
        if self.turning:
            mode = self.turning * self.mode
            guess, load_factor = size * mode, state.time
            along = Linear(self.metric.comm, self.metric.weight * mode, size, size)
            point = self.points.find(along, guess, load_factor)
        else:
            tangent = state.memory["tangent"]
            length = self.control.length(size, tangent)
            guess, load_factor = length * tangent, state.time + length * self.slope
            point = self.points.find(self.control.constraint(size), guess, load_factor)
        self._suspect(point, guess)
        if not self.turning:
            point = self._refuse_turn(point, size)
            if self.scale:
                self._refuse_jump(point, size)
        point, reached = self._end_at_limit(point)
        if self.turning or self.points.stability is None:
            return point, [], reached
        events: list[Event] = []
        start = replace(point, u=self.zero, load_factor=state.time, tangent=tangent, slope=self.slope)
        start.negatives = self.negatives
        try:
            for kind, found, multiplicity in CriticalPoints(self.points, self.control, start, point):
                way = np.nan if self.direction is None else self.direction.at(state.position + found.u)
                events.append(Event(kind, float(found.load_factor), self.number + 1, float(way), multiplicity))
                if kind == "bifurcation" and self._turns_at(found, events):
                    return found, events, ""
        except NotConverged as failure:
            # close to an imperfect bifurcation the point may lie on a path that does not pass through it
            if size > _UNRESOLVED * self.arc and 0.5 * size >= self.keys.smallest:
                raise
            self.message(f"a critical point was not located: {failure}")
            events = []
        return point, events, reached

    def _refuse_turn(self, point: Point, size: float) -> Point:
        """Refuse a tangent that has turned too far: it belongs to another path, or the step has cut a corner.

        Returns the point, with the tangent that continues the path.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        cornered = bool(self.scale and self.model.bars.kept_names)
        if cornered and self.direction.of(point.tangent) < 0.0:  # where bars yield the path may turn by any angle
            point = replace(point, tangent=-point.tangent, slope=-point.slope)
        cosine = self.metric.product(point.tangent, self.state.memory["tangent"])
        if cosine < _TURN and 0.5 * size >= self.keys.smallest:
            raise NotConverged(
                f"{self.points.place}: the path turns by {np.degrees(np.arccos(max(cosine, -1.0))):.3g} degrees"
            )
        if self.scale and cosine < 0.0 and not cornered:
            raise NotConverged(f"{self.points.place}: the path turns by more than 90 degrees", _JUMPS)
        return point

    def _refuse_jump(self, point: Point, size: float) -> None:
        """Refuse a point to which the truss jumps, as where the displacement turns back.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        state, change = self.state, point.load_factor - self.state.time

        def between(part: float, guess: np.ndarray) -> Place | None:
            u = guess[: len(point.u)] - state.position
            try:
                u, load_factor, _ = self.points.newton(
                    self.control.constraint(part * size), u, state.time + part * change
                )
            except NotConverged:
                return None
            return Place(part, load_factor, self.with_ghosts(state.position + u).copy())

        last = Place(1.0, point.load_factor, self.with_ghosts(state.position + point.u).copy())
        for jump in JumpSearch(self.model, between).look(Place(0.0, state.time, state.x), last):
            raise NotConverged(f"{self.points.place}: {jump}", _JUMPS)

    def _suspect(self, point: Point, guess: np.ndarray) -> None:
        """Refuse a point that is unrelated to the last one.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        if self.guard is None:
            return
        state = self.state
        after = self.with_ghosts(state.position + point.u)
        forces = np.maximum(np.abs(self.system.external(point.load_factor)), np.abs(self.system.external(state.time)))
        energy = 0.5 * float(((forces + np.abs(state.support)) * np.abs(point.u)).sum())
        reason = self.guard.check(state.x, after, state.position + guess, energy)
        if reason is not None:
            raise NotConverged(f"{self.points.place}: {reason}; {self.remedy}", reason.partition(":")[0])

    def _end_at_limit(self, point: Point) -> tuple[Point, str]:
        """Return a point and an empty text, or the point at the first limit before it and that limit. Collective.

        Raises
        ------
        NotConverged
            On all ranks, if there is no point at the limit.
        """
        limits = self._exceeded(point)
        if not limits:
            return point, ""
        time = self.state.time
        share, constraint, reached = min(limits, key=lambda limit: limit[0])
        change = share * (point.load_factor - time)
        return self.points.find(constraint, share * point.u, time + change), reached

    def _load_factor(self, change: float, size: float) -> Linear:
        """Return the constraint of the point at a change of the load factor."""
        return Linear(self.metric.comm, self.zero, change, size, by_load=1.0)

    def _exceeded(self, point: Point) -> list[tuple[float, Arc | Linear, str]]:
        """Return the limits that a point exceeds: share of the step up to them, constraint, and text. Collective."""
        state, keys, direction = self.state, self.keys, self.direction
        limits: list[tuple[float, Arc | Linear, str]] = []
        change = point.load_factor - state.time
        if keys.end is not None and point.load_factor >= keys.end * (1.0 - TIME):
            left = keys.end - state.time
            limits.append((left / change, self._load_factor(left, abs(change)), f"static.end = {keys.end:g}"))
        if keys.displacement is not None:
            start, way = direction.at(state.position), direction.of(point.u)
            if start + way >= keys.displacement * (1.0 - TIME):
                left = keys.displacement - start
                constraint = direction.constraint(left, self.scale or abs(way))
                limits.append((left / way, constraint, f"static.displacement = {keys.displacement:g} m"))
        return limits

    def _settle_broken(self) -> tuple[bool, str]:
        """Find equilibria at the same displacement until no further bar breaks. Collective.

        Returns whether bars broke, and why the path ends there: an empty text if it goes on.

        Raises
        ------
        SimulationFailure
            On all ranks, if the rest of the truss finds no equilibrium.
        """
        broke, ended = False, ""
        if not self.model.bars.can_break:
            return broke, ended
        while self.model.comm.allreduce(self.energy.changed > 0, op=MPI.LOR):
            broke = True
            self.hold_detached()
            try:
                point, ended = self._without_broken()
                self.commit(point)
            except NotConverged as failure:
                raise SimulationFailure(
                    f"{self.arrived()}: the rest of the truss finds no equilibrium at this displacement after bars "
                    "broke: a part of it is a mechanism, or the next equilibrium is distant; [time] follows the "
                    f"motion. The last attempt: {failure}{free_motions(self.model, self.state)}"
                ) from failure
            self.keep(point)
        return broke, ended

    def _without_broken(self) -> tuple[Point, str]:
        """Return the point of the bars that are left; without a load on them, that at load factor zero, and why."""
        state, system, points, comm = self.state, self.system, self.points, self.model.comm
        system.begin(state)
        zero = np.zeros_like(state.position)
        system.linearise(zero)
        gradient = self.control.gradient(state.memory["tangent"])
        response = system.response(zero, state.time)
        size = float(np.sqrt(dot(comm, gradient, gradient) * dot(comm, response, response)))
        along = dot(comm, gradient, response)
        if not abs(along) > 1e-12 * size:
            u, load_factor, newton = points.newton(self._load_factor(-state.time, self.arc), zero, state.time)
            tangent, slope = state.memory["tangent"], self.slope
            return Point(u, load_factor, tangent, slope, *points.spectrum(u), newton), PARTED
        point = points.find(Linear(comm, gradient, 0.0, self.arc), zero, state.time)
        sign = np.sign(dot(comm, gradient, point.tangent))
        return replace(point, tangent=sign * point.tangent, slope=float(sign * point.slope)), ""


def _check_path(model: Model, keys: Any) -> None:
    """Refuse what path following does not support.

    Raises
    ------
    InputError
        On all ranks.
    """
    case = model.case
    if case.remove:
        raise InputError(
            f'{case.source}: static.method = "{case.static.method}" can pass a load factor several times or never, '
            'so that [[remove]] has no defined time; remove bars and supports with static.method = "newton"'
        )
    if model.can_touch:
        raise InputError(
            f'{case.source}: static.method = "{case.static.method}" follows paths without contact; remove walls, '
            'contact pairs and constraints, or use static.method = "newton", with static.stabilise beyond limit points'
        )
    if not (model.external.active or model.supports.moves or model.bars_vary):
        raise InputError(f"{case.source}: static: nothing depends on the load factor; give a [[load]] or a table")
    free = 3 * model.mesh.n_nodes - model.comm.allreduce(model.supports.number)
    unknown = [turn for turn in keys.branch_at if abs(turn) > free]
    if unknown:
        raise InputError(
            f"{case.source}: static.branch_at = {unknown}: bifurcations are numbered from 1 along the path, and a "
            f"truss with {free} free components has no more than {free} eigenvalues that can change their sign on it; "
            "run the case without branch_at, which reports the bifurcations and their numbers"
        )
    if keys.node_set is not None and not model.comm.allreduce(len(model.nodes[keys.node_set])):
        raise InputError(f"{case.source}: static.node_set = {keys.node_set!r} has no nodes")
