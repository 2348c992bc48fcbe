"""The style of curves, and utilities for charts over time."""

from __future__ import annotations

import csv
import io
import itertools
import os
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..output.units import TIME, Axis, common_prefix, prefix_for

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6b7280", "#000000")
"""For colour-blind eyes (Okabe and Ito 2008), without their yellow, which is too pale for lines on white."""

FORMATS = ("png", "svg", "pdf", "csv")

REFERENCE: dict[str, Any] = {"color": "#000000", "linewidth": 1.1, "linestyle": (0, (5, 2.5)), "zorder": 3}
"""The style of closed forms."""

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "pfem_petsc",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": "#1f242c",
    "axes.edgecolor": "#5b6472",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-4, 5),
    "axes.formatter.use_mathtext": True,
    "axes.xmargin": 0.0,
    "grid.color": "#e3e6ea",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "xtick.color": "#3a3f4b",
    "ytick.color": "#3a3f4b",
    "savefig.dpi": 150,
    "figure.facecolor": "white",
}

_WIDTHS = {1: 8.6, 2: 10.4}
"""Widths of pictures by the number of columns [inch]."""
_LETTER = 0.075
"""Width of a letter of a note [inch]."""

_POINTS = 3000  # approximate maximum number of points of a curve, more than a picture has columns


class Curve(NamedTuple):
    """A curve (n,) of a panel: its name in the legend, its style, and its name in tables if that is another one."""

    name: str
    values: np.ndarray
    style: Mapping[str, Any] = MappingProxyType({})
    key: str = ""


def legend_beside(axes: Any, **options: Any) -> None:
    """Put the legend to the right of a panel."""
    if axes.get_legend_handles_labels()[0]:
        place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
        axes.legend(**place, **{"handlelength": 1.4, **options})


def thinned(time: np.ndarray, values: np.ndarray, points: int = _POINTS) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve (n,) with fewer points that looks the same: lowest and highest value of each time interval."""
    if len(time) <= points:
        return time, values
    stretch = -(-len(time) // (points // 2))
    whole = len(time) // stretch
    body = values[: whole * stretch].reshape(whole, stretch)
    with np.errstate(invalid="ignore"):
        picked = np.stack([np.argmin(body, axis=1), np.argmax(body, axis=1)], axis=1)
    picked = np.sort(picked, axis=1) + stretch * np.arange(whole)[:, None]
    rest = values[whole * stretch - 1 :]  # shorter than an interval; it overlaps by a point, so that it is never empty
    last = whole * stretch - 1 + np.array([np.argmin(rest), np.argmax(rest)])
    picked = np.unique(np.concatenate([picked.ravel(), last, [0, len(time) - 1]]))
    return time[picked], values[picked]


def largest(values: np.ndarray) -> float:
    """Return the largest magnitude of the finite values, 0 without any."""
    sizes = np.abs(values)
    return float(sizes[np.isfinite(sizes)].max(initial=0.0))


def literal(text: str) -> str:
    """Return a text in which dollar signs do not start a formula."""
    return text.replace("$", r"\$")


@contextmanager
def boxes_allowed() -> Iterator[None]:
    """Draw without warnings of characters that the font lacks: they are boxes in the picture, for everybody to see."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


def png(figure: Any, dpi: float = 100) -> bytes:
    """Return a figure of matplotlib as PNG, with so many pixels per inch."""
    made = io.BytesIO()
    with boxes_allowed():
        figure.savefig(made, format="png", dpi=dpi)
    return made.getvalue()


def opened(result: Path | str | Any) -> Any:
    """Return a context of a result that is open, or opened by its path."""
    if not isinstance(result, (str, os.PathLike)):
        return nullcontext(result)
    from ..output.result import open_result

    return open_result(result)


def check_formats(formats: Iterable[str]) -> tuple[str, ...]:
    """Return the formats of pictures, each once.

    Raises
    ------
    InputError
        For an unknown format, or none.
    """
    if isinstance(formats, str):
        formats = (formats,)
    chosen = tuple(dict.fromkeys(name.lower().removeprefix(".") for name in formats))
    for name in chosen:
        if name not in FORMATS:
            raise InputError(f"plot: format = {name!r} is not known; it is one of {', '.join(FORMATS)}")
    if not chosen:
        raise InputError(f"plot: no format named; it is one of {', '.join(FORMATS)}")
    return chosen


