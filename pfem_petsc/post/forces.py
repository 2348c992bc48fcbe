"""Curves of the forces of walls, of contact pairs, and of constraints, over time and over displacements."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..output.units import TIME
from .chart import COLOURS, REFERENCE, Chart, Curve, largest, literal
from .closed_forms import ClosedForm
from .filters import AS_COMPUTED, Filter, make_filter

WINDOW = 0.02  # width of the moving average of forces, relative to the run


def draw_forces(
    history: Mapping[str, np.ndarray],
    source: str,
    walls: Iterable[Any],
    title: str,
    chosen: Filter | None = None,
    exact: ClosedForm | None = None,
) -> Chart | None:
    """Draw the forces of all walls, or of all pairs or constraints, and the nodes in contact where they are counted.

    Forces are drawn as computed and filtered, by default by the mean of the last 2 % of the run; before it, they are
    zero.
    """
    names = [name.removeprefix(f"{source}/").removesuffix("/force") for name in history if name.endswith("/force")]
    names = [name for name in names if f"{source}/{name}/force" in history]
    if not names:
        return None
    silent = [name for name in names if not np.any(history[f"{source}/{name}/force"])]
    if len(silent) < len(names):  # nothing would be in their panels
        names = [name for name in names if name not in silent]
    else:
        silent = []
    time = np.asarray(history["time"], dtype=float)
    normals = {wall.name: np.asarray(wall.normal, dtype=float) for wall in walls if hasattr(wall, "normal")}
    counted = [f"{source}/{name}/contacts" in history for name in names]
    smoothing = chosen or _usual_filter(history)
    if all(not np.any(history[f"{source}/{name}/force"]) for name in names):  # a panel each says so
        smoothing, counted = make_filter("none"), [False] * len(names)
    plain = smoothing.name == AS_COMPUTED
    heights = [h for c in counted for h in [0.9] * (2 - plain) + [0.5] * c]
    chart = Chart(time, title, len(heights), heights=heights, axis=getattr(history, "axis", TIME))
    panels = iter(chart.axes[:, 0])
    # peaks (the inertia of a node that is stopped within a step) and means have panels of their own
    forces = {}
    for name in names:
        values, label = _pressing(np.asarray(history[f"{source}/{name}/force"], dtype=float), normals.get(name))
        forms = ((AS_COMPUTED, values, 0.9), (smoothing.name, smoothing.apply(time, values, True), 1.6))[: 2 - plain]
        forces[name] = label, forms
    chart.share("force", "N", [largest(drawn) for _, forms in forces.values() for _, drawn, _ in forms])
    for name, counts in zip(names, counted, strict=True):
        column, (label, forms) = f"{source}/{name}/force", forces[name]
        heading = f"{source.capitalize()} '{name}'"
        known = None if exact is None or column not in exact.columns else exact.columns[column]
        for form, drawn, width in forms:
            curves = [Curve(form, drawn, {"linewidth": width}, f"{column} {label}, {form}")]
            if known is not None:
                pressing = _pressing(known, normals.get(name))[0]
                curves.append(Curve(exact.name, pressing, REFERENCE, f"{column} closed form"))
            chart.curves(next(panels), label, "N", curves, heading, "force")
            heading = ""
        if counts:
            chart.counts(next(panels), "nodes in\ncontact", history[f"{source}/{name}/contacts"], COLOURS[1])
    if silent:
        _note(chart.axes[0, 0], "no force throughout: " + ", ".join(f"'{name}'" for name in silent))
    return chart


def draw_force_displacement(
    result: Any, title: str, chosen: Filter | None = None, exact: ClosedForm | None = None
) -> Chart | None:
    """Draw what resists over how far it was pressed.

    A static analysis: the load factor over the displacement of each probe along the direction in which it moved
    farthest. Each wall with a normal and a force, while it is touched: the normal force over the displacement, since
    the first contact, of the wall along its normal, or, of a wall at rest, of the centre of mass towards it. Both have
    passed the filter, so that neither is late.
    """
    history = result.history
    lines = _load_paths(history, result.axis, exact) if "load_factor" in history else []
    lines += _wall_paths(result, chosen or _usual_filter(history), exact)
    if not lines:
        return None
    chart = Chart(history["time"], title, len(lines), sharex=False, axis=result.axis)
    for unit in {line.unit for line in lines}:
        chart.share(unit, unit, [largest(line.values) for line in lines if line.unit == unit])
    chart.share("m", "m", [largest(line.place) for line in lines])
    for axes, line in zip(chart.axes[:, 0], lines, strict=True):
        line.draw(chart, axes)
    return chart


@dataclass
class _Path:
    """A curve over a displacement [m]."""

    heading: str
    over: str
    place: np.ndarray
    label: str
    unit: str
    values: np.ndarray
    name: str
    exact: tuple[str, np.ndarray, np.ndarray] | None = None

    def draw(self, chart: Chart, axes: Any) -> None:
        (along, metre), (factor, unit) = chart.scale("m"), chart.scale(self.unit)
        few = {"marker": "o", "markersize": 3} if len(self.place) < 80 else {}
        axes.plot(self.place * along, self.values * factor, color=COLOURS[0], label=literal(self.name), **few)
        known = np.isfinite(self.values)
        over = (f"{self.over} [m]", self.place[known])
        chart.record(f"{self.heading} {self.label}, {self.name}", self.values[known], self.unit, over)
        if self.exact is not None:
            name, place, values = self.exact
            axes.plot(place * along, values * factor, label=name, **REFERENCE)
            chart.record(f"{self.heading} {self.label}, closed form", values, self.unit, (f"{self.over} [m] ", place))
        axes.margins(x=0.02)
        axes.set_xlabel(f"{self.over} [{metre}]")
        axes.set_ylabel(f"{self.label} [{unit}]" if unit else self.label)
        axes.set_title(literal(self.heading))
        chart.legend_above(axes)


def _load_paths(history: Mapping[str, np.ndarray], axis: Any, exact: ClosedForm | None) -> list[_Path]:
    if axis is TIME:
        return []
    factor = np.asarray(history["load_factor"], dtype=float)
    lines = []
    for name in history:
        if name.startswith("probe/") and name.endswith("/position"):
            moved = np.asarray(history[name], dtype=float).mean(axis=1)
            moved = moved - moved[0]
            k = int(np.argmax(np.abs(moved).max(axis=0)))
            sign = -1.0 if moved[np.argmax(np.abs(moved[:, k])), k] < 0.0 else 1.0
            if not np.any(moved[:, k]):
                continue
            probe = f"Probe '{name.removeprefix('probe/').removesuffix('/position')}'"
            over = f"displacement along {'−' if sign < 0 else ''}{'xyz'[k]}"
            line = _Path(probe, over, sign * moved[:, k], "load factor", "", factor, AS_COMPUTED)
            if exact is not None and exact.path is not None:
                line.exact = (exact.name, *exact.path)
            lines.append(line)
    return lines


def _wall_paths(result: Any, smoothing: Filter, exact: ClosedForm | None) -> list[_Path]:
    history, lines = result.history, []
    time = np.asarray(history["time"], dtype=float)
    for wall in result.case.every_wall:
        column, place = f"wall/{wall.name}/force", f"wall/{wall.name}/position"
        if not hasattr(wall, "normal") or column not in history or not np.any(history[column]):
            continue
        normal = np.asarray(wall.normal, dtype=float) / np.linalg.norm(wall.normal)
        force, sign, known = np.asarray(history[column], dtype=float) @ normal, 1.0, None
        if place in history and np.any(np.ptp(np.asarray(history[place]), axis=0) > 0.0):
            over = "displacement of the wall since contact"
        elif "centre_of_mass" in history:
            place, sign, over = "centre_of_mass", -1.0, "displacement of the centre of mass since contact"
            if exact is not None and {column, place} <= set(exact.columns):
                known = (exact.columns[column] @ normal, -exact.columns[place] @ normal)
        else:
            continue
        moved = sign * np.asarray(history[place], dtype=float) @ normal
        moved, smooth = smoothing.apply(time, moved), smoothing.apply(time, force, True)
        shown, begin = _touching(force, smooth)
        line = _Path(
            f"Wall '{wall.name}'",
            over,
            (moved - moved[begin])[shown],
            "normal force",
            "N",
            np.where(_near(force, smooth), smooth, np.nan)[shown],
            smoothing.name,
        )
        if known is not None:
            part, begin = _touching(*known[:1] * 2)
            line.exact = (exact.name, (known[1] - known[1][begin])[part], known[0][part])
        lines.append(line)
    return lines


def _near(force: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Return which rows (n,) bool have a force as computed or filtered, or are beside such a row."""
    felt = (force != 0.0) | (np.abs(smooth) > 1e-3 * largest(smooth))
    near = felt.copy()
    near[:-1] |= felt[1:]
    near[1:] |= felt[:-1]
    return near


