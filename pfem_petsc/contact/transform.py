"""The coordinates of one implicit solve, in which contact rows are bounds on unknowns: u = T w.

T is composed of the frames of nodes near walls (:mod:`~pfem_petsc.contact.frames`), u = B^-1 y, and the coordinates of
links (:mod:`~pfem_petsc.contact.links`), y = T_1 ... T_n w. Friction multiplies the residual from the left
(:mod:`~pfem_petsc.contact.sliding`). Solvers use this object only and do not know what produced a row; without contact
it is the identity.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..solvers.node_blocks import turn_blocks
from .frames import NodalFrames
from .links import BlocksOf, LinkCoordinates
from .sliding import Sliding

if TYPE_CHECKING:
    from ..solvers.matrix import HessianMatrix
    from ..stepping.model import Model

__all__ = ["Transform"]


class Transform:
    """Coordinates of a solve. Construction is collective.

    Parameters
    ----------
    model : Model
    frames : of nodes near walls; None if no rank has any
    links : coordinates of the links that may close in the step

    Attributes
    ----------
    links : tuple of these
    sliding : friction forces on slipping nodes; has no nodes without friction
    identity : whether w equals u and the residual is unchanged
    bounded : whether the solve has bounds
    """

    def __init__(self, model: Model, frames: NodalFrames | None = None, links: Sequence[LinkCoordinates] = ()) -> None:
        self.mesh = model.mesh
        self.links = tuple(links)
        walls = model.contact.members.shape[1]
        own = frames is not None and (frames.oblique or (frames.sliding is not None and len(frames.sliding.nodes) > 0))
        self._oblique = frames is not None and model.comm.allreduce(int(own)) > 0
        self.bounded = frames is not None or bool(self.links)
        self.identity = not self._oblique and not self.links
        # frames along the axes change no coordinates
        self._frames = frames if self._oblique else NodalFrames(np.empty(0, dtype=np.int64), walls)
        self.sliding = self._frames.sliding or Sliding.none(walls)
        if self._oblique:
            self._share_frames()

    @property
    def frames(self) -> NodalFrames:
        """Frames of owned nodes whose coordinates are not those of x."""
        return self._frames

    @cached_property
    def nodewise(self) -> bool:
        """Whether w differs from u by frames of nodes only, and the Hessian is symmetric. Collective at first use."""
        return not self.links and not self.mesh.comm.allreduce(int(len(self.sliding.nodes) > 0))

    def _share_frames(self) -> None:
        mesh, frames = self.mesh, self._frames
        inverse = np.zeros((mesh.n_local, 10))
        inverse[frames.nodes, 0] = 1.0
        inverse[frames.nodes, 1:] = frames.inverse.reshape(-1, 9)
        mesh.update_ghosts(inverse)
        turned = np.flatnonzero(inverse[:, 0] > 0.0)
        self._frame_of = np.full(mesh.n_local, -1, dtype=np.int32)
        self._frame_of[turned] = np.arange(len(turned), dtype=np.int32)
        self._inverse = np.ascontiguousarray(inverse[turned, 1:]).reshape(-1, 3, 3)

    def forward(self, w: np.ndarray) -> None:
        """Transform w (owned, 3) to u, in place. Collective."""
        for link in reversed(self.links):
            link.forward(w)
        at = self._frames.nodes
        w[at] = np.einsum("nij,nj->ni", self._frames.inverse, w[at])

    def inverse(self, u: np.ndarray) -> None:
        """Transform u (owned, 3) to w, in place. Collective."""
        at = self._frames.nodes
        u[at] = np.einsum("nij,nj->ni", self._frames.basis, u[at])
        for link in self.links:
            link.inverse(u)

    def residual(self, predictor: np.ndarray, u: np.ndarray, g: np.ndarray) -> None:
        """Transform the residual force (owned, 3) at predictor + u to the residual of w, in place. Collective."""
        at, slipping = self._frames.nodes, self.sliding.nodes
        g[at] = np.einsum("nji,nj->ni", self._frames.inverse, g[at])
        g[slipping] = self.sliding.couple(predictor[slipping] + u[slipping], g[slipping])
        for link in self.links:
            link.adjoint(g)

    def left(self) -> np.ndarray:
        """Matrices (m, 3, 3) that map the residual force at framed nodes to the residual, at the last evaluation."""
        left = self._frames.inverse.transpose(0, 2, 1).copy()
        at = self.sliding.at
        left[at] = self.sliding.maps @ left[at]
        return left

    def linear(self, left: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Transform H u (local, 3), in place, to the derivative of the residual along u (local, 3). Collective.

        ``left`` : value of :meth:`left` where H was evaluated.
        """
        at, slipping = self._frames.nodes, self.sliding.nodes
        out[slipping] += np.einsum("nij,nj->ni", self.sliding.stiffness, u[slipping])
        out[at] = np.einsum("nij,nj->ni", left, out[at])
        for link in self.links:
            link.adjoint(out)

    def diagonal(self, left: np.ndarray, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        """Replace the diagonal (owned, 3) of H by that of the derivative of the residual. Collective."""
        nodes = self._frames.nodes
        full = blocks(nodes)
        full[self.sliding.at] += self.sliding.stiffness
        diagonal[nodes] = np.einsum("nij,njk,nki->ni", left, full, self._frames.inverse)
        for link in self.links:
            link.diagonal(lambda some: self._in_frames(some, blocks(some)), diagonal)

    def _in_frames(self, nodes: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        _, at, place = np.intersect1d(nodes, self._frames.nodes, return_indices=True)
        inverse = self._frames.inverse[place]
        blocks[at] = inverse.transpose(0, 2, 1) @ blocks[at] @ inverse
        return blocks

    def turn(self, matrix: HessianMatrix, values: np.ndarray) -> None:
        """Transform the values of an assembled Hessian to frame coordinates, without those of links. Collective."""
        if not self._oblique:
            return
        matrix.add_blocks(self.sliding.nodes, self.sliding.stiffness, values)
        left = self.left()
        turn_blocks(matrix.pattern.ptr, matrix.local_columns, self._frame_of, left, self._inverse, values)
