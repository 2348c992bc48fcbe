"""Curves of a history as numbers: columns and expressions, closed forms, filters without a shift in time, spectra."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..errors import InputError
from ..output.table import select
from ..output.units import TIME, engineering, prefix_for
from .chart import REFERENCE, Curve

History = Mapping[str, np.ndarray]

CLOSED_FORM = " closed form"
"""What follows the name of a curve in the name of its closed form, in tables."""


def read(history: History, name: str) -> np.ndarray:
    """Return a column as float64."""
    return np.asarray(history[name], dtype=float)


def words(name: str) -> str:
    """Return the name of a column as words."""
    return name.replace("_", " ")


def column(history: History, name: str) -> dict[str, np.ndarray]:
    """Return the curves (n,) of a name or an expression, which :func:`~pfem_petsc.output.table.select` takes.

    Columns of nodes are the mean over the nodes, of reactions the sum. A vector without component gives those that are
    not zero up to rounding.

    Raises
    ------
    InputError
        If the history has no such column.
    """
    found = select(history, name).reduced()
    values = found.values.astype(float)
    if not found.single and values.size and not np.isfinite(values).any():
        raise InputError(f"plot: {name}: is a number in no row, as it divides by zero")
    if not found.vector:
        return {name: values}
    name = name if found.single else f"({name})"
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    kept = [k for k in range(3) if np.nanmax(np.abs(values[:, k]), initial=0.0) > 1e-9 * largest]
    return {f"{name}.{'xyz'[k]}": values[:, k] for k in kept or range(3)}


def smoothed(result: Any, chosen: Filter, values: np.ndarray, touch: bool = False) -> np.ndarray:
    """Return values (rows,) of a history after a filter of each stretch of motion; those of static stages are kept.

    ``touch``: whether the quantity is zero before the run, as contact forces are.
    """
    time, made = read(result.history, "time"), np.nan_to_num(np.array(values, dtype=float))
    for rows in result.stretches:
        zero_before = touch and (rows.start == 0 or made[rows.start - 1] == 0.0)
        made[rows] = chosen.apply(time[rows], made[rows], zero_before)
    return np.where(np.isnan(values), np.nan, made)


def exact_curves(exact: ClosedForm | None, names: Sequence[str], place: np.ndarray | None = None) -> list[Curve]:
    """Return the closed forms of curves of :func:`column`, where they are known."""
    curves: list[Curve] = []
    for name in names if exact is not None else ():
        try:
            values = column(exact.columns, name)[name]
        except InputError:  # of columns, or in an expression of some, that have none
            continue
        curves.append(Curve("" if curves else exact.name, values, REFERENCE, name + CLOSED_FORM, place))
    return curves


def usual_curves(results: Sequence[Any]) -> list[str]:
    """Return what is compared of results: energies, forces of walls, displacements of probes, if all have them."""
    common = [name for name in results[0].history if all(name in result.history for result in results)]
    energies = [name for name in (*STORED, *LOST, *SUPPLIED) if name in common]
    sizes = {name: max(float(np.abs(read(r.history, name)).max()) for r in results) for name in energies}
    largest = max(sizes.values(), default=0.0)
    chosen = [name for name in energies if sizes[name] > 1e-3 * largest]
    forces = [name for name in common if name.startswith("wall/") and name.endswith("/force")]
    chosen += [name for name in forces if any(np.any(result.history[name]) for result in results)]
    for name in common:
        if name.startswith("probe/") and name.endswith("/position"):
            moved = name.removesuffix("position") + "displacement"
            chosen += [moved] if any(np.any([*column(r.history, moved).values()]) for r in results) else []
    # over load factors, the load factor is a straight line; it is a curve over the points of a path
    if "load_factor" in common and results[0].axis.symbol != TIME.symbol:
        every = [(read(r.history, "load_factor"), read(r.history, "time")) for r in results]
        chosen += ["load_factor"] if not all(np.array_equal(*pair) for pair in every) else []
    if not chosen:
        raise InputError("plot: the results have no columns in common that change; name some as curves")
    return chosen


_ABSENT = ("load", "support", "temperature", "contact_pair", "constraint", "remove", "point_mass", "spring", "dashpot")


@dataclass
class ClosedForm:
    """Exact values of columns of the history.

    Attributes
    ----------
    name : of the solution
    columns : values at the times of the history, of the shape of the columns; NaN where they are not known
    path : displacement (m,) [m] and load factor (m,) of an equilibrium path
    """

    name: str
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    path: tuple[np.ndarray, np.ndarray] | None = None


def closed_form(result: Any) -> ClosedForm | None:
    """Return the closed form of a result's case, None if none is known.

    Parameters
    ----------
    result : an open result
    """
    if not hasattr(result.case, "mesh") or result.case.stage or len(result.history["time"]) == 0:
        return None
    return rod_on_wall(result) or von_mises(result)


def rod_on_wall(result: Any) -> ClosedForm | None:
    """An elastic rod that flies along its axis against a rigid wall, or the plateau of one that yields.

    From the contact at t_c = gap/v for 2 L/c the wall exerts F = rho c A v, c = sqrt(E/rho); a wave brings the rod to
    rest and, reflected at the free end, to the velocity -v. With linear hardening and v > v_Y = s_Y/(rho c), the force
    is A (s_Y + rho c_p (v - v_Y)) in the same time, c_p = sqrt(E_t/rho), E_t = E H/(E + H); later it is not known.
    """
    case, history = result.case, result.history
    if case.mesh.generator != "rod" or case.time is None or len(case.wall) != 1 or len(case.initial) != 1:
        return None
    wall, start, section = case.wall[0], case.initial[0], next(iter(case.section.values()))
    if (
        _has_more(case)
        or not _keys(wall) <= {"name", "type", "point", "normal", "node_set"}
        or wall.type != "plane"
        or len(case.section) != 1
        or section.uniform_area is None
        or section.prestressed
        or start.node_set is not None
        or any(start.angular_velocity)
        or np.linalg.norm(start.velocity[1:]) > 0.0
        or np.linalg.norm(wall.normal[1:]) > 0.0
        or start.velocity[0] * wall.normal[0] >= 0.0
    ):
        return None
    material = case.material[section.material]
    plastic = {"yield_stress", "isotropic_hardening", "kinematic_hardening"}
    if not _keys(material) <= {"law", "young_modulus", "density"} | plastic:
        return None
    points = np.asarray(result.positions(0), dtype=float)
    axis, speed = math.copysign(1.0, start.velocity[0]), abs(start.velocity[0])
    along = axis * points[:, 0]
    if not _holds_end(case, wall, points, int(np.argmax(along))):
        return None
    modulus, density = material.young_modulus, material.density
    c, length = math.sqrt(modulus / density), float(np.ptp(along))
    time, impact = read(history, "time"), (axis * wall.point[0] - float(along.max())) / speed
    since, travel = time - impact, length / c
    touching = (since >= 0.0) & (since <= 2.0 * travel)
    force, normal = f"wall/{wall.name}/force", np.asarray(wall.normal, dtype=float) / np.linalg.norm(wall.normal)
    limit = getattr(material, "yield_stress", None)
    if limit is not None and speed > limit / (density * c):
        hardening = material.isotropic_hardening + material.kinematic_hardening
        slow = math.sqrt(modulus * hardening / (modulus + hardening) / density)
        plateau = section.uniform_area * (limit + density * slow * (speed - limit / (density * c)))
        known = np.where(touching, plateau, np.where(since < 0.0, 0.0, np.nan))
        return ClosedForm("plastic wave of linear hardening", {force: known[:, None] * normal})
    mass, way = density * section.uniform_area * length, np.array([axis, 0.0, 0.0])
    mean = speed * np.clip(1.0 - np.maximum(since, 0.0) / travel, -1.0, 1.0)
    inside = np.clip(since, 0.0, 2.0 * travel)
    centre = speed * (
        np.minimum(time, impact) + inside - inside**2 / (2.0 * travel) - np.maximum(since - 2 * travel, 0)
    )
    kinetic = 0.5 * mass * speed**2 * np.abs(mean) / speed
    columns = {
        force: (density * c * section.uniform_area * speed * touching)[:, None] * normal,
        "kinetic_energy": kinetic,
        "elastic_energy": 0.5 * mass * speed**2 - kinetic,
        "momentum": mass * mean[:, None] * way,
        "centre_of_mass": np.asarray(history["centre_of_mass"])[0] + centre[:, None] * way,
    }
    for name in history:
        if name.startswith("probe/") and name.endswith("/position"):
            place = np.asarray(history[name])[0]
            delay = (along.max() - axis * place[:, 0]) / c
            first, last = impact + delay, impact + 2.0 * travel - delay
            moved = np.minimum(time[:, None], first) - np.maximum(time[:, None] - last, 0.0)
            columns[name] = place + speed * moved[..., None] * way
            sign = np.where(time[:, None] < first, 1.0, np.where(time[:, None] < last, 0.0, -1.0))
            columns[name.replace("/position", "/velocity")] = speed * sign[..., None] * way
    return ClosedForm("closed form of the wave in the rod", columns)


def von_mises(result: Any) -> ClosedForm | None:
    """Two bars under a load at the apex: P(z) = 2 E A z (1/sqrt(b^2 + z^2) - 1/L_0) at the height z, half span b."""
    case = result.case
    if case.mesh.generator != "von_mises" or case.static is None or len(case.load) != 1 or len(case.section) != 1:
        return None
    load, section = case.load[0], next(iter(case.section.values()))
    if (
        _has_more(case, ("load", "support"))
        or case.wall
        or not _keys(load) <= {"node_set", "force"}
        or any(load.force[:2])
        or section.uniform_area is None
        or section.prestressed
        or not _keys(case.material[section.material]) <= {"law", "young_modulus", "density"}
    ):
        return None
    points = np.asarray(result.positions(0), dtype=float)
    if len(points) != 3:
        return None
    apex = int(np.argmax(np.abs(points[:, 2])))
    feet = np.delete(points, apex, axis=0)
    base, rise = 0.5 * float(np.ptp(feet[:, 0])), float(points[apex, 2])
    heights = [np.asarray(result.positions(i))[apex, 2] for i in range(len(result.times))]
    height = np.linspace(rise, min([*heights, rise]), 400)
    stiff = 2.0 * case.material[section.material].young_modulus * section.uniform_area
    load_z = -stiff * height * (1.0 / np.hypot(base, height) - 1.0 / math.hypot(base, rise))
    return ClosedForm("closed form of two bars", path=(rise - height, load_z / load.force[2]))


def _keys(table: Any) -> set[str]:
    """Return the keys of a table that differ from their defaults."""
    return set(table.model_dump(exclude_defaults=True, exclude_none=True))


def _has_more(case: Any, allowed: tuple[str, ...] = ()) -> bool:
    """Whether a case has forces or constraints beside the allowed tables."""
    return (
        case.gravity is not None
        or case.wind is not None
        or any(len(getattr(case, name)) for name in _ABSENT if name not in allowed)
    )


def _holds_end(case: Any, wall: Any, points: np.ndarray, end: int) -> bool:
    """Whether a wall stops the end of a rod."""
    if wall.node_set is None:
        return True
    chosen = case.node_set[wall.node_set]
    if chosen.nearest is not None:
        return int(np.argmin(np.linalg.norm(points - np.array(chosen.nearest), axis=1))) == end
    return bool(chosen.all) or end in (chosen.indices or ())


AS_COMPUTED = "as computed"
"""The name of no filter."""

CFC_CORNER = 2.0775
"""Corner frequency of each pass over the channel frequency class (SAE J211-1, appendix C)."""

_ROWS = 10.0
"""Rows per second and unit of the channel frequency class, at least (SAE J211-1)."""

WINDOWS = ("rectangular", "hann", "hamming", "blackman", "flattop")


class Filter(NamedTuple):
    """A filter and its description.

    Attributes
    ----------
    name : with the cut-off, for pictures
    apply : from times (n,) [s], values (n,), and whether the quantity is zero before the first row, as contact forces
        are, to filtered values (n,)
    """

    name: str
    apply: Callable[..., np.ndarray]


def make_filter(text: str) -> Filter:
    """Return a filter: ``cfc:CLASS``, ``butterworth:FREQUENCY[:ORDER]``, ``mean:SECONDS`` or ``none``.

    Raises
    ------
    InputError
        If the text is none of them.
    """
    kind, *words = text.lower().split(":")
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [math.nan]
    if kind == "butterworth" and len(numbers) == 1:
        numbers.append(2.0)
    good = all(math.isfinite(number) and number > 0.0 for number in numbers)
    match kind, numbers:
        case "none", []:
            return Filter(AS_COMPUTED, lambda time, values, zero=False: np.array(values, dtype=float))
        case "mean", [width] if good:
            corner = _hertz(0.4429 / width)
            name = f"mean of the {engineering(width, 's', 3)} before (−3 dB at {corner})"
            return Filter(name, lambda time, values, zero=False: _chosen_mean(time, values, width, zero))
        case "cfc", [size] if good:
            corner = _hertz(CFC_CORNER * size * (math.sqrt(2.0) - 1.0) ** 0.25)
            name = f"CFC {size:g} of SAE J211-1 (two passes, −3 dB at {corner})"
            return Filter(name, lambda time, values, zero=False: cfc(time, values, size, zero))
        case "butterworth", [cutoff, order] if good and order == int(order) <= 10:
            name = f"Butterworth of order {order:g} (two passes, −3 dB at {_hertz(cutoff, 6)})"
            return Filter(name, lambda time, values, zero=False: butterworth(time, values, cutoff, int(order), zero))
    raise InputError(
        f"filter = {text!r} is not known; give cfc:CLASS, butterworth:FREQUENCY[:ORDER] [Hz, up to order 10], "
        "mean:SECONDS or none, like cfc:180"
    )


def _hertz(frequency: float, digits: int = 3) -> str:
    """Return the text of a frequency: ``88571.4`` -> ``"88.6 kHz"``."""
    rounded = float(f"{frequency:.{digits}g}")
    factor, unit = prefix_for(rounded, "Hz")
    return f"{rounded * factor:.{digits}g} {unit}"


def _chosen_mean(time: np.ndarray, values: np.ndarray, width: float, zero_before: bool) -> np.ndarray:
    """Return :func:`window_mean`; a window that the history cannot carry is rejected."""
    steps = np.diff(time)
    if len(time) < 2 or width > time[-1] - time[0] or width < steps.max() * (1.0 - 1e-6):
        least, most = (float(steps.max()), float(time[-1] - time[0])) if len(time) > 1 else (0.0, 0.0)
        raise InputError(
            f"filter: a mean of {engineering(width, 's', 3)} needs a window from the longest interval of rows, "
            f"{engineering(least, 's', 3)}, to the length of the history, {engineering(most, 's', 3)}"
        )
    return window_mean(time, values, width, zero_before)


def window_mean(time: np.ndarray, values: np.ndarray, width: float, zero_before: bool = False) -> np.ndarray:
    """Return the mean of a piecewise linear curve over a window [s] before each point.

    It depends on past values only. The integral is exact for any spacing of the points. At the start, the window is
    truncated, unless the curve is zero before it: a spike in the first row would be its own mean.
    """
    if len(time) < 2 or width <= 0.0:
        return values.copy()
    from scipy.interpolate import BSpline

    knots = np.concatenate([time[:1], time, time[-1:]])  # of a piecewise linear curve, which may jump
    integral = BSpline(knots, values, 1).antiderivative()
    low = np.maximum(time - width, time[0])
    span = np.full(len(time), width) if zero_before else time - low
    change = integral(time) - integral(low)
    return np.divide(change, span, out=np.array(values, dtype=float), where=span > 0.0)


def cfc(time: np.ndarray, values: np.ndarray, size: float, zero_before: bool = False) -> np.ndarray:
    """Return a history filtered by a channel frequency class of SAE J211-1: 60, 180, 600, 1000.

    Two passes of the two-pole Butterworth filter with the corner frequency f_d = 2.0775 CFC, forward and backward, so
    that nothing is shifted in time. Together they have -6 dB at f_d and -3 dB at 1.67 times the class. The history is
    continued by odd reflection at both ends, or by zero before the start.

    Source: SAE J211-1 (March 1995), appendix C, equations C1 and following, as also in "Crash Analysis: Description of
    Criteria", version 2.1.1, of the Workgroup Data Processing Vehicle Safety. ISO 6487:2002 has the same with
    f_d = 1.25 5/3 CFC, which is 0.3 % higher. Both passes have -3 dB at 100, 300, 1000 and 1650 Hz for the classes
    60, 180, 600 and 1000, which the standards name, to 0.1 dB.

    Parameters
    ----------
    time : (n,) [s]; uneven steps are interpolated linearly to even ones
    values : (n,)
    size : the class; the standard asks for 10 rows or more per second and unit of it
    zero_before : whether the quantity is zero before the first row, as contact forces are

    Raises
    ------
    InputError
        If the history is too coarse or too short for the class, or has less than three rows.
    """
    return _two_passes(time, values, zero_before, f"CFC {size:g}", 2, _ROWS * size, lambda interval: CFC_CORNER * size)


def butterworth(
    time: np.ndarray, values: np.ndarray, cutoff: float, order: int = 2, zero_before: bool = False
) -> np.ndarray:
    """Return a history after a Butterworth low-pass filter forward and backward, with -3 dB in all at the cut-off [Hz].

    The gain of both passes is 1/(1 + r^(2 n)), r = tan(pi f h)/tan(pi f_d h), of the bilinear transform at a sampling
    interval h, with f_d so that it is 2^-1/2 at the cut-off. See :func:`cfc` for parameters and errors.
    """

    def corner(interval: float) -> float:
        # (f/f_d)^(2 n) at which two passes of order n have -3 dB: (1 + x)^-1 = 2^-1/2
        ratio = (math.sqrt(2.0) - 1.0) ** (-0.5 / order)
        return math.atan(ratio * math.tan(math.pi * cutoff * interval)) / (math.pi * interval)

    # more than two rows per period: tan(pi f_d h) is infinite there
    what = f"a cut-off of {engineering(cutoff, 'Hz', 3)}"
    return _two_passes(time, values, zero_before, what, order, 2.01 * cutoff, corner)


def _two_passes(
    time: np.ndarray,
    values: np.ndarray,
    zero_before: bool,
    what: str,
    order: int,
    rate: float,
    corner: Callable[[float], float],
) -> np.ndarray:
    """Return the values (n,) at times (n,) [s] after a Butterworth filter forward and backward.

    ``what``: the name in messages; ``rate``: the fewest rows per second; ``corner`` [Hz] at an interval [s]
    """
    from scipy.signal import butter, sosfiltfilt

    time, values = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    steps = np.diff(time)[np.diff(time) > 0.0]
    if len(steps) < 2:
        raise InputError(
            f"filter: {what} needs a history of three rows or more, and this one has {len(steps) + 1}: "
            "set [output] history_every, or give filter none"
        )
    longest = float(steps.max())
    if longest * rate > 1.0 + 1e-6:
        raise InputError(
            f"filter: {what} needs {rate:.5g} rows of the history per second, and this one has "
            f"{1 / longest:.4g} where they are farthest apart: set [output] history_every, or give a lower one"
        )
    grid, even = _evenly(time, values)
    interval = (grid[-1] - grid[0]) / (len(grid) - 1)
    cutoff = corner(interval)
    if cutoff * (time[-1] - time[0]) < 1.0:
        raise InputError(
            f"filter: {what} is slower than the history of {engineering(time[-1] - time[0], 's')}: it has "
            f"less than a period of {engineering(1 / cutoff, 's', 3)}; give a higher one"
        )
    # what the slowest pole forgets to rounding error
    pad = math.ceil(36.0 / (2 * math.pi * cutoff * interval * math.sin(math.pi / (2 * order))))
    longer = np.pad(even, pad, mode="reflect", reflect_type="odd")
    if zero_before:
        longer[:pad] = 0.0
    sections = butter(order, cutoff, fs=1.0 / interval, output="sos")
    smooth = sosfiltfilt(sections, longer, padtype=None)[pad : pad + len(even)]
    return smooth if grid is time else np.interp(time, grid, smooth)


def _evenly(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values at even steps, of the median length if they are uneven."""
    keep = np.diff(time, prepend=-np.inf) > 0.0  # stages begin with a row at the end of the last one
    if not keep.all():
        time, values = time[keep], values[keep]
    steps = np.diff(time)
    if len(steps) == 0 or np.ptp(steps) <= 1e-6 * steps.max():
        return time, values
    grid = np.linspace(time[0], time[-1], max(3, round((time[-1] - time[0]) / float(np.median(steps))) + 1))
    return grid, np.interp(grid, time, values)