class Chart:
    """Panels over a common axis, mostly of time, one below the other or in columns.

    What is drawn is kept in SI units, with all points, and can be written as a table.

    Parameters
    ----------
    time : (n,) [s], or in the unit of the axis
    title : of the figure
    rows, columns : of panels
    heights : relative heights of the rows
    axis : what the times are
    sharex : whether all panels have the times as their axis
    """

    def __init__(
        self,
        time: np.ndarray,
        title: str,
        rows: int,
        columns: int = 1,
        heights: Sequence[float] | None = None,
        axis: Axis = TIME,
        sharex: bool = True,
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        relative = list(heights or [1.0] * rows)
        size = (_WIDTHS.get(columns, 4.4 * columns), 0.9 + 2.5 * sum(relative))
        self.figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(self.figure)
        self.axes = self.figure.subplots(rows, columns, sharex=sharex, squeeze=False, height_ratios=relative)
        self.figure.suptitle(literal(title), x=0.01, ha="left", fontsize=13, fontweight="bold", color="#1f242c")
        self.time = np.asarray(time, dtype=float)
        self.factor, self.unit = prefix_for(float(np.abs(self.time).max()) if self.time.size else 0.0, axis.unit)
        self._over = axis.label(axis.unit)
        self._columns: list[tuple[str, np.ndarray, str, np.ndarray]] = []
        self._scales: dict[str, tuple[float, str]] = {}
        self._label = axis.label(self.unit)
        if sharex:
            for axes in self.axes[-1]:
                axes.set_xlabel(self._label)

    def share(self, quantity: str, unit: str, magnitudes: Iterable[float]) -> None:
        """Have one unit for a quantity in panels whose largest numbers are the magnitudes."""
        self._scales[quantity] = common_prefix(magnitudes, unit)

    def scale(self, quantity: str) -> tuple[float, str]:
        """Return the factor and the unit that panels of a quantity :meth:`share`."""
        return self._scales[quantity]

    def note(self, text: str) -> None:
        """Write a text below the panels."""
        width = int((self.figure.get_figwidth() - 0.3) / _LETTER)
        lines = "\n".join(textwrap.wrap(text, width))
        self.figure.supxlabel(literal(lines), x=0.01, ha="left", fontsize=9, color="#5b6472")

    def leave_out(self, places: Iterable[tuple[int, int]]) -> None:
        """Remove the panels at these places (row, column); the lowest that is left in a column has its numbers."""
        for place in places:
            self.axes[place].remove()
        gone = set(places)
        for column in range(self.axes.shape[1]):
            left = [row for row in range(self.axes.shape[0]) if (row, column) not in gone]
            lowest = self.axes[left[-1], column]
            lowest.tick_params(labelbottom=True)
            lowest.set_xlabel(self._label)

    def legend_above(self, axes: Any) -> None:
        """Put the legend above a panel, beside the title if there is room, so that it hides no curve."""
        texts = [line.get_label() for line in axes.get_lines() if not line.get_label().startswith("_")]
        if not texts:
            return
        title, columns = axes.get_title(loc="left"), self.axes.shape[1]
        taken = 1.4 * len(title) + sum(len(text) + 5.0 for text in texts)
        if title and taken * _LETTER > self.figure.get_figwidth() / columns - 0.9:
            axes.set_title(f"{title}\n")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(texts), handlelength=1.4, borderaxespad=0.1)

    def curves(
        self, axes: Any, label: str, unit: str, curves: Sequence[Curve], title: str = "", quantity: str = ""
    ) -> tuple[float, str]:
        """Draw curves of one unit into a panel, with their legend above; return the factor and unit of its axis.

        The unit is that which panels of the quantity :meth:`share`, or else suits these curves.
        """
        sizes = (largest(np.asarray(curve.values)) for curve in curves)
        factor, shown = self._scales.get(quantity) or prefix_for(max(sizes, default=0.0), unit)
        for number, curve in enumerate(curves):
            time, thin = thinned(self.time, np.asarray(curve.values, dtype=float) * factor)
            options = {"color": COLOURS[number % len(COLOURS)], **curve.style}
            options |= {"marker": "o"} if len(time) == 1 else {}  # a line needs two points
            axes.plot(time * self.factor, thin, label=literal(curve.name), **options)
            self.record(curve.key or curve.name, curve.values, unit)
        axes.set_ylabel(f"{label} [{shown}]" if shown else label)
        axes.set_title(literal(title))
        self.legend_above(axes)
        return factor, shown

    def counts(self, axes: Any, label: str, values: np.ndarray, colour: str = COLOURS[0], before: bool = False) -> None:
        """Draw integers (n,) as steps into a panel; those of an interval (``before``) up to its end."""
        from matplotlib.ticker import MaxNLocator

        time, thin = thinned(self.time, np.asarray(values, dtype=float))
        self.record(" ".join(label.split()), np.asarray(values))
        side = "pre" if before else "post"
        axes.plot(time * self.factor, thin, color=colour, linewidth=1.0, drawstyle=f"steps-{side}")
        axes.fill_between(time * self.factor, thin, step=side, color=colour, alpha=0.15, linewidth=0)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
        axes.set_ylim(0, max(1.0, 1.08 * float(thin.max(initial=0.0))))
        axes.set_ylabel(label)

    def record(self, name: str, values: np.ndarray, unit: str = "", over: tuple[str, np.ndarray] | None = None) -> None:
        """Add a column (n,) to the table of the picture, over the times or over other named values (n,)."""
        along, places = over or (self._over, self.time)
        heading = f"{name} [{unit}]" if unit else name
        if not any(heading == other and along == before for before, _, other, _ in self._columns):
            self._columns.append((along, places, heading, np.asarray(values)))

    def save(self, file: Path, formats: Iterable[str] = ("png",)) -> list[Path]:
        """Write the picture, or its table, in formats of :data:`FORMATS`; return the files.

        Raises
        ------
        InputError
            If one cannot be written.
        """
        written = []
        for suffix in formats:
            path = file.with_name(f"{file.name.removesuffix('.png')}.{suffix}")
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                if suffix == "csv":
                    self._write_table(path)
                else:
                    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(suffix)
                    with boxes_allowed():
                        self.figure.savefig(path, metadata=metadata)
            except OSError as error:
                raise InputError(
                    f"{path}: the picture cannot be written ({error.strerror}); give another folder"
                ) from error
            written.append(path)
        return written

    def _write_table(self, path: Path) -> None:
        """Write all curves at all points: columns over the same values have these once, before the first of them."""
        columns: list[tuple[str, np.ndarray]] = []
        shown: list[np.ndarray] = []
        for along, places, name, values in self._columns:
            if not any(places is other or np.array_equal(places, other) for other in shown):
                columns.append((along, places))
                shown.append(places)
            columns.append((name, values))
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([name for name, _ in columns])
            writer.writerows(itertools.zip_longest(*(values.tolist() for _, values in columns), fillvalue=""))
