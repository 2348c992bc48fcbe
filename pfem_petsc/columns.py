"""The columns of the history, one line each: recorder, files, units, stages, curves and compiled loops read them here.

A rank's share of a row is a vector of sums: :data:`HEAD`, then for cases with walls the changes of the active set and
one :data:`WALL` per wall, one :data:`PAIR` per table of contact pairs or constraints, and the probes, of bars first.
Compiled loops use the positions as integers at module level, which are constants of the machine code.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

SUMMED, LASTING = "summed", "lasting"


class Column(NamedTuple):
    """One column; those of walls, pairs and probes without the name of theirs, ``force`` of ``wall/floor/force``.

    Attributes
    ----------
    unit : SI unit, empty for a pure number
    size : numbers of a value: 1, or 3 for a vector
    kind : type of the numbers in the file
    source : of an energy, see :func:`energy`
    side : of an energy, of the balance: stored + lost - supplied is constant; ``part`` of another column
    parts : columns that a derived energy sums
    value : its value, a number or (size,), at the state of a :class:`~pfem_petsc.stepping.stepper.Stepper`, this rank's
        share if it is summed over ranks; None if the ledger, the contact log or the recorder has it
    looped : whether the loop of a call of compiled steps has it too; a row with another value ends the call
    stages : what a stage does with the value of the stage before: it goes on with a ``summed`` one, keeps a ``lasting``
        one that it does not have itself, and forgets others
    exists : whether the column is recorded, from a :class:`~pfem_petsc.stepping.model.Model`
    """

    name: str
    unit: str = ""
    size: int = 1
    kind: type = np.float64
    source: str = ""
    side: str = ""
    parts: tuple[str, ...] = ()
    value: Callable[[Any], Any] | None = None
    looped: bool = False
    stages: str = ""
    exists: Callable[[Any], bool] = lambda model: True

    @property
    def dtype(self) -> np.dtype:
        """Type of a value in the file, with the shape of a vector."""
        return np.dtype((self.kind, (self.size,) if self.size > 1 else ()))


def energy(
    name: str, side: str, source: str, parts: tuple[str, ...] = (), value: Callable[[Any], Any] | None = None
) -> Column:
    """Return the column of an energy [J].

    Parameters
    ----------
    side : ``stored``, ``lost`` or ``supplied``; ``part`` of another column
    source : ``bars``, sums of the material laws; ``state``, at the time of the row; ``ledger``, sums accumulated over
        the steps; ``derived``, the sum of other columns
    parts, value : as of :class:`Column`
    """
    stages = SUMMED if source == "ledger" else ""
    return Column(name, "J", source=source, side=side, parts=parts, value=value, stages=stages)


# to add an energy, add one line here
ENERGIES = (
    energy("kinetic_energy", "stored", "state"),
    energy("elastic_energy", "stored", "bars"),
    energy("wall_kinetic_energy", "stored", "state"),
    energy("plastic_dissipation", "lost", "derived", parts=("plastic_heat", "hardening_energy")),
    energy("plastic_heat", "part", "bars"),
    energy("hardening_energy", "part", "bars"),
    energy("damage_dissipation", "lost", "bars"),
    energy("rupture_dissipation", "lost", "bars"),
    energy("viscous_dissipation", "lost", "bars"),
    energy("damping_dissipation", "lost", "ledger"),
    energy("friction_dissipation", "lost", "ledger"),
    energy("impact_dissipation", "lost", "ledger"),
    energy("external_work", "supplied", "ledger"),
    energy("contact_work", "supplied", "ledger"),
    energy("thermal_work", "supplied", "ledger"),
    energy("prestress_work", "supplied", "ledger"),
    energy("numerical_dissipation", "lost", "ledger"),
    energy("spring_energy", "stored", "bars"),  # of springs to the ground, whose forces are added to those of the bars
    energy("self_contact_energy", "stored", "bars"),  # so are those of bars that touch
    energy("self_contact_dissipation", "lost", "bars"),
)

STORED, LOST, SUPPLIED = (tuple(e.name for e in ENERGIES if e.side == side) for side in ("stored", "lost", "supplied"))

BAR_ENERGIES = tuple(one.name for one in ENERGIES if one.source == "bars")
"""Energies whose densities material laws return, in the order of their sums."""

OF_RUN = (
    Column("time", "s"),
    Column("step", kind=np.int64),
    Column("step_size", "s"),
)
"""Equal on all ranks."""
STAGE = Column("stage", kind=np.int64)
"""Number of the stage, from 0, of cases with stages."""
OF_ANALYSES = (Column("load_factor", stages=LASTING), Column("pseudo_steps"), Column("residual"))
"""Those that steppers name in their ``columns``."""
ITERATIONS = (Column("newton_iterations", kind=np.int64), Column("linear_iterations", kind=np.int64))
COUNTS = (
    Column("active_contacts", kind=np.int64, value=lambda now: now.solution.contacts, looped=True),
    Column(
        "slack_bars",
        kind=np.int64,
        value=lambda now: now.model.bars.slack_count(),
        exists=lambda model: model.bars.slackens,
    ),
    # others can break in the last step of a call alone
    Column("broken_bars", kind=np.int64, value=lambda now: now.ruptures.count, looped=True),
    *(
        Column(
            f"self_contact/{name}",
            unit,
            kind=kind,
            value=lambda now, name=name: now.model.self_contact.of_row(name),
            exists=lambda model: model.self_contact is not None,
            looped=True,
        )
        for name, unit, kind in (("contacts", "", np.int64), ("overlap", "m", float), ("force", "N", float))
    ),
)
IMBALANCE = Column("energy_imbalance", "J")
VECTORS = (
    Column("momentum", "kg m/s", 3),
    Column("angular_momentum", "kg m²/s", 3),
    Column("centre_of_mass", "m", 3),  # the sum over ranks is that of mass times position
    Column("support_force", "N", 3),
    Column("external_impulse", "N s", 3, stages=SUMMED),
    Column("support_impulse", "N s", 3, stages=SUMMED),
    Column("damping_impulse", "N s", 3, stages=SUMMED),
)
CHANGES = Column("active_set_changes", kind=np.int64, exists=lambda model: model.contact.any)
OF_WALLS = (
    Column("force", "N", 3),
    Column("moment", "N m", 3),
    Column("impulse", "N s", 3, stages=SUMMED),
    Column("jump_impulse", "N s", 3, stages=SUMMED),
    Column("contacts", kind=np.int64),
    Column("contact_time", "s", stages=LASTING),
    Column("releases", kind=np.int64, stages=SUMMED),
)
MOTION = (Column("position", "m", 3, stages=LASTING), Column("velocity", "m/s", 3))
"""Of walls that move."""
OF_BODIES = (
    Column("rotation", "rad", 3, stages=LASTING),  # by angles up to pi
    Column("angular_velocity", "rad/s", 3),
    *(column for column in VECTORS if column.name == "angular_momentum"),
)
"""Of walls with inertia."""
OF_PAIRS = tuple(column for column in OF_WALLS if column.name in ("force", "impulse", "jump_impulse"))
PROBED = (*MOTION, Column("acceleration", "m/s²", 3), Column("reaction", "N", 3))
"""Of each node of a probe."""
OF_BARS = (Column("strain"), Column("stress", "Pa"), Column("axial_force", "N"))
"""Of each bar of a probe of bars."""
OF_MODES = (Column("frequency", "Hz"), Column("eigenvalue", "1/s²"))

_GROUPS = (OF_RUN, OF_ANALYSES, ITERATIONS, COUNTS, ENERGIES, VECTORS, OF_WALLS, OF_BODIES, PROBED, OF_BARS, OF_MODES)
DECLARED = {
    column.name: column for column in (*(column for group in _GROUPS for column in group), STAGE, IMBALANCE, CHANGES)
}
"""All columns by the last part of their names, those of bars that touch by the whole."""


def declared(name: str) -> Column:
    """Return the column of a name as it is in the file, ``wall/floor/force``; an unknown one is a pure number."""
    last = name.rsplit("/", 1)[-1]
    return DECLARED.get(name) or DECLARED.get(last) or Column(last)


class Layout:
    """Positions of named numbers and arrays in a vector.

    Parameters
    ----------
    columns : name to the type of a value, with its shape; integers are stored as floating-point numbers, exact below
        2^53

    Attributes
    ----------
    columns : as given
    places : name to (first, end, shape, type of a number)
    width : length of the vector
    """

    def __init__(self, columns: Mapping[str, np.dtype]) -> None:
        self.columns = dict(columns)
        self.places: dict[str, tuple[int, int, tuple[int, ...], type]] = {}
        self.width = 0
        self._alike: Layout | None = None
        for name, dtype in self.columns.items():
            end = self.width + int(np.prod(dtype.shape, dtype=np.int64))
            self.places[name] = (self.width, end, dtype.shape, int if dtype.base.kind in "iu" else float)
            self.width = end

    def __getitem__(self, name: str) -> slice:
        """The slice of a name."""
        return slice(*self.places[name][:2])

    def first(self, name: str) -> int:
        """Return the position of the first number of a name, the only one of a scalar."""
        return self.places[name][0]

    def indices(self, names: Iterable[str]) -> np.ndarray:
        """Return the positions of all numbers of some names, one after the other, int64."""
        found = [np.arange(*self.places[name][:2]) for name in names]
        return np.concatenate([np.empty(0, dtype=np.int64), *found])

    def vector(self, row: Mapping[str, Any]) -> np.ndarray:
        """Return the vector (width,) of a row."""
        if isinstance(row, Row) and self._is_alike(row.layout):
            return row.vector
        if set(row) != set(self.places):
            raise ValueError(f"a history row has the columns {sorted(self.places)}, got {sorted(row)}")
        return np.concatenate([np.ravel(row[name]).astype(np.float64) for name in self.places] or [np.empty(0)])

    def _is_alike(self, other: Layout) -> bool:
        if other is not self._alike and list(other.places.items()) == list(self.places.items()):
            self._alike = other
        return other is self._alike


class Row(Mapping):
    """A row of the history: column name to number or array (views of the vector).

    Attributes
    ----------
    layout : Layout
    vector : (width,) float64
    """

    __slots__ = ("layout", "vector")

    def __init__(self, layout: Layout, vector: np.ndarray) -> None:
        self.layout = layout
        self.vector = vector

    def __getitem__(self, name: str) -> Any:
        first, end, shape, kind = self.layout.places[name]
        return self.vector[first:end].reshape(shape) if shape else kind(self.vector[first])

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.places)

    def __len__(self) -> int:
        return len(self.layout.places)

    def __repr__(self) -> str:
        return repr(dict(self))


def _layout(*columns: Column) -> Layout:
    return Layout({column.name: column.dtype for column in columns})


HEAD = _layout(*(one for one in ENERGIES if one.source != "derived"), *VECTORS, *COUNTS, Column("alarm"))
"""Sums of all cases."""
WALL = _layout(*OF_WALLS)
PAIR = _layout(*OF_PAIRS)


def at_state(model: Any) -> list[Column]:
    """Return the columns of a model with a value at the state of a stepper, which :data:`HEAD` has."""
    return [one for one in (*ENERGIES, *VECTORS, *COUNTS) if one.value is not None and one.exists(model)]


def fill_at_state(columns: Iterable[Column], stepper: Any, head: np.ndarray) -> None:
    """Write the values of :func:`at_state` to the sums of a row."""
    for one in columns:
        head[HEAD[one.name]] = one.value(stepper)


class Share:
    """This rank's share of a row with some walls, tables, numbers of probes of bars, and nodes of probes, zero.

    Attributes
    ----------
    numbers : (width,) the sums of HEAD; with walls, the changes of the active set; the sums of WALL of each wall, those
        of PAIR of each table, and the probes
    head : (width of HEAD,)
    bars : (numbers of probes of bars,)
    probes : (nodes, number of PROBED, 3)
    """

    def __init__(self, walls: int, tables: int, bars: int, probes: int) -> None:
        parts = (HEAD.width, int(walls > 0), walls * WALL.width, tables * PAIR.width, bars, probes * len(PROBED) * 3)
        self.numbers = np.zeros(sum(parts))
        self.head = self.numbers[: HEAD.width]
        at = sum(parts[:-1])
        self.bars = self.numbers[at - bars : at]
        self.probes = self.numbers[at:].reshape(probes, len(PROBED), 3)


STATUS = ("intact", "broken", "slack")
"""Meaning of the numbers 0, 1, 2 of the field ``status``."""


class Field(NamedTuple):
    """One field.

    Attributes
    ----------
    place : ``nodes``, values (owned, 3), or ``bars``, values (local bars,)
    unit : SI unit, empty for a pure number
    value : returns its values from a :class:`~pfem_petsc.columns.Snapshot`, which no later step changes; called by all
        ranks
    default : whether it is written if a case does not name fields, from a :class:`~pfem_petsc.stepping.model.Model`
    """

    name: str
    place: str
    unit: str
    value: Callable[[Any], np.ndarray]
    default: Callable[[Any], bool] = lambda model: True


# to add a field, add one entry here
FIELDS = [
    Field("displacement", "nodes", "m", lambda now: now.state.position - now.start),
    Field("velocity", "nodes", "m/s", lambda now: now.state.v.copy()),
    Field("acceleration", "nodes", "m/s²", lambda now: now.acceleration().copy()),
    Field("contact_force", "nodes", "N", lambda now: now.contact_force()),
    Field("strain", "bars", "", lambda now: now.bars["strain"]),
    Field("stress", "bars", "Pa", lambda now: now.bars["stress"]),
    Field("axial_force", "bars", "N", lambda now: now.bars["axial_force"]),
    Field("plastic_strain", "bars", "", lambda now: now.bars["plastic_strain"]),
    Field("rest_length", "bars", "m", lambda now: now.model.bars.rest.copy(), lambda model: model.rest_lengths.found),
    Field("temperature", "bars", "K", lambda now: now.temperature(), lambda model: model.temperatures.any),
    Field("status", "bars", "", lambda now: now.model.bars.status(), lambda model: model.bars.has_status),
]


def point_fields() -> list[str]:
    """Return the names of the fields at nodes."""
    return [field.name for field in FIELDS if field.place == "nodes"]


def cell_fields() -> list[str]:
    """Return the names of the fields at bars."""
    return [field.name for field in FIELDS if field.place == "bars"]


class Snapshot:
    """The data from which fields are computed.

    Attributes
    ----------
    model : Model
    state : State
    start : (owned, 3) positions in the mesh [m]
    acceleration : returns the acceleration to record (owned, 3) [m/s2]; collective with consistent mass
    """

    def __init__(self, model: Any, state: Any, acceleration: Callable[[], np.ndarray] | None = None) -> None:
        self.model, self.state, self.acceleration = model, state, acceleration
        self.start = model.mesh.points[: model.mesh.n_owned]

    @cached_property
    def bars(self) -> dict[str, np.ndarray]:
        """Name to (local bars,): strain, stress, axial force, internal variables."""
        return self.model.bars.fields(self.state.x)

    def temperature(self) -> np.ndarray:
        """(local bars,) temperature above reference [K], zero if the case has none."""
        temperatures = self.model.temperatures
        return temperatures.values.copy() if temperatures.any else 0.0 * self.bars["strain"]

    def contact_force(self) -> np.ndarray:
        """(owned, 3) force of walls and rows on nodes, and of walls on bars between them [N]."""
        touch = self.model.self_contact
        between = 0.0 if touch is None or touch.at_walls is None else touch.at_walls.force
        return self.state.contact + between


class Fields:
    """Fields of the nodes and bars of this rank.

    Attributes
    ----------
    points, cells : names of the fields that the case selects; by default all that it has, except internal variables of
        material laws other than the plastic strain

    Parameters
    ----------
    model : Model
    names : of fields in place of those that the case selects; a case with stages has the same in all of them
    """

    def __init__(self, model: Any, names: Collection[str] | None = None) -> None:
        self.model = model
        wanted = model.case.output.fields if names is None else names
        self._fields = [field for field in FIELDS if (field.default(model) if wanted is None else field.name in wanted)]
        for name, unit in model.bars.internal.items():
            if wanted is not None and name in wanted and name not in cell_fields():
                self._fields.append(Field(name, "bars", unit, lambda now, name=name: now.bars[name]))
        self.points = [field.name for field in self._fields if field.place == "nodes"]
        self.cells = [field.name for field in self._fields if field.place == "bars"]

    def at(self, place: str, now: Snapshot) -> dict[str, np.ndarray]:
        """Return name to values at ``nodes`` (owned, 3), or ``bars`` (local bars,); collective with consistent mass."""
        return {field.name: field.value(now) for field in self._fields if field.place == place}
