"""Curves of a result's history."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..output.units import TIME
from .chart import STYLE, Chart, check_formats, opened
from .closed_forms import closed_form
from .curves import History, draw_curves, draw_spectra, usual_curves
from .filters import WINDOWS, Filter, make_filter
from .forces import draw_force_displacement, draw_forces
from .histories import draw_energies, draw_momentum, draw_probes, draw_solver


@dataclass(frozen=True)
class Options:
    """Options of :func:`plot`.

    Parameters
    ----------
    curves : names of history columns, drawn into ``curves.png`` instead of the other pictures; an existing
        ``curves.png`` is kept, and the new one is ``curves_2.png`` and so on
    formats : of :data:`~pfem_petsc.post.chart.FORMATS`; "csv" writes a table of each picture, with all rows in SI
        units, and, without curves, ``history.csv``
    force_filter : of the forces of walls and others, and of the curves with which it is given: see
        :func:`~pfem_petsc.post.filters.make_filter`; None: the mean of the last 2 % of the run, for forces alone
    against : column or component, like ``probe/tip/position.x``, over which the curves are drawn instead of time
    spectrum : names of history columns whose amplitude spectra are drawn into ``spectra.png`` instead
    window : of the spectra, one of :data:`~pfem_petsc.post.filters.WINDOWS`
    highest : frequency [Hz] at which the spectra end; None: half the sampling rate
    closed_forms : whether closed forms are drawn where the case has one

    Raises
    ------
    InputError
        For an unknown format or window, and options that exclude each other.
    """

    curves: Iterable[str] | None = None
    formats: Iterable[str] = ("png",)
    force_filter: str | None = None
    against: str | None = None
    spectrum: Iterable[str] | None = None
    window: str = "hann"
    highest: float | None = None
    closed_forms: bool = True

    def __post_init__(self) -> None:
        if self.spectrum is not None and (self.curves is not None or self.against is not None):
            raise InputError("plot: spectrum is a picture of its own: give it without curves and against")
        if self.against is not None and self.curves is None:
            raise InputError(f"plot: against = {self.against!r} needs curves, the columns to draw over it")
        if self.window not in WINDOWS:
            raise InputError(f"plot: window = {self.window!r} is not known; it is one of {', '.join(WINDOWS)}")
        object.__setattr__(self, "formats", check_formats(self.formats))


def plot(result_path: Path | str | Any | Sequence[Any], output: Path | str | None = None, **options: Any) -> list[Path]:
    """Draw the history: ``energies.png``, ``momentum.png``, ``probes.png``, ``walls.png``, ``solver.png`` and others.

    Parameters
    ----------
    result_path : result file or its folder, or an open result; several of them are drawn over each other, into
        ``comparison.png`` without ``curves``
    output : folder of the pictures; None: beside the (first) result
    options : see :class:`Options`

    Returns
    -------
    The files written; there is none for what the result lacks (probes, walls, ``pairs.png``, ``constraints.png``,
    iterations).

    Raises
    ------
    InputError
        For a column that the history does not have (with the nearest name), an empty history, an unknown format, filter
        or window, options that exclude each other, or a folder that cannot be written.
    """
    import matplotlib

    several = isinstance(result_path, Sequence) and not isinstance(result_path, str)
    paths = list(result_path) if several else [result_path]
    given = Options(**options)
    suffixes = given.formats
    chosen = make_filter(given.force_filter) if given.force_filter is not None else None
    if not paths:
        raise InputError("plot: no result named")
    with ExitStack() as stack, matplotlib.rc_context(STYLE):
        results = [stack.enter_context(opened(path)) for path in paths]
        folder = Path(output) if output is not None else Path(results[0].path).parent
        for result in results:
            if "time" not in result.history or len(result.history["time"]) == 0:
                raise InputError(
                    f"{result.path}: the history is empty: nothing to plot; set [output] history_every >= 1"
                )
            if chosen is not None and result.axis is not TIME:
                raise InputError(
                    f"{result.path}: filter = {given.force_filter!r} needs a run over time, not a static analysis"
                )
        if given.spectrum is not None:
            chart = draw_spectra(results, list(given.spectrum), given.window, given.highest)
            return chart.save(_free(folder / "spectra", suffixes), suffixes)
        if given.curves is not None:
            chart = draw_curves(results, list(given.curves), given.against, chosen, given.closed_forms)
            return chart.save(_free(folder / "curves", suffixes), suffixes)
        if len(results) > 1:
            chart = draw_curves(results, usual_curves(results), None, chosen, given.closed_forms)
            return chart.save(folder / "comparison", suffixes)
        (result,) = results
        return _usual(result, folder, suffixes, chosen, given.closed_forms)


def _usual(
    result: Any, folder: Path, suffixes: tuple[str, ...], chosen: Filter | None, closed_forms: bool
) -> list[Path]:
    """The pictures of a single result."""
    history: History = result.history
    case = result.case
    title = case.title or case.name
    exact = closed_form(result) if closed_forms else None
    drawn: dict[str, Chart | None] = {
        "energies": draw_energies(history, title, exact),
        "momentum": draw_momentum(history, title, exact) if result.axis is TIME else None,
        "probes": draw_probes(history, title, exact),
        "walls": draw_forces(history, "wall", case.every_wall, title, chosen, exact),
        "pairs": draw_forces(history, "pair", (), title, chosen),
        "constraints": draw_forces(history, "constraint", (), title, chosen),
        "force_displacement": draw_force_displacement(result, title, chosen, exact),
        "solver": draw_solver(history, title),
    }
    written = [path for name, chart in drawn.items() if chart for path in chart.save(folder / name, suffixes)]
    if "csv" in suffixes and hasattr(result, "table"):
        written.append(result.table().to_csv(folder / "history.csv"))
    return written


def _free(file: Path, suffixes: Sequence[str]) -> Path:
    """Return the file name without suffix, with the next free number if it exists in one of the formats."""
    numbered = (file.with_name(f"{file.name}_{k}") for k in itertools.count(2))
    free = (p for p in itertools.chain([file], numbered) if not any(Path(f"{p}.{s}").exists() for s in suffixes))
    return next(free)
