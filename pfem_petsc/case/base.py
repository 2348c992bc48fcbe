"""What the keys of a case file are: a strict model of a table, types of numbers, rows over time, names of tables.

Generators, integrators, laws and walls declare their keys with these types, so that an invalid case file is rejected
with the name of the key before any work is done.
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Protocol, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic.types import Strict
from pydantic_core import InitErrorDetails, PydanticCustomError

from ..registry import nearest


class Context(Protocol):
    """What the validation of a whole case gives that of its tables; a table validated alone has none."""

    folder: Path
    names: Mapping[str, Sequence[str]]
    """Names of the tables that others refer to, by top-level key."""

    def rows(self, given: Any, columns: tuple[str, ...]) -> list[list[float]]:
        """Return the rows of a file: its name, or a table with the key ``file``."""


def refusal(*problems: tuple[tuple[str | int, ...], str, Any]) -> ValidationError:
    """Return what a validator raises to refuse keys of its table: path within it, message, value to show or None."""
    details = [
        InitErrorDetails(type=PydanticCustomError("refused", "{text}", {"text": text}), loc=path, input=value)
        for path, text, value in problems
    ]
    return ValidationError.from_exception_data("case", details)


@cache
def _texts(model: type) -> dict[str, str]:
    """Return the texts below the keys of a model, from its source, which is read only when they are needed."""
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0].body
    except (OSError, TypeError):
        return {}
    return {
        one.target.id: inspect.cleandoc(text.value.value)
        for one, text in pairwise(body)
        if isinstance(one, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


class StrictModel(BaseModel):
    """A table of a case file: no unknown keys, values of the stated type only, finite numbers only.

    An integer is accepted as a float; a string or a boolean is never accepted as a number. A table of a case has its
    place there: a key that is set is validated with the whole case (:mod:`pfem_petsc.case.editing`). Any other is
    frozen.
    """

    __slots__ = ("_place",)

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    exactly_one: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Groups of keys, of each of which the table has exactly one."""
    at_most_one: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Groups of keys, of each of which the table has at most one."""
    conflicts: ClassVar[tuple[tuple[Callable[[Any], object], str], ...]] = ()
    """What keys of the table must not be together: a test of the table, and the message, which is formatted with it.
    Those of base classes come first."""

    @classmethod
    def description(cls, key: str) -> str:
        """Return the text below a key in the class that declares it, or ""."""
        owner = next((base for base in cls.__mro__ if key in base.__dict__.get("__annotations__", {})), cls)
        return _texts(owner).get(key, "")

    @model_validator(mode="after")
    def _as_many_as_allowed(self) -> StrictModel:
        for groups, least, many in ((self.exactly_one, 1, "exactly"), (self.at_most_one, 0, "at most")):
            for keys in groups:
                given = [key for key in keys if getattr(self, key) is not None]
                text = f"expected {many} one of the keys {', '.join(keys)}, got {' and '.join(given) or 'none'}"
                if not least <= len(given) <= 1:
                    raise ValueError(text)
        for kind in reversed(type(self).__mro__):
            for test, text in kind.__dict__.get("conflicts", ()):
                if test(self):
                    raise ValueError(text.format(self))
        return self

    def __setattr__(self, key: str, value: Any) -> None:
        place = getattr(self, "_place", None)
        if place is None or key.startswith("_"):
            super().__setattr__(key, value)
        else:
            place.change(key, value)

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        return [(key, value) for key, value in super().__repr_args__() if value is not None]

    def __delattr__(self, key: str) -> None:
        place = getattr(self, "_place", None)
        if place is None:
            super().__delattr__(key)
        else:
            place.change(key, None)

    def as_table(self, given: bool = False) -> dict[str, Any]:
        """Return the keys of the table, or those that were given, with those of its scheme or generator among them."""
        slot = getattr(type(self), "slot", "")
        data = self.model_dump(exclude_unset=given, exclude_none=True, exclude={slot})
        others = self.__dict__.get(slot)
        if others is not None:
            data |= others.table() if not given and hasattr(others, "table") else others.as_table(given)
        return data

    def _take(self, **values: Any) -> None:
        """Set keys while the table is validated, as if they had been given."""
        self.__dict__.update(values)
        self.__pydantic_fields_set__.update(values)


listed = Strict(False)
"""Annotation of a tuple type that accepts TOML lists: ``Annotated[tuple[float, float], listed]``."""


def is_finite_number(value: Any) -> bool:
    """Return whether a value of a key of any type is a number that double precision holds."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max  # whole numbers may be too large to be converted


