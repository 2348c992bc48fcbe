"""The root model of a case: its tables by top-level key, which the rest of the program reads from the types.

A new table or key is a line here or in :mod:`~pfem_petsc.case.tables`; documentation, completion, overrides, editing,
writing and messages follow from it.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import (
    BeforeValidator,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from ..columns import cell_fields, point_fields
from ..contact.walls.base import WALLS, WallKeys
from ..errors import InputError
from ..mechanics.materials.base import LAWS, MaterialKeys, internal_variables, law_name
from ..registry import added_file, choices, lookup, modules, nearest
from . import load_cases
from . import tables as t
from .base import (
    ConstraintKeys,
    FilePath,
    Finite,
    Name,
    NonNegativeInt,
    PositiveInt,
    StrictModel,
    listed,
    must,
    refers,
    refusal,
)
from .files import Columns, TableFile, file_columns, rows_of

GENERATORS = "pfem_petsc.mesh.generators"
INTEGRATORS = "pfem_petsc.integrators"
CONSTRAINTS = "pfem_petsc.contact.constraints"
TREATMENTS = "pfem_petsc.contact.treatments"
STATIC_METHODS = "pfem_petsc.statics.methods"

ARRAYS = "arrays"
"""The generator of meshes that are given as arrays, or in the case file itself."""


class Reading:
    """The :class:`~pfem_petsc.case.base.Context` of a case: its folder, the names of its tables, files read once.

    If ``lenient``, as for results, tables may be of modules that are not there; ``missing`` tells which.
    """

    def __init__(self, data: Mapping[str, Any], folder: Path, lenient: bool = False) -> None:
        self.folder, self.lenient = folder, lenient
        self.missing: list[str] = []
        self.names = {key: _names(data.get(key)) for key in ("node_set", "material", "section", "support", "load_case")}
        self._columns: dict[str, Columns] = {}

    def rows(self, given: Any, columns: tuple[str, ...]) -> list[list[float]]:
        """Return the rows of a file: its name, or a table with the key ``file``."""
        named = isinstance(given, str | Mapping) and given != ""
        if not named:
            raise refusal(((), "expected the name of a file, or a table with the key file", given))
        read = TableFile.model_validate({"file": given} if isinstance(given, str) else given)
        try:
            if read.file not in self._columns:
                self._columns[read.file] = file_columns(self.folder / read.file)
            return rows_of(read, self._columns[read.file], columns)
        except InputError as error:
            raise refusal(((), str(error), read.file)) from error


def _names(data: Any) -> list[str]:
    """Names of tables ``[material.NAME]``, or of those of a list that have one."""
    if isinstance(data, list):
        return [row["name"] for row in data if isinstance(row, Mapping) and isinstance(row.get("name"), str)]
    return list(data) if isinstance(data, Mapping) else []


class Chosen:
    """Annotation of a table whose content chooses its model.

    Parameters
    ----------
    models : all models that it may choose
    choose : the model for a table
    """

    def __init__(self, *models: type[StrictModel], choose: Callable[[Mapping[str, Any]], type[StrictModel]]) -> None:
        self.models, self._choose = models, choose

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self.read)

    def read(self, table: Any, info: ValidationInfo) -> Any:
        """Validate a table."""
        if not isinstance(table, Mapping):
            raise refusal(((), "expected a table", table))
        return self.validated(self.chosen(table, info), table, info)

    def chosen(self, table: Mapping[str, Any], info: ValidationInfo) -> type[StrictModel]:
        """Return the model of a table that is validated."""
        return self.model_of(table)

    def model_of(self, table: Mapping[str, Any]) -> type[StrictModel]:
        """Return the model of a table, or refuse the key that chooses it."""
        return self._choose(table)

    def found(self, table: Mapping[str, Any]) -> type[StrictModel] | None:
        """Return the model of a table, None where the key that chooses it is refused."""
        try:
            return self.model_of(table)
        except ValidationError:
            return None

    def validated(self, model: type[StrictModel], table: Mapping[str, Any], info: ValidationInfo) -> Any:
        """Return the table of a model."""
        try:
            return model.model_validate(dict(table), context=info.context)
        except InputError as error:
            raise refusal(((), str(error), None)) from error


class Family(Chosen):
    """Annotation of a table one key of which names a module, whose ``Parameters`` have its keys.

    Parameters
    ----------
    package : of the modules
    key : that names the module
    common : model of the keys that all have
    unknown : model of the tables of a result whose module is not there
    taker : what has the keys, for messages: ``generator rod``
    missing : text of the message where the key is missing
    """

    def __init__(
        self,
        package: str,
        key: str,
        common: type[StrictModel],
        unknown: type[StrictModel],
        taker: str,
        missing: str = "",
    ) -> None:
        self.package, self.key, self.models, self.unknown = package, key, (common,), unknown
        self.taker, self._missing = taker, missing

    def name(self, table: Mapping[str, Any]) -> Any:
        """Return the name of the module of a table."""
        return table.get(self.key)

    def model_of(self, table: Mapping[str, Any]) -> type[StrictModel]:
        """Return the ``Parameters`` of the module."""
        name = self.name(table)
        if name is None:
            raise refusal(((self.key,), f"this key is missing: {self._missing}", None))
        try:
            return lookup(self.package, name, "").Parameters
        except InputError as error:
            text = str(error).partition(": ")[2].replace(f"unknown value {name!r}", "unknown value")
            raise refusal(((self.key,), text, name)) from error
        except AttributeError as error:
            text = f"{self.package}.{name} has no Parameters: it is not meant for case files"
            raise refusal(((self.key,), text, name)) from error

    def chosen(self, table: Mapping[str, Any], info: ValidationInfo) -> type[StrictModel]:
        """Return the model of a table that is validated: in results, one without module where there is none."""
        found, name = self.found(table), self.name(table)
        if found is None and name is not None and getattr(info.context, "lenient", False):
            info.context.missing.append(self.called(name))
            return self.unknown
        return found or self.model_of(table)  # which says what is wrong

    def called(self, name: str) -> str:
        """Return what a module is, for the message where it is not there."""
        return self.taker.format(name)

    def keys(self) -> dict[str, list[str]]:
        """Return the keys of all modules by name, without common ones."""
        found = {name: getattr(module, "Parameters", None) for name, module in modules(self.package).items()}
        common = self.models[0].model_fields
        return {n: [k for k in model.model_fields if k not in common] for n, model in found.items() if model}


class UnknownParameters(StrictModel, extra="allow"):
    """Keys of a module that is not there."""


class UnknownWall(WallKeys, extra="allow"):
    """A wall of a type that is not there."""


class UnknownConstraint(ConstraintKeys, extra="allow"):
    """A constraint of a kind that is not there."""


class UnknownMaterial(MaterialKeys, extra="allow"):
    """A material with a law that is not there."""


class WithParameters(StrictModel):
    """A table with the keys of a scheme, generator or method, which is found by name, among its own.

    The last field of a subclass has these keys, with its :class:`Family` as annotation.
    """

    __slots__ = ()

    slot: ClassVar[str]

    @property
    def _others(self) -> StrictModel | None:
        return self.__dict__.get(self.slot)

    def __getattr__(self, key: str) -> Any:
        others = None if key.startswith("_") else self._others
        if others is not None and key in type(others).model_fields:
            return getattr(others, key)
        return super().__getattr__(key)  # type: ignore[misc]

    def __dir__(self) -> list[str]:
        others = self._others
        return sorted({*super().__dir__(), *(type(others).model_fields if others is not None else ())})

    @model_validator(mode="before")
    @classmethod
    def _split(cls, data: Any) -> Any:
        """Put the keys that are not the table's own into one table, with the key that names what they are of."""
        if not isinstance(data, Mapping) or isinstance(data.get(cls.slot), StrictModel):
            return data
        own = {key: value for key, value in data.items() if key in cls.model_fields and key != cls.slot}
        return {**own, cls.slot: {key: value for key, value in data.items() if key not in own}}


