"""Pictures of trusses, cases and results in notebooks, found by name by what is shown."""

from __future__ import annotations

import base64
import io
import math
import tempfile
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, PfemError
from .camera import aim
from .chart import STYLE, boxes_allowed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..case.schema import Case
    from ..mesh.truss import Truss
    from ..output.result import Result

__all__ = ["figure_of_history", "of_case", "of_result", "of_truss", "picture", "png"]

MOST_BARS = 50_000
"""Number of bars up to which a case or a truss is drawn when it is shown."""

_SIZE = (640, 360)


def png(figure: Figure, dpi: float = 100) -> bytes:
    """Return a figure of matplotlib as PNG, with so many pixels per inch."""
    made = io.BytesIO()
    with boxes_allowed():
        figure.savefig(made, format="png", dpi=dpi)
    return made.getvalue()


def picture(points: np.ndarray, bars: np.ndarray, size: tuple[int, int] = _SIZE) -> bytes:
    """Return bars as lines, as PNG; nothing but matplotlib is needed.

    Parameters
    ----------
    points : (nodes, 3) [m]
    bars : (bars, 2) nodes at their ends
    size : in pixels
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    camera = aim(points, bounds, [], "auto", size[0] / size[1])
    flat = np.stack([(points - camera.centre) @ camera.right, (points - camera.centre) @ camera.up], axis=1)
    if not camera.parallel:
        flat *= (camera.distance / (camera.distance - (points - camera.centre) @ camera.towards))[:, None]
    figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.03, 0.03, 0.94, 0.94))
    width = float(np.clip(60.0 / np.sqrt(max(len(bars), 1)), 0.4, 1.8))
    axes.add_collection(LineCollection(flat[bars], colors="#2563b0", linewidths=width))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    return png(figure)


def figure_of_history(result: Result, names: list[str] | None = None) -> Figure:
    """Return curves of columns of the history over time; default: the energies that occur."""
    import matplotlib

    from ..columns import ENERGIES
    from ..output.units import unit_of
    from .chart import Chart

    table = result.table(names)
    if names is None:
        names = [
            each.name for each in ENERGIES if each.name in table and np.abs(table[each.name]).max(initial=0.0) > 0.0
        ]
    else:
        names = [name for name in table if name not in ("step", "time")]
    units = {unit_of(name.partition("[")[0].rpartition("/")[2].partition(".")[0]) for name in names}
    with matplotlib.rc_context(STYLE):
        chart = Chart(table["time"], "", 1, axis=result.axis)
        curves = [(name, table[name]) for name in names]
        if curves:
            chart.curves(chart.axes[0, 0], "energy" if units == {"J"} else "", units.pop(), curves)
        chart.figure.set_size_inches(6.4, 3.0)
    return chart.figure


def _image(data: bytes) -> str:
    return f'<img src="data:image/png;base64,{base64.b64encode(data).decode()}" style="max-width: 100%"/>'


def _list(entries: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><td style="text-align: left">{escape(label)}</td><td style="text-align: left">{escape(text)}</td></tr>'
        for label, text in entries.items()
    )
    return f"<table>{rows}</table>"


def of_truss(truss: Truss) -> str:
    """Return number of nodes and bars, groups, and a picture."""
    entries = {"nodes": f"{truss.n_nodes:,}", "bars": f"{truss.n_bars:,}"}
    if truss.points is None:
        return _list(entries)
    for label, groups in (("node groups", truss.node_groups), ("bar groups", truss.bar_groups)):
        if groups:
            entries[label] = ", ".join(f"{name} ({len(members):,})" for name, members in groups.items())
    if truss.bar_fields:
        entries["bar fields"] = ", ".join(truss.bar_fields)
    drawn = _image(picture(truss.points, truss.bars)) if truss.n_bars <= MOST_BARS else ""
    return _list(entries) + drawn


def of_case(case: Case) -> str:
    """Return what a case computes, and a picture of its mesh."""
    mesh = case.mesh
    entries = {"case": case.title, "mesh": str(mesh.file) if mesh.file else str(mesh.generator)}
    for key in ("material", "section", "node_set"):
        entries[key] = ", ".join(getattr(case, key))
    for key in ("support", "load", "wall", "contact_pair", "constraint"):
        if getattr(case, key):
            entries[key] = str(len(getattr(case, key)))
    for stage in case.stages:
        label = stage.name if case.stage else "analysis"
        if stage.time is not None:
            step = stage.time.step if isinstance(stage.time.step, str) else f"{stage.time.step:g} s"
            entries[label] = f"{stage.time.integrator}, step {step}, end {stage.time.end:g} s"
        elif stage.static is not None:
            entries[label] = f"static, {stage.static.method}"
    if case.modes is not None:
        entries["modes"] = f"{case.modes.count} of {case.modes.kind}"
    try:
        slab = _mesh_of(case)
    except PfemError as error:
        return _list(entries) + f"<p>{escape(str(error))}</p>"
    return _list(entries) + ("" if slab is None else _image(picture(slab.points, slab.bars)))


def _mesh_of(case: Case) -> Any:
    """Return the mesh of a case if it is small, else None."""
    from mpi4py import MPI

    from ..mesh import load_slab
    from ..registry import lookup

    mesh = case.mesh
    if mesh.file is not None:
        few = mesh.file.is_file() and mesh.file.stat().st_size <= 100 * MOST_BARS
    elif not mesh.arranged:
        few = mesh.truss is not None and mesh.truss.points is not None and mesh.truss.n_bars <= MOST_BARS
    else:
        generator = lookup("pfem_petsc.mesh.generators", mesh.generator, "")
        cells = getattr(mesh.parameters, "cells", None)
        if hasattr(generator, "generate_on"):
            few = cells is not None and math.prod(cells) <= MOST_BARS // 50
        else:  # a small part of the mesh has the number of all bars
            few = generator.generate(mesh.parameters, 0, 1000).n_bars <= MOST_BARS
    return load_slab(mesh, MPI.COMM_SELF) if few else None


def of_result(result: Result) -> str:
    """Return what a result has, a picture of its last snapshot, and its energies."""
    entries = {
        "result": str(result.path),
        "mesh": f"{result.n_nodes:,} nodes, {result.n_bars:,} bars",
        "snapshots": str(len(result.times)),
        "history": f"{result.history.n_rows} rows",
    }
    drawn = [_image(_snapshot(result))] if len(result.times) else []
    if result.history.n_rows > 1:
        drawn.append(_image(png(figure_of_history(result))))
    return _list(entries) + "<br/>".join(drawn)


def _snapshot(result: Result) -> bytes:
    """Return the last snapshot as PNG, by lines where there is no library to draw with."""
    from .render import render

    with tempfile.TemporaryDirectory() as folder:
        options: dict[str, Any] = {"video": "none", "poster": False, "size": _SIZE, "note": lambda text: None}
        field = "stress" if "stress" in result.cell_fields else next(iter(result.cell_fields + result.point_fields), "")
        try:
            (file,) = render(result, folder, field=field, frames=[len(result.times) - 1], **options)
            return Path(file).read_bytes()
        except InputError:
            return picture(result.positions(-1), result.bars)
