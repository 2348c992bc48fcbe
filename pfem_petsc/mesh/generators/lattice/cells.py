"""Unit cells of lattices, whose points and struts repeat in three directions: built-in kinds, own cells, mechanisms."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

_SAME = 1e-9
"""Points of a cell closer than this, in cell edges, are one; coordinates this close to a face are on it."""

ANGLE = 20.0
"""Default of the angle [degrees] of ``auxetic``."""

_LARGEST = 100
"""Points of a cell up to which the matrices of mechanisms are so small that every run can afford them."""


@dataclass(frozen=True)
class UnitCell:
    """Points and struts of one cell; those on a face belong to the neighbours too and occur once."""

    points: np.ndarray
    """(points, 3) float64: coordinates in [0, 1), in cell edges."""
    ends: np.ndarray
    """(struts, 2) int64: the points that each strut joins."""
    offsets: np.ndarray
    """(struts, 2, 3) int64: cells, relative to that of the strut, in which the ends are; the smaller one is 0."""
    groups: dict[str, np.ndarray]
    """(members,) int64: struts of each kind, by name."""
    aspect: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Cell edges over the pitch."""
    layers: tuple[int, int, int] = (1, 1, 1)
    """Parts of a cell along each axis that ``cells`` counts."""
    item_by_item: bool = False
    """Whether nodes and bars are numbered point by point and strut by strut, else cell by cell."""
    skin: tuple[str, ...] = ()
    """Names of axes: struts within the outer faces normal to these are of the group ``skin`` alone."""

    @property
    def spans(self) -> np.ndarray:
        """(struts, 3) From the first to the second end of each strut, in cell edges."""
        places = self.points[self.ends] + self.offsets
        return places[:, 1] - places[:, 0]

    @property
    def vectors(self) -> np.ndarray:
        """(struts, 3) The same over the pitch."""
        return self.spans * np.array(self.aspect)


def cell_of(
    points: Sequence[Sequence[float]] | np.ndarray,
    struts: Sequence[Sequence[int]] | np.ndarray,
    groups: Mapping[str, Sequence[int]] | None = None,
    **other: object,
) -> UnitCell:
    """Return a unit cell; points and struts that are given on both sides of it are merged by their integer offsets.

    Parameters
    ----------
    points : (points, 3)
        Coordinates in the cell, in cell edges; 0 and 1 are the same place of two neighbouring cells.
    struts : (struts, 2) or (struts, 5)
        The two points that each strut joins, and the cell in which the second one is, relative to that of the first.
    groups : struts of each name; default: all are ``struts``
    **other
        ``aspect``, ``layers``, ``item_by_item``, ``skin`` of :class:`UnitCell`.

    Raises
    ------
    ValueError
        For a strut without length, or a group member that does not exist.
    """
    places = np.asarray(points, dtype=float)
    whole = np.floor(places + _SAME).astype(np.int64)
    inside = np.where(places - whole < _SAME, 0.0, places - whole)
    first = np.array([np.argmax(np.abs(inside - place).max(axis=1) < _SAME) for place in inside], dtype=np.int64)
    kept = np.unique(first)
    number = np.searchsorted(kept, first)

    found: dict[tuple[int, ...], int] = {}
    strut_of = []
    for row in struts:
        p, q = int(row[0]), int(row[1])
        at = np.array([whole[p], whole[q] + np.array(row[2:5] if len(row) > 2 else (0, 0, 0), dtype=np.int64)])
        at -= at.min(axis=0)
        one, two = (int(number[p]), *at[0].tolist()), (int(number[q]), *at[1].tolist())
        if one == two:
            raise ValueError(f"strut {len(strut_of)} ({list(row)}) has no length: its ends coincide")
        key = next((k for k in ((*one, *two), (*two, *one)) if k in found), (*one, *two))
        strut_of.append(found.setdefault(key, len(found)))
    rows = np.array(list(found), dtype=np.int64).reshape(-1, 2, 4)
    groups = groups if groups is not None else {"struts": range(len(struts))}
    named = {name: np.unique([strut_of[m] for m in members]) for name, members in groups.items()}
    return UnitCell(inside[kept], rows[:, :, 0], rows[:, :, 1:], named, **other)  # type: ignore[arg-type]


