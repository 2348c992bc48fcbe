"""Negative eigenvalues of the tangent stiffness, and the modes that belong to eigenvalues near zero.

Their number changes by one at a simple critical point (Wriggers and Simo 1990). Small models have all eigenvalues
computed; beyond, Sylvester's law of inertia gives the number from a factorisation L D L^T, and inverse iteration
with it the eigenvalue nearest to zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..solvers.linear import has_mumps

if TYPE_CHECKING:
    from ..solvers.matrix import HessianMatrix
    from ..stepping.model import Model

__all__ = ["DENSE", "LARGEST", "LARGEST_WITH_MUMPS", "Spectrum", "Stability"]

DENSE = 450
"""Unknowns up to which all eigenvalues are computed: in 0.03 s."""
LARGEST = 30_000
"""Unknowns up to which PETSc's own factorisation is used, and checks that are not asked for are made."""
LARGEST_WITH_MUMPS = 400_000
"""Unknowns up to which MUMPS factorises the stiffness: of an octet block in 20 s, with 4 GB."""
_SWEEPS = 6  # of inverse iteration; where its result matters, the eigenvalue is far nearer to zero than the next
_ALIKE = 1e-6
_PREFIX = "pfem_inertia_"


class Spectrum(NamedTuple):
    """Number of negative eigenvalues, and the magnitude of the eigenvalue nearest to zero [N/m]."""

    negatives: int
    nearest: float


