"""Curves of a result's history."""

from __future__ import annotations

import itertools
import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from ..energies import LOST, STORED, SUPPLIED
from ..errors import InputError
from ..output.units import TIME, engineering, unit_of
from ..registry import nearest
from .chart import COLOURS, STYLE, Chart
from .forces import draw_forces

__all__ = ["plot"]

History = Mapping[str, np.ndarray]

_NOTE_WIDTH = 100  # characters of a line above the axes


def plot(
    result_path: Path | str | Any, output: Path | str | None = None, *, curves: Iterable[str] | None = None
) -> list[Path]:
    """Draw the history: ``energies.png``, ``momentum.png``, ``probes.png``, ``walls.png``, ``solver.png`` and others.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    output : folder of the pictures; None: beside the result
    curves : names of history columns, drawn into ``curves.png`` instead of the other pictures; an existing
        ``curves.png`` is kept, and the new one is ``curves_2.png`` and so on

    Returns
    -------
    The files written; there is none for what the result lacks (probes, walls, ``pairs.png``, ``constraints.png``,
    iterations).

    Raises
    ------
    InputError
        For a column that the history does not have (with the nearest name), an empty history, or a folder that cannot
        be written.
    """
    import matplotlib

    with _opened(result_path) as result, matplotlib.rc_context(STYLE):
        folder = Path(output) if output is not None else Path(result.path).parent
        history: History = result.history
        if "time" not in history or len(history["time"]) == 0:
            raise InputError(f"{result.path}: the history is empty: nothing to plot; set [output] history_every >= 1")
        case = result.case
        title = case.title or case.name
        if curves is not None:
            return [_named(history, list(curves), title, _free(folder / "curves.png"))]
        drawn = [
            _energies(history, title, folder / "energies.png"),
            _momentum(history, title, folder / "momentum.png") if result.axis is TIME else None,
            _probes(history, title, folder / "probes.png"),
            draw_forces(history, "wall", case.every_wall, title, folder / "walls.png"),
            draw_forces(history, "pair", (), title, folder / "pairs.png"),
            draw_forces(history, "constraint", (), title, folder / "constraints.png"),
            _solver(history, title, folder / "solver.png"),
        ]
    return [file for file in drawn if file is not None]


def _opened(result: Path | str | Any) -> Any:
    if not isinstance(result, (str, os.PathLike)):
        return nullcontext(result)
    from ..output.result import open_result

    return open_result(result)


def _free(file: Path) -> Path:
    """Return the file name, with the next free number if it exists."""
    numbered = (file.with_name(f"{file.stem}_{k}{file.suffix}") for k in itertools.count(2))
    return next(path for path in itertools.chain([file], numbered) if not path.exists())


def _read(history: History, name: str) -> np.ndarray:
    return np.asarray(history[name], dtype=float)


def _chart(history: History, title: str, rows: int, columns: int = 1, heights: Sequence[float] | None = None) -> Chart:
    axis = getattr(history, "axis", TIME)
    return Chart(_read(history, "time"), title, rows, columns, heights, axis)


def _words(name: str) -> str:
    return name.replace("_", " ")


def balance_error(history: History) -> np.ndarray | None:
    """Return the imbalance of stored, lost and supplied energies since the first row, (n,) [J]; None without them."""
    signs = {**dict.fromkeys((*STORED, *LOST), 1.0), **dict.fromkeys(SUPPLIED, -1.0)}
    parts = [sign * _read(history, name) for name, sign in signs.items() if name in history]
    if not parts:
        return None
    total = np.sum(parts, axis=0)
    return total - total[0]


