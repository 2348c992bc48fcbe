"""Choice of the linear solver of a Newton step, accelerations with consistent mass, and PETSc's reasons in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError, SimulationFailure
from .matrix import HessianMatrix

if TYPE_CHECKING:
    from ..stepping.model import Model


DIRECT = ("lu", "mumps")
"""Direct solvers: PETSc's own factorisation, for small matrices, and MUMPS if PETSc has it."""

USUAL_REDUCTION = 1e-3
"""Factor by which linear solves reduce the residual if nothing else is known."""

_MULTIGRID = "conjugate gradients, multigrid on a background grid, matrix-free"
_DIRECT_BELOW = 500  # unknowns; a lattice of 3,993 takes 0.06 s to factorise, and 1 to 4 ms with conjugate gradients
# Step, relative to the explicit limit, up to which each is chosen; see scripts/linear_solvers.py,
# docs/linear_solvers.md
_JACOBI_FREE_UP_TO = 30.0
_JACOBI_BLOCK_UP_TO = 10.0  # where the truss fills a block
_MULTIGRID_FROM = 10  # steps after which the first set-up pays off
# with an assembled matrix
_JACOBI_UP_TO = 5.0
_CHOLESKY_UP_TO = 50.0


@dataclass(frozen=True)
class LinearChoice:
    """A Krylov method and preconditioner, with or without a matrix, and the description in the log."""

    krylov: str
    preconditioner: str
    why: str
    matrix_free: bool = False

    @property
    def factorises(self) -> bool:
        """Whether the preconditioner is a factorisation of the whole matrix."""
        return self.preconditioner in DIRECT

    @property
    def lagged(self) -> bool:
        """Whether the preconditioner has its own matrix from an earlier iteration."""
        return self.preconditioner in ("gamg", "multigrid") or (self.matrix_free and self.factorises)


@dataclass(frozen=True)
class Demand:
    """What the choice of a linear solver depends on besides the case's wishes.

    Attributes
    ----------
    unknowns : of the whole model
    step_ratio : time step relative to the critical step of central differences: stiffness relative to mass
    symmetric : whether the matrix is symmetric; if not, GMRES and incomplete LU replace conjugate gradients and
        Cholesky
    steps : of the run
    impact : whether there is contact or yielding, with which tangents change too fast for a lagged preconditioner
    block : whether the truss fills a block, see :func:`~pfem_petsc.solvers.background_grid.fills_block`
    """

    unknowns: int
    step_ratio: float
    symmetric: bool = True
    steps: int = _MULTIGRID_FROM
    impact: bool = False
    block: bool = False


def choose_linear(request: str, operator: str, demand: Demand) -> LinearChoice:
    """Resolve ``solver.linear`` and ``solver.operator``.

    Parameters
    ----------
    request : ``auto``, ``cg``, ``multigrid``, ``gamg`` or ``mumps``
    operator : ``auto``, ``assembled`` or ``matrix_free``
    demand : Demand

    Raises
    ------
    InputError
        If a matrix-free operator is requested together with a method that needs a matrix, or the reverse.
    """
    unknowns, step_ratio, symmetric, impact = demand.unknowns, demand.step_ratio, demand.symmetric, demand.impact
    _check(request, operator, symmetric)
    free = operator != "assembled" and symmetric
    krylov, method = ("cg", "conjugate gradients") if symmetric else ("gmres", "GMRES")
    direct = DIRECT[unknowns > _DIRECT_BELOW]
    if request == "mumps" and operator == "matrix_free":
        return LinearChoice("cg", direct, "conjugate gradients, lagged factorisation, matrix-free (asked for)", True)
    if request == "mumps":
        return LinearChoice("preonly", direct, "direct (asked for)")
    if request == "auto" and operator != "matrix_free" and unknowns <= _DIRECT_BELOW:
        return LinearChoice("preonly", direct, f"direct ({unknowns} unknowns, at most {_DIRECT_BELOW})")
    if request == "multigrid":
        return LinearChoice(krylov, "multigrid", f"{_MULTIGRID} (asked for)", True)
    words = f"{method}, lagged multigrid, {'matrix-free' if free else 'assembled'}"
    if request == "gamg":
        return LinearChoice(krylov, "gamg", f"{words} (asked for)", free)
    ratio = f"step is {step_ratio:.3g} x the explicit limit"
    if free:
        if request == "auto" and demand.block and not impact and step_ratio > _JACOBI_BLOCK_UP_TO:
            return LinearChoice(krylov, "multigrid", f"{_MULTIGRID} ({ratio})", True)
        if request == "cg" or step_ratio <= _JACOBI_FREE_UP_TO:
            return LinearChoice(krylov, "jacobi", f"{method}, Jacobi, matrix-free ({ratio})", True)
        if impact or demand.steps < _MULTIGRID_FROM:
            short = "contact or yielding" if impact else f"{demand.steps} steps"
            return LinearChoice(krylov, "jacobi", f"{method}, Jacobi, matrix-free ({ratio}, {short})", True)
        return LinearChoice(krylov, "gamg", f"{words} ({ratio})", True)
    if request == "cg" or step_ratio <= _JACOBI_UP_TO:
        return LinearChoice(krylov, "pbjacobi", f"{method}, point-block Jacobi ({ratio})")
    if step_ratio <= _CHOLESKY_UP_TO:
        if symmetric:
            return LinearChoice(krylov, "icc", f"{method}, incomplete Cholesky ({ratio})")
        return LinearChoice(krylov, "ilu", f"{method}, incomplete LU ({ratio})")
    return LinearChoice(krylov, "gamg", f"{words} ({ratio})")


