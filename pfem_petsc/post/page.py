"""The page around drawings, and their colours: title, colour bar, scale, axes and curves, time and a marker."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

from ..errors import InputError
from ..output.table import select
from ..output.units import field_unit, prefix_for
from ..registry import nearest
from .chart import STYLE, boxes_allowed, largest, literal
from .curves import column
from .scene import Camera, Scene, Style, direction, fit

if TYPE_CHECKING:
    from ..mesh.whole import WholeMesh


# Zero is a light grey, so that bars without a force recede, and the lightness falls with the magnitude on both sides.
DIVERGING = ("#0a3580", "#1f63b8", "#5f9bd1", "#b6bbc3", "#e8825a", "#c8312e", "#84101f")
SEQUENTIAL = ("#b6bbc3", "#eda540", "#dd5a3a", "#a3216b", "#3f0f5c")

GHOST = (208, 214, 222)
TRAILS = ((0, 158, 115), (204, 121, 167), (86, 180, 233), (230, 159, 0))
"""Told apart with any colour vision (Okabe and Ito 2008)."""

_SIGNED = ("stress", "strain", "axial_force")
_COMPONENTS = {"x": 0, "y": 1, "z": 2, 0: 0, 1: 1, 2: 2}
_SAMPLES = 60  # maximum number of snapshots from which a range is determined


class Mark(NamedTuple):
    """How bars in a state are marked: by the field that tells, with a colour, and its text below the picture."""

    field: str
    colour: tuple[int, int, int]
    text: str


MARKS = {
    "broken": Mark("status", (0, 0, 0), "broken"),
    "yielded": Mark("plastic_strain", (240, 200, 30), "yielded"),
}


class ColourField:
    """A point or cell field of a result, reduced to one value per node or bar.

    Parameters
    ----------
    result : an open result
    name : name of a point or cell field
    component : "x", "y", "z" (or 0, 1, 2) of a vector field; None: its length

    Raises
    ------
    InputError
        For a field that the result does not have (with the nearest name), or a component that it does not have.

    Attributes
    ----------
    rounded : whether the last range was that of rounding errors of zero
    """

    def __init__(self, result: Any, name: str, component: str | int | None = None) -> None:
        point, cell = list(result.point_fields), list(result.cell_fields)
        if name not in point and name not in cell:
            raise InputError(f"render: the result holds no field '{name}'{nearest(name, point + cell)}")
        self.name, self.unit = name, field_unit(name)
        self.on_nodes = name in point
        vector = np.ndim(result.field(name, 0)) == 2
        if component is not None and (not vector or component not in _COMPONENTS):
            why = f"{component!r} is not one of x, y, z" if vector else "it has one value only"
            raise InputError(f"render: field '{name}' has no such component: {why}")
        self._component = _COMPONENTS[component] if component is not None else None
        self._result, self._rounding = result, _rounding_of(result, name)
        self.rounded = False
        title = name.replace("_", " ")
        self.title = f"{title} {'xyz'[self._component]}" if self._component is not None else title

    def values(self, index: int) -> np.ndarray:
        """Return the values of a snapshot, (nodes,) or (bars,) float64."""
        values = np.asarray(self._result.field(self.name, index), dtype=float)
        if values.ndim == 1:
            return values
        return np.linalg.norm(values, axis=1) if self._component is None else values[:, self._component]

    def limits(self, indices: Iterable[int]) -> tuple[float, float]:
        """Return the range for all frames: from zero, or symmetric about zero if there are negative values of more than
        a hundredth of it.

        In each snapshot one value in a hundred may lie outside (a spike at an impact would leave the rest without
        contrast), unless the full range is not much larger.
        """
        indices = list(indices)
        chosen = [indices[k] for k in np.unique(np.linspace(0, len(indices) - 1, _SAMPLES).astype(int))]
        shown = [values[np.isfinite(values)] for values in map(self.values, chosen)]
        sizes = [np.abs(values) for values in shown if values.size]
        bulk = max((float(np.quantile(size, 0.99)) for size in sizes), default=0.0)
        largest = max((float(size.max()) for size in sizes), default=0.0)
        lowest = min((float(values.min(initial=0.0)) for values in shown), default=0.0)
        limit = largest if largest <= 2.0 * bulk or bulk == 0.0 else bulk
        self.rounded = 0.0 < largest <= self._rounding
        if self.rounded or limit == 0.0:
            return (-1.0 if self.name in _SIGNED else 0.0), 1.0
        return (-limit if lowest < -0.01 * limit else 0.0), limit


def _rounding_of(result: Any, name: str) -> float:
    """Return below what a field of bars is rounding: of strains, that of coordinates over the length of a bar.

    A rod that flies without a force has stresses of 1e-6 Pa, which should not get all colours.
    """
    if name not in _SIGNED or not len(result.bars):
        return 0.0
    points = np.asarray(result.positions(0), dtype=float)
    ends = points[np.asarray(result.bars)]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    strain = 1e-13 * float(np.abs(points).max()) / max(float(np.median(length)), 1e-300)
    case = result.case
    moduli = [getattr(each, "young_modulus", None) or 0.0 for each in getattr(case, "material", {}).values()]
    areas = [each.area or 0.0 for each in getattr(case, "section", {}).values()]
    stress = strain * max(moduli, default=0.0)
    return {"strain": strain, "stress": stress, "axial_force": stress * max(areas, default=0.0)}[name]


class ColourScale:
    """Maps values to colours.

    Parameters
    ----------
    limits : lower and upper value
    cmap : a matplotlib colour map or its name; None: chosen by the sign of the lower limit
    unit : unit of the values

    Attributes
    ----------
    factor, unit : of the numbers beside the colours, and their unit with a prefix
    shown : maps values in that unit

    Raises
    ------
    InputError
        If the limits are not two increasing numbers, or for an unknown colour map.
    """

    def __init__(self, limits: tuple[float, float], cmap: Any = None, unit: str = "") -> None:
        import matplotlib
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        low, high = limits
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"render: colour limits {low:g}, {high:g} must be two finite, increasing numbers")
        if cmap is None:
            cmap = LinearSegmentedColormap.from_list("bars", DIVERGING if low < 0.0 else SEQUENTIAL)
            if low < 0.0:  # the part with zero at the grey, and equal magnitudes equally dark
                shares = 0.5 + 0.5 * np.linspace(low, high, 257) / max(-low, abs(high))
                cmap = LinearSegmentedColormap.from_list("bars", cmap(shares))
        elif isinstance(cmap, str):
            if cmap not in matplotlib.colormaps:
                raise InputError(f"render: unknown colour map '{cmap}'{nearest(cmap, list(matplotlib.colormaps))}")
            cmap = matplotlib.colormaps[cmap]
        self.factor, self.unit = prefix_for(max(abs(low), abs(high)), unit)
        self.shown = ScalarMappable(Normalize(low * self.factor, high * self.factor, clip=True), cmap)

    def colours(self, values: np.ndarray) -> np.ndarray:
        """Return colours (n, 3) uint8 of values (n,), clipped at the limits; NaN has the lowest colour."""
        low, high = self.shown.get_clim()
        return self.shown.to_rgba(np.nan_to_num(self.factor * values, nan=low, posinf=high, neginf=low), bytes=True)[
            :, :3
        ]


INK, PALE = "#1f242c", "#5b6472"
_GROUPS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")
"""Okabe and Ito: apart for all kinds of colour vision."""
_OTHERS = "#7a7a7a"
_LETTERS = 16
_CURVE, _MARKER = "#2563b0", "#d9482b"
_CURVE_WIDTH = 220  # of an inset, in pixels of a page of 1280 by 720


def _unit_of(size: tuple[int, int]) -> float:
    """Return how many pixels a page has for each of one of 1280 by 720."""
    return min(size[0] / 1280, size[1] / 720)


def _figure(size: tuple[int, int], opacity: float = 1.0) -> Figure:
    """Return a figure with a canvas of some pixels, whose points are those of a page of 1280 by 720."""
    dpi = 100.0 * _unit_of(size)
    figure = Figure(figsize=((size[0] + 0.1) / dpi, (size[1] + 0.1) / dpi), dpi=dpi)
    figure.patch.set(facecolor="white", alpha=opacity)
    FigureCanvasAgg(figure)
    return figure


class Heading(NamedTuple):
    """The texts of a page: titles of the case and the field, its colours, what is marked, and looks.

    Attributes
    ----------
    title, field : titles
    scale : colours of the field
    marks : what is marked, told below the picture
    notes : texts below the picture
    transparent : whether the background is
    """

    title: str
    field: str
    scale: ColourScale
    marks: Sequence[Mark] = ()
    notes: Sequence[str] = ()
    transparent: bool = False


class Page:
    """Frame of a picture: drawings in tiles of a figure of matplotlib, with texts, axes and curves around them.

    An inch has a hundred pixels of a page of 1280 by 720.

    Parameters
    ----------
    size : width and height in pixels
    heading : texts and colours
    captions : above the drawings, one for each; a single drawing has none
    columns : of the drawings
    inset : whether a curve is below each drawing

    Attributes
    ----------
    tiles : axes of the drawings, row by row
    tile : width and height of a drawing in pixels
    """

    def __init__(
        self,
        size: tuple[int, int],
        heading: Heading,
        captions: Sequence[str] = ("",),
        columns: int = 1,
        inset: bool = False,
    ) -> None:
        self._figure = figure = _figure(size, 0.0 if heading.transparent else 1.0)
        self._channels, self._notes = 4 if heading.transparent else 3, heading.notes
        # the marker on a curve, (rows,) times [s], and (rows, 2) where the marker is then
        self._insets: list[tuple[Line2D, np.ndarray, np.ndarray]] = []
        wide, high = figure.get_size_inches()
        left, top, width, height = self.region_of(size)
        rows, strip = -(-len(captions) // columns), round(34 * _unit_of(size)) if len(captions) > 1 else 0
        across, along = width // columns, height // rows - strip
        least = round(_CURVE_WIDTH * _unit_of(size))
        if inset and (across < least or along < 1.2 * least):
            raise InputError(
                f"render: inset needs tiles of {least} x {round(1.2 * least)} pixels or more, and these have "
                f"{across} x {along}: give a larger size, or fewer results"
            )
        below = round(max(0.6 * least, 0.3 * along)) if inset else 0
        self.tile, self._below = (across, along - below), below
        edges = {"left": left / size[0], "right": (left + width) / size[0], "wspace": 0.0}
        edges |= {"bottom": 1.0 - (top + height - below) / size[1], "top": 1.0 - (top + strip) / size[1]}
        place = {**edges, "hspace": (strip + below) / self.tile[1]}
        tiles = figure.subplots(rows, columns, squeeze=False, gridspec_kw=place).ravel()
        self.tiles = tiles[: len(captions)].tolist()
        self._triad = figure.add_axes((1.0 - 1.48 / wide, 0.06 / high, 1.12 / wide, 1.12 / high))
        self._triad.set(xlim=(-1.65, 1.65), ylim=(-1.65, 1.65))
        for axes in (*tiles, self._triad):
            axes.axis("off")
        letters = across / _unit_of(size) / 11.0
        for axes, caption in zip(self.tiles, captions, strict=True):
            head, comma, time = caption.rpartition(", ")  # long names of results are cut, and times are not
            text = cut(head, letters - len(time)) + comma + time
            axes.set_title(literal(text), loc="left", color=INK, fontsize=14.5, pad=8.0)
        title = cut(heading.title, (width / _unit_of(size) - 230) / 10.5)  # space for the time is left empty
        figure.text(0.2 / wide, 1.0 - 0.38 / high, literal(title), color=INK, fontsize=16, weight="bold")
        self._time = figure.text(1.0 - 1.5 / wide, 1.0 - 0.41 / high, "", color=INK, fontsize=14.5, ha="right")
        self._foot = figure.text(0.34, 0.22 / high, "", color=INK, fontsize=11.5, va="center", linespacing=1.1)
        keys = [
            Line2D([], [], color=np.divide(mark.colour, 255), linewidth=4, label=mark.text) for mark in heading.marks
        ]
        corner = (1.0 - 1.5 / wide, 0.0)
        figure.legend(
            handles=keys, frameon=False, fontsize=11.5, ncols=len(keys) or 1, loc="lower right", bbox_to_anchor=corner
        )
        scale = heading.scale
        bar = figure.add_axes((1.0 - 1.16 / wide, 1.6 / high, 0.2 / wide, 1.0 - 2.91 / high))
        figure.colorbar(scale.shown, cax=bar, ticks=MaxNLocator(nbins=7, steps=[1, 2, 2.5, 5, 10]))
        bar.tick_params(labelsize=12, colors=INK)
        bar.minorticks_off()
        label = heading.field.replace(" ", "\n", 1) + (f"\n[{scale.unit}]" if scale.unit else "")
        bar.set_title(label, loc="left", x=-0.5, color=INK, fontsize=13, pad=10)

    @staticmethod
    def region_of(size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Return left, top, width and height of the part of a page with the drawings, in pixels."""
        left, top, right, bottom = (round(pixels * _unit_of(size)) for pixels in (20, 64, 150, 52))
        return left, top, size[0] - left - right, size[1] - top - bottom

    def draw(
        self,
        drawings: Sequence[np.ndarray],
        camera: Camera,
        time: str = "",
        moments: Sequence[float] = (),
        acting: Sequence[Mapping[str, np.ndarray]] = (),
        told: Sequence[str] = (),
    ) -> np.ndarray:
        """Return the page (height, width, 3 or 4) uint8 with drawings (h, w, 3 or 4) of the size of a tile.

        Parameters
        ----------
        drawings : row by row
        camera : for the axes
        time : text of the time
        moments : times of the insets [s]
        acting : directions (3,) of gravity and wind of each drawing: in it, or beside the axes if there is one drawing
        told : of the loads of each drawing: in it, or below if there is one drawing
        """
        for artist in (*self._figure.images, *self._triad.texts, *(text for axes in self.tiles for text in axes.texts)):
            artist.remove()
        for axes, drawing in zip(self.tiles, drawings, strict=True):
            self._figure.figimage(drawing, *axes.bbox.min.round(), origin="upper", zorder=-1)
        self._time.set_text(time)
        single, unit, high = len(drawings) == 1, self._figure.dpi / 100.0, self.tile[1]
        notes = [*self._notes, *(text for text in told if text and single)]
        self._foot.set_text(literal("\n".join("   ".join(notes[k : k + 2]) for k in range(0, len(notes), 2))))
        _draw_ways(self._triad, dict(zip("xyz", np.eye(3))) | (dict(*acting) if single else {}), camera)
        for axes, ways, text in zip(self.tiles, acting, told, strict=False) if not single else ():
            place = {"xycoords": "axes pixels", "ha": "left", "va": "top", "color": PALE, "fontsize": 11.5}
            axes.annotate(literal(text), (0.0, high), **place)
            _draw_ways(axes, ways, camera, (24.0 * unit, high - 52.0 * unit), 20.0 * unit, "axes pixels")
        for (marker, times, curve), moment in zip(self._insets, moments, strict=False):
            if len(times):
                marker.set_data(*([np.interp(moment, times, values)] for values in curve.T))
        canvas = self._figure.canvas
        with boxes_allowed():
            canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., : self._channels].copy()

    def add_length_scale(self, camera: Camera) -> None:
        """Draw a line of 1, 2 or 5 times a power of ten, and its length; with perspective, it is that at mid-depth."""
        metres = 2.0 * camera.half_height / self.tile[1]
        length = float(MaxNLocator(9, steps=[1, 2, 5, 10]).tick_values(0.0, metres * self.tile[0])[1])
        factor, name = prefix_for(length, "m")
        text = f"{length * factor:g} {name}" + ("" if camera.parallel else " at mid-depth")
        look = {"loc": "lower left", "frameon": False, "color": PALE, "fontproperties": FontProperties(size=11.5)}
        place = {"bbox_to_anchor": self._figure.bbox, "borderpad": 0.5, "sep": 3.0, "fill_bar": True}
        inches = length / metres / self._figure.dpi
        bar = AnchoredSizeBar(self._figure.dpi_scale_trans, inches, text, size_vertical=0.02, **look, **place)
        self._figure.add_artist(bar)

    def add_insets(self, results: Sequence[Any], name: str) -> None:
        """Add a curve of the history below each drawing, with a marker, which :meth:`draw` moves.

        Parameters
        ----------
        results : open results, whose curves are all in the range of the axes
        name : of a column, see :func:`history_curve`
        """
        curves = [(np.asarray(r.history["time"], dtype=float), history_curve(r.history, name)) for r in results]
        chosen, axis = select(results[0].history, name), results[0].axis
        factor, unit = prefix_for(max(largest(values) for _, values in curves), chosen.unit or "")
        time_factor, time_unit = axis.scale(max(largest(times) for times, _ in curves))
        kind, *parts, last = name.split("/") if "/" in name and chosen.single else ("", name)
        label = (f"{kind} '{'/'.join(parts)}', {last}" if parts else last).replace("_", " ")
        share = self._below / self.tile[1]
        place, shared = (0.08, -0.76 * share, 0.88, 0.54 * share), None
        with rc_context({**STYLE, "font.size": 9.0, "axes.titlesize": 9.5}):
            for tile, (times, values) in zip(self.tiles, curves, strict=True):
                shared = axes = tile.inset_axes(place, sharex=shared, sharey=shared)
                curve = np.stack([times * time_factor, values * factor], axis=1)
                axes.plot(*curve.T, color=_CURVE)
                (marker,) = axes.plot([], [], "o", color=_MARKER, markersize=6.0)
                axes.locator_params(nbins=5)
                axes.set_xlabel(axis.label(time_unit), labelpad=1.0)
                axes.margins(y=0.08)
                axes.set_title(literal(label + (f" [{unit}]" if unit else "")))
                self._insets.append((marker, times, curve))


