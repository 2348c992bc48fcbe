"""A box of unit cells: its keys in case files, and numbers, places, joints and positions of its nodes and bars, each
from its number alone.

An *item* is a point or a strut of the unit cell. It repeats at the places (i, j, k) of a box whose shape depends on the
item: a point on the lower face of its cell occurs once more than there are cells along that axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator, model_validator

from ....case.base import (
    FilePath,
    Name,
    NonNegativeInt,
    PositiveFloat,
    PositiveInts3,
    StrictModel,
    Vector3,
    is_finite_number,
    listed,
)
from ....errors import InputError
from ...slab import check_length, check_size
from ..base import Length
from .cells import ANGLE, KINDS, UnitCell, auxetic, cell_of
from .expressions import COORDINATES, Expression, Fields, MeshField, can_be_variable
from .surface import Surface

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Point = Annotated[tuple[Fraction, Fraction, Fraction], listed]
Strut = Annotated[tuple[int, ...], listed]


class CellKeys(StrictModel):
    """A unit cell, ``[mesh.cell]``."""

    points: Annotated[tuple[Point, ...], listed]
    """coordinates in the cell, in cell edges, from 0 to 1"""
    struts: Annotated[tuple[Strut, ...], listed]
    """points that each strut joins, by numbers from 0: [p, q], or [p, q, i, j, k] if q is i, j, k cells farther on"""
    groups: dict[str, Annotated[tuple[NonNegativeInt, ...], listed]] | None = None
    """bar groups: numbers of struts, from 0, for each name"""

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
            for wrong in [m for m in members if m >= len(self.struts)][:1]:
                raise ValueError(f"groups.{name}: there is no strut {wrong}: they go from 0 to {len(self.struts) - 1}")
        cell = self.made()
        for bare in np.setdiff1d(np.arange(len(cell.points)), cell.ends)[:1]:
            raise ValueError(f"the point at {cell.points[bare].tolist()} belongs to no strut")
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

    conflicts = ((lambda own: own.closed and own.shape != "cylinder", 'closed = true needs shape = "cylinder"'),)

    shape: Literal["cylinder", "sphere"]
    """``cylinder``: x around the y axis; ``sphere``: x and y along great circles; both z outwards"""
    radius: PositiveFloat
    """radius of the inner side, z = 0 [m]"""
    closed: bool = False
    """cylinder: whether the block goes all the way around, and its ends are joined"""


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "lattice"``."""

    conflicts = (
        (
            lambda own: own.curved is not None and own.map is not None,
            "map and the table [mesh.curved] exclude each other: give one of them",
        ),
        (
            lambda own: own.cells is None and (own.surface is None or own.curved is not None or own.map is not None),
            "the key cells is missing: number of cells along x, y and z",
        ),
        (
            lambda own: (own.kind == "cell") != (own.cell is not None),
            'kind = "cell" and the table [mesh.cell] with points and struts need each other',
        ),
        (
            lambda own: own.angle is not None and own.kind != "auxetic",
            f'angle belongs to kind = "auxetic" (default {ANGLE:g}), not to {{0.kind!r}}',
        ),
        (
            lambda own: own.seed is not None and not (own.perturbation or own.missing),
            "seed needs perturbation or missing",
        ),
        (
            lambda own: own.curved is not None and own.curved.closed and own.cells is not None and own.cells[0] < 3,
            "curved.closed = true needs 3 cells or more along x",
        ),
    )

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
    pitch: Length
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


FACES = {
    name: (axis, upper)
    for axis, names in ((2, ("bottom", "top")), (0, ("left", "right")), (1, ("front", "back")))
    for upper, name in enumerate(names)
}
"""Axis to which each face is normal, and whether it is the upper one, by name."""

PIECE = 1 << 17
"""Number of nodes or bars generated at a time, to keep temporary arrays small."""

_STEPS = 16
"""Runge-Kutta steps within a cell of graded pitch."""


class Places(NamedTuple):
    """Items and their places: one item for all places, or arrays of one length."""

    item: int | np.ndarray
    i: np.ndarray
    j: np.ndarray
    k: np.ndarray