def _energies(history: History, title: str, file: Path) -> Path | None:
    error = balance_error(history)
    if error is None:
        return None
    held = {name: _read(history, name) for name in (*STORED, *LOST, *SUPPLIED) if name in history}
    largest = max(float(np.nanmax(np.abs(values))) for values in held.values())
    moving = {name: values for name, values in held.items() if np.abs(values).max() > 1e-12 * largest}
    still = [_words(name) for name in held if name not in moving]
    chart = _chart(history, title, 2, heights=(1.7, 0.8))
    upper, lower = chart.axes[:, 0]
    total = sum(values for name, values in held.items() if name in (*STORED, *LOST))
    curves = [(_words(name), values) for name, values in moving.items()]
    styles: list[dict[str, Any]] = [{} for _ in curves]
    curves.append(("stored and lost", total))
    styles.append({"color": "#1f242c", "linewidth": 1.2, "linestyle": (0, (4, 2)), "zorder": 1.5})
    chart.curves(upper, "energy", "J", curves, styles=styles)
    if still:
        text = textwrap.fill("zero throughout: " + ", ".join(still), _NOTE_WIDTH)
        note = upper.annotate(text, (0, 1.02), xycoords="axes fraction", fontsize=8, color="#5b6472", va="bottom")
        note.set_in_layout(False)  # a long line must not take the width of the axes; the title makes the height for it
        upper.set_title("\n" * text.count("\n"), fontsize=9)
    chart.curves(lower, "balance error", "J", [("balance error", error)], styles=[{"color": COLOURS[1]}])
    worst = float(np.nanmax(np.abs(error)))
    if largest > 0:
        text = f"largest: {worst / largest:.1e} of {engineering(largest, 'J')}"
        lower.annotate(text, (1.01, 0.5), xycoords="axes fraction", fontsize=9, color="#5b6472", va="center")
    return chart.save(file)


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
    chart: Chart, axes: Any, label: str, unit: str, values: np.ndarray, title: str = "", scale: float = 0.0
) -> None:
    curves = _components(values, scale)
    chart.curves(axes, label, unit, curves, title, _colours_of(curves), legend=False)
    axes.legend(loc="best", ncols=3, handlelength=1.2)


def _momentum(history: History, title: str, file: Path) -> Path | None:
    names = [name for name in ("momentum", "angular_momentum", "centre_of_mass") if name in history]
    if not names:
        return None
    chart = _chart(history, title, len(names), heights=[0.9] * len(names))
    for axes, name in zip(chart.axes[:, 0], names, strict=True):
        values, label, scale = _read(history, name), _words(name), 0.0
        if name == "centre_of_mass":
            values = values - values[0]
            label = "centre of mass,\nmoved by"
        elif name == "angular_momentum" and {"momentum", "centre_of_mass"} <= set(names):
            arm = np.linalg.norm(_read(history, "centre_of_mass"), axis=1)
            scale = float(np.nanmax(arm * np.linalg.norm(_read(history, "momentum"), axis=1)))
        _vector(chart, axes, label, unit_of(name), values, scale=scale)
    return chart.save(file)


def _probes(history: History, title: str, file: Path) -> Path | None:
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
    chart = _chart(history, title, len(probes), len(columns))
    labels = {"position": "displacement"}
    for row, (probe, held) in zip(chart.axes, probes.items(), strict=True):
        for axes, quantity in zip(row, columns, strict=True):
            if quantity not in held:
                axes.set_axis_off()
                continue
            values = held[quantity]
            if quantity == "position":
                values = values - values[:1]
            nodes = values.shape[1]
            # the reaction of a support is the sum over its nodes
            total = quantity == "reaction"
            how = f"sum of {nodes} nodes" if total else f"mean and range of {nodes} nodes"
            name = f"{probe} ({how})" if nodes > 1 else probe
            shown = values.sum(axis=1) if total else values.mean(axis=1)
            _vector(chart, axes, labels.get(quantity, quantity), unit_of(quantity), shown, name)
            if nodes > 1 and not total:
                _range(chart, axes, quantity, values)
    return chart.save(file)


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


def _solver(history: History, title: str, file: Path) -> Path | None:
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
    chart = _chart(history, title, len(names), heights=[0.7] * len(names))
    for number, (axes, name) in enumerate(zip(chart.axes[:, 0], names, strict=True)):
        chart.counts(axes, labels[name], history[name], COLOURS[number])
    return chart.save(file)


def _is_shown(history: History) -> bool:
    """Whether the nodes in contact are those of a single wall: their number is in the picture of the walls."""
    walls = [name for name in history if name.startswith("wall/") and name.endswith("/contacts")]
    return len(walls) == 1 and np.array_equal(history[walls[0]], history["active_contacts"])


def _named(history: History, names: list[str], title: str, file: Path) -> Path:
    if not names:
        raise InputError("plot: no curves named; columns: " + ", ".join(history))
    for name in names:
        if name not in list(history):
            raise InputError(f"plot: the history holds no column '{name}'{nearest(name, list(history))}")
    chart = _chart(history, title, len(names), heights=[0.9] * len(names))
    for axes, name in zip(chart.axes[:, 0], names, strict=True):
        values = _read(history, name)
        label, unit = _words(name.rsplit("/", 1)[-1]), unit_of(name)
        if values.ndim == 3:  # nodes of a probe
            many, total = values.shape[1] > 1, name.endswith("/reaction")
            values = values.sum(axis=1) if total else values.mean(axis=1)
            label += (" (sum)" if total else " (mean)") if many else ""
        if values.ndim == 2:
            _vector(chart, axes, label, unit, values, name)
        else:
            chart.curves(axes, label, unit, [(name, values)], name)
    return chart.save(file)
