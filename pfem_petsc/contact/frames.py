"""Bounds on nodal coordinates for implicit steps, and the oblique coordinates that turn planes into bounds.

At a node, y = B x with the normals of up to three independent planes as rows of B makes each plane a bound on one
coordinate; opposite planes bound the same coordinate from both sides. Rows along the axes stay in the slot of their axis,
so that walls along the axes need no change of coordinates at all.
"""

from __future__ import annotations

import numpy as np

__all__ = ["MAX_CONDITION", "NodalFrames", "build_frames"]

MAX_CONDITION = 50.0  # of B: planes closer to parallel than about 2 degrees do not share a node's coordinates


class NodalFrames:
    """Coordinates and bounds of nodes near walls.

    Attributes
    ----------
    nodes : (m,) owned local indices
    basis, inverse : (m, 3, 3): y = B x
    lower, upper : (m, 3) bounds on y [m], infinite where there is none
    rows : (m, w) int8: the coordinate (0, 1, 2) that wall k bounds at the node, -1 where it does not
    signs : (m, w) +1 for a lower bound, -1 for an upper one
    oblique : whether any basis is not the identity
    """

    def __init__(self, nodes: np.ndarray, walls: int) -> None:
        m = len(nodes)
        self.nodes = nodes
        self.basis = np.tile(np.eye(3), (m, 1, 1))
        self.inverse = self.basis.copy()
        self.lower = np.full((m, 3), -np.inf)
        self.upper = np.full((m, 3), np.inf)
        self.rows = np.full((m, walls), -1, dtype=np.int8)
        self.signs = np.ones((m, walls))
        self.oblique = False


def build_frames(
    nodes: np.ndarray, fixed: np.ndarray, normals: np.ndarray, offsets: np.ndarray, gaps: np.ndarray
) -> NodalFrames:
    """Frames of nodes from their planes, nearest plane first.

    Parameters
    ----------
    nodes : (m,) owned local indices
    fixed : (m, 3) bool, prescribed components: their axes are rows of B
    normals, offsets : (m, w, 3), (m, w) planes n . x >= d; offset -inf where a wall does not concern a node
    gaps : (m, w) distances to the planes [m], to rank them
    """
    frames = NodalFrames(nodes, offsets.shape[1])
    if (np.abs(normals).max(axis=2) == 1.0).all():
        _along_axes(frames, fixed, normals, offsets)
        return frames
    for i in range(len(nodes)):
        _frame(frames, i, fixed[i], normals[i], offsets[i], gaps[i])
    return frames


def _along_axes(frames: NodalFrames, fixed: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> None:
    """All planes along the axes: bounds on the components as they are."""
    every = np.arange(len(frames.nodes))
    for wall in range(offsets.shape[1]):
        axis = np.argmax(np.abs(normals[:, wall]), axis=1)
        sign = np.sign(normals[every, wall, axis])
        at = np.flatnonzero((offsets[:, wall] > -np.inf) & ~fixed[every, axis])
        frames.rows[at, wall] = axis[at]
        frames.signs[at, wall] = sign[at]
        low, high = at[sign[at] > 0], at[sign[at] < 0]
        frames.lower[low, axis[low]] = np.maximum(frames.lower[low, axis[low]], offsets[low, wall])
        frames.upper[high, axis[high]] = np.minimum(frames.upper[high, axis[high]], -offsets[high, wall])


def _frame(
    frames: NodalFrames, i: int, fixed: np.ndarray, normals: np.ndarray, offsets: np.ndarray, gaps: np.ndarray
) -> None:
    basis = np.full((3, 3), np.nan)
    basis[fixed] = np.eye(3)[fixed]
    for wall in np.argsort(gaps, kind="stable"):
        if offsets[wall] == -np.inf:
            continue
        normal = normals[wall]
        slot, sign = _slot(basis, fixed, normal)
        if slot < 0:
            continue
        frames.rows[i, wall] = slot
        frames.signs[i, wall] = sign
        if sign > 0:
            frames.lower[i, slot] = max(frames.lower[i, slot], offsets[wall])
        else:
            frames.upper[i, slot] = min(frames.upper[i, slot], -offsets[wall])
    free = np.isnan(basis[:, 0])
    if free.any():
        rest = basis[~free]
        complement = np.linalg.svd(rest)[2][len(rest) :] if len(rest) else np.eye(3)
        axes = np.eye(3)[free]
        # keep plain axes where they are orthogonal to the rest, so that nothing is turned without need
        basis[free] = axes if len(rest) == 0 or np.abs(axes @ rest.T).max() == 0.0 else complement
    frames.basis[i] = basis
    frames.inverse[i] = np.linalg.inv(basis)
    if not np.array_equal(basis, np.eye(3)):
        frames.oblique = True


def _slot(basis: np.ndarray, fixed: np.ndarray, normal: np.ndarray) -> tuple[int, float]:
    """Row of the basis for a normal: an existing parallel one, the slot of its axis, or the next free; -1 for none."""
    taken = ~np.isnan(basis[:, 0])
    for row in np.flatnonzero(taken):
        cosine = float(basis[row] @ normal)
        if abs(cosine) > 1.0 - 1e-14:
            return (-1, 1.0) if fixed[row] else (int(row), float(np.sign(cosine)))
    axis = int(np.argmax(np.abs(normal)))
    along = abs(normal[axis]) == 1.0
    if along and not taken[axis]:
        trial, slot, sign = np.eye(3)[axis], axis, float(np.sign(normal[axis]))
    else:
        free = np.flatnonzero(~taken)
        if len(free) == 0:
            return -1, 1.0
        trial, slot, sign = normal, int(free[np.argmax(np.abs(normal[free]))]), 1.0
    rows = np.vstack([basis[taken], trial])
    if np.linalg.cond(rows) > MAX_CONDITION:
        return -1, 1.0
    basis[slot] = trial
    return slot, sign
