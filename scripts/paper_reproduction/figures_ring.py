"""Figures 12 to 14: displacement of two nodes of the ring, and its deformed shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from pages import save

from .figures import DPI, finish, new_figure, styled
from .running import Run
from .schemes import LIKELY, PAPER, SCHEMES
from .studies import INSTANTS, RING_STEPS, ring_key

WALL = 22.93  # [m]
STRAIN = LinearSegmentedColormap.from_list("strain", ["#1f4e9c", "#7a4fbf", "#d9482b", "#f2a33a"])


@styled
def _displacement(runs: dict[str, Run], file: Path, number: int, step: str) -> None:
    figure = new_figure(9.4, 4.3)
    panels = figure.subplots(1, 2)
    nodes = (("impact", "(a) node 1, the vertex that hits"), ("opposite", "(b) node 2, the opposite vertex"))
    for axes, (probe, title) in zip(panels, nodes):
        for scheme in [scheme for scheme in SCHEMES if scheme in PAPER]:
            run = runs[ring_key(scheme, LIKELY, step)]
            x = run.history[f"probe/{probe}/position"][:, 0, 0]
            axes.plot(run.time * 1e3, x - x[0], **SCHEMES[scheme].style)
        axes.set_title(title)
        axes.set_xlabel("time [ms]")
        axes.set_ylabel("horizontal displacement [m]")
        axes.set_xlim(0.0, 200.0)
    panels[0].axhline(0.1, color="#111418", linewidth=1.0, linestyle=(0, (5, 3)))
    panels[0].annotate("wall", (199.0, 0.1), xytext=(0, 3), textcoords="offset points", ha="right", fontsize=9)
    name = f"Figure {number}. Ring against a wall, reconstructed geometry: Δt = {RING_STEPS[step] * 1e3:g} ms"
    finish(figure, file, name, [], columns=3)


@styled
def _shapes(runs: dict[str, Run], file: Path) -> None:
    figure = new_figure(9.4, 6.6)
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    run = runs[ring_key("central_differences", LIKELY, "0.05")]
    start = runs["ring/first_step"].result
    rest, bars = start.positions(0)[:, :2], start.bars
    colours = None
    for axes, instant, letter in zip(panels.flat, INSTANTS, "abcdef"):
        result = start if instant == INSTANTS[0] else run.result
        snapshot = int(np.argmin(np.abs(result.times - instant)))
        assert np.isclose(result.times[snapshot], instant, rtol=1e-9)
        points = result.positions(snapshot)[:, :2]
        plastic = np.abs(result.field("plastic_strain", snapshot))
        # the ring is empty: its middle has room for the zone of impact
        close = axes.inset_axes((0.24, 0.27, 0.4, 0.46))
        for part, width in ((axes, 0.8), (close, 1.2)):
            part.add_collection(LineCollection(rest[bars], colors="#b9c0ca", linewidths=0.6))
            colours = LineCollection(points[bars], cmap=STRAIN, linewidths=width, clim=(0.0, 0.16))
            colours.set_array(plastic)
            part.add_collection(colours)
            part.axvline(WALL, color="#5b6472", linewidth=1.6)
            part.axvspan(WALL, WALL + 4.0, color="#eceef1", zorder=0)
            part.grid(False)
        close.set_xlim(19.6, 23.6)
        close.set_ylim(-11.0, 11.0)
        close.tick_params(labelsize=7, length=2)
        close.spines[["top", "right"]].set_visible(True)
        axes.set_title(f"({letter}) t = {instant:.5f} s" if instant < 1e-3 else f"({letter}) t = {instant:.2f} s")
        axes.set_aspect("equal")
    panels[0, 0].set_xlim(-24.5, 25.5)
    panels[0, 0].set_ylim(-27.0, 27.0)
    for axes in panels[-1]:
        axes.set_xlabel("x [m]")
    for axes in panels[:, 0]:
        axes.set_ylabel("y [m]")
    figure.colorbar(colours, ax=panels, label="size of plastic strain", shrink=0.75, pad=0.015)
    title = "Figure 14. Deformed ring (central differences, Δt = 0.05 ms; grey: at rest; inset: zone of impact)"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, fontweight="bold")
    save(figure, file, DPI)


def draw_ring(runs: dict[str, Run], folder: Path) -> list[Path]:
    """Draw figures 12 to 14."""
    _displacement(runs, folder / "figure_12.png", 12, "0.5")
    _displacement(runs, folder / "figure_13.png", 13, "0.05")
    _shapes(runs, folder / "figure_14.png")
    return [folder / f"figure_{n}.png" for n in (12, 13, 14)]