def _check(request: str, operator: str, symmetric: bool) -> None:
    """Refuse combinations that do not exist."""
    if operator == "matrix_free" and not symmetric:
        raise InputError('solver.operator = "matrix_free": this integrator needs a matrix; use "assembled" or "auto"')
    if request == "multigrid" and not symmetric:
        raise InputError('solver.linear = "multigrid": the matrix of this integrator is not symmetric; use "gamg"')
    if request == "multigrid" and operator == "assembled":
        raise InputError('solver.linear = "multigrid" is matrix-free: use operator = "matrix_free", or linear = "gamg"')


def unsymmetric(choice: LinearChoice) -> LinearChoice:
    """Return the corresponding choice for an unsymmetric matrix."""
    if choice.krylov == "preonly":
        return choice
    preconditioner = "ilu" if choice.preconditioner == "icc" else choice.preconditioner
    return replace(choice, krylov="gmres", preconditioner=preconditioner)


def configure(ksp: PETSc.KSP, choice: LinearChoice, reduced: bool, ours: object = None) -> None:
    """Configure a linear solver; options of the same prefix given by the user override this afterwards.

    Parameters
    ----------
    ksp : the solver
    choice : method and preconditioner
    reduced : whether it solves for the inactive unknowns of a contact problem, whose matrix has no blocks
    ours : Python preconditioner to use instead of that of the choice
    """
    ksp.setType(choice.krylov)
    if choice.krylov == "gmres":
        ksp.setGMRESRestart(100)
    if choice.krylov != "preonly":
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setTolerances(rtol=USUAL_REDUCTION, max_it=4000 if ours is None else 1000)  # Newton's method sets others
    if ours is None:
        set_preconditioner(ksp.getPC(), choice.preconditioner, reduced)
    else:
        ksp.getPC().setType("python")
        ksp.getPC().setPythonContext(ours)


def set_preconditioner(pc: PETSc.PC, kind: str, reduced: bool = False) -> None:
    """Set the type of a preconditioner as in :class:`LinearChoice`, with the defaults of this program."""
    comm = pc.comm
    if kind in DIRECT:
        pc.setType("lu")
        # PETSc's own takes 57 s for a lattice of 101,706 bars and MUMPS 2.3 s, but 0.5 ms less for one of 200
        if (kind == "mumps" or comm.size > 1) and has_mumps():
            pc.setFactorSolverType("mumps")
        elif comm.size > 1:
            pc.setType("redundant")
    elif kind == "pbjacobi":
        pc.setType("jacobi" if reduced else "pbjacobi")
    elif kind in ("icc", "ilu"):
        shift = "positive_definite" if kind == "icc" else "nonzero"
        if comm.size == 1:
            pc.setType(kind)
            _default(pc, "pc_factor_shift_type", shift)
        else:
            _default(pc, "sub_pc_type", kind)
            _default(pc, "sub_pc_factor_shift_type", shift)
            pc.setType("bjacobi")
    else:
        pc.setType(kind)


