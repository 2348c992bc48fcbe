"""Rows that come and go from step to step: on any ranks, over restarts, in explicit and implicit steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.kills import differences
from helpers.stopped import everywhere
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


def case_of(scheme: str, straight: bool, *more: str) -> Case:
    """A lattice that tumbles freely, with rows that live for three steps or more."""
    rows = f'{{name="random", kind="random_rows", interval=3e-4, straight={str(straight).lower()}}}'
    keys = ["mesh.cells=[2,2,1]", "node_set.corner.nearest=[0.1,0.1,0.05]", f"constraint=[{rows}]"]
    keys += ["output.fields_every=10", "solver.rtol=1e-12", *SCHEMES[scheme], *more]
    return Case.load("tumbling_lattice", keys, plugins=[PLUGIN])


@pytest.mark.parallel
@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_rows_that_come_and_go_hold_and_conserve_momentum(scheme, straight, comm, shared_tmp_path):
    """No row is violated while it is there, forces are between nodes, and all ranks find the results of one."""
    folders = shared_tmp_path / "ranks", shared_tmp_path / f"alone-{comm.rank}"
    sets, pressed = set(), 0
    with Simulation(case_of(scheme, straight), comm, output=folders[0], quiet=True) as run:
        for _ in run:
            links, stepper = run.model.links, run.stepper
            x = links.rows.gather(stepper.balance.predictor + stepper.solution.u)
            slack = 1e-9 * run.model.size
            assert links.rows.values(x).min(initial=0.0) >= -slack
            assert np.abs(links.rows.values(x)[links.force > 0.0]).max(initial=0.0) <= slack
            sets.add(id(links.rows))
            pressed += comm.allreduce(int((links.force > 0.0)[links.rows.counted].sum()))
    assert len(sets) > 5 and pressed > 10
    with Simulation(case_of(scheme, straight), MPI.COMM_SELF, output=folders[1], quiet=True) as run:
        run.run()
    found, alone = (open_result(folder).history for folder in folders)
    momentum = found["momentum"]
    assert np.abs(momentum - momentum[0]).max() <= 1e-9 * np.abs(momentum[0]).max()
    for name in ("kinetic_energy", "elastic_energy", "constraint/random/force"):
        np.testing.assert_allclose(found[name], alone[name], rtol=0, atol=1e-6 * np.abs(alone[name]).max())
    assert np.abs(found["energy_imbalance"]).max() <= 1e-6 * found["kinetic_energy"][0]


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", SCHEMES)
def test_restart_among_rows_that_come_and_go_is_bitwise(scheme, comm, shared_tmp_path):
    """Also where rows have lived for a step only: their bounds, forces, and what the search remembers are kept."""
    folders = shared_tmp_path / "whole", shared_tmp_path / "stopped"
    with Simulation(case_of(scheme, False), comm, output=folders[0], quiet=True) as run:
        run.run()
    end = float(case_of(scheme, False).time.end)
    for part, restart in ((20 / STEPS, False), (41 / STEPS, True), (1.0, True)):
        case = case_of(scheme, False, f"time.end={part * end:.17g}")
        with Simulation(case, comm, output=folders[1], quiet=True, restart=restart) as run:
            run.run()
    found = everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders))
    if scheme == "implicit, assembled" and comm.size > 2:
        # PETSc adds the parts of a product of matrices in the order in which they come from other ranks
        assert found.get("VTKHDF/PointData/displacement", 0.0) <= 1e-9
    else:
        assert found == {}
