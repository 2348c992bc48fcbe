"""Rotating walls and truss together changes only the frame."""

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, rotation, simulation, with_mesh_file

# schemes whose recursion of a held node is stable under walls that bound positions alone
SCHEMES = {
    "central_differences": {},
    "chung_lee": {},
    "hulbert_chung": {"rho_b": 0.5},
    "newmark": {},
    "houbolt": {},
    "wilson": {"theta": 1.8},
    "generalized_alpha": {"rho_inf": 0.0},
}


def rod(integrator, parameters):
    return {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 10},
        "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "node_set": {"tip": {"nearest": [1.0, 0.0, 0.0]}},
        "initial": {"velocity": [0.1, 0.0, 0.0]},
        "wall": planes([[-1.0, 0.0, 0.0]], [-1.0213], node_set="tip"),
        "time": {"integrator": integrator, "step": 0.02, "end": 3.0, **parameters},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-13},
    }


def ring(integrator, parameters):
    return {
        "mesh": {"generator": "ring", "outer_radius": 1.0, "inner_radius": 0.8, "bays": 10, "bracing": "x"},
        "material": {"m": {"young_modulus": 1e4, "density": 1.0, "yield_stress": 50.0, "kinematic_hardening": 1e3}},
        "section": {"s": {"area": 1e-2, "material": "m"}},
        "initial": {"velocity": [1.0, 0.2, 0.0]},
        "wall": planes([[-1.0, 0.3, 0.0], [-1.0, -0.8, 0.0]], [-1.01, -1.01]),
        "time": {"integrator": integrator, "step": 5e-4, "end": 0.06, **parameters},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-13},
    }


def plastic(integrator, parameters):
    material = {"yield_stress": 2e3, "isotropic_hardening": 1e5, "kinematic_hardening": 5e4}
    walls = planes([[0.2, 0.1, 1.0], [1.0, 0.0, 0.5]], [-0.03, -0.04])
    walls.append({"type": "sphere", "point": [0.2, 0.05, -0.25], "radius": 0.2})
    case = lattice_case(
        walls,
        velocity=[-0.5, 0.3, -3.0],
        spin=[3.0, 10.0, -5.0],
        integrator=integrator,
        step=2e-4,
        end=0.03,
        material=material,
        solver={"rtol": 1e-13},
    )
    case["time"] |= parameters
    return case


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("problem", [rod, ring, plastic], ids=lambda f: f.__name__)
def test_frame_does_not_matter(problem, integrator, comm, shared_tmp_path):
    case = problem(integrator, SCHEMES[integrator])
    shake = 0.01 if problem is plastic else 0.0
    turn = rotation(5)
    positions, contacts, strains = [], [], []
    for name, matrix in (("straight", np.eye(3)), ("turned", turn)):
        turned = with_mesh_file(case, shared_tmp_path / f"{name}.vtu", matrix, shake)
        run = simulation(turned, comm, shared_tmp_path, name)
        rows = [step.row for step in run]
        contacts.append([row["active_contacts"] for row in rows])
        strains.append(rows[-1]["plastic_dissipation"])
        positions.append(run.gather(run.state.position @ matrix))
    assert max(contacts[0]) >= 1
    assert contacts[0] == contacts[1]
    assert strains[0] > 0.0 or problem is rod
    if comm.rank == 0:
        size = np.ptp(positions[0], axis=0).max()
        assert np.abs(positions[0] - positions[1]).max() < 1e-9 * size
