"""Coulomb's law at single nodes: the explicit solution for the free position x - R/K, for any stiffness K.

A node at x with the reaction R satisfies the law if this solution is x again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..tolerances import PROJECTED
from .friction import add_friction
from .projection import project

if TYPE_CHECKING:
    from .contact import Contact

__all__ = ["LocalSolution", "solve_locally"]


class LocalSolution(NamedTuple):
    """Solutions of the local problems of k nodes at w walls.

    Attributes
    ----------
    moved : (k, 3) positions [m]
    normal_forces, drag : (k, w), (k, w, 3) normal and friction forces [N]
    stiffness : (k,) K of each node [N/m]
    """

    moved: np.ndarray
    normal_forces: np.ndarray
    drag: np.ndarray
    stiffness: np.ndarray

    def of(self, some: np.ndarray) -> LocalSolution:
        """Return the solutions of some of the nodes."""
        return LocalSolution(*(each[some] for each in self))


def solve_locally(
    contact: Contact,
    nodes: np.ndarray,
    planes: tuple[np.ndarray, np.ndarray],
    x: np.ndarray,
    reaction: np.ndarray,
    start: np.ndarray,
    wall_motion: np.ndarray,
    stiffness: np.ndarray,
    slipping: np.ndarray,
) -> LocalSolution:
    """Solve the local problems of nodes (k,) at tangent planes, normals (k, w, 3) and offsets (k, w) [m].

    Slipping nodes use the dynamic coefficient only; whether they stick is determined by a trial.

    Parameters
    ----------
    x, reaction : (k, 3) positions [m] and forces by walls [N]
    start : (k, 3) positions at the start of the step [m]
    wall_motion : (w, 3) displacements of the walls in the step [m]
    stiffness : (k,) [N/m]
    slipping : (k,) bool
    """
    normals, offsets = planes
    fixed = contact.fixed[nodes]
    moved = x - np.where(fixed, 0.0, reaction) / stiffness[:, None]
    normal_forces, drag = np.zeros(offsets.shape), np.zeros(normals.shape)
    project(moved, fixed, normals, offsets, PROJECTED * contact.size, normal_forces)
    normal_forces *= stiffness[:, None]
    for group, static in ((slipping, contact.friction), (~slipping, contact.static_friction)):
        part = np.flatnonzero(group)
        place, press, pull = moved[part], normal_forces[part], drag[part]
        add_friction(
            place,
            start[part],
            wall_motion,
            fixed[part],
            normals[part],
            offsets[part],
            contact.friction,
            static,
            stiffness[part],
            press,
            pull,
        )
        moved[part], normal_forces[part], drag[part] = place, press, pull
    return LocalSolution(moved, normal_forces, drag, stiffness)