def must(test: Callable[[Any], object], text: str) -> AfterValidator:
    """Annotation of a key whose value must pass a test, with the message of one that does not."""

    def check(value: Any) -> Any:
        if not test(value):
            raise ValueError(text)
        return value

    return AfterValidator(check)


Finite = Annotated[float, Field(allow_inf_nan=False)]
PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(gt=0, lt=2**63)]
NonNegativeInt = Annotated[int, Field(ge=0, lt=2**63)]
Vector3 = Annotated[tuple[Finite, Finite, Finite], listed]
PositiveInts3 = Annotated[tuple[PositiveInt, PositiveInt, PositiveInt], listed]
Name = Annotated[
    str,
    Field(min_length=1, pattern=r"^[^/\x00-\x1f\x7f-\x9f]+$"),
    must(lambda name: name not in (".", ".."), '"." is not a valid name; results are stored under it'),
]
"""A name that is part of a path in the result file: not empty, no slash, and not a single dot, which HDF5 skips."""
DIGEST = r"^[0-9a-f]{64}$"
Digest = Annotated[str, Field(pattern=DIGEST)]
"""SHA-256 of the content of a file."""


FileName = Annotated[
    str, Field(min_length=1), must(lambda name: "\0" not in name, "a name of a file cannot contain a NUL character")
]
"""The name of a file, relative to the case file."""


def _absolute(name: str, info: ValidationInfo) -> str:
    return name if info.context is None else str(Path(info.context.folder, name).resolve())


FilePath = Annotated[FileName, AfterValidator(_absolute)]
"""A key of a generator that names a file relative to the case file; the case has its absolute path."""


def refers(table: str, what: str) -> AfterValidator:
    """Annotation of a key that names a table of the case, :data:`Context.names`, which messages call ``what``."""

    def check(name: str, info: ValidationInfo) -> str:
        known = [name] if info.context is None else info.context.names[table]
        if name not in known:
            hint = nearest(name, list(known)) if known else "; the case defines none"
            if table == "node_set":
                hint += f'; a group of the mesh becomes one by node_set.NAME = {{ group = "{name}" }}'
            raise ValueError(f"there is no {what} of this name{hint}")
        return name

    return AfterValidator(check)


NodeSetName = Annotated[str, Field(json_schema_extra={"refers_to": "node_set"}), refers("node_set", "node set")]
"""A key that names a node set."""

Row2 = Annotated[tuple[Finite, Finite], listed]
Row4 = Annotated[tuple[Finite, Finite, Finite, Finite], listed]
Rows = TypeVar("Rows", bound=Sequence[Sequence[float]])


def increasing(rows: Rows) -> Rows:
    """Return the rows of a table over time; reject it if it is empty or its times do not increase."""
    if not rows:
        raise ValueError("expected at least one row")
    for k in range(1, len(rows)):
        if rows[k][0] <= rows[k - 1][0]:
            raise ValueError(f"times must increase, but row {k} has t = {rows[k][0]!r} after {rows[k - 1][0]!r}")
    return rows


Table2 = Annotated[tuple[Row2, ...], listed, AfterValidator(increasing)]
"""rows [t, value] with increasing times"""
Table4 = Annotated[tuple[Row4, ...], listed, AfterValidator(increasing)]
"""rows [t, x, y, z] with increasing times"""


def has_rows(value: Any) -> bool:
    """Whether a value of a key that takes rows over time as well is given as such."""
    return isinstance(value, list | tuple) and any(isinstance(row, list | tuple) for row in value)


