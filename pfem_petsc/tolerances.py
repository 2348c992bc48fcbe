"""Tolerances of geometry, in one place with their rationale.

Those of length are parts of the model's length L, the extent of the truss (``model.length``, ``contact.length`` [m]).
Coordinates of that size have a rounding of 2.2e-16 L; a gap is a difference of two of them, and an active set of a
few rows loses some digits more. Each tolerance is at least ten times the one before it, so that what one part leaves
is nothing to the next.

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
    "SINGULAR_ROW",
    "TIME",
]

FIXED_POINT = 1e-15
"""of L: motions of rigid bodies are iterated until nothing changes but rounding"""
ROUNDING = 1e-14
"""of L, of times and of directions: what summation in another order changes; below it, two values are the same"""
PROJECTED = 1e-13
"""of L: projections and active sets keep their bounds to this, some hundred roundings of a coordinate"""
ON_BOUND = 1e-12
"""of L, of wave speeds and of directions: a node that is no farther from a bound, or moves no faster from it, is on it;
ten times what a projection leaves"""
BEYOND = 1e-9
"""of L: how far a node may be beyond a wall before it is a failure, 4e6 roundings, and how much farther than a step
takes it a node looks for walls. Steps keep walls to 1e-12; walls that are almost parallel, walls with mass and nodes
tied to one wall and carried along another to 1e-9; losses of contact that were seen are from 1e-4 on"""

FREE_PART = 1e-12
"""squared length of the part of a unit direction that supports leave free: below it, supports alone decide there. The
direction itself is then within 1e-6 of the fixed ones, and its free part is known to 1e-10 of itself at best"""
SINGULAR_ROW = 1e-10
"""of a row's diagonal in a Gram matrix: what is left of it after elimination of the other rows, below which it depends
on them"""
RANK = 1e-8
"""singular values of unit normals over the largest, below which normals are dependent: the square root of rounding"""
TIME = 1e-9
"""of a step or an end time: how far a time that steps sum up to may be from the time that was asked for"""
