"""The tables of a case file, each with its keys (SI units); :mod:`~pfem_petsc.case.model` puts them together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    field_validator,
    model_validator,
)

from ..errors import InputError
from .base import (
    Digest,
    FileName,
    FilePath,
    Finite,
    Name,
    NodeSetName,
    NonNegativeFloat,
    NonNegativeInt,
    NumberOrRows,
    PositiveFloat,
    PositiveInt,
    StrictModel,
    SurfaceKeys,
    Table2,
    Table4,
    Vector3,
    VectorOrRows,
    WithFiles,
    has_rows,
    is_finite_number,
    listed,
    must,
    refers,
    refusal,
)
from .files import found_file, profile_of
from .section_shapes import SHAPES, SIZES, CrossSection, cross_section


def distinct(what: str) -> AfterValidator:
    """Annotation of a list of tables whose names must differ, those of a ``what``."""

    def check(entries: Sequence[Any]) -> Sequence[Any]:
        names = [entry.name for entry in entries]
        twice = [i for i, name in enumerate(names) if name is not None and name in names[:i]]
        if twice:
            raise refusal(*(((i, "name"), f"another {what} has this name", names[i]) for i in twice))
        return entries

    return AfterValidator(check)


BY_BAR = ("pretension", "rest_length", "force_density", "target_length")
"""Keys of a section whose values may also be those of a field of the mesh, ``pretension_field`` and so on."""
PRESTRESSES = ("prestress", *BY_BAR, *(f"{key}_field" for key in BY_BAR))
"""Keys of a section that prescribe rest lengths."""
FIELD_KEYS = ("area_field", *(f"{key}_field" for key in BY_BAR))
"""Keys of a section that name fields of the mesh with a value for each bar."""


_PARALLEL = 1e-6  # sine of the angle between two vectors that give no frame

Direction = Annotated[
    Vector3,
    must(any, "has zero length; give a direction"),
    must(
        lambda vector: 1e-100 < max(map(abs, vector)) < 1e100,
        "has components out of range (1e-100 to 1e100); give a vector of about length 1",
    ),
]
"""A vector of any length, which gives a direction."""


def _parallel(table: Any) -> bool:
    """Whether the two vectors of the key ``frame`` give none."""
    first, second = (np.array(row) / np.linalg.norm(row) for row in table.frame)
    return np.linalg.norm(np.cross(first, second)) < _PARALLEL


NO_FRAME = (
    lambda own: own.frame is not None and _parallel(own),
    "the two vectors of frame are parallel; the second must point to the side of the y axis",
)
"""One of the conflicts of tables with the key ``frame``."""


class MeshKeys(StrictModel):
    """The keys of [mesh] other than those of a generator."""

    generator: Name | None = None
    """name of a mesh generator"""
    file: Annotated[FilePath, AfterValidator(lambda name: Path(name)), PlainSerializer(str)] | None = None
    """mesh file, relative to the case file"""

    @model_validator(mode="after")
    def _exactly_one(self) -> MeshKeys:
        if (self.generator is None) == (self.file is None):
            hint = "" if self.file else " (a file is made from arrays by pfem_petsc.write_mesh)"
            raise ValueError(f"expected exactly one of the keys generator, file{hint}")
        return self


class FieldValue(StrictModel):
    """The bars or nodes at which a field of the mesh has a value, which the mesh then has as a group of this text."""

    field: Annotated[str, Field(min_length=1)]
    """name of a field of the mesh"""
    value: Annotated[int, Field(ge=-(2**53), le=2**53)]
    """a whole number, the value of the field"""

    def __str__(self) -> str:
        return f"{self.field} = {self.value}"


def _of_bars(given: Any, info: ValidationInfo) -> str | FieldValue:
    if isinstance(given, str | FieldValue):
        return given
    if not isinstance(given, Mapping):
        raise ValueError('expected the name of a bar group, or a value of a field: { field = "NAME", value = 2 }')
    return FieldValue.model_validate(dict(given), context=info.context)


BarGroup = Annotated[
    FieldValue | str,
    PlainValidator(_of_bars),
    PlainSerializer(lambda bars: bars if isinstance(bars, str) else bars.as_table()),
]
"""A group of bars: a name in the mesh, or a value of a field; its text is the name in ``bar_groups`` in both cases."""


def numbers_of(what: str) -> Any:
    """Type of a key with numbers of nodes or bars, a ``what``, of which there is at least one, and none is listed
    twice."""
    once = must(lambda numbers: len(set(numbers)) == len(numbers), f"a {what} number is listed twice")
    return Annotated[tuple[NonNegativeInt, ...], listed, must(len, f"expected at least one {what} number"), once]


NodeNumbers, BarNumbers = numbers_of("node"), numbers_of("bar")


class NodeSet(StrictModel):
    """A named set of nodes, selected by exactly one key; ``field`` goes with ``value``."""

    exactly_one = (("nearest", "box", "group", "indices", "field", "all"),)
    conflicts = (
        (
            lambda own: (own.field is None) != (own.value is None),
            'field and value need each other: field = "NAME", value = 2',
        ),
    )

    nearest: Vector3 | None = None
    """a point [m]: selects the nearest node"""
    box: Annotated[tuple[Vector3, Vector3], listed] | None = None
    """lower and upper corner [m]: selects the nodes inside, faces included"""
    group: str | None = None
    """a node group of the mesh"""
    indices: NodeNumbers | None = None
    """node numbers of the mesh, from 0"""
    field: Annotated[str, Field(min_length=1)] | None = None
    """a field of the mesh: selects the nodes where it has ``value``; of a field of bars, the ends of these bars"""
    value: Annotated[int, Field(ge=-(2**53), le=2**53)] | None = None
    """a whole number, the value of ``field``"""
    all: Literal[True] | None = None
    """true: all nodes"""

    @field_validator("box")
    @classmethod
    def _ordered(cls, box: tuple[Vector3, Vector3] | None) -> tuple[Vector3, Vector3] | None:
        for axis, low, high in zip("xyz", *box, strict=True) if box is not None else ():
            if low > high:
                raise ValueError(f"the first corner must be the lower one, but {axis} is {low!r} and then {high!r}")
        return box

    @property
    def selection(self) -> FieldValue | None:
        """The value of a field that selects the nodes, if one does."""
        return None if self.field is None else FieldValue.model_construct(field=self.field, value=self.value)


class Rupture(StrictModel):
    """A bar breaks at the end of the step in which it first reaches one of the limits."""

    conflicts = (
        (
            lambda own: all(value is None for key, value in own if key != "steps"),
            "expected at least one limit: stress, strain, compressive_stress, compressive_strain, plastic_strain, "
            "damage",
        ),
    )

    stress: PositiveFloat | None = None
    """tensile stress [Pa]"""
    strain: PositiveFloat | None = None
    """tensile strain, without the thermal strain, in the strain measure of the material"""
    compressive_stress: PositiveFloat | None = None
    """magnitude of the compressive stress [Pa]"""
    compressive_strain: PositiveFloat | None = None
    """magnitude of the compressive strain, without the thermal strain"""
    plastic_strain: PositiveFloat | None = None
    """accumulated plastic strain; the magnitude of the plastic strain for laws that do not accumulate it"""
    damage: PositiveFloat | None = None
    """damage variable of the law"""
    steps: PositiveInt = 1
    """steps over which the force of a broken bar is reduced to zero in equal parts"""


class Section(StrictModel):
    """Cross-section and material of bars."""

    at_most_one = (("area", "area_field"), ("shape", "second_moment"), PRESTRESSES)

    area: PositiveFloat | None = None
    """cross-section area [m2]; default: that of the sizes of the shape"""
    area_field: Annotated[str, Field(min_length=1)] | None = None
    """cell field of the mesh file with the area of each bar [m2], instead of ``area``"""
    material: Annotated[str, refers("material", "material")]
    """name of a material"""
    bars: BarGroup | None = None
    """bar group of the mesh, or the bars with a value of a field: { field = "NAME", value = 2 }; default: all bars that
    no other section names"""
    shape: Literal[SHAPES] | None = None  # type: ignore[valid-type]
    """shape of the cross-section, by sizes; an area may stand for the diameter of a solid circle, for the diameter or
    the thickness of a tube, and for the thickness of the others"""
    diameter: PositiveFloat | None = None
    """outer diameter of a solid circle or a tube [m]; without a shape, the diameter in wind alone, by default that of a
    solid circle of this area"""
    width: PositiveFloat | None = None
    """width of an angle, box, I section or channel, over all [m]"""
    height: PositiveFloat | None = None
    """height of the same, over all [m]; default: width"""
    thickness: PositiveFloat | None = None
    """thickness of the walls of a tube or box, of the legs of an angle, of the flanges of the others [m]"""
    web_thickness: PositiveFloat | None = None
    """thickness of the web of an I section or channel [m]; default: thickness"""
    second_moment: PositiveFloat | None = None
    """second moment of area about the axis of buckling [m4], instead of a shape"""
    catalogue: FileName | None = None
    """CSV file with a line for each profile: its name in the column ``profile``, and keys of this table in others"""
    profile: Annotated[str, Field(min_length=1)] | None = None
    """name of a profile in the catalogue, whose values the section has"""
    effective_length: PositiveFloat = 1.0
    """effective length factor K: a bar buckles over K times its length"""
    drag_coefficient: NonNegativeFloat | None = None
    """drag coefficient in wind; default: that of [wind]"""
    pretension: NumberOrRows | None = None
    """axial force in the mesh [N], or rows [t, force] [s, N]: linear between rows, constant outside"""
    prestress: NumberOrRows | None = None
    """stress in the mesh [Pa], or rows [t, stress] [s, Pa]"""
    rest_length: (
        Annotated[
            NumberOrRows,
            must(
                lambda value: all(1e-3 < row[1] < 1e3 for row in (value if has_rows(value) else [[0.0, value]])),
                "expected a factor on the length in the mesh, like 0.99, or rows [t, factor]",
            ),
        ]
        | None
    ) = None
    """rest length over the length in the mesh, or rows [t, factor] [s, -]; if constant, mass is that of this length"""
    force_density: NumberOrRows | None = None
    """axial force over length in the mesh [N/m], or rows [t, q] [s, N/m]"""
    target_length: PositiveFloat | None = None
    """length in a form that is found [m]"""
    pretension_field: Annotated[str, Field(min_length=1)] | None = None
    """cell field of the mesh file with the ``pretension`` of each bar [N]"""
    rest_length_field: Annotated[str, Field(min_length=1)] | None = None
    """cell field of the mesh file with the ``rest_length`` of each bar over its length in the mesh"""
    force_density_field: Annotated[str, Field(min_length=1)] | None = None
    """cell field of the mesh file with the ``force_density`` of each bar [N/m]"""

    target_length_field: Annotated[str, Field(min_length=1)] | None = None
    """cell field of the mesh file with the ``target_length`` of each bar [m]"""

    @model_validator(mode="before")
    @classmethod
    def _of_catalogue(cls, data: Any, info: ValidationInfo) -> Any:
        """Put the values of a profile in the place of its name, so that a case does not depend on the file any more."""
        if not isinstance(data, Mapping) or info.context is None or not {"catalogue", "profile"} & set(data):
            return data
        for key in ("catalogue", "profile"):
            if not isinstance(data.get(key), str) or not data[key]:
                raise ValueError("catalogue (a CSV file) and profile (a name in it) need each other")
        try:
            values = profile_of(Path(info.context.folder, data["catalogue"]), data["profile"], list(cls.model_fields))
        except InputError as error:
            raise refusal((("catalogue",), str(error), data["catalogue"])) from error
        taken = [key for key in values if key in data]
        if taken:
            text = f"the profile {data['profile']!r} has this value too: remove it here, or from the catalogue"
            raise refusal(((taken[0],), text, data[taken[0]]))
        return {key: value for key, value in data.items() if key not in ("catalogue", "profile")} | values

    @property
    def prestressed(self) -> str | None:
        """The key that prescribes rest lengths, None without one."""
        return next((key for key in PRESTRESSES if getattr(self, key) is not None), None)

    @property
    def sizes(self) -> dict[str, float]:
        """The sizes that are given [m]."""
        return {key: getattr(self, key) for key in SIZES if getattr(self, key) is not None}

    @property
    def uniform_area(self) -> float | None:
        """The area of each bar [m2], given or that of the sizes; None with a field of areas."""
        return float(self.cross_section().area) if self.area_field is None else None

    def cross_section(self, area: np.ndarray | None = None) -> CrossSection:
        """Return the cross-sections of the bars, with the areas (b,) [m2] of the field if the section has one."""
        return cross_section(self.shape, self.sizes, self.area if self.area_field is None else area, self.second_moment)

    @model_validator(mode="after")
    def _has_sizes(self) -> Section:
        # areas of a field are checked with the mesh; these suit any size
        thickness, diameter = self.thickness or 0.0, self.diameter or 0.0
        trial = max(2.0 * math.pi * thickness * thickness, 0.125 * math.pi * diameter * diameter) or 1.0
        try:
            found = self.cross_section(np.array([trial]))
        except OverflowError:
            found = CrossSection(0.0, 0.0, 0.0, 0.0, 0.0)
        if not np.all(np.isfinite(np.hstack(found))) or not np.all(np.asarray(found.area) > 0.0):
            raise ValueError(f"sizes are out of range, in square metres: {self.sizes}")
        return self


class Initial(StrictModel):
    """Initial velocity v + w x (X - c) of a node set, or of all nodes if ``node_set`` is None."""

    conflicts = (
        (
            lambda own: own.centre is not None and not any(own.angular_velocity),
            "centre needs an angular_velocity [rad/s] other than zero",
        ),
    )

    node_set: NodeSetName | None = None
    """name of a node set"""
    velocity: Vector3 = (0.0, 0.0, 0.0)
    """velocity v [m/s]"""
    angular_velocity: Vector3 = (0.0, 0.0, 0.0)
    """angular velocity w [rad/s]"""
    centre: Vector3 | None = None
    """centre c of the rotation [m]; default: the centre of mass"""


class Support(WithFiles):
    """Fixed or prescribed position components of a node set."""

    exactly_one = (("fix", "normal"),)
    at_most_one = (("motion", "velocity", "acceleration"),)
    conflicts = (
        (
            lambda own: own.interpolation == "linear" and own.motion is None,
            'interpolation = "linear" requires motion; accelerations are always linear between rows',
        ),
        (
            lambda own: own.frame is not None and own.fix is None,
            "frame defines the axes of fix; expected the key fix",
        ),
        NO_FRAME,
        (
            lambda own: own.normal is not None and own._moves_across,
            "the motion has no component along normal, so it would have no effect",
        ),
    )

    name: Name | None = None
    """name, by which [[remove]] refers to the support; unique"""
    node_set: NodeSetName
    """name of a node set"""
    fix: (
        Annotated[
            str,
            must(
                lambda fix: fix and set(fix) <= set("xyz") and len(set(fix)) == len(fix),
                'expected any of the components x, y, z, each once, like "xz"',
            ),
        ]
        | None
    ) = None
    """the fixed components: any of x, y, z"""
    frame: Annotated[tuple[Direction, Direction], listed] | None = None
    """axes of ``fix`` that are not those of the model: x along the first vector, y in the plane of both, on the side of
    the second"""
    normal: Direction | None = None
    """instead of ``fix``: the one direction along which displacements are prescribed, such as the normal of the plane
    on which a roller moves"""
    motion: Table4 | None = None
    """rows [t, dx, dy, dz]: displacement from the mesh [s, m], at rest before the first and after the last row"""
    velocity: VectorOrRows | None = None
    """constant velocity of the fixed components [m/s]; or rows [t, vx, vy, vz] [s, m/s]: linear between rows, zero
    outside"""
    acceleration: Table4 | None = None
    """rows [t, ax, ay, az] [s, m/s2]: linear between rows, zero outside; the fixed components start from rest"""
    motion_file: FileName | None = None
    """the rows of ``motion`` from the columns of a CSV or NPZ file: its name, or a table of :class:`TableFile`"""
    velocity_file: FileName | None = None
    """the rows of ``velocity`` from a file in the same way"""
    acceleration_file: FileName | None = None
    """the rows of ``acceleration`` from a file in the same way"""
    interpolation: Literal["smooth", "linear"] = "smooth"
    """interpolation of ``motion`` between its rows: a cubic spline, or straight lines with velocity jumps at rows"""

    @model_validator(mode="after")
    def _moves_what_it_fixes(self) -> Support:
        for axis, moves in zip("xyz", self._vectors.any(axis=0)) if self.fix and self.frame is None else ():
            free = moves and axis not in self.fix
            if free:
                raise ValueError(f'{axis} is given a motion, but fix = "{self.fix}" leaves it free')
        return self

    @property
    def _moves_across(self) -> bool:
        """Whether all vectors of its motion are across the one direction in which it prescribes them."""
        unit, given = np.array(self.normal) / np.linalg.norm(self.normal), self._vectors
        return given.any() and np.abs(given @ unit).max() <= _PARALLEL * np.abs(given).max()

    @property
    def _vectors(self) -> np.ndarray:
        """The vectors (n, 3) that describe its motion."""
        rows = self.motion or self.acceleration or (self.velocity if has_rows(self.velocity) else ())
        constant = self.velocity is not None and not has_rows(self.velocity)
        return np.array([row[1:] for row in rows] + ([self.velocity] if constant else [])).reshape(-1, 3)


class NodalMass(StrictModel):
    """Mass of each node of a node set, in addition to that of its bars."""

    node_set: NodeSetName
    """name of a node set"""
    value: NonNegativeFloat
    """mass of each node of the set [kg]"""
    damping: NonNegativeFloat = 0.0
    """damping of this mass over it [1/s], as ``damping`` of a material over its density"""


class Damping(StrictModel):
    """Rayleigh damping of the whole truss, C = a M + b K: each material and nodal mass gets its part."""

    ratio: Annotated[float, Field(gt=0.0, lt=1.0)]
    """damping ratio, of critical damping, at the frequencies"""
    frequencies: Annotated[tuple[PositiveFloat, ...], listed, Field(min_length=1, max_length=2)]
    """one or two natural frequencies [Hz]"""

    @property
    def factors(self) -> tuple[float, float]:
        """The factors a of the mass [1/s] and b of the stiffness [s]: with two circular frequencies v and w,
        a = 2 z v w/(v + w) and b = 2 z/(v + w), so that z = (a/w + b w)/2 at both; with one, where z is smallest."""
        first, last = 2.0 * math.pi * self.frequencies[0], 2.0 * math.pi * self.frequencies[-1]
        return 2.0 * self.ratio * first * last / (first + last), 2.0 * self.ratio / (first + last)


class _GroundOrNodes(StrictModel):
    """From each node of a node set to the ground, or between the nodes of two node sets."""

    exactly_one = (("node_set", "between"),)

    node_set: NodeSetName | None = None
    """name of a node set, whose nodes are connected with the ground"""
    between: Annotated[tuple[NodeSetName, NodeSetName], listed] | None = None
    """instead: names of two node sets; each node of the second is connected with the nearest of the first"""


class Spring(_GroundOrNodes):
    """Spring without force at the positions in the mesh."""

    conflicts = (
        (
            lambda own: own.frame is not None and own.between is not None,
            "frame defines the axes of springs to the ground; springs between nodes act along their line",
        ),
        NO_FRAME,
    )

    stiffness: Any
    """stiffness [kx, ky, kz] of each node of the set along the axes, or k along the line between two nodes [N/m]"""
    frame: Annotated[tuple[Direction, Direction], listed] | None = None
    """x axis of the three values, and a vector on the side of their y axis; default: the axes of the model"""

    @field_validator("stiffness")
    @classmethod
    def _as_many_as_directions(cls, value: Any, info: ValidationInfo) -> Any:
        if info.data.get("between") is not None:
            along = "expected one number > 0 [N/m] between nodes, along the line from one to the other"
            if not (is_finite_number(value) and value > 0.0):
                raise ValueError(along)
            return float(value)
        three = isinstance(value, list | tuple) and len(value) == 3 and all(map(is_finite_number, value))
        if not three:
            raise ValueError("expected three numbers [kx, ky, kz] [N/m] to the ground")
        if min(value) < 0.0:
            raise ValueError("expected values >= 0")
        return tuple(map(float, value))


class Dashpot(_GroundOrNodes):
    """Dashpot to the ground, or between nodes."""

    coefficient: NonNegativeFloat
    """force over velocity [N s/m]: of each node of the set, in any direction, or along the line between two nodes"""

    @field_validator("coefficient")
    @classmethod
    def _acts(cls, value: float, info: ValidationInfo) -> float:
        if info.data.get("between") is not None and not value:
            raise ValueError("expected a number > 0 between nodes")
        return value


class _Interpolated(WithFiles):
    """What may vary over time, by rows."""

    conflicts = (
        (
            lambda own: own.interpolation == "smooth" and not own.varies,
            'interpolation = "smooth" requires rows over time',
        ),
    )

    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation between the rows: straight lines, or a cubic spline"""

    @property
    def varies(self) -> bool:
        """Whether there are rows over time."""
        return any(has_rows(value) for value in self.__dict__.values())