class Stability:
    """Looks at the stiffness that a matrix holds. Collective.

    Parameters
    ----------
    model : Model
    matrix : HessianMatrix that is filled before each look

    Attributes
    ----------
    refusal : why it cannot look, None where it can
    """

    def __init__(self, model: Model, matrix: HessianMatrix) -> None:
        self.mesh, self.comm, self._mat = model.mesh, model.comm, matrix.mat
        self._supports, self._fixed = model.supports, model.supports.fixed
        unknowns = 3 * self.mesh.n_nodes
        self.dense = unknowns <= DENSE
        self.refusal: str | None = None
        self._factor: PETSc.PC | None = None
        self._mumps = not self.dense and has_mumps()
        if self.dense:
            return
        largest = LARGEST_WITH_MUMPS if self._mumps else LARGEST
        if unknowns > largest:
            why = "" if self._mumps else ", and this PETSc does not have MUMPS"
            self.refusal = f"the model has {unknowns:,} unknowns, more than {largest:,}{why}"
        elif self.comm.size > 1 and not self._mumps:
            self.refusal = "on several ranks it requires MUMPS, which this PETSc does not have"

    def look(self) -> Spectrum:
        """Count at the stiffness that the matrix holds now."""
        if self.dense:
            values, _ = self._eigen()
            return Spectrum(int((values < 0.0).sum()), float(np.abs(values).min(initial=np.inf)))
        self._factorise()
        negatives = int(self._factor.getFactorMatrix().getInertia()[0])
        return Spectrum(negatives, abs(float(self._near(1)[0][0])))

    def modes(self, count: int) -> list[np.ndarray]:
        """Modes (owned, 3) of the ``count`` eigenvalues nearest to zero, of unit 2-norm.

        Of eigenvalues that are the same any combination is a mode. These are the projections of single components on
        them: first of the component that has the largest, of these the first in the mesh; then of the next within what
        is left. So they do not depend on the ranks.
        """
        return self.combined(self.nearest(count)[1])

    def nearest(self, count: int, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues (n,) nearest to zero [N/m], and modes (n, owned, 3), ``count`` of them or all that there are.

        ``shift`` [N/m] is what a factorisation needs where the stiffness is singular.
        """
        if self.dense:
            return self._eigen_near(count)
        if shift:
            self._mat.shift(shift)
        self._factorise()
        unknowns = 3 * self.mesh.n_nodes - self.comm.allreduce(self._supports.number)
        values, vectors = self._near(min(count, unknowns))
        return values - shift, vectors

    def combined(self, vectors: np.ndarray) -> list[np.ndarray]:
        """Combinations of modes (n, owned, 3) that do not depend on which modes they are made of, see :meth:`modes`."""
        ids = 3 * self.mesh.node_ids[: self.mesh.n_owned, None] + np.arange(3)
        found = []
        for _ in range(len(vectors)):
            size = np.einsum("knc,knc->nc", vectors, vectors)
            largest = self.comm.allreduce(float(size.max(initial=0.0)), op=MPI.MAX)
            candidates = np.where(size >= (1.0 - _ALIKE) * largest, ids, np.iinfo(np.int64).max)
            first = self.comm.allreduce(int(candidates.min(initial=np.iinfo(np.int64).max)), op=MPI.MIN)
            row = self.comm.allreduce(vectors[:, ids == first].sum(axis=1))
            unit = row / np.linalg.norm(row)
            found.append(np.einsum("k,knc->nc", unit, vectors))
            # what is orthogonal to it
            basis = np.linalg.svd(unit[None, :])[2][1:]
            vectors = np.einsum("jk,knc->jnc", basis, vectors)
        return found

    def destroy(self) -> None:
        """Free the PETSc objects."""
        if self._factor is not None:
            self._factor.destroy()

    def _eigen(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and vectors (components, eigenvalues) of the free components, in mesh order."""
        pointers, columns, values = self._mat.getValuesCSR()
        rows = 3 * self.mesh.first_node + np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
        first, owned = self.mesh.first_node, self.mesh.n_owned
        ids = np.column_stack([first + np.arange(owned), self.mesh.node_ids[:owned]])
        numbers = np.empty(self.mesh.n_nodes, dtype=np.int64)
        fixed = np.zeros((self.mesh.n_nodes, 3), dtype=bool)
        matrix = np.zeros((3 * self.mesh.n_nodes,) * 2)
        parts = self.comm.allgather((ids, self._fixed))
        for pairs, some in parts:
            numbers[pairs[:, 0]] = pairs[:, 1]
            fixed[pairs[:, 1]] = some
        for row, column, value in self.comm.allgather((rows, columns, values)):
            matrix[3 * numbers[row // 3] + row % 3, 3 * numbers[column // 3] + column % 3] = value
        self._free = np.flatnonzero(~fixed.ravel())
        return np.linalg.eigh(matrix[np.ix_(self._free, self._free)])

    def _eigen_near(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        values, vectors = self._eigen()
        near = np.argsort(np.abs(values), kind="stable")[:count]
        whole = np.zeros((3 * self.mesh.n_nodes, len(near)))
        whole[self._free] = vectors[:, near]
        return values[near], whole.T.reshape(len(near), -1, 3)[:, self.mesh.node_ids[: self.mesh.n_owned]]

    def _factorise(self) -> None:
        if self._factor is not None:
            self._factor.destroy()
        self._factor = PETSc.PC().create(self.comm)
        self._factor.setOptionsPrefix(_PREFIX)
        self._factor.setOperators(self._mat)
        self._factor.setType("cholesky")
        if self._mumps:
            self._factor.setFactorSolverType("mumps")
            options = PETSc.Options(_PREFIX)
            if not options.hasName("mat_mumps_icntl_24"):
                options["mat_mumps_icntl_24"] = 1  # detection of null pivots, without which there is no inertia
        self._factor.setFromOptions()
        self._factor.setUp()

    def _near(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues nearest to zero, and vectors (count, owned, 3), by inverse iteration with the factorisation."""
        ids = 3 * self.mesh.node_ids[: self.mesh.n_owned, None] + np.arange(3)
        block = np.stack([np.cos((k + 1.0) * (ids + 0.5) ** 1.5) for k in range(count)])
        for vectors in block:
            self._supports.clear(vectors)
        b, x = self._mat.createVecs()
        values = np.zeros(count)
        for _ in range(_SWEEPS):
            block = self._orthonormal(block)
            after = np.empty_like(block)
            for k in range(count):
                b.array[:] = block[k].ravel()
                self._factor.apply(b, x)
                after[k] = x.array.reshape(block[k].shape)
            small = self.comm.allreduce(np.einsum("inc,jnc->ij", block, after))
            inverse, turn = np.linalg.eigh(0.5 * (small + small.T))
            values = 1.0 / inverse
            block = np.einsum("ji,jnc->inc", turn, after)
        b.destroy()
        x.destroy()
        order = np.argsort(np.abs(values))
        return values[order], self._orthonormal(block[order])

    def _orthonormal(self, block: np.ndarray) -> np.ndarray:
        gram = self.comm.allreduce(np.einsum("inc,jnc->ij", block, block))
        scale = 1.0 / np.sqrt(np.diag(gram))
        lower = np.linalg.cholesky(gram * np.outer(scale, scale))
        return np.einsum("ij,jnc->inc", np.linalg.inv(lower), block * scale[:, None, None])
