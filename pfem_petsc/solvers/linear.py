"""Which linear solver a Newton step uses, from the case and the model alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

from petsc4py import PETSc

from ..errors import InputError

__all__ = ["LinearChoice", "choose_linear", "configure", "set_preconditioner", "unsymmetric"]

_DIRECT_BELOW = 500  # unknowns; a lattice of 3,993 takes 0.22 s to factorise, and 1 to 4 ms with conjugate gradients
# Steps over the explicit limit up to which each is chosen. scripts/linear_solvers.py, 101,706 bars on one core, seconds
# a Newmark step at 1, 10, 100, 1000 x: matrix-free Jacobi 0.015, 0.046, 0.13, 0.15; point-block Jacobi 0.091, 0.16,
# 0.30, 0.36; incomplete Cholesky 0.082, 0.15, 0.34, 0.42; multigrid 0.55, 0.60, 0.58, 0.60 (docs/linear_solvers.md).
_MATRIX_FREE_UP_TO = 3000.0
_JACOBI_UP_TO = 5.0
_CHOLESKY_UP_TO = 50.0


@dataclass(frozen=True)
class LinearChoice:
    """A Krylov method and preconditioner, with or without a matrix, and the words that the log shows."""

    krylov: str
    preconditioner: str
    why: str
    matrix_free: bool = False

    @property
    def lagged(self) -> bool:
        """Whether the preconditioner has a matrix of its own, of an earlier iteration."""
        return self.preconditioner == "gamg" or (self.matrix_free and self.preconditioner == "lu")


def choose_linear(
    request: str, unknowns: int, step_ratio: float, symmetric: bool = True, operator: str = "auto"
) -> LinearChoice:
    """Resolve ``solver.linear`` and ``solver.operator``.

    Parameters
    ----------
    request : str
        ``auto``, ``cg``, ``gamg`` or ``mumps``.
    unknowns : int
        Of the whole model.
    step_ratio : float
        Time step over the critical step of central differences: how much stiffness weighs against mass.
    symmetric : bool
        Whether the matrix is; GMRES and incomplete LU stand in for conjugate gradients and Cholesky where it is not.
    operator : str
        ``auto``, ``assembled`` or ``matrix_free``.

    Raises
    ------
    InputError
        Where an operator without matrix is asked for together with what needs one.
    """
    if operator == "matrix_free" and not symmetric:
        raise InputError('solver.operator = "matrix_free": this integrator needs a matrix; take "assembled" or "auto"')
    free = operator != "assembled" and symmetric
    if operator == "matrix_free" and request in ("gamg", "mumps"):
        kind, words = ("gamg", "multigrid") if request == "gamg" else ("lu", "factorisation")
        return LinearChoice("cg", kind, f"conjugate gradients, lagged {words}, matrix-free (asked for)", True)
    if request == "mumps" or (request == "auto" and operator != "matrix_free" and unknowns <= _DIRECT_BELOW):
        why = "asked for" if request != "auto" else f"{unknowns} unknowns, at most {_DIRECT_BELOW}"
        return LinearChoice("preonly", "lu", f"direct ({why})")
    krylov, method = ("cg", "conjugate gradients") if symmetric else ("gmres", "GMRES")
    if request == "gamg":
        return LinearChoice(krylov, "gamg", f"{method}, multigrid (asked for)")
    ratio = f"step is {step_ratio:.3g} x the explicit limit"
    if free and (operator == "matrix_free" or request == "cg" or step_ratio <= _MATRIX_FREE_UP_TO):
        return LinearChoice(krylov, "jacobi", f"{method}, Jacobi, matrix-free ({ratio})", matrix_free=True)
    if request == "cg" or step_ratio <= _JACOBI_UP_TO:
        return LinearChoice(krylov, "pbjacobi", f"{method}, point-block Jacobi ({ratio})")
    if step_ratio <= _CHOLESKY_UP_TO:
        if symmetric:
            return LinearChoice(krylov, "icc", f"{method}, incomplete Cholesky ({ratio})")
        return LinearChoice(krylov, "ilu", f"{method}, incomplete LU ({ratio})")
    return LinearChoice(krylov, "gamg", f"{method}, multigrid ({ratio})")


def unsymmetric(choice: LinearChoice) -> LinearChoice:
    """The same choice for a matrix that is not symmetric."""
    if choice.krylov == "preonly":
        return choice
    preconditioner = "ilu" if choice.preconditioner == "icc" else choice.preconditioner
    return replace(choice, krylov="gmres", preconditioner=preconditioner)


def configure(ksp: PETSc.KSP, choice: LinearChoice, reduced: bool, ours: object = None) -> None:
    """Set a linear solver up; options of the same prefix given by the user override it afterwards.

    Parameters
    ----------
    ksp : the solver
    choice : what it is to be
    reduced : whether it works on the inactive unknowns of a contact problem, whose matrix has no blocks
    ours : a preconditioner of our own that PETSc is to call, instead of the choice's
    """
    ksp.setType(choice.krylov)
    if choice.krylov == "gmres":
        ksp.setGMRESRestart(100)
    if choice.krylov != "preonly":
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        # 101,706 bars at 2 x the explicit limit: 1e-5, 1e-4, 1e-3, 1e-2 took 30.0, 29.4, 27.0, 35.7 ms a step
        ksp.setTolerances(rtol=1e-3, max_it=2000 if ours is None else 500)
    if ours is None:
        set_preconditioner(ksp.getPC(), choice.preconditioner, reduced)
    else:
        ksp.getPC().setType("python")
        ksp.getPC().setPythonContext(ours)


def set_preconditioner(pc: PETSc.PC, kind: str, reduced: bool = False) -> None:
    """Make a preconditioner one of the kinds of :class:`LinearChoice`, with our defaults for its options."""
    comm = pc.comm
    if kind == "lu":
        pc.setType("lu")
        if comm.size > 1:
            if _has_mumps():
                pc.setFactorSolverType("mumps")
            else:
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


def _has_mumps() -> bool:
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