class Load(_Interpolated):
    """Force on each node of a node set."""

    node_set: NodeSetName
    """name of a node set"""
    force: Vector3
    """force on each node of the set [N]"""
    table: Table2 | None = None
    """rows [t, factor] [s, -], constant outside; default: factor 1"""
    table_file: FileName | None = None
    """the rows of ``table`` from the columns of a CSV or NPZ file: its name, or a table of :class:`TableFile`"""


class LoadFile(StrictModel):
    """Forces over time on many nodes or node sets, from one file (:mod:`~pfem_petsc.case.files`)."""

    node_set: ClassVar[None] = None

    file: FileName
    """CSV or NPZ file with forces over time of nodes or node sets, relative to the case file"""
    scale: Finite = 1.0
    """factor of the forces"""
    time_scale: PositiveFloat = 1.0
    """factor of the times"""
    interpolation: Literal["linear", "smooth"] = "linear"
    """interpolation between the rows: straight lines, or a cubic spline"""
    digest: Digest | None = None
    """SHA-256 of the content of the file, which results and checkpoints keep; default: that of the file"""

    @model_validator(mode="before")
    @classmethod
    def _alone(cls, data: Any) -> Any:
        taken = [key for key in ("node_set", "force", "table", "table_file") if key in data]
        if taken:
            raise ValueError(f"file gives the forces of nodes or node sets over time, without {', '.join(taken)}")
        return data

    @model_validator(mode="after")
    def _found(self, info: ValidationInfo) -> LoadFile:
        if info.context is not None:
            self._take(**found_file(self.file, self.digest, info.context.folder))
        return self