def _touching(force: np.ndarray, smooth: np.ndarray) -> tuple[slice, int]:
    """Return the rows from before the first force to after the last one, and the last row before the first force."""
    near = np.flatnonzero(_near(force, smooth))
    return slice(near[0], near[-1] + 1), max(0, int(np.flatnonzero(force)[0]) - 1)


def _usual_filter(history: Mapping[str, np.ndarray]) -> Filter:
    time = np.asarray(history["time"], dtype=float)
    # of a window shorter than the interval of the rows, nothing would be left of a spike
    width = max(WINDOW * float(time[-1] - time[0]), float(np.diff(time).max(initial=0.0)))
    if getattr(history, "axis", TIME) is not TIME or width <= 0.0:
        return make_filter("none")
    return make_filter(f"mean:{width!r}")


def _pressing(force: np.ndarray, normal: np.ndarray | None) -> tuple[np.ndarray, str]:
    """Return the force (n,) along a normal, or its length, and what it is."""
    if normal is None:
        return np.linalg.norm(force, axis=1), "force"
    return force @ normal / np.linalg.norm(normal), "normal force"


def _note(axes: Any, text: str) -> None:
    axes.annotate(literal(text), (1.0, 1.02), xycoords="axes fraction", fontsize=8, color="#5b6472", ha="right")
