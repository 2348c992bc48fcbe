"""All bars of a rank, in blocks of one section each, evaluated by compiled loops that call their laws."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..case.tables import FIELD_KEYS, FieldValue
from ..columns import BAR_ENERGIES, OF_BARS, STATUS, STORED
from ..errors import InputError
from ..mesh import load_slab
from ..mesh.distribution import bars_of_group, group_hint
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from .chunk_laws import STRESS, densities_row, evaluate, first_class, flatten, law_loops, work_rows
from .compiled import by_reference
from .elements import (
    MEASURES,
    ElementFamily,
    ForceElements,
    MatrixRows,
    add_step_forces,
    add_step_tangents,
    add_tangents,
    bar_lengths,
    first_inverted,
)
from .internal_forces import (
    BarArrays,
    StepStart,
    internal_forces,
    known_rates,
    new_workspace,
    states,
    step_coefficients,
    stiffnesses,
)
from .layout import (
    FORCES,
    NO_BAR,
    BarLayout,
    aligned,
    clear,
    join_components,
    make_layout,
    new_components,
    split_components,
)
from .materials.base import BarShapes, Law, UnsuitableBarError, internal_variables, law_of
from .rupture import breakable, intact, limit_values
from .springs import Springs, connected, connector_modulus

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import BarProbe, Section
    from ..mesh.distribution import DistributedMesh
    from ..mesh.slab import MeshSlab
    from .elements import BlockPattern


def bar_shapes(section: Section, length: np.ndarray, area: np.ndarray) -> BarShapes:
    """Return the shapes of bars of a section from their lengths [m] and areas [m2], both (b,)."""
    found = section.cross_section(area)
    each = [np.broadcast_to(np.asarray(value, dtype=float), length.shape) for value in found[:4]]
    return BarShapes(length, *each, section.effective_length * length)


_SHOWN = 12
"""Number of values of a field that messages list."""


def bar_fields(case: Case) -> dict[str, str]:
    """Return the cell fields of the mesh whose values sections take, each with the key that names it."""
    named = [(s, key, f"{case.source}: section.{name}.{key}") for name, s in case.section.items() for key in FIELD_KEYS]
    return {getattr(section, key): text for section, key, text in reversed(named) if getattr(section, key) is not None}


def _bar_groups(case: Case) -> Iterator[tuple[str, str | FieldValue]]:
    """Yield the groups of bars that a case names, each with its key."""
    tables = [(f"section.{name}", section) for name, section in case.section.items()]
    if case.self_contact is not None:
        tables.append(("self_contact", case.self_contact))
    for kind in ("temperature", "remove"):
        tables += [(f"{kind}[{i}]", entry) for i, entry in enumerate(getattr(case, kind))]
    tables += [(f"output.bar_probe[{i}]", entry) for i, entry in enumerate(case.output.bar_probe)]
    for key, table in tables:
        if table.bars is not None:
            yield f"{case.source}: {key}.bars", table.bars


def mesh_of_cases(cases: Sequence[Case], comm: MPI.Comm) -> MeshSlab:
    """Return this rank's part of the mesh of a case and its stages, with all groups and areas that they use.
    Collective.

    Raises
    ------
    InputError
        On all ranks, as :func:`~pfem_petsc.mesh.load_slab`, and if no bar or node has a value that selects some.
    """
    case = cases[0]
    groups = {name for each in cases for _, name in _bar_groups(each) if isinstance(name, str)}
    groups |= {node_set.group for node_set in case.node_set.values() if node_set.group is not None}
    values = {field: key for each in reversed(cases) for field, key in bar_fields(each).items()}
    fields = {chosen.field: key for key, chosen, _ in reversed(selections(cases))} | values
    slab = load_slab(case.mesh, comm, fields, groups)
    for name, key in values.items():
        if name not in slab.bar_fields:
            raise InputError(f"{key} = {name!r}: {slab.source} has this field for nodes, not for bars")
    select(slab, cases, comm)
    slab.bar_fields, slab.node_fields = {name: slab.bar_fields[name] for name in values}, {}
    return slab


def selections(cases: Sequence[Case]) -> list[tuple[str, FieldValue, bool]]:
    """Return what cases select by values of fields of the mesh: the key, the value, and whether these are nodes."""
    found = [(key, group, False) for case in cases for key, group in _bar_groups(case) if isinstance(group, FieldValue)]
    for name, node_set in cases[0].node_set.items():
        if node_set.selection is not None:
            found.append((f"{cases[0].source}: node_set.{name}.field", node_set.selection, True))
    return found


def select(slab: MeshSlab, cases: Sequence[Case], comm: MPI.Comm) -> None:
    """Add the groups of a mesh that cases select by values of its fields. Collective."""
    for key, chosen, nodes in selections(cases):
        of_nodes = nodes and chosen.field in slab.node_fields
        values = (slab.node_fields if of_nodes else slab.bar_fields).get(chosen.field)
        if values is None:
            raise InputError(f"{key}: {slab.source} has the field {chosen.field!r} for nodes, not for bars")
        members = np.flatnonzero(values == chosen.value)
        if comm.allreduce(len(members)) == 0:
            several = comm.allgather(np.unique(values[np.isfinite(values)])[:_SHOWN].tolist())
            there = ", ".join(f"{value:g}" for value in sorted({value for own in several for value in own})[:_SHOWN])
            what = "node" if of_nodes else "bar"
            raise InputError(f"{key}: no {what} of {slab.source} has {chosen}; the field has values like {there}")
        if not nodes:
            slab.bar_groups[str(chosen)] = slab.first_bar + members
        elif of_nodes:
            slab.node_groups[str(chosen)] = slab.first_node + members
        else:
            ends = np.unique(slab.bars[members]).astype(np.int64)
            slab.node_groups[str(chosen)] = np.unique(Router(comm, slab_of(ends, slab.n_nodes, comm.size)).send(ends))


def check_areas(case: Case, slab: MeshSlab, sections: np.ndarray) -> None:
    """Refuse areas of a mesh field that are not positive. ``sections``: of :func:`section_of_bars`.

    Raises
    ------
    InputError
        Names the first such bar of this rank.
    """
    for index, (name, section) in enumerate(case.section.items()):
        if section.area_field is None:
            continue
        values = slab.bar_fields[section.area_field]
        wrong = np.flatnonzero((sections == index) & ~((values > 0.0) & np.isfinite(values)))
        if len(wrong):
            key = f"{case.source}: section.{name}.area_field = {section.area_field!r}"
            raise InputError(
                f"{key}: bar {wrong[0] + slab.first_bar} of {slab.source} (and {len(wrong) - 1} more here) has "
                f"{values[wrong[0]]:g} m2; give each bar of the section an area > 0"
            )
        thickness, diameter = section.thickness or 0.0, section.diameter or np.inf
        for size, unsuitable in (
            (f"thickness = {thickness!r} m is too much", values < np.pi * thickness**2),
            (f"diameter = {diameter!r} m is too little", values > 0.25 * np.pi * diameter**2),
        ):
            bars = np.flatnonzero(unsuitable & (sections == index)) if section.shape is not None else ()
            if len(bars):
                raise InputError(
                    f"{case.source}: section.{name}.{size} for the tube of bar {bars[0] + slab.first_bar}, whose area "
                    f"is {values[bars[0]]:g} m2"
                )


def section_of_bars(case: Case, slab: MeshSlab) -> np.ndarray:
    """Return the section index (m,) int32 of each bar of a slab: the section that names its group, else the default.

    Raises
    ------
    InputError
        If a section names a group that the mesh does not have, or a bar has two sections or none.
    """
    if [section.bars for section in case.section.values()] == [None]:
        return np.broadcast_to(np.int32(0), len(slab.bars))  # without memory of its own
    chosen = np.full(len(slab.bars), -1, dtype=np.int32)
    for index, (name, section) in enumerate(case.section.items()):
        if section.bars is None:
            continue
        group = str(section.bars)
        if group not in slab.bar_groups:
            hint = group_hint(case, group, sorted(slab.bar_groups), "Curve")
            raise InputError(
                f"{case.source}: section.{name}.bars = {group!r}: no such bar group in {slab.source}{hint}"
            )
        members = slab.bar_groups[group] - slab.first_bar
        taken = members[chosen[members] >= 0]
        if len(taken):
            other = list(case.section)[chosen[taken[0]]]
            raise InputError(
                f"{case.source}: section.{name}.bars: bar {taken[0] + slab.first_bar} already belongs to section "
                f"{other!r}; give each bar one section"
            )
        chosen[members] = index
    default = [i for i, section in enumerate(case.section.values()) if section.bars is None]
    if default:
        chosen[chosen < 0] = default[0]
    bare = np.flatnonzero(chosen < 0)
    if len(bare):
        raise InputError(
            f"{case.source}: section: bar {bare[0] + slab.first_bar} of {slab.source} (and {len(bare) - 1} more here) "
            "has no section; add a section without 'bars' as the default"
        )
    return chosen


@dataclass(eq=False)
class BarBlock:
    """Local bars [start, stop) of one section, of which [start, counted) are counted on this rank.

    ``area`` [m2] is a number, or (stop - start,) if it differs from bar to bar. ``modulus`` is the largest tangent
    modulus of the law [Pa]; ``columns`` (rows, columns) has the data kept from step to step, ``law.rows`` and after
    them ``law.bar_data``, in the columns of the ``layout`` for the section of this ``index``.
    """

    section: str
    start: int
    counted: int
    stop: int
    area: float | np.ndarray
    density: float
    damping: float
    thermal_expansion: float
    law: Law
    measure: Callable
    parameters: tuple[float, ...]
    modulus: float
    layout: BarLayout
    index: int
    columns: np.ndarray

    @property
    def column_of(self) -> np.ndarray:
        """Columns (stop - start,) of its bars among those of the section."""
        return self.layout.column_of[self.start : self.stop] - self.layout.columns(self.index).start

    def row(self, number: int) -> np.ndarray:
        """Return a copy (stop - start,) of a row of the data kept from step to step."""
        return self.columns[number, self.column_of]

    def put_row(self, number: int, values: Any) -> None:
        """Set a row of these data to values (stop - start,) or a number.

        Columns without a bar have the ``bar_data`` of the first one, as laws need not have a stress for zeros.
        """
        values = np.broadcast_to(values, self.stop - self.start)
        self.columns[number] = values[0] if number >= len(self.law.rows) and len(values) else 0.0
        self.columns[number, self.column_of] = values

    @property
    def history(self) -> np.ndarray:
        """Copy of all these data (rows, stop - start), which cannot be changed."""
        rows = self.columns[:, self.column_of]
        rows.flags.writeable = False
        return rows

    @property
    def counted_area(self) -> float | np.ndarray:
        """Area of the counted bars [m2], a number or (counted - start,)."""
        return self.area if isinstance(self.area, float) else self.area[: self.counted - self.start]

    def variables(self) -> Iterator[tuple[str, str, np.ndarray]]:
        """Yield name, unit and a copy of the values (stop - start,) of all data kept from step to step."""
        for number, (name, unit) in enumerate(self.law.rows):
            yield name, unit, self.row(number)


def laws_of(case: Case) -> dict[str, Law]:
    """Return the law of each material that a section has, by its name; that of bars that can leave the model is
    breakable."""
    laws = {section.material: law_of(case.material[section.material]) for section in case.section.values()}
    for name, law in laws.items():
        if case.material[name].rupture is not None or case.removes_bars:
            laws[name] = breakable(law)
    return laws


def make_blocks(mesh: DistributedMesh, case: Case) -> tuple[list[BarBlock], BarLayout, np.ndarray]:
    """Return the blocks of this rank, without data of single bars, their layout, and the history of all."""
    laws, names, blocks = laws_of(case), list(case.section), []
    layout = make_layout(mesh.bars, [(block.start, block.counted, block.stop) for block in mesh.blocks])
    sizes = [layout.columns(k).stop - layout.columns(k).start for k in range(len(mesh.blocks))]
    kept = [laws[case.section[names[block.section]].material] for block in mesh.blocks]
    counts = [len(law.rows) + len(law.bar_data) for law in kept]
    room, begun = aligned(sum(size * count for size, count in zip(sizes, counts, strict=True))), 0
    for index, block in enumerate(mesh.blocks):
        section = case.section[names[block.section]]
        material = case.material[section.material]
        law, measure = laws[section.material], MEASURES[material.strain]
        area = None if section.area_field is None else mesh.bar_fields[section.area_field]
        blocks.append(
            BarBlock(
                section=names[block.section],
                start=block.start,
                counted=block.counted,
                stop=block.stop,
                area=section.uniform_area if area is None else area[block.start : block.stop].copy(),
                density=material.density,
                damping=material.damping,
                thermal_expansion=material.thermal_expansion,
                law=law,
                measure=measure,
                parameters=(*(limit_values(material.rupture) if law.rupture >= 0 else ()), *material.numbers()),
                modulus=material.upper_modulus(),
                layout=layout,
                index=index,
                columns=room[begun : begun + sizes[index] * counts[index]].reshape(counts[index], sizes[index]),
            )
        )
        begun += sizes[index] * counts[index]
    return blocks, layout, room


_LOADING = 1e-8  # relative change of all lengths that distinguishes the tangents of loading and unloading
_KINK = 1e-6  # relative difference of these tangents above which the bar is at a kink of its law


_LOST = np.array([name not in STORED for name in BAR_ENERGIES])


class StrainEnergy(NamedTuple):
    """Sums over the bars counted on this rank, and its springs, in the order of
    :data:`~pfem_petsc.columns.BAR_ENERGIES` [J], the first collapsed bar (local index, -1: none), whether any bar is
    so short that it may be inverted, and how many local bars have changed their state of rupture."""

    energies: tuple[float, ...] = (0.0,) * len(BAR_ENERGIES)
    failed: int = -1
    shortened: bool = False
    changed: int = 0

    def of(self, name: str) -> float:
        """Return the energy of a name [J]."""
        return self.energies[BAR_ENERGIES.index(name)]

    @property
    def total(self) -> float:
        """Stored and dissipated energy [J]."""
        return sum(self.energies)


class Bars:
    """Internal forces, tangents and energies of the bars of this rank.

    Attributes
    ----------
    ends : (b, 2) int32, local node indices of each bar
    mesh_lengths : (b,) float64, lengths in the mesh [m]
    mass_lengths : (b,) the same, or rest lengths that sections give, which determine mass and damping
    rest_at_start : (b,) the same at the start of the step, or (0,) if they are constant
    heat_at_start : :attr:`heat` at the start of the step, if it varies
    arrays : what compiled loops read
    components : (3, stride) twice, room for positions and forces of nodes by components
    can_break : whether bars of the case can leave the model
    step : time from the start of the step to the evaluated positions [s]; 0 at the start of a run, infinite in static
        analyses
    internal : name and unit of the internal variables of all laws of the case
    kept_names : names of all data that laws keep from step to step, the same on all ranks
    blocks : bars by section
    viscous : whether bars of the case have a viscous stress, the same on all ranks
    viscous_blocks : those of them on this rank
    families : other elements, whose forces and stiffness are added to those of the bars
    touching : contact of bars with bars, whose forces alone are added; None without
    """

    def __init__(self, mesh: DistributedMesh, case: Case) -> None:
        self.mesh, self.case = mesh, case
        self.ends = mesh.bars
        self.mesh_lengths = np.empty(len(mesh.bars))
        bar_lengths(mesh.points, mesh.bars, self.mesh_lengths)
        self.families: list[ElementFamily] = []
        self.touching: ForceElements | None = None
        self.rest_at_start = np.empty(0)
        self.step = 0.0
        self.internal = internal_variables(case.material)
        self.blocks, layout, history = make_blocks(mesh, case)
        self._lists: dict[str, Any] = {}
        self._reference = self._referred = None
        self.components = new_components(len(mesh.points)), new_components(len(mesh.points), FORCES)
        self.arrays = self._make_arrays(layout, history)
        self.rest = self.mass_lengths = self.mesh_lengths
        self.heat_at_start = self.heat
        for block in self.blocks:
            if block.law.bar_data:
                self._fill_bar_data(block)
        self.viscous_blocks = [block for block in self.blocks if block.law.known_rate >= 0]
        laws = laws_of(case).values()
        self.can_break = any(law.rupture >= 0 for law in laws)
        self.viscous = any(law.known_rate >= 0 for law in laws)
        self._watched = np.empty(len(mesh.bars) if self.can_break else 0)
        self.kept_names = list(dict.fromkeys(name for law in laws for name, _ in law.rows))

    def _make_arrays(self, layout: BarLayout, history: np.ndarray) -> BarArrays:
        """Return what compiled loops read, without rest lengths."""
        blocks, empty = self.blocks, np.empty(0)
        numbers = [flatten(block.parameters)[0] for block in blocks]
        parameters = np.zeros((len(blocks), max(map(len, numbers), default=0)))
        for row, values in zip(parameters, numbers, strict=True):
            row[: len(values)] = values
        energies = np.full((len(blocks), len(BAR_ENERGIES)), -1)
        for row, block in zip(energies, blocks, strict=True):
            row[: len(block.law.energies)] = [BAR_ENERGIES.index(name) for name in block.law.energies]
        areas = empty
        if any(not isinstance(block.area, float) for block in blocks):
            areas = aligned(int(layout.starts[-1]))
            areas[layout.column_of] = self.of_blocks(lambda block: block.area)
        sizes = np.cumsum([0, *(block.columns.size for block in blocks)])[:-1]

        def numbers_of(value: Callable[[BarBlock], Any], kind: type = np.int64) -> np.ndarray:
            return np.array([value(block) for block in blocks], dtype=kind)

        return BarArrays(
            layout,
            empty,
            np.empty((2, 0)),
            numbers_of(lambda block: block.area if isinstance(block.area, float) else np.nan, float),
            areas,
            numbers_of(lambda block: list(MEASURES.values()).index(block.measure)),
            parameters,
            history,
            sizes,
            numbers_of(lambda block: len(block.law.rows)),
            numbers_of(lambda block: len(block.columns)),
            numbers_of(lambda block: len(block.law.internal) if block.law.rate else -1),
            numbers_of(lambda block: block.law.rupture),
            energies,
            new_workspace(max((work_rows(block.law) for block in blocks), default=1)),
        )

    @property
    def reference(self) -> Any:
        """:attr:`arrays` as compiled loops take them."""
        if self._referred is not self.arrays:
            self._reference, self._referred = by_reference(self.arrays), self.arrays
        return self._reference

    @property
    def rest(self) -> np.ndarray:
        """Rest lengths (b,) [m]."""
        return self._rest

    @rest.setter
    def rest(self, values: np.ndarray) -> None:
        values = values if values.flags.writeable else values.copy()
        self._rest, self._lengths = values.view(), values  # compiled loops distinguish arrays that cannot be changed
        self._rest.flags.writeable = False
        layout = self.arrays.layout
        spread = aligned(int(layout.starts[-1]))
        spread[:] = NO_BAR
        spread[layout.column_of] = values
        self.arrays = self.arrays._replace(rest=spread)

    def set_rest(self, part: slice, values: Any) -> None:
        """Set the rest lengths of some bars [m]."""
        rest = self.rest.copy()
        rest[part] = values
        self.rest = rest

    @property
    def heat(self) -> np.ndarray:
        """Thermal strains and temperatures (2, b) [K], or (2, 0) without temperatures."""
        return self.arrays.heat

    @heat.setter
    def heat(self, values: np.ndarray) -> None:
        self.arrays = self.arrays._replace(heat=values)

    def put_parameters(self, block: BarBlock, parameters: tuple[Any, ...]) -> None:
        """Give a law other numbers of the same form."""
        values, block.parameters = flatten(parameters)[0], parameters
        self.arrays.parameters[block.index, : len(values)] = values

    def loops(self, kind: str) -> Any:
        """Return the loops of the laws of all blocks, ``brief``, ``full`` or ``mean``, see
        :func:`~pfem_petsc.mechanics.chunk_laws.law_loops`; they are compiled when they are first needed."""
        if kind not in self._lists:
            made = [getattr(law_loops(block.law, flatten(block.parameters)[1]), kind) for block in self.blocks]
            self._lists[kind] = first_class(made)
        return self._lists[kind]

    @property
    def springs(self) -> Springs | None:
        """Springs from nodes to the ground; None without."""
        return next((family for family in self.families if isinstance(family, Springs)), None)

    @property
    def _all_families(self) -> list[ForceElements]:
        return [*self.families, *([] if self.touching is None else [self.touching])]

    @property
    def slackens(self) -> bool:
        """Whether bars of the case can be slack, the same on all ranks."""
        return "slack" in self.internal

    @property
    def has_status(self) -> bool:
        """Whether bars of the case can have another status than intact, the same on all ranks."""
        return self.slackens or self.can_break

    def slack_count(self) -> int:
        """Return the number of counted bars that are slack."""
        slack = self.status() == STATUS.index("slack")
        return sum(int(np.count_nonzero(slack[b.start : b.counted])) for b in self.blocks)

    def tighten(self) -> bool:
        """Make bars that are slack in the mesh just taut there; return whether there are any on this rank."""
        found = False
        for block in self.blocks:
            if block.law.slack_row < 0:
                continue
            part = slice(block.start, block.stop)
            heat, rest = self.heat[:, part], self.rest[part].copy()
            shift = heat[0] if heat.shape[1] else 0.0
            slack = self.mesh_lengths[part] < (1.0 - 1e-12) * (1.0 + shift) * rest
            rest[slack] = self.mesh_lengths[part][slack]
            self.set_rest(part, rest)
            if heat.shape[1]:
                heat[0, slack] = 0.0
            found |= bool(slack.any())
        return found

    def status(self) -> np.ndarray:
        """Return the status (b,) of each local bar, of :data:`~pfem_petsc.columns.STATUS`."""
        status = np.full(len(self.ends), float(STATUS.index("intact")))
        for block in self.blocks:
            if block.law.slack_row >= 0:
                slack = block.row(block.law.slack_row) != 0.0
                status[block.start : block.stop][slack] = STATUS.index("slack")
        if self.can_break:
            status[self.rupture() != 0.0] = STATUS.index("broken")
        return status

    def forces(self, x: np.ndarray, f: np.ndarray, commit: bool) -> StrainEnergy:
        """Compute internal forces ``f`` (local nodes, 3) [N] at positions ``x``; valid for owned nodes. Internal
        variables are updated only if ``commit``."""
        energies, (places, forces) = np.zeros(len(BAR_ENERGIES)), self.components
        split_components(x, places)
        clear(forces)
        failed, shortened, changed = internal_forces(
            places, forces, self.reference, self.loops("full"), self.step, commit, energies
        )
        join_components(forces, f)
        for family in self._all_families:
            for name, energy in zip(family.energies, family.add_forces(x, f, commit), strict=True):
                energies[BAR_ENERGIES.index(name)] += energy
        return StrainEnergy(tuple(energies.tolist()), failed, shortened, changed)

    def set_rates(self, x0: np.ndarray, x: np.ndarray, v: np.ndarray, eta: float) -> None:
        """Give viscous bars the strain rate at the positions x + dx with the velocities v + eta dx, linear in the
        strain; all (local nodes, 3), with ghosts, and ``x0`` at the start of the step. ``x`` is held fixed for eta = 0.
        """
        for block in self.viscous_blocks:
            known = np.empty(block.stop - block.start)
            known_rates(self.ends, self.reference, block.index, self.step, (x0, x, v, eta), known)
            block.put_row(block.law.known_rate, known)
            if self.step > 0.0:
                self.put_parameters(block, (*block.parameters[:-1], eta * self.step))

    def extrapolate_rates(self, ratio: float) -> None:
        """Extrapolate the strain rates of viscous bars from the last two steps, whose sizes have this ratio, and those
        of the steps before the inverse one."""
        for block in self.viscous_blocks:
            self.put_parameters(block, (*block.parameters[:-1], 1.0 + ratio / (1.0 + ratio)))
            block.put_row(block.law.known_rate, ratio * block.row(block.law.known_rate))

    @contextmanager
    def at_step(self, step: float, eta: float) -> Iterator[None]:
        """Evaluate bars with another ``step``, viscous ones with ``eta`` as in :meth:`set_rates`."""
        kept = self.step, [block.parameters for block in self.viscous_blocks]
        self.step = step
        for block in self.viscous_blocks if 0.0 < step < np.inf else ():
            self.put_parameters(block, (*block.parameters[:-1], eta * step))
        try:
            yield
        finally:
            self.step = kept[0]
            for block, parameters in zip(self.viscous_blocks, kept[1], strict=True):
                self.put_parameters(block, parameters)

    @contextmanager
    def without_rates(self) -> Iterator[None]:
        """Evaluate bars at rest: laws with a rate have the step zero, and there is no viscous stress."""
        step, kept = self.step, [block.row(block.law.known_rate) for block in self.viscous_blocks]
        self.step = 0.0
        self.forget_rates()
        try:
            yield
        finally:
            self.step = step
            for block, rates in zip(self.viscous_blocks, kept, strict=True):
                block.put_row(block.law.known_rate, rates)

    def forget_rates(self) -> None:
        """Set the known strain rates of viscous bars to zero."""
        for block in self.viscous_blocks:
            block.put_row(block.law.known_rate, 0.0)

    def keep_start(self) -> None:
        """Store temperatures and rest lengths as those of the start of the next step."""
        self.heat_at_start[:] = self.heat
        if len(self.rest_at_start):
            self.rest_at_start[:] = self.rest

    def first_inverted(self, x: np.ndarray, before: np.ndarray) -> int:
        """Return the first local bar that passed through zero length from positions ``before`` to ``x``, or -1.

        Lengths alone do not show this, because a bar can jump over zero in one step. Stretched bars are not checked.
        """
        return first_inverted(x, before, self.ends, self.watched)

    def tangents(
        self,
        x: np.ndarray,
        weight: float,
        inertia: list[float],
        pattern: BlockPattern,
        values: np.ndarray,
        start: np.ndarray | None = None,
        stored: np.ndarray | None = None,
    ) -> None:
        """Add ``weight`` K_t(x) and the consistent inertia (a coefficient per block) to the values of a matrix; with
        positions ``start``, the derivative of :meth:`step_forces` from there in the place of K_t; else with ``stored``
        (2, b), the stiffness of bars that these are, see :meth:`stiffnesses`."""
        rows = MatrixRows(pattern.ptr, pattern.slots, values, self.ends)
        mass = np.zeros(len(self.ends))
        for block, m in zip(self.blocks, inertia, strict=True):
            mass[block.start : block.stop] = m * self.mass_lengths[block.start : block.stop]
        if start is not None:
            coefficients = np.zeros((2, len(self.ends)))
            self._step_coefficients(start, x, coefficients)
            add_step_tangents(start, x, coefficients, weight, mass, rows)
        else:
            if stored is None:
                stored = np.zeros((2, len(self.ends)))
                if weight:
                    self.stiffnesses(x, weight, stored)
            add_tangents(x, stored, mass, rows)
        for family in self.families:  # in a step, their force is that at its middle
            family.add_tangents(weight if start is None else 0.5 * weight, pattern, values)

    def state_stiffness(self, x: np.ndarray) -> np.ndarray:
        """Return the stiffness of the bars (2, b) in the state at ``x``, as :meth:`stiffnesses`.

        If the law has a kink at the state, as on the yield surface, dN/dl is the larger one, that of unloading: small
        motions about the state do not yield further. The strain rate has no effect.
        """
        stored, *around = np.zeros((3 if self.kept_names else 1, 2, len(self.rest)))
        square = self.lengths(x) ** 2
        with self.without_rates():
            self.stiffnesses(x, 1.0, stored)
            for factor, side in zip((1.0 - _LOADING, 1.0 + _LOADING), around, strict=False):
                self.stiffnesses(factor * x, 1.0, side)
                side[0] *= factor**2
        if around:
            tangent = stored[0] * square + stored[1]
            larger = np.maximum(*(side[0] * square + side[1] for side in around))
            kink = larger - tangent > _KINK * np.abs(larger)
            stored[0, kink] = ((larger - stored[1]) / square)[kink]
        return stored

    def stiffnesses(self, x: np.ndarray, weight: float, stored: np.ndarray) -> None:
        """Fill ``stored`` (2, b) with c = (dN/dl - N/l)/l^2 [N/m3] and g = N/l [N/m], times ``weight``: the stiffness
        of a bar with end difference d is c d d^T + g I; without springs."""
        split_components(x, self.components[0])
        stiffnesses(self.components[0], self.reference, self.loops("full"), self.step, weight, stored)

    def _step_coefficients(self, x0: np.ndarray, x: np.ndarray, out: np.ndarray) -> None:
        start = StepStart(x0, self.rest_at_start, self.heat_at_start)
        step_coefficients(x, self.ends, self.reference, self.loops("mean"), self.step, start, out)

    def step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Compute discrete-gradient forces ``f`` (local nodes, 3) [N] of a step from ``x0`` to ``x``."""
        f[:] = 0.0
        coefficients = np.empty((2, len(self.ends)))
        self._step_coefficients(x0, x, coefficients)
        add_step_forces(x0, x, self.ends, coefficients, f)
        for family in self._all_families:
            family.add_step_forces(x0, x, f)

    def lengths(self, x: np.ndarray) -> np.ndarray:
        """Return the length (b,) of each local bar [m]."""
        lengths = np.empty_like(self.rest)
        bar_lengths(x, self.ends, lengths)
        return lengths

    def _fill_bar_data(self, block: BarBlock) -> None:
        """Give the law of a block what it reads of each bar."""
        material = self.case.section[block.section].material
        try:
            for number, values in enumerate(self.case.material[material].pack_bars(self._shapes(block))):
                block.put_row(len(block.law.rows) + number, values)
        except UnsuitableBarError as error:
            bar = self.mesh.bar_ids[block.start + error.bar]
            raise InputError(
                f"{self.case.source}: section.{block.section} with material.{material}: bar {bar}: {error.reason}"
            ) from error

    def _shapes(self, block: BarBlock) -> BarShapes:
        lengths = self.mesh_lengths[block.start : block.stop]
        return bar_shapes(self.case.section[block.section], lengths, np.broadcast_to(block.area, lengths.shape))

    def of_blocks(self, value: Callable[[BarBlock], Any]) -> np.ndarray:
        """Return values (b,) of all local bars from those of each block, a number or (stop - start,)."""
        out = np.empty(len(self.ends))
        for block in self.blocks:
            out[block.start : block.stop] = value(block)
        return out

    def radii(self) -> np.ndarray:
        """Return the outer radius (b,) [m] of each local bar: of its shape, else of the circle of its area."""

        def radius(block: BarBlock) -> np.ndarray | float:
            if not isinstance(block.area, float):
                return self._shapes(block).radius
            return float(self.case.section[block.section].cross_section().radius)  # that of each of them

        return self.of_blocks(radius)

    def euler_loads(self) -> np.ndarray:
        """Return pi^2 E I/(K L)^2 (b,) [N] of each local bar, with its length L in the mesh and I, K of its section;
        infinite if the section has neither a shape nor a second moment."""

        def load(block: BarBlock) -> np.ndarray | float:
            section = self.case.section[block.section]
            if section.shape is None and section.second_moment is None:
                return np.inf
            shapes = self._shapes(block)
            young = self.case.material[section.material].young_modulus
            with np.errstate(divide="ignore"):
                force = np.pi**2 * young * shapes.second_moment / shapes.effective_length**2
            return np.where(shapes.second_moment > 0.0, force, np.inf)

        return self.of_blocks(load)

    def fields(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return, per local bar at the end of the last step, ``strain``, ``stress`` [Pa], ``axial_force`` [N],
        ``plastic_strain``, and the internal variables of the case's laws; zero for bars without such a variable."""
        out = dict(zip(("strain", "stress", "axial_force"), self.axial(x), strict=True))
        out |= {name: np.zeros(len(self.ends)) for name in ("plastic_strain", *self.internal)}
        for block in self.blocks:
            for name, _, values in block.variables():
                if name in out:
                    out[name][block.start : block.stop] = values
        return out

    def densities(self, x: np.ndarray) -> np.ndarray:
        """Return the energies per rest volume (number of BAR_ENERGIES, b) [J/m3] at the end of the last step."""
        densities = np.zeros((len(BAR_ENERGIES), len(self.ends)))
        self.axial(x, densities)
        return densities

    def axial(self, x: np.ndarray, densities: np.ndarray | None = None) -> np.ndarray:
        """Return strain, stress [Pa] and axial force [N] (3, b) of local bars at the end of the last step; write the
        ``densities``, if they are given."""
        split_components(x, self.components[0])
        out = np.empty((3, len(self.ends)))
        densities = np.empty((0, 0)) if densities is None else densities
        states(self.components[0], self.reference, self.loops("full"), out, densities)
        return out

    def scaled_dissipation(self, densities: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return by how much the energies (number of BAR_ENERGIES,) [J] that the counted bars have dissipated would
        change, with their ``densities``, if their rest lengths change by ``change`` (b,) [m]."""
        total = np.zeros(len(BAR_ENERGIES))
        for block in self.blocks:
            part = slice(block.start, block.counted)
            total += (densities[:, part] * (block.counted_area * change[part])).sum(axis=1)
        return np.where(_LOST, total, 0.0)

    def history(self) -> np.ndarray:
        """Return the data that laws keep of all local bars (b, names), one column for each of :attr:`kept_names`; zero
        for bars without such data."""
        history = np.zeros((len(self.ends), len(self.kept_names)))
        for block in self.blocks:
            for name, _, values in block.variables():
                history[block.start : block.stop, self.kept_names.index(name)] = values
        return history

    def rupture(self) -> np.ndarray:
        """Return the state of rupture (b,) of all local bars, see :mod:`~pfem_petsc.mechanics.rupture`."""
        return self.of_blocks(lambda block: block.row(block.law.rupture) if block.law.rupture >= 0 else 0.0)

    @property
    def watched(self) -> np.ndarray:
        """Rest lengths (b,) [m], zero for bars that have left the model; the same array in each call."""
        if not self.can_break:
            return self._lengths
        np.copyto(self._watched, np.where(np.abs(self.rupture()) >= 1.0, 0.0, self.rest))
        return self._watched

    @property
    def stiffness(self) -> np.ndarray:
        """Largest axial stiffness (b,) of all local bars [N/m]; zero for bars that have left the model."""
        rest, axial = self.watched, self.of_blocks(lambda block: block.area * block.modulus)
        return np.divide(axial, rest, out=np.zeros_like(axial), where=rest > 0.0)

    def put_history(self, history: np.ndarray, names: Sequence[str] | None = None) -> None:
        """Take the data that :meth:`history` returned, with the ``names`` of its columns if they are those of other
        bars."""
        names = self.kept_names if names is None else names
        for block in self.blocks:
            for number, (name, _) in enumerate(block.law.rows):
                block.put_row(number, history[block.start : block.stop, names.index(name)])


def state_before_rupture(bars: Bars, x: np.ndarray, bar: int) -> tuple[BarBlock, np.ndarray, float, float]:
    """Return the block of a bar (local index), its data (rows,), and its stress [Pa] and strain without the thermal
    strain at positions ``x``, as if it had not broken."""
    block = next(block for block in bars.blocks if block.start <= bar < block.stop)
    k = bar - block.start
    law, history = block.law, block.history[:, k : k + 1].copy()
    history[law.rupture] = 0.0
    length = float(np.linalg.norm(np.subtract(*x[bars.ends[bar]])))
    shift, temperature = bars.heat[:, bar] if bars.heat.shape[1] else (0.0, 0.0)
    strain = block.measure(length / bars.rest[bar])[0] - shift
    if law.rate:
        stress = history[len(law.internal) + 1, 0]
    else:
        stress = evaluate(law, block.parameters, strain, temperature, history)[STRESS, 0]
    return block, history[:, 0], float(stress), float(strain)


def release(bars: Bars, x: np.ndarray, members: np.ndarray, state: float) -> np.ndarray:
    """Remove bars (local indices) up to a share; return by how much the
    energies of the bars counted on this rank change, in the order of :data:`~pfem_petsc.columns.BAR_ENERGIES`."""
    change = np.zeros(len(BAR_ENERGIES))
    for block in bars.blocks:
        mine = members[(members >= block.start) & (members < block.stop)]
        history = block.history.copy()
        mine = mine[np.abs(history[block.law.rupture, mine - block.start]) < state]
        if not len(mine):
            continue
        here, count = mine - block.start, block.law.rupture  # variables of the law of intact bars come first
        law, parameters = intact(block.law, block.parameters)
        ends = x[bars.ends[mine]]
        stretch = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / bars.rest[mine]
        strain = np.array([block.measure(value)[0] for value in stretch])
        shift, temperature = bars.heat[:, mine] if bars.heat.shape[1] else (0.0, 0.0)
        rows = history[:count, here], np.zeros((len(law.rows) - count, len(mine))), history[len(block.law.rows) :, here]
        found = evaluate(law, parameters, strain - shift, temperature, np.vstack(rows))
        densities = found[densities_row(law) :]
        lost = (state - np.abs(history[count, here])) * densities
        history[count + 1 : count + 1 + len(lost), here] += lost
        # one that has begun to break counts as broken
        history[count, here] = np.where(history[count, here] > 0.0, state, -state)
        for number in range(count, count + 1 + len(lost)):
            block.put_row(number, history[number])
        volume = np.broadcast_to(block.area, block.stop - block.start)[here] * bars.rest[mine] * (mine < block.counted)
        for name, energy in zip(law.energies, (lost @ volume).tolist(), strict=True):
            if name in STORED:
                change[BAR_ENERGIES.index(name)] -= energy
                change[BAR_ENERGIES.index("rupture_dissipation")] += energy
    return change


def viscous_rate(case: Case, bars: Bars, mass: np.ndarray, consistent: bool) -> float:
    """Return an upper bound of the eigenvalues of C over M [1/s] of dashpots between nodes. Collective.

    By Gershgorin's theorem it is the largest sum of 2 c/m at a node; a consistent mass is at least a third of the
    lumped one.
    """
    viscous = {table.key for table in connected(case) if table.viscous}
    if not viscous:
        return 0.0
    sums = np.zeros(bars.mesh.n_local)
    for block in bars.blocks:
        if block.section in viscous:
            part = slice(block.start, block.stop)
            values = np.asarray(block.area) * connector_modulus(case) / bars.mesh_lengths[part]
            for end in (0, 1):
                np.add.at(sums, bars.ends[part, end], 2.0 * values)
    largest = float((sums[: len(mass)] / mass).max(initial=0.0))
    return (3.0 if consistent else 1.0) * bars.mesh.comm.allreduce(largest, op=MPI.MAX)


class ProbedBars:
    """The bars of all ``[[output.bar_probe]]``, whose strain, stress and axial force are in each row of the history.
    Construction is collective.

    A row has them by probe, by quantity of :data:`~pfem_petsc.columns.OF_BARS`, and by mesh number. Each bar is counted
    on one rank, so that the sum of the ranks' shares is the row's values.

    Attributes
    ----------
    ids : name of a probe to the mesh numbers of its bars on all ranks, ascending
    width : numbers of all probes in a row

    Raises
    ------
    InputError
        On all ranks, for a group that the mesh does not have, a number out of range, or a probe without bars.
    """

    def __init__(self, case: Case, mesh: DistributedMesh) -> None:
        self.ids: dict[str, np.ndarray] = {}
        self.width = 0
        counted = np.arange(len(mesh.bars))[mesh.counted]
        local, places = [np.empty(0, dtype=np.int64)], [np.empty((len(OF_BARS), 0), dtype=np.int64)]
        for number, probe in enumerate(case.output.bar_probe):
            chosen = np.intersect1d(_chosen(case, mesh, f"output.bar_probe[{number}]", probe, counted), counted)
            ids = np.sort(np.concatenate(mesh.comm.allgather(mesh.bar_ids[chosen].astype(np.int64))))
            if not len(ids):
                raise InputError(f"{case.source}: output.bar_probe[{number}].bars = {str(probe.bars)!r}: has no bars")
            local.append(chosen)
            order = np.searchsorted(ids, mesh.bar_ids[chosen])
            places.append(self.width + np.arange(len(OF_BARS))[:, None] * len(ids) + order)
            self.ids[probe.name] = ids
            self.width += len(OF_BARS) * len(ids)
        self._local, self._places = np.concatenate(local), np.hstack(places)

    def fill(self, bars: Bars, x: np.ndarray, share: np.ndarray) -> None:
        """Write the values of the bars that are counted on this rank to its share (width,), at positions ``x``."""
        if len(self._local):
            share[self._places] = bars.axial(x)[:, self._local]


def _chosen(case: Case, mesh: DistributedMesh, key: str, probe: BarProbe, counted: np.ndarray) -> np.ndarray:
    """Return the local bars of a probe, with those that other ranks count. Collective."""
    if probe.bars is not None:
        return bars_of_group(case, mesh, f"{key}.bars", str(probe.bars))
    ids = mesh.bar_ids[counted]
    if probe.indices is not None:
        last = mesh.n_bars - mesh.n_connectors - 1
        outside = [number for number in probe.indices if number > last]
        if outside:
            raise InputError(
                f"{case.source}: {key}.indices: bar {outside[0]} does not exist; the mesh has bars 0 to {last}"
            )
        return counted[np.isin(ids, probe.indices)]
    real = counted[ids < mesh.n_bars - mesh.n_connectors]
    middles = mesh.points[mesh.bars[real]].mean(axis=1)
    distance = np.linalg.norm(middles - np.array(probe.nearest), axis=1)
    shortest = mesh.comm.allreduce(float(distance.min(initial=np.inf)), op=MPI.MIN)
    nearest = real[distance == shortest]
    first = mesh.comm.allreduce(int(mesh.bar_ids[nearest].min(initial=mesh.n_bars)), op=MPI.MIN)
    return nearest[mesh.bar_ids[nearest] == first]
