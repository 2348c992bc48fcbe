"""Keys of ``[mesh]`` with ``generator = "lattice"``, and of the tables within it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ...case.base import (
    FilePath,
    Finite,
    Name,
    NonNegativeInt,
    PositiveFloat,
    PositiveInts3,
    StrictModel,
    Vector3,
    is_finite_number,
    listed,
)
from .cells import ANGLE, KINDS, UnitCell, auxetic, cell_of
from .expressions import COORDINATES, Expression, Fields, MeshField, can_be_variable

Point = Annotated[tuple[Finite, Finite, Finite], listed]
Strut = Annotated[tuple[int, ...], listed]


class CellKeys(StrictModel):
    """A unit cell, ``[mesh.cell]``."""

    points: Annotated[tuple[Point, ...], listed]
    """coordinates in the cell, in cell edges, from 0 to 1"""
    struts: Annotated[tuple[Strut, ...], listed]
    """points that each strut joins, by numbers from 0: [p, q], or [p, q, i, j, k] if q is i, j, k cells farther on"""
    groups: dict[str, Annotated[tuple[NonNegativeInt, ...], listed]] | None = None
    """bar groups: numbers of struts, from 0, for each name"""

    @field_validator("points")
    @classmethod
    def _inside(cls, points: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        for number, point in enumerate(points):
            if not all(0.0 <= x <= 1.0 for x in point):
                raise ValueError(f"point {number} is outside the cell: expected coordinates from 0 to 1, in cell edges")
        return points

    @model_validator(mode="after")
    def _joined(self) -> CellKeys:
        count = len(self.points)
        if not self.points or not self.struts:
            raise ValueError("expected at least one point and one strut")
        for number, strut in enumerate(self.struts):
            where = f"struts[{number}] = {list(strut)}"
            if len(strut) not in (2, 5) or not all(0 <= p < count for p in strut[:2]):
                raise ValueError(
                    f"{where}: expected two numbers of points, 0 to {count - 1}, or these and the cell (i, j, k) of "
                    "the second one"
                )
            if any(abs(i) > 1 for i in strut[2:]):
                raise ValueError(f"{where}: expected -1, 0 or 1 for the cell of the second point")
        for name, members in (self.groups or {}).items():
            if wrong := [m for m in members if m >= len(self.struts)]:
                raise ValueError(
                    f"groups.{name}: there is no strut {wrong[0]}: they go from 0 to {len(self.struts) - 1}"
                )
        cell = self.made()
        if bare := sorted(set(range(len(cell.points))) - set(cell.ends.ravel().tolist())):
            raise ValueError(f"the point at {cell.points[bare[0]].tolist()} belongs to no strut")
        return self

    def made(self) -> UnitCell:
        """Return the unit cell."""
        return cell_of(self.points, self.struts, self.groups)


class SurfaceKeys(StrictModel):
    """A closed surface that the lattice fills, ``[mesh.surface]``."""

    file: FilePath
    """STL, OBJ or PLY file, relative to the case file"""
    scale: PositiveFloat = 1.0
    """metres per unit of length of the file: 0.001 for millimetres"""
    cut: Literal["trim", "clip"] = "trim"
    """``trim``: only struts that are inside entirely; ``clip``: struts end on the surface, at new nodes"""
    shortest: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """with ``clip``: what is left of a strut is dropped if it is shorter than this fraction of it"""


class FieldKeys(StrictModel):
    """A field on a mesh of VTK for expressions, ``[mesh.fields.NAME]``."""

    file: FilePath
    """VTK file (``.vtu``, ``.vti``, ``.vtk``, ...), relative to the case file"""
    array: Annotated[str, Field(min_length=1)]
    """name of an array of points or cells with one number each"""
    scale: PositiveFloat = 1.0
    """metres per unit of length of the file"""


class CurvedKeys(StrictModel):
    """A map of the block to a curved shell, ``[mesh.curved]``."""

    shape: Literal["cylinder", "sphere"]
    """``cylinder``: x around the y axis; ``sphere``: x and y along great circles; both z outwards"""
    radius: PositiveFloat
    """radius of the inner side, z = 0 [m]"""
    closed: bool = False
    """cylinder: whether the block goes all the way around, and its ends are joined"""

    @model_validator(mode="after")
    def _what_closes(self) -> CurvedKeys:
        if self.closed and self.shape != "cylinder":
            raise ValueError('closed = true needs shape = "cylinder"')
        return self


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
        if value is None:
            return None
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise ValueError('expected three factors on the pitch along x, y and z, like [1, 1, "1 + 2*z"]')
        for axis, factor in zip(COORDINATES, value):
            if isinstance(factor, str):
                Expression(factor, (axis,))
            elif not is_finite_number(factor) or not 1e-100 < factor < 1e100:
                raise ValueError(f"expected a factor > 0 or an expression of {axis}, got {factor!r}")
        return tuple(factor if isinstance(factor, str) else float(factor) for factor in value)

    @model_validator(mode="after")
    def _consistent(self) -> Parameters:
        for name in self.fields or {}:
            if not can_be_variable(name):
                raise ValueError(f"fields.{name}: expected a name of letters, digits and underscores")
        self.expressions()
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

    def expressions(self) -> Fields:
        """Return the expressions ``keep``, ``map[0]`` to ``map[2]``, and those of ``bar_fields``."""
        texts = {f"bar_fields.{name}": text for name, text in (self.bar_fields or {}).items()}
        texts |= {"keep": self.keep} if self.keep is not None else {}
        texts |= {f"map[{axis}]": text for axis, text in enumerate(self.map or ())}
        fields = {
            name: MeshField(f"mesh.fields.{name}", keys.file, keys.array, keys.scale)
            for name, keys in (self.fields or {}).items()
        }
        return Fields(texts, fields)

    def unit_cell(self) -> UnitCell:
        """Return the unit cell."""
        if self.cell is not None:
            return self.cell.made()
        return auxetic(self.angle or ANGLE) if self.kind == "auxetic" else KINDS[self.kind]()