class _OverTime(_Interpolated):
    """A vector that may vary over time; the rows of its file are added to a constant vector."""

    @model_validator(mode="before")
    @classmethod
    def _added(cls, data: Any, info: ValidationInfo) -> Any:
        key = next(key for key in cls.COLUMNS if key in cls.model_fields)
        given = data.get(key) if isinstance(data, Mapping) else None
        if given is None or has_rows(given) or f"{key}_file" not in data:
            return data
        constant = getattr(cls.model_validate({key: given}), key)
        rest = cls._rows_of_files({name: value for name, value in data.items() if name != key}, info)
        return {**rest, key: [[t, *(a + b for a, b in zip(row, constant, strict=True))] for t, *row in rest[key]]}

    def as_table(self, given: bool = False) -> dict[str, Any]:
        """Return the keys; the interpolation of a constant vector says nothing."""
        table = super().as_table(given)
        interpolation = table.pop("interpolation", None)
        return table | {"interpolation": interpolation} if self.varies and interpolation else table


class Gravity(_OverTime):
    """Uniform acceleration of every mass."""

    acceleration: VectorOrRows
    """acceleration [m/s2]; or rows [t, ax, ay, az] [s, m/s2], constant outside"""
    acceleration_file: FileName | None = None
    """such rows from the columns of a CSV or NPZ file, added to a constant acceleration"""

    @property
    def mean(self) -> tuple[float, ...]:
        """Acceleration, or the mean of its rows (3,) [m/s2]."""
        rows = np.array(self.acceleration, ndmin=2)
        return tuple(np.mean(rows[:, -3:], axis=0).tolist())


