"""Curves of a result's history: the usual pictures, or those of named columns."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from ..case.base import StrictModel
from ..columns import SUPPLIED
from ..errors import InputError
from ..output.result import balance_error
from ..output.result import energies as energies_of
from ..output.table import Selected, select, varied
from ..output.units import engineering, prefix_for, unit_of
from .chart import COLOURS, DASHES, REFERENCE, STYLE, Chart, Curve, Panel, area, distinct, largest, opened
from .curves import (
    AS_COMPUTED,
    ClosedForm,
    Filter,
    History,
    amplitude_spectrum,
    closed_form,
    column,
    exact_curves,
    make_filter,
    read,
    smoothed,
    usual_curves,
    window_mean,
    words,
)
from .options import PlotOptions

_LONGEST = 50  # number of letters of a label that tells the values of a run

_LINE = 40  # letters of a line of a legend

_HEIGHT = 26  # letters of a line beside a panel

_QUANTITY_OF = {
    "": "ratio",
    "N": "force",
    "Pa": "stress",
    "J": "energy",
    "W": "power",
    "m": "length",
    "m²": "area",
    "m³": "volume",
    "m/s": "velocity",
    "m/s²": "acceleration",
    "s": "time",
    "N s": "impulse",
    "kg m/s": "momentum",
    "N/m": "force by length",
}
"""What expressions are called on their axis, by their unit."""

_UNIT = re.compile(r"\[((?:kg|Pa|Hz|rad|[msNJKW]|1/)(?:kg|Pa|Hz|rad|[msNJKW]|[²³ /()])*)\]")

_PEAKS = 5  # of a spectrum, at most, that are told


WINDOW = 0.02  # width of the moving average of forces, relative to the run

_ROUNDING = 1e-9
"""Change of a curve below which it is constant, relative to the largest number of its unit in the picture."""


def plot(result_path: Path | str | Any | Sequence[Any], output: Path | str | None = None, **options: Any) -> list[Path]:
    """Draw the history: ``energies.png``, ``momentum.png``, ``probes.png``, ``bars.png``, ``walls.png`` and others.

    Parameters
    ----------
    result_path : result file or its folder, or an open result; several of them are drawn over each other, into
        ``comparison.png`` without ``curves``
    output : folder of the pictures; None: beside the (first) result
    options : see :class:`~pfem_petsc.post.options.PlotOptions`

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
    given = PlotOptions(**options)
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
            if chosen is not None and not result.stretches:
                raise InputError(
                    f"{result.path}: filter = {given.force_filter!r} needs a run over time, not a static analysis"
                )
        if given.labels is not None and len(results) == 1 and given.spectrum is None and given.curves is None:
            raise InputError("plot: labels name several results, or the curves of one: give curves, or more results")
        if given.spectrum is not None:
            chart = draw_spectra(results, list(given.spectrum), given.window, given.highest, given.labels)
            return chart.save(_free(folder / "spectra", suffixes), suffixes)
        if given.curves is not None:
            panels = [(name, chosen) for name in given.curves]
            chart = draw_curves(results, panels, given.against, chosen, given.closed_forms, given.labels)
            return chart.save(_free(folder / "curves", suffixes), suffixes)
        if len(results) > 1:
            forces = chosen or _usual_filter(results[0])
            panels = []
            for name in usual_curves(results):  # forces as computed and, in a panel below, filtered
                smoothed_too = name.endswith("/force") and forces.name != AS_COMPUTED
                panels += [(name, None), (name, forces)] if smoothed_too else [(name, None)]
            chart = draw_curves(results, panels, closed_forms=given.closed_forms, labels=given.labels)
            return chart.save(folder / "comparison", suffixes)
        (result,) = results
        return _usual(result, folder, suffixes, chosen, given.closed_forms)


