"""Geometric tolerances, in one module with their rationale.

Tolerances of length are relative to a length L (``model.size``, ``contact.size`` [m]): the extent of the truss, or a
twentieth of the largest coordinate X of nodes and walls at the start, if the truss is farther from the origin
(:func:`resolvable`). Coordinates of the size X have a rounding of 2.2e-16 X, at most 4.4e-15 L; a gap is a difference
of two of them, and an active set of a few rows loses some more digits. Each tolerance is at least ten times the
previous one, so that the error of one part is negligible for the next.

Forces, energies and linear systems have tolerances of their own where they are used: they scale with the model's
stiffness, not with its size.
"""

from __future__ import annotations

__all__ = [
    "BEYOND",
    "FIXED_POINT",
    "FREE_PART",
    "ON_BOUND",
    "PROJECTED",
    "RANK",
    "ROUNDING",
    "SINGULAR_PIVOT",
    "SINGULAR_ROW",
    "TIME",
    "resolvable",
]

_FAR = 0.05  # of the largest coordinate

FIXED_POINT = 1e-15
"""relative to L: motions of rigid bodies are iterated until only rounding changes"""
ROUNDING = 1e-14
"""relative to L, times or directions: the effect of another order of summation; closer values count as equal"""
PROJECTED = 1e-13
"""relative to L: accuracy of bounds in projections and active sets, at least twenty roundings of a coordinate"""
ON_BOUND = 1e-12
"""relative to L, wave speeds or directions: a node within this distance of a bound, or with less than this velocity
away from it, is on it; ten times the error of a projection"""
BEYOND = 1e-9
"""relative to L: depth beyond a wall that is a failure, at least 2e5 roundings, and the margin by which nodes search
for walls beyond their motion in a step. Steps satisfy walls to 1e-12; almost parallel walls, walls with mass, and nodes
tied to one wall and moved along another to 1e-9; observed losses of contact are at least 1e-4"""

FREE_PART = 1e-12
"""squared length of the free part of a unit direction, below which supports alone determine the motion. The direction
is then within 1e-6 of the fixed ones, and its free part has a relative accuracy of 1e-10 at best"""
SINGULAR_ROW = 1e-10
"""relative to the diagonal of a row in a Gram matrix: remainder after elimination of the other rows, below which the
row depends on them"""
RANK = 1e-8
"""relative to the largest singular value of unit normals: below it, normals are dependent; the root of rounding"""
TIME = 1e-9
"""relative to a step or an end time: largest difference between the sum of steps and the requested time"""
SINGULAR_PIVOT = 1e-13
"""relative to the largest entry of a matrix: a pivot that is zero up to rounding"""


def resolvable(extent: float, *coordinates: float) -> float:
    """Return the length L [m] of a truss of an extent, with the largest ``coordinates`` of nodes and walls [m]."""
    return max(extent, _FAR * max(coordinates))
