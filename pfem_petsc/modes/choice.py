"""Choice of the library that solves the eigenvalue problem."""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING

from ..errors import InputError
from ..registry import lookup

if TYPE_CHECKING:
    from ..case.tables import Modes
    from ..stepping.model import Model

__all__ = ["SOLVERS", "available", "choose", "describe_modes", "solver_module"]

SOLVERS = "pfem_petsc.modes.eigen"
LIBRARIES = {"slepc": "slepc4py.SLEPc", "scipy": "scipy.sparse.linalg"}
DENSE_UP_TO = 600
"""Maximum number of components for which NumPy computes all eigenvalues, faster than an iteration."""
DENSE_AT_MOST = 6_000
"""Maximum number of components for NumPy without a library for sparse matrices: about 2 minutes and 1 GB."""
_PART = 0.2  # of all modes, from which on computing all of them takes less time than iterations
GATHERED_AT_MOST = 300_000
"""Maximum number of components for which matrices are gathered on one rank for SciPy."""


@cache
def available(package: str) -> bool:
    """Return whether a library is installed and can be loaded; PETSc must be initialised before."""
    try:
        importlib.import_module(package)
    except ImportError:
        return False
    return True


def describe_modes(model: Model) -> dict[str, str]:
    """Return label and text of the modes that a case requests, empty if none. Collective.

    Raises
    ------
    InputError
        On all ranks, if no suitable library is installed.
    """
    case = model.case
    if case.modes is None:
        return {}
    free = 3 * model.mesh.n_nodes - model.comm.allreduce(model.supports.number)
    name = choose(case.modes, free, case.source)
    what = "natural vibrations" if case.modes.kind == "vibration" else "buckling modes"
    mass = f", {case.modes.mass or case.mass} mass" if case.modes.kind == "vibration" else ""
    return {"modes": f"{min(case.modes.count, free)} {what} of the state at the end{mass}, solver {name}"}


def choose(settings: Modes, free: int, source: str) -> str:
    """Return the name of the solver for a number of free components.

    Parameters
    ----------
    settings : table ``[modes]``
    free : number of free components
    source : file of the case, for the message

    Raises
    ------
    InputError
        If no installed library can solve a problem of this size.
    """
    asked, most = settings.solver, min(settings.count, free)
    if asked == "auto":
        if free <= DENSE_UP_TO or (free <= DENSE_AT_MOST and most > _PART * free):
            return "dense"
        if available(LIBRARIES["slepc"]):
            return "slepc"
        if free <= GATHERED_AT_MOST and available(LIBRARIES["scipy"]):
            return "scipy"
        if free <= DENSE_AT_MOST:
            return "dense"
        raise InputError(
            f"{source}: modes: {free:,} free components need slepc4py, which is not installed (Debian, Ubuntu: "
            "python3-slepc4py-real and the version of PETSc; scripts/setup.sh installs it), or up to "
            f"{GATHERED_AT_MOST:,} of them scipy (pip install scipy)"
        )
    limits = {"dense": DENSE_AT_MOST, "scipy": GATHERED_AT_MOST}
    if asked in limits and free > limits[asked]:
        raise InputError(
            f'{source}: modes.solver = "{asked}": {free:,} free components exceed its limit of '
            f'{limits[asked]:,}; use "slepc" or "auto"'
        )
    if asked in LIBRARIES and not available(LIBRARIES[asked]):
        package = LIBRARIES[asked].partition(".")[0]
        raise InputError(f'{source}: modes.solver = "{asked}": {package} is not installed; install it, or use "auto"')
    return asked


def solver_module(name: str) -> ModuleType:
    """Return the module of a solver, with ``largest(problem, count, start)`` and ``definite(problem)``."""
    return lookup(SOLVERS, name, "modes.solver")