def _usual(
    result: Any, folder: Path, suffixes: tuple[str, ...], chosen: Filter | None, closed_forms: bool
) -> list[Path]:
    """The pictures of a single result."""
    history, title = result.history, result.case.title or result.case.name
    exact = closed_form(result) if closed_forms else None
    forces = chosen or _usual_filter(result)
    drawn = {
        "energies": energies(history, exact),
        "momentum": momentum(result, exact) if result.stretches else ([], ""),
        "probes": probes(result, exact),
        "bars": bars(result),
        "walls": force_panels(result, "wall", forces, exact),
        "pairs": force_panels(result, "pair", forces),
        "constraints": force_panels(result, "constraint", forces),
        "force_displacement": (force_displacement(result, forces, exact), ""),
        "solver": (solver(result), ""),
    }
    written = []
    for name, (panels, note) in drawn.items():
        if panels:
            ends = result.stage_ends if result.axis.staged else ()
            chart = Chart(panels, title, read(history, "time"), result.axis, note, ends)
            written += chart.save(folder / name, suffixes)
    if "csv" in suffixes and hasattr(result, "table"):
        written.append(result.table().to_csv(folder / "history.csv"))
    return written


def _free(file: Path, suffixes: Sequence[str]) -> Path:
    """Return the file name without suffix, with the next free number if it exists in one of the formats."""
    numbered = (file.with_name(f"{file.name}_{k}") for k in itertools.count(2))
    free = (p for p in itertools.chain([file], numbered) if not any(Path(f"{p}.{s}").exists() for s in suffixes))
    return next(free)


def energies(history: History, exact: ClosedForm | None = None) -> tuple[list[Panel], str]:
    """Stacked stored and lost energies with what was supplied, the terms one by one, and the balance.

    Each picture is panels, and may have a note below them.
    """
    error = balance_error(history)
    if error is None:
        return [], ""
    held = energies_of(history)
    most = max(float(np.nanmax(np.abs(values))) for values in held.values())
    moving = {name: values for name, values in held.items() if np.abs(values).max() > 1e-12 * most}
    still = [words(name) for name in held if name not in moving]
    number = {name: k for k, name in enumerate(moving)}
    # supplied energies have no area; negative parts hang below zero
    areas = [
        Curve(words(name), values, area(number[name]), name, kind="area")
        for name, values in moving.items()
        if name not in SUPPLIED
    ]
    stored = np.sum([values for name, values in held.items() if name not in SUPPLIED], axis=0)
    supplied = np.sum([np.zeros_like(error), *(held[name] for name in SUPPLIED if name in held)], axis=0)
    label = "at the start + supplied" if np.any(supplied) else "at the start"
    ink = {"color": "#1f242c", "linewidth": 1.2}
    available = Curve(label, stored[0] + supplied - supplied[0], {**ink, "linestyle": (0, (4, 2))})
    sums = [Curve("_", stored, {**ink, "linewidth": 0.6}, "stored and lost")]
    sums.append(available._replace(key="at the start and supplied"))
    lines = [Curve(words(name), values, distinct(number[name]), name) for name, values in moving.items()]
    lines += exact_curves(exact, list(moving))
    # a share of the largest energy, so that neither a prefix nor a unit hides how small it is
    share, worst = (1.0 / (most or 1.0), ""), float(np.nanmax(np.abs(error)))
    told = f"at most {worst * share[0]:.1e}\nof {engineering(most, 'J')}" if worst > 0.0 else "zero"
    balance = Curve(told, error, {"color": COLOURS[1]}, "balance error")
    panels = [
        Panel("stored and lost,\nstacked", "J", [*areas, *sums], "", 1.3),
        Panel("energy", "J", lines, "", 1.3),
        Panel("balance error,\nshare of largest", "J", [balance], "", 0.7, scale=share),
    ]
    return panels, f"Zero throughout: {', '.join(still)}." if still else ""


def momentum(result: Any, exact: ClosedForm | None = None) -> tuple[list[Panel], str]:
    """Momentum, angular momentum and the displacement of the centre of mass, without those that do not change."""
    history, scales = result.history, {}
    names = {words(name): name for name in ("momentum", "angular_momentum") if name in history}
    if "centre_of_mass" in history:
        names["displacement of the centre of mass"] = "centre_of_mass/displacement"
    if len(names) == 3:
        arm = np.linalg.norm(read(history, "centre_of_mass"), axis=1)
        scales["angular momentum"] = largest(arm * np.linalg.norm(read(history, "momentum"), axis=1))
    shown, note = _moving(result, names, scales, exact)
    return (shown if any(panel.size > 0.0 for panel in shown) else []), note


