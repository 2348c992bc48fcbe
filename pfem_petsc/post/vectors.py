"""Curves of the momentum and of probes: vectors, of which only what changes has a panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..output.units import unit_of
from .chart import COLOURS, REFERENCE, Chart, Curve
from .closed_forms import ClosedForm
from .curves import History, make_chart, read, words

__all__ = ["draw_momentum", "draw_probes"]

_ROUNDING = 1e-9
"""Change of a curve below which it is constant, relative to the largest number of its quantity in the picture."""

_QUANTITIES = ("position", "velocity", "reaction")
"""Of probes that have panels; accelerations in impacts are mostly noise."""


@dataclass
class _Panel:
    """A vector over time.

    Attributes
    ----------
    title, label : above and beside the panel
    key : name of its columns in the table
    unit : of its values
    values : (n, 3)
    scale : magnitude of the numbers that the values are differences of
    exact : (n, 3), None without a closed form
    nodes : (n, nodes, 3), if the values are their mean; else None
    """

    title: str
    label: str
    key: str
    unit: str
    values: np.ndarray
    scale: float = 0.0
    exact: np.ndarray | None = None
    nodes: np.ndarray | None = None

    @property
    def size(self) -> float:
        """The largest number, of closed forms too."""
        every = [self.values] if self.exact is None else [self.values, self.exact]
        every += [] if self.nodes is None else [self.nodes]
        return max(float(np.nanmax(np.abs(part), initial=0.0)) for part in every)

    @property
    def changes(self) -> bool:
        """Whether a component changes by more than rounding."""
        parts = self.values[:, None] if self.nodes is None else self.nodes
        finite = np.where(np.isfinite(parts), parts, 0.0)
        return bool(np.ptp(finite, axis=0).max(initial=0.0) > _ROUNDING * self.scale)


def draw_momentum(history: History, title: str, exact: ClosedForm | None) -> Chart | None:
    """Draw momentum, angular momentum and the displacement of the centre of mass, without those that do not change."""
    names = [name for name in ("momentum", "angular_momentum", "centre_of_mass") if name in history]
    panels = []
    for name in names:
        values, label, scale = read(history, name), words(name), 0.0
        known = exact.columns.get(name) if exact is not None else None
        if name == "centre_of_mass":
            known = None if known is None else known - values[0]
            values, scale = values - values[0], float(np.nanmax(np.abs(values), initial=0.0))
            label = "centre of mass,\nmoved by"
        elif name == "angular_momentum" and {"momentum", "centre_of_mass"} <= set(names):
            arm = np.linalg.norm(read(history, "centre_of_mass"), axis=1)
            scale = float(np.nanmax(arm * np.linalg.norm(read(history, "momentum"), axis=1)))
        panels.append(_Panel("", label, name, unit_of(name), values, scale, known))
    shown, still = _moving(panels, {panel.key: panel.size for panel in panels})
    if not shown:
        return None
    chart = make_chart(history, title, len(shown), heights=[0.9] * len(shown))
    for axes, panel in zip(chart.axes[:, 0], shown, strict=True):
        _draw(chart, axes, panel)
    _tell(chart, still)
    return chart


def draw_probes(history: History, title: str, exact: ClosedForm | None) -> Chart | None:
    """Draw displacement, velocity and reaction of each probe, without those that do not change."""
    panels: dict[tuple[str, str], _Panel] = {}
    for name in history:
        parts = name.split("/")
        if parts[0] == "probe" and parts[-1] in _QUANTITIES:
            probe = "/".join(parts[1:-1])
            panels[probe, parts[-1]] = _of_probe(probe, parts[-1], read(history, name), exact, name)
    # in the order of probes, and of quantities
    probes = list(dict.fromkeys(probe for probe, _ in panels))
    every = [panels[probe, each] for probe in probes for each in _QUANTITIES if (probe, each) in panels]
    if not every:
        return None
    largest = {each.label: max(other.size for other in every if other.label == each.label) for each in every}
    shown, still = _moving(every, largest)
    shown, still = (shown, still) if shown else (every, [])  # probes are asked for
    rows, columns, places = _grid([(panel.title, panel.label) for panel in shown])
    chart = make_chart(history, title, rows, columns)
    for label in dict.fromkeys(panel.label for panel in shown):
        own = [panel for panel in shown if panel.label == label]
        chart.share(label, own[0].unit, [panel.size for panel in own])
    for place, panel in zip(places, shown, strict=True):
        _draw(chart, chart.axes[place], panel)
    chart.leave_out([place for place in np.ndindex(rows, columns) if place not in places])
    ranges = any(panel.nodes is not None for panel in shown)
    _tell(chart, still, "Shaded: the range of the nodes. " if ranges else "")
    return chart


def _of_probe(probe: str, quantity: str, values: np.ndarray, exact: ClosedForm | None, column: str) -> _Panel:
    known = exact.columns.get(column) if exact is not None else None
    label, scale = quantity, 0.0
    if quantity == "position":
        known = None if known is None else known - values[:1]
        label, scale = "displacement", float(np.nanmax(np.abs(values), initial=0.0))
        values = values - values[:1]
    count = values.shape[1]
    # the reaction of a support is the sum over its nodes
    total = quantity == "reaction"
    how = f"{'sum' if total else 'mean'} of {count} nodes"
    shown = values.sum(axis=1) if total else values.mean(axis=1)
    return _Panel(
        f"{probe}, {how}" if count > 1 else probe,
        label,
        f"probe/{probe}/{label}",
        unit_of(quantity),
        shown,
        1e-3 * scale,
        None if known is None else known.mean(axis=1),
        values if count > 1 and not total else None,
    )


def _moving(panels: Sequence[_Panel], largest: dict[str, float]) -> tuple[list[_Panel], list[_Panel]]:
    """Return the panels to draw, which change, or are not zero if none does, and the others.

    Rounding is relative to the largest number, by key or label of the panel.
    """
    for panel in panels:
        panel.scale = max(panel.scale, largest.get(panel.key, largest.get(panel.label, 0.0)))
    shown = [panel for panel in panels if panel.changes]
    shown = shown or [panel for panel in panels if panel.size > 0.0]
    return shown, [panel for panel in panels if not any(panel is other for other in shown)]


def _grid(names: Sequence[tuple[str, str]]) -> tuple[int, int, list[tuple[int, int]]]:
    """Return rows, columns and places of panels: a row for each probe, if that leaves few places empty."""
    probes, labels = (list(dict.fromkeys(each)) for each in zip(*names, strict=True))
    if len(probes) > 1 and len(labels) > 1 and 3 * len(probes) * len(labels) <= 4 * len(names):
        return len(probes), len(labels), [(probes.index(probe), labels.index(label)) for probe, label in names]
    columns = 1 if len(names) <= 3 else 2 if len(names) <= 8 else 3
    rows = -(-len(names) // columns)
    return rows, columns, [divmod(number, columns) for number in range(len(names))]


def _draw(chart: Chart, axes: Any, panel: _Panel) -> None:
    parts = _components(panel.values, panel.scale)
    shown = [name for name, _ in parts]
    curves = [
        Curve(name, values, {"color": COLOURS["xyz".index(name)]}, f"{panel.key}.{name}") for name, values in parts
    ]
    for name in shown if panel.exact is not None else ():
        label, values = "closed form" if name == shown[0] else f"_{name}", panel.exact[:, "xyz".index(name)]
        curves.append(Curve(label, values, REFERENCE, f"{panel.key}.{name} closed form"))
    factor, _ = chart.curves(axes, panel.label, panel.unit, curves, panel.title, panel.label)
    if panel.nodes is not None:
        every = max(1, len(panel.nodes) // 3000)
        time = chart.time[::every] * chart.factor
        for name in shown:
            k = "xyz".index(name)
            low, high = (factor * pick(panel.nodes[::every, :, k], axis=1) for pick in (np.min, np.max))
            axes.fill_between(time, low, high, color=COLOURS[k], alpha=0.15, linewidth=0)


def _components(values: np.ndarray, scale: float = 0.0) -> list[tuple[str, np.ndarray]]:
    """Return named components of (n, 3) that are not zero up to rounding; all, as zero, if all are.

    Rounding is relative to the largest value, or to ``scale`` if the vector is a difference of larger ones.
    """
    floor = _ROUNDING * max(float(np.nanmax(np.abs(values), initial=0.0)), scale)
    curves = [(name, values[:, k]) for k, name in enumerate("xyz")]
    kept = [(name, v) for name, v in curves if np.nanmax(np.abs(v), initial=0.0) > floor]
    return kept or [(name, np.zeros_like(v)) for name, v in curves]


def _tell(chart: Chart, still: Sequence[_Panel], more: str = "") -> None:
    """Say below the panels what has none because it does not change."""
    zero: dict[str, list[str]] = {}
    constant = []
    for panel in still:
        label, probe = panel.label.partition(",")[0], panel.title.partition(",")[0]
        mean = np.nanmean(panel.values, axis=0) if len(panel.values) else np.zeros(3)
        if np.abs(mean).max() <= _ROUNDING * panel.scale:
            zero.setdefault(probe, []).append(label)
        else:
            name = f"{label} of {probe}" if probe else label
            constant.append(f"{name} ({', '.join(f'{part:.4g}' for part in mean + 0.0)}) {panel.unit}")
    names = [" and ".join(labels) + (f" of {probe}" if probe else "") for probe, labels in zero.items()]
    text = more + (f"Zero throughout: {', '.join(names)}. " if zero else "")
    text += f"Constant: {', '.join(constant)}." if constant else ""
    if text:
        chart.note(text.strip())
