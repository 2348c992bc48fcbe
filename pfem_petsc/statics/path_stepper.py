"""Points along a path of equilibria, on which the load factor may increase and decrease."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import NotConverged, SimulationFailure
from ..integrators.base import Balance
from ..solvers.linear import LinearChoice
from ..stepping.solution import Solution
from .bordered import BorderedSystem
from .controls import ByArc, ByComponent, Control
from .critical import EVENTS, Event
from .free_motions import free_motions
from .path_constraints import Direction, Metric
from .path_next import next_point
from .path_rupture import settle_broken
from .path_scheme import PathEquilibrium
from .path_start import check_path, first_point
from .points import Point, PointSolver
from .stepper import StaticStepper

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .path_keys import PathKeys

__all__ = ["PathStepper"]

_FACTORS = 0.5, 1.5  # of the length from point to point


class PathStepper(StaticStepper):
    """Advances from point to point by a predictor along the tangent and Newton's method with a constraint.

    Parameters
    ----------
    model : Model
    choice : LinearChoice
    keys : of the method
    component : whether points are defined by a displacement instead of an arc length

    Attributes
    ----------
    arc : next length, in units of the load factor
    slope : derivative of the load factor with respect to the length at the state
    negatives : number of negative eigenvalues at the state, -1 if unknown
    events : found with the last point and not recorded yet
    outcome : why the path ended; empty before
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
    event_columns = EVENTS
    remedy = "reduce static.max_step or static.step; if such jumps are intended, set solver.guard = false"

    def __init__(self, model: Model, choice: LinearChoice, keys: PathKeys, component: bool) -> None:
        check_path(model, keys)
        super().__init__(model, choice, keys)
        self.keys = keys
        self.scheme = PathEquilibrium()
        self.end = float(keys.max_points)  # of the clock
        self.metric = Metric(model.comm, keys.spherical)
        self.direction = None
        if keys.node_set is not None:
            self.direction = Direction(model, keys.node_set, keys.direction)
        self.by_component = component
        self.control: Control = ByComponent(self.direction) if component else ByArc(self.metric)
        self._choice = choice
        self._make_system()
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

    def _make_system(self) -> None:
        """Create what solves for points, for the supports as they are. Collective."""
        self.system = BorderedSystem(self.model, self.hessian, self._choice, self.lagged, self.scheme, self.keys.step)
        self.points = PointSolver(self.model, self.state, self.system, self.metric, self.keys.critical_points)

    def supports_changed(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        self.system.destroy()
        self.points.destroy()
        super().supports_changed()
        self._make_system()

    @property
    def clock(self) -> float:
        """Number of the point, as the load factor need not increase."""
        return float(self.state.step)

    @property
    def scale(self) -> float:
        """Scale of the prescribed displacement [m]; zero with arc lengths."""
        return self.control.scale

    @scale.setter
    def scale(self, value: float) -> None:
        if value:
            self.control.scale = value

    def measure(self, point: Point) -> float:
        """Return the measure of a point. Collective."""
        return self.control.measure(point.u, point.load_factor - self.state.time)

    def rate(self, point: Point) -> float:
        """Return the derivative of the measure along the tangent at a point. Collective."""
        return self.control.rate(point.u, point.load_factor - self.state.time, point.tangent, point.slope)

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
                point, events, reached = next_point(self, size)
                break
            except NotConverged as failure:
                self.name_obstacle(failure)
                self._restore_bars()
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
        self.system.destroy()
        self.points.destroy()

    def solve(self, balance: Balance) -> Solution:
        """Return the point found as the solution of the step."""
        point = self._point
        g = np.empty_like(point.u)
        self.system.imbalance(point.u, point.load_factor, g)
        self.state.support = self.model.supports.part(g)
        self._note(point, g - self.state.support)
        walls = self.model.contact.nothing
        return Solution(point.u, self.system.problem.f, walls, point.newton, self.system.linear)

    def _note(self, point: Point, g: np.ndarray) -> None:
        """Take account of what rounding leaves of the residual (owned, 3) [N] at a point. Collective."""
        sums = np.array([(array**2).sum() for array in (g, self.system.external(point.load_factor))])
        norm, force = np.sqrt(self.model.comm.allreduce(sums))
        required = self.points.tolerance(point.u, point.load_factor, 0.0).residual
        self.resolution.note(self.model, self.system.problem.x, float(force), float(norm), required)

    def _begin_path(self) -> bool:
        """Take the first point; return whether a step was made, because the start was not in equilibrium."""
        try:
            point, moved = first_point(self)
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
        broke, parted = settle_broken(self)
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
        self.slope, self.negatives = float(point.slope), int(point.negatives)

    def turns_at(self, number: int, point: Point, multiplicity: int) -> bool:
        """Return whether the path branches off at a bifurcation, counted from 1, and store the mode. Collective."""
        wanted = [turn for turn in self.keys.branch_at if abs(turn) == number]
        if not wanted:
            return False
        choices = self.points.modes(point, max(multiplicity, 1))
        chosen = self.keys.branch_mode
        if chosen > len(choices):
            many = f"{len(choices)} mode" + "s" * (len(choices) > 1)
            self.message(f"bifurcation {number} has only {many}: static.branch_mode = 1 is used")
            chosen = 1
        self._turn = 1 if wanted[0] > 0 else -1
        self.mode = choices[chosen - 1]
        return True

    def _restore_bars(self) -> None:
        if self.model.bars_vary:
            # the failed solve has changed the bars
            self.model.change_bars(self.state.time)

    def _no_path(self, failure: NotConverged) -> SimulationFailure:
        """Return the message about a path that cannot be continued."""
        hint = ""
        if self.control.scale:
            hint = '; if the displacement along static.direction turns back, static.method = "arc_length" continues'
        return SimulationFailure(
            f"the path cannot be followed beyond point {self.state.step} at load factor {self.state.time:.6g} with "
            f"steps down to {self.keys.smallest:.3g}: {failure}{hint}{free_motions(self.model, self.state)}"
        )
