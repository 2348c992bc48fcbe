"""Closed forms of the histories of cases that have one, for pictures: recognised from the case, whatever its name."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..case.base import StrictModel
from ..columns import LOST, STORED, SUPPLIED
from ..errors import InputError
from ..output.table import Selected, select, varied
from ..output.units import TIME, prefix_for, unit_of
from .chart import DASHES, REFERENCE, Chart, Curve, Panel, distinct, largest
from .filters import AS_COMPUTED, Filter, amplitude_spectrum

_ABSENT = ("load", "support", "temperature", "contact_pair", "constraint", "remove", "point_mass", "spring", "dashpot")


@dataclass
class ClosedForm:
    """Exact values of columns of the history.

    Attributes
    ----------
    name : of the solution
    columns : values at the times of the history, of the shape of the columns; NaN where they are not known
    path : displacement (m,) [m] and load factor (m,) of an equilibrium path
    """

    name: str
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    path: tuple[np.ndarray, np.ndarray] | None = None


def closed_form(result: Any) -> ClosedForm | None:
    """Return the closed form of a result's case, None if none is known.

    Parameters
    ----------
    result : an open result
    """
    if not hasattr(result.case, "mesh") or result.case.stage or len(result.history["time"]) == 0:
        return None
    for find in FORMS:
        found = find(result)
        if found is not None:
            return found
    return None


def rod_on_wall(result: Any) -> ClosedForm | None:
    """An elastic rod that flies along its axis against a rigid wall, or the plateau of one that yields.

    From the contact at t_c = gap/v for 2 L/c the wall exerts F = rho c A v, c = sqrt(E/rho); a wave brings the rod to
    rest and, reflected at the free end, to the velocity -v. With linear hardening and v > v_Y = s_Y/(rho c), the force
    is A (s_Y + rho c_p (v - v_Y)) in the same time, c_p = sqrt(E_t/rho), E_t = E H/(E + H); later it is not known.
    """
    case, history = result.case, result.history
    if case.mesh.generator != "rod" or case.time is None or len(case.wall) != 1 or len(case.initial) != 1:
        return None
    wall, start, section = case.wall[0], case.initial[0], next(iter(case.section.values()))
    if (
        _has_more(case)
        or not _keys(wall) <= {"name", "type", "point", "normal", "node_set"}
        or wall.type != "plane"
        or len(case.section) != 1
        or section.uniform_area is None
        or section.prestressed
        or start.node_set is not None
        or any(start.angular_velocity)
        or np.linalg.norm(start.velocity[1:]) > 0.0
        or np.linalg.norm(wall.normal[1:]) > 0.0
        or start.velocity[0] * wall.normal[0] >= 0.0
    ):
        return None
    material = case.material[section.material]
    plastic = {"yield_stress", "isotropic_hardening", "kinematic_hardening"}
    if not _keys(material) <= {"law", "young_modulus", "density"} | plastic:
        return None
    points = np.asarray(result.positions(0), dtype=float)
    axis, speed = math.copysign(1.0, start.velocity[0]), abs(start.velocity[0])
    along = axis * points[:, 0]
    if not _holds_end(case, wall, points, int(np.argmax(along))):
        return None
    modulus, density = material.young_modulus, material.density
    c, length = math.sqrt(modulus / density), float(np.ptp(along))
    impact = (axis * wall.point[0] - float(along.max())) / speed
    time = np.asarray(history["time"], dtype=float)
    since, travel = time - impact, length / c
    touching = (since >= 0.0) & (since <= 2.0 * travel)
    normal = np.asarray(wall.normal, dtype=float) / np.linalg.norm(wall.normal)
    force = f"wall/{wall.name}/force"
    limit = getattr(material, "yield_stress", None)
    if limit is not None and speed > limit / (density * c):
        hardening = material.isotropic_hardening + material.kinematic_hardening
        slow = math.sqrt(modulus * hardening / (modulus + hardening) / density)
        plateau = section.uniform_area * (limit + density * slow * (speed - limit / (density * c)))
        known = np.where(touching, plateau, np.where(since < 0.0, 0.0, np.nan))
        return ClosedForm("plastic wave of linear hardening", {force: known[:, None] * normal})
    mass, way = density * section.uniform_area * length, np.array([axis, 0.0, 0.0])
    mean = speed * np.clip(1.0 - np.maximum(since, 0.0) / travel, -1.0, 1.0)
    inside = np.clip(since, 0.0, 2.0 * travel)
    centre = speed * (
        np.minimum(time, impact) + inside - inside**2 / (2.0 * travel) - np.maximum(since - 2 * travel, 0)
    )
    kinetic = 0.5 * mass * speed**2 * np.abs(mean) / speed
    columns = {
        force: (density * c * section.uniform_area * speed * touching)[:, None] * normal,
        "kinetic_energy": kinetic,
        "elastic_energy": 0.5 * mass * speed**2 - kinetic,
        "momentum": mass * mean[:, None] * way,
        "centre_of_mass": np.asarray(history["centre_of_mass"])[0] + centre[:, None] * way,
    }
    for name in history:
        if name.startswith("probe/") and name.endswith("/position"):
            place = np.asarray(history[name])[0]
            delay = (along.max() - axis * place[:, 0]) / c
            first, last = impact + delay, impact + 2.0 * travel - delay
            moved = np.minimum(time[:, None], first) - np.maximum(time[:, None] - last, 0.0)
            columns[name] = place + speed * moved[..., None] * way
            sign = np.where(time[:, None] < first, 1.0, np.where(time[:, None] < last, 0.0, -1.0))
            columns[name.replace("/position", "/velocity")] = speed * sign[..., None] * way
    return ClosedForm("closed form of the wave in the rod", columns)


def von_mises(result: Any) -> ClosedForm | None:
    """Two bars under a load at the apex: P(z) = 2 E A z (1/sqrt(b^2 + z^2) - 1/L_0) at the height z, half span b."""
    case = result.case
    if case.mesh.generator != "von_mises" or case.static is None or len(case.load) != 1 or len(case.section) != 1:
        return None
    load, section = case.load[0], next(iter(case.section.values()))
    if (
        _has_more(case, ("load", "support"))
        or case.wall
        or not _keys(load) <= {"node_set", "force"}
        or any(load.force[:2])
        or section.uniform_area is None
        or section.prestressed
        or not _keys(case.material[section.material]) <= {"law", "young_modulus", "density"}
    ):
        return None
    points = np.asarray(result.positions(0), dtype=float)
    if len(points) != 3:
        return None
    apex = int(np.argmax(np.abs(points[:, 2])))
    feet = np.delete(points, apex, axis=0)
    base, rise = 0.5 * float(np.ptp(feet[:, 0])), float(points[apex, 2])
    heights = [np.asarray(result.positions(i))[apex, 2] for i in range(len(result.times))]
    height = np.linspace(rise, min([*heights, rise]), 400)
    stiff = 2.0 * case.material[section.material].young_modulus * section.uniform_area
    load_z = -stiff * height * (1.0 / np.hypot(base, height) - 1.0 / math.hypot(base, rise))
    return ClosedForm("closed form of two bars", path=(rise - height, load_z / load.force[2]))


FORMS: tuple[Callable[[Any], ClosedForm | None], ...] = (rod_on_wall, von_mises)


def _keys(table: Any) -> set[str]:
    """Return the keys of a table that differ from their defaults."""
    return set(table.model_dump(exclude_defaults=True, exclude_none=True))


def _has_more(case: Any, allowed: tuple[str, ...] = ()) -> bool:
    """Whether a case has forces or constraints beside the allowed tables."""
    return (
        case.gravity is not None
        or case.wind is not None
        or any(len(getattr(case, name)) for name in _ABSENT if name not in allowed)
    )


def _holds_end(case: Any, wall: Any, points: np.ndarray, end: int) -> bool:
    """Whether a wall stops the end of a rod."""
    if wall.node_set is None:
        return True
    chosen = case.node_set[wall.node_set]
    if chosen.nearest is not None:
        return int(np.argmin(np.linalg.norm(points - np.array(chosen.nearest), axis=1))) == end
    return bool(chosen.all) or (chosen.indices is not None and end in chosen.indices)


History = Mapping[str, np.ndarray]

CLOSED_FORM = " closed form"
"""What follows the name of a curve in the name of its closed form, in tables."""

_LONGEST = 50  # number of letters of a label that tells the values of a run

_LINE = 40  # letters of a line of a legend

_HEIGHT = 26  # letters of a line beside a panel

_QUANTITIES = {
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


def read(history: History, name: str) -> np.ndarray:
    """Return a column as float64."""
    return np.asarray(history[name], dtype=float)


def words(name: str) -> str:
    """Return the name of a column as words."""
    return name.replace("_", " ")


def column(history: History, name: str) -> dict[str, np.ndarray]:
    """Return the curves (n,) of a name or an expression, which :func:`~pfem_petsc.output.table.select` takes.

    Columns of nodes are the mean over the nodes, of reactions the sum. A vector without component gives those that are
    not zero up to rounding.

    Raises
    ------
    InputError
        If the history has no such column.
    """
    found = select(history, name).reduced()
    values = found.values.astype(float)
    if not found.single and values.size and not np.isfinite(values).any():
        raise InputError(f"plot: {name}: is a number in no row, as it divides by zero")
    if not found.vector:
        return {name: values}
    name = name if found.single else f"({name})"
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    kept = [k for k in range(3) if np.nanmax(np.abs(values[:, k]), initial=0.0) > 1e-9 * largest]
    return {f"{name}.{'xyz'[k]}": values[:, k] for k in kept or range(3)}


def smoothed(result: Any, chosen: Filter, values: np.ndarray, touch: bool = False) -> np.ndarray:
    """Return values (rows,) of a history after a filter of each stretch of motion; those of static stages are kept.

    ``touch``: whether the quantity is zero before the run, as contact forces are.
    """
    time, made = read(result.history, "time"), np.nan_to_num(np.array(values, dtype=float))
    for rows in result.stretches:
        zero_before = touch and (rows.start == 0 or made[rows.start - 1] == 0.0)
        made[rows] = chosen.apply(time[rows], made[rows], zero_before)
    return np.where(np.isnan(values), np.nan, made)


def exact_curves(exact: ClosedForm | None, names: Sequence[str], place: np.ndarray | None = None) -> list[Curve]:
    """Return the closed forms of curves of :func:`column`, where they are known."""
    curves: list[Curve] = []
    for name in names if exact is not None else ():
        try:
            values = column(exact.columns, name)[name]
        except InputError:  # of columns, or in an expression of some, that have none
            continue
        curves.append(Curve("" if curves else exact.name, values, REFERENCE, name + CLOSED_FORM, place))
    return curves


def usual_curves(results: Sequence[Any]) -> list[str]:
    """Return what is compared of results: energies, forces of walls, displacements of probes, if all have them."""
    common = [name for name in results[0].history if all(name in result.history for result in results)]
    energies = [name for name in (*STORED, *LOST, *SUPPLIED) if name in common]
    sizes = {name: max(float(np.abs(read(r.history, name)).max()) for r in results) for name in energies}
    largest = max(sizes.values(), default=0.0)
    chosen = [name for name in energies if sizes[name] > 1e-3 * largest]
    forces = [name for name in common if name.startswith("wall/") and name.endswith("/force")]
    chosen += [name for name in forces if any(np.any(result.history[name]) for result in results)]
    for name in common:
        if name.startswith("probe/") and name.endswith("/position"):
            moved = name.removesuffix("position") + "displacement"
            chosen += [moved] if any(np.any([*column(r.history, moved).values()]) for r in results) else []
    # over load factors, the load factor is a straight line; it is a curve over the points of a path
    if "load_factor" in common and results[0].axis.symbol != TIME.symbol:
        every = [(read(r.history, "load_factor"), read(r.history, "time")) for r in results]
        chosen += ["load_factor"] if not all(np.array_equal(*pair) for pair in every) else []
    if not chosen:
        raise InputError("plot: the results have no columns in common that change; name some as curves")
    return chosen


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
    labels, captions = _labels_and_captions(results, [name for name, _ in panels], labels)
    if len({result.axis.symbol for result in results}) > 1 and against is None:
        raise InputError("plot: the results are over different axes: " + ", ".join({r.axis.symbol for r in results}))
    exact = closed_form(first) if closed_forms and against is None else None
    times = [read(result.history, "time") for result in results]
    places = times
    if against is not None:
        found = [column(result.history, against) for result in results]
        if any(list(each) != [against] for each in found):
            raise InputError(f"plot: against = {against!r} is a vector: name a component, {against}.x, .y, .z or .norm")
        places = [_filtered(r, chosen, against, each[against]) for r, each in zip(results, found, strict=True)]
    shared = all(np.array_equal(place, places[0]) for place in places)
    over = None if against is None else (against, select(first.history, against).unit or "")
    columns = {name: [column(result.history, name) for result in results] for name, _ in panels}
    components = {name: _parts(found) for name, found in columns.items()}
    split = any(len(parts) > 1 for parts in components.values())
    drawn = []
    for (name, smoothing), caption in zip(panels, captions, strict=True):
        found, parts, whole = columns[name], components[name], select(first.history, name)
        curves = []
        for number, (each, label, result, place) in enumerate(zip(found, labels, results, places, strict=True)):
            for k, part in enumerate(parts):
                if part not in each:
                    continue
                shown = _filtered(result, smoothing, part, each[part])
                style = _line(number, k, len(results), split)
                component = part.rpartition(".")[2] if caption else part
                words_of = (label if len(found) > 1 else "", component if len(parts) > 1 else "")
                key = f"{part}: {label}" if len(found) > 1 else part
                key += f", {smoothing.name}" if smoothing is not None and (name, None) in panels else ""
                text = " ".join(word for word in words_of if word) or caption or "computed"
                curves.append(Curve(text, shown, style, key, place, "" if shared else label))
        for known in exact_curves(exact, [part for part in parts if part in found[0]], places[0]):
            part = known.key.removesuffix(CLOSED_FORM)
            curves.append(known._replace(values=_filtered(first, smoothing, part, known.values)))
        title = parts[0] if len(parts) == 1 else name  # which component it is
        label = caption or quantity_of(name, whole)
        titles = [title] if not caption and words(title) != label else []
        if smoothing is not None and smoothing.name != AS_COMPUTED:
            titles.append(f"{AS_COMPUTED}, as all energies" if _is_energy(whole) else smoothing.name)
        lines = sum(1 + curve.name.count("\n") for curve in curves)
        height = max(0.9, 0.11 * lines)  # of the legend
        drawn.append(Panel(label, whole.unit or "", curves, ": ".join(titles), height, over, None, len(curves) > 1))
    axis = max((result.axis for result in results), key=lambda axis: axis.staged)
    ends = first.stage_ends if len(results) == 1 and axis.staged else ()
    return Chart(drawn, first.case.title or first.case.name, np.concatenate(times), axis, ends=ends)


def _filtered(result: Any, chosen: Filter | None, name: str, values: np.ndarray) -> np.ndarray:
    """Return the values (rows,) of a column or expression after a filter, those of energies as they are."""
    history = result.history
    if chosen is None or _is_energy(select(history, name)):
        return values
    sources = select(history, name).sources
    # forces of contact are zero before the run, and so is what is computed from them, unless something is added
    touch = all(one.startswith(("wall/", "pair/", "constraint/")) and one.endswith("/force") for one in sources)
    before = {one: np.zeros_like(history[one][:1]) for one in sources if touch}
    return smoothed(result, chosen, values, touch and not np.any(select(before, name).values))


def _is_energy(found: Selected) -> bool:
    return all(unit_of(source) == "J" for source in found.sources)


def quantity_of(name: str, found: Selected) -> str:
    """Return the label of the axis of a column, as words, or of an expression, by its unit."""
    if found.single:
        return words(name.rsplit("/", 1)[-1])
    if found.unit is None:
        return "value of unknown unit"
    return "displacement" if found.unit == "m" and "displacement" in name else _QUANTITIES.get(found.unit, "value")


def _parts(found: Sequence[Mapping[str, np.ndarray]]) -> list[str]:
    """Return the names of the curves of :func:`column` of results: a vector that is zero in some has all components
    there."""
    parts = list(dict.fromkeys(part for curves in found for part in curves))
    return [part for part in parts if any(np.any(curves.get(part, 0.0)) for curves in found)] or parts


def _line(number: int, part: int, results: int, split: bool) -> dict[str, Any]:
    """Return the style of a curve: a result has its colour in all panels.

    Dashes are those of components, in charts ``split`` into them, else of a few results.
    """
    if results == 1:
        return distinct(part, 0)
    return distinct(number, part if split else number if results <= len(DASHES) else None)


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
    window : see :func:`~pfem_petsc.post.filters.amplitude_spectrum`
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
        whole, parts = select(first.history, name), _parts(found)
        unit = whole.unit or ""
        curves = []
        for number, (label, result) in enumerate(zip(labels, results, strict=True)):
            time = read(result.history, "time")
            rows = max(result.stretches, key=lambda rows, time=time: float(np.ptp(time[rows])))
            for part in (part for part in parts if part in found[number]):
                key = f"{part}: {label}" if len(results) > 1 else part
                frequency, amplitude = amplitude_spectrum(time[rows], found[number][part][rows], window)
                style = _line(number, parts.index(part), len(results), split)
                curves.append(Curve(key, amplitude, style, place=frequency))
        label = f"amplitude of\n{caption or quantity_of(name, whole)}"
        legend, title = len(curves) > 1, f"window: {window}" if caption else f"{name}, window: {window}"
        along = prefix_for(highest or max(curve.place[-1] for curve in curves), "Hz")
        over, scale = ("frequency", "Hz"), (1.0, unit)
        panels.append(Panel(label, unit, curves, title, 1.1, over, scale, legend, True, along))
    title = first.case.title or first.case.name
    chart = Chart(panels, title, np.zeros(1))
    for axes, panel in zip(chart.axes, panels, strict=True):
        factor, shown = panel.along
        end = highest or max(curve.place[-1] for curve in panel.curves)
        inside = [(curve.place > 0.0) & (curve.place <= end) for curve in panel.curves]
        top = max(largest(curve.values[part]) for curve, part in zip(panel.curves, inside, strict=True))
        if len(panel.curves) == 1:
            _tell_peaks(axes, panel.curves[0].place[inside[0]], panel.curves[0].values[inside[0]], factor, shown)
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
