"""Members: axial forces and stresses of bars and chains of bars, and their utilisation of strength and Euler's load.

A member is a chain of bars of one section that lie on one line in the mesh: they are joined at nodes with no other bar,
no support, spring or dashpot. Utilisations are

- of strength: |N|/(A f), the largest of its bars, with the axial force N, the area A in the mesh, and the
  ``design_strength`` f of its material, by default its ``yield_stress``;
- of Euler's load: -N (K L)^2/(pi^2 E I) where N is compression, with the length L of the member in the mesh, Young's
  modulus E, and the smallest second moment I and the effective length factor K of its section.

They do not exist without a strength, or without a shape or second moment of the section.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from ..output.result import check_mesh, stage_at
from ..output.table import Table
from ..registry import nearest
from .options import PER

_COLLINEAR = 1e-4
"""Largest sine of the angle between bars of a member."""

_ROUNDING = 1e-9
"""Relative difference of times that are equal."""

_FORCE = "axial_force"


class Bars(NamedTuple):
    """The bars of a case, by their numbers in the mesh: arrays (bars,), in SI units.

    Attributes
    ----------
    section : number of the section, -1 of connectors between nodes
    area, length : in the mesh
    strength : of the material, NaN without
    rigidity : E I, NaN without shape and second moment
    factor : effective length factor
    """

    section: np.ndarray
    area: np.ndarray
    length: np.ndarray
    strength: np.ndarray
    rigidity: np.ndarray
    factor: np.ndarray


class Members(NamedTuple):
    """Members of a truss.

    Attributes
    ----------
    bars : (bars,) numbers of bars, member after member
    first : (members,) where each begins in ``bars``
    """

    bars: np.ndarray
    first: np.ndarray

    def least(self, values: np.ndarray) -> np.ndarray:
        """The smallest value (members,) of each member, of values (bars,) in the order of the mesh."""
        return np.minimum.reduceat(values[self.bars], self.first)

    def most(self, values: np.ndarray) -> np.ndarray:
        """The largest value (members,) of each member; NaN where one is."""
        return np.maximum.reduceat(values[self.bars], self.first)

    def total(self, values: np.ndarray) -> np.ndarray:
        """The sum (members,) over the bars of each member."""
        return np.add.reduceat(values[self.bars], self.first)


class Truss(NamedTuple):
    """What members need of the model of a result: its bars, and nodes at which members end."""

    bars: Bars
    held: np.ndarray
    sections: list[str]


def truss_of(result: Any) -> Truss:
    """Return the bars of the case of an open result, whose mesh is made or read again.

    Raises
    ------
    InputError
        If the mesh is not there any more, or has other bars.
    """
    from mpi4py import MPI

    from ..mechanics.bars import bar_shapes
    from ..stepping.model import Model

    stages = result.case.stages
    model = Model(stages[0], MPI.COMM_SELF, later=stages[1:])
    mesh, case, n = model.mesh, model.case, len(result.bars)
    check_mesh(result, mesh)
    sections = list(case.section)
    values = {name: np.full(n, np.nan) for name in Bars._fields}
    values["section"] = np.full(n, -1)
    for block in model.bars.blocks:
        if block.section not in case.section:
            continue
        section = case.section[block.section]
        material = case.material[section.material]
        own = mesh.bar_ids[block.start : block.stop]
        lengths = model.bars.mesh_lengths[block.start : block.stop]
        shapes = bar_shapes(section, lengths, np.broadcast_to(block.area, lengths.shape))
        strength = material.design_strength or getattr(material, "yield_stress", None)
        rigidity = material.young_modulus * shapes.second_moment
        found = {
            "section": sections.index(block.section),
            "area": shapes.area,
            "length": lengths,
            "strength": np.nan if strength is None else strength,
            "rigidity": np.where(rigidity > 0.0, rigidity, np.nan),
            "factor": section.effective_length,
        }
        for name, each in found.items():
            values[name][own] = each
    held = [model.nodes[table.node_set] for stage in stages for table in stage.support]
    for table in (*case.spring, *case.dashpot):
        held += [model.nodes[name] for name in (table.between or (table.node_set,))]
    held += [model.nodes[name] for pair in case.contact_pair for name in (pair.first, pair.second)]
    nodes = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *held]))
    return Truss(Bars(**values), mesh.node_ids[nodes], sections)


def find_members(points: np.ndarray, ends: np.ndarray, section: np.ndarray, held: np.ndarray) -> Members:
    """Return the members of a truss, in the order of their first bars; connectors are in none.

    Parameters
    ----------
    points : (nodes, 3) positions in the mesh [m]
    ends : (bars, 2) nodes of bars, connectors among them
    section : (bars,) numbers of sections, -1 of connectors
    held : nodes at which a member ends
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, inner = len(ends), np.bincount(ends.ravel(), minlength=len(points)) == 2
    inner[held] = False
    # both bars of each node with two: sorted by node, they follow each other
    order = np.argsort(ends.ravel(), kind="stable")
    sides = order[inner[ends.ravel()[order]]].reshape(-1, 2)
    first, second = sides.T // 2
    away = points[ends.ravel()[sides ^ 1]] - points[ends.ravel()[sides[:, 0]]][:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        one, other = np.moveaxis(away / np.linalg.norm(away, axis=2, keepdims=True), 1, 0)
    straight = (np.linalg.norm(np.cross(one, other), axis=1) <= _COLLINEAR) & ((one * other).sum(axis=1) < 0.0)
    straight &= (section[first] == section[second]) & (section[first] >= 0)
    joined = coo_array((np.ones(straight.sum()), (first[straight], second[straight])), shape=(n, n))
    _, label = connected_components(joined, directed=False)
    # in the order of the first bars
    _, begins = np.unique(label, return_index=True)
    bars = np.flatnonzero(section >= 0)
    bars = bars[np.argsort(begins[label[bars]], kind="stable")]
    return Members(bars, np.flatnonzero(np.diff(begins[label[bars]], prepend=-1)))


class Instant(NamedTuple):
    """A snapshot that the table covers.

    Attributes
    ----------
    case : name of the load case, combination or stage, empty without
    snapshot : its number
    """

    case: str
    snapshot: int


def instants_of(result: Any, time: float | None, case: str | None) -> list[Instant]:
    """Return the snapshots of a table: of all or one of the cases, at a time or over the run.

    Raises
    ------
    InputError
        If there is no such case or time.
    """
    times, stages = np.asarray(result.times), result.case.stage
    names = [stage.name for stage in stages]
    if case is not None and case not in names:
        raise InputError(f"{result.path}: there is no load case, combination or stage {case!r}{nearest(case, names)}")
    if time is not None and not times[0] <= time <= times[-1] * (1.0 + _ROUNDING):
        raise InputError(f"{result.path}: --time {time:g}: snapshots are from {times[0]:g} to {times[-1]:g}")
    number, complete = _stage_of(result)
    of_cases = any(stage.starts_from is not None for stage in stages)
    # of a load case or a form, only the end is a state of the truss; before load cases is none, unless it is asked
    ends = [stage.starts_from is not None or _finds_form(stage) for stage in stages]
    wanted = [stage.starts_from is not None or not of_cases or stage.name == case for stage in stages]
    found = [Instant("", i) for i in range(len(times))]
    if stages:
        found = [
            Instant(names[k], i)
            for i, k in enumerate(number.tolist())
            if wanted[k] and (complete[i] or not ends[k]) and case in (None, names[k])
        ]
    elif _finds_form(result.case):
        found = found[-1:]
    if not found:
        what = f"no {'load case' if of_cases else 'stage'} has" if case is None else f"{case!r} has not"
        raise InputError(f"{result.path}: {what} been computed to its end")
    return found if time is None else [min(found, key=lambda each: abs(times[each.snapshot] - time))]


def unfinished(result: Any) -> list[str]:
    """Return the names of load cases and combinations that have not been computed to their ends."""
    number, complete = _stage_of(result)
    done = set(number[complete].tolist())
    return [s.name for k, s in enumerate(result.case.stage) if s.starts_from is not None and k not in done]


def _stage_of(result: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the stage of each snapshot, and whether it is that of the end of the stage."""
    times, stages = np.asarray(result.times), result.case.stage
    if not stages:
        return np.zeros(len(times), dtype=int), np.ones(len(times), dtype=bool)
    number = stage_at(result.history, times * (1.0 - _ROUNDING))
    # a path ends where it ends; other analyses where the case says
    planned = np.array([np.nan if stage.end is None else stage.end for stage in stages])[number]
    made = times - np.asarray(result.stage_ends)[number]
    return number, ~(made < planned * (1.0 - _ROUNDING)) & (made > 0.0)


def _finds_form(stage: Any) -> bool:
    """Whether an analysis finds a form, so that its start is no state of the truss."""
    return stage.static is not None and stage.static.method == "force_density"


_ENVELOPE = "largest utilisation of strength and Euler's load"
_MOST_CASES = 12  # drawings of a picture
UTILISATIONS = ("yield_utilisation", "buckling_utilisation")
"""Columns that may be empty."""


def members(
    result_path: Path | str | Any,
    *,
    per: str = "member",
    time: float | None = None,
    case: str | None = None,
    each_case: bool = False,
) -> Table:
    """Return the table of the members of a result, those with the highest utilisation first.

    A row has the state that governs its member: of the largest utilisation of strength or of Euler's load; without
    either, of the largest axial force, and rows are sorted by that. States are those of the snapshots.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    per : ``member``, or ``bar``: each bar is a row, and buckles over its own length
    time : of the snapshot nearest to it, in the unit of the result; None: the whole run
    case : name of a load case, a combination or a stage; None: all of them
    each_case : whether each of them has rows of its own, instead of one row for the one that governs

    Returns
    -------
    Columns ``member`` (number), ``bars`` (numbers, from 0), ``section``, ``length`` [m], ``axial_force`` [N], tension
    positive, ``stress`` [Pa], ``yield_utilisation``, ``buckling_utilisation`` (NaN where there is none), ``case``,
    ``time`` of the snapshot, and over all states ``tension``, ``compression`` [N], the largest and the smallest axial
    force, 0 without any.

    Raises
    ------
    InputError
        If the result has no axial forces or no such case, or its mesh is not there any more.
    """
    from .chart import opened

    if per not in PER:
        raise InputError(f"members: per = {per!r}: expected one of {', '.join(PER)}")
    with opened(result_path) as result:
        instants = instants_of(result, time, case)
        if _FORCE not in result.cell_fields:
            raise InputError(
                f"{result.path}: has no field {_FORCE}; name it in output.fields of the case, and run it again"
            )
        truss = truss_of(result)
        if per == "bar":
            own = np.flatnonzero(truss.bars.section >= 0)
            found = Members(own, np.arange(len(own)))
        else:
            points = np.asarray(result.positions(0), dtype=float)
            found = find_members(points, result.bars, truss.bars.section, truss.held)
        groups: dict[str, list[Instant]] = {}
        for instant in instants:
            groups.setdefault(instant.case if each_case else "", []).append(instant)
        tables = [_governing(result, truss, found, group) for group in groups.values()]
    columns = {name: np.concatenate([each[name] for each in tables]) for name in tables[0]}
    utilised = ~np.isnan(np.fmax(*(columns[name] for name in UTILISATIONS)))
    order = np.lexsort([-columns.pop("measure"), ~utilised])
    return Table({name: values[order] for name, values in columns.items()})


def _governing(result: Any, truss: Truss, found: Members, instants: Sequence[Instant]) -> dict[str, np.ndarray]:
    """Return the columns (members,) of the table, with the state of the largest ``measure`` of each member."""
    count = len(found.first)
    governing, number = {"measure": np.full(count, -1.0)}, np.zeros(count, dtype=int)
    tension, compression = np.zeros(count), np.zeros(count)
    for k, instant in enumerate(instants):
        force = np.asarray(result.field(_FORCE, instant.snapshot), dtype=float)
        state = _state(truss.bars, found, force)
        tension, compression = np.maximum(tension, found.most(force)), np.minimum(compression, found.least(force))
        taken = state["measure"] > governing["measure"]
        number[taken] = k
        governing = {name: np.where(taken, values, governing.get(name, values)) for name, values in state.items()}
    return {
        "member": np.arange(count),
        "bars": np.array([_numbers(part) for part in np.split(found.bars, found.first[1:])]),
        "section": np.array(truss.sections)[truss.bars.section[found.bars[found.first]]],
        "length": found.total(truss.bars.length),
        **governing,
        "case": np.array([instant.case for instant in instants])[number],
        "time": np.asarray(result.times)[[instant.snapshot for instant in instants]][number],
        "tension": tension,
        "compression": compression,
    }


def _state(bars: Bars, members: Members, force: np.ndarray) -> dict[str, np.ndarray]:
    """Return columns (members,) of a state, from axial forces (bars,) [N], and the ``measure`` by which it governs."""
    stress = force / bars.area
    least, most = members.least(force), members.most(force)
    with np.errstate(invalid="ignore", divide="ignore"):
        strength = members.most(np.abs(stress) / bars.strength)
        length = members.total(bars.length) * members.most(bars.factor)
        buckling = np.maximum(-least, 0.0) * length**2 / (np.pi**2 * members.least(bars.rigidity))
    # where compression governs by buckling, its force is the one to show
    governs = np.nan_to_num(buckling, nan=-1.0) > np.nan_to_num(strength, nan=-1.0)
    pushed = (-least > most) | governs
    shown = np.where(pushed, least, most)
    largest = np.fmax(strength, buckling)
    return {
        _FORCE: shown,
        "stress": np.where(pushed, members.least(stress), members.most(stress)),
        "yield_utilisation": strength,
        "buckling_utilisation": buckling,
        "measure": np.where(np.isnan(largest), np.abs(shown), largest),
    }


def _numbers(bars: np.ndarray) -> str:
    """Return numbers as text: ``3``, ``3-7`` for those in a row, ``3 8 12``."""
    ordered = np.sort(bars)
    if len(ordered) > 2 and ordered[-1] - ordered[0] == len(ordered) - 1:
        return f"{ordered[0]}-{ordered[-1]}"
    return " ".join(map(str, ordered.tolist()))


def _bars_of(text: str) -> list[int]:
    """Return the numbers that :func:`_numbers` has written."""
    first, _, last = text.partition("-")
    return list(range(int(first), int(last) + 1) if last else map(int, first.split()))


def draw_members(
    result_path: Path | str | Any, table: Table, file: Path | str, each_case: bool = False, **options: Any
) -> Path:
    """Draw the truss with each bar in the colour of the utilisation of its member; return the file.

    Parameters
    ----------
    result_path : result file or its folder, or an open result
    table : of :func:`members`, of the same result
    file : PNG file
    each_case : whether each load case, combination or stage of the table has a drawing of its own
    options : see :class:`~pfem_petsc.post.options.Options`

    Raises
    ------
    InputError
        If no member has a utilisation, there are too many cases, or the picture cannot be made.
    """
    from .chart import opened
    from .motion import Frames
    from .options import Options
    from .render import Film, save

    values = np.fmax(table["yield_utilisation"], table["buckling_utilisation"])
    if not np.any(np.isfinite(values)):
        raise InputError(
            "members: nothing to draw: utilisations need a yield_stress or design_strength of the material, or a "
            "shape or second_moment of the section"
        )
    cases, number = np.unique(table["case"], return_inverse=True)
    if not each_case:
        cases, number = np.array([_ENVELOPE]), np.zeros_like(number)
    if len(cases) > _MOST_CASES:
        raise InputError(
            f"members: a picture has at most {_MOST_CASES} drawings, and the table has {len(cases)} cases: draw one "
            "with case (--case NAME), or the envelope of all without each_case (--each-case)"
        )
    with opened(result_path) as result:
        each = np.zeros((len(cases), len(result.bars)))
        for bars, row, value in zip(table["bars"], number, values, strict=True):
            chosen = _bars_of(str(bars))
            each[row, chosen] = np.fmax(each[row, chosen], value)
        names = [stage.name for stage in result.case.stage]
        order = sorted(range(len(cases)), key=lambda k: names.index(cases[k]) if cases[k] in names else 0)
        # the first snapshot, with the utilisations as its field, once for each case
        drawn = Frames(
            result,
            times=np.repeat(result.times[:1], len(cases)),
            positions=lambda snapshot: result.positions(0),
            point_fields=(),
            cell_fields=("utilisation",),
            field=lambda name, i: each[order[i]] if name == "utilisation" else result.field(name, 0),
            caption=lambda snapshot: str(cases[order[snapshot]]),
            instants=lambda count: list(range(len(cases))),
        )
        defaults = {"field": "utilisation", "clim": (0.0, max(1.0, float(each.max())))}
        film = Film([drawn], Options(frames=list(range(len(cases))), **(defaults | options)), lambda _: None)
        if len(cases) == 1:
            film.start(film.options.size)
        file = save(film.frame(0) if len(cases) == 1 else film.poster(), Path(file))
        film.close()
    return file