class Numbering:
    """Numbers of items in a block, each with a number of places along x, y and z: ``shapes`` (items, 3) int64."""

    def __init__(self, shapes: np.ndarray) -> None:
        self.shapes = shapes
        self.total = int(shapes.astype(object).prod(axis=1).sum())

    def pieces(self, first: int, last: int) -> Iterator[tuple[np.ndarray, Places]]:
        """Divide the range [first, last) into numbers and what they are."""
        for start in range(first, last, PIECE):
            numbers = np.arange(start, min(start + PIECE, last))
            yield numbers, self.decode(numbers)

    def arrays(self, span: tuple[int, int], make: Callable[..., list[np.ndarray]]) -> list[np.ndarray]:
        """Return what ``make(numbers, places)`` returns for a range of numbers, made piece by piece."""
        first, last = span
        empty = np.empty(0, np.int64)
        whole = [np.empty((last - first, *part.shape[1:]), part.dtype) for part in make(empty, self.decode(empty))]
        for numbers, places in self.pieces(first, last):
            for array, part in zip(whole, make(numbers, places), strict=True):
                array[numbers[0] - first : numbers[-1] + 1 - first] = part
        return whole


class ItemByItem(Numbering):
    """All places of the first item, z fastest, then all of the next."""

    def __init__(self, shapes: np.ndarray) -> None:
        super().__init__(shapes)
        self._starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])

    def encode(self, item: int | np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the numbers of items at places."""
        return (i * self.shapes[item, 1] + j) * self.shapes[item, 2] + (k + self._starts[item])

    def decode(self, numbers: np.ndarray) -> Places:
        """Return the items of numbers (int64), with their places."""
        item = np.searchsorted(self._starts, numbers, side="right") - 1
        row, k = np.divmod(numbers - self._starts[item], self.shapes[item, 2])
        return Places(item, *np.divmod(row, self.shapes[item, 1]), k)


class CellByCell(Numbering):
    """All items of the first cell, then those of the next, z fastest.

    Far from the faces of the block, bars that are copies of one strut join nodes whose numbers differ by the same.
    """

    def __init__(self, shapes: np.ndarray) -> None:
        super().__init__(shapes)
        # Cells along an axis are of one class if they have the same items: those whose shape reaches that far.
        self._class = [
            np.searchsorted(np.unique(lengths), np.arange(lengths.max(initial=0)), side="right") for lengths in shapes.T
        ]
        present = [
            np.stack([lengths > np.argmax(classes == c) for c in range(classes.max(initial=0) + 1)])
            for lengths, classes in zip(shapes.T, self._class)
        ]
        # (classes of x, of y, of z, items): which items a cell has, and their order within it
        has = present[0][:, None, None] & present[1][None, :, None] & present[2][None, None, :]
        self._order = np.cumsum(has, axis=3) - 1
        self._items = np.argsort(~has, axis=3, kind="stable")
        self._along_z = _starts(has.sum(axis=3)[:, :, self._class[2]])
        self._along_y = _starts(self._along_z[:, self._class[1], -1])
        self._along_x = _starts(self._along_y[self._class[0], -1])

    def encode(self, item: int | np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return the numbers of items at places."""
        cx, cy, cz = self._class[0][i], self._class[1][j], self._class[2][k]
        numbers = self._along_x[i] + self._along_y[cx, j]
        numbers += self._along_z[cx, cy, k]
        numbers += self._order[cx, cy, cz, item]
        return numbers

    def decode(self, numbers: np.ndarray) -> Places:
        """Return the items of numbers (int64), with their places."""
        i = np.searchsorted(self._along_x, numbers, side="right") - 1
        cx, rest = self._class[0][i], numbers - self._along_x[i]
        j = _found(self._along_y, cx, rest)
        rest = rest - self._along_y[cx, j]
        cy = self._class[1][j]
        k = _found(self._along_z.reshape(-1, self._along_z.shape[2]), cx * self._along_z.shape[1] + cy, rest)
        rest = rest - self._along_z[cx, cy, k]
        return Places(self._items[cx, cy, self._class[2][k], rest], i, j, k)


def _starts(counts: np.ndarray) -> np.ndarray:
    """Return sums of what comes before along the last axis, and of all."""
    return np.concatenate([np.zeros((*counts.shape[:-1], 1), np.int64), np.cumsum(counts, axis=-1)], axis=-1)


def _found(starts: np.ndarray, row: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the last column of each row of ``starts`` (rows, n) that is not above the value."""
    beyond = int(starts[:, -1].max(initial=0)) + 1
    length = starts.shape[1]
    flat = (starts + beyond * np.arange(len(starts))[:, None]).ravel()
    return np.searchsorted(flat, value + beyond * row, side="right") - 1 - length * row


class Joints:
    """Nodes and bars of cells in a box, without positions.

    Parameters
    ----------
    cell : UnitCell
    cells : (3,) int64
        Number of cells along each axis, or of layers where a cell has several.
    closed : bool
        Whether the last cell along x is joined to the first.
    plain : bool
        Whether the numbering of the cell may be item by item.
    """

    def __init__(self, cell: UnitCell, cells: np.ndarray, closed: bool, plain: bool = True) -> None:
        self.cell, self.cells, self.closed = cell, cells, closed
        size = cells / np.array(cell.layers)
        nodes = np.floor(size - cell.points + 1e-9).astype(np.int64).clip(min=-1) + 1
        bars = (nodes[cell.ends] - cell.offsets).min(axis=1).clip(min=0)
        if closed:
            nodes[:, 0] = bars[:, 0] = cells[0]
        n_nodes, n_bars = (int(counts.astype(object).prod(axis=1).sum()) for counts in (nodes, bars))
        check_size(n_nodes, "mesh.cells", n_bars)
        number = ItemByItem if plain and cell.item_by_item else CellByCell
        self.nodes, self.bars = number(nodes), number(bars)
        there = (nodes > 0).all(axis=1)
        low = cell.points[there].min(axis=0, initial=np.inf)
        self._limits = low, (cell.points + nodes - 1)[there].max(axis=0, initial=-np.inf)
        self.faces = [name for name, (axis, _) in FACES.items() if axis or not closed]

    def end(self, places: Places, which: int) -> tuple[np.ndarray, Places]:
        """Return numbers and places of the first or second (``which`` = 0, 1) ends of bars.

        Where the block is closed, a place may be one cell beyond the last.
        """
        item, offset = places.item, self.cell.offsets[places.item, which]
        at = Places(self.cell.ends[item, which], *(index + offset[..., axis] for axis, index in enumerate(places[1:])))
        return self.nodes.encode(at.item, at.i % self.cells[0] if self.closed else at.i, at.j, at.k), at

    def on_face(self, places: Places, name: str) -> np.ndarray:
        """Return which nodes (n,) are on an outer face: those farthest along its axis."""
        axis, upper = FACES[name]
        return places[1 + axis] + self.cell.points[places.item, axis] == self._limits[upper][axis]

    def groups_of(self, bars: Places) -> dict[str, np.ndarray]:
        """Return which bars (n,) are in each bar group."""
        skin = np.zeros(len(bars.i), bool)
        ends = [self.end(bars, which)[1] for which in (0, 1)] if self.cell.skin else []
        for name, (axis, _) in FACES.items():
            if COORDINATES[axis] in self.cell.skin:
                skin |= self.on_face(ends[0], name) & self.on_face(ends[1], name)
        struts = np.arange(len(self.cell.ends))
        found = {name: np.isin(struts, some)[bars.item] & ~skin for name, some in self.cell.groups.items()}
        return found | ({"skin": skin} if self.cell.skin else {})

    def has_bare_nodes(self) -> bool:
        """Whether a node at a corner, an edge or a face of the block has no bar."""
        counts = np.array(self.cell.layers) * 3
        small = np.where(self.cells > counts, counts + self.cells % self.cell.layers, self.cells)
        block = Joints(self.cell, small, self.closed)
        used = np.zeros(block.nodes.total, bool)
        for _, bars in block.bars.pieces(0, block.bars.total):
            used[block.end(bars, 0)[0]] = used[block.end(bars, 1)[0]] = True
        return not used.all()


class Block(Joints):
    """The block that the keys of a lattice describe, of which no rank has more than what it asks for.

    Parameters
    ----------
    keys : Parameters
        With ``cells``.
    plain : bool
        Whether nothing is left out, so that nodes and bars keep the numbering of their kind.

    Attributes
    ----------
    volume : of what the block fills [m3]

    Raises
    ------
    InputError
        For lengths, gradings, perturbations or maps that do not fit the block.
    """

    def __init__(self, keys: Parameters, plain: bool) -> None:
        self.keys, self.expressions = keys, keys.expressions()
        closed = keys.curved is not None and keys.curved.closed
        cell, cells = keys.unit_cell(), np.array(keys.cells, np.int64)
        super().__init__(cell, cells, closed, plain)
        # the coordinates of the borders of cells along each axis, and of one more
        self._levels: list[np.ndarray] = []
        for axis, factor in enumerate(keys.grading or (1.0, 1.0, 1.0)):
            edge, count = keys.pitch * cell.aspect[axis], -(-int(cells[axis]) // cell.layers[axis])
            if isinstance(factor, str):
                levels = [*islice(_borders(edge, factor, axis), count + 1)]
                # no expression has to hold beyond the last cell: what lies there only completes the arithmetic
                self._levels.append(np.array([*levels, 2.0 * levels[-1] - levels[-2]]))
            else:
                check_length(edge * factor, f"mesh.pitch times mesh.grading[{axis}]")
                self._levels.append(edge * factor * np.arange(count + 2))
        self._amplitude = (keys.perturbation or 0.0) * keys.pitch
        self.disturbed = self._amplitude > 0.0
        edges = [np.diff(level[:-1]).min() for level in self._levels]
        shortest = float(np.linalg.norm(cell.spans * np.array(edges), axis=1).min())
        if self._amplitude and 2.0 * math.sqrt(3.0) * self._amplitude >= shortest:
            raise InputError(
                f"mesh.perturbation = {keys.perturbation!r}: ends of a strut of {shortest:.4g} m could meet; choose "
                f"less than {shortest / (2.0 * math.sqrt(3.0) * keys.pitch):.4g}"
            )
        sizes = zip(self.cells / np.array(cell.layers), self._levels)
        self._extents = np.array([np.interp(size, np.arange(len(level)), level) for size, level in sizes])
        farthest = float(np.abs(keys.origin or 0.0).max()) + float(self._extents.max())
        check_length(farthest, "mesh.origin and the extent of the block")
        self.volume = self._shell() if keys.curved is not None else float(np.prod(self._extents))

    def cell_volumes(self, places: Places) -> np.ndarray:
        """Return the volumes (n,) [m3] of the cells at places of bars, before they are curved or mapped."""
        edges = [level[index + 1] - level[index] for level, index in zip(self._levels, places[1:])]
        return np.prod(edges, axis=0)

    def _shell(self) -> float:
        """Return the volume of the shell [m3] to which the block is mapped."""
        curved, extents = self.keys.curved, self._extents
        inner, outer = curved.radius, curved.radius + float(extents[2])
        if curved.shape == "cylinder":
            if not self.closed and extents[0] > 2.0 * np.pi * inner * (1.0 + 1e-9):
                raise InputError(
                    f"mesh.curved.radius = {inner!r}: the block is {extents[0]:.6g} m long, more than the "
                    f"circumference of {2.0 * np.pi * inner:.6g} m; use fewer cells, or closed = true"
                )
            angle = 2.0 * np.pi if self.closed else extents[0] / inner
            return float(0.5 * angle * (outer**2 - inner**2) * extents[1])
        half = 0.5 * extents[:2] / inner
        if half.max() >= 0.45 * np.pi:
            raise InputError(
                f"mesh.curved.radius = {inner!r}: the block spans {np.degrees(2.0 * half.max()):.0f} degrees of the "
                "sphere; at most 160 are mapped: use fewer cells or a larger radius"
            )
        solid_angle = 4.0 * np.arcsin(np.sin(half[0]) * np.sin(half[1]))
        return float(solid_angle * (outer**3 - inner**3) / 3.0)

    def positions(self, numbers: np.ndarray, places: Places, disturbed: bool = True) -> np.ndarray:
        """Return the positions (n, 3) [m] of nodes with given numbers and places, with the perturbation or without."""
        keys, points = self.keys, np.empty((len(numbers), 3))
        for axis, (level, index) in enumerate(zip(self._levels, places[1:])):
            points[:, axis] = level[index] + self.cell.points[places.item, axis] * (level[index + 1] - level[index])
        if self.disturbed and disturbed:
            for axis in range(3):  # nodes of outer faces remain in them
                held = [self.on_face(places, name) for name in self.faces if FACES[name][0] == axis]
                drawn = random_numbers(keys.seed or 0, axis, numbers)
                points[:, axis] += ~np.any(held, axis=0) * (self._amplitude * (2.0 * drawn - 1.0))
        points = (points if keys.curved is None else self._curved(points)) + np.array(keys.origin or 0.0)
        if keys.map is not None:
            points = np.stack([self.expressions.at(points, f"map[{axis}]") for axis in range(3)], axis=1)
        return points

    def _curved(self, points: np.ndarray) -> np.ndarray:
        """Return where points (n, 3) [m] of the block are on its shell, with z outwards from the radius.

        On a cylinder about the y axis, x = 0 goes to the positive z axis. On a sphere about the origin, lines of x and
        y become great circles at angles x/radius and y/radius from the middle of the block, which goes to the positive
        z axis (the equiangular projection of a face of a cube).
        """
        x, y, z = points.T
        radius = self.keys.curved.radius
        if self.keys.curved.shape == "cylinder":
            angle = x * (2.0 * np.pi / float(self._extents[0]) if self.closed else 1.0 / radius)
            return np.stack([(radius + z) * np.sin(angle), y, (radius + z) * np.cos(angle)], axis=1)
        middle = 0.5 * self._extents
        a, b = np.tan((x - middle[0]) / radius), np.tan((y - middle[1]) / radius)
        factor = (radius + z) / np.sqrt(1.0 + a * a + b * b)
        return np.stack([a * factor, b * factor, factor], axis=1)


def random_numbers(seed: int, stream: int, numbers: np.ndarray) -> np.ndarray:
    """Return a uniform random number in [0, 1) for each number (n,) int64, of one of several streams.

    Each depends on seed, stream and number alone, and not on which others are asked for or in what order.

    Notes
    -----
    The finaliser of SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators",
    OOPSLA 2014), applied to the seed with the stream and then to a counter.
    """
    start = _mixed(np.array([seed % (1 << 63)], np.uint64) ^ (np.uint64(stream) << np.uint64(56)))
    counter = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return (_mixed(counter + start) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _mixed(z: np.ndarray) -> np.ndarray:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def graded_count(length: float, edge: float, factor: str, axis: int, most: int = 20_000) -> int:
    """Return the least number of graded cells that cover a length [m] from x = 0 on.

    Raises
    ------
    InputError
        If the factor is not positive somewhere, or more than ``most`` cells are needed.
    """
    start = 0.0
    for count, end in enumerate(islice(_borders(edge, factor, axis), 1, most + 1), 1):
        if end >= length - 1e-9 * (end - start):
            return count
        start = end
    raise InputError(
        f"mesh.grading[{axis}]: {factor!r} takes more than {most:,} cells over {length:g} m, and reaches {start:g} m"
    )


def _borders(edge: float, factor: str, axis: int) -> Iterator[float]:
    """Yield the coordinates [m] of the borders of graded cells, from 0 on.

    Cell numbers s are mapped to coordinates x by dx/ds = edge factor(x), x(0) = 0 (Runge-Kutta of order 4).

    Raises
    ------
    InputError
        If the factor is not positive somewhere.
    """
    name = COORDINATES[axis]
    expression = Expression(factor, (name,))

    def slope(x: float) -> float:
        value = float(expression({name: np.array([x])})[0])
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(
                f"mesh.grading[{axis}]: {factor!r} is {value:g} at {name} = {x:g} m; expected a factor > 0 in the block"
            )
        return edge * value

    x, h = 0.0, 1.0 / _STEPS
    yield x
    while True:
        for _ in range(_STEPS):
            k1 = slope(x)
            k2 = slope(x + 0.5 * h * k1)
            k3 = slope(x + 0.5 * h * k2)
            x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(x + h * k3))
        yield x


def fitted(keys: Parameters, surface: Surface) -> Parameters:
    """Return the keys with cells that cover the surface, if they give none: from a corner of cells at ``origin``.

    Along an axis whose grading is an expression the block begins at ``origin``, which must not be above the lower side
    of the surface. All ranks compute the same.

    Raises
    ------
    InputError
        For a pitch that takes too many cells, and an origin or an expression that does not fit the surface.
    """
    if keys.cells is not None:
        return keys
    cell, (low, high) = keys.unit_cell(), surface.bounds
    origin = np.array(keys.origin if keys.origin is not None else low)
    start, count = origin.copy(), np.ones(3)
    for axis, factor in enumerate(keys.grading or (1.0, 1.0, 1.0)):
        edge = keys.pitch * cell.aspect[axis]
        if isinstance(factor, str):
            if origin[axis] > low[axis] + 1e-9 * edge:
                raise InputError(
                    f"mesh.grading[{axis}] = {factor!r}: an expression begins at mesh.origin, and the surface below it "
                    f"would stay empty: use {COORDINATES[axis]} = {low[axis]:.9g} or less there, or leave the key out"
                )
            count[axis] = graded_count(float(high[axis] - origin[axis]), edge, factor, axis)
            continue
        first = np.floor((low[axis] - origin[axis]) / (edge * factor) + 1e-9)
        count[axis] = max(np.ceil((high[axis] - origin[axis]) / (edge * factor) - 1e-9) - first, 1.0)
        start[axis] += first * edge * factor
    size = f"a surface of {' x '.join(f'{length:.4g}' for length in high - low)} m"
    if keys.surface.scale == 1.0:
        size += " (if its file is in millimetres, set mesh.surface.scale = 0.001)"
    if not (count < float(np.iinfo(np.int64).max) / 16.0).all():
        raise InputError(f"mesh.pitch = {keys.pitch!r}: too small for {size}")
    check_size(
        math.prod(int(number) for number in count.tolist()),
        f"mesh.pitch = {keys.pitch!r}, with cells that cover {size}",
    )
    cells = tuple((count.astype(np.int64) * np.array(cell.layers)).tolist())
    return keys.model_copy(update={"cells": cells, "origin": tuple(start.tolist())})
