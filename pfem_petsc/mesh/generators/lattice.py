"""A block of a space lattice: built-in or own unit cells, graded, curved, or cut to a closed surface."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ...case.base import Name, NonNegativeInt, PositiveFloat, PositiveInts3, StrictModel, Vector3, listed
from ..lattices.build import build, generate_block
from ..lattices.expressions import RESERVED
from ..lattices.keys import (
    COORDINATES,
    CellKeys,
    CurvedKeys,
    FieldKeys,
    SurfaceKeys,
    checked_expression,
    grading_factors,
)
from ..lattices.kinds import ANGLE
from ..slab import MeshSlab

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = ["Parameters", "generate", "generate_on"]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "lattice"``."""

    kind: Literal[
        "cubic",
        "octet",
        "bcc",
        "bcc_diagonals",
        "fcc",
        "kelvin",
        "diamond",
        "gyroid",
        "auxetic",
        "tetrahedral_octahedral",
        "cell",
    ] = "cubic"
    """``cubic``: edges and both diagonals of every face of the cubes. ``octet``: face-centred nodes, every pair of
    nearest neighbours. ``bcc``: corners and centres, the eight half diagonals of each cube and the cube edges
    (without which it would be a mechanism). ``cell``: the unit cell of the key ``cell``. docs/lattices.md has all."""
    cells: PositiveInts3 | None = None
    """Number of cubic cells along x, y and z; with ``surface``, default: as many as cover it, from ``origin`` on where
    ``grading`` is an expression."""
    pitch: PositiveFloat
    """Edge of the cubic cell [m]."""
    angle: Annotated[float, Field(gt=0.0, lt=45.0)] | None = None
    """Angle of the inclined struts of ``auxetic`` against the x-y plane [degrees]; default: 20."""
    cell: CellKeys | None = None
    """The unit cell of the kind ``cell``: ``points``, ``struts``, ``groups``."""
    grading: Any = None
    """Three factors on the pitch along x, y and z: numbers, or expressions of one coordinate from ``origin`` [m]."""
    perturbation: Annotated[float, Field(ge=0.0, lt=0.5)] | None = None
    """Random displacement of nodes along each axis, at most this fraction of the pitch."""
    missing: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    """Probability with which a strut is left out."""
    seed: NonNegativeInt | None = None
    """Seed of ``perturbation`` and ``missing``; default: 0."""
    origin: Vector3 | None = None
    """Where the corner of the first cell goes, after ``curved`` the centre of the shell [m]; default: the origin, with
    ``surface`` and without ``cells`` the lower corner of the box around it."""
    surface: SurfaceKeys | None = None
    """A closed surface that the lattice fills: ``file``, ``scale``, ``cut``, ``shortest``."""
    dangling: Literal["remove", "keep"] | None = None
    """Struts that end at a node without another; default: ``remove`` with ``surface``, ``keep`` or
    ``missing``, else ``keep``."""
    curved: CurvedKeys | None = None
    """Map to a curved shell: ``shape``, ``radius``, ``closed``."""
    fields: dict[Name, FieldKeys] | None = None
    """Fields on meshes of VTK, by their names in expressions: ``file``, ``array``, ``scale``."""
    map: Annotated[tuple[str, str, str], listed] | None = None
    """Three expressions of x, y and z [m] and ``fields``: where each node goes."""
    keep: str | None = None
    """Nodes where this expression of x, y and z [m] and ``fields`` is false are left out, with their struts."""
    bar_fields: dict[Name, str] | None = None
    """Cell fields of the bars by name, for ``area_field``: expressions of x, y and z of their middles [m], and of
    ``fields``."""

    @field_validator("grading")
    @classmethod
    def _factors(cls, value: Any) -> Any:
        return None if value is None else grading_factors(value)

    @model_validator(mode="after")
    def _expressions(self) -> Parameters:
        for name in self.fields or {}:
            if not name.isidentifier() or name in RESERVED:
                raise ValueError(f"fields.{name}: expected a name of letters, digits and underscores")
        texts = {f"bar_fields.{name}": text for name, text in (self.bar_fields or {}).items()}
        texts |= {"keep": self.keep} if self.keep is not None else {}
        texts |= {f"map[{axis}]": text for axis, text in enumerate(self.map or ())}
        for key, text in texts.items():
            try:
                checked_expression(text, (*COORDINATES, *(self.fields or {})))
            except ValueError as error:
                raise ValueError(f"{key} = {text!r}: {error}") from None
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Parameters:
        if self.map is not None and self.curved is not None:
            raise ValueError("map and the table [mesh.curved] exclude each other: give one of them")
        if self.cells is None and (self.surface is None or self.curved is not None or self.map is not None):
            raise ValueError("the key cells is missing: number of cells along x, y and z")
        if (self.kind == "cell") != (self.cell is not None):
            raise ValueError('kind = "cell" and the table [mesh.cell] with points and struts need each other')
        if self.angle is not None and self.kind != "auxetic":
            raise ValueError(f'angle belongs to kind = "auxetic" (default {ANGLE:g}), not to {self.kind!r}')
        if self.seed is not None and not (self.perturbation or self.missing):
            raise ValueError("seed needs perturbation or missing")
        if self.curved is not None and self.curved.closed and self.cells is not None and self.cells[0] < 3:
            raise ValueError("curved.closed = true needs 3 cells or more along x")
        return self


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part of a lattice from which nothing is cut, by index arithmetic and without messages.

    Corners without a bar, of kinds such as ``diamond``, are still in it.

    Node groups: ``bottom`` and ``top`` (z faces), ``left`` and ``right`` (x faces), ``front`` and ``back`` (y faces).
    Bar groups: those of the unit cell.
    """
    return generate_block(parameters, rank, size)


def generate_on(
    parameters: Parameters, comm: MPI.Comm, fields: Mapping[str, str], groups: Collection[str] | None
) -> MeshSlab:
    """Generate this rank's part; no rank has the whole lattice. Collective.

    Parameters
    ----------
    fields : names of cell fields to make, each with the key that asks for it, for messages
    groups : names of the bar groups to make; None: all

    Raises
    ------
    InputError
        On all ranks.
    """
    return build(parameters, comm, fields, groups)
