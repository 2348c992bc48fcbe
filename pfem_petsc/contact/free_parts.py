"""The part of a wall's normal that supports leave free: along the rest no contact can move a node."""

from __future__ import annotations

import numpy as np

from ..tolerances import FREE_PART

__all__ = ["free_squares", "held_by_supports"]


def free_squares(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Squared lengths (...,) of the parts of unit normals (..., 3) whose components are not ``fixed`` (..., 3)."""
    return (np.where(fixed, 0.0, normals) ** 2).sum(axis=-1)


def held_by_supports(fixed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(...,) bool: supports alone decide how far a node moves along these unit normals."""
    return free_squares(fixed, normals) <= FREE_PART
