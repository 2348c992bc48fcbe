"""The usual pictures of a history: energies and their balance, momentum, probes, and iterations."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..output.units import engineering, unit_of
from .chart import COLOURS, REFERENCE, Chart, Curve, legend_beside, thinned
from .closed_forms import ClosedForm
from .curves import History, make_chart, read, words

_NOTE_WIDTH = 100  # characters of a line above the axes
_ROUNDING = 1e-9
"""Change of a curve below which it is constant, relative to the largest number of its quantity in the picture."""

_QUANTITIES = ("position", "velocity", "reaction")
"""Of probes that have panels; accelerations in impacts are mostly noise."""


def balance_error(history: History) -> np.ndarray | None:
    """Return the imbalance of stored, lost and supplied energies since the first row, (n,) [J]; None without them."""
    signs = {**dict.fromkeys((*STORED, *LOST), 1.0), **dict.fromkeys(SUPPLIED, -1.0)}
    parts = [sign * read(history, name) for name, sign in signs.items() if name in history]
    if not parts:
        return None
    total = np.sum(parts, axis=0)
    return total - total[0]


def draw_energies(history: History, title: str, exact: ClosedForm | None) -> Chart | None:
    """Stacked stored and lost energies with what was supplied, the terms one by one, and the balance."""
    error = balance_error(history)
    if error is None:
        return None
    held = {name: read(history, name) for name in (*STORED, *LOST, *SUPPLIED) if name in history}
    largest = max(float(np.nanmax(np.abs(values))) for values in held.values())
    moving = {name: values for name, values in held.items() if np.abs(values).max() > 1e-12 * largest}
    still = [words(name) for name in held if name not in moving]
    chart = make_chart(history, title, 3, heights=(1.3, 1.3, 0.7))
    upper, middle, lower = chart.axes[:, 0]
    colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(moving)}
    chart.share("energy", "J", [largest])
    _stack(chart, upper, {n: v for n, v in moving.items() if n not in SUPPLIED}, held, colours)
    curves = [Curve(words(name), values, {"color": colours[name]}, name) for name, values in moving.items()]
    known = [] if exact is None else [name for name in moving if name in exact.columns]
    for name in known:
        label = exact.name if name == known[0] else f"_{name}"
        curves.append(Curve(label, exact.columns[name], REFERENCE, f"{name} closed form"))
    chart.curves(middle, "energy", "J", curves, quantity="energy")
    legend_beside(middle)
    if still:
        text = textwrap.fill("zero throughout: " + ", ".join(still), _NOTE_WIDTH)
        note = upper.annotate(text, (0, 1.02), xycoords="axes fraction", fontsize=8, color="#5b6472", va="bottom")
        note.set_in_layout(False)  # a long line must not take the width of the axes; the title makes the height for it
        upper.set_title("\n" * text.count("\n"), fontsize=9)
    _balance(chart, lower, error, largest)
    return chart


def _balance(chart: Chart, axes: Any, error: np.ndarray, largest: float) -> None:
    """The error as a share of the largest energy, so that neither a prefix nor a unit hides how small it is."""
    axes.plot(*thinned(chart.time * chart.factor, error / (largest or 1.0)), color=COLOURS[1])
    chart.record("balance error", error, "J")
    axes.set_ylabel("balance error,\nshare of largest" if largest > 0.0 else "balance error [J]")
    worst = float(np.nanmax(np.abs(error))) / (largest or 1.0)
    text = f"at most {worst:.1e}\nof {engineering(largest, 'J')}" if worst > 0.0 else "zero"
    axes.annotate(text, (1.01, 0.5), xycoords="axes fraction", fontsize=9, color="#5b6472", va="center")


def _stack(
    chart: Chart, axes: Any, parts: Mapping[str, np.ndarray], held: Mapping[str, np.ndarray], colours: Mapping[str, str]
) -> None:
    """Areas of the stored and lost energies on each other, and the line up to which the balance fills them."""
    total = np.sum([values for name, values in held.items() if name not in SUPPLIED], axis=0)
    supplied = np.sum([values for name, values in held.items() if name in SUPPLIED], axis=0)
    available = total[0] + supplied - (supplied[0] if np.ndim(supplied) else 0.0)
    available = np.broadcast_to(available, total.shape)
    factor, shown = chart.scale("energy")
    every = max(1, len(total) // 3000)
    time = chart.time[::every] * chart.factor
    above, below = np.zeros(len(time)), np.zeros(len(time))
    # supplied energies have no area; negative parts hang below zero
    for name, values in parts.items():
        thin = values[::every] * factor
        up, down = np.maximum(thin, 0.0), np.minimum(thin, 0.0)
        axes.fill_between(time, above, above + up, color=colours[name], linewidth=0, label=words(name), alpha=0.85)
        if down.any():
            axes.fill_between(time, below, below + down, color=colours[name], linewidth=0, alpha=0.85)
        above, below = above + up, below + down
    label = "at the start + supplied" if np.any(supplied) else "at the start"
    thin = available[::every] * factor
    axes.plot(time, thin, color="#1f242c", linewidth=1.2, linestyle=(0, (4, 2)), label=label)
    chart.record("stored and lost", total, "J")
    chart.record("at the start and supplied", available, "J")
    axes.set_ylabel(f"stored and lost,\nstacked [{shown}]")
    legend_beside(axes)


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
    shown, still = _moving(panels)
    return _draw_panels(history, title, shown, still, np.arange(len(shown))[:, None]) if shown else None


def draw_probes(history: History, title: str, exact: ClosedForm | None) -> Chart | None:
    """Draw displacement, velocity and reaction of each probe, without those that do not change."""
    found = [name.split("/") for name in history if name.startswith("probe/") and name.endswith(_QUANTITIES)]
    probes = list(dict.fromkeys("/".join(parts[1:-1]) for parts in found))
    columns = [(probe, each, f"probe/{probe}/{each}") for probe in probes for each in _QUANTITIES]
    every = [
        _of_probe(probe, each, read(history, name), exact, name) for probe, each, name in columns if name in history
    ]
    if not every:
        return None
    shown, still = _moving(every)
    shown, still = (shown, still) if shown else (every, [])  # probes are asked for
    return _draw_panels(history, title, shown, still, _grid([(panel.title, panel.label) for panel in shown]))


def _draw_panels(
    history: History, title: str, shown: Sequence[_Panel], still: Sequence[_Panel], places: np.ndarray
) -> Chart:
    """Draw panels in a grid (rows, columns) of their numbers, -1 for none, and name those that do not change."""
    rows, columns = places.shape
    chart = make_chart(history, title, rows, columns, None if shown[0].title else [0.9] * rows)
    for label in dict.fromkeys(panel.label for panel in shown):
        own = [panel for panel in shown if panel.label == label]
        chart.share(label, own[0].unit, [panel.size for panel in own])
    for place, number in np.ndenumerate(places):
        if number >= 0:
            _draw(chart, chart.axes[place], shown[number])
    chart.leave_out([place for place in np.ndindex(rows, columns) if places[place] < 0])
    _tell(chart, still, "Shaded: the range of the nodes. " if any(panel.nodes is not None for panel in shown) else "")
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


def _moving(panels: Sequence[_Panel]) -> tuple[list[_Panel], list[_Panel]]:
    """Return the panels to draw, which change, or are not zero if none does, and the others.

    Rounding is relative to the largest number of panels of the same label.
    """
    for panel in panels:
        panel.scale = max(panel.scale, *(other.size for other in panels if other.label == panel.label))
    shown = [panel for panel in panels if panel.changes] or [panel for panel in panels if panel.size > 0.0]
    return shown, [panel for panel in panels if not any(panel is other for other in shown)]


def _grid(names: Sequence[tuple[str, str]]) -> np.ndarray:
    """Return the numbers of panels in rows and columns, -1 for none: a row for each probe, if few places are empty."""
    probes, labels = (list(dict.fromkeys(each)) for each in zip(*names, strict=True))
    if len(probes) > 1 and len(labels) > 1 and 3 * len(probes) * len(labels) <= 4 * len(names):
        return np.array([[names.index((p, q)) if (p, q) in names else -1 for q in labels] for p in probes])
    columns = 1 if len(names) <= 3 else 2 if len(names) <= 8 else 3
    numbers = np.arange(-(-len(names) // columns) * columns).reshape(-1, columns)
    return np.where(numbers < len(names), numbers, -1)


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


def draw_solver(history: History, title: str) -> Chart | None:
    """Draw the iterations of the steps, and the nodes in contact where no other picture has them."""
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
        chart.counts(axes, labels[name], history[name], COLOURS[number], before=name.endswith("_iterations"))
    return chart


def _is_shown(history: History) -> bool:
    """Whether the nodes in contact are those of a single wall: their number is in the picture of the walls."""
    walls = [name for name in history if name.startswith("wall/") and name.endswith("/contacts")]
    return len(walls) == 1 and np.array_equal(history[walls[0]], history["active_contacts"])