class _Parameters(Family):
    """The family of a :class:`WithParameters`, which has the key that names the module."""

    def called(self, name: str) -> str:
        """Return what a module is: ``the integrator newmark``."""
        return f"the {self.key} {name}"

    def read(self, table: Any, info: ValidationInfo) -> Any:
        """Validate the keys of the module that the table names; a table that names none is refused for that."""
        name = info.data.get(self.key)
        if isinstance(table, StrictModel):
            return table
        return None if name is None else self.validated(self.chosen({self.key: name}, info), table, info)

    def name(self, table: Mapping[str, Any]) -> Any:
        """Return the name of the module of a table."""
        return table.get(self.key, self.models[0].model_fields[self.key].default)


_generator = _Parameters(GENERATORS, "generator", t.MeshKeys, UnknownParameters, "generator {}")
_integrator = _Parameters(INTEGRATORS, "integrator", t.TimeKeys, UnknownParameters, "{}")
_method = _Parameters(STATIC_METHODS, "method", t.StaticKeys, UnknownParameters, "{}")


class Mesh(t.MeshKeys, WithParameters):
    """Source of the mesh: a generator with its parameters, or a file."""

    slot: ClassVar[str] = "parameters"

    parameters: Annotated[StrictModel | None, _generator] = None

    @model_validator(mode="before")
    @classmethod
    def _source(cls, data: Any) -> Any:
        data = getattr(data, "mesh_table", data)  # of a truss from arrays
        if isinstance(data, Mapping) and (data.get("generator") is None) == (data.get("file") is None):
            t.MeshKeys.model_validate({key: data[key] for key in ("generator", "file") if key in data})  # is refused
        if isinstance(data, Mapping) and data.get("file") is not None and len(data) > 1:
            text = "unknown key; a mesh from a file takes no other keys"
            raise refusal(*(((key,), text, None) for key in data if key != "file"))
        return data

    @property
    def arranged(self) -> bool:
        """Whether a generator computes the mesh, which is then free of mistakes."""
        return self.generator not in (None, ARRAYS)


