"""Contact pairs whose nodes walls stop too."""

import numpy as np
import pytest
from helpers.lattices import planes, rotation, simulation, two_lattices, two_rods

from pfem_petsc import Case, Simulation, open_result


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    "solver", [{"operator": "matrix_free"}, {"linear": "gamg"}, {"linear": "gamg", "operator": "matrix_free"}], ids=str
)
def test_lattices_in_a_wedge(solver, comm, shared_tmp_path):
    """Walls that stop every node, those of pairs as well, against a direct solution in another frame."""
    turn, found = rotation(6), []
    for k, (frame, keys) in enumerate([(np.eye(3), {"linear": "mumps"}), (turn, solver)]):
        options = {"turn": frame, "step": 1e-3, "end": 0.04, "solver": {"rtol": 1e-12, **keys}}
        case = two_lattices(shared_tmp_path / f"{k}.vtu", "newmark", **options)
        case["wall"] = planes(np.array([[0.0, 0.3, 1.0], [0.1, 1.0, -0.2]]) @ frame.T, [-0.002, -0.04])
        run = simulation(case, comm, shared_tmp_path, f"r{k}")
        rows = [step.row for step in run]
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10
        names = ["pair/faces/force", "wall/wall1/force", "wall/wall2/force"]
        forces = np.array([[row[name] for name in names] for row in rows]) @ frame
        assert (np.abs(forces).max(axis=2) > 0.0).all(axis=1).any()  # at once
        found.append((forces, run.gather(run.state.position)))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-8 * np.abs(found[0][0]).max())
    if comm.rank == 0:
        np.testing.assert_allclose(found[1][1] @ turn, found[0][1], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("linear", ["mumps", "gamg"])
def test_a_wall_while_pairs_are_apart(linear, comm, shared_tmp_path):
    """The first rod springs back to a wall behind it, with the second one far away: few iterations, as for the pair."""
    found = []
    for name in ("cg", linear):
        case = two_rods("newmark", linear=name)
        case["node_set"]["back"] = {"nearest": [0.0, 0, 0]}
        case["wall"] = [
            {"name": "back", "type": "plane", "point": [-0.02, 0, 0], "normal": [1.0, 0, 0], "node_set": "back"}
        ]
        run = simulation(case, comm, shared_tmp_path, name)
        rows = [step.row for step in run]
        apart = [row for row in rows if row["wall/back/force"][0] > 0.0 and row["time"] > 3.0]
        assert len(apart) > 5 and all(row["pair/faces/force"][0] == 0.0 for row in apart)
        assert max(row["newton_iterations"] for row in apart) <= 4
        found.append(run.gather(run.state.position))
    np.testing.assert_allclose(found[1], found[0], atol=1e-10)


def test_walls_stop_nodes_beside_pairs(tmp_path):
    """Nodes in no pair meet a wall in the same explicit run, whose steps nothing interrupts."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "two_rods", "length": 1.0, "elements": 5, "gap": 0.001},
            "material": {"it": {"young_modulus": 1e6, "density": 1000.0}},
            "section": {"it": {"area": 1e-4, "material": "it"}},
            "node_set": {name: {"group": name} for name in ("start", "first_end", "second_start")},
            "initial": {"velocity": [-0.5, 0.0, 0.0]},
            "contact_pair": [
                {"name": "faces", "first": "first_end", "second": "second_start", "direction": [1.0, 0.0, 0.0]}
            ],
            "wall": [
                {"name": "wall", "type": "plane", "node_set": "start", "point": [-0.01, 0, 0], "normal": [1, 0, 0]}
            ],
            "time": {"integrator": "central_differences", "step": 1e-4, "end": 0.15},
            "output": {"fields_every": 0, "history_every": 500},
        }
    )
    run = Simulation(case, output=tmp_path / "it", quiet=True)
    assert run.run() == 0
    history = open_result(run.folder).history
    assert history["wall/wall/impulse"][-1, 0] > 0.0
    assert run.state.x[0, 0] >= -0.01 - 1e-9
    moved = history["momentum"] - history["momentum"][0]
    np.testing.assert_allclose(
        moved, history["wall/wall/impulse"] + history["wall/wall/jump_impulse"], atol=1e-12 * np.abs(moved).max()
    )
