"""Low-pass filters of histories without a shift in time, and amplitude spectra."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..output.units import engineering, prefix_for

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
    if len(time) < 2 or width <= 0:
        return values.copy()
    steps = np.diff(time)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * steps * (values[1:] + values[:-1]))])
    low = np.maximum(time - width, time[0])

    def primitive(at: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(steps) - 1)
        part = at - time[k]
        slope = (values[k + 1] - values[k]) / np.where(steps[k] > 0, steps[k], 1.0)
        return integral[k] + part * (values[k] + 0.5 * slope * part)

    span = np.full(len(time), width) if zero_before else time - low
    return np.where(span > 0.0, (integral - primitive(low)) / np.where(span > 0.0, span, 1.0), values)


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
    passes = _Passes(f"CFC {size:g}", 2, _ROWS * size, lambda interval: CFC_CORNER * size)
    return _filtered(passes, time, values, zero_before)


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
    passes = _Passes(f"a cut-off of {engineering(cutoff, 'Hz', 3)}", order, 2.01 * cutoff, corner)
    return _filtered(passes, time, values, zero_before)


class _Passes(NamedTuple):
    """The name in messages, the order, the fewest rows per second, and the corner [Hz] at an interval [s]."""

    what: str
    order: int
    rate: float
    corner: Callable[[float], float]


def _filtered(passes: _Passes, time: np.ndarray, values: np.ndarray, zero_before: bool) -> np.ndarray:
    """Return the values (n,) at times (n,) [s] after both passes."""
    from scipy.signal import butter, sosfiltfilt

    time, values = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    what, order, rate, corner = passes
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
    steps = np.diff(time)
    if np.any(steps <= 0.0):
        keep = np.concatenate([[True], steps > 0.0])  # stages begin with a row at the end of the last one
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
