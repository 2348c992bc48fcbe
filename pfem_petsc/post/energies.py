"""Curves of the energies and of their balance."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..output.units import engineering
from .chart import COLOURS, REFERENCE, Chart, thinned
from .closed_forms import ClosedForm
from .curves import History, make_chart, read, words

__all__ = ["balance_error", "draw_energies"]

_NOTE_WIDTH = 100  # characters of a line above the axes


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
    pairs = [(words(name), values) for name, values in moving.items()]
    styles: list[dict[str, Any]] = [{"color": colours[name]} for name in moving]
    keys = list(moving)
    for name in moving if exact is not None else ():
        if name in exact.columns:
            first = not any(label == exact.name for label, _ in pairs)
            pairs.append((exact.name if first else f"_{name}", exact.columns[name]))
            styles.append(REFERENCE)
            keys.append(f"{name} closed form")
    chart.curves(middle, "energy", "J", pairs, styles=styles, keys=keys, quantity="energy")
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
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, handlelength=1.4)
