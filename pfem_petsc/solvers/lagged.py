"""A lagged preconditioner, from multigrid or an assembled Hessian, reused for many Newton iterations."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from .linear import USUAL_REDUCTION, reproducible_products, set_preconditioner
from .matrix import HessianMatrix
from .matrix_free import MatrixFreeHessian
from .multigrid import GridMultigrid

if TYPE_CHECKING:
    from ..contact.transform import RowCoordinates
    from ..stepping.model import Model
    from .matrix import StepProblem


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

    def couple(self, rows: RowCoordinates | None) -> None:
        """Set the coordinates of rows for steps with bounds. Collective."""
        self.matrix.couple(rows)

    def make(self, problem: StepProblem, held: np.ndarray) -> None:
        """Set up at the positions of a problem; ``held`` (owned, 3): nonzero for active unknowns. Collective."""
        stored = None
        if self.product is not None:
            self.product.linearise(problem)
            self.product.make_definite()
            stored = self.product.stored
            self.product.extension.kept = np.flatnonzero(held == 0.0)
        final = self.matrix.fill_held(problem, held, stored)
        self._set_up(final, problem)
        if self._inner.getType() == "gamg" and self.fill() > _DENSE:
            # the independent sets of PETSc 3.18 hardly coarsen a body-centred lattice: set-up and steps take 5 x as
            # long
            options = PETSc.Options(_PREFIX)
            if not options.hasName("mat_coarsen_type"):
                options["mat_coarsen_type"] = "hem"
                self._set_up(final, problem)
                options.delValue("mat_coarsen_type")

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


# A set-up costs about as much as this many iterations: it is repeated when the iterations in excess of those of the
# first solve after the last set-up add up to this number. 101,706 bars, one core: multigrid 0.33 s and 3.7 ms, MUMPS
# 2.3 s and 0.04 s.
_SET_UP = {"gamg": 90, "lu": 40, "mumps": 55, "multigrid": 15}


_NONE = (0.0,) * 7 + (1.0,)  # before the first set-up


class LaggedPreconditioner:
    """The preconditioner and the decision when to set it up again.

    It is kept during the Newton iterations of a problem, and from step to step as long as temperatures and rest lengths
    are constant and the unknowns are nodal displacements (no oblique walls, no links in contact). After a restart it
    can then be set up again from the positions and the bars' history at its last set-up, which checkpoints contain.

    Parameters
    ----------
    model : Model
    kind : of preconditioner: ``gamg``, ``lu``, ``mumps``; ``multigrid``
    symmetric, definite, matrix_free : see :class:`~pfem_petsc.solvers.lagged.AssembledPreconditioner`

    Attributes
    ----------
    inner : the preconditioner
    place : (owned, 6) positions at which the Hessian was evaluated [m], and whether a component was active; (owned, 0)
        if the next problem needs a set-up
    history : (b, names) data of the material laws there, see ``Bars.history``; (b, 0) if they keep none
    count : other data that decide on a set-up: the coefficients of the Hessian and the step of the bars there [s],
        iterations of the first solve with it for the usual reduction, excess iterations of later solves, iterations of
        the last solve, and its share
    carried : whether it was set up for an earlier problem
    share : digits by which the next solve reduces the residual, over those of the usual reduction
    """

    def __init__(self, model: Model, kind: str, symmetric: bool, definite: bool, matrix_free: bool) -> None:
        mesh = model.mesh
        self.mesh = mesh
        self.kind = kind
        if kind == "multigrid":
            self.inner = GridMultigrid(model)
        else:
            self.inner = AssembledPreconditioner(model, kind, symmetric, definite, matrix_free)
        self.bars = model.bars
        self.outlasts = not model.bars_vary and not model.inertia.varies
        self.place = np.zeros((mesh.n_owned, 0))
        self.history = np.zeros((len(mesh.bars), 0))
        self.count = list(_NONE)
        self.carried = False
        self.share = 1.0
        self._supports = model.supports
        self._problem = None
        self._kept: np.ndarray | None = None
        self._right = PETSc.Vec().createMPI((3 * mesh.n_owned, 3 * mesh.n_nodes), bsize=3, comm=mesh.comm)
        self._left = self._right.duplicate()

    def expect(self, reduction: float) -> None:
        """Take account of the factor by which the next solve reduces the residual."""
        self.share = max(np.log(reduction) / np.log(USUAL_REDUCTION), 1.0 / 3.0)

    @property
    def is_set_up(self) -> bool:
        """Whether there is a preconditioner to apply."""
        return self._problem is not None

    def drop(self) -> None:
        """Require a set-up in the next Newton iteration."""
        self._problem = None
        self.place = self.place[:, :0]

    def renew(self, problem: StepProblem, kept: np.ndarray | None) -> None:
        """Set the preconditioner up again if necessary; called at each Newton iteration. Collective.

        Parameters
        ----------
        problem : StepProblem, at the positions at which the Hessian is required
        kept : this rank's unknowns in the system, local and ascending; None for all
        """
        *coefficients, step, first, beyond, last, share = [*(self.count or _NONE), 1.0][: len(_NONE)]
        if last and not first:
            first = last / share
        else:
            beyond += max(last - first * share, 0.0)
        balance = problem.balance
        wanted = [balance.alpha, balance.eta, balance.weight]
        due = beyond > _SET_UP.get(self.kind, 0)
        own = not problem.transform.identity or balance.discrete_gradient
        usable = self.outlasts and not own
        self._kept = kept
        if problem is not self._problem:
            self.carried = True
            due |= not usable or wanted != coefficients or not self.place.shape[1]
            if not due and self._problem is None:
                self._make_again(problem, step)
        if due:
            owned = self.mesh.n_owned
            held = np.full((owned, 3), float(kept is not None))
            if kept is not None:
                held.reshape(-1)[kept] = 0.0
            self.inner.make(problem, held)
            first, beyond, step = 0.0, 0.0, self.bars.step
            self.place = np.hstack([problem.x[:owned], held]) if usable else np.zeros((owned, 0))
            if usable:
                self.history = self.bars.history()
        self.carried &= not due
        self._problem = problem
        self.count = [*wanted, step, first, beyond, 0.0, self.share]

    def _make_again(self, problem: StepProblem, step: float) -> None:
        """Recreate the preconditioner after a restart, from the Hessian at its last set-up with a ``step`` of the bars,
        which differs from step to step by rounding."""
        here, owned = problem.x.copy(), self.mesh.n_owned
        problem.x[:owned] = self.place[:, :3]
        self.mesh.update_ghosts(problem.x)
        history = self.bars.history()
        self.bars.put_history(self.history)
        balance = problem.balance
        with self.bars.at_step(step, balance.eta / balance.weight if balance.weight else 0.0):
            self.inner.make(problem, self.place[:, 3:])
        problem.x[:] = here
        self.bars.put_history(history)

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = P x for the unknowns kept, see :meth:`renew`. Collective."""
        self.count[-2] += 1.0
        kept = self._kept
        if kept is None:
            self.inner.apply(x, y)
            self._hold(y)
            return
        self._right.set(0.0)
        self._right.array[kept] = x.getArray(readonly=True)
        self.inner.apply(self._right, self._left)
        self._hold(self._left)
        y.setArray(self._left.getArray(readonly=True)[kept])

    def _hold(self, y: PETSc.Vec) -> None:
        """Set prescribed components to zero, which coarse corrections of multigrid would otherwise move."""
        if self._supports.number:
            with y as out:
                self._supports.clear(out.reshape(-1, 3))

    def destroy(self) -> None:
        """Free the PETSc objects."""
        self._problem = None
        for thing in (self.inner, self._right, self._left):
            thing.destroy()


class Preconditioning:
    """Python preconditioner of a solver of PETSc; all of them share the lagged preconditioner.

    Parameters
    ----------
    shared : the lagged preconditioner
    owner : of the solver of PETSc, which owns this object; has ``problem``, the current one or None
    inactive : function that returns this rank's unknowns in the system, local and ascending; None for all
    """

    def __init__(
        self, shared: LaggedPreconditioner, owner: Any, inactive: Callable[[], np.ndarray] | None = None
    ) -> None:
        self.shared, self.owner, self.inactive = shared, weakref.ref(owner), inactive

    def setUp(self, pc: PETSc.PC) -> None:  # noqa: N802 - PETSc's name
        """Handle a change of the operator; called by PETSc."""
        problem = self.owner().problem
        if problem is not None:
            self.shared.renew(problem, None if self.inactive is None else self.inactive())

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = P x; called by PETSc."""
        self.shared.apply(x, y)
