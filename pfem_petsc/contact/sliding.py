"""The drag of slipping nodes in one solve of an implicit step, as a map of the imbalance of forces.

A wall that presses a slipping node with lambda_k drags it by -mu_k lambda_k d_k. Its normal force is the imbalance on
its bound, so that the drag is a linear function of the imbalance itself: with y = B x, the rows r(k) of the walls and
their signs s_k,

    g' = B^-T g + sum_k mu_k s_k g'_r(k) B^-T d_k   =>   g' = (I - C)^-1 B^-T g,

and g' is complementary to the bounds. Where a wall does not press, nothing is dragged. Normal and tangential forces are
so coupled within Newton's method; the Hessian loses its symmetry.

The direction is d_k = z/|z| with z = a d + b s_k(u), the slip s_k, and a known direction d: b = 0 keeps it as it is,
a << b |s_k| makes it that of the slip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Sliding"]

_SINGULAR = 1e-6  # determinant of I - C from which on a wedge is jammed


@dataclass
class Sliding:
    """Slipping nodes of a rank.

    Attributes
    ----------
    nodes, at : (m,) owned local indices, and places among the frames
    known : (m, 3) drag that is known [N]
    inverse : (m, 3, 3) of the frames' bases
    rows, signs : (m, w) of the frames
    friction : (m, w) coefficients, zero where a wall does not drag
    normals, origins : (m, w, 3) of the walls; places where the node would be without slip [m]
    start : (m, w, 3) a d [N]
    weight : (m,) b [N/m]
    maps : (m, 3, 3) (I - C)^-1 at the last evaluation
    stiffness : (m, 3, 3) derivative of the drag by the node's position, in x, at the last evaluation [N/m]
    """

    nodes: np.ndarray
    at: np.ndarray
    known: np.ndarray
    inverse: np.ndarray
    rows: np.ndarray
    signs: np.ndarray
    friction: np.ndarray
    normals: np.ndarray
    origins: np.ndarray
    start: np.ndarray
    weight: np.ndarray

    def __post_init__(self) -> None:
        self.maps = np.tile(np.eye(3), (len(self.nodes), 1, 1))
        self.stiffness = np.zeros((len(self.nodes), 3, 3))

    @classmethod
    def none(cls, walls: int) -> Sliding:
        """No slipping nodes."""
        zeros, rows = np.zeros((0, walls, 3)), np.zeros((0, walls), dtype=np.int8)
        nodes, matrices = np.empty(0, dtype=np.int64), np.zeros((0, 3, 3))
        signs, known = np.zeros((0, walls)), np.zeros((0, 3))
        return cls(nodes, nodes, known, matrices, rows, signs, signs, zeros, zeros, zeros, np.zeros(0))

    def couple(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """The imbalance (m, 3) with drag from the one without, in the frames' coordinates, at positions (m, 3)."""
        slip = x[:, None, :] - self.origins
        slip -= np.einsum("mwi,mwi->mw", slip, self.normals)[:, :, None] * self.normals
        way = self.start + self.weight[:, None, None] * slip
        size = np.maximum(np.linalg.norm(way, axis=2), 1e-300)
        directions = way / size[:, :, None]
        every = np.arange(len(self.nodes))
        coupling = np.zeros((len(self.nodes), 3, 3))
        turned = np.einsum("mji,mwj->mwi", self.inverse, directions)
        for k in range(self.rows.shape[1]):
            row = np.maximum(self.rows[:, k], 0)
            factor = self.friction[:, k] * self.signs[:, k]
            coupling[every, :, row] += factor[:, None] * turned[:, k]
        system = np.eye(3) - coupling
        jammed = np.abs(np.linalg.det(system)) < _SINGULAR
        system[jammed] = np.eye(3)
        self.maps = np.linalg.inv(system)
        g = np.einsum("mij,mj->mi", self.maps, g - np.einsum("mji,mj->mi", self.inverse, self.known))
        # what a turn of the slip makes of the drag
        self.stiffness[:] = 0.0
        for k in range(self.rows.shape[1]):
            normal_forces = np.maximum(self.signs[:, k] * g[every, np.maximum(self.rows[:, k], 0)], 0.0)
            factor = self.friction[:, k] * normal_forces * self.weight / size[:, k]
            n, d = self.normals[:, k], directions[:, k]
            across = np.eye(3) - n[:, :, None] * n[:, None, :] - d[:, :, None] * d[:, None, :]
            self.stiffness += factor[:, None, None] * across
        return g