def amplitude_spectrum(time: np.ndarray, values: np.ndarray, window: str = "hann") -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (m,) [Hz] and amplitudes (m,), in the unit of the values, of a history.

    The mean is removed, the history is multiplied by a window w and transformed:
    A(f) = 2 |sum w_k x_k e^(-2 pi i f k h)|/sum w_k. A sine of amplitude A gives a peak of height A; between two
    frequencies it is lower, by up to 1.42 dB (15 %) with "hann", 0.01 dB (0.1 %) with "flattop", 3.9 dB (36 %) with
    "rectangular".

    Parameters
    ----------
    time : (n,) [s]; uneven steps are interpolated linearly to even ones
    values : (n,)
    window : one of :data:`WINDOWS`

    Raises
    ------
    InputError
        For an unknown window, or less than 8 rows.
    """
    if window not in WINDOWS:
        raise InputError(f"spectrum: window = {window!r} is not known; it is one of {', '.join(WINDOWS)}")
    if len(time) < 8:
        raise InputError(f"spectrum: the history has {len(time)} rows; 8 or more are needed")
    from scipy.signal import get_window

    grid, even = _evenly(np.asarray(time, dtype=float), np.asarray(values, dtype=float))
    n = len(even)
    weight = get_window("boxcar" if window == "rectangular" else window, n)
    even = even - np.sum(weight * even) / np.sum(weight)
    transform = np.abs(np.fft.rfft(weight * even)) / np.sum(weight)
    transform[1 : (n + 1) // 2] *= 2.0
    return np.fft.rfftfreq(n, (grid[-1] - grid[0]) / (n - 1)), transform