def cut(text: str, letters: float) -> str:
    """Return a text of at most some letters, but four."""
    most = max(4, int(letters))
    return text if len(text) <= most else text[: most - 1].rstrip() + "…"


def _draw_ways(
    axes: Any,
    ways: Mapping[str, np.ndarray],
    camera: Camera,
    origin: tuple[float, float] = (0.0, 0.0),
    unit: float = 1.0,
    coordinates: str = "data",
) -> None:
    """Draw directions (3,) as arrows of a unit from an origin with their names, the farthest first."""
    for name, way in sorted(ways.items(), key=lambda each: float(each[1] @ camera.towards)):
        colour = PALE if name in ("x", "y", "z") else _MARKER
        arrow = {"arrowstyle": "<|-", "color": colour, "shrinkA": 0.0, "shrinkB": 0.0}
        tip = np.array([way @ camera.right, way @ camera.up])
        length = float(np.linalg.norm(tip))
        if length > 0.05:
            label = {"color": colour, "fontsize": 11, "ha": "center", "va": "center", "xycoords": coordinates}
            axes.annotate(name, origin, origin + unit * tip * (1.0 + 0.33 / length), arrowprops=arrow, **label)


def history_curve(history: Any, name: str) -> np.ndarray:
    """Return a column of the history as one number a row: of vectors the length, or ``NAME.x``; of nodes the mean.

    Raises
    ------
    InputError
        If there is no such column.
    """
    found = column(history, name)
    return found[name] if name in found else column(history, f"({name}).norm")[f"({name}).norm"]


