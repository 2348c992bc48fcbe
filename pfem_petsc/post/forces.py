"""Curves of the forces of walls, of contact pairs, and of constraints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..output.units import TIME, engineering
from .chart import COLOURS, Chart, literal, window_mean

__all__ = ["draw_forces"]

WINDOW = 0.02  # width of the moving average of forces, relative to the run


def draw_forces(
    history: Mapping[str, np.ndarray], source: str, walls: Iterable[Any], title: str, file: Path
) -> Path | None:
    """Draw the forces of all walls, or of all pairs or constraints, and the nodes in contact where they are counted."""
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
    rows, heights = sum(3 if c else 2 for c in counted), [h for c in counted for h in (0.9, 0.9, 0.5)[: 2 + c]]
    chart = Chart(time, title, rows, heights=heights, axis=getattr(history, "axis", TIME))
    panels = iter(chart.axes[:, 0])
    width = WINDOW * float(time[-1] - time[0])
    for name, counts in zip(names, counted, strict=True):
        # peaks (the inertia of a node that is stopped within a step) and means need different scales
        force = np.asarray(history[f"{source}/{name}/force"], dtype=float)
        if name in normals:
            values, label = force @ normals[name] / np.linalg.norm(normals[name]), "normal force"
        else:
            values, label = np.linalg.norm(force, axis=1), "force"
        smooth = window_mean(time, values, width)
        heading = f"{source.capitalize()} '{name}'"
        chart.curves(next(panels), label, "N", [("as computed", values)], heading, [{"linewidth": 0.9}])
        mean = f"{label},\nmean of the\n{engineering(width, 's', 3)} before"
        chart.curves(next(panels), mean, "N", [("mean", smooth)], styles=[{"linewidth": 1.6}])
        if counts:
            chart.counts(next(panels), "nodes in\ncontact", history[f"{source}/{name}/contacts"], COLOURS[1])
    if silent:
        _note(chart.axes[0, 0], "no force throughout: " + ", ".join(f"'{name}'" for name in silent))
    return chart.save(file)


def _note(axes: Any, text: str) -> None:
    axes.annotate(literal(text), (1.0, 1.02), xycoords="axes fraction", fontsize=8, color="#5b6472", ha="right")