def probes(result: Any, exact: ClosedForm | None = None) -> tuple[list[Panel], str]:
    """Displacement, velocity and reaction of each probe, without those that do not change."""
    names, scales, history = {}, {}, result.history
    found = dict.fromkeys(
        name.removeprefix("probe/").rpartition("/")[0] for name in history if name.startswith("probe/")
    )
    for probe, quantity in itertools.product(found, ("position", "velocity", "reaction")):
        source = f"probe/{probe}/{quantity}"
        if source in history:
            name = f"{'displacement' if quantity == 'position' else quantity} of {probe}"
            names[name] = source.replace("/position", "/displacement")
            scales[name] = 1e-3 * largest(read(history, source)) if quantity == "position" else 0.0
    return _moving(result, names, scales, exact)


def bars(result: Any) -> tuple[list[Panel], str]:
    """Axial force and stress of the bars of each probe."""
    names = [name for name in result.history if name.startswith("bar/") and not name.endswith("/strain")]
    panels = curve_panels([result], [(name, None) for name in names])
    return panels, _SHADED if any(len(panel.curves) > 1 for panel in panels) else ""


_SHADED = "Shaded: the range of the nodes or bars."


def _moving(
    result: Any, names: Mapping[str, str], scales: Mapping[str, float], exact: ClosedForm | None
) -> tuple[list[Panel], str]:
    """Return the panels of columns that change, or of all if none does, and a note that names the others.

    Rounding is relative to the largest number of the unit, or to the ``scales`` of numbers that values are
    differences of.
    """
    shown, still = [], []
    panels = dict(zip(names, curve_panels([result], [(name, None) for name in names.values()], exact), strict=True))
    for name, panel in panels.items():
        scale = max([scales.get(name, 0.0), *(other.size for other in panels.values() if other.unit == panel.unit)])
        curves = [np.nan_to_num(curve.values) for curve in panel.curves]
        if max(float(np.ptp(values, axis=0).max()) for values in curves) > _ROUNDING * scale:
            shown.append(panel)
        else:
            means = {curve.key[-1]: float(np.mean(curve.values)) for curve in panel.curves if curve.kind == "line"}
            parts = ", ".join(f"{part} = {mean:.4g}" for part, mean in means.items() if abs(mean) > _ROUNDING * scale)
            still.append(f"{name} ({parts} {panel.unit})" if parts else f"{name} (zero)")
    note = f"Constant: {', '.join(still)}." if still and shown else ""
    shown = shown or list(panels.values())
    shaded = any(curve.kind == "band" for panel in shown for curve in panel.curves)
    return shown, f"{_SHADED} {note}".strip() if shaded else note


def solver(result: Any) -> list[Panel]:
    """The iterations of the steps, and the nodes in contact where no other picture has them."""
    history = result.history
    names = [name for name in ("newton_iterations", "linear_iterations") if np.any(history.get(name, 0))]
    contacts = [name for name in history if name.startswith("wall/") and name.endswith("/contacts")]
    shown = len(contacts) == 1 and np.array_equal(history[contacts[0]], history["active_contacts"])  # with the walls
    names += ["active_contacts"] if contacts and (names or not shown) else []
    panels = curve_panels([result], [(name, None) for name in names])
    for name, panel in zip(names, panels, strict=True):  # iterations are those of the step before a row
        style = {"drawstyle": "steps-pre" if name.endswith("iterations") else "steps-post"}
        panel.curves = [curve._replace(style={**curve.style, **style}) for curve in panel.curves]
    return panels


