"""Curves of a result's history."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..output.units import TIME, unit_of
from .chart import COLOURS, REFERENCE, STYLE, Chart, check_formats
from .closed_forms import ClosedForm, closed_form
from .curves import History, draw_curves, draw_spectra, make_chart, read, usual_curves, words
from .energies import draw_energies
from .filters import WINDOWS, Filter, make_filter
from .forces import draw_force_displacement, draw_forces
from .options import opened

__all__ = ["plot"]


def plot(
    result_path: Path | str | Any | Sequence[Any],
    output: Path | str | None = None,
    *,
    curves: Iterable[str] | None = None,
    formats: Iterable[str] = ("png",),
    force_filter: str | None = None,
    against: str | None = None,
    spectrum: Iterable[str] | None = None,
    window: str = "hann",
    highest: float | None = None,
    closed_forms: bool = True,
) -> list[Path]:
    """Draw the history: ``energies.png``, ``momentum.png``, ``probes.png``, ``walls.png``, ``solver.png`` and others.

    Parameters
    ----------
    result_path : result file or its folder, or an open result; several of them are drawn over each other, into
        ``comparison.png`` without ``curves``
    output : folder of the pictures; None: beside the (first) result
    curves : names of history columns, drawn into ``curves.png`` instead of the other pictures; an existing
        ``curves.png`` is kept, and the new one is ``curves_2.png`` and so on
    formats : of :data:`~pfem_petsc.post.chart.FORMATS`; "csv" writes a table of each picture, with all rows in SI
        units, and, without curves, ``history.csv``
    force_filter : of the forces of walls and others, and of the curves with which it is given: see
        :func:`~pfem_petsc.post.filters.make_filter`; None: the mean of the last 2 % of the run, for forces alone
    against : column or component, like ``probe/tip/position.x``, over which the curves are drawn instead of time
    spectrum : names of history columns whose amplitude spectra are drawn into ``spectra.png`` instead
    window : of the spectra, one of :data:`~pfem_petsc.post.filters.WINDOWS`
    highest : frequency [Hz] at which the spectra end; None: half the sampling rate
    closed_forms : whether closed forms are drawn where the case has one

    Returns
    -------
    The files written; there is none for what the result lacks (probes, walls, ``pairs.png``, ``constraints.png``,
    iterations).

    Raises
    ------
    InputError
        For a column that the history does not have (with the nearest name), an empty history, an unknown format, filter
        or window, options that exclude each other, or a folder that cannot be written.
    """
    import matplotlib

    several = isinstance(result_path, Sequence) and not isinstance(result_path, str)
    paths = list(result_path) if several else [result_path]
    suffixes = check_formats(formats)
    chosen = make_filter(force_filter) if force_filter is not None else None
    names, sines = (None if found is None else list(found) for found in (curves, spectrum))
    _check_options(paths, names, sines, against, window)
    with ExitStack() as stack, matplotlib.rc_context(STYLE):
        results = [stack.enter_context(opened(path)) for path in paths]
        folder = Path(output) if output is not None else Path(results[0].path).parent
        for result in results:
            if "time" not in result.history or len(result.history["time"]) == 0:
                raise InputError(
                    f"{result.path}: the history is empty: nothing to plot; set [output] history_every >= 1"
                )
            if chosen is not None and result.axis is not TIME:
                raise InputError(
                    f"{result.path}: filter = {force_filter!r} needs a run over time, not a static analysis"
                )
        if sines is not None:
            chart = draw_spectra(results, sines, window, highest)
            return chart.save(_free(folder / "spectra", suffixes), suffixes)
        if names is not None:
            chart = draw_curves(results, names, against, chosen, closed_forms)
            return chart.save(_free(folder / "curves", suffixes), suffixes)
        if len(results) > 1:
            chart = draw_curves(results, usual_curves(results), None, chosen, closed_forms)
            return chart.save(folder / "comparison", suffixes)
        (result,) = results
        return _usual(result, folder, suffixes, chosen, closed_forms)


def _check_options(
    paths: list[Any], names: list[str] | None, sines: list[str] | None, against: str | None, window: str
) -> None:
    if not paths:
        raise InputError("plot: no result named")
    if sines is not None and (names is not None or against is not None):
        raise InputError("plot: spectrum is a picture of its own: give it without curves and against")
    if against is not None and names is None:
        raise InputError(f"plot: against = {against!r} needs curves, the columns to draw over it")
    if window not in WINDOWS:
        raise InputError(f"plot: window = {window!r} is not known; it is one of {', '.join(WINDOWS)}")


def _usual(
    result: Any, folder: Path, suffixes: tuple[str, ...], chosen: Filter | None, closed_forms: bool
) -> list[Path]:
    """The pictures of a single result."""
    history: History = result.history
    case = result.case
    title = case.title or case.name
    exact = closed_form(result) if closed_forms else None
    drawn: dict[str, Chart | None] = {
        "energies": draw_energies(history, title, exact),
        "momentum": _momentum(history, title, exact) if result.axis is TIME else None,
        "probes": _probes(history, title, exact),
        "walls": draw_forces(history, "wall", case.every_wall, title, chosen, exact),
        "pairs": draw_forces(history, "pair", (), title, chosen),
        "constraints": draw_forces(history, "constraint", (), title, chosen),
        "force_displacement": draw_force_displacement(result, title, chosen, exact),
        "solver": _solver(history, title),
    }
    written = [path for name, chart in drawn.items() if chart for path in chart.save(folder / name, suffixes)]
    if "csv" in suffixes and hasattr(result, "table"):
        written.append(result.table().to_csv(folder / "history.csv"))
    return written


def _free(file: Path, suffixes: Sequence[str]) -> Path:
    """Return the file name without suffix, with the next free number if it exists in one of the formats."""
    numbered = (file.with_name(f"{file.name}_{k}") for k in itertools.count(2))
    free = (p for p in itertools.chain([file], numbered) if not any(Path(f"{p}.{s}").exists() for s in suffixes))
    return next(free)


def _components(values: np.ndarray, scale: float = 0.0) -> list[tuple[str, np.ndarray]]:
    """Return named components of (n, 3) that are not zero up to rounding; all, as zero, if all are.

    Rounding is relative to the largest value, or to ``scale`` if the vector is a difference of larger ones.
    """
    floor = 1e-9 * max(float(np.nanmax(np.abs(values), initial=0.0)), scale)
    curves = [(name, values[:, k]) for k, name in enumerate("xyz")]
    kept = [(name, v) for name, v in curves if np.nanmax(np.abs(v), initial=0.0) > floor]
    return kept or [(name, np.zeros_like(v)) for name, v in curves]


def _colours_of(curves: Sequence[tuple[str, np.ndarray]]) -> list[dict[str, Any]]:
    """Return the styles of curves, with the same colours for x, y, z in all panels."""
    return [{"color": COLOURS["xyz".index(name)]} for name, _ in curves]


def _vector(
    chart: Chart,
    axes: Any,
    label: str,
    unit: str,
    values: np.ndarray,
    title: str = "",
    scale: float = 0.0,
    exact: np.ndarray | None = None,
    key: str = "",
) -> None:
    curves = _components(values, scale)
    styles, keys = _colours_of(curves), [f"{key or label}.{name}" for name, _ in curves]
    for name, _ in list(curves) if exact is not None else ():
        first = len(styles) == len(keys) and not any(label == "closed form" for label, _ in curves)
        curves.append(("closed form" if first else f"_{name}", exact[:, "xyz".index(name)]))
        styles.append(REFERENCE)
        keys.append(f"{key or label}.{name} closed form")
    chart.curves(axes, label, unit, curves, title, styles, legend=False, keys=keys)
    axes.legend(loc="best", ncols=4, handlelength=1.4)


def _momentum(history: History, title: str, exact: ClosedForm | None) -> Chart | None:
    names = [name for name in ("momentum", "angular_momentum", "centre_of_mass") if name in history]
    if not names:
        return None
    chart = make_chart(history, title, len(names), heights=[0.9] * len(names))
    for axes, name in zip(chart.axes[:, 0], names, strict=True):
        values, label, scale = read(history, name), words(name), 0.0
        known = exact.columns.get(name) if exact is not None else None
        if name == "centre_of_mass":
            known = None if known is None else known - values[0]
            values = values - values[0]
            label = "centre of mass,\nmoved by"
        elif name == "angular_momentum" and {"momentum", "centre_of_mass"} <= set(names):
            arm = np.linalg.norm(read(history, "centre_of_mass"), axis=1)
            scale = float(np.nanmax(arm * np.linalg.norm(read(history, "momentum"), axis=1)))
        _vector(chart, axes, label, unit_of(name), values, scale=scale, exact=known, key=name)
    return chart


def _probes(history: History, title: str, exact: ClosedForm | None) -> Chart | None:
    quantities = ("position", "velocity", "acceleration", "reaction")
    probes: dict[str, dict[str, np.ndarray]] = {}
    for name in history:
        parts = name.split("/")
        if parts[0] == "probe" and parts[-1] in quantities:
            probes.setdefault("/".join(parts[1:-1]), {})[parts[-1]] = np.asarray(history[name], dtype=float)
    if not probes:
        return None
    # reactions have a column only if there are any; accelerations in impacts are mostly noise
    columns = [q for q in quantities if q != "acceleration" and any(_wanted(q, held) for held in probes.values())]
    chart = make_chart(history, title, len(probes), len(columns))
    labels = {"position": "displacement"}
    for row, (probe, held) in zip(chart.axes, probes.items(), strict=True):
        for axes, quantity in zip(row, columns, strict=True):
            if quantity not in held:
                axes.set_axis_off()
                continue
            values = held[quantity]
            column = f"probe/{probe}/{quantity}"
            known = exact.columns.get(column) if exact is not None else None
            if quantity == "position":
                known = None if known is None else known - values[:1]
                values = values - values[:1]
            nodes = values.shape[1]
            # the reaction of a support is the sum over its nodes
            total = quantity == "reaction"
            how = f"sum of {nodes} nodes" if total else f"mean and range of {nodes} nodes"
            name = f"{probe} ({how})" if nodes > 1 else probe
            shown = values.sum(axis=1) if total else values.mean(axis=1)
            known = None if known is None else known.mean(axis=1)
            key = f"probe/{probe}/{labels.get(quantity, quantity)}"
            _vector(chart, axes, labels.get(quantity, quantity), unit_of(quantity), shown, name, exact=known, key=key)
            if nodes > 1 and not total:
                _range(chart, axes, quantity, values)
    return chart


def _wanted(quantity: str, held: dict[str, np.ndarray]) -> bool:
    return quantity in held and (quantity != "reaction" or bool(np.any(held[quantity])))


def _range(chart: Chart, axes: Any, quantity: str, values: np.ndarray) -> None:
    """Shade the range of the nodes, in the units of the panel."""
    from ..output.units import prefix_for

    mean = values.mean(axis=1)
    factor, _ = prefix_for(float(np.nanmax(np.abs([v for _, v in _components(mean)]))), unit_of(quantity))
    every = max(1, len(values) // 3000)
    time = chart.time[::every] * chart.factor
    for name, _ in _components(mean):
        k = "xyz".index(name)
        low, high = values[::every, :, k].min(axis=1) * factor, values[::every, :, k].max(axis=1) * factor
        axes.fill_between(time, low, high, color=COLOURS[k], alpha=0.15, linewidth=0)


def _solver(history: History, title: str) -> Chart | None:
    labels = {
        "newton_iterations": "Newton\niterations",
        "linear_iterations": "linear\niterations",
        "active_contacts": "nodes in\ncontact",
    }
    names = [name for name in labels if name in history]
    # without iterations (explicit schemes) or without walls these panels would be empty
    walls = any(name.startswith("wall/") for name in history)
    names = [name for name in names if (walls and name == "active_contacts") or np.any(history[name])]
    if not names or (names == ["active_contacts"] and _is_shown(history)):
        return None
    chart = make_chart(history, title, len(names), heights=[0.7] * len(names))
    for number, (axes, name) in enumerate(zip(chart.axes[:, 0], names, strict=True)):
        chart.counts(axes, labels[name], history[name], COLOURS[number])
    return chart


def _is_shown(history: History) -> bool:
    """Whether the nodes in contact are those of a single wall: their number is in the picture of the walls."""
    walls = [name for name in history if name.startswith("wall/") and name.endswith("/contacts")]
    return len(walls) == 1 and np.array_equal(history[walls[0]], history["active_contacts"])