def _or_rows(constant: Any, rows: Any) -> Any:
    """The type of a key that takes a constant, or rows over time."""
    readers = [TypeAdapter(each, config=ConfigDict(strict=True)) for each in (constant, rows)]
    return Annotated[constant | rows, PlainValidator(lambda value: readers[has_rows(value)].validate_python(value))]


NumberOrRows = _or_rows(Finite, Table2)
"""a number, or rows [t, value] with increasing times"""
VectorOrRows = _or_rows(Vector3, Table4)
"""a vector [x, y, z], or rows [t, x, y, z] with increasing times"""
Inertia = _or_rows(Vector3, Annotated[tuple[Vector3, Vector3, Vector3], listed])
"""three principal moments [Ix, Iy, Iz], or the three rows of a matrix"""


def _rows(given: tuple[Any, tuple[str, ...]], info: ValidationInfo) -> list[list[float]]:
    return info.context.rows(*given)


_FILES = TypeAdapter(dict[str, Annotated[Any, PlainValidator(_rows)]])
"""Reads files by key, so that what is refused has the key in its path."""


class WithFiles(StrictModel):
    """A table whose keys ``NAME_file`` name files with the rows of its keys ``NAME``.

    The table has the rows, so that a case does not depend on the file any more, and a restart compares them.
    """

    __slots__ = ()

    COLUMNS: ClassVar[dict[str, tuple[str, ...]]] = {
        "acceleration": ("t", "ax", "ay", "az"),
        "motion": ("t", "dx", "dy", "dz"),
        "table": ("t", "value"),
        "velocity": ("t", "vx", "vy", "vz"),
    }
    """Columns of the rows, by key."""

    alternatives: ClassVar[tuple[str, ...]] = ()
    """Further keys, of which a table has at most one beside its files."""

    @model_validator(mode="before")
    @classmethod
    def _rows_of_files(cls, data: Any, info: ValidationInfo) -> Any:
        keys = [key for key in cls.model_fields if f"{key}_file" in cls.model_fields]
        for key in keys if isinstance(data, Mapping) and info.context is not None else ():
            name = f"{key}_file"
            if name in data:
                exclusive = [*keys, *(f"{each}_file" for each in keys), *cls.alternatives]
                taken = [other for other in exclusive if other in data and other != name]
                if taken:
                    raise ValueError(f"expected at most one of the keys {name}, {', '.join(taken)}")
                read = _FILES.validate_python({name: (data[name], cls.COLUMNS[key])}, context=info.context)
                return {other: value for other, value in data.items() if other != name} | {key: read[name]}
        return data


class ConstraintKeys(StrictModel):
    """Keys of all constraints; each kind adds its own."""

    name: Name
    """Name of the constraint in results and messages; unique. Default: ``constraint1``, ``constraint2``, ..."""
    kind: str
    """The kind of constraint: a module of ``pfem_petsc.contact.constraints``."""


class SurfaceKeys(StrictModel):
    """Keys of contacts that may rub and rebound."""

    conflicts = (
        (
            lambda own: own.static_friction is not None and own.static_friction < own.friction,
            "static_friction must be no less than friction = {0.friction!r}",
        ),
    )

    friction: NonNegativeFloat = 0.0
    """coefficient of Coulomb friction"""
    static_friction: NonNegativeFloat | None = None
    """coefficient of static friction; default, and minimum: friction"""
    restitution: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """coefficient of restitution: fraction of the normal velocity at which a node leaves after impact"""

    @property
    def friction_coefficients(self) -> tuple[float, float]:
        """The coefficients of dynamic and static friction."""
        return self.friction, self.friction if self.static_friction is None else self.static_friction


class WallParameters(WithFiles):
    """Keys of all walls; each type adds its own."""

    alternatives: ClassVar[tuple[str, ...]] = ("velocity", "mass")

    name: Name
    """Name of the wall in results and messages; unique. Default: ``wall1``, ``wall2``, ..."""
    type: str
    """The type of wall: a module of ``pfem_petsc.contact.walls``."""
    node_set: NodeSetName | None = None
    """The nodes that the wall stops; default: all nodes."""
