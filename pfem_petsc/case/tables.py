"""The tables of a case file that define the model, each with its keys (SI units)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, InstanceOf, ValidationInfo, field_validator, model_validator

from .base import (
    FileName,
    Finite,
    Name,
    NodeSetName,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    StrictModel,
    Vector3,
    WithParameters,
    listed,
    number_or_rows,
)
from .load_tables import Gravity, Load, LoadFile, Temperature, VaryingGravity, VaryingWind, Wind
from .point_tables import Dashpot, NodalMass, Spring
from .rows import increasing
from .support_tables import Support

__all__ = [
    "ARRAYS",
    "ContactPair",
    "Dashpot",
    "Gravity",
    "Initial",
    "Load",
    "LoadFile",
    "Mesh",
    "MeshKeys",
    "NodalMass",
    "NodeSet",
    "PRESTRESSES",
    "Remove",
    "Section",
    "Spring",
    "Support",
    "Temperature",
    "VaryingGravity",
    "VaryingWind",
    "Wind",
]

Indices = Annotated[tuple[NonNegativeInt, ...], listed]


ARRAYS = "arrays"
"""The generator of meshes that are given as arrays, or in the case file itself."""


PRESTRESSES = ("pretension", "prestress", "rest_length")
"""Keys of a section that prescribe rest lengths."""


class MeshKeys(StrictModel):
    """The keys of [mesh] other than those of a generator."""

    generator: Name | None = None
    """name of a mesh generator"""
    file: FileName | None = None
    """mesh file, relative to the case file"""

    @model_validator(mode="after")
    def _exactly_one(self) -> MeshKeys:
        if (self.generator is None) == (self.file is None):
            hint = "" if self.file else " (a file is made from arrays by pfem_petsc.write_mesh)"
            raise ValueError(f"expected exactly one of the keys generator, file{hint}")
        return self


class Mesh(WithParameters):
    """Source of the mesh: a generator with its parameters, or a file."""

    generator: str | None = None
    file: Path | None = None
    parameters: InstanceOf[StrictModel] | None = None

    @property
    def arranged(self) -> bool:
        """Whether a generator computes the mesh, which is then free of mistakes."""
        return self.generator not in (None, ARRAYS)


class NodeSet(StrictModel):
    """A named set of nodes, selected by exactly one key."""

    nearest: Vector3 | None = None
    """a point [m]: selects the nearest node"""
    box: Annotated[tuple[Vector3, Vector3], listed] | None = None
    """lower and upper corner [m]: selects the nodes inside, faces included"""
    group: str | None = None
    """a node group of the mesh"""
    indices: Indices | None = None
    """node numbers of the mesh, from 0"""
    all: Literal[True] | None = None
    """true: all nodes"""

    @field_validator("box")
    @classmethod
    def _ordered(cls, box: tuple[Vector3, Vector3] | None) -> tuple[Vector3, Vector3] | None:
        if box is not None:
            for axis, low, high in zip("xyz", *box, strict=True):
                if low > high:
                    raise ValueError(f"the first corner must be the lower one, but {axis} is {low!r} and then {high!r}")
        return box

    @field_validator("indices")
    @classmethod
    def _distinct(cls, indices: tuple[int, ...] | None) -> tuple[int, ...] | None:
        if indices is not None and not indices:
            raise ValueError("expected at least one node number")
        if indices is not None and len(set(indices)) < len(indices):
            raise ValueError("a node number is listed twice")
        return indices

    @model_validator(mode="after")
    def _exactly_one(self) -> NodeSet:
        given = [k for k in type(self).model_fields if getattr(self, k) is not None]
        if len(given) != 1:
            found = f"got {' and '.join(given)}" if given else "got none"
            raise ValueError(f"expected exactly one of the keys {', '.join(type(self).model_fields)}, {found}")
        return self


class Section(StrictModel):
    """Cross-section and material of bars."""

    area: PositiveFloat | None = None
    """cross-section area [m2]"""
    area_field: Annotated[str, Field(min_length=1)] | None = None
    """cell field of the mesh file with the area of each bar [m2], instead of ``area``"""
    material: str
    """name of a material"""
    bars: str | None = None
    """bar group of the mesh; default: all bars that no other section names"""
    shape: Literal["round", "tube"] | None = None
    """shape of the cross-section: a solid circle or a tube of this area"""
    thickness: PositiveFloat | None = None
    """wall thickness of a tube [m]"""
    second_moment: PositiveFloat | None = None
    """second moment of area about the axis of buckling [m4], instead of a shape"""
    effective_length: PositiveFloat = 1.0
    """effective length factor K: a bar buckles over K times its length"""
    diameter: PositiveFloat | None = None
    """diameter in wind [m]; default: that of the shape, or of a round bar of this area"""
    drag_coefficient: NonNegativeFloat | None = None
    """drag coefficient in wind; default: that of [wind]"""
    pretension: Any = None
    """axial force in the mesh [N], or rows [t, force] [s, N]: linear between rows, constant outside"""
    prestress: Any = None
    """stress in the mesh [Pa], or rows [t, stress] [s, Pa]"""
    rest_length: Any = None
    """rest length over the length in the mesh, or rows [t, factor] [s, -]"""

    @field_validator("pretension", "prestress", "rest_length")
    @classmethod
    def _number_or_rows(cls, value: Any, info: ValidationInfo) -> Any:
        if value is None:
            return None
        value = number_or_rows(value)
        rows = ((0.0, value),) if isinstance(value, float) else value
        increasing(rows)
        if info.field_name == "rest_length" and not all(1e-3 < row[1] < 1e3 for row in rows):
            raise ValueError("expected a factor on the length in the mesh, like 0.99, or rows [t, factor]")
        return value

    @model_validator(mode="after")
    def _one_area(self) -> Section:
        if (self.area is None) == (self.area_field is None):
            raise ValueError("expected exactly one of the keys area, area_field")
        return self

    @model_validator(mode="after")
    def _one_prestress(self) -> Section:
        given = [key for key in PRESTRESSES if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(f"expected at most one of the keys {', '.join(PRESTRESSES)}; got {' and '.join(given)}")
        return self

    @property
    def prestressed(self) -> str | None:
        """The key that prescribes rest lengths, None without one."""
        return next((key for key in PRESTRESSES if getattr(self, key) is not None), None)

    @model_validator(mode="after")
    def _one_shape(self) -> Section:
        if (self.shape == "tube") != (self.thickness is not None):
            raise ValueError('shape = "tube" and thickness [m] need each other')
        if self.shape is not None and self.second_moment is not None:
            raise ValueError("second_moment follows from the shape: give one of the two")
        if self.thickness is not None and self.area is not None and self.thickness > math.sqrt(self.area / math.pi):
            raise ValueError(
                f"thickness = {self.thickness!r} m is too much for a tube of area = {self.area!r} m2: a solid bar of "
                f"this area has a radius of {math.sqrt(self.area / math.pi):.6g} m"
            )
        return self


class Initial(StrictModel):
    """Initial velocity v + w x (X - c) of a node set, or of all nodes if ``node_set`` is None."""

    node_set: str | None = None
    """name of a node set"""
    velocity: Vector3 = (0.0, 0.0, 0.0)
    """velocity v [m/s]"""
    angular_velocity: Vector3 = (0.0, 0.0, 0.0)
    """angular velocity w [rad/s]"""
    centre: Vector3 | None = None
    """centre c of the rotation [m]; default: the centre of mass"""

    @model_validator(mode="after")
    def _centre_turns(self) -> Initial:
        if self.centre is not None and not any(self.angular_velocity):
            raise ValueError("centre needs an angular_velocity [rad/s] other than zero")
        return self


class ContactPair(StrictModel):
    """Nodes of two bodies that cannot pass each other along a direction, in pairs."""

    name: Name
    """name of the pairs in results and messages; unique"""
    first: NodeSetName
    """name of a node set"""
    second: NodeSetName
    """name of a node set of equal size; each node is paired with the nearest of first, seen along the direction"""
    direction: Vector3
    """points from the first nodes to the second"""
    gap: Finite = 0.0
    """smallest distance of second from first along the direction [m]"""

    @field_validator("direction")
    @classmethod
    def _has_length(cls, value: Vector3) -> Vector3:
        if not any(value):
            raise ValueError("has zero length; give the direction from first to second")
        if not 1e-100 < max(map(abs, value)) < 1e100:
            raise ValueError("has components out of range (1e-100 to 1e100); give a vector of about length 1")
        return value


class Remove(StrictModel):
    """Bars or supports that are removed, at once or gradually."""

    bars: str | None = None
    """bar group of the mesh"""
    supports: str | None = None
    """name of a support"""
    time: NonNegativeFloat
    """time [s], or load factor, at which the removal begins"""
    duration: NonNegativeFloat = 0.0
    """time [s], or change of the load factor, over which the force is reduced to zero linearly; 0: at once"""

    @model_validator(mode="after")
    def _exactly_one(self) -> Remove:
        if (self.bars is None) == (self.supports is None):
            raise ValueError("expected exactly one of the keys bars, supports")
        return self