def neighbours(points: Sequence[Sequence[float]], length: float, aspect: Sequence[float] = (1.0, 1.0, 1.0)) -> list:
    """Return struts [p, q, i, j, k] between all points of a periodic cell at a distance, in pitches."""
    places, shifts = np.asarray(points, dtype=float), np.array(list(np.ndindex(3, 3, 3))) - 1
    apart = np.linalg.norm((places + shifts[:, None, None] - places[:, None]) * np.asarray(aspect), axis=-1)
    return [[p, q, *shifts[s].tolist()] for s, p, q in np.argwhere(np.abs(apart - length) < _SAME).tolist()]


_CORNER = (0.0, 0.0, 0.0)
_FACE_CENTRES = [(0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0)]
_EDGES = [[0, 0, *axis] for axis in np.eye(3, dtype=int).tolist()]
_HALF_DIAGONALS = [[0, 1, *(-np.array(corner))] for corner in np.ndindex(2, 2, 2)]


def _unit(*axes: int) -> np.ndarray:
    return np.array([int(axis in axes) for axis in range(3)])


_CORNERS_TO_FACES = [
    [0, 1 + axis, *(-corner)]
    for axis, (first, second) in enumerate(((1, 2), (0, 2), (0, 1)))
    for corner in (_unit(), _unit(first), _unit(second), _unit(first, second))
]
_BETWEEN_FACES = [
    [1 + one, 1 + two, *(b - a)]
    for one, two in ((0, 1), (0, 2), (1, 2))
    for a in (_unit(), _unit(one))
    for b in (_unit(), _unit(two))
]
_FACE_DIAGONALS = [[0, 0, *way] for a, b in ((0, 1), (0, 2), (1, 2)) for way in (_unit(a, b), _unit(b) - _unit(a))]
_OCTAHEDRON = sorted({point for z in (0.25, 0.75) for point in itertools.permutations((0.0, z, 0.5))})
"""Corners of truncated octahedra about the corners and the centre of the cube (tetrakaidecahedra)."""
_DIAMOND = [tuple(np.add(point, shift)) for shift in (0.0, 0.25) for point in (_CORNER, *_FACE_CENTRES)]
_SRS = [
    tuple((np.array(point) / 8.0 + shift) % 1.0)
    for shift in (0.0, 0.5)
    for point in ((1, 1, 1), (3, 7, 5), (7, 5, 3), (5, 3, 7))
]
"""Wyckoff position 8a of the space group I4(1)32."""


def auxetic(angle: float = ANGLE) -> UnitCell:
    """Re-entrant honeycombs in the planes x-z and y-z, with common struts along z.

    Parameters
    ----------
    angle : of the inclined struts against the x-y plane [degrees], between 0 and 45
    """
    height = 0.5 + 0.5 * np.tan(np.radians(angle))  # of the struts along z
    low, high = 0.5 - 0.5 * height, 0.5 + 0.5 * height
    # columns of one kind have their strut in the middle of the cell, those of the other across its border in z
    points = [(x, x, z) for x in (0.0, 0.5) for z in (low, high)]
    points += [(x, 0.5 - x, z) for x in (0.5, 0.0) for z in (0.5 * height, 1.0 - 0.5 * height)]
    struts = [[0, 1], [2, 3], [5, 4, 0, 0, 1], [7, 6, 0, 0, 1]]
    for level in range(2):
        struts += [[level, 4 + level, i, 0, 0] for i in (0, -1)] + [[level, 6 + level, 0, j, 0] for j in (0, -1)]
        struts += [[2 + level, 4 + level, 0, j, 0] for j in (0, 1)] + [[2 + level, 6 + level, i, 0, 0] for i in (0, 1)]
    return cell_of(points, struts, {"vertical": range(4), "inclined": range(4, len(struts))})


def _tetrahedral_octahedral() -> UnitCell:
    """Triangular layers normal to z, each over the hollows of the one below (ABC): the octet lattice on (111)."""
    aspect = (1.0, np.sqrt(3.0), np.sqrt(6.0))
    layer = np.array([(0.0, 0.0, 0.0), (0.5, 0.5, 0.0)])
    points = np.concatenate([(layer + m * np.array([1 / 2, 1 / 6, 1 / 3])) % 1.0 for m in range(3)])
    struts = neighbours(points, 1.0, aspect)
    groups: dict[str, list[int]] = {"layers": [], "diagonals": []}
    for m, (p, q, *row) in enumerate(struts):
        groups["layers" if abs(points[q][2] + row[2] - points[p][2]) < 0.1 else "diagonals"].append(m)
    return cell_of(points, struts, groups, aspect=aspect, layers=(1, 1, 3), skin=("z",))


