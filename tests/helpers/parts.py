"""A run on all ranks, the same run in two parts, and the same run on one rank."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from pfem_petsc import Case, Simulation

__all__ = ["last_rows"]


def last_rows(
    tables: Callable[[float], dict], every: int, comm: MPI.Comm, folder: Path
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Last rows of the history of a run to 0.03 s on all ranks, and on one rank: None but on rank 0.

    ``tables`` makes a case of an end time; checkpoints are written every so many steps. A run in two parts gives the
    same row bit for bit, one rank the same positions to 1e-10 of the size of 0.2 m.
    """
    found = {}
    for title, end in (("one", 0.03), ("two", 0.02), ("two", 0.03)):
        case = tables(end)
        case["output"]["checkpoint_every"] = every
        case = Case.from_dict(case, name="it")
        run = Simulation(case, comm, output=folder / title, quiet=True, restart=title == "two")
        found[title] = [step.row for step in run][-1]
        x = run.gather(run.state.position)
    for column, value in found["one"].items():
        np.testing.assert_array_equal(found["two"][column], value, err_msg=column)
    row = None
    if comm.rank == 0:
        alone = Simulation(case, MPI.COMM_SELF, output=folder / "alone", quiet=True)
        row = [step.row for step in alone][-1]
        assert np.abs(alone.gather(alone.state.position) - x).max() < 1e-10 * 0.2
    return found["one"], row