def force_panels(
    result: Any, source: str, smoothing: Filter, exact: ClosedForm | None = None
) -> tuple[list[Panel], str]:
    """The forces of all walls, or of all pairs or constraints, and the nodes in contact where they are counted.

    Forces are drawn as computed and filtered; before the run, they are zero. Those of none have a panel only if all do.
    """
    history, panels, plain = result.history, [], make_filter("none")
    forces = [name for name in history if name.startswith(f"{source}/") and name.endswith("/force")]
    names = [name.removeprefix(f"{source}/").removesuffix("/force") for name in forces]
    felt = [name for name in names if np.any(history[f"{source}/{name}/force"])]
    normals = {wall.name: wall.normal for wall in result.case.every_wall if hasattr(wall, "normal")}
    for name in felt or names:
        key, heading = f"{source}/{name}/force", f"{source.capitalize()} '{name}'"
        # pairs and constraints may have the name of a wall
        normal = normals.get(name) if source == "wall" else None
        values, label = _pressing(read(history, key), normal)
        forms = [plain, smoothing] if felt and smoothing.name != AS_COMPUTED else [plain]
        for form in forms:
            style = {"linewidth": 0.9 if form is plain else 1.6}
            curves = [Curve(form.name, smoothed(result, form, values, True), style, f"{key} {label}, {form.name}")]
            if exact is not None and key in exact.columns:
                known = smoothed(result, form, _pressing(exact.columns[key], normal)[0], True)
                curves.append(Curve(exact.name, known, REFERENCE, f"{key} closed form, {form.name}"))
            panels.append(Panel(label, "N", curves, heading, 0.9))
            heading = ""
        if felt and f"{source}/{name}/contacts" in history:
            counts = history[f"{source}/{name}/contacts"]
            curve = Curve("", counts, {"color": COLOURS[1], "drawstyle": "steps-post"}, f"{source}/{name}/contacts")
            panels.append(Panel("nodes in\ncontact", "", [curve], height=0.5, legend=False))
    silent = [f"'{name}'" for name in names if felt and name not in felt]
    return panels, f"No force throughout: {', '.join(silent)}." if silent else ""


def force_displacement(result: Any, smoothing: Filter, exact: ClosedForm | None = None) -> list[Panel]:
    """What resists over how far it was pressed.

    A static analysis: the load factor over the displacement of each probe along the direction in which it moved
    farthest. Each wall with a normal and a force, while it is touched: the normal force over the displacement, since
    the first contact, of the wall along its normal, or, of a wall at rest, of the centre of mass towards it. Both have
    passed the filter, so that neither is late.
    """
    panels = []
    if "load_factor" in result.history and not result.axis.unit:
        panels += _load_paths(result.history, exact)
    for wall in result.case.every_wall:
        if hasattr(wall, "normal") and np.any(result.history.get(f"wall/{wall.name}/force", 0.0)):
            panels += _wall_path(result, wall, smoothing, exact)
    return panels


def _path(curves: list[Curve], label: str, unit: str, heading: str, over: str) -> Panel:
    first, *known = curves
    few = {"marker": "o", "markersize": 3} if len(first.place) < 80 else {}
    drawn = [first._replace(style={"color": COLOURS[0], **few}, key=f"{heading} {label}, {first.name}")]
    key = f"{heading} {label}, closed form"
    drawn += [curve._replace(style=REFERENCE, key=key, source="closed form") for curve in known]
    return Panel(label, unit, drawn, heading, over=(over, "m"))


def _load_paths(history: History, exact: ClosedForm | None) -> list[Panel]:
    panels = []
    for name in history:
        if name.startswith("probe/") and name.endswith("/position"):
            moved = read(history, name).mean(axis=1)
            moved = moved - moved[0]
            row, k = np.unravel_index(np.argmax(np.abs(moved)), moved.shape)
            sign = np.sign(moved[row, k])
            if sign == 0.0:
                continue
            curves = [Curve(AS_COMPUTED, read(history, "load_factor"), place=sign * moved[:, k])]
            if exact is not None and exact.path is not None:
                curves.append(Curve(exact.name, exact.path[1], place=exact.path[0]))
            heading = f"Probe '{name.removeprefix('probe/').removesuffix('/position')}'"
            over = f"displacement along {'−' if sign < 0 else ''}{'xyz'[k]}"
            panels.append(_path(curves, "load factor", "", heading, over))
    return panels