class Wind(_OverTime):
    """Wind that drags the bars, the same everywhere."""

    velocity: VectorOrRows
    """velocity [m/s]; or rows [t, vx, vy, vz] [s, m/s], constant outside"""
    velocity_file: FileName | None = None
    """such rows from the columns of a CSV or NPZ file, added to a constant velocity"""
    density: PositiveFloat = 1.225
    """density of the fluid [kg/m3]; default: air at 15 degrees Celsius"""
    drag_coefficient: NonNegativeFloat = 1.2
    """drag coefficient C_d of bars whose section has none"""


class Temperature(_Interpolated):
    """Temperature above reference of bars."""

    alternatives = ("value",)
    exactly_one = (("value", "table", "table_file"),)

    bars: BarGroup | None = None
    """bar group of the mesh, or bars with a value of a field, as in a section; default: all bars"""
    value: Finite | None = None
    """temperature above reference [K]"""
    table: Table2 | None = None
    """rows [t, temperature above reference] [s, K], constant outside"""
    table_file: FileName | None = None
    """the rows of ``table`` from the columns of a CSV or NPZ file: its name, or a table of :class:`TableFile`"""


class ContactPair(SurfaceKeys):
    """Nodes of two bodies that cannot pass each other along a direction, in pairs."""

    name: Name
    """name of the pairs in results and messages; unique"""
    first: NodeSetName
    """name of a node set"""
    second: NodeSetName
    """name of a node set of equal size; each node is paired with the nearest of first, seen along the direction"""
    direction: Direction
    """points from the first nodes to the second"""
    gap: Finite = 0.0
    """smallest distance of second from first along the direction [m]"""