_TWO = [_CORNER, (0.5, 0.5, 0.5)]
_FOUR = [_CORNER, *_FACE_CENTRES]

KINDS: dict[str, Callable[[], UnitCell]] = {
    # edges along x, y, z, then the two diagonals of the faces normal to z, to y and to x
    "cubic": lambda: cell_of(
        [_CORNER], _EDGES + _FACE_DIAGONALS, {"edges": range(3), "diagonals": range(3, 9)}, item_by_item=True
    ),
    # struts from corners to face centres, then those of the octahedron of face centres
    "octet": lambda: cell_of(
        _FOUR,
        _CORNERS_TO_FACES + _BETWEEN_FACES,
        {"face_struts": range(12), "octahedra": range(12, 24)},
        item_by_item=True,
    ),
    # cube edges along x, y, z, then the eight half diagonals
    "bcc": lambda: cell_of(
        _TWO, _EDGES + _HALF_DIAGONALS, {"edges": range(3), "diagonals": range(3, 11)}, item_by_item=True
    ),
    # the eight half diagonals
    "bcc_diagonals": lambda: cell_of(_TWO, _HALF_DIAGONALS, {"diagonals": range(8)}),
    # both diagonals of every face, which cross in a node
    "fcc": lambda: cell_of(_FOUR, _CORNERS_TO_FACES, {"diagonals": range(12)}),
    "kelvin": lambda: cell_of(_OCTAHEDRON, neighbours(_OCTAHEDRON, np.sqrt(2.0) / 4.0)),
    # every node joined to four others at the corners of a tetrahedron
    "diamond": lambda: cell_of(_DIAMOND, neighbours(_DIAMOND, np.sqrt(3.0) / 4.0)),
    # the net srs, (10,3)-a: nodes on one labyrinth of the gyroid, each joined to three others in a plane
    "gyroid": lambda: cell_of(_SRS, neighbours(_SRS, np.sqrt(2.0) / 4.0)),
    "auxetic": auxetic,
    "tetrahedral_octahedral": _tetrahedral_octahedral,
}


def periodic_mechanisms(cell: UnitCell) -> tuple[int, int]:
    """Count motions of the infinite lattice that stretch no bar.

    Returns
    -------
    uniform : those that strain the lattice as a whole, or repeat in every cell, besides translations
    waves : those that alternate from cell to cell along one, two or three axes

    Notes
    -----
    Displacements u exp(i k . R) + E R of the points of cell R, with a symmetric strain E for k = 0 alone (R. G.
    Hutchinson and N. A. Fleck, "The structural performance of the periodic truss", J. Mech. Phys. Solids 54, 2006): the
    null space of the elongations of the struts of one cell.
    """
    vectors = cell.vectors
    directions = vectors / np.linalg.norm(vectors, axis=1)[:, None]
    struts, strains = np.arange(len(vectors)), np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
    free: dict[tuple[int, ...], int] = {}
    for wave in itertools.product((0, 1), repeat=3):
        rows = np.zeros((len(struts), *cell.points.shape))
        for which, sign in ((0, -1.0), (1, 1.0)):
            phase = sign * (-1.0) ** (cell.offsets[:, which] @ np.array(wave))
            np.add.at(rows, (struts, cell.ends[:, which]), phase[:, None] * directions)
        strained = [] if any(wave) else [vectors[:, strains[:, 0]] * directions[:, strains[:, 1]]]
        rows = np.hstack([rows.reshape(len(struts), -1), *strained])
        free[wave] = rows.shape[1] - int(np.linalg.matrix_rank(rows, tol=1e-8))
    return free.pop((0, 0, 0)) - 3, sum(free.values())


def mechanism_warning(kind: str, cell: UnitCell) -> list[str]:
    """Return a warning if the lattice is a mechanism as a pin-jointed truss."""
    uniform, waves = periodic_mechanisms(cell) if len(cell.points) <= _LARGEST else (0, 0)
    what = [f"{uniform} that repeat{'s' * (uniform == 1)} in every cell"] if uniform else []
    what += [f"{waves} that alternate{'s' * (waves == 1)} from cell to cell"] if waves else []
    return [
        f"mesh.kind = {kind!r} is a mechanism: motions of the infinite lattice stretch no bar ({' and '.join(what)}); "
        "bars are pin-jointed here, and nothing resists these motions to first order: add struts, or supports"
        for _ in what[:1]
    ]
