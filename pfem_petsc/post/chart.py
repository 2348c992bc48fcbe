"""Charts of curves: panels over a common axis, their style, and their tables."""

from __future__ import annotations

import csv
import itertools
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from cycler import cycler

from ..errors import InputError, written
from ..output.units import TIME, Axis, common_prefix

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6b7280", "#000000")
"""For colour-blind eyes (Okabe and Ito 2008), without their yellow, which is too pale for lines on white."""

DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)))

# the dashes of closed forms, which are black as well, come last of those without markers
_STYLES = tuple(
    cycler(marker=["", "o", "s", "^", "D", "v", "P", "X"])
    * cycler(linestyle=[DASHES[k] for k in (0, 2, 3, 1)])
    * cycler(color=COLOURS)
)

FORMATS = ("png", "svg", "pdf", "csv")

REFERENCE: dict[str, Any] = {"color": "#000000", "linewidth": 1.1, "linestyle": (0, (5, 2.5)), "zorder": 3}
"""The style of closed forms."""

STYLE: dict[str, Any] = {
    "agg.path.chunksize": 20_000,
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

_WIDTH = 8.6  # of pictures [inch]


class Curve(NamedTuple):
    """A curve of a panel.

    Attributes
    ----------
    name : in the legend
    values : (n,) in the unit of the panel; of a band the lowest and highest ones (n, 2)
    style : of its line
    key : its name in tables, if that is another one
    place : (n,) on the axis of the panel; None: the times of the chart
    source : of the places, in tables, where curves of a panel have different ones
    kind : ``line``; ``area``, on top of the areas before it; ``band``
    """

    name: str
    values: np.ndarray
    style: Mapping[str, Any] = MappingProxyType({})
    key: str = ""
    place: np.ndarray | None = None
    source: str = ""
    kind: str = "line"


@dataclass
class Panel:
    """What one pair of axes shows. All panels of a chart with the same unit, and no scale, have the same prefix.

    Attributes
    ----------
    label : of the vertical axis
    unit : of the values
    curves : what is drawn
    title : above the panel
    height : relative to others
    over : name and unit of the horizontal axis; None: that of the chart
    scale : factor and unit of the vertical axis; None: by the values
    legend : whether there is one, beside the panel
    log : whether the vertical axis is logarithmic
    """

    label: str
    unit: str
    curves: Sequence[Curve]
    title: str = ""
    height: float = 1.0
    over: tuple[str, str] | None = None
    scale: tuple[float, str] | None = None
    legend: bool = True
    log: bool = False

    @property
    def size(self) -> float:
        """The largest number."""
        return max((largest(curve.values) for curve in self.curves), default=0.0)


def distinct(k: int, dash: int | None = None) -> dict[str, Any]:
    """Return the style of the ``k``-th line of a panel, which differs from those of all others.

    There are eight colours, and each time that they begin again other dashes and another marker: 256 styles.

    Parameters
    ----------
    k : from 0
    dash : number of another dash, for lines that their colours tell apart
    """
    marked = {"markersize": 4.5, "markevery": (0.012 * (k % 10), 0.12)}  # so that those of equal curves are apart
    return {**_STYLES[k % len(_STYLES)], **marked} | ({} if dash is None else {"linestyle": DASHES[dash]})


def area(k: int) -> dict[str, Any]:
    """Return the style of the ``k``-th area of a panel: of the first ones plain, of others hatched."""
    colour = COLOURS[k % len(COLOURS)]
    hatch = (None, "///", "\\\\\\", "...", "xxx")[k // len(COLOURS) % 5]
    return {"facecolor": colour, "edgecolor": "white", "hatch": hatch, "alpha": 0.85}


def _same_widths(axes: Any, ends: np.ndarray) -> None:
    """Give stages between their ends the same width: a motion of milliseconds beside a load factor would be a line."""
    from matplotlib.ticker import MaxNLocator

    at = np.arange(len(ends), dtype=float)
    axes.set_xscale("function", functions=(lambda x: np.interp(x, ends, at), lambda x: np.interp(x, at, ends)))
    axes.set_xlim(ends[0], ends[-1])
    ticks = list(ends)
    for first, last in itertools.pairwise(ends.tolist()):
        inner = MaxNLocator(4).tick_values(first, last)
        ticks += inner[np.abs(inner - 0.5 * (first + last)) < 0.4 * (last - first)].tolist()
    axes.set_xticks(sorted(ticks))
    for end in ends[1:-1]:
        axes.axvline(end, color="#5b6472", linewidth=0.8, linestyle=":")


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
    """Panels below each other, over a common axis unless they have one of their own.

    What is drawn is kept in SI units, with all points, and can be written as a table.

    Parameters
    ----------
    panels : from above
    title : of the figure
    time : (n,) [s], or in the unit of the axis
    axis : what the times are
    note : text below the panels
    ends : start of the first stage and ends of all, which get the same width where load factors and times are on one
        axis

    Attributes
    ----------
    figure, axes : of matplotlib; axes of each panel
    scales : factor and prefixed unit of all numbers of a unit
    """

    def __init__(
        self,
        panels: Sequence[Panel],
        title: str,
        time: np.ndarray,
        axis: Axis = TIME,
        note: str = "",
        ends: Sequence[float] = (),
    ) -> None:
        from matplotlib.figure import Figure

        heights = [panel.height for panel in panels]
        self.figure = Figure(figsize=(_WIDTH, 0.9 + 2.5 * sum(heights)), layout="constrained")
        own = any(panel.over for panel in panels)
        grid = self.figure.subplots(len(panels), sharex=not own, squeeze=False, height_ratios=heights)
        self.axes = grid.ravel().tolist()
        self.figure.suptitle(literal(title), x=0.01, ha="left", fontsize=13, fontweight="bold", color="#1f242c")
        if note:
            self.figure.supxlabel(literal(note), x=0.01, ha="left", fontsize=9, color="#5b6472", wrap=True)
        self.time, self._axis, self._ends = np.asarray(time, dtype=float), axis, ends
        self._columns: list[tuple[str, np.ndarray, str, np.ndarray]] = []
        sizes = [(panel.unit, panel.size) for panel in panels if panel.scale is None]
        sizes += [(panel.over[1], largest(curve.place)) for panel in panels if panel.over for curve in panel.curves]
        self.scales = {unit: common_prefix([size for other, size in sizes if other == unit], unit) for unit, _ in sizes}
        for axes, panel in zip(self.axes, panels, strict=True):
            self._draw(axes, panel)

    def _draw(self, axes: Any, panel: Panel) -> None:
        """Draw a panel; only the lowest one has a label of the common axis."""
        if panel.over is None:
            along, places = self._axis.scale(largest(self.time)), self._axis.label(self._axis.unit)
            label = self._axis.label(along[1])
        else:
            name, unit = panel.over
            along, places = self.scales[unit], f"{name} [{unit}]" if unit else name
            label = f"{name.replace('_', ' ')} [{along[1]}]" if unit else name.replace("_", " ")
        factor, shown = panel.scale or self.scales[panel.unit]
        above = below = 0.0
        for number, curve in enumerate(panel.curves):
            place = self.time if curve.place is None else np.asarray(curve.place, dtype=float)
            values = np.asarray(curve.values, dtype=float)
            style = {"label": literal(curve.name), **curve.style}
            x, y = place * along[0], values * factor
            if curve.kind == "band":
                axes.fill_between(x, *y.T, linewidth=0, **style)
                continue
            if curve.kind == "area":
                axes.fill_between(x, above, above := above + np.maximum(y, 0.0), linewidth=0, **style)
                axes.fill_between(x, below, below := below + np.minimum(y, 0.0), linewidth=0, **style | {"label": None})
            else:
                point = {"marker": "o"} if len(place) == 1 else {}  # a line needs two points
                axes.plot(x, y, **{**distinct(number), **point, **style})
            heading = f"{curve.key or curve.name} [{panel.unit}]" if panel.unit else curve.key or curve.name
            over = f"{places}: {curve.source}" if curve.source else places
            if not any(heading == other and over == before for before, _, other, _ in self._columns):
                known = np.isfinite(values) if panel.over else slice(None)
                self._columns.append((over, place[known], heading, np.asarray(curve.values)[known]))
        axes.set_ylabel(f"{panel.label} [{shown}]".lstrip() if shown else panel.label)
        axes.set_title(literal(panel.title))
        axes.margins(x=0.02 if panel.over else 0.0)
        if panel.log:
            axes.set_yscale("log")
        if panel.over is None and len(self._ends) > 2:
            _same_widths(axes, np.asarray(self._ends))
        if panel.over or axes is self.axes[-1]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(label)
        if panel.legend and axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, handlelength=1.8)

    def save(self, file: Path, formats: Iterable[str] = ("png",)) -> list[Path]:
        """Write the picture, or its table, in formats of :data:`FORMATS`; return the files.

        Raises
        ------
        InputError
            If one cannot be written.
        """
        made = []
        for suffix in formats:
            path = file.with_name(f"{file.name.removesuffix('.png')}.{suffix}")
            with written(path, "the picture"), boxes_allowed():
                if suffix == "csv":
                    self._write_table(path)
                else:
                    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(suffix)
                    self.figure.savefig(path, metadata=metadata)
            made.append(path)
        return made

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
