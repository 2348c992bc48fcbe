"""The balance of one step as a function of the position increment: residual and Hessian, in nodal frames at walls."""

from __future__ import annotations

import numpy as np

from ..contact.frames import NodalFrames
from ..contact.pair_coordinates import PairCoordinates
from ..integrators.base import Balance, State
from ..mechanics.compiled import kernel
from ..solvers.matrix import HessianMatrix

__all__ = ["StepProblem"]


@kernel
def _turn_blocks(ptr, local_columns, frame_of, left, inverse, values):
    """H <- L H B^-1 on the rows and columns of nodes with a frame (index -1: none)."""
    block = np.zeros((3, 3))
    for row in range(len(ptr) - 1):
        width = 3 * (ptr[row + 1] - ptr[row])
        r = frame_of[row]
        for k in range(ptr[row], ptr[row + 1]):
            c = frame_of[local_columns[k]]
            if r < 0 and c < 0:
                continue
            at = 6 * ptr[row] + 3 * k
            for i in range(3):
                for j in range(3):
                    block[i, j] = values[at + i * width + j]
            if r >= 0:
                for j in range(3):
                    x, y, z = block[0, j], block[1, j], block[2, j]
                    for i in range(3):
                        block[i, j] = left[r, i, 0] * x + left[r, i, 1] * y + left[r, i, 2] * z
            if c >= 0:
                for i in range(3):
                    x, y, z = block[i, 0], block[i, 1], block[i, 2]
                    for j in range(3):
                        block[i, j] = x * inverse[c, 0, j] + y * inverse[c, 1, j] + z * inverse[c, 2, j]
            for i in range(3):
                for j in range(3):
                    values[at + i * width + j] = block[i, j]


