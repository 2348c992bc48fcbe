"""Curves of the forces of walls, of contact pairs, and of constraints, over time and over displacements."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..output.units import TIME, prefix_for
from .chart import COLOURS, REFERENCE, Chart, literal
from .closed_forms import ClosedForm
from .filters import AS_COMPUTED, Filter, make_filter

__all__ = ["draw_force_displacement", "draw_forces"]

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

    Forces are drawn as computed and filtered, by default by the mean of the last 2 % of the run.
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
    plain = smoothing.name == AS_COMPUTED
    heights = [h for c in counted for h in [0.9] * (2 - plain) + [0.5] * c]
    chart = Chart(time, title, len(heights), heights=heights, axis=getattr(history, "axis", TIME))
    panels = iter(chart.axes[:, 0])
    for name, counts in zip(names, counted, strict=True):
        # peaks (the inertia of a node that is stopped within a step) and means need different scales
        column = f"{source}/{name}/force"
        values, label = _pressing(np.asarray(history[column], dtype=float), normals.get(name))
        smooth = smoothing.apply(time, values)
        heading = f"{source.capitalize()} '{name}'"
        known = None if exact is None or column not in exact.columns else exact.columns[column]
        for form, drawn, width in ((AS_COMPUTED, values, 0.9), (smoothing.name, smooth, 1.6))[: 2 - plain]:
            curves, styles, keys = [(form, drawn)], [{"linewidth": width}], [f"{column} {label}, {form}"]
            if known is not None:
                curves.append((exact.name, _pressing(known, normals.get(name))[0]))
                styles.append(REFERENCE)
                keys.append(f"{column} closed form")
            axes = next(panels)
            chart.curves(axes, label, "N", curves, heading, styles, legend=False, keys=keys)
            axes.legend(loc="best")
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
    farthest. Each wall with a normal and a force: the filtered normal force over the displacement of the wall along its
    normal, or, of a wall at rest, over that of the centre of mass towards it.
    """
    history = result.history
    lines = _load_paths(history, result.axis, exact) if "load_factor" in history else []
    lines += _wall_paths(result, chosen or _usual_filter(history))
    if not lines:
        return None
    chart = Chart(history["time"], title, len(lines), sharex=False, axis=result.axis)
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
        along, metre = prefix_for(float(np.abs(self.place).max()), "m")
        factor, unit = prefix_for(float(np.nanmax(np.abs(self.values))), self.unit)
        few = {"marker": "o", "markersize": 3} if len(self.place) < 80 else {}
        axes.plot(self.place * along, self.values * factor, color=COLOURS[0], label=literal(self.name), **few)
        over = (f"{self.over} [m]", self.place)
        chart.record(f"{self.heading} {self.label}, {self.name}", self.values, self.unit, over)
        if self.exact is not None:
            name, place, values = self.exact
            axes.plot(place * along, values * factor, label=name, **REFERENCE)
            chart.record(f"{self.heading} {self.label}, closed form", values, self.unit, (f"{self.over} [m] ", place))
        axes.margins(x=0.02)
        axes.set_xlabel(f"{self.over} [{metre}]")
        axes.set_ylabel(f"{self.label} [{unit}]" if unit else self.label)
        axes.set_title(literal(self.heading))
        axes.legend(loc="best")


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


def _wall_paths(result: Any, smoothing: Filter) -> list[_Path]:
    history, lines = result.history, []
    time = np.asarray(history["time"], dtype=float)
    for wall in result.case.every_wall:
        column, place = f"wall/{wall.name}/force", f"wall/{wall.name}/position"
        if not hasattr(wall, "normal") or column not in history or not np.any(history[column]):
            continue
        normal = np.asarray(wall.normal, dtype=float) / np.linalg.norm(wall.normal)
        force = smoothing.apply(time, np.asarray(history[column], dtype=float) @ normal)
        if place in history and np.any(np.ptp(np.asarray(history[place]), axis=0) > 0.0):
            moved, over = np.asarray(history[place], dtype=float), "displacement of the wall"
        elif "centre_of_mass" in history:
            moved, over = -np.asarray(history["centre_of_mass"], dtype=float), "displacement of the centre of mass"
        else:
            continue
        heading = f"Wall '{wall.name}'"
        lines.append(_Path(heading, over, (moved - moved[0]) @ normal, "normal force", "N", force, smoothing.name))
    return lines


def _usual_filter(history: Mapping[str, np.ndarray]) -> Filter:
    time = np.asarray(history["time"], dtype=float)
    width = WINDOW * float(time[-1] - time[0])
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