def grid(count: int, aspect: float, room: tuple[int, int]) -> tuple[int, int]:
    """Return the columns and rows of tiles that make pictures of this aspect (width over height) largest."""

    def drawn_width(columns: int) -> float:
        rows = -(-count // columns)
        return min(room[0] / columns, aspect * room[1] / rows)

    columns = max(range(1, count + 1), key=lambda columns: (round(drawn_width(columns), 3), -columns))
    return columns, -(-count // columns)


def mesh_page(mesh: WholeMesh, size: tuple[int, int] = (1280, 720), view: str = "auto") -> bytes:
    """Return a picture of a mesh as PNG, with a legend of up to seven bar groups and the size of the mesh.

    Parameters
    ----------
    size : in pixels
    view : ``xy``, ``xz``, ``yz``, ``iso`` or ``auto``

    Raises
    ------
    InputError
        For a mesh without bars, and for an unknown view.
    """
    points = mesh.points
    if len(mesh.bars) == 0 or not np.isfinite(points).all():
        raise InputError(f"{mesh.source}: {len(mesh.bars)} bars, or coordinates that are not finite: nothing to draw")
    group = np.full(len(mesh.bars), len(_GROUPS))  # the first one of each bar, the last number for others
    for k, members in reversed(list(enumerate(mesh.bar_groups.values()))[: len(_GROUPS)]):
        group[members] = k
    shown = np.unique(group).tolist() if mesh.bar_groups else []
    figure, bounds = _figure(size), np.array([points.min(axis=0), points.max(axis=0)])
    axes = figure.add_axes((0.02, 0.09, 0.96, 0.78 if shown else 0.89))
    axes.axis("off")
    span = " x ".join(f"{x:.4g}" for x in bounds[1] - bounds[0])
    text = f"{len(points):,} nodes, {len(mesh.bars):,} bars, {span} m"
    figure.text(0.02, 0.025, text, fontsize=15, color=INK)
    palette = np.array([to_rgb(colour) for colour in (*_GROUPS, _OTHERS)])
    names = [*(cut(name, _LETTERS) for name in list(mesh.bar_groups)[: len(_GROUPS)]), "other bars"]
    handles = [
        Line2D([], [], color=palette[number], linewidth=4, label=names[min(number, len(names) - 1)]) for number in shown
    ]
    figure.legend(handles=handles, ncols=4, fontsize=15, loc="upper center", frameon=False)
    wide, high = axes.bbox.size.astype(int).tolist()
    camera = fit(points, direction(view, bounds, [], (0.0, 0.0, 1.0)), wide / high)
    motion = SimpleNamespace(start=points, bars=mesh.bars, bounds=bounds)
    scene = Scene(motion, camera, (wide, high), Style(rims=False), unit=_unit_of(size))
    picture = scene.draw(points, (255.0 * palette[group]).astype(np.uint8), camera)
    scene.close()
    figure.figimage(picture, *axes.bbox.min.round(), origin="upper")
    made = io.BytesIO()
    with boxes_allowed():
        figure.savefig(made, format="png")
    return made.getvalue()