def _default(pc: PETSc.PC, name: str, value: str) -> None:
    options = PETSc.Options(pc.getOptionsPrefix())
    if not options.hasName(name):
        options[name] = value


@cache
def has_mumps() -> bool:
    """Whether PETSc has MUMPS."""
    mat = PETSc.Mat().createAIJ((1, 1), nnz=1, comm=PETSc.COMM_SELF)
    mat[0, 0] = 1.0
    mat.assemble()
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setOperators(mat)
    pc.setType("lu")
    try:
        pc.setFactorSolverType("mumps")
        pc.setUp()
    except PETSc.Error:
        return False
    finally:
        pc.destroy()
        mat.destroy()
    return True


_EXTERNAL_LIBRARY = 76  # PETSC_ERR_LIB

_NEWTON = {
    "DIVERGED_FUNCTION_DOMAIN": "the positions left the domain of the model (a collapsed bar)",
    "DIVERGED_LINEAR_SOLVE": "a linear solve failed",
    "DIVERGED_FNORM_NAN": "the residual is not a number (a bar collapsed or the motion diverged)",
    "DIVERGED_FUNCTION_NANORINF": "the residual is not a number (a bar collapsed or the motion diverged)",
    "DIVERGED_MAX_IT": "the limit of Newton iterations was reached",
    "DIVERGED_LINE_SEARCH": "the line search found no decrease of the residual",
    "DIVERGED_LOCAL_MIN": "the residual has a local minimum that is not zero",
    "DIVERGED_DTOL": "the residual grew",
    "DIVERGED_INNER": "the inner solver failed",
}
_LINEAR = {
    "DIVERGED_MAX_IT": "the limit of linear iterations was reached",
    "DIVERGED_ITS": "the limit of linear iterations was reached",
    "DIVERGED_INDEFINITE_MAT": "the tangent is indefinite (bars in compression beyond buckling)",
    "DIVERGED_INDEFINITE_PC": "the preconditioner is indefinite",
    "DIVERGED_BREAKDOWN": "the Krylov method broke down",
    "DIVERGED_NANORINF": "not-a-number in the linear solve",
    "DIVERGED_NAN": "not-a-number in the linear solve",
    "DIVERGED_PCSETUP_FAILED": "the preconditioner could not be set up (a singular matrix)",
    "DIVERGED_PC_FAILED": "the preconditioner could not be set up (a singular matrix)",
    "DIVERGED_DTOL": "the linear residual grew",
}


def _words(table: type, known: dict[str, str], reason: int) -> str:
    names = [name for name in dir(table) if not name.startswith("_") and getattr(table, name) == reason]
    name = min(names, key=lambda name: (not name.startswith(("DIVERGED", "CONVERGED")), name), default=str(reason))
    return f"{known[name]} [{name}]" if name in known else name


def newton_reason(reason: int) -> str:
    """Describe a SNES converged reason."""
    return _words(PETSc.SNES.ConvergedReason, _NEWTON, reason)


def linear_reason(reason: int) -> str:
    """Describe a KSP converged reason."""
    return _words(PETSc.KSP.ConvergedReason, _LINEAR, reason)


def is_failed_factorisation(error: PETSc.Error) -> bool:
    """Return whether MUMPS could not factorise a matrix.

    On several ranks PETSc 3.18 continues the solve with the incomplete factors. The solver must then be created again.
    """
    return error.ierr == _EXTERNAL_LIBRARY and "MUMPS" in str(error)


_PREFIX = "pfem_mass_"


