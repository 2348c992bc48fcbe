"""Surfaces of walls for pictures: the result of a wall's ``surface``, and functions that build it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Surface", "revolved", "slab"]


@dataclass(frozen=True)
class Surface:
    """Polygons of a wall for pictures, with the depth of each point beyond the face.

    Parameters
    ----------
    name : the wall's name
    points : (n, 3) float64 [m]
    faces : (f, 4) int64, corners of quadrilaterals
    depth : (n,) float64, 0 on the face that nodes touch, 1 where the picture fades out
    edge : (e, 2) int64, lines that outline the face
    """

    name: str
    points: np.ndarray
    faces: np.ndarray
    depth: np.ndarray
    edge: np.ndarray


def slab(name: str, face: np.ndarray, normal: np.ndarray, thickness: float) -> Surface:
    """Return a slab behind a quadrilateral face (4, 3) [m] whose unit normal points to the allowed side."""
    return Surface(
        name,
        np.concatenate([face, face - thickness * normal]),
        np.array([[0, 1, 2, 3], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]),
        depth=np.repeat([0.0, 1.0], 4),
        edge=np.array([[0, 1], [1, 2], [2, 3], [3, 0]]),
    )


def revolved(name: str, profile: np.ndarray, centre: np.ndarray, axis: np.ndarray, segments: int = 48) -> Surface:
    """Return the surface of revolution of a profile (p, 2), radius and height [m], about an axis through ``centre``."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    angles = 2.0 * np.pi * np.arange(segments) / segments
    around = np.multiply.outer(np.cos(angles), first) + np.multiply.outer(np.sin(angles), second)
    points = centre + profile[:, None, :1] * around + profile[:, None, 1:] * axis
    rings = np.arange(len(profile) * segments).reshape(len(profile), segments)
    after = np.roll(rings, -1, axis=1)
    faces = np.stack([rings[:-1], after[:-1], after[1:], rings[1:]], axis=2).reshape(-1, 4)
    edge = np.concatenate([np.stack([rings[k], after[k]], axis=1) for k in (0, -1)])
    return Surface(name, points.reshape(-1, 3), faces, depth=np.zeros(points.shape[0] * segments), edge=edge)