class Time(t.TimeKeys, WithParameters):
    """The time integration: scheme, its parameters, step and end."""

    slot: ClassVar[str] = "scheme"

    scheme: Annotated[StrictModel, _integrator]

    @model_validator(mode="after")
    def _known_step(self) -> Time:
        if self.step != "auto" or isinstance(self.scheme, UnknownParameters):
            return self
        text = f'"auto" is for explicit schemes, and {self.integrator} is implicit: give the step in seconds'
        explicit = lookup(INTEGRATORS, self.integrator, "time.integrator").Scheme.explicit
        if not explicit:
            raise refusal((("step",), text, "auto"))
        return self


class Static(t.StaticKeys, WithParameters):
    """The static analysis: method and its parameters."""

    slot: ClassVar[str] = "parameters"

    parameters: Annotated[StrictModel, _method]


class _Materials(Family):
    """Materials, the law of which follows from ``yield_stress`` if it is not named."""

    _HARDENING = ("isotropic_hardening", "kinematic_hardening")

    def name(self, table: Mapping[str, Any]) -> Any:
        """Return the law of a table."""
        return "elastoplastic" if self._hardening(table) else law_name(table)

    def _hardening(self, table: Mapping[str, Any]) -> list[str]:
        """Keys of a table without law and ``yield_stress`` that need one."""
        if table.get("law") is not None or table.get("yield_stress") is not None:
            return []
        return [key for key in self._HARDENING if table.get(key, 0.0) != 0.0]

    def validated(self, model: type[StrictModel], table: Mapping[str, Any], info: ValidationInfo) -> Any:
        """Return the table of a model."""
        hardening = self._hardening(table)
        law = self.name(table)
        if hardening:  # the other keys are validated nevertheless
            table = {**table, "yield_stress": 1.0}
        elif law == "elastic" and table.get("law") is None:
            # resolved cases of earlier versions have zeros for materials that cannot yield
            table = {key: value for key, value in table.items() if key not in self._HARDENING}
        material = super().validated(model, table, info)
        if isinstance(material, UnknownMaterial):
            return material
        if hardening:
            text = f"{hardening[0]} = {table[hardening[0]]!r} needs a yield_stress [Pa]"
            raise refusal(((), text, None))
        known, file = lookup(LAWS, law, "").LAW, added_file(LAWS, law)
        flaw = known.flaw(material, file) if file else ""
        if flaw:
            raise refusal((("law",), f"{file}: {flaw}", law))
        softens = material.softening is None or known.softening is not None
        if not softens:
            raise refusal((("softening",), f"the law {law} does not soften by a table; remove the key", None))
        variables = [variable for variable, _ in material.choose(known).internal]
        for limit in ("plastic_strain", "damage"):
            value = getattr(material.rupture, limit, None)
            unknown = value is not None and not any(variable.endswith(limit) for variable in variables)
            text = f"the law {law} has no {limit.replace('_', ' ')}; use another limit or law"
            if unknown:
                raise refusal((("rupture", limit), text, value))
        return material