def _wall_path(result: Any, wall: Any, smoothing: Filter, exact: ClosedForm | None) -> list[Panel]:
    history = result.history
    key, place = f"wall/{wall.name}/force", f"wall/{wall.name}/position"
    normal = np.asarray(wall.normal, dtype=float) / np.linalg.norm(wall.normal)
    force, sign, over = read(history, key) @ normal, 1.0, "displacement of the wall since contact"
    if place not in history or not np.any(np.ptp(read(history, place), axis=0) > 0.0):
        place, sign, over = "centre_of_mass", -1.0, "displacement of the centre of mass since contact"
    if place not in history:
        return []

    def path(force: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return both after the filter, while nodes touch the wall."""
        smooth, moved = smoothed(result, smoothing, force, True), smoothed(result, smoothing, moved)
        felt = (force != 0.0) | (np.abs(smooth) > 1e-3 * largest(smooth))
        near, begin = binary_dilation(felt), max(0, int(np.argmax(force != 0.0)) - 1)
        shown = slice(np.argmax(near), len(near) - np.argmax(near[::-1]))
        return np.where(near, smooth, np.nan)[shown], (moved - moved[begin])[shown]

    values, along = path(force, sign * read(history, place) @ normal)
    curves = [Curve(smoothing.name, values, place=along)]
    if exact is not None and sign < 0.0 and {key, place} <= set(exact.columns):
        values, along = path(exact.columns[key] @ normal, -exact.columns[place] @ normal)
        curves.append(Curve(exact.name, values, place=along))
    return [_path(curves, "normal force", "N", f"Wall '{wall.name}'", over)]


def _usual_filter(result: Any) -> Filter:
    times = [read(result.history, "time")[rows] for rows in result.stretches]
    length = sum(float(time[-1] - time[0]) for time in times)
    # of a window shorter than the interval of the rows, nothing would be left of a spike
    width = max([WINDOW * length, *(float(np.diff(time).max(initial=0.0)) for time in times)])
    if width <= 0.0:
        return make_filter("none")
    # a short stretch may end within the window
    return make_filter(f"mean:{width!r}")._replace(apply=lambda *curve: window_mean(*curve[:2], width, *curve[2:]))


def _pressing(force: np.ndarray, normal: Sequence[float] | None) -> tuple[np.ndarray, str]:
    """Return the force (n,) along a normal, or its length, and what it is."""
    if normal is None:
        return np.linalg.norm(force, axis=1), "force"
    return force @ np.asarray(normal, dtype=float) / np.linalg.norm(normal), "normal force"


def draw_curves(
    results: Sequence[Any],
    panels: Sequence[tuple[str, Filter | None]],
    against: str | None = None,
    chosen: Filter | None = None,
    closed_forms: bool = True,
    labels: Sequence[str] | None = None,
) -> Chart:
    """Draw panels of columns, with the curves of all results, over time or another column.

    Parameters
    ----------
    results : open results
    panels : columns, components of them or expressions, and the filter of each; energies are never filtered
    against : a column of numbers, a component or an expression; None: time
    chosen : filter of the column that they are drawn over
    closed_forms : whether to draw the closed form of the first result
    labels : names of the results in the legends, None: see :func:`labels_of`; of a single result, names of the curves
    """
    if not panels:
        raise InputError("plot: no curves named; columns: " + ", ".join(results[0].history))
    first = results[0]
    if len({result.axis.symbol for result in results}) > 1 and against is None:
        raise InputError("plot: the results are over different axes: " + ", ".join({r.axis.symbol for r in results}))
    exact = closed_form(first) if closed_forms and against is None else None
    times = [read(result.history, "time") for result in results]
    places, over = times, None
    if against is not None:
        found = [column(result.history, against) for result in results]
        if any(list(each) != [against] for each in found):
            raise InputError(f"plot: against = {against!r} is a vector: name a component, {against}.x, .y, .z or .norm")
        places = [_filtered(r, chosen, against, each[against]) for r, each in zip(results, found, strict=True)]
        over = against, select(first.history, against).unit or ""
    drawn = curve_panels(results, panels, exact, labels, places, over)
    axis = max((result.axis for result in results), key=lambda axis: axis.staged)
    ends = first.stage_ends if len(results) == 1 and axis.staged else ()
    return Chart(drawn, first.case.title or first.case.name, np.concatenate(times), axis, ends=ends)


def curve_panels(
    results: Sequence[Any],
    panels: Sequence[tuple[str, Filter | None]],
    exact: ClosedForm | None = None,
    labels: Sequence[str] | None = None,
    places: Sequence[np.ndarray] | None = None,
    over: tuple[str, str] | None = None,
) -> list[Panel]:
    """Return panels of columns, with the curves of all results; of one result also the range of nodes or bars.

    Parameters
    ----------
    results, panels, labels : as of :func:`draw_curves`
    exact : closed form of the first result
    places : of the rows of each result (rows,) on the horizontal axis; None: their times
    over : name and unit of that axis, as :class:`~pfem_petsc.post.chart.Panel` has it
    """
    first, drawn = results[0], []
    labels, captions = _labels_and_captions(results, [name for name, _ in panels], labels)
    places = [read(result.history, "time") for result in results] if places is None else places
    shared = all(np.array_equal(place, places[0]) for place in places)
    columns = [[column(result.history, name) for result in results] for name, _ in panels]
    split = any(len(_parts(found)) > 1 for found in columns)
    for (name, smoothing), caption, found in zip(panels, captions, columns, strict=True):
        curves, parts, whole = [], _parts(found), select(first.history, name)
        for number, curve in _curves_of(found, labels, caption, split):
            key = curve.key + (f", {smoothing.name}" if smoothing is not None and (name, None) in panels else "")
            values = _filtered(results[number], smoothing, name, curve.values)
            source = "" if shared else labels[number]
            curves.append(curve._replace(values=values, key=key, place=places[number], source=source))
        title = parts[0] if len(parts) == 1 else name  # which component it is
        label = caption or quantity_of(name, whole)
        titles = [title] if not caption and words(title) != label else []
        if smoothing is not None and smoothing.name != AS_COMPUTED:
            titles.append(f"{AS_COMPUTED}, as all energies" if _is_energy(whole) else smoothing.name)
        if whole.single and whole.values.ndim == 2 + whole.vector and whole.values.shape[1] > 1:
            summed = name.endswith("/reaction")
            titles.append(f"{'sum' if summed else 'mean'} of {whole.values.shape[1]}")
            curves += _ranges(whole, curves) if len(results) == 1 and smoothing is None and not summed else []
        for known in exact_curves(exact, [part for part in parts if part in found[0]], places[0]):
            curves.append(known._replace(values=_filtered(first, smoothing, name, known.values)))
        lines = sum(1 + curve.name.count("\n") for curve in curves)
        height = max(0.9, 0.11 * lines)  # of the legend
        legend = sum(curve.kind == "line" for curve in curves) > 1
        drawn.append(Panel(label, whole.unit or "", curves, ": ".join(titles), height, over, None, legend))
    return drawn


def _ranges(whole: Selected, curves: Sequence[Curve]) -> list[Curve]:
    """Return the ranges of the members of a column as bands around the curves of their means."""
    low, high = whole.values.min(axis=1), whole.values.max(axis=1)
    made = []
    for curve in curves:
        part = ("xyz".index(curve.key[-1]),) if whole.vector else ()
        bounds = np.stack([low[:, *part], high[:, *part]], axis=1)
        made.append(Curve("", bounds, {"color": curve.style["color"], "alpha": 0.15}, place=curve.place, kind="band"))
    return made


def _curves_of(
    found: Sequence[Mapping[str, np.ndarray]], labels: Sequence[str], caption: str, split: bool
) -> Iterator[tuple[int, Curve]]:
    """Yield the number of a result and one of the curves that :func:`column` found in it, with its name and style.

    Dashes are those of components, in charts ``split`` into them, else of a few results.
    """
    parts, several = _parts(found), len(found) > 1
    for number, (columns, label) in enumerate(zip(found, labels, strict=True)):
        for k, part in enumerate(parts):
            if part in columns:
                names = [label] if several else []
                names += [part.rpartition(".")[2] if caption else part] if len(parts) > 1 else []
                key = f"{part}: {label}" if several else part
                dash = k if split else number if len(found) <= len(DASHES) else None
                style = distinct(number, dash) if several else distinct(k, 0)
                yield number, Curve(" ".join(names) or caption or "computed", columns[part], style, key)


def _filtered(result: Any, chosen: Filter | None, name: str, values: np.ndarray) -> np.ndarray:
    """Return the values (rows,) of a column or expression after a filter, those of energies as they are."""
    history, found = result.history, select(result.history, name)
    if chosen is None or _is_energy(found):
        return values
    # forces of contact are zero before the run, and so is what is computed from them, unless something is added
    touch = all(one.startswith(("wall/", "pair/", "constraint/")) and one.endswith("/force") for one in found.sources)
    before = {one: np.zeros_like(history[one][:1]) for one in found.sources if touch}
    return smoothed(result, chosen, values, touch and not np.any(select(before, name).values))


def _is_energy(found: Selected) -> bool:
    return all(unit_of(source) == "J" for source in found.sources)


def quantity_of(name: str, found: Selected) -> str:
    """Return the label of the axis of a column, as words, or of an expression, by its unit."""
    if found.single:
        return words(name.rsplit("/", 1)[-1])
    if found.unit is None:
        return "value of unknown unit"
    return "displacement" if found.unit == "m" and "displacement" in name else _QUANTITY_OF.get(found.unit, "value")


def _parts(found: Sequence[Mapping[str, np.ndarray]]) -> list[str]:
    """Return the names of the curves of :func:`column` of results: a vector that is zero in some has all components
    there."""
    parts = list(dict.fromkeys(part for curves in found for part in curves))
    return [part for part in parts if any(np.any(curves.get(part, 0.0)) for curves in found)] or parts


def _labels_and_captions(
    results: Sequence[Any], names: Sequence[str], labels: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Return the names of results, and those of the curves, which labels are for a single result, else empty."""
    if len(results) > 1 or labels is None:
        return labels_of(results, labels), [""] * len(names)
    if len(labels) != len(names):
        raise InputError(
            f"plot: labels: one result needs a label for each curve ({len(names)} here), not {list(labels)}"
        )
    return labels_of(results), [textwrap.fill(label, _HEIGHT) for label in labels]


def labels_of(results: Sequence[Any], given: Sequence[str] | None = None) -> list[str]:
    """Return distinct names of results: those given, else what varies in runs of a sweep, else folders, or as much of
    the paths as it takes.

    Raises
    ------
    InputError
        If names are given, but not one for each result.
    """
    if given is not None:
        if len(given) != len(results) or len(set(given)) < len(given):
            raise InputError(f"plot: labels: {len(results)} results need as many different labels, not {list(given)}")
        return [textwrap.fill(label, _LINE) for label in given]
    paths = [Path(result.path).absolute() for result in results]
    labels = _values_of_runs(results[0].case, [varied(path.parent) for path in paths])
    if len(set(labels)) == len(labels) and all(0 < len(label) <= _LONGEST for label in labels):
        return labels
    for count in range(1, max(len(path.parts) for path in paths)):
        labels = ["/".join(path.parent.parts[-count:]) for path in paths]
        if len(set(labels)) == len(labels):
            return labels
    return (
        [str(path) for path in paths] if len(set(paths)) == len(paths) else [f"{k}: {p}" for k, p in enumerate(paths)]
    )


def _values_of_runs(case: Any, runs: Sequence[Mapping[str, str]]) -> list[str]:
    """Return for each run of a sweep the values that differ between some of them, with as much of the keys as it takes;
    empty texts for others."""
    keys = [key for key in runs[0] if len({run.get(key) for run in runs}) > 1]
    short = [key.rpartition(".")[2] for key in keys]
    names = short if len(set(short)) == len(short) else keys
    units = [_unit_of_key(case, key) for key in keys]
    return [
        ", ".join(f"{name} = {_text(run[key], unit)}" for name, key, unit in zip(names, keys, units) if key in run)
        for run in runs
    ]


def _unit_of_key(case: Any, key: str) -> str:
    """Return the unit that the text of a key of a case names, empty without: ``section.legs.thickness`` -> ``m``."""
    *way, last = key.split(".")
    table = case
    for part in way:
        table = table.get(part) if isinstance(table, Mapping) else getattr(table, part, None)
    found = _UNIT.search(table.description(last)) if isinstance(table, StrictModel) else None
    return found[1] if found else ""


def _text(value: str, unit: str) -> str:
    """Return a value with its unit and a prefix; a text that is no number as it is."""
    if not unit or not re.fullmatch(r"-?\d+\.?\d*(e[-+]?\d+)?", value):
        return value
    factor, shown = prefix_for(float(value), unit)
    return f"{float(value) * factor:.9g} {shown}"


def draw_spectra(
    results: Sequence[Any],
    names: Sequence[str],
    window: str = "hann",
    highest: float | None = None,
    labels: Sequence[str] | None = None,
) -> Chart:
    """Draw a panel with the amplitude spectrum of each named column; natural frequencies are dotted lines.

    Parameters
    ----------
    results : open results of runs over time; with static stages, the longest part without them is taken
    names : columns, components of them or expressions
    window : see :func:`~pfem_petsc.post.curves.amplitude_spectrum`
    highest : frequency at which the picture ends [Hz]; None: half the sampling rate
    labels : names of the results, as of :func:`draw_curves`
    """
    first = results[0]
    if not names:
        raise InputError("plot: no columns named for spectra; columns: " + ", ".join(first.history))
    if highest is not None and not highest > 0.0:
        raise InputError(f"plot: highest frequency = {highest:g} Hz must be positive")
    for result in results:
        if not result.stretches:
            raise InputError(f"{result.path}: spectra need a run over time, not a static analysis")
    natural = first.modes.frequency if getattr(first, "n_modes", 0) and first.modes.kind == "vibration" else ()
    labels, captions = _labels_and_captions(results, names, labels)
    columns = [[column(result.history, name) for result in results] for name in names]
    split = any(len(_parts(found)) > 1 for found in columns)
    panels = []
    for name, caption, found in zip(names, captions, columns, strict=True):
        whole, curves = select(first.history, name), []
        for number, curve in _curves_of(found, labels, caption, split):
            time = read(results[number].history, "time")
            rows = max(results[number].stretches, key=lambda rows, time=time: float(np.ptp(time[rows])))
            frequency, amplitude = amplitude_spectrum(time[rows], curve.values[rows], window)
            kept = frequency <= (highest or np.inf)
            curves.append(curve._replace(values=amplitude[kept], place=frequency[kept]))
        label = f"amplitude of\n{caption or quantity_of(name, whole)}"
        title, scale = f"window: {window}" if caption else f"{name}, window: {window}", (1.0, whole.unit or "")
        several = len(curves) > 1
        panels.append(Panel(label, scale[1], curves, title, 1.1, ("frequency", "Hz"), scale, several, log=True))
    chart = Chart(panels, first.case.title or first.case.name, np.zeros(1))
    factor, shown = chart.scales["Hz"]
    for axes, panel in zip(chart.axes, panels, strict=True):
        end = highest or max(curve.place[-1] for curve in panel.curves)
        top = max(largest(curve.values[curve.place > 0.0]) for curve in panel.curves)
        if len(panel.curves) == 1:
            _tell_peaks(axes, panel.curves[0].place[1:], panel.curves[0].values[1:], factor, shown)
        if top > 0.0:
            axes.set_ylim(1e-6 * top, 4.0 * top)
        axes.set_xlim(0.0, end * factor)
        for value in natural:
            if 0.0 < value <= end:
                axes.axvline(value * factor, color="#6b7280", linewidth=0.8, linestyle=":", zorder=0)
    return chart


def _tell_peaks(axes: Any, frequency: np.ndarray, amplitude: np.ndarray, factor: float, unit: str) -> None:
    """Write the frequencies of the highest peaks beside them; each is higher than all within 6 % of the picture."""
    from scipy.signal import find_peaks

    if len(amplitude) < 3:
        return
    apart = max(1.0, 0.06 * (frequency[-1] - frequency[0]) / (frequency[1] - frequency[0]))
    peaks, _ = find_peaks(amplitude, height=3e-3 * amplitude.max(), distance=apart)
    for k in peaks[np.argsort(-amplitude[peaks])][:_PEAKS]:
        left, middle, right = np.log(np.maximum(amplitude[k - 1 : k + 2], 1e-300))
        bend = left - 2.0 * middle + right
        place = frequency[k] + (0.5 * (left - right) / bend if bend < 0.0 else 0.0) * (frequency[1] - frequency[0])
        text, at = f"{place * factor:.4g} {unit}", (frequency[k] * factor, amplitude[k])
        axes.annotate(text, at, xytext=(3, 4), textcoords="offset points", fontsize=8)