class SelfContact(StrictModel):
    """Bars that cannot pass through each other, as capsules."""

    bars: BarGroup | None = None
    """bar group of the mesh, or bars with a value of a field, as in a section; default: every bar"""
    radius: PositiveFloat | None = None
    """radius of the bars [m]; default: that of the section's shape, else of the circle of its area"""
    friction: NonNegativeFloat = 0.0
    """Coulomb coefficient of friction"""
    restitution: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """ratio of velocities after and before an impact of two bars; 1: no damping"""


class Remove(StrictModel):
    """Bars or supports that are removed, at once or gradually."""

    exactly_one = (("bars", "supports"),)

    bars: BarGroup | None = None
    """bar group of the mesh, or bars with a value of a field, as in a section"""
    supports: Annotated[str, refers("support", "support")] | None = None
    """name of a support"""
    time: NonNegativeFloat
    """time [s], or load factor, at which the removal begins"""
    duration: NonNegativeFloat = 0.0
    """time [s], or change of the load factor, over which the force is reduced to zero linearly; 0: at once"""


class ContactSettings(StrictModel):
    """Treatment of contact."""

    treatment: str = "scheme"
    """treatment of impact: velocity and acceleration of nodes in contact"""


_computable = must(
    lambda seconds: 1e-50 <= seconds <= 1e50,
    "overflows double precision in the formulas of the schemes; give seconds from 1e-50 to 1e50",
)


