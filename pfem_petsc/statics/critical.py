"""Critical points between two points of a path: limit points of the load factor, and bifurcations; jumps within an
increment.

At a limit point the slope of the load factor changes sign, and the number of negative eigenvalues of the tangent
stiffness changes by one. Where this number changes without a change of sign, paths cross: a bifurcation. Both are
located by regula falsi with bisection over the length from the last point; each trial is a point of the path.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np

from ..errors import NotConverged

if TYPE_CHECKING:
    from ..stepping.model import Model
    from .path_points import ArcControl, Point, PointSolver

KINDS = {"limit": 0, "bifurcation": 1}
EVENTS: dict[str, Any] = {
    "kind": h5py.enum_dtype(KINDS, basetype="i8"),
    "load_factor": np.float64,
    "step": np.int64,
    "displacement": np.float64,
    "multiplicity": np.int64,
}
"""Columns of events, and their types."""

_TRIALS = 60
_LOCATED = 1e-8  # last change of the length, over the step
_NARROW = 1e-3  # interval, over the step, in which the last trial is accepted if no further one converges
_FLAT = 1e-9  # slope of the load factor at a limit point, over that of the first response
_BESIDE = 4e-3  # distance from a bifurcation, over the step, at which the path is well determined
_DEPTH = 8  # bisections to separate the critical points of a step


@dataclass(frozen=True)
class Event:
    """A critical point.

    Attributes
    ----------
    kind : ``limit`` or ``bifurcation``
    load_factor : there
    step : number of the first point at it or beyond it
    displacement : along ``static.direction`` [m]; NaN if there is none
    multiplicity : number of eigenvalues that change sign
    """

    kind: str
    load_factor: float
    step: int
    displacement: float
    multiplicity: int

    def row(self) -> dict[str, Any]:
        """Return the values by column."""
        return {**self.__dict__, "kind": KINDS[self.kind]}

    def __str__(self) -> str:
        what = {"limit": "limit point", "bifurcation": "bifurcation"}[self.kind]
        what += f" of {self.multiplicity} modes" if self.multiplicity > 1 else ""
        where = "" if np.isnan(self.displacement) else f", displacement {self.displacement:.6g} m"
        return f"{what} at load factor {self.load_factor:.9g}{where}, before point {self.step}"


class _End(NamedTuple):
    """An end of an interval: length, slope, and number of negative eigenvalues."""

    size: float
    slope: float
    negatives: int


class CriticalPoints:
    """The search for critical points between two points of a path. Methods are collective.

    Parameters
    ----------
    points : PointSolver, begun at the first point
    control : by which points are asked for
    first, last : the points
    """

    def __init__(self, points: PointSolver, control: ArcControl, first: Point, last: Point) -> None:
        self.points, self.control, self.first, self.last = points, control, first, last
        self.size = control.measure(last)

    def __iter__(self) -> Iterator[tuple[str, Point, int]]:
        """Locate the critical points in their order: kind, point, and number of eigenvalues that change sign.

        Raises
        ------
        NotConverged
            On all ranks, if one cannot be located between the points: the last may lie on another path.
        """
        start = _End(0.0, self.first.slope, self.first.negatives)
        yield from self._look(start, self._end(self.last), 0)

    def _look(self, first: _End, second: _End, depth: int) -> Iterator[tuple[str, Point, int]]:
        """Locate the critical points of an interval, starting from its first end."""
        turned = first.slope * second.slope < 0.0  # the load factor
        known = first.negatives >= 0 and second.negatives >= 0
        change = second.negatives - first.negatives if known else 0
        if not (turned or change):
            return
        limit = abs(change) == 1 or first.negatives < 0
        if turned and (limit or depth == _DEPTH):
            # the load factor turns without a change of sign of an eigenvalue where two paths meet
            sign = np.sign(first.slope)
            point = self._locate(first, second, lambda point: sign * point.slope, _FLAT)
            yield "limit" if limit else "bifurcation", point, max(abs(change), 1)
            return
        if turned:
            middle = self._end(self._at(0.5 * (first.size + second.size)))
            yield from self._look(first, middle, depth + 1)
            yield from self._look(middle, second, depth + 1)
            return
        before = first.negatives

        def distance(point: Point) -> float:
            return point.nearest if point.negatives == before else -point.nearest

        tried: list[tuple[float, float]] = []
        try:
            size = self.control.measure(self._locate(first, second, distance, 0.0, tried))
        except NotConverged:
            size = self._between(first, second, distance, tried)
        beyond = self._at(size + _BESIDE * self.size)
        many = abs(beyond.negatives - before) or 1
        yield "bifurcation", self._crossing(size, beyond), many
        end = self._end(beyond)._replace(negatives=before + (many if second.negatives > before else -many))
        if end.size < second.size:
            yield from self._look(end, second, depth + 1)

    def _between(
        self, first: _End, second: _End, value: Callable[[Point], float], tried: list[tuple[float, float]]
    ) -> float:
        """Return the zero of a value by inverse interpolation of trials (length, value).

        At a bifurcation the equations are singular, and Newton's method needs too many iterations; beside it the value
        is accurate.
        """
        from scipy.interpolate import barycentric_interpolate

        before = [trial for trial in tried if trial[1] > 0.0]
        beyond = [trial for trial in tried if trial[1] <= 0.0]
        low = max(before)[0] if before else first.size
        high = min(beyond)[0] if beyond else second.size
        guess = 0.5 * (low + high)
        if before and beyond:
            (a, fa), (b, fb) = max(before), min(beyond)
            guess = (a * fb - b * fa) / (fb - fa)
        for side in (-2.0, -1.0, 1.0, 2.0):
            size = guess + side * _BESIDE * self.size
            if size not in [trial[0] for trial in tried]:
                tried.append((size, value(self._at(size))))
        sizes, values = np.array(sorted(tried, key=lambda trial: abs(trial[0] - guess))[:4]).T
        return float(barycentric_interpolate(values, sizes, 0.0))

    def _crossing(self, size: float, beyond: Point) -> Point:
        """Return the point at a bifurcation, interpolated between points on both sides of it.

        At the bifurcation itself, neither the position along the mode nor the tangent of the path is well determined.
        """
        low = size - _BESIDE * self.size
        before = self._at(low) if low > _BESIDE * self.size else self.first
        low = max(low, 0.0) if before is not self.first else 0.0
        u, load_factor, tangent, slope = self._cubic(before, low, beyond, self.control.measure(beyond), size)
        length = self.points.metric.length(tangent)
        return replace(beyond, u=u, load_factor=load_factor, tangent=tangent / length, slope=slope / length)

    def _end(self, point: Point) -> _End:
        return _End(self.control.measure(point), point.slope, point.negatives)

    def _at(self, size: float) -> Point:
        """Return the point at a length; the guess is the cubic through both ends with their tangents.

        Trials in between are closer, but near a bifurcation rounding destroys their tangents.
        """
        u, load_factor, _, _ = self._cubic(self.first, 0.0, self.last, self.size, size)
        return self.points.find(self.control.constraint(size), u, load_factor)

    def _cubic(
        self, first: Point, low: float, second: Point, high: float, size: float
    ) -> tuple[np.ndarray, float, np.ndarray, float]:
        """Return displacement, load factor and their derivatives at a length, by cubic interpolation of two points."""
        from scipy.interpolate import CubicHermiteSpline  # takes longer than most paths need

        # lengths are not measured along the path: that of an arc is a chord
        points = [
            (np.append(point.u, point.load_factor), np.append(point.tangent, point.slope)) for point in (first, second)
        ]
        rates = [rate / self.control.rate(point) for (_, rate), point in zip(points, (first, second), strict=True)]
        curve = CubicHermiteSpline([low, high], [value for value, _ in points], rates)
        at, along = curve(size), curve(size, 1)
        shape = first.u.shape
        return at[:-1].reshape(shape), float(at[-1]), along[:-1].reshape(shape), float(along[-1])

    def _locate(
        self,
        first: _End,
        second: _End,
        value: Callable[[Point], float],
        zero: float,
        tried: list[tuple[float, float]] | None = None,
    ) -> Point:
        """Return the point where a value becomes negative: regula falsi (Illinois), with bisection where that is slow.

        ``tried`` receives length and value of the trials.
        """
        a, b = first.size, second.size
        fa = fb = None
        size, side, point, previous = 0.5 * (a + b), 0, None, None
        for trial in range(_TRIALS):
            try:
                point = self._tried(size, a, b)
            except NotConverged:
                if point is None or b - a > _NARROW * self.size:
                    raise
                break  # the linear solver gets no closer
            f = value(point)
            size = self.control.measure(point)
            if tried is not None:
                tried.append((size, f))
            if abs(f) <= zero or (previous is not None and abs(size - previous) <= _LOCATED * self.size):
                break
            previous = size
            width = b - a
            if f > 0.0:  # before the critical point
                a, fa = size, f
                fb = 0.5 * fb if side == -1 and fb is not None else fb
                side = -1
            else:
                b, fb = size, f
                fa = 0.5 * fa if side == 1 and fa is not None else fa
                side = 1
            slow = trial % 4 == 3 and b - a > 0.5 * width
            size = 0.5 * (a + b)
            if fa is not None and fb is not None and not slow:
                size = (a * fb - b * fa) / (fb - fa)
        return point

    def _tried(self, size: float, a: float, b: float) -> Point:
        """Return the point at a length, or close to it where the stiffness is singular to rounding."""
        for share in (0.0, 1e-3, 0.05, -0.05):
            try:
                return self._at(min(max(size + share * (b - a), a), b) if share else size)
            except NotConverged as failure:
                last = failure
        raise last


_NOTICEABLE = 1e-2  # defect of a part over the sum of the magnitudes of its works, below which it is a path
_LEAST = 1e-4  # the same over the works of the whole increment
_ROUNDING = 1e-12  # of the energy of the bars
_KEPT = 0.4  # of the defect after so many divisions: a jump. Straight cables keep 1/16, smooth paths at most 1/23
_DIVISIONS = 3
_DEEP = 10  # divisions after which a defect that stays is a jump, and no steep part of a path
_DEEPEST = 20


class Place(NamedTuple):
    """A state within an increment: the part of the increment up to it, load factor and local positions [m]."""

    part: float
    load_factor: float
    x: np.ndarray


class Jump(NamedTuple):
    """Load factors before and after a jump, and the energy that it releases [J]."""

    first: float
    last: float
    energy: float

    def __str__(self) -> str:
        between = f"between load factors {self.first:.9g} and {self.last:.9g}"
        return f"{between} the truss jumps, which releases {self.energy:.4g} J"


class JumpSearch:
    """Looks for jumps between two states, evaluated with the internal variables of the last complete one.

    Jumps are told by their energy. Between two states of a path of equilibria, the trapezoidal rule gives the work on
    the bars, forces at both ends times the displacement. It differs from the change of their energy by an amount, here
    the defect, that falls with the third power of the increment where the path is smooth, and with the second at
    corners, as where bars begin to yield. Where the truss snaps through there is no path: the defect is the energy that
    would become motion, however small the increment. So an increment with a noticeable defect is divided by equilibria
    in between until each part has either a small defect or one that no longer falls.

    Parameters
    ----------
    model : Model
    between : returns the state at a part of the increment from a guess of local positions, None if it finds none;
        collective
    """

    def __init__(self, model: Model, between: Callable[[float, np.ndarray], Place | None]) -> None:
        self._model, self._between = model, between
        self._least = 0.0

    def look(self, first: Place, last: Place) -> list[Jump]:
        """Return the jumps between two states; the bars are left as they are at the last one. Collective."""
        defect, works = self._defect(first, last)
        self._least = _LEAST * works
        found = self._divide(first, last, defect, works, ())
        self._model.change_bars(last.load_factor)
        return found

    def _divide(self, first: Place, last: Place, defect: float, works: float, before: tuple[float, ...]) -> list[Jump]:
        """Return the jumps of a part; ``before``: defects of the parts that it is a part of."""
        depth = len(before)
        if abs(defect) <= max(_NOTICEABLE * works, self._least) or depth == _DEEPEST:
            return []
        stays = depth >= _DIVISIONS and defect > _KEPT * abs(before[-_DIVISIONS])
        middle = None if stays and depth >= _DEEP else self._middle(first, last)
        if middle is None:
            return [Jump(first.load_factor, last.load_factor, defect)] if stays else []
        parts = (first, middle), (middle, last)
        return [jump for part in parts for jump in self._divide(*part, *self._defect(*part), (*before, defect))]

    def _middle(self, first: Place, last: Place) -> Place | None:
        """Return the state halfway, if possible that which continues the first one. Collective."""
        guesses = first.x, 0.5 * (first.x + last.x), last.x
        found = (self._between(0.5 * (first.part + last.part), guess) for guess in guesses)
        return next((middle for middle in found if middle is not None), None)

    def _defect(self, first: Place, last: Place) -> tuple[float, float]:
        """Return work minus change of energy [J], and the sum of the magnitudes of the works. Collective."""
        model, owned = self._model, self._model.mesh.n_owned
        model.change_bars(last.load_factor)
        forces = np.zeros((2, *first.x.shape))
        energies = [model.bars.forces(place.x, f, commit=False).total for place, f in zip((first, last), forces)]
        works = (forces[:, :owned] * (last.x - first.x)[:owned]).sum(axis=2)
        sums = model.comm.allreduce(np.array([works.sum(), np.abs(works).sum(), *energies]))
        defect = 0.5 * float(sums[0]) - float(sums[3] - sums[2])
        if not abs(defect) > _ROUNDING * float(np.abs(sums[2:]).sum()):
            return 0.0, 0.0
        return defect, 0.5 * float(sums[1])
