"""Rotations: matrices, rotation vectors, and the step by which a rigid body turns.

A rotation vector psi [rad] has the direction of the axis and the length of the angle, by the right-hand rule.
"""

from __future__ import annotations

import numpy as np

_ROUNDS = 50  # of Newton's method, which needs five
_NEAR = 1e-9  # last move [rad], the square of which is below rounding
_SMALL = 1e-2  # angle [rad] below which differences of nearly equal numbers are a series


def across(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (w, 3, 3) of products of vectors (w, 3) from the left, v x ..."""
    return np.cross(np.eye(3), vectors[:, None, :])


def turns_about(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return matrices (w, 3, 3) of rotations by angles (w,) [rad] about unit axes (w, 3), by Rodrigues' formula."""
    product = across(axes)
    sine, versed = np.sin(angles), 2.0 * np.sin(0.5 * angles) ** 2
    return np.eye(3) + sine[:, None, None] * product + versed[:, None, None] * (product @ product)


def turns_by(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (w, 3, 3) of rotation vectors (w, 3) [rad]."""
    angles = np.linalg.norm(vectors, axis=1)
    return turns_about(vectors / np.where(angles > 0.0, angles, 1.0)[:, None], angles)


def vectors_of(turns: np.ndarray) -> np.ndarray:
    """Return rotation vectors (w, 3) [rad] of matrices (w, 3, 3), by angles up to pi.

    They follow from the largest row of 4 q q^T, the products of the quaternion's components, by a square root of no
    small number.
    """
    trace = np.trace(turns, axis1=1, axis2=2)
    products = np.empty((len(turns), 4, 4))
    products[:, 1:, 1:] = turns + turns.swapaxes(1, 2) + (1.0 - trace)[:, None, None] * np.eye(3)
    products[:, 0, 0] = 1.0 + trace
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        products[:, 0, k + 1] = products[:, k + 1, 0] = turns[:, j, i] - turns[:, i, j]
    largest = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=1)
    quaternion = products[np.arange(len(turns)), largest]
    quaternion *= np.where(quaternion[:, :1] < 0.0, -1.0, 1.0)
    sines = np.linalg.norm(quaternion[:, 1:], axis=1)
    angles = 2.0 * np.arctan2(sines, quaternion[:, 0])
    return quaternion[:, 1:] * (angles / np.where(sines > 0.0, sines, 1.0))[:, None]


def changes_of_turns(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (w, 3, 3) from a change of rotation vectors (w, 3) to the small rotation, in space, that the
    rotations change by."""
    angles, product = np.linalg.norm(vectors, axis=1), across(vectors)
    whole = np.maximum(angles, _SMALL)
    rest = np.where(angles < _SMALL, 1.0 / 6.0 - angles**2 / 120.0, (whole - np.sin(whole)) / whole**3)
    versed = 0.5 * np.sinc(angles / (2.0 * np.pi)) ** 2
    return np.eye(3) + versed[:, None, None] * product + rest[:, None, None] * (product @ product)


def steps_of_bodies(ways: np.ndarray, inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the rotation vectors (t, 3) [rad] by which rigid bodies turn in a step, and their derivatives (t, 3, 3) by
    the ways; None if the step is too large for one of them.

    ``ways`` (t, 3) are the integrals of the angular momentum about the centre over the step [kg m2], fixed in space,
    and ``inertia`` (t, 3, 3) [kg m2], all in the axes of the body at the start of the step. The angular velocity is
    that of the angular momentum halfway, J psi = exp(-psi/2) w. Both ends are alike in it: it is of second order and
    reversible, so that the energy of a free body oscillates about a constant (Hairer, Lubich and Wanner, Geometric
    Numerical Integration, VII.5 and XI).
    """
    vectors = np.linalg.solve(inertia, ways[:, :, None])[:, :, 0]
    for _ in range(_ROUNDS):
        halfway = turns_by(-0.5 * vectors)
        there = np.einsum("tij,tj->ti", halfway, ways)
        slope = inertia - 0.5 * across(there) @ changes_of_turns(-0.5 * vectors)
        lack = there - np.einsum("tij,tj->ti", inertia, vectors)
        move = np.linalg.solve(slope, lack[:, :, None])[:, :, 0]
        vectors = vectors + move
        if not np.abs(vectors).max(initial=0.0) < np.pi:
            return None
        if np.abs(move).max(initial=0.0) <= _NEAR:
            return vectors, np.linalg.solve(slope, halfway)
    return None
