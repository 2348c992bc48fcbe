"""Runs with the fields of their last snapshot."""

from __future__ import annotations

import numpy as np

from pfem_petsc import Simulation, open_result


def run(case, comm, folder):
    """Run a case; its history and the fields of its last snapshot, the same on all ranks."""
    with Simulation(case, comm, output=folder, quiet=True) as simulation:
        assert simulation.run() == 0
    found = None
    if comm.rank == 0:
        result = open_result(folder)
        history = {name: np.asarray(result.history[name]) for name in result.history}
        found = history, {name: result.field(name, -1) for name in result.cell_fields}
    return comm.bcast(found)
