"""Base of all tables of a case file: a strict model and its number types.

Generators, integrators and walls declare their keys with these types, so that an invalid case file is rejected with
the name of the key before any work is done. Imports pydantic only.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

__all__ = [
    "ConstraintKeys",
    "FileName",
    "FilePath",
    "Finite",
    "Name",
    "NodeSetName",
    "NonNegativeFloat",
    "NonNegativeInt",
    "PositiveFloat",
    "PositiveInt",
    "PositiveInts3",
    "StrictModel",
    "Vector3",
    "WallParameters",
    "WithParameters",
    "is_finite_number",
    "listed",
    "number_or_rows",
    "with_absolute_paths",
]


class StrictModel(BaseModel):
    """A table of a case file: no unknown keys, values of the stated type only, finite numbers only.

    An integer is accepted as a float; a string or a boolean is never accepted as a number. A table of a case has its
    place there: a key that is set is validated with the whole case (:mod:`pfem_petsc.case.editing`). Any other is
    frozen.
    """

    __slots__ = ("_place",)

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

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


class WithParameters(StrictModel):
    """A table with the keys of a scheme, generator or method, which is found by name, among its own."""

    __slots__ = ()

    @property
    def _others(self) -> StrictModel | None:
        return self.__dict__.get("scheme") or self.__dict__.get("parameters")

    def __getattr__(self, key: str) -> Any:
        others = None if key.startswith("_") else self._others
        if others is not None and key in type(others).model_fields:
            return getattr(others, key)
        return super().__getattr__(key)  # type: ignore[misc]

    def __dir__(self) -> list[str]:
        others = self._others
        return sorted({*super().__dir__(), *(type(others).model_fields if others is not None else ())})


def _tuple_from_list(value: Any) -> Any:
    """Convert TOML lists to the tuples of the models; anything else is left to the strict check."""
    return tuple(value) if isinstance(value, list) else value


listed = BeforeValidator(_tuple_from_list)
"""Annotation of a tuple type that accepts TOML lists: ``Annotated[tuple[float, float], listed]``."""


def is_finite_number(value: Any) -> bool:
    """Return whether a value of a key of any type is a number that double precision holds."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max  # whole numbers may be too large to be converted


def number_or_rows(value: Any) -> float | tuple[tuple[float, float], ...]:
    """Return a finite number, or rows of two, of a key that takes both; for validators."""
    expected = "expected a number in SI units, without quotes and unit, or rows [t, value]"
    rows = value if isinstance(value, list | tuple) else [[0.0, value]]
    if not rows or not all(isinstance(row, list | tuple) and len(row) == 2 for row in rows):
        raise ValueError(expected)
    if not all(is_finite_number(number) for row in rows for number in row):
        raise ValueError(expected)
    if rows is value:
        return tuple((float(t), float(number)) for t, number in rows)
    return float(value)


def _no_path_of_its_own(name: str) -> str:
    if name in (".", ".."):
        raise ValueError('"." is not a valid name; results are stored under it')
    return name


Finite = Annotated[float, Field(allow_inf_nan=False)]
PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(gt=0, lt=2**63)]
NonNegativeInt = Annotated[int, Field(ge=0, lt=2**63)]
Vector3 = Annotated[tuple[Finite, Finite, Finite], listed]
PositiveInts3 = Annotated[tuple[PositiveInt, PositiveInt, PositiveInt], listed]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^/\x00-\x1f\x7f-\x9f]+$"), AfterValidator(_no_path_of_its_own)]
"""A name that is part of a path in the result file: not empty, no slash, and not a single dot, which HDF5 skips."""


def _without_nul(name: str) -> str:
    if "\0" in name:
        raise ValueError("a name of a file cannot contain a NUL character")
    return name


FileName = Annotated[str, Field(min_length=1), AfterValidator(_without_nul)]
"""The name of a file, relative to the case file."""
FilePath = Annotated[str, Field(min_length=1, json_schema_extra={"is_path": True}), AfterValidator(_without_nul)]
"""A key of a generator that names a file relative to the case file; the case has its absolute path."""


def with_absolute_paths(table: StrictModel, folder: Path) -> StrictModel:
    """Return a table, with those within it, whose :data:`FilePath` keys are absolute."""
    update: dict[str, Any] = {}
    for name, field in type(table).model_fields.items():
        value, extra = getattr(table, name), field.json_schema_extra
        if isinstance(value, StrictModel):
            update[name] = with_absolute_paths(value, folder)
        elif isinstance(value, dict) and any(isinstance(entry, StrictModel) for entry in value.values()):
            update[name] = {key: with_absolute_paths(entry, folder) for key, entry in value.items()}
        elif isinstance(value, str) and isinstance(extra, dict) and extra.get("is_path"):
            update[name] = str(Path(folder, value).resolve())
    return table.model_copy(update=update) if update else table


NodeSetName = Annotated[str, Field(json_schema_extra={"refers_to": "node_set"})]
"""A key of a constraint that names a node set; the names are checked with the case."""


class ConstraintKeys(StrictModel):
    """Keys of all constraints; each kind adds its own."""

    name: Name
    """Name of the constraint in results and messages; unique. Default: ``constraint1``, ``constraint2``, ..."""
    kind: str
    """The kind of constraint: a module of ``pfem_petsc.contact.constraints``."""


class WallParameters(StrictModel):
    """Keys of all walls; each type adds its own."""

    name: Name
    """Name of the wall in results and messages; unique. Default: ``wall1``, ``wall2``, ..."""
    type: str
    """The type of wall: a module of ``pfem_petsc.contact.walls``."""
    node_set: str | None = None
    """The nodes that the wall stops; default: all nodes."""
