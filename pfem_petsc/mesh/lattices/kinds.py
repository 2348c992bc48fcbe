"""The built-in unit cells."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np

from .cell import UnitCell, cell_of, neighbours

__all__ = ["ANGLE", "KINDS", "auxetic"]

ANGLE = 20.0
"""Default of the angle [degrees] of ``auxetic``."""

_FACE_CENTRES = [(0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0)]


def _unit(*axes: int) -> np.ndarray:
    return np.array([int(axis in axes) for axis in range(3)])


def _edges() -> list[list[int]]:
    return [[0, 0, *_unit(axis)] for axis in range(3)]


def _cubic() -> UnitCell:
    """Edges along x, y, z, then the two diagonals of the faces normal to z, to y and to x."""
    struts = _edges()
    for first, second in ((0, 1), (0, 2), (1, 2)):
        struts += [[0, 0, *_unit(first, second)], [0, 0, *(_unit(second) - _unit(first))]]
    return cell_of([(0, 0, 0)], struts, {"edges": range(3), "diagonals": range(3, 9)}, item_by_item=True)


def _corners_to_faces() -> list[list[int]]:
    struts = []
    for axis in range(3):
        first, second = (a for a in range(3) if a != axis)
        for corner in (_unit(), _unit(first), _unit(second), _unit(first, second)):
            struts.append([0, 1 + axis, *(-corner)])
    return struts


def _octet() -> UnitCell:
    """Struts from corners to face centres, then those of the octahedron of face centres."""
    struts = _corners_to_faces()
    for one, two in ((0, 1), (0, 2), (1, 2)):
        for a in (_unit(), _unit(one)):
            for b in (_unit(), _unit(two)):
                struts.append([1 + one, 1 + two, *(b - a)])
    groups = {"face_struts": range(12), "octahedra": range(12, 24)}
    return cell_of([(0, 0, 0), *_FACE_CENTRES], struts, groups, item_by_item=True)


def _fcc() -> UnitCell:
    """Both diagonals of every face, which cross in a node."""
    return cell_of([(0, 0, 0), *_FACE_CENTRES], _corners_to_faces(), {"diagonals": range(12)})


def _half_diagonals() -> list[list[int]]:
    return [[0, 1, *(-np.array(corner))] for corner in np.ndindex(2, 2, 2)]


def _bcc() -> UnitCell:
    """Cube edges along x, y, z, then the eight half diagonals."""
    points, struts = [(0, 0, 0), (0.5, 0.5, 0.5)], _edges() + _half_diagonals()
    return cell_of(points, struts, {"edges": range(3), "diagonals": range(3, 11)}, item_by_item=True)


def _bcc_diagonals() -> UnitCell:
    """The eight half diagonals."""
    return cell_of([(0, 0, 0), (0.5, 0.5, 0.5)], _half_diagonals(), {"diagonals": range(8)})


def _kelvin() -> UnitCell:
    """Truncated octahedra about the corners and the centre of the cube (tetrakaidecahedra)."""
    points = sorted(set(permutations((0.0, 0.25, 0.5))) | set(permutations((0.0, 0.75, 0.5))))
    struts = neighbours(points, np.sqrt(2.0) / 4.0)
    return cell_of(points, struts, {"struts": range(len(struts))})


def _diamond() -> UnitCell:
    """Every node joined to four others at the corners of a tetrahedron."""
    corners = np.array([(0.0, 0.0, 0.0), *_FACE_CENTRES])
    points = np.concatenate([corners, corners + 0.25])
    struts = neighbours(points.tolist(), np.sqrt(3.0) / 4.0)
    return cell_of(points, struts, {"struts": range(len(struts))})


def _gyroid() -> UnitCell:
    """The net srs, (10,3)-a: nodes on one labyrinth of the gyroid, each joined to three others in a plane."""
    # Wyckoff position 8a of the space group I4(1)32
    first = np.array([(1, 1, 1), (3, 7, 5), (7, 5, 3), (5, 3, 7)]) / 8.0
    points = np.concatenate([first, (first + 0.5) % 1.0])
    struts = neighbours(points.tolist(), np.sqrt(2.0) / 4.0)
    return cell_of(points, struts, {"struts": range(len(struts))})


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
    struts = neighbours(points.tolist(), 1.0, aspect)
    level = [abs(points[q][2] + row[2] - points[p][2]) < 0.1 for p, q, *row in struts]
    groups = {name: [m for m, flat in enumerate(level) if flat == is_flat] for name, is_flat in _LAYERED.items()}
    return cell_of(points, struts, groups, aspect=aspect, layers=(1, 1, 3), skin=("z",))


_LAYERED = {"layers": True, "diagonals": False}

KINDS: dict[str, Callable[[], UnitCell]] = {
    "cubic": _cubic,
    "octet": _octet,
    "bcc": _bcc,
    "bcc_diagonals": _bcc_diagonals,
    "fcc": _fcc,
    "kelvin": _kelvin,
    "diamond": _diamond,
    "gyroid": _gyroid,
    "auxetic": auxetic,
    "tetrahedral_octahedral": _tetrahedral_octahedral,
}