NUMBERED = {"wall": "wall", "contact_pair": "pair", "constraint": "constraint", "stage": "stage"}
"""Lists of tables that have names by default, with their beginning: ``pair1``, ``pair2``, ..."""


def _numbered(table: str) -> BeforeValidator:
    """Annotation of a list of :data:`NUMBERED`."""
    name = NUMBERED[table]

    def named(rows: Any) -> Any:
        if not isinstance(rows, list):
            return rows
        return [{"name": f"{name}{i + 1}", **row} if isinstance(row, Mapping) else row for i, row in enumerate(rows)]

    return BeforeValidator(named)


class _Start(t.Initial):
    """An entry of [[initial.on]]."""

    node_set: t.NodeSetName
    """name of a node set"""


class _Initial(t.Initial):
    """The table [initial]."""

    node_set: Annotated[
        t.NodeSetName | None,
        must(lambda name: name is None, "the velocity of a node set belongs under a heading [[initial.on]]"),
    ] = None
    """name of a node set"""
    on: list[_Start] = []
    """velocities of node sets, each under a heading ``[[initial.on]]``"""


class _Initials(Chosen):
    """The table [initial], which becomes a list: velocities of all nodes, if there are any, then of node sets."""

    def read(self, table: Any, info: ValidationInfo) -> Any:
        """Validate a table."""
        read = super().read(table, info)
        everywhere = {key: value for key, value in table.items() if key != "on"}
        return [*([t.Initial.model_validate(everywhere)] if everywhere else []), *read.on]


class StageOutput(StrictModel):
    """The keys of [stage.output]; what else is written is the same for all stages."""

    fields_every: NonNegativeInt | None = None
    """steps between field snapshots, counted from the start of the run; 0: none but the last of the stage"""
    history_every: PositiveInt | None = None
    """steps between rows of the history"""


class StageName(StrictModel):
    """The key of a stage that is no table."""

    name: Name
    """name of the stage in results and messages; unique; default: ``stage1`` and so on"""


Material = Annotated[MaterialKeys, _Materials(LAWS, "law", MaterialKeys, UnknownMaterial, "the law {}")]
Wall = Annotated[WallKeys, Family(WALLS, "type", WallKeys, UnknownWall, "a wall of type {}", "the kind of wall")]
Constraint = Annotated[
    ConstraintKeys,
    Family(CONSTRAINTS, "kind", ConstraintKeys, UnknownConstraint, "a constraint of kind {}", "the kind of constraint"),
]
Load = Annotated[
    t.Load | t.LoadFile, Chosen(t.Load, t.LoadFile, choose=lambda row: t.LoadFile if "file" in row else t.Load)
]


