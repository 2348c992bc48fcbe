"""Pairs are distributed with their nodes: no array of the size of all pairs, and the results of one rank."""

import numpy as np
import pytest
from helpers.lattices import planes, simulation, two_lattices
from mpi4py import MPI

CASES = {
    "explicit": ("central_differences", False, {}),
    "explicit, supported": ("chung_lee", False, {"supports": [{"node_set": "held", "fix": "y"}]}),
    "explicit, stick": ("chung_lee", False, {"contact": {"treatment": "stick"}}),
    "in several pairs": ("central_differences", True, {}),
    "in several pairs and on walls": (
        "central_differences",
        True,
        {"wall": planes([[0.0, 0.1, 1.0], [0.1, 1.0, -0.2]], [-0.001, -0.04])},
    ),
    "implicit": ("newmark", False, {"solver": {"rtol": 1e-13}}),
    "implicit, conserving": ("newmark", False, {"solver": {"rtol": 1e-13}, "contact": {"treatment": "conserving"}}),
    "implicit, stick": ("newmark", False, {"solver": {"rtol": 1e-13}, "contact": {"treatment": "stick"}}),
    "implicit, on walls": (
        "newmark",
        False,
        {"solver": {"rtol": 1e-13}, "wall": planes([[0.0, 0.1, 1.0]], [-0.001])},
    ),
}


@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_ranks_give_what_one_gives(name, comm, shared_tmp_path):
    integrator, crowded, tables = CASES[name]
    tables = {key: value for key, value in tables.items() if key != "wall"}
    case = two_lattices(shared_tmp_path / "m.vtu", integrator, step=5e-4, end=0.008, **tables)
    case["wall"] = CASES[name][2].get("wall", [])
    if crowded:
        case["contact_pair"].append({**case["contact_pair"][0], "name": "across", "direction": [1.0, -0.4, 0.3]})
    run = simulation(case, comm, shared_tmp_path, "ranks")
    cut = comm.allreduce(int((run.model.links.two.nodes < 0).sum()))
    assert comm.size < 3 or cut > 0
    rows = [step.row for step in run]
    alone = simulation(case, MPI.COMM_SELF, shared_tmp_path, f"alone{comm.rank}")
    others = [step.row for step in alone]
    assert max(abs(row["pair/faces/force"]).max() for row in rows) > 0.1
    for row, other in zip(rows, others, strict=True):
        for key in ("pair/faces/force", "pair/faces/impulse", "pair/faces/jump_impulse", "momentum"):
            np.testing.assert_allclose(row[key], other[key], atol=1e-9 * max(1.0, np.abs(other[key]).max()))
        assert row["active_contacts"] == other["active_contacts"]
        assert row["impact_dissipation"] == pytest.approx(other["impact_dissipation"], abs=1e-12)
    x, y = run.gather(run.state.position), alone.gather(alone.state.position)
    if comm.rank == 0:
        np.testing.assert_allclose(x, y, atol=1e-11)
