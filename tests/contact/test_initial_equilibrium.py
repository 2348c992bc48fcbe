"""A truss that lies on a wall stays at rest from the first row, with its weight as the wall's force."""

import h5py
import numpy as np
import pytest
from helpers.runs import GRAVITY, SCHEMES
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.output.result import open_result

CASE = """
[mesh]
generator = "rod"
length = 1.0
elements = 4
[material.it]
young_modulus = 1e9
density = 1000.0
[section.it]
area = 1e-4
material = "it"
[gravity]
acceleration = [0.0, 0.0, -{gravity}]
[initial]
velocity = {velocity}
[[wall]]
name = "floor"
type = "plane"
point = [0.3, 0.0, 0.0]
normal = [0.0, 0.0, 2.5]
[time]
integrator = "{scheme}"
mass = "{mass}"
step = 5e-5
end = 2e-3
"""


def lie(scheme, mass, folder, velocity="[0.0, 0.0, 0.0]"):
    """History and last positions of a rod that starts on a floor."""
    case = Case.from_toml(CASE.format(scheme=scheme, mass=mass, gravity=GRAVITY, velocity=velocity))
    Simulation(case, MPI.COMM_WORLD, output=folder, quiet=True).run()
    read = None
    if MPI.COMM_WORLD.rank == 0:
        with open_result(folder) as result:
            read = {name: np.array(result.history[name]) for name in result.history}, result.positions(-1)
    return MPI.COMM_WORLD.bcast(read)


@pytest.mark.parallel
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_weight_from_the_start(scheme, mass, shared_tmp_path):
    history, end = lie(scheme, mass, shared_tmp_path)
    weight = 1000.0 * 1e-4 * GRAVITY
    np.testing.assert_allclose(history["wall/floor/force"][:, 2], weight, rtol=1e-9)
    assert (history["active_contacts"] == 5).all()
    assert history["kinetic_energy"].max() <= 1e-24 * weight  # J: the jolt of a step without the floor is 1e-7 of it
    assert np.abs(end[:, 2]).max() <= 1e-18


@pytest.mark.parametrize("scheme", ["central_differences", "energy_momentum"])
def test_a_truss_that_leaves_falls_freely(scheme, shared_tmp_path):
    """Touching a wall is no rest: z = v t - g t^2/2 from the first step on."""
    history, end = lie(scheme, "lumped", shared_tmp_path, "[0.0, 0.0, 0.5]")
    time = history["time"][-1]
    np.testing.assert_allclose(end[:, 2], 0.5 * time - 0.5 * GRAVITY * time**2, rtol=1e-12)
    assert not history["wall/floor/force"].any()


def stacked(scheme, mass, folder, comm, floor=False):
    """A rod that lies along another one, which is held, or lies on a floor: each node on one of the lower."""
    n = 5
    x = np.linspace(0.0, 1.0, n)
    points = np.concatenate([np.stack([x, 0.0 * x, z + 0.0 * x], axis=1) for z in (0.0, 0.1)])
    bars = [(i + k, i + k + 1) for k in (0, n) for i in range(n - 1)]
    if comm.rank == 0:
        with h5py.File(folder / "mesh.h5", "w") as file:
            file["points"], file["bars"] = points, bars
    comm.Barrier()
    data = {
        "mesh": {"file": "mesh.h5"},
        "node_set": {"lower": {"indices": list(range(n))}, "upper": {"indices": list(range(n, 2 * n))}},
        "material": {"it": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"it": {"area": 1e-4, "material": "it"}},
        "gravity": {"acceleration": [0.0, 0.0, -GRAVITY]},
        "support": [{"node_set": "lower", "fix": "xyz"}],
        "contact_pair": [{"name": "p", "first": "lower", "second": "upper", "direction": [0, 0, 1.0], "gap": 0.1}],
        "time": {"integrator": scheme, "mass": mass, "step": 5e-5, "end": 1e-3},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-12},
    }
    if floor:
        del data["support"]
        data["wall"] = [{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}]
    return Simulation(Case.from_dict(data, folder=folder), comm, output=folder / "it", quiet=True)


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", SCHEMES)
def test_rods_in_a_pile_stay_there(scheme, comm, shared_tmp_path):
    """The lower one on a floor that stops every node, the upper one on it."""
    run = stacked(scheme, "lumped", shared_tmp_path, comm, floor=True)
    weight = 0.1 * GRAVITY
    run.start()
    assert comm.allreduce(run.stepper.solution.contacts) == 10
    for row in [step.row for step in run]:
        assert row["pair/p/force"] == pytest.approx([0.0, 0.0, weight], rel=1e-8)
        assert row["wall/floor/force"] == pytest.approx([0.0, 0.0, 2.0 * weight], rel=1e-8)
        assert row["active_contacts"] == 10
    assert np.abs(run.state.v).max(initial=0.0) < 1e-12


