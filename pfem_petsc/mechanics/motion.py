"""Prescribed motion over time and tables over time, many of them evaluated together in one compiled loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..case.base import has_rows
from .compiled import kernel

if TYPE_CHECKING:
    from ..case.tables import Support
    from ..contact.walls.base import WallKeys


_AGREE = 1e-7  # relative to the displacements: by how much motions along dependent directions may differ
_ROUNDING = 1e-14  # relative tolerance of times: a step reaches a row up to rounding


class Motion:
    """Piecewise cubic function of time; displacement and velocity are zero before the first piece.

    Parameters
    ----------
    times : (n,) start of each cubic [s]
    coefficients : (n, 4, 3) of 1, s, s^2, s^3, where s is the time since its start [m, m/s, m/s2, m/s3]
    jumps : whether the velocity jumps from one cubic to the next

    Attributes
    ----------
    times, coefficients : as given
    jumps : as given; accelerations are then means over the step that ends at the requested time
    """

    def __init__(self, times: np.ndarray, coefficients: np.ndarray, jumps: bool = False) -> None:
        self.times = times
        self.coefficients = coefficients
        self.jumps = jumps

    def at(self, time: float | np.ndarray, span: float = 0.0, ahead: bool = True) -> np.ndarray:
        """Return displacement [m], velocity [m/s] and acceleration [m/s2] at times of any shape [s], (..., 3, 3).

        Parameters
        ----------
        time : [s]
        span : size of the step [s]; a velocity jump within it, after t = 0, counts as acceleration over the step
        ahead : at the time of a row, whether to return the right limit; else the left limit
        """
        time = np.asarray(time, dtype=np.float64)
        slack = _ROUNDING * np.abs(time)
        row = np.searchsorted(self.times, time + slack if ahead else time - slack, "right" if ahead else "left")
        begun = row[..., None] > 0
        s = np.where(begun, (time - self.times[row - 1])[..., None], 0.0)
        c0, c1, c2, c3 = np.moveaxis(self.coefficients[np.maximum(row - 1, 0)], -2, 0)
        v, a = c1 + s * (2.0 * c2 + 3.0 * s * c3), 2.0 * c2 + 6.0 * s * c3
        moved = np.stack([c0 + s * (c1 + s * (c2 + s * c3)), np.where(begun, v, 0.0), np.where(begun, a, 0.0)], axis=-2)
        if self.jumps and span > 0.0:
            jump = (moved[..., 1, :] - self.at(np.maximum(time - span, 0.0))[..., 1, :]) / span
            moved[..., 2, :] = np.where((time > 0.0)[..., None], jump, 0.0)
        return moved


def vanishes(terms: list[tuple[Motion | None, np.ndarray]]) -> bool:
    """Whether a sum of displacements along vectors (3,) is zero at all times; None is rest.

    Motions with rows at different times are different motions: the sum of those with the same times must be zero.
    """
    sums: dict[bytes, tuple[np.ndarray, float]] = {}
    for motion, vector in terms:
        if motion is not None:
            along = motion.coefficients @ vector
            total, size = sums.get(motion.times.tobytes(), (0.0, 0.0))
            sums[motion.times.tobytes()] = total + along, size + np.abs(motion.coefficients) @ np.abs(vector)
    return all((np.abs(total).max(axis=0) <= _AGREE * size.max(axis=0)).all() for total, size in sums.values())


def motion_of(entry: Support | WallKeys) -> Motion | None:
    """Return the motion that a case prescribes for a support or a wall; None if there is none.

    Parameters
    ----------
    entry : with ``motion`` and ``velocity``, and optionally ``interpolation`` and ``acceleration``
    """
    if getattr(entry, "acceleration", None) is not None:
        rows = np.array(entry.acceleration, dtype=np.float64)
        return Motion(rows[:, 0], _integral(rows[:, 0], _integral(rows[:, 0], _over_time(rows))))
    if entry.motion is not None:
        rows = np.array(entry.motion, dtype=np.float64)
        return _through(rows[:, 0], rows[:, 1:], getattr(entry, "interpolation", "smooth"))
    if entry.velocity is not None and has_rows(entry.velocity):
        rows = np.array(entry.velocity, dtype=np.float64)
        jumps = bool(rows[[0, -1], 1:].any())  # velocities are zero outside
        return Motion(rows[:, 0], _integral(rows[:, 0], _over_time(rows)), jumps)
    if entry.velocity is not None and any(entry.velocity):
        return _uniform(entry.velocity)
    return None


def rotation_of(wall: WallKeys) -> Motion | None:
    """Return the rotation of a wall as a motion whose first component is the angle [rad]; None if it does not turn."""
    if wall.rotation is None:
        return None
    if wall.rotation.angles is None:
        return _uniform((wall.rotation.angular_velocity, 0.0, 0.0))
    rows = np.array(wall.rotation.angles, dtype=np.float64)
    values = np.column_stack([rows[:, 1], np.zeros((len(rows), 2))])
    return _through(rows[:, 0], values, wall.rotation.interpolation)


def _uniform(velocity: Sequence[float]) -> Motion:
    coefficients = np.zeros((1, 4, 3))
    coefficients[0, 1] = velocity
    return Motion(np.zeros(1), coefficients)


def _through(times: np.ndarray, values: np.ndarray, interpolation: str) -> Motion:
    smooth = interpolation == "smooth"
    return Motion(times, pieces(times, values, smooth), jumps=not smooth)


def pieces(times: np.ndarray, values: np.ndarray, smooth: bool) -> np.ndarray:
    """Return the coefficients (n, 4, k) of the cubics through values (n, k), by a spline if ``smooth``, else linear;
    see :class:`Motion`. The last one is constant."""
    coefficients = np.zeros((len(times), 4, values.shape[1]))
    coefficients[:, 0] = values
    width = np.diff(times)[:, None]
    rate = np.diff(values, axis=0) / width
    if not smooth:
        coefficients[:-1, 1] = rate
        return coefficients
    slopes = np.array([spline_slopes(times, column) for column in values.T]).reshape(values.T.shape).T
    coefficients[:-1, 1] = slopes[:-1]
    coefficients[:-1, 2] = (3.0 * rate - 2.0 * slopes[:-1] - slopes[1:]) / width
    coefficients[:-1, 3] = (slopes[:-1] + slopes[1:] - 2.0 * rate) / width**2
    return coefficients


def spline_slopes(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the slopes (n,) of the cubic spline through values (n,), zero at both ends and at intervals of rest."""
    from scipy.linalg import solve_banded  # takes longer than most cases need

    if len(times) < 3:
        return np.zeros(len(times))
    width = np.diff(times)
    rate = np.diff(values) / width
    still = np.zeros(len(times), dtype=bool)
    still[[0, -1]] = True
    rests = _rests(width, rate)
    still[:-1] |= rests
    still[1:] |= rests
    # continuity of the second derivative at row i:
    # m[i-1]/w[i-1] + 2 m[i] (1/w[i-1] + 1/w[i]) + m[i+1]/w[i] = 3 (rate[i-1]/w[i-1] + rate[i]/w[i])
    inverse, right = np.pad(1.0 / width, 1), np.pad(3.0 * rate / width, 1)
    bands = np.zeros((3, len(times)))
    bands[0, 1:] = np.where(still[:-1], 0.0, inverse[1:-1])
    bands[1] = 2.0 * (inverse[:-1] + inverse[1:])
    bands[2, :-1] = np.where(still[1:], 0.0, inverse[1:-1])
    return solve_banded((1, 1), bands, np.where(still, 0.0, right[:-1] + right[1:]))