class TimeKeys(StrictModel):
    """The keys of [time] other than those of an integrator."""

    integrator: str
    """name of a time integration scheme"""
    step: Any
    """time step [s], or "auto" with an explicit scheme"""
    end: Annotated[PositiveFloat, _computable]
    """end time [s]"""
    mass: Literal["lumped", "consistent"] = "lumped"
    """mass matrix"""
    safety: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    """factor on the critical step if step = "auto\""""
    damping_table: (
        Annotated[Table2, must(lambda rows: all(row[1] >= 0.0 for row in rows), "expected factors >= 0")] | None
    ) = None
    """rows [t, factor] [s, -] of the damping of all materials over time, constant outside; default: factor 1"""

    @field_validator("step")
    @classmethod
    def _step(cls, step: Any) -> float | str:
        if step == "auto":
            return "auto"
        number = isinstance(step, int | float) and not isinstance(step, bool)
        text = 'expected a number of seconds in SI units without quotes and unit, or "auto"'
        if not number:
            raise ValueError(text)
        positive = step > 0 and is_finite_number(step)
        if not positive:
            raise ValueError('expected a finite number of seconds > 0, or "auto"')
        return _computable.func(float(step))


class StaticKeys(StrictModel):
    """The keys of [static] that are not a method's own."""

    method: str = "newton"
    """name of a method that finds equilibria"""


