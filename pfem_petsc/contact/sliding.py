"""Friction forces on slipping nodes in one solve of an implicit step, as a linear map of the residual force.

A wall with normal force lambda_k exerts the friction force -mu_k lambda_k d_k on a slipping node. The normal force is
the residual on its bound, so friction is a linear function of the residual itself: with y = B x, the rows r(k) of the
walls and their signs s_k,

    g' = B^-T g + sum_k mu_k s_k g'_r(k) B^-T d_k   =>   g' = (I - C)^-1 B^-T g,

and g' is complementary to the bounds. An open wall causes no friction. Normal and tangential forces are thus coupled
within Newton's method, and the Hessian loses its symmetry.

The direction is d_k = z/|z| with z = a d + b s_k(u), the slip s_k, and a known direction d: with b = 0 the direction is
fixed, with a << b |s_k| it is that of the slip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Sliding"]

_SINGULAR = 1e-6  # determinant of I - C below which a wedge is jammed


@dataclass
class Sliding:
    """Slipping nodes of a rank.

    Attributes
    ----------
    nodes, at : (m,) owned local indices, and indices among the frames
    known : (m, 3) known part of the friction forces [N]
    inverse : (m, 3, 3) of the frames' bases
    rows, signs : (m, w) of the frames
    friction : (m, w) coefficients, zero where a wall exerts no friction
    normals, origins : (m, w, 3) normals of the walls; positions of the node without slip [m]
    start : (m, w, 3) a d [N]
    weight : (m,) b [N/m]
    maps : (m, 3, 3) (I - C)^-1 at the last evaluation
    stiffness : (m, 3, 3) derivative of friction with respect to the node's position x, at the last evaluation [N/m]
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
        """Return an instance without slipping nodes."""
        zeros, rows = np.zeros((0, walls, 3)), np.zeros((0, walls), dtype=np.int8)
        nodes, matrices = np.empty(0, dtype=np.int64), np.zeros((0, 3, 3))
        signs, known = np.zeros((0, walls)), np.zeros((0, 3))
        return cls(nodes, nodes, known, matrices, rows, signs, signs, zeros, zeros, zeros, np.zeros(0))

    def couple(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the residual (m, 3) with friction from the one without, in frame coordinates, at positions (m, 3)."""
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
        # the change of friction as the direction of slip turns
        self.stiffness[:] = 0.0
        for k in range(self.rows.shape[1]):
            normal_forces = np.maximum(self.signs[:, k] * g[every, np.maximum(self.rows[:, k], 0)], 0.0)
            factor = self.friction[:, k] * normal_forces * self.weight / size[:, k]
            n, d = self.normals[:, k], directions[:, k]
            across = np.eye(3) - n[:, :, None] * n[:, None, :] - d[:, :, None] * d[:, None, :]
            self.stiffness += factor[:, None, None] * across
        return g
