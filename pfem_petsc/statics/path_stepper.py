"""Points along the path of equilibria, on which the load factor may rise and fall."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..solvers.linear import LinearChoice
from ..stepping.solution import Solution
from ..tolerances import TIME
from .bordered import BorderedSystem
from .controls import ByArc, ByComponent, Control
from .critical import EVENTS, Event, find_critical
from .free_motions import free_motions
from .path_constraints import Along, Component, Direction, LoadFactor, Metric, dot
from .path_scheme import PathEquilibrium
from .points import Point, PointSolver
from .stepper import StaticStepper

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .path_keys import PathKeys

__all__ = ["PathStepper"]

_FACTORS = 0.5, 1.5  # of the length from point to point
_UNRESOLVED = 2.0**-6  # of the length first tried, down to which a step is halved for a critical point not located
_TURN = 0.5  # cosine between tangents of successive points, below which the step is halved while it can be


class PathStepper(StaticStepper):
    """Advances from point to point by a predictor along the tangent and Newton's method with a constraint.

    Parameters
    ----------
    model : Model
    choice : LinearChoice
    keys : of the method
    component : whether points are given by a displacement, instead of a length of arc

    Attributes
    ----------
    arc : length that is tried next, in units of the load factor
    slope : of the load factor over the length, at the state
    negatives : number of negative eigenvalues at the state, -1 unknown
    events : found with the last point and not recorded yet
    outcome : why the path ended; empty before
    """

    kept_numbers = (
        *StaticStepper.kept_numbers,
        "arc",
        "slope",
        "negatives",
        "weight",
        "scale",
        "ended",
        "bifurcations",
        "turning",
        "outcome",
    )
    kept_arrays = (*StaticStepper.kept_arrays, "mode")
    event_columns = EVENTS
    remedy = "reduce static.max_step or static.step; if such jumps are intended, set solver.guard = false"

    def __init__(self, model: Model, choice: LinearChoice, keys: PathKeys, component: bool) -> None:
        _check(model, keys)
        super().__init__(model, choice, keys)
        self.keys = keys
        self.scheme = PathEquilibrium()
        self.end = float(keys.max_points)  # of the clock
        self.metric = Metric(model.comm, keys.spherical)
        self.direction = None
        if keys.node_set is not None:
            self.direction = Direction(model, keys.node_set, keys.direction)
        self.control: Control = ByComponent(self.direction) if component else ByArc(self.metric)
        self.system = BorderedSystem(model, self.hessian, choice, self.lagged, self.scheme, keys.step)
        self.points = PointSolver(model, self.state, self.system, self.metric, keys.critical_points)
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
            self.scheme.notice = f"bifurcations are not looked for, only limit points: {refusal}"

    @property
    def clock(self) -> float:
        """Number of the point: the load factor need not increase."""
        return float(self.state.step)

    @property
    def scale(self) -> float:
        """Of the displacement that is prescribed [m]; zero with lengths of arc."""
        return self.control.scale

    @scale.setter
    def scale(self, value: float) -> None:
        if value:
            self.control.scale = value

    def measure(self, point: Point) -> float:
        """The measure of a point. Collective."""
        return self.control.measure(point.u, point.load_factor - self.state.time)

    def rate(self, point: Point) -> float:
        """Derivative of the measure along the tangent at a point. Collective."""
        return self.control.rate(point.u, point.load_factor - self.state.time, point.tangent, point.slope)

    @property
    def done(self) -> bool:
        """Whether the path has reached one of its limits."""
        return bool(self.ended)

    def remarks(self) -> list[str]:
        """Where the path ended, and why."""
        state = self.state
        reached = self.outcome or "stopped"
        text = f"the path ended at point {state.step}, load factor {state.time:.9g}"
        if self.direction is not None:
            text += f", displacement {self.direction.at(state.position):.6g} m"
        return [f"{text}: {reached}"]

    def start(self) -> None:
        """See :class:`StaticStepper`. Collective."""
        super().start()
        self.state.memory.pop("rate", None)

    def step(self) -> None:
        """Find the next point.

        Raises
        ------
        SimulationFailure
            On all ranks, where the path cannot go on.
        """
        self.metric.weight = self.weight
        self.system.begin(self.state)
        if not self.weight and self._begin_path():
            return
        size = self.arc
        while True:
            self.smallest = size
            try:
                point, events, reached = self._next(size)
                break
            except NotConverged as failure:
                self._restore_bars()
                if 0.5 * size < self.keys.smallest:
                    raise self._no_path(failure) from failure
                size *= 0.5
                self.message(f"{failure}; halving the length of the step, to {size:.4g}")
        self._accept(point, size)
        self.turning, self._turn = self._turn, 0
        self.events, self.outcome = events, reached
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
        self.system.destroy()
        self.points.destroy()

    def solve(self, balance: Balance) -> Solution:
        """The point found, as the solution of the step that goes there."""
        point, fixed = self._point, self.model.supports.fixed
        g = np.empty_like(point.u)
        self.system.imbalance(point.u, point.load_factor, g)
        self.state.support = np.zeros_like(g)
        self.state.support[fixed] = g[fixed]
        walls = self.model.contact.nothing
        return Solution(point.u, self.system.problem.f, walls, point.newton, self.system.linear)

    def _begin_path(self) -> bool:
        """Tangent and metric at the start; whether a point was made, as the start was not in equilibrium."""
        state, u = self.state, np.zeros_like(self.zero)
        try:
            g = np.empty_like(u)
            self.system.residual(u, state.time, g)
            moved = float(np.sqrt(dot(self.model.comm, g, g))) > self.points.tolerance(u, state.time, 0.0)
            newton = 0
            if moved:
                at_rest = LoadFactor(0.0, self.keys.step)
                u, _, newton = self.points.newton(at_rest, u, state.time)
            self.system.linearise(u)
            response = self.system.response(u, state.time)
        except NotConverged as failure:
            raise self._no_path(failure) from failure
        size = float(np.sqrt(dot(self.model.comm, response, response)))
        if not size > 0.0 or not np.isfinite(size):
            raise SimulationFailure(
                f"{self.model.case.source}: static: the load factor moves no node at the start of the path: loads act "
                "on supports alone, or tables are constant there"
            )
        self.weight = self.metric.weight = 1.0 / size**2
        sign = self._begin_component(response, size) if isinstance(self.control, ByComponent) else 1.0
        length = self.metric.length(response, 1.0)
        tangent, slope = sign * response / length, sign / length
        negatives, nearest = self.points.spectrum(u)
        point = Point(u, state.time, tangent, slope, negatives, nearest, newton)
        if moved:
            self._accept(point, self.keys.step)
        else:
            self._keep(point)
        return moved

    def _begin_component(self, response: np.ndarray, size: float) -> float:
        """Scale of the displacement that is prescribed; the sign of load factors that increase it. Collective."""
        along = self.direction.of(response)
        if not abs(along) > 1e-12 * size:
            raise SimulationFailure(
                "static.direction: the load does not move the nodes of static.node_set along it at the start of "
                'the path; take another direction, or static.method = "arc_length"'
            )
        self.scale = abs(along)
        return float(np.sign(along))

    def _next(self, size: float) -> tuple[Point, list[Event], str]:
        """The point at a length, or the limit that comes before it; critical points on the way; and the limit reached.

        Raises
        ------
        NotConverged
            On all ranks.
        """
        state = self.state
        if self.turning:
            mode = self.turning * self.mode
            guess, load_factor = size * mode, state.time
            point = self.points.find(Along(self.metric, mode, size), guess, load_factor)
        else:
            tangent = state.memory["tangent"]
            length = self.control.advance(tangent, size)
            guess, load_factor = length * tangent, state.time + length * self.slope
            point = self.points.find(self.control.constraint(size), guess, load_factor)
        self._suspect(point, guess)
        if not self.turning:
            self._refuse_turn(point, size)
        point, reached = self._limited(point)
        if self.turning or self.points.stability is None:
            return point, [], reached
        try:
            events, turn = find_critical(self, point)
        except NotConverged as failure:
            # beside an imperfect bifurcation a step may have come to a path that does not lead there
            if size > _UNRESOLVED * self.arc and 0.5 * size >= self.keys.smallest:
                raise
            self.message(f"a critical point was not located: {failure}")
            events, turn = [], None
        if turn is not None:
            point, reached = turn, ""
        return point, events, reached

    def _refuse_turn(self, point: Point, size: float) -> None:
        """A tangent that has turned too much is that of another path, or of a corner that the step has cut."""
        cosine = self.metric.product(point.tangent, point.slope, self.state.memory["tangent"], self.slope)
        if cosine < _TURN and 0.5 * size >= self.keys.smallest:
            raise NotConverged(
                f"{self.points.place}: the path turns by {np.degrees(np.arccos(max(cosine, -1.0))):.3g} degrees"
            )
        if self.control.scale and cosine < 0.0:
            raise NotConverged(
                f"{self.points.place}: the displacement along static.direction turns back; static.method = "
                '"arc_length" follows the path'
            )

    def _limited(self, point: Point) -> tuple[Point, str]:
        """The point, or the one at the first limit that is exceeded, and that limit."""
        state, keys = self.state, self.keys
        limits = []
        if keys.end is not None and point.load_factor >= keys.end * (1.0 - TIME):
            share = (keys.end - state.time) / (point.load_factor - state.time)
            constraint = LoadFactor(keys.end - state.time, abs(point.load_factor - state.time))
            limits.append((share, constraint, f"static.end = {keys.end:g}"))
        if keys.displacement is not None:
            start, way = self.direction.at(state.position), self.direction.of(point.u)
            if start + way >= keys.displacement * (1.0 - TIME):
                scale = self.control.scale or abs(way)
                constraint = Component(self.direction, keys.displacement - start, scale)
                limits.append(
                    ((keys.displacement - start) / way, constraint, f"static.displacement = {keys.displacement:g} m")
                )
        if not limits:
            return point, ""
        share, constraint, reached = min(limits, key=lambda limit: limit[0])
        change = share * (point.load_factor - state.time)
        return self.points.find(constraint, share * point.u, state.time + change), reached

    def _suspect(self, point: Point, guess: np.ndarray) -> None:
        """Refuse a point that has nothing to do with the last one. Collective."""
        if self.guard is None:
            return
        state, model = self.state, self.model
        self._after[: model.mesh.n_owned] = state.position + point.u
        model.mesh.update_ghosts(self._after)
        forces = np.maximum(np.abs(self.system.external(point.load_factor)), np.abs(self.system.external(state.time)))
        energy = 0.5 * float(((forces + np.abs(state.support)) * np.abs(point.u)).sum())
        reason = self.guard.check(state.x, self._after, state.position + guess, energy)
        if reason is not None:
            raise NotConverged(f"{self.points.place}: {reason}; {self.remedy}")

    def _accept(self, point: Point, size: float) -> None:
        """Make the step to a point. Collective."""
        self._point, self.part = point, size
        self.smallest = size
        self.scheme.reached = point.load_factor
        self._make_part(point.load_factor)
        self.system.linear = 0
        self.state.step += 1
        self._keep(point)

    def _keep(self, point: Point) -> None:
        self.state.memory["tangent"] = point.tangent
        self.slope, self.negatives = float(point.slope), int(point.negatives)

    def turns_at(self, number: int, point: Point, multiplicity: int) -> bool:
        """Whether the path is to leave at a bifurcation, counted from 1; its mode is kept then. Collective."""
        wanted = [turn for turn in self.keys.branch_at if abs(turn) == number]
        if not wanted:
            return False
        choices = self.points.modes(point, max(multiplicity, 1))
        chosen = self.keys.branch_mode
        if chosen > len(choices):
            many = f"{len(choices)} mode" + "s" * (len(choices) > 1)
            self.message(f"bifurcation {number} has {many} to leave along: static.branch_mode = 1 is taken")
            chosen = 1
        self._turn = 1 if wanted[0] > 0 else -1
        self.mode = choices[chosen - 1]
        return True

    def _restore_bars(self) -> None:
        if self.model.bars_vary:
            # the failed solve has changed the bars
            self.model.change_bars(self.state.time)

    def _no_path(self, failure: NotConverged) -> SimulationFailure:
        """What to tell of a path that cannot go on."""
        hint = ""
        if self.control.scale:
            hint = '; where the displacement along static.direction turns back, static.method = "arc_length" goes on'
        return SimulationFailure(
            f"the path cannot be followed beyond point {self.state.step} at load factor {self.state.time:.6g} with "
            f"steps down to {self.keys.smallest:.3g}: {failure}{hint}{free_motions(self.model, self.state)}"
        )


def _check(model: Model, keys: PathKeys) -> None:
    """Refuse what a path cannot have."""
    case = model.case
    if model.can_touch:
        raise InputError(
            f'{case.source}: static.method = "{case.static.method}" follows paths without contact; remove walls, '
            'contact pairs and constraints, or take static.method = "newton"'
        )
    if not (model.external.active or model.supports.moving or model.bars_vary):
        raise InputError(f"{case.source}: static: nothing depends on the load factor; give a [[load]] or a table")
    if keys.node_set is not None and not model.comm.allreduce(len(model.nodes[keys.node_set])):
        raise InputError(f"{case.source}: static.node_set = {keys.node_set!r} has no nodes")