BELTS = {
    "velocity": [{"velocity": [1.0, 0.0, 0.0]}, 1.0],
    "backwards": [{"velocity": [-1.0, 0.0, 0.0]}, -1.0],
    "table": [{"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]], "interpolation": "linear"}, 1.0],
}


@pytest.mark.parametrize("belt", BELTS)
@pytest.mark.parametrize("scheme", ["central_differences", "newmark", "generalized_alpha", "energy_momentum"])
def test_a_block_on_a_belt_is_dragged_along_from_the_start(scheme, belt, comm, shared_tmp_path):
    """With v = mu g t until it has the belt's speed."""
    keys, direction = BELTS[belt]
    floor = {"name": "belt", "type": "plane", "point": [0, 0, 0], "normal": [0.0, 0.0, 1.0], "friction": 0.3}
    data = {
        "mesh": {"generator": "rod", "length": 0.1, "elements": 2},
        "material": {"it": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"it": {"area": 1e-2, "material": "it"}},
        "gravity": {"acceleration": [0.0, 0.0, -GRAVITY]},
        "wall": [floor | keys],
        "time": {"integrator": scheme, "step": 1e-3, "end": 0.1},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-12},
    }
    run = Simulation(Case.from_dict(data), comm, output=shared_tmp_path / "it", quiet=True)
    run.start()
    first = run.row
    assert first["wall/belt/force"] == pytest.approx([direction * 0.3 * GRAVITY, 0.0, GRAVITY], rel=1e-9, abs=1e-9)
    last = [step.row for step in run][-1]
    assert last["momentum"][0] == pytest.approx(direction * 0.3 * GRAVITY * 0.1, rel=1e-2)


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("scheme", ["central_differences", "newmark", "energy_momentum"])
def test_a_block_on_a_floor_that_starts_to_move(scheme, axis, comm, shared_tmp_path):
    """Two rows are an S, whose first acceleration is 6 d/T^2: the block goes along with it from the first row."""
    moved = [0.0, 0.0, 0.0]
    moved[axis] = 0.05
    floor = {"name": "floor", "type": "plane", "point": [0, 0, 0], "normal": [0.0, 0.0, 1.0], "friction": 0.3}
    data = {
        "mesh": {"generator": "rod", "length": 0.1, "elements": 2},
        "material": {"it": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"it": {"area": 1e-2, "material": "it"}},
        "gravity": {"acceleration": [0.0, 0.0, -GRAVITY]},
        "wall": [floor | {"motion": [[0.0, 0.0, 0.0, 0.0], [1.0, *moved]]}],
        "time": {"integrator": scheme, "step": 1e-3, "end": 0.1},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-12},
    }
    run = Simulation(Case.from_dict(data), comm, output=shared_tmp_path / "it", quiet=True)
    run.start()
    expected = np.array([0.0, 0.0, GRAVITY])
    expected[axis] += 0.3
    # that of central differences brings the nodes to where the floor is one step later
    error = 2e-4 if scheme == "central_differences" else 1e-9
    assert run.row["wall/floor/force"] == pytest.approx(expected, abs=error)
    last = [step.row for step in run][-1]
    assert last["momentum"][axis] == pytest.approx(0.05 * 6.0 * 0.1 * 0.9, rel=0.03)