class MassSolver:
    """The consistent mass matrix, constant during a run, and its solver. Construction is collective.

    Options: prefix ``pfem_mass_``.

    Parameters
    ----------
    model : Model
        With consistent mass.
    """

    def __init__(self, model: Model) -> None:
        self._supports = model.supports
        self._matrix = matrix = HessianMatrix(model.mesh, model.supports)

        def add(values: np.ndarray) -> None:
            matrix.add_mass(model.bars, model.inertia, values)
            matrix.constrain(float(model.inertia.mass.max(initial=1.0)), values)

        matrix.fill(add)
        self._right, self._left = matrix.mat.createVecs()
        self._ksp = PETSc.KSP().create(model.comm)
        self._ksp.setOptionsPrefix(_PREFIX)
        self._ksp.setType("cg")
        self._ksp.getPC().setType("pbjacobi")
        self._ksp.setTolerances(rtol=1e-14, max_it=1000)
        self._ksp.setOperators(matrix.mat)
        self._ksp.setFromOptions()

    def solve(self, load: np.ndarray) -> np.ndarray:
        """Return accelerations (owned, 3) [m/s2] for forces (owned, 3) [N], zero on prescribed components. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if the solver does not converge.
        """
        right = load.copy()
        self._supports.clear(right)
        self._right.array[:] = right.ravel()
        self._ksp.solve(self._right, self._left)
        reason = self._ksp.getConvergedReason()
        if reason < 0:
            raise SimulationFailure(
                f"the initial acceleration: no convergence after {self._ksp.getIterationNumber()} iterations with the "
                f"consistent mass matrix: {linear_reason(reason)}; check options -{_PREFIX}..., the densities and areas"
            )
        a = self._left.array.reshape(load.shape).copy()
        self._supports.clear(a)
        return a

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for thing in (self._ksp, self._right, self._left):
            thing.destroy()
        self._matrix.destroy()


@contextmanager
def reproducible_products(comm: MPI.Comm) -> Iterator[None]:
    """Make coarse matrices by sums in an order that does not depend on when messages arrive, unless options ask for
    another way."""
    options = PETSc.Options()
    ours = comm.size > 1 and not options.hasName("matptap_via")
    if ours:
        # PETSc's default sums contributions of other ranks in the order of arrival
        options["matptap_via"] = "allatonce_merged"
    yield
    if ours:
        options.delValue("matptap_via")


_TIE = 1e-6  # relative difference below which components count as equal


def first_largest(comm: MPI.Comm, numbers: np.ndarray, sizes: np.ndarray) -> int:
    """Return the local index of the largest of sizes (3 owned,) of components on all ranks, the first one by the mesh
    ``numbers`` (owned,) of nodes; -1 on the other ranks. Collective."""
    largest = comm.allreduce(float(sizes.max(initial=0.0)), op=MPI.MAX)
    near = np.flatnonzero(sizes >= (1.0 - _TIE) * largest)
    places = 3 * numbers[near // 3] + near % 3
    first = int(places.min(initial=np.iinfo(np.int64).max))
    found = comm.allreduce(first, op=MPI.MIN) == first and len(near) > 0
    return int(near[places.argmin()]) if found else -1


def basis_by_peaks(
    comm: MPI.Comm, numbers: np.ndarray, space: np.ndarray, rows: Sequence[np.ndarray] = ()
) -> list[np.ndarray]:
    """Return orthonormal coefficients (k,) of k combinations of vectors (k, owned, 3) that do not depend on which
    vectors span the space: first ``rows``, and then projections of single components. Collective.

    They are those of the component that has the largest within what is left, of these the first in the mesh.
    """
    rows, flat = list(rows), space.reshape(len(space), 3 * len(numbers))
    while len(rows) < len(space):
        left = flat - sum((np.outer(row, row @ flat) for row in rows), np.zeros_like(flat))
        at = first_largest(comm, numbers, np.sqrt((left**2).sum(axis=0)))
        peak = comm.allreduce(left[:, at].copy() if at >= 0 else np.zeros(len(space)))
        rest = without(peak, rows)
        rows.append(rest / np.linalg.norm(rest))
    return rows


def without(vector: np.ndarray, rows: Sequence[np.ndarray]) -> np.ndarray:
    """Return what is left of a vector without its components along orthonormal rows."""
    for _ in range(2):
        for row in rows:
            vector = vector - (row @ vector) * row
    return vector
