"""The part of a wall's normal that supports leave free; contact cannot move a node along the rest."""

from __future__ import annotations

import numpy as np

from ..tolerances import FREE_PART

__all__ = ["free_squares", "held_by_supports"]


def free_squares(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return squared lengths (...,) of unit normals (..., 3) restricted to components that are not ``fixed``."""
    return (np.where(fixed, 0.0, normals) ** 2).sum(axis=-1)


def held_by_supports(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return (...,) bool: only supports determine the motion of a node along these unit normals."""
    return free_squares(fixed, normals) <= FREE_PART
