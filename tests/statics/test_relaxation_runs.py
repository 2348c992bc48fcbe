"""Runs of dynamic relaxation: restarts, ranks, increments that fail, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cables import chain, heavy_cable, run
from mpi4py import MPI

from pfem_petsc import Case, open_result
from pfem_petsc.errors import InputError, SimulationFailure

pytestmark = pytest.mark.parallel

INCREMENTS = [
    *("static.step=0.25", "mesh.cells=[4, 4]", "output.checkpoint_every=1", "output.fields_every=1"),
]
FLOOR = "wall=[{name='floor', type='plane', point=[0.0, 0.0, -2.3], normal=[0.0, 0.0, 1.0]}]"


@pytest.mark.parametrize("newton", [True, False])
def test_ranks_agree(comm, shared_tmp_path, newton):
    keys = [*INCREMENTS, FLOOR, "material.rope.young_modulus=1e7", "static.step=0.5"]
    keys += [f"static.newton={str(newton).lower()}", "static.tolerance=1e-11"]
    row, x = run(Case.load("hanging_net", keys), comm, shared_tmp_path / "all")
    alone = None
    if comm.rank == 0:
        alone = run(Case.load("hanging_net", keys), MPI.COMM_SELF, shared_tmp_path / "one")
    alone, places = comm.bcast(alone)
    assert np.abs(x - places).max() < 1e-8 * 10.0
    for name in ("elastic_energy", "wall/floor/force", "support_force"):
        assert row[name] == pytest.approx(alone[name], rel=1e-7, abs=1e-6)


def test_what_does_not_settle_ends_with_its_residual(comm, shared_tmp_path):
    with pytest.raises(SimulationFailure) as failure:
        run(heavy_cable(10, step=0.5, max_iterations=50), comm, shared_tmp_path / "out")
    assert failure.value.exit_status == 3
    text = str(failure.value)
    for part in ("load factor 0.5", "50 pseudo-steps", "residual", "required", "worst at node", "max_iterations"):
        assert part in text
    assert list(open_result(shared_tmp_path / "out").history["load_factor"]) == [0.0]


def test_crushed_bars_end_the_run_on_all_ranks(comm, shared_tmp_path):
    case = chain(shared_tmp_path, comm, [[0, 0, 0], [1, 0, 0]], support=[
        {"node_set": "at0", "fix": "xyz"}, {"node_set": "at1", "fix": "yz"}],
        load=[{"node_set": "at1", "force": [-1e6, 0, 0]}])  # fmt: skip
    with pytest.raises(SimulationFailure, match="bar 0 collapsed"):
        run(case, comm, shared_tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wall": [{"name": "floor", "type": "plane", "point": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0],
                    "friction": 0.2}]}, "wall 'floor': friction"),
        ({"contact_pair": [{"name": "pair", "first": "at1", "second": "at2", "direction": [1.0, 0.0, 0.0]}]},
         r"does not support \[\[contact_pair\]\]"),
        ({"static": {"method": "relaxation", "damping": "viscous"}}, "static.damping"),
        ({"static": {"method": "relaxation", "tolerance": 2.0}}, "static.tolerance"),
    ],
)  # fmt: skip
def test_refusals(comm, shared_tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        run(chain(shared_tmp_path, comm, [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], **change), comm,
            shared_tmp_path / "out")  # fmt: skip
