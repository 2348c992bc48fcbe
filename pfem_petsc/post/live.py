"""Curves of a running simulation: a function for :meth:`~pfem_petsc.simulation.Simulation.on_step`."""

from __future__ import annotations

from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..output.bar import is_notebook
from ..output.table import flat_columns
from ..registry import nearest
from .chart import COLOURS, STYLE, png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..analysis import Step


class LivePlot:
    """Curves of columns of the history, redrawn during a run: ``simulation.on_step(LivePlot("kinetic_energy"), 10)``.

    In a notebook the picture below the cell is updated; elsewhere a file is written, if one is given. Steps that are
    not recorded (``output.history_every``) are omitted. Only rank 0 draws.

    Parameters
    ----------
    names : columns of the history; vectors are drawn as three curves
    interval : minimum time between two updates [s]
    file : PNG file that is written at each update

    Attributes
    ----------
    times : list of float, times of the rows so far [s]
    columns : lists of their values, by name
    """

    def __init__(self, *names: str, interval: float = 1.0, file: Path | str | None = None) -> None:
        from mpi4py import MPI

        if not names:
            raise InputError("LivePlot: give the names of columns of the history, as in LivePlot('kinetic_energy')")
        self.names, self.interval = names, interval
        self.file = None if file is None else Path(file)
        self.times: list[float] = []
        self.columns: dict[str, list[float]] = {}
        self._draws = MPI.COMM_WORLD.rank == 0
        self._last = -np.inf
        self._handle: Any = None

    def __call__(self, step: Step) -> None:
        """Add the row of a step, and update the picture if that is due."""
        if step.row is None:
            return
        for name in self.names:  # on all ranks, so that all raise
            if name not in step.row:
                raise InputError(f"LivePlot: the history has no column {name}{nearest(name, list(step.row))}")
        for name in self.names if self._draws else ():
            for key, value in flat_columns(name, np.asarray(step.row[name], dtype=float)[None]).items():
                self.columns.setdefault(key, []).append(float(value[0]))
        self.times.append(step.time)
        if self._draws and monotonic() - self._last >= self.interval:
            self.draw()

    @property
    def figure(self) -> Figure:
        """The curves so far."""
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=(6.4, 3.0), layout="constrained")
            FigureCanvasAgg(figure)
            axes = figure.add_subplot()
            for k, (name, values) in enumerate(self.columns.items()):
                axes.plot(self.times, values, label=name, color=COLOURS[k % len(COLOURS)])
            axes.set_xlabel("time [s]")
            if self.columns:
                axes.legend()
        return figure

    def draw(self) -> None:
        """Update the picture, or write the file."""
        import sys

        data = png(self.figure)
        if self.file is not None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_bytes(data)
        if is_notebook(sys.stdout):
            from IPython.display import Image, display

            if self._handle is None:
                self._handle = display(Image(data=data), display_id=True)
            else:
                self._handle.update(Image(data=data))
        self._last = monotonic()

    def _repr_png_(self) -> bytes:
        return png(self.figure)
