"""The matrices of the eigenvalue problems: stiffness of the state, of the unstressed truss, geometric stiffness, mass.

Both problems are brought into the form A x = theta B x with B positive definite, of which the largest theta are wanted:

- vibration, (K - lambda M) x = 0: A = M, B = K - shift M with a shift below all lambda, theta = 1/(lambda - shift);
- buckling, (K0 + lambda Kg) x = 0: A = -Kg, B = K0, theta = 1/lambda.

Held components remain in the matrices without coupling; their theta is positive and below all others, or zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.mass import Inertia
from ..solvers.matrix import HessianMatrix
from .holds import Holds

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["Pencil", "StateMatrices", "buckling_bars", "join"]


@dataclass
class Pencil:
    """The problem A x = theta B x in PETSc matrices, with data for an iteration.

    Attributes
    ----------
    a, b : PETSc matrices; b is positive definite if the shift lies below all eigenvalues
    points : (owned, 3) positions of the nodes [m], for multigrid
    held : (owned, 3) bool, components that are held
    free : number of free components of the whole model
    """

    a: PETSc.Mat
    b: PETSc.Mat
    points: np.ndarray
    held: np.ndarray
    free: int

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for matrix in (self.a, self.b):
            matrix.destroy()


def buckling_bars(model: Model, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bars (5, b) of K0 and Kg, both on the geometry of the mesh; see ``Bars.state_stiffness``.

    K0: dN/dl of the unstressed bars with their virgin material, along the bar. Kg: N/l0 across it, where N is the
    axial force at the local positions ``x``.
    """
    bars, points = model.bars, model.mesh.points
    lengths = bars.lengths(x)
    force = bars.state_stiffness(x)[4] * lengths
    history, heat, rest = bars.history(), bars.heat, bars.rest
    step, bars.step = bars.step, 0.0
    try:
        bars.put_history(np.zeros_like(history))
        bars.heat, bars.rest = np.zeros_like(heat), bars.mesh_lengths
        unloaded = np.zeros((5, len(model.mesh.bars)))
        bars.linearise(points, 1.0, unloaded)
    finally:
        bars.put_history(history)
        bars.heat, bars.rest, bars.step = heat, rest, step
    unloaded[3:] *= bars.mesh_lengths / rest  # dN/dl of bars that are stress-free at their rest lengths
    geometric = unloaded.copy()
    unloaded[3] += unloaded[4]
    unloaded[4] = 0.0
    geometric[4] = force / bars.mesh_lengths
    geometric[3] = -geometric[4]
    return unloaded, geometric


class StateMatrices:
    """Assembled matrices of a model in which components held by supports and walls are decoupled.

    Parameters
    ----------
    model : Model
    holds : Holds
    consistent : whether the mass matrix is consistent
    """

    def __init__(self, model: Model, holds: Holds, consistent: bool) -> None:
        self.model, self.holds = model, holds
        # a treatment of impact may have moved the masses of nodes
        same = consistent == model.inertia.consistent and model.inertia.redistribution is None
        self.inertia = model.inertia if same else Inertia(model.mesh, model.bars, consistent, model.inertia.points)
        self._ends = model.mesh.bars.astype(np.int64)

    def stiffness(
        self, bars: np.ndarray, diagonal: float | np.ndarray, added: tuple | None = None, springs: bool = True
    ) -> PETSc.Mat:
        """Return the matrix of bars (5, b), with ``diagonal`` (owned,) at held components. Collective.

        ``springs``: whether those to the ground are part of it
        ``added``: owned nodes (m,) and blocks (m, 3, 3) [N/m] to add
        """
        matrix = HessianMatrix(self.model.mesh)

        def fill(values: np.ndarray) -> None:
            matrix.add_bars(bars, values)
            if springs and self.model.bars.springs is not None:
                self.model.bars.springs.add_tangents(1.0, matrix.pattern, values)
            if added is not None:
                matrix.add_blocks(*added, values)

        return self.holds.taken_out(matrix.fill(fill), diagonal)

    def mass(self) -> PETSc.Mat:
        """Return the mass matrix [kg]; held components keep their lumped mass. Collective."""
        mesh, inertia = self.model.mesh, self.inertia
        if not inertia.consistent:
            return _diagonal(mesh.comm, np.repeat(inertia.mass, 3))
        matrix = HessianMatrix(mesh)

        def fill(values: np.ndarray) -> None:
            coefficients = inertia.coefficients(1.0, 0.0)
            self.model.bars.tangents(mesh.points, 0.0, coefficients, matrix.pattern, values)
            if inertia.points.mass is not None:
                matrix.add_lumped(inertia.points.mass, values)

        return self.holds.taken_out(matrix.fill(fill), inertia.mass)

    def bounds(self, bars: np.ndarray, blocks: tuple | None = None) -> tuple[float, float]:
        """Return bounds below and above all eigenvalues of the bars' stiffness (5, b) and the mass [1/s2]. Collective.

        A bar's matrix is (a n n^T + c (I - n n^T)) times [[1, -1], [-1, 1]], which lies between 2 min(a, c, 0) and
        2 max(a, c, 0) times the identity; a consistent mass is at least a third of the lumped one.
        """
        axial, transverse = bars[3] + bars[4], bars[4]
        low = self._at_nodes(2.0 * np.minimum(np.minimum(axial, transverse), 0.0))
        high = self._at_nodes(2.0 * np.maximum(np.maximum(axial, transverse), 0.0))
        if self.model.bars.springs is not None:
            high[self.model.bars.springs.nodes] += self.model.bars.springs.largest()
        if blocks is not None:
            nodes, added = blocks
            values = np.linalg.eigvalsh(added)
            low[nodes] += np.minimum(values[:, 0], 0.0)
            high[nodes] += np.maximum(values[:, -1], 0.0)
        factor = 3.0 if self.inertia.consistent else 1.0
        mine = np.array([-(low / self.inertia.mass).min(initial=0.0), (high / self.inertia.mass).max(initial=0.0)])
        self.model.comm.Allreduce(MPI.IN_PLACE, mine, op=MPI.MAX)
        return -factor * float(mine[0]), factor * float(mine[1])

    def _at_nodes(self, values: np.ndarray) -> np.ndarray:
        """Return sums over the bars of each owned node."""
        mesh = self.model.mesh
        sums = np.zeros(mesh.n_local)
        for end in (0, 1):
            sums += np.bincount(self._ends[:, end], weights=values, minlength=mesh.n_local)
        return sums[: mesh.n_owned]


def join(first: PETSc.Mat, factor: float, second: PETSc.Mat) -> PETSc.Mat:
    """Return first + factor second as a new symmetric matrix with the pattern of the first. Collective."""
    total = first.duplicate(copy=True)
    total.axpy(factor, second, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
    total.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return total


def _diagonal(comm: MPI.Comm, values: np.ndarray) -> PETSc.Mat:
    matrix = PETSc.Mat().createAIJ(((len(values), None), (len(values), None)), bsize=3, nnz=1, comm=comm)
    first, last = matrix.getOwnershipRange()
    rows = np.arange(first, last + 1, dtype=PETSc.IntType)
    matrix.setValuesCSR(np.arange(len(values) + 1, dtype=PETSc.IntType), rows[:-1], values)
    matrix.assemble()
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return matrix