class Modes(StrictModel):
    """Modes of the state at the end of the analysis, or of the initial state where the case has none."""

    conflicts = ((lambda own: own.linear and own.kind != "buckling", 'linear = true is of kind = "buckling"'),)

    count: PositiveInt = 10
    """number of modes"""
    kind: Literal["vibration", "buckling"] = "vibration"
    """natural frequencies, or linear buckling factors of the load"""
    mass: Literal["lumped", "consistent"] | None = None
    """mass matrix; default: that of [time], lumped without it"""
    linear: bool = False
    """whether buckling factors are of the axial forces that a linear solve gives for what changes from the start of the
    analysis to its end, or for all loads without one"""
    solver: Literal["auto", "dense", "scipy", "slepc"] = "auto"
    """library that solves the eigenvalue problem"""


class Probe(StrictModel):
    """A node set whose motion and reaction are recorded in the history."""

    name: Name
    """name of the probe in the results"""
    node_set: NodeSetName
    """name of a node set"""


class BarProbe(StrictModel):
    """Bars whose strain, stress and axial force are recorded in the history, selected by exactly one key."""

    exactly_one = (("bars", "indices", "nearest"),)

    name: Name
    """name of the probe in the results"""
    bars: BarGroup | None = None
    """bar group of the mesh, or bars with a value of a field, as in a section"""
    indices: BarNumbers | None = None
    """bar numbers of the mesh, from 0"""
    nearest: Vector3 | None = None
    """a point [m]: selects the bar whose middle is nearest in the mesh"""


