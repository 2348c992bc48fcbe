"""Vectors of three numbers as tuples in compiled loops, whose components may be complex; rotations: matrices, rotation
vectors, and the step by which a rigid body turns.

A rotation vector psi [rad] has the direction of the axis and the length of the angle, by the right-hand rule.
"""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import inlined, kernel

NOWHERE = 0.0, 0.0, 0.0
"""The vector of no length."""

_ROUNDS = 50  # of Newton's method, which needs five
_NEAR = 1e-9  # last move [rad], the square of which is below rounding
_SMALL = 1e-2  # angle [rad] below which differences of nearly equal numbers are a series


@inlined
def vector(x, i):
    """Return the first three columns of row i."""
    return x[i, 0], x[i, 1], x[i, 2]


@inlined
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def along(a, s, b):
    """Return a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@inlined
def times(s, a):
    """Return s a."""
    return s * a[0], s * a[1], s * a[2]


@inlined
def dot(a, b):
    """Return the scalar product, without conjugation."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a, b):
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def put(x, i, a):
    """Write a to the first three columns of row i."""
    x[i, 0], x[i, 1], x[i, 2] = a


@inlined
def add_to(x, i, s, a):
    """Add s a to the first three columns of row i."""
    put(x, i, along(vector(x, i), s, a))


@inlined
def free_components(a, fixed):
    """Return a vector without its ``fixed`` components."""
    return 0.0 if fixed[0] else a[0], 0.0 if fixed[1] else a[1], 0.0 if fixed[2] else a[2]


@kernel
def across(vectors):
    """Return the matrices (w, 3, 3) of products of vectors (w, 3) from the left, v x ..."""
    products = np.zeros((len(vectors), 3, 3))
    for w in range(len(vectors)):
        for c in range(3):
            one, other = (c + 1) % 3, (c + 2) % 3
            products[w, other, one], products[w, one, other] = vectors[w, c], -vectors[w, c]
    return products


@inlined
def _series(vectors, first, second):
    """Return I + a V + b V V (w, 3, 3) with numbers (w,) and the products V = v x ... of vectors (w, 3)."""
    found = across(vectors)
    for w in range(len(vectors)):
        product = found[w].copy()
        found[w] = np.eye(3) + first[w] * product + second[w] * (product @ product)
    return found


@kernel
def turns_about(axes, angles):
    """Return matrices (w, 3, 3) of rotations by angles (w,) [rad] about unit axes (w, 3), by Rodrigues' formula."""
    return _series(axes, np.sin(angles), 2.0 * np.sin(0.5 * angles) ** 2)


@inlined
def _angles(vectors):
    """Return the lengths (w,) of vectors (w, 3)."""
    return np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + vectors[:, 2] ** 2)


@kernel
def turns_by(vectors):
    """Return the matrices (w, 3, 3) of rotation vectors (w, 3) [rad]."""
    angles = _angles(vectors)
    return turns_about(vectors / np.where(angles > 0.0, angles, 1.0).reshape(-1, 1), angles)


def vectors_of(turns: np.ndarray) -> np.ndarray:
    """Return rotation vectors (w, 3) [rad] of matrices (w, 3, 3), by angles up to pi."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(turns).as_rotvec() if len(turns) else np.empty((0, 3))


@kernel
def changes_of_turns(vectors):
    """Return the matrices (w, 3, 3) from a change of rotation vectors (w, 3) to the small rotation, in space, that the
    rotations change by."""
    angles = _angles(vectors)
    whole = np.maximum(angles, _SMALL)
    rest = np.where(angles < _SMALL, 1.0 / 6.0 - angles**2 / 120.0, (whole - np.sin(whole)) / whole**3)
    half = 0.5 * np.maximum(angles, 1e-9)
    return _series(vectors, 0.5 * (np.sin(half) / half) ** 2, rest)


@kernel
def steps_of_bodies(ways, inertia):
    """Return the rotation vectors (t, 3) [rad] by which rigid bodies turn in a step, and their derivatives (t, 3, 3) by
    the ways; the former are infinite if the step is too large for one of them.

    ``ways`` (t, 3) are the integrals of the angular momentum about the centre over the step [kg m2], fixed in space,
    and ``inertia`` (t, 3, 3) [kg m2], all in the axes of the body at the start of the step. The angular velocity is
    that of the angular momentum halfway, J psi = exp(-psi/2) w. Both ends are alike in it: it is of second order and
    reversible, so that the energy of a free body oscillates about a constant (Hairer, Lubich and Wanner, Geometric
    Numerical Integration, VII.5 and XI).
    """
    vectors, slopes, there = np.zeros_like(ways), np.zeros_like(inertia), np.zeros_like(ways)
    for t in range(len(ways)):
        part, move = slice(t, t + 1), np.full(3, np.inf)
        vectors[t] = np.linalg.solve(inertia[t], ways[t])
        for _ in range(_ROUNDS):
            if not np.abs(move).max() > _NEAR:
                break
            halfway = turns_by(-0.5 * vectors[part])[0]
            there[t] = halfway @ ways[t]
            slope = inertia[t] - 0.5 * across(there[part])[0] @ changes_of_turns(-0.5 * vectors[part])[0]
            move = np.linalg.solve(slope, there[t] - inertia[t] @ vectors[t])
            vectors[t] += move
            if not np.abs(vectors[t]).max() < np.pi:
                break
            slopes[t] = np.linalg.solve(slope, halfway)
        if not (np.abs(move).max() <= _NEAR and np.abs(vectors[t]).max() < np.pi):
            vectors[t] = np.inf
    return vectors, slopes


@kernel
def turn_bodies(turns, scale, inertia, ways):
    """Return the rotation vectors (t, 3) [rad], in space, of :func:`steps_of_bodies` of bodies at ``turns`` (t, 3, 3)
    from rest, and the derivatives (t, 3, 3) of small rotations at the end by the ways (t, 3), which ``scale`` (t, 1)
    makes those of angular momenta."""
    own = np.empty_like(ways)
    for t in range(len(turns)):
        own[t] = turns[t].T @ (scale[t, 0] * ways[t])
    vectors, slopes = steps_of_bodies(own, inertia)
    changes = changes_of_turns(vectors)
    for t in range(len(turns)):
        slopes[t] = scale[t, 0] * (turns[t] @ changes[t] @ slopes[t] @ turns[t].T)
        vectors[t] = turns[t] @ vectors[t]
    return vectors, slopes