class LoadCase(StrictModel):
    """Loads that act together, beside what the case has outside of load cases."""

    conflicts = (
        (
            lambda own: not any(getattr(own, key) for key in load_cases.TABLES),
            f"has no loads: expected at least one of the tables {', '.join(load_cases.TABLES)}",
        ),
    )

    name: Name
    """name of the load case in results, tables and messages; unique, also among combinations and stages"""
    load: Annotated[list[Load], listed] = []
    """forces on nodes, under ``[[load_case.load]]``"""
    gravity: t.Gravity | None = None
    """acceleration of every mass"""
    wind: t.Wind | None = None
    """wind that drags the bars"""
    temperature: list[t.Temperature] = []
    """temperatures of bars, under ``[[load_case.temperature]]``"""
    support: list[t.Support] = []
    """supports that move, in the place of those of the same name or node set, under ``[[load_case.support]]``"""

    @model_validator(mode="after")
    def _constant_wind(self) -> LoadCase:
        varies = self.wind is not None and self.wind.varies
        if varies:
            raise refusal((("wind", "velocity"), "a load case takes a constant wind [vx, vy, vz]", None))
        return self


class Combination(StrictModel):
    """Load cases that act together, each with a factor."""

    name: Name
    """name of the combination in results, tables and messages; unique, also among load cases and stages"""
    factors: Annotated[dict[Annotated[str, refers("load_case", "load case")], Finite], Field(min_length=1)]
    """factors by the names of load cases: { dead = 1.35, wind = 1.5 }"""


STAGED = Field(json_schema_extra={"staged": True})
"""Annotation of a table that a stage may give."""


class CaseModel(StrictModel):
    """The tables of a case file by top-level key."""

    title: str | None = None
    plugins: Annotated[tuple[FilePath, ...], listed] = ()
    mesh: Mesh
    node_set: dict[str, t.NodeSet] = {}
    material: dict[str, Material] = {}
    section: Annotated[dict[str, t.Section], STAGED] = {}
    initial: Annotated[list[t.Initial], _Initials(_Initial, choose=lambda _: _Initial), STAGED] = []
    support: Annotated[list[t.Support], t.distinct("support"), STAGED] = []
    mass: list[t.NodalMass] = []
    spring: list[t.Spring] = []
    dashpot: list[t.Dashpot] = []
    load: Annotated[list[Load], STAGED] = []
    gravity: Annotated[t.Gravity | None, STAGED] = None
    wind: Annotated[t.Wind | None, STAGED] = None
    temperature: Annotated[list[t.Temperature], STAGED] = []
    wall: Annotated[list[Wall], _numbered("wall"), t.distinct("wall"), STAGED] = []
    contact_pair: Annotated[list[t.ContactPair], _numbered("contact_pair"), t.distinct("contact pair")] = []
    constraint: Annotated[list[Constraint], _numbered("constraint"), t.distinct("constraint")] = []
    self_contact: Annotated[t.SelfContact | None, STAGED] = None
    remove: Annotated[list[t.Remove], STAGED] = []
    contact: Annotated[t.ContactSettings, STAGED] = Field(default_factory=t.ContactSettings)
    time: Time | None = None
    static: Static | None = None
    stage: list[Any] = []
    load_case: list[LoadCase] = []
    combination: list[Combination] = []
    modes: t.Modes | None = None
    output: Annotated[t.Output, STAGED] = Field(default_factory=t.Output)
    solver: Annotated[t.Solver, STAGED] = Field(default_factory=t.Solver)

    @field_validator("section")
    @classmethod
    def _bars_once(cls, sections: dict[str, t.Section]) -> dict[str, t.Section]:
        seen: dict[str | None, str] = {}
        for name, section in sections.items():
            group = None if section.bars is None else str(section.bars)
            other, rest = seen.setdefault(group, name), group is None
            text = f"both this section and {other} name no bars; only one can be the default"
            if rest and other != name:
                raise refusal(((name,), text, None))
            if other != name:
                raise refusal(((name, "bars"), f"section {other} has these bars already", group))
        return sections

    @field_validator("remove")
    @classmethod
    def _removed_once(cls, entries: list[t.Remove]) -> list[t.Remove]:
        targets = [(entry.bars, entry.supports) for entry in entries]
        for i, (bars, supports) in enumerate(targets):
            text = f"{str(bars or supports)!r} is removed by an earlier table already"
            if targets[i] in targets[:i]:
                raise refusal(((i,), text, None))
        return entries

    @field_validator("contact")
    @classmethod
    def _treats(cls, contact: t.ContactSettings, info: ValidationInfo) -> t.ContactSettings:
        if contact.treatment == "scheme":
            return contact
        known = ["scheme", *choices(TREATMENTS)]
        if contact.treatment not in known and info.context.lenient:
            info.context.missing.append(f"the treatment {contact.treatment}")
        elif contact.treatment not in known:
            raise refusal((("treatment",), f"unknown value{nearest(contact.treatment, known)}", contact.treatment))
        return contact

    @field_validator("output")
    @classmethod
    def _known_fields(cls, output: t.Output, info: ValidationInfo) -> t.Output:
        if info.context.lenient:
            return output
        laws = internal_variables(info.data.get("material", {}))
        known = list(dict.fromkeys([*point_fields(), *cell_fields(), *laws]))
        for i, name in enumerate(output.fields or ()):
            unknown = name not in known and "material" in info.data
            if unknown:
                raise refusal((("fields", i), f"there is no field of this name{nearest(name, known)}", name))
            if name in output.fields[:i]:
                raise refusal((("fields", i), "this field is listed twice", name))
        return output


