"""Negative eigenvalues of the tangent stiffness, and whether an equilibrium is a minimum of the potential."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..solvers.linear import has_mumps
from ..solvers.matrix import HessianMatrix

if TYPE_CHECKING:
    from ..contact.forces import WallForces
    from ..solvers.lagged import LaggedPreconditioner
    from ..solvers.matrix_free import MatrixFreeHessian
    from ..stepping.model import Model


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


_ZERO = 1e-10  # of the largest nodal stiffness: eigenvalues down to minus this are zero, those of free motions
_RIGID = 1e3  # of the largest nodal stiffness: what walls have along the normals of nodes that they push
_ITERATIONS = 500  # of conjugate gradients that look for a negative curvature, about those of a linear solve
_RTOL = 1e-6  # a mode of negative curvature cannot remain hidden while the residual of a random load falls this far
_NOISE = 1e-12  # of the largest nodal stiffness: curvatures down to minus this are rounding


def held_nodes(model: Model, walls: WallForces) -> np.ndarray:
    """Return which owned nodes are taken as held in all directions.

    These are tied nodes, those that walls with friction or curved walls push, and those that links push: their forces
    resist a motion along the wall, or turn with the nodes. What is unstable with them held is unstable without.
    """
    contact, held = model.contact, np.zeros(model.mesh.n_owned, dtype=bool)
    special = ~contact.flat | (np.array(contact.static_friction) > 0.0)
    held[walls.nodes[walls.touching[:, special].any(axis=1)]] = True
    if contact.ties.any:
        held[contact.ties.nodes()[0]] = True
    model.links.mark(held)
    return held


def is_indefinite(
    model: Model,
    hessian: HessianMatrix | MatrixFreeHessian,
    lagged: LaggedPreconditioner | None,
    held: np.ndarray,
) -> bool:
    """Return whether conjugate gradients meet a negative curvature of an operator; without a factorisation.

    A curvature that is found is a proof. The load is random: that of the truss may be orthogonal to the mode.
    ``held`` (owned,) : nodes that do not move. Collective.
    """
    noise = _NOISE * max(model.comm.allgather(float(model.nodal_stiffness.max(initial=0.0))))
    b, diagonal = hessian.mat.createVecs()
    z, p, w = b.duplicate(), b.duplicate(), b.duplicate()

    def clear(vector: PETSc.Vec) -> None:
        with vector as values:
            model.supports.clear(values.reshape(-1, 3))
            values.reshape(-1, 3)[held] = 0.0

    def precondition() -> float:
        if lagged is not None and lagged.is_set_up:
            lagged.inner.apply(b, z)
        else:
            z.pointwiseDivide(b, diagonal)
        clear(z)
        return b.dot(z)

    diagonal = hessian.mat.getDiagonal(diagonal)
    diagonal.array[:] = np.maximum(np.abs(diagonal.array), noise or 1.0)
    ids = 3 * model.mesh.node_ids[: model.mesh.n_owned, None] + np.arange(3)
    b.array[:] = np.cos((ids.ravel() + 0.5) ** 1.5)
    clear(b)
    start, before, found = b.norm(), 0.0, False
    for _ in range(_ITERATIONS):
        product = precondition()
        if not (product > 0.0 and b.norm() > _RTOL * start):
            break
        p.aypx(product / before if before else 0.0, z)
        hessian.mat.mult(p, w)
        clear(w)
        curvature, before = p.dot(w), product
        if curvature <= 0.0:
            found = curvature < -noise * p.dot(p)
            break
        b.axpy(-product / curvature, w)
    for vector in (b, diagonal, z, p, w):
        vector.destroy()
    return found


class MinimumCheck:
    """Counts directions in which the potential falls, without those that walls prevent. Collective.

    Parameters
    ----------
    model : Model
    largest : number of unknowns up to which it factorises the stiffness

    Attributes
    ----------
    refusal : why it cannot, None where it can
    """

    def __init__(self, model: Model, largest: int = LARGEST) -> None:
        self.model = model
        self._matrix: HessianMatrix | None = None
        self._stability: Stability | None = None
        self.refusal: str | None = f"the model has more than {largest:,} unknowns"
        if 3 * model.mesh.n_nodes <= largest:
            self._matrix = HessianMatrix(model.mesh, model.supports)
            self._stability = Stability(model, self._matrix)
            self.refusal = self._stability.refusal
        self._scale = max(model.comm.allgather(float(model.nodal_stiffness.max(initial=0.0))))

    def falling(self, x: np.ndarray, walls: WallForces, time: float, bars: np.ndarray | None = None) -> int:
        """Number of negative eigenvalues of the stiffness at positions (local, 3), -1 where it cannot be factorised.

        ``walls`` says which nodes walls push, ``time`` where the walls are; ``bars`` (5, b) is their stiffness if not
        the tangent, see ``Bars.linearise``. Collective.
        """
        nodes, blocks = self._held(walls, time)
        model, matrix = self.model, self._matrix

        def add(values: np.ndarray) -> None:
            matrix.add_lumped(np.full(model.mesh.n_owned, _ZERO * self._scale), values)
            if bars is None:
                model.bars.tangents(x, 1.0, model.inertia.coefficients(0.0, 0.0), matrix.pattern, values)
            else:
                matrix.add_bars(bars, values)
                if model.bars.springs is not None:
                    model.bars.springs.add_tangents(1.0, matrix.pattern, values)
            matrix.add_blocks(nodes, _RIGID * self._scale * blocks, values)
            matrix.constrain(self._scale, values)

        matrix.fill(add)
        try:
            return self._stability.look().negatives
        except PETSc.Error:
            return -1

    def _held(self, walls: WallForces, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (k,) that walls hold, and the projections (k, 3, 3) on their directions, summed."""
        contact = self.model.contact
        blocks = np.zeros((self.model.mesh.n_owned, 3, 3))
        if len(walls.nodes):
            normals, _ = contact.planes(walls.touching, walls.places, contact.motion.displacements(time))
            blocks[walls.nodes] += np.einsum("mw,mwi,mwj->mij", walls.touching.astype(float), normals, normals)
        blocks[held_nodes(self.model, walls)] += np.eye(3)
        nodes = np.flatnonzero(blocks.any(axis=(1, 2)))
        return nodes, blocks[nodes]

    def destroy(self) -> None:
        """Free the PETSc objects. Collective."""
        for owner in (self._stability, self._matrix):
            if owner is not None:
                owner.destroy()
