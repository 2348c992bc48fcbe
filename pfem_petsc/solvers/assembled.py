"""Preconditioners from an assembled Hessian: PETSc's algebraic multigrid, or a factorisation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from .linear import set_preconditioner
from .matrix import HessianMatrix
from .matrix_free import MatrixFreeHessian
from .reproducible import reproducible_products

if TYPE_CHECKING:
    from ..stepping.model import Model
    from ..stepping.problem import StepProblem

__all__ = ["AssembledPreconditioner"]

# Nodes a rank. Aggregates of fewer unknowns than rigid body modes make PETSc 3.18 fail on several ranks, and let solves
# stagnate on one.
_FEW = 64
_DENSE = 3.0  # entries of coarse matrices relative to the finest; cubic and octet lattices have 0.2 to 0.5
_PREFIX = "pfem_assembled_"


class AssembledPreconditioner:
    """A preconditioner from the matrix of the definite part of a Hessian.

    The matrix contains the geometric stiffness of bars in tension only, so it is definite beyond buckling, where the
    Hessian is not. It covers all unknowns; rows and columns of active ones are those of the identity. This preserves
    the 3 x 3 blocks and the rigid body modes that multigrid needs.

    Options: prefix ``pfem_assembled_``.

    Parameters
    ----------
    model : Model
    kind : ``gamg``, ``lu`` or ``mumps``
    symmetric : whether the Hessian, including friction, is symmetric
    definite : whether the Hessian without friction is symmetric, and thus has a definite part
    matrix_free : whether multigrid smooths on the finest level with matrix-free products of the same matrix, which
        saves a third of the time
    """

    def __init__(self, model: Model, kind: str, symmetric: bool, definite: bool, matrix_free: bool) -> None:
        self.mesh, self.kind = model.mesh, kind
        # for symmetric schemes: the stiffness of the bars and its products
        self.product = MatrixFreeHessian(model) if definite else None
        self._smooth = matrix_free and kind == "gamg"
        self.matrix = HessianMatrix(model.mesh, model.supports, symmetric)
        self._inner: PETSc.PC | None = None
        self._new_inner(self.matrix.mat)  # reports invalid PETSc options before the first step

    def couple(self, links: Iterable) -> None:
        """Set the coordinates of links for steps with bounds. Collective."""
        self.matrix.couple(links)

    def make(self, problem: StepProblem, held: np.ndarray) -> None:
        """Set up at the positions of a problem; ``held`` (local, 3): nonzero for active unknowns, ghosts not yet up to
        date. Collective."""
        matrix = self.matrix
        self.mesh.update_ghosts(held)
        stored = None
        if self.product is not None:
            self.product.linearise(problem)
            self.product.make_definite()
            stored = self._vectors()
            self.product.extension.kept = np.flatnonzero(held[: self.mesh.n_owned] == 0.0)

        def add(values: np.ndarray) -> None:
            problem.hessian_here(matrix, values, stored)

        final = matrix.fill_held(add, held, problem.scale, problem.transform)
        self._set_up(final, problem)
        if self._inner.getType() == "gamg" and self.fill() > _DENSE:
            # the independent sets of PETSc 3.18 hardly coarsen a body-centred lattice: set-up and steps take 5 x as
            # long
            options = PETSc.Options(_PREFIX)
            if not options.hasName("mat_coarsen_type"):
                options["mat_coarsen_type"] = "hem"
                self._set_up(final, problem)
                options.delValue("mat_coarsen_type")

    def _vectors(self) -> np.ndarray:
        """Return vectors and stiffnesses (5, b) of the bars for :meth:`HessianMatrix.add_bars`."""
        ends, x = self.mesh.bars, self.product.x
        stored = np.empty((5, len(ends)))
        np.subtract(x[ends[:, 1]].T, x[ends[:, 0]].T, out=stored[:3])
        stored[3:] = self.product.stored
        return stored

    def fill(self) -> float:
        """Return the entries of multigrid's coarse matrices relative to the finest. Collective."""
        solvers = [self._inner.getMGSmoother(level) for level in range(1, self._inner.getMGLevels())]
        solvers.insert(0, self._inner.getMGCoarseSolve())
        entries = [solver.getOperators()[1].getInfo()["nz_used"] for solver in solvers]
        return sum(entries[:-1]) / max(entries[-1], 1.0)

    def _set_up(self, matrix: PETSc.Mat, problem: StepProblem) -> None:
        # from scratch: a reused hierarchy would differ from that after a restart
        self._new_inner(matrix)
        x = problem.x[: self.mesh.n_owned]
        centre = self.mesh.comm.allreduce(x.sum(axis=0)) / self.mesh.n_nodes
        # multigrid builds the rigid body modes from them, which it must not damp. MatNullSpaceCreateRigidBody would
        # orthogonalise them, with rounding that is not reproducible in PETSc 3.26
        if self.mesh.n_nodes > _FEW * self.mesh.comm.size:
            self._inner.setCoordinates(x - centre)
        with reproducible_products(self.mesh.comm):
            self._inner.setUp()

    def _new_inner(self, matrix: PETSc.Mat) -> None:
        if self._inner is not None:
            self._inner.destroy()
        self._inner = PETSc.PC().create(self.mesh.comm)
        self._inner.setOptionsPrefix(_PREFIX)
        self._inner.setOperators(self.product.extension.mat if self._smooth else matrix, matrix)
        set_preconditioner(self._inner, self.kind)
        self._inner.setUseAmat(self._smooth)
        self._inner.setFromOptions()

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = P x of all unknowns. Collective."""
        self._inner.apply(x, y)

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in (self._inner, self.matrix, self.product):
            if thing is not None:
                thing.destroy()
