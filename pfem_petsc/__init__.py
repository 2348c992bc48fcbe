"""Dynamics and statics of large trusses: positional finite elements on PETSc over MPI.

``from pfem_petsc import Case, Simulation, Truss, open_result, write_mesh``; these names are imported lazily, at their
first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .case.schema import Case
    from .errors import EarlyStop, InputError, NotConverged, PfemError, SimulationFailure
    from .mesh.generators.arrays import Truss, write_mesh
    from .output.result import open_result
    from .output.table import Table
    from .simulation import Simulation
    from .studies import sweep

__all__ = [
    "Case",
    "EarlyStop",
    "InputError",
    "NotConverged",
    "PfemError",
    "Simulation",
    "SimulationFailure",
    "Table",
    "Truss",
    "__version__",
    "open_result",
    "sweep",
    "write_mesh",
]

_HOMES = {
    "Case": ".case.schema",
    **dict.fromkeys(("EarlyStop", "InputError", "NotConverged", "PfemError", "SimulationFailure"), ".errors"),
    "Truss": ".mesh.generators.arrays",
    "Simulation": ".simulation",
    "Table": ".output.table",
    "open_result": ".output.result",
    "sweep": ".studies",
    "write_mesh": ".mesh.generators.arrays",
}


def __getattr__(name: str) -> Any:
    """Import an exported name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module(_HOMES[name], __name__), name)
    except (ValueError, ImportError) as error:
        from .errors import NUMPY_REMEDY, InputError, lacking_module, numpy_is_too_new

        if numpy_is_too_new(error):
            raise InputError(NUMPY_REMEDY) from error
        if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith(__name__):
            raise InputError(lacking_module(error)) from error
        raise
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