class Output(StrictModel):
    """Outputs and their intervals."""

    fields_every: NonNegativeInt = 10
    """steps between field snapshots; 0: only first and last"""
    history_every: PositiveInt = 1
    """steps between rows of the history"""
    checkpoint_every: NonNegativeInt = 0
    """steps between checkpoints; 0: none"""
    checkpoint_minutes: NonNegativeFloat = 0.0
    """wall-clock time between checkpoints [min]; 0: none"""
    fields: Annotated[tuple[str, ...], listed] | None = None
    """names of the fields to write; default: all"""
    precision: Literal["float64", "float32"] = "float64"
    """precision of the fields in the result file"""
    compression: Literal["none", "gzip"] = "none"
    """lossless, of positions and fields in the result file; "gzip" takes ten times as long to write"""
    probe: Annotated[tuple[Probe, ...], listed, distinct("probe")] = ()
    """node sets whose motion and reaction the history has"""
    bar_probe: Annotated[tuple[BarProbe, ...], listed, distinct("bar probe")] = ()
    """bars whose strain, stress and axial force the history has"""


class Solver(StrictModel):
    """Solution of the nonlinear and linear systems."""

    linear: Literal["auto", "cg", "multigrid", "gamg", "mumps"] = "auto"
    """linear solver"""
    operator: Literal["auto", "assembled", "matrix_free"] = "auto"
    """form of the Hessian"""
    rtol: Annotated[float, Field(gt=0.0, lt=1.0)] = 1e-9
    """relative tolerance of the residual"""
    atol: PositiveFloat | None = None
    """absolute tolerance of the residual [N]; default: from the model's force scale"""
    max_newton: PositiveInt = 50
    """maximum number of Newton iterations in a step"""
    guard: bool = True
    """whether converged implicit steps that are unrelated to the previous state are rejected and bisected"""
