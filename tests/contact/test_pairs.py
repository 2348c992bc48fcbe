"""Contact between bodies: two rods that collide are the rod against the plane of symmetry."""

import numpy as np
import pytest
from lattices import simulation

from pfem_petsc.errors import InputError

SCHEMES = ["central_differences", "chung_lee", "hulbert_chung"]


def two_rods(integrator, **pair):
    """Equal rods that fly at each other; wave speed 1, gap 0.1."""
    return {
        "mesh": {"generator": "two_rods", "length": 1.0, "elements": 10, "gap": 0.1},
        "node_set": {
            "left": {"group": "first_end"},
            "right": {"group": "second_start"},
            "second": {"box": [[1.05, -1, -1], [3, 1, 1]]},
        },
        "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "initial": {"velocity": [0.1, 0, 0], "on": [{"node_set": "second", "velocity": [-0.1, 0, 0]}]},
        "contact_pair": [{"name": "faces", "first": "left", "second": "right", "direction": [2.0, 0, 0], **pair}],
        "time": {"integrator": integrator, "step": 0.02, "end": 4.0},
        "output": {"fields_every": 0},
    }


def half(integrator):
    case = two_rods(integrator)
    case["mesh"] = {"generator": "rod", "length": 1.0, "elements": 10}
    case["node_set"] = {"left": {"group": "end"}}
    case["initial"] = {"velocity": [0.1, 0, 0]}
    del case["contact_pair"]
    case["wall"] = [
        {"type": "plane", "name": "symmetry", "point": [1.05, 0, 0], "normal": [-1.0, 0, 0], "node_set": "left"}
    ]
    return case


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", SCHEMES)
def test_two_rods_are_the_symmetric_model(integrator, comm, shared_tmp_path):
    both = simulation(two_rods(integrator), comm, shared_tmp_path, "both")
    rows = [step.row for step in both]
    one = simulation(half(integrator), comm, shared_tmp_path, "one")
    others = [step.row for step in one]
    force = np.array([row["pair/faces/force"] for row in rows])
    wall = np.array([row["wall/symmetry/force"] for row in others])
    assert np.abs(wall).max() > 0.1
    np.testing.assert_allclose(force, -wall, atol=1e-9)
    x, y = both.gather(both.state.position), one.gather(one.state.position)
    if comm.rank == 0:
        np.testing.assert_allclose(x[:11], y, atol=1e-9)
        np.testing.assert_allclose(2.1 - x[11:][::-1, 0], y[:, 0], atol=1e-9)
    for row in rows:  # momentum of both together, and the ledger
        assert abs(row["momentum"][0]) < 1e-13
        assert abs(row["energy_imbalance"]) < 1e-12
    assert max(row["active_contacts"] for row in rows) == 2


def test_unequal_bodies_keep_momentum(comm, shared_tmp_path):
    case = two_rods("central_differences")
    case["section"] = {"s": {"area": 1.0, "material": "m", "bars": "first"}, "t": {"area": 3.0, "material": "m"}}
    rows = [step.row for step in simulation(case, comm, shared_tmp_path)]
    momentum = np.array([row["momentum"][0] for row in rows])
    np.testing.assert_allclose(momentum, 0.1 - 0.3, atol=1e-13)
    assert rows[-1]["pair/faces/force"][0] == 0.0 and max(row["pair/faces/force"][0] for row in rows) > 0.1


@pytest.mark.parametrize(
    "change, message",
    [
        ({"direction": [0.0, 0, 0]}, "zero length"),
        ({"direction": [-1.0, 0, 0]}, "beyond each other"),
        ({"gap": 0.2}, "beyond each other"),
        ({"second": "second"}, "first has 1 nodes and second 11"),
        ({"second": "rigt"}, "no node set of this name"),
        ({"second": "left"}, "several pairs"),
    ],
)
def test_refusals(change, message, comm, shared_tmp_path):
    with pytest.raises(InputError, match=message):
        simulation(two_rods("central_differences", **change), comm, shared_tmp_path)


def test_needs_explicit_steps_and_no_wall(comm, shared_tmp_path):
    with pytest.raises(InputError, match="needs an explicit integrator"):
        simulation(two_rods("newmark"), comm, shared_tmp_path)
    case = two_rods("central_differences")
    case["wall"] = [{"type": "plane", "point": [-1.0, 0, 0], "normal": [1.0, 0, 0]}]
    with pytest.raises(InputError, match="a wall stops it as well"):
        simulation(case, comm, shared_tmp_path)
