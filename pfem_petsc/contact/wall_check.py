"""Checks of the solution of an implicit solve against all walls."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..tolerances import ON_BOUND, PROJECTED
from .candidates import Candidates
from .frames import NodalFrames
from .free_parts import held_by_supports

if TYPE_CHECKING:
    from .contact import Contact

__all__ = ["broken_walls", "is_misaligned", "is_off_surface"]


def broken_walls(
    contact: Contact,
    displacements: np.ndarray,
    candidates: Candidates,
    frames: NodalFrames,
    x: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (k,) beyond walls that no bound of theirs represents, and these walls (k, walls) bool.

    Parameters
    ----------
    contact : Contact
    displacements : (walls, 3) of walls [m]
    candidates, frames : of the solve
    x : (owned, 3) solution [m]
    tolerance : depth that counts as zero [m]
    """
    beyond = np.flatnonzero(contact.near(x, displacements, np.array([-tolerance])))
    applicable = contact.applicable(beyond, x[beyond], displacements)
    normals, offsets = contact.planes(applicable, x[beyond], displacements)
    gaps = np.einsum("iwk,ik->iw", normals, x[beyond]) - offsets
    broken = gaps < -tolerance
    place = np.searchsorted(candidates.nodes, beyond)
    known = place < len(candidates.nodes)
    known[known] = candidates.nodes[place[known]] == beyond[known]
    # walls with their own bound are satisfied to rounding of the coordinates; supports override walls
    place = place[known]
    broken[known] &= (frames.rows[place] < 0) | frames.shared[place]
    broken &= ~contact.ties.held[beyond][:, None]
    broken &= ~held_by_supports(contact.fixed[beyond][:, None, :], normals)
    met = broken.any(axis=1)
    return beyond[met], broken[met]


def is_misaligned(frames: NodalFrames, strengths: np.ndarray) -> bool:
    """Return whether a wall presses through the row of an almost parallel wall, so that the force is off its normal."""
    normal_forces = strengths > 0.0
    astray = normal_forces & frames.shared
    for node, wall in np.argwhere(astray):
        own = (frames.rows[node] == frames.rows[node, wall]) & ~frames.shared[node]
        turn = np.abs(
            frames.normals[node, wall] - frames.signs[node, wall] * frames.basis[node, frames.rows[node, wall]]
        )
        if turn.max() > ON_BOUND and not (normal_forces[node] & own).any():
            return True
    return False


def is_off_surface(
    contact: Contact,
    displacements: np.ndarray,
    frames: NodalFrames,
    strengths: np.ndarray,
    x: np.ndarray,
    tolerance: float,
    part: float,
) -> bool:
    """Return whether a node in contact with a curved wall is off its surface or used the normal of another point.

    A node without contact force may satisfy the plane of another point and still lie beyond the wall. ``part``: see
    :meth:`~pfem_petsc.contact.contact.Contact.acting`.
    """
    at = frames.nodes
    acting = contact.acting(at, x[at], displacements, part)
    normals, _ = contact.planes(strengths > 0.0, x[at], displacements, acting)
    for k in np.flatnonzero(~contact.flat):
        pressed = strengths[:, k] > 0.0
        passed = ~pressed & (frames.rows[:, k] >= 0)
        if passed.any() and (contact.gap(k, x[at[passed]], displacements) < -tolerance).any():
            return True
        if pressed.any():
            turn = np.abs(normals[pressed, k] - frames.normals[pressed, k]).max(axis=1)
            # far from the origin, the rounding of positions turns normals by more
            moved = np.abs(x[at[pressed]] - frames.places[pressed]).max(axis=1)
            turned = (turn > ON_BOUND) & (moved > PROJECTED * contact.size)
            if np.abs(contact.gap(k, x[at[pressed]], displacements)).max() > tolerance or turned.any():
                return True
    return False
