"""Rows that come and go from step to step: on any ranks, over restarts, in explicit and implicit steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.stopped import assert_restart_is_bitwise
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result

PLUGIN = Path(__file__).parents[1] / "helpers" / "random_rows.py"
STEPS = 60
EXPLICIT = ("time.step=1e-4", f"time.end={STEPS}e-4")
IMPLICIT = ("time.integrator=generalized_alpha", "time.step=2e-4", f"time.end={2 * STEPS // 2}e-4")
SCHEMES = {
    "explicit": EXPLICIT,
    "implicit, matrix-free": (*IMPLICIT, "solver.operator=matrix_free", "solver.linear=cg"),
    "implicit, assembled": (*IMPLICIT, "solver.operator=assembled", "solver.linear=cg"),
}


def case_of(scheme: str, row: str = "nodes=2") -> Case:
    """A lattice that tumbles freely, with rows that live for three steps or more."""
    rows = f'{{name="random", kind="random_rows", interval=3e-4, {row}}}'
    keys = ["mesh.cells=[2,2,1]", "node_set.corner.nearest=[0.1,0.1,0.05]", f"constraint=[{rows}]"]
    keys += ["output.fields_every=10", "solver.rtol=1e-12", *SCHEMES[scheme]]
    return Case.load("tumbling_lattice", keys, plugins=[PLUGIN])


@pytest.mark.parallel
@pytest.mark.parametrize("row", ["nodes=2", "straight=true", "nodes=3"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_rows_that_come_and_go_hold_and_conserve_momentum(scheme, row, comm, shared_tmp_path):
    """No row is violated while it is there, forces are between nodes, and all ranks find the results of one."""
    folders = shared_tmp_path / "ranks", shared_tmp_path / f"alone-{comm.rank}"
    sets, pressed, away = set(), 0, 0
    with Simulation(case_of(scheme, row), comm, output=folders[0], quiet=True) as run:
        for _ in run:
            links, stepper = run.model.links, run.stepper
            x = links.rows.gather(stepper.balance.predictor + stepper.solution.u)
            slack = 1e-9 * run.model.size
            assert links.rows.values(x).min(initial=0.0) >= -slack
            assert np.abs(links.rows.values(x)[links.force > 0.0]).max(initial=0.0) <= slack
            sets.add(id(links.rows))
            pressed += comm.allreduce(int((links.force > 0.0)[links.rows.counted].sum()))
            away += comm.allreduce(int(links.rows.counted.sum())) - len(links.rows.source)
    assert len(sets) > 5 and pressed > 10
    # a rank has the rows of its nodes, and of groups of which it has nodes
    assert comm.size == 1 or row != "straight=true" or comm.allreduce(away) > 0
    with Simulation(case_of(scheme, row), MPI.COMM_SELF, output=folders[1], quiet=True) as run:
        run.run()
    found, alone = (open_result(folder).history for folder in folders)
    momentum = found["momentum"]
    assert np.abs(momentum - momentum[0]).max() <= 1e-9 * np.abs(momentum[0]).max()
    for name in ("kinetic_energy", "elastic_energy", "constraint/random/force"):
        np.testing.assert_allclose(found[name], alone[name], rtol=0, atol=1e-6 * np.abs(alone[name]).max())
    assert np.abs(found["energy_imbalance"]).max() <= 1e-6 * found["kinetic_energy"][0]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("scheme", SCHEMES)
def test_restart_among_rows_that_come_and_go_is_bitwise(scheme, comm, shared_tmp_path):
    """Also where rows have lived for a step only: their bounds, forces, and what the search remembers are kept."""
    # PETSc adds the parts of a product of matrices in the order in which they come from other ranks
    allowed = 1e-9 if scheme == "implicit, assembled" and comm.size > 2 else 0.0
    stops = (20, 41) if scheme == "explicit" else (10, 21)  # of 60 steps, or 30
    assert_restart_is_bitwise(case_of(scheme), comm, shared_tmp_path, *stops, allowed=allowed)
