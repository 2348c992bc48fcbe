"""Figures 3, 4 and 7 to 10: velocity of the tip and contact force of a rod or bar."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from pages import save

from pfem_petsc.post.chart import STYLE

from .claims import Measures
from .exact import BAR, PLASTIC_BAR, ROD, Rod
from .measures import tip_velocity, wall_force
from .running import Run
from .schemes import LIKELY, PAPER, SCHEMES
from .studies import bar_key, refined_key, rod_key

EXACT = {"color": "#111418", "linewidth": 2.2, "alpha": 0.55, "linestyle": "-"}
FINE = {"color": "#6b7280", "linewidth": 1.8, "alpha": 0.8, "linestyle": (0, (4, 1.5))}
DPI = 130


def styled(draw: Callable) -> Callable:
    """Decorator: draw in the project's style."""

    def wrapped(*arguments: Any) -> Any:
        with rc_context(STYLE):
            return draw(*arguments)

    return wrapped


def new_figure(width: float, height: float) -> Figure:
    """A figure [inch] that needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finish(figure: Figure, file: Path, title: str, extra: list[tuple[str, dict]], columns: int = 4) -> None:
    """Write a figure with its title, and with the paper's schemes and more below the panels, where they cover
    nothing."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    handles = [Line2D([], [], label=label, **style) for label, style in extra]
    for entry in (SCHEMES[scheme] for scheme in PAPER):
        handles.append(Line2D([], [], label=entry.name, **(entry.style | {"linewidth": entry.width + 0.4})))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=2.2, columnspacing=1.6)
    save(figure, file, DPI)


def _curves(
    axes: Axes, runs: dict[str, Run], keys: dict[str, str], values: Callable, scale: tuple[float, float]
) -> None:
    """One curve a scheme; ``scale`` multiplies time and value."""
    for scheme in (scheme for scheme in SCHEMES if scheme in PAPER):
        run = runs[keys[scheme]]
        if run.history:
            axes.plot(run.time * scale[0], values(run) * scale[1], **SCHEMES[scheme].style)


@styled
def draw_rod(runs: dict[str, Run], file: Path, force: bool) -> None:
    """Figure 3 or 4: the whole history, and the first moments of contact."""
    figure = new_figure(9.4, 4.3)
    wide, close = figure.subplots(1, 2, width_ratios=[1.7, 1.0])
    keys = {scheme: rod_key(scheme, LIKELY) for scheme in PAPER}
    for axes in (wide, close):
        corners = ROD.contact_force(5.0) if force else ROD.tip_velocity(5.0)
        axes.plot(*corners, **EXACT)
        _curves(axes, runs, keys, wall_force if force else tip_velocity, (1.0, 1.0))
        axes.set_xlabel("time")
    wide.set_ylabel("contact force" if force else "velocity of the impacted node")
    wide.set_title("whole history")
    close.set_title("first contact")
    wide.set_xlim(0.0, 3.0 if force else 5.0)
    close.set_xlim(0.06, 0.34)
    if not force:
        wide.set_ylim(-0.9, 0.6)
        close.set_ylim(-0.62, 0.62)
    title = (
        "Figure 4. Rod against a wall: contact force" if force else "Figure 3. Rod against a wall: velocity of the tip"
    )
    finish(figure, file, title, [("exact", EXACT)])


@styled
def draw_bars(runs: dict[str, Run], file: Path, number: int, plastic: bool, force: bool) -> None:
    """Figures 7 to 10: panel (a) the small, (b) the large step."""
    exact: Rod = PLASTIC_BAR if plastic else BAR
    figure = new_figure(9.4, 6.4)
    panels = figure.subplots(2, 1, sharex=True, sharey=not force)
    scale = (1e6, 1e-3 if force else 1.0)
    values = wall_force if force else tip_velocity
    extra = [("exact", EXACT)]
    fine = runs[refined_key("bar_collision_plastic", "central_differences", LIKELY, 320)]
    if plastic:
        extra = [("exact, to the end of the plateau", EXACT), ("320 bars, 31 ns", FINE)]
    end = 190.0 if force and plastic else 130.0 if force else 250.0
    for axes, (name, letter) in zip(panels, (("0.5", "a"), ("2", "b"))):
        if plastic:
            # the coarse mesh cannot show the fine one's ringing: its mean over a step of the panel
            axes.plot(*_smoothed(fine.time * 1e6, values(fine) * scale[1], 2.0), **FINE)
        corners = exact.contact_force(2.5e-4) if force else exact.tip_velocity(2.5e-4)
        axes.plot(corners[0] * scale[0], corners[1] * scale[1], **EXACT)
        keys = {scheme: bar_key(scheme, LIKELY, name, plastic) for scheme in PAPER}
        _curves(axes, runs, keys, values, scale)
        axes.set_title(f"({letter}) Δt = {name} µs")
        axes.set_ylabel("contact force [kN]" if force else "velocity of the impacted node [m/s]", fontsize=9)
        axes.set_xlim(0.0, end)
    if not force:
        panels[0].set_ylim(-5.2 if plastic else -9.0, 6.2)
    panels[-1].set_xlabel("time [µs]")
    what = "contact force" if force else "velocity of the impacted node"
    kind = "elastoplastic" if plastic else "elastic"
    finish(figure, file, f"Figure {number}. Two {kind} bars: {what}", extra)


def _smoothed(time: np.ndarray, values: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    rows = max(round(width / (time[1] - time[0])), 1)
    kernel = np.full(rows, 1.0 / rows)
    return time[rows - 1 :] - 0.5 * width, np.convolve(values, kernel, mode="valid")


@styled
def draw_phases(readings: list[Measures], file: Path) -> None:
    """Variation of the tip's velocity, and energy left, over where in the time step the impact falls."""
    figure = new_figure(9.4, 6.4)
    panels = figure.subplots(2, len(readings), sharex=True, sharey="row", squeeze=False)
    for column, measures in enumerate(readings):
        for scheme in (scheme for scheme in SCHEMES if scheme in PAPER):
            style, rods = SCHEMES[scheme].style, measures.phases[scheme]
            x = [phase / len(rods) for phase, rod in enumerate(rods) if rod is not None]
            ended = [rod for rod in rods if rod is not None]
            panels[0, column].plot(x, [rod.excess for rod in ended], marker="o", markersize=3, **style)
            panels[1, column].plot(x, [rod.energy for rod in ended], marker="o", markersize=3, **style)
        panels[0, column].set_title(measures.reading.name)
        panels[1, column].set_xlabel("impact within the step")
    panels[0, 0].set_ylabel("variation beyond the jump [v₀]")
    panels[1, 0].set_ylabel("energy left")
    finish(figure, file, "Rod: what depends on the phase of the impact", [])


def draw_rods(runs: dict[str, Run], readings: list[Measures], folder: Path) -> list[Path]:
    """Draw figures 3, 4, 7 to 10, and that of the study of phases."""
    draw_rod(runs, folder / "figure_03.png", False)
    draw_rod(runs, folder / "figure_04.png", True)
    for number, plastic, force in ((7, False, False), (8, True, False), (9, False, True), (10, True, True)):
        draw_bars(runs, folder / f"figure_{number:02d}.png", number, plastic, force)
    draw_phases(readings, folder / "phases.png")
    return [*(folder / f"figure_{n:02d}.png" for n in (3, 4, 7, 8, 9, 10)), folder / "phases.png"]
