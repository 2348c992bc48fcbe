"""What every table of a case file is made of: a strict model and its number types.

Generators, integrators and walls declare their keys with these, so that a case file is refused with the key's name
before any work is done. Imports pydantic alone.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

__all__ = [
    "ConstraintKeys",
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
    "listed",
]


class StrictModel(BaseModel):
    """A table of a case file: unknown keys refused, values of the stated type only, finite numbers only, frozen.

    An integer is taken where a float is expected; a string or a boolean never stands for a number.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def _tuple_from_list(value: Any) -> Any:
    """TOML has lists where the models hold tuples; anything else is left to the strict check."""
    return tuple(value) if isinstance(value, list) else value


listed = BeforeValidator(_tuple_from_list)
"""Put on a tuple type (``Annotated[tuple[float, float], listed]``): takes TOML's lists."""


def _no_path_of_its_own(name: str) -> str:
    if name in (".", ".."):
        raise ValueError("a dot is no name; results are kept under it")
    return name


Finite = Annotated[float, Field(allow_inf_nan=False)]
PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
PositiveInt = Annotated[int, Field(gt=0, lt=2**63)]
NonNegativeInt = Annotated[int, Field(ge=0, lt=2**63)]
Vector3 = Annotated[tuple[Finite, Finite, Finite], listed]
PositiveInts3 = Annotated[tuple[PositiveInt, PositiveInt, PositiveInt], listed]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^/\x00-\x1f\x7f-\x9f]+$"), AfterValidator(_no_path_of_its_own)]
"""A name that ends up as part of a path inside the result file: not empty, no slash, no dot alone, which HDF5 skips."""


NodeSetName = Annotated[str, Field(json_schema_extra={"refers_to": "node_set"})]
"""A key of a constraint that names a node set of the case; that there is one is checked with the case."""


class ConstraintKeys(StrictModel):
    """The keys that every constraint has; a kind of constraint adds its own."""

    name: Name
    """Names the constraint in results and messages; unique. One without is called ``constraint1``, ..."""
    kind: str
    """The kind of constraint: a module of ``pfem_petsc.contact.constraints``."""


class WallParameters(StrictModel):
    """The keys that every wall has; a kind of wall adds its own."""

    name: Name
    """Names the wall in results and messages; unique. A wall without one is called ``wall1``, ``wall2``, ..."""
    type: str
    """The kind of wall: a module of ``pfem_petsc.contact.walls``."""
    node_set: str | None = None
    """The nodes that the wall stops; default: every node."""
