"""Curves selected by name: over time or another column, of one result or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..errors import InputError
from ..output.units import TIME, prefix_for, unit_of
from ..registry import nearest
from .chart import COLOURS, REFERENCE, Chart, largest, literal, thinned
from .closed_forms import closed_form
from .filters import AS_COMPUTED, Filter

__all__ = [
    "History",
    "column",
    "draw_curves",
    "labels_of",
    "make_chart",
    "read",
    "unit_of_curve",
    "usual_curves",
    "words",
]

History = Mapping[str, np.ndarray]

_DISPLACEMENT = "/displacement"  # of probes, whose columns have positions

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
        raise InputError(f"plot: the history holds no column '{whole}'{nearest(whole, known)}")
    values = read(history, whole)
    if values.ndim == 3:
        values = values.sum(axis=1) if whole.endswith("/reaction") else values.mean(axis=1)
    if values.ndim == 1:
        if part:
            raise InputError(f"plot: {name}: column '{whole}' is a number and has no components")
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
    every = [[column(result.history, name) for result in results] for name in names]
    sizes: dict[str, list[float]] = {}
    for name, found in zip(names, every, strict=True):
        sizes.setdefault(unit_of_curve(name), []).append(max(largest_of(curves) for curves in found))
    for unit, magnitudes in sizes.items():
        chart.share(unit, unit, magnitudes)
    for axes, name, found in zip(chart.axes[:, 0], names, every, strict=True):
        _panel(chart, axes, name, found, places, labels, over, chosen, [read(r.history, "time") for r in results])
        if exact is not None:
            _draw_exact(chart, axes, exact, found[0], places[0])
        axes.margins(x=0.0 if against is None else 0.02)
        if len(axes.lines) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, handlelength=2.2)
    return chart


def unit_of_curve(name: str) -> str:
    """Return the SI unit of a column or a component of one."""
    name = name.replace(_DISPLACEMENT, "/position")
    return unit_of(name.rpartition(".")[0] or name) or unit_of(name)


def _panel(
    chart: Chart,
    axes: Any,
    name: str,
    found: Sequence[dict[str, np.ndarray]],
    places: Sequence[np.ndarray],
    labels: Sequence[str],
    over: str,
    chosen: Filter | None,
    times: Sequence[np.ndarray],
) -> None:
    unit = unit_of_curve(name)
    axes.pfem_factor, shown = chart.scale(unit)
    parts = list(dict.fromkeys(part for curves in found for part in curves))
    several = len(found) > 1
    shared = all(np.array_equal(place, places[0]) for place in places)
    for number, (curves, place, label, time) in enumerate(zip(found, places, labels, times, strict=True)):
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