class StepProblem:
    """g(w) of one step, where w is the increment u from the predictor, in nodal coordinates w = B u at walls.

    With ``pairs``, nodes of contact pairs have their coordinates as well. Drag by friction is a part of g (see
    :mod:`pfem_petsc.contact.sliding`), whose derivative is then not symmetric.

    Components that supports prescribe have a zero residual and a unit row: the guess carries their value.
    """

    def __init__(
        self,
        model,
        state: State,
        balance: Balance,
        external: np.ndarray,
        frames: NodalFrames | None,
        pairs: PairCoordinates | None = None,
    ) -> None:
        self.pairs = pairs
        self.model = model
        self.state = state
        self.balance = balance
        self.external = external
        self.frames = frames
        mesh, inertia = model.mesh, model.inertia
        self.x = np.zeros((mesh.n_local, 3))
        self.f = np.zeros((mesh.n_local, 3))
        self.u = np.zeros((mesh.n_owned, 3))
        self._work = np.zeros((mesh.n_owned, 3))
        self.nodal = balance.alpha * inertia.mass + balance.eta * inertia.damping
        self.scale = float(self.nodal.max(initial=0.0))
        # what does not change with u: M a_hat + C v_hat + (1 - w) f_n - f_ext
        known = -external
        if balance.a_hat is not None:
            known = known + inertia.mass_times(balance.a_hat, np.zeros_like(known))
        if inertia.damped and balance.v_hat is not None:
            known = known + inertia.damping_times(balance.v_hat, np.zeros_like(known))
        if balance.weight < 1.0:
            known = known + (1.0 - balance.weight) * state.f[: mesh.n_owned]
        self.known = known
        own = frames is not None and (frames.oblique or (frames.sliding is not None and len(frames.sliding.nodes) > 0))
        self.oblique = frames is not None and model.comm.allreduce(int(own)) > 0
        self.sliding = frames.sliding if self.oblique else None
        if self.oblique:
            self._share_frames()

    def _share_frames(self) -> None:
        mesh, frames = self.model.mesh, self.frames
        inverse = np.zeros((mesh.n_local, 10))
        inverse[frames.nodes, 0] = 1.0
        inverse[frames.nodes, 1:] = frames.inverse.reshape(-1, 9)
        mesh.update_ghosts(inverse)
        turned = np.flatnonzero(inverse[:, 0] > 0.0)
        self._frame_of = np.full(mesh.n_local, -1, dtype=np.int32)
        self._frame_of[turned] = np.arange(len(turned), dtype=np.int32)
        self._inverse = np.ascontiguousarray(inverse[turned, 1:]).reshape(-1, 3, 3)

    def increment(self, w: np.ndarray) -> np.ndarray:
        """u (owned, 3) for w. Collective."""
        self.u[:] = w
        if self.pairs is not None:
            self.pairs.increment(self.u)
        if self.oblique:
            at = self.frames.nodes
            self.u[at] = np.einsum("nij,nj->ni", self.frames.inverse, self.u[at])
        return self.u

    def coordinates(self, u: np.ndarray) -> np.ndarray:
        """w (owned, 3) for u. Collective."""
        w = u.copy()
        if self.oblique:
            at = self.frames.nodes
            w[at] = np.einsum("nij,nj->ni", self.frames.basis, u[at])
        if self.pairs is not None:
            self.pairs.coordinates(w)
        return w

    def imbalance(self, u: np.ndarray, g: np.ndarray) -> None:
        """g = M a + C v + f_int - f_ext at u, in x, without regard to supports and walls [N]. Collective."""
        mesh, inertia, balance = self.model.mesh, self.model.inertia, self.balance
        owned = mesh.n_owned
        if inertia.consistent:
            g[:] = inertia.mass_times(balance.alpha * u, self._work)
            if inertia.damped and balance.eta:
                g += inertia.damping_times(balance.eta * u, self._work)
        else:
            np.multiply(self.nodal[:, None], u, out=g)
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                g[moved.touched] += balance.alpha * np.einsum("kij,kj->ki", moved.tensors, u[moved.touched])
        g += self.known
        if balance.weight:
            self.place(u)
            if balance.from_start:
                self.model.bars.step_forces(self.state.x, self.x, self.f)
            else:
                self.model.bars.forces(self.x, self.f, commit=False)
            g += balance.weight * self.f[:owned]

    def residual(self, w: np.ndarray, g: np.ndarray) -> None:
        """See :class:`~pfem_petsc.solvers.newton.Problem`."""
        self.imbalance(self.increment(w), g)
        if self.oblique:
            at = self.frames.nodes
            g[at] = np.einsum("nji,nj->ni", self.frames.inverse, g[at])
            if self.sliding is not None:
                nodes = self.sliding.nodes
                g[nodes] = self.sliding.couple(self.balance.predictor[nodes] + self.u[nodes], g[nodes])
        if self.pairs is not None:
            self.pairs.gradient(g)
        if self.model.supports.any:
            g[self.model.supports.fixed] = 0.0

    def hessian(self, w: np.ndarray, matrix: HessianMatrix, values: np.ndarray) -> None:
        """Add dg/dw to the values of an assembled matrix, in which pairs have no coordinates yet. Collective."""
        self.place(self.increment(w))
        self.hessian_here(matrix, values)

    def hessian_here(self, matrix: HessianMatrix, values: np.ndarray, stored: np.ndarray | None = None) -> None:
        """As :meth:`hessian`, at the positions :attr:`x`, ghosts included. Collective.

        With ``stored`` (b, 5) the stiffness of the bars is that of its numbers, see ``Bars.linearise``.
        """
        inertia, balance = self.model.inertia, self.balance
        if not inertia.consistent:
            matrix.add_lumped(self.nodal, values)
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                matrix.add_blocks(moved.touched, balance.alpha * moved.tensors, values)
        coefficients = inertia.coefficients(balance.alpha, balance.eta)
        if balance.weight or inertia.consistent:
            bars, arguments = self.model.bars, (balance.weight, coefficients, matrix.pattern, values)
            if balance.from_start:
                bars.step_tangents(self.state.x, self.x, *arguments)
            elif stored is not None:
                bars.tangents(self.x, 0.0, *arguments[1:])
                matrix.add_bars(stored, values)
            else:
                bars.tangents(self.x, *arguments)
        if self.oblique:
            if self.sliding is not None:
                matrix.add_blocks(self.sliding.nodes, self.sliding.stiffness, values)
            _turn_blocks(matrix.pattern.ptr, matrix.local_columns, self._frame_of, self.left(), self._inverse, values)
        matrix.constrain(self.scale, values)

    def left(self) -> np.ndarray:
        """What turns the imbalance of the frames' nodes (m, 3, 3) into the residual, at the last evaluation."""
        left = self.frames.inverse.transpose(0, 2, 1).copy()
        if self.sliding is not None:
            left[self.sliding.at] = self.sliding.maps @ left[self.sliding.at]
        return left

    def place(self, u: np.ndarray) -> None:
        """Put the positions of all local nodes at the predictor plus u. Collective."""
        np.add(self.balance.predictor, u, out=self.x[: self.model.mesh.n_owned])
        self.model.mesh.update_ghosts(self.x)
