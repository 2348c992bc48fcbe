"""Amplitude spectra of columns of the history."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..output.units import TIME
from .chart import COLOURS, Chart, literal
from .curves import column, labels_of, read, unit_of_curve, words
from .filters import amplitude_spectrum

__all__ = ["draw_spectra"]

_PEAKS = 5  # of a spectrum, at most, that are told


def draw_spectra(
    results: Sequence[Any], names: Sequence[str], window: str = "hann", highest: float | None = None
) -> Chart:
    """Draw a panel with the amplitude spectrum of each named column; natural frequencies are dotted lines.

    Parameters
    ----------
    results : open results of runs over time
    names : columns, or components of them
    window : see :func:`~pfem_petsc.post.filters.amplitude_spectrum`
    highest : frequency at which the picture ends [Hz]; None: half the sampling rate
    """
    first = results[0]
    if not names:
        raise InputError("plot: no columns named for spectra; columns: " + ", ".join(first.history))
    if highest is not None and not highest > 0.0:
        raise InputError(f"plot: highest frequency = {highest:g} Hz must be positive")
    for result in results:
        if result.axis is not TIME:
            raise InputError(f"{result.path}: spectra need a run over time, not a static analysis")
    found = []
    for name in names:
        curves = {}
        for label, result in zip(labels_of(results), results, strict=True):
            time = read(result.history, "time")
            for part, values in column(result.history, name).items():
                key = f"{part}: {label}" if len(results) > 1 else part
                curves[key] = amplitude_spectrum(time, values, window)
        found.append(curves)
    end = highest or max(frequency[-1] for curves in found for frequency, _ in curves.values())
    title = first.case.title or first.case.name
    chart = Chart(np.array([0.0, end]), title, len(names), heights=[1.1] * len(names))
    chart.factor, shown = (1e-3, "kHz") if end >= 2e3 else (1.0, "Hz")
    chart.axes[-1, 0].set_xlabel(f"frequency [{shown}]")
    for axes, name, curves in zip(chart.axes[:, 0], names, found, strict=True):
        unit = unit_of_curve(name)
        top = 0.0
        for k, (key, (frequency, amplitude)) in enumerate(curves.items()):
            inside = (frequency > 0.0) & (frequency <= end)
            axes.semilogy(
                frequency[inside] * chart.factor, amplitude[inside], label=literal(key), color=COLOURS[k % len(COLOURS)]
            )
            chart.record(key, amplitude, unit, ("frequency [Hz]", frequency))
            top = max(top, float(amplitude[inside].max(initial=0.0)))
            if len(curves) == 1:
                _tell_peaks(axes, frequency[inside], amplitude[inside], chart.factor, shown)
        if top > 0.0:
            axes.set_ylim(1e-6 * top, 4.0 * top)
        axes.set_xlim(0.0, end * chart.factor)
        for value in _natural(first):
            if 0.0 < value <= end:
                axes.axvline(value * chart.factor, color="#6b7280", linewidth=0.8, linestyle=":", zorder=0)
        label = words(name.rsplit("/", 1)[-1])
        axes.set_ylabel(f"amplitude of\n{label} [{unit}]" if unit else f"amplitude of\n{label}")
        axes.set_title(literal(f"{name}, window: {window}"))
        if len(curves) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    return chart


def _natural(result: Any) -> np.ndarray:
    modes = result.modes if getattr(result, "n_modes", 0) else None
    return modes.frequency if modes is not None and modes.kind == "vibration" else np.zeros(0)


def _tell_peaks(axes: Any, frequency: np.ndarray, amplitude: np.ndarray, factor: float, unit: str) -> None:
    """Write the frequencies of the highest peaks beside them; each is higher than all within 2 % of the picture."""
    if len(amplitude) < 3:
        return
    peak = np.flatnonzero((amplitude[1:-1] > amplitude[:-2]) & (amplitude[1:-1] >= amplitude[2:])) + 1
    told: list[int] = []
    apart = 0.06 * (frequency[-1] - frequency[0])
    for k in peak[np.argsort(-amplitude[peak])]:
        if len(told) == _PEAKS or amplitude[k] < 3e-3 * amplitude.max():
            break
        if all(abs(frequency[k] - frequency[other]) > apart for other in told):
            told.append(int(k))
    for k in told:
        left, middle, right = np.log(np.maximum(amplitude[k - 1 : k + 2], 1e-300))
        bend = left - 2.0 * middle + right
        place = frequency[k] + (0.5 * (left - right) / bend if bend < 0.0 else 0.0) * (frequency[1] - frequency[0])
        text = f"{place * factor:.4g} {unit}"
        axes.annotate(
            text, (frequency[k] * factor, amplitude[k]), xytext=(3, 4), textcoords="offset points", fontsize=8
        )