KEYS = list(CaseModel.model_fields)
"""Top-level keys of a case file."""

ANALYSES = ("time", "static")
"""Tables of which a stage has exactly one."""

ONE_STAGE = ("initial", "remove")
"""Tables that are in force in the stage alone that gives them."""

STAGE_TABLES = [
    key
    for key, field in CaseModel.model_fields.items()
    if (field.json_schema_extra or {}).get("staged")  # type: ignore[union-attr]
]
"""Tables that a stage may give."""


class Shape(NamedTuple):
    """What a key has: ``many`` is list or dict for a list of tables or tables by name, else None."""

    many: type | None
    models: tuple[type[StrictModel], ...]
    chosen: Any

    @property
    def family(self) -> Family | None:
        """The family of the modules whose keys stand in the table, if there is one."""
        slot = getattr(self.models[0], "slot", None) if self.models else None
        found = self.chosen if slot is None else shape_of(self.models[0].model_fields[slot]).chosen
        return found if isinstance(found, Family) else None

    def keys(self) -> set[str]:
        """The keys of the table, of any model and any module."""
        own = {key for model in self.models for key in model.model_fields if key != getattr(model, "slot", None)}
        return own.union(*(self.family.keys().values() if self.family is not None else ()))


def shape_of(field: FieldInfo) -> Shape:
    """Return what a key has; no models if it has no tables."""
    return _shape([*field.metadata], field.annotation)


def _shape(metadata: Sequence[Any], annotation: Any) -> Shape:
    if typing.get_origin(annotation) is Annotated:
        annotation, *more = typing.get_args(annotation)
        metadata = [*metadata, *more]
    found = next((each for each in metadata if isinstance(each, Chosen)), None)
    if found is not None:
        return Shape(None, found.models, found)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return _shape((), next(each for each in arguments if each is not type(None)))
    if origin in (list, tuple, dict):
        return _shape((), arguments[origin is dict])._replace(many=dict if origin is dict else list)
    own = isinstance(annotation, type) and issubclass(annotation, StrictModel)
    return Shape(None, (annotation,) if own else (), None)


def plain_type(annotation: Any) -> Any:
    """Return a type without ``Annotated`` and ``None``."""
    while True:
        if typing.get_origin(annotation) is Annotated:
            annotation = typing.get_args(annotation)[0]
        elif typing.get_origin(annotation) in (typing.Union, types.UnionType):
            annotation = next(each for each in typing.get_args(annotation) if each is not type(None))
        else:
            return annotation


def list_paths(model: type[StrictModel] = CaseModel, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the keys, without indices, that have lists of tables."""
    for key, field in model.model_fields.items():
        many, models, _ = shape_of(field)
        if many is list and (models or key == "stage"):
            yield (*path, key)
        for each in models if many is None else ():
            yield from list_paths(each, (*path, key))


LISTS: set[tuple[str, ...]] = set()
"""Keys, without indices, that have lists of tables."""
LISTS.update(list_paths())
LISTS.update(("stage", *path) for path in [*LISTS] if path[0] in STAGE_TABLES)
