"""Curves selected by name: over time or another column, of one result or several, and their spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..errors import InputError
from ..output.units import TIME, prefix_for, unit_of
from ..registry import nearest
from .chart import COLOURS, REFERENCE, Chart, largest, legend_beside, literal, thinned
from .closed_forms import closed_form
from .filters import AS_COMPUTED, Filter, amplitude_spectrum

History = Mapping[str, np.ndarray]

_DISPLACEMENT = "/displacement"  # of probes, whose columns have positions

_PEAKS = 5  # of a spectrum, at most, that are told

DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)))


def read(history: History, name: str) -> np.ndarray:
    """Return a column as float64."""
    return np.asarray(history[name], dtype=float)


def words(name: str) -> str:
    """Return the name of a column as words."""
    return name.replace("_", " ")


def make_chart(
    history: History, title: str, rows: int, columns: int = 1, heights: Sequence[float] | None = None
) -> Chart:
    """Return a chart over the times of a history."""
    axis = getattr(history, "axis", TIME)
    return Chart(read(history, "time"), title, rows, columns, heights, axis)


def column(history: History, name: str) -> dict[str, np.ndarray]:
    """Return the curves (n,) of a name: a column, or ``.x``, ``.y``, ``.z``, ``.norm`` of one.

    Columns of nodes are the mean over the nodes, of reactions the sum. A vector without component gives those that are
    not zero up to rounding. ``probe/NAME/displacement`` is the position relative to that of the first row.

    Raises
    ------
    InputError
        If the history has no such column.
    """
    whole, _, part = name.rpartition(".")
    if name in list(history) or part not in ("x", "y", "z", "norm"):
        whole, part = name, ""
    if whole not in list(history) and (position := _position(whole)) in list(history):
        values = read(history, position)
        history = {whole: values - values[:1]}
    if whole not in list(history) or whole.startswith("event/"):
        known = [each for each in history if not each.startswith("event/")]
        raise InputError(f"the history holds no column '{whole}'{nearest(whole, known)}")
    values = read(history, whole)
    if values.ndim == 3:
        values = values.sum(axis=1) if whole.endswith("/reaction") else values.mean(axis=1)
    if values.ndim == 1:
        if part:
            raise InputError(f"{name}: column '{whole}' is a number and has no components")
        return {whole: values}
    if part == "norm":
        return {name: np.linalg.norm(values, axis=1)}
    if part:
        return {name: values[:, "xyz".index(part)]}
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    kept = [k for k in range(3) if np.nanmax(np.abs(values[:, k]), initial=0.0) > 1e-9 * largest]
    return {f"{whole}.{'xyz'[k]}": values[:, k] for k in kept or range(3)}


def _position(name: str) -> str:
    """Return the name of the positions that displacements of a probe are made of; others as they are."""
    is_displacement = name.startswith("probe/") and name.endswith(_DISPLACEMENT)
    return name.removesuffix(_DISPLACEMENT) + "/position" if is_displacement else name


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
            moved = name.removesuffix("/position") + _DISPLACEMENT
            chosen += [moved] if any(largest_of(column(r.history, moved)) > 0.0 for r in results) else []
    # over load factors, the load factor is a straight line; it is a curve over the points of a path
    paths = "load_factor" in common and results[0].axis is not TIME
    chosen += ["load_factor"] if paths and not all(_is_axis(r.history, "load_factor") for r in results) else []
    if not chosen:
        raise InputError("plot: the results have no columns in common that change; name some as curves")
    return chosen


def largest_of(curves: Mapping[str, np.ndarray]) -> float:
    """Return the largest magnitude of all curves."""
    return max((largest(values) for values in curves.values()), default=0.0)


def _is_axis(history: History, name: str) -> bool:
    return np.array_equal(read(history, name), read(history, "time"))


def draw_curves(
    results: Sequence[Any],
    names: Sequence[str],
    against: str | None = None,
    chosen: Filter | None = None,
    closed_forms: bool = True,
) -> Chart:
    """Draw a panel for each named column, with the curves of all results, over time or another column.

    Parameters
    ----------
    results : open results
    names : columns, or components of them
    against : a column of numbers, or a component; None: time
    chosen : filter of the curves
    closed_forms : whether to draw the closed form of the first result
    """
    first = results[0]
    if not names:
        raise InputError("plot: no curves named; columns: " + ", ".join(first.history))
    if len({result.axis for result in results}) > 1 and against is None:
        raise InputError("plot: the results are over different axes: " + ", ".join({r.axis.symbol for r in results}))
    title, labels = first.case.title or first.case.name, labels_of(results)
    exact = closed_form(first) if closed_forms and against is None else None
    chart = Chart(
        np.concatenate([read(result.history, "time") for result in results]),
        title,
        len(names),
        heights=[0.9] * len(names),
        axis=first.axis,
    )
    if against is not None:
        places = [_single(result.history, against) for result in results]
        unit = unit_of_curve(against)
        chart.factor, shown = prefix_for(max(float(np.nanmax(np.abs(p), initial=0.0)) for p in places), unit)
        over = f"{against} [{unit}]" if unit else against
        chart.axes[-1, 0].set_xlabel(f"{words(against)} [{shown}]" if shown else words(against))
    else:
        places = [read(result.history, "time") for result in results]
        over = first.axis.label(first.axis.unit)
    sources = [_Source(*each) for each in zip(results, labels, places, strict=True)]
    every = [[column(result.history, name) for result in results] for name in names]
    sizes: dict[str, list[float]] = {}
    for name, found in zip(names, every, strict=True):
        sizes.setdefault(unit_of_curve(name), []).append(max(largest_of(curves) for curves in found))
    for unit, magnitudes in sizes.items():
        chart.share(unit, unit, magnitudes)
    for axes, name, found in zip(chart.axes[:, 0], names, every, strict=True):
        _panel(chart, axes, name, found, sources, over, chosen)
        if exact is not None:
            _draw_exact(chart, axes, exact, found[0], places[0])
        axes.margins(x=0.0 if against is None else 0.02)
        if len(axes.lines) > 1:
            legend_beside(axes, handlelength=2.2)
    return chart


class _Source(NamedTuple):
    """A result, its label, and the places of its rows on the axis (n,)."""

    result: Any
    label: str
    place: np.ndarray


def unit_of_curve(name: str) -> str:
    """Return the SI unit of a column or a component of one."""
    name = name.replace(_DISPLACEMENT, "/position")
    return unit_of(name.rpartition(".")[0] or name) or unit_of(name)


def _panel(
    chart: Chart,
    axes: Any,
    name: str,
    found: Sequence[dict[str, np.ndarray]],
    sources: Sequence[_Source],
    over: str,
    chosen: Filter | None,
) -> None:
    unit = unit_of_curve(name)
    axes.pfem_factor, shown = chart.scale(unit)
    parts = list(dict.fromkeys(part for curves in found for part in curves))
    several = len(found) > 1
    shared = all(np.array_equal(source.place, sources[0].place) for source in sources)
    for number, (curves, (result, label, place)) in enumerate(zip(found, sources, strict=True)):
        time = read(result.history, "time")
        for part, values in curves.items():
            touch = part.startswith(("wall/", "pair/", "constraint/")) and "/force" in part  # zero before the run
            filtered = chosen.apply(time, values, touch) if chosen is not None else values
            k = number * len(parts) + parts.index(part)
            text = " ".join(word for word in (label if several else "", part if len(parts) > 1 else "") if word)
            x, y = (place, filtered) if over[:4] != "time" else thinned(place, filtered)
            style = {"color": COLOURS[k % len(COLOURS)], "linestyle": DASHES[number % len(DASHES)]}
            axes.plot(x * chart.factor, y * axes.pfem_factor, label=literal(text or part), **style)
            along = over if shared else f"{over}: {label}"
            chart.record(f"{part}: {label}" if several else part, filtered, unit, (along, place))
    label = words(name.rsplit("/", 1)[-1])
    axes.set_ylabel(f"{label} [{shown}]" if shown else label)
    name = parts[0] if len(parts) == 1 else name  # which component it is
    axes.set_title(literal(name if chosen is None or chosen.name == AS_COMPUTED else f"{name}: {chosen.name}"))


def _draw_exact(chart: Chart, axes: Any, exact: Any, found: dict[str, np.ndarray], place: np.ndarray) -> None:
    """Add the closed form of the curves of a panel."""
    for part in found:
        whole, _, component = part.rpartition(".")
        values = exact.columns.get(part, exact.columns.get(_position(whole)))
        if values is None:
            continue
        values = column({_position(whole) or part: values}, part)[part]
        axes.plot(place * chart.factor, values * axes.pfem_factor, label="closed form", **REFERENCE)
        chart.record(f"{part} closed form", values, unit_of(whole or part), (chart._over, place))


def _single(history: History, name: str) -> np.ndarray:
    found = column(history, name)
    if list(found) != [name]:
        raise InputError(f"plot: against = {name!r} is a vector: name a component, {name}.x, .y, .z or .norm")
    return found[name]


def labels_of(results: Sequence[Any]) -> list[str]:
    """Return distinct names of results: those of their folders, or as much of the paths as it takes."""
    paths = [Path(result.path).absolute() for result in results]
    for count in range(1, max(len(path.parts) for path in paths)):
        labels = ["/".join(path.parent.parts[-count:]) for path in paths]
        if len(set(labels)) == len(labels):
            return labels
    return (
        [str(path) for path in paths] if len(set(paths)) == len(paths) else [f"{k}: {p}" for k, p in enumerate(paths)]
    )


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
            legend_beside(axes)
    return chart


def _natural(result: Any) -> np.ndarray:
    modes = result.modes if getattr(result, "n_modes", 0) else None
    return modes.frequency if modes is not None and modes.kind == "vibration" else np.zeros(0)


def _tell_peaks(axes: Any, frequency: np.ndarray, amplitude: np.ndarray, factor: float, unit: str) -> None:
    """Write the frequencies of the highest peaks beside them; each is higher than all within 6 % of the picture."""
    from scipy.signal import find_peaks

    if len(amplitude) < 3:
        return
    apart = max(1.0, 0.06 * (frequency[-1] - frequency[0]) / (frequency[1] - frequency[0]))
    peaks, _ = find_peaks(amplitude, height=3e-3 * amplitude.max(), distance=apart)
    for k in peaks[np.argsort(-amplitude[peaks])][:_PEAKS]:
        left, middle, right = np.log(np.maximum(amplitude[k - 1 : k + 2], 1e-300))
        bend = left - 2.0 * middle + right
        place = frequency[k] + (0.5 * (left - right) / bend if bend < 0.0 else 0.0) * (frequency[1] - frequency[0])
        text, at = f"{place * factor:.4g} {unit}", (frequency[k] * factor, amplitude[k])
        axes.annotate(text, at, xytext=(3, 4), textcoords="offset points", fontsize=8)
