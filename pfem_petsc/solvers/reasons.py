"""PETSc's reasons for stopping, in words."""

from __future__ import annotations

from petsc4py import PETSc

__all__ = ["is_failed_factorisation", "linear_reason", "newton_reason"]

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


def _name(table: type, reason: int) -> str:
    names = [name for name in dir(table) if not name.startswith("_") and getattr(table, name) == reason]
    return next(iter(sorted(names, key=lambda name: not name.startswith(("DIVERGED", "CONVERGED")))), str(reason))


def _words(table: type, known: dict[str, str], reason: int) -> str:
    name = _name(table, reason)
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
