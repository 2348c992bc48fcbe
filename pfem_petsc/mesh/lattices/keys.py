"""Tables within ``[mesh]`` of a lattice."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from ...case.base import FilePath, Finite, NonNegativeInt, PositiveFloat, StrictModel, listed
from .cell import UnitCell, cell_of
from .expressions import Expression

__all__ = ["COORDINATES", "CellKeys", "CurvedKeys", "FieldKeys", "SurfaceKeys", "checked_expression", "grading_factors"]

COORDINATES = ("x", "y", "z")

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
            if len(strut) not in (2, 5) or not all(0 <= p < count for p in strut[:2]):
                raise ValueError(
                    f"struts[{number}] = {list(strut)}: expected two numbers of points, 0 to {count - 1}, or these and "
                    "the cell (i, j, k) of the second one"
                )
            if any(abs(i) > 1 for i in strut[2:]):
                raise ValueError(
                    f"struts[{number}] = {list(strut)}: expected -1, 0 or 1 for the cell of the second point"
                )
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
        groups = self.groups if self.groups is not None else {"struts": range(len(self.struts))}
        return cell_of(self.points, self.struts, groups)


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


def checked_expression(text: Any, variables: tuple[str, ...] = COORDINATES) -> Expression:
    """Return an expression of coordinates from a key.

    Raises
    ------
    ValueError
        If it is not one.
    """
    if not isinstance(text, str):
        raise ValueError('expected an expression in quotes, like "1e-6*(1 + z/0.1)"')
    return Expression(text, variables)


def grading_factors(value: Any) -> tuple[float | str, ...]:
    """Return three factors, each a number or an expression of its own coordinate."""
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError('expected three factors on the pitch along x, y and z, like [1, 1, "1 + 2*z"]')
    factors: list[float | str] = []
    for axis, factor in zip(COORDINATES, value):
        if isinstance(factor, str):
            checked_expression(factor, (axis,))
            factors.append(factor)
        elif isinstance(factor, bool) or not isinstance(factor, int | float) or not 1e-100 < factor < 1e100:
            raise ValueError(f"expected a factor > 0 or an expression of {axis}, got {factor!r}")
        else:
            factors.append(float(factor))
    return tuple(factors)