def _rests(width: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return (n - 1,) bool: intervals of rest, with equal values at both ends, except crests of sampled waves."""
    rests = rate == 0.0
    for k in np.flatnonzero(rests[2:-2]) + 2:
        before, after = rate[k - 1], rate[k + 1]
        turns = before * after < 0.0
        fades = abs(before) <= 0.8 * abs(rate[k - 2]) and abs(after) <= 0.8 * abs(rate[k + 2])
        even = np.ptp(width[k - 1 : k + 2]) <= 0.01 * width[k]
        onward = before * rate[k - 2] > 0.0 and after * rate[k + 2] > 0.0
        rests[k] = not (turns and fades and even and onward)
    return rests


def _over_time(rows: np.ndarray) -> np.ndarray:
    """Return the coefficients of vectors by rows [t, x, y, z], linear in between and zero after the last one."""
    coefficients = pieces(rows[:, 0], rows[:, 1:], False)
    coefficients[-1] = 0.0
    return coefficients


def _integral(times: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the coefficients of the integral of cubics from the first time on, which have no term of s^3."""
    whole, width = np.zeros_like(rates), np.diff(times)[:, None]
    whole[:, 1:] = rates[:, :3] / np.arange(1.0, 4.0)[:, None]
    _, c1, c2, c3 = np.moveaxis(whole[:-1], 1, 0)
    whole[1:, 0] = np.cumsum(width * (c1 + width * (c2 + width * c3)), axis=0)
    return whole


@kernel
def _evaluate(time, groups, out):
    """Write the values of all groups at a time to ``out``, group by group; ``groups``: see :class:`TimeTables`."""
    first, count, start, width, times, coefficients = groups
    at = 0
    for g in range(len(first)):
        low, high = first[g], first[g] + count[g]
        while high - low > 1:
            middle = (low + high) // 2
            if times[middle] <= time:
                low = middle
            else:
                high = middle
        passed = max(time - times[low], 0.0) if low < first[g] + count[g] - 1 else 0.0
        w = width[g]
        c0 = start[g] + 4 * w * (low - first[g])
        for c in range(c0, c0 + w):
            cubic = coefficients[c + 2 * w] + passed * coefficients[c + 3 * w]
            out[at] = coefficients[c] + passed * (coefficients[c + w] + passed * cubic)
            at += 1


class Group(NamedTuple):
    """Columns with the same times.

    Attributes
    ----------
    times : (n,) increasing [s]
    values : (n, k)
    smooth : whether they are interpolated by a spline
    """

    times: np.ndarray
    values: np.ndarray
    smooth: bool = False


class TimeTables:
    """All columns of some groups.

    Attributes
    ----------
    width : number of columns
    """

    def __init__(self, groups: Sequence[Group]) -> None:
        self.width = sum(group.values.shape[1] for group in groups)
        counts = np.array([len(group.times) for group in groups], dtype=np.int64)
        widths = np.array([group.values.shape[1] for group in groups], dtype=np.int64)
        sizes = 4 * counts * widths
        times = np.concatenate([np.zeros(0), *(group.times for group in groups)])
        coefficients = np.concatenate([np.zeros(0), *(pieces(*group).ravel() for group in groups)])
        # of each group: first row, rows, first coefficient, columns; of all rows: times and coefficients
        self._groups = np.cumsum(counts) - counts, counts, np.cumsum(sizes) - sizes, widths, times, coefficients

    def at(self, time: float, out: np.ndarray) -> None:
        """Write the values (width,) at a time [s], group by group."""
        _evaluate(time, self._groups, out)


def grouped(tables: Sequence[tuple[np.ndarray, bool]]) -> tuple[list[Group], np.ndarray]:
    """Return groups of tables with two columns (n, 2), smooth or not, and the column of each table in the groups."""
    members: dict[tuple[bytes, bool], list[int]] = {}
    for k, (rows, smooth) in enumerate(tables):
        members.setdefault((rows[:, 0].tobytes(), smooth), []).append(k)
    columns = np.empty(len(tables), dtype=np.int64)
    groups, n = [], 0
    for (_, smooth), which in members.items():
        groups.append(
            Group(tables[which[0]][0][:, 0].copy(), np.column_stack([tables[k][0][:, 1] for k in which]), smooth)
        )
        columns[which] = np.arange(n, n + len(which))
        n += len(which)
    return groups, columns


class Table:
    """A function of time by rows (t, value, ...).

    Attributes
    ----------
    values : (n, k) of its rows
    """

    def __init__(self, rows: Sequence[Sequence[float]], smooth: bool = False) -> None:
        rows = np.array(rows, dtype=np.float64)
        self.values = rows[:, 1:].copy()
        self._tables = TimeTables([Group(rows[:, 0].copy(), self.values, smooth)])

    def __call__(self, time: float) -> np.ndarray:
        """Return the values at a time, one per column."""
        out = np.empty(self._tables.width)
        self._tables.at(time, out)
        return out
