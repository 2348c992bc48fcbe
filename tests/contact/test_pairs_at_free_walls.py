"""Contact pairs whose nodes walls with mass stop too, in explicit steps: conservation and closed forms."""

import numpy as np
import pytest
from helpers.lattices import planes, rows_of, two_lattices
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case

BODY = {"mass": 0.03, "inertia": [2e-5, 3e-5, 4e-5]}


def walls_of(kind):
    """Walls in the way of both lattices, which meet nodes of pairs as well."""
    if kind == "planes":
        return planes([[0.0, 0.3, 1.0], [0.1, 1.0, -0.2]], [-0.002, -0.04], mass=0.05)
    below = {"type": "sphere", "point": [0.1, 0.1, -0.105], "radius": 0.1, **BODY}
    if kind == "rough":
        return [
            {"name": "ball", "friction": 0.4, **below},
            *planes([[0.1, 1.0, -0.2]], [-0.04], friction=0.3, mass=0.05),
        ]
    return [{"name": "ball", "restitution": 0.5, **below}]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("kind", "friction"), [("planes", 0.0), ("planes", 0.3), ("rough", 0.0), ("elastic", 0.0)])
def test_momentum_and_energy(kind, friction, comm, shared_tmp_path):
    """Momentum of lattices and walls stays to 1e-12, and energy is balanced; pairs and walls press at once."""
    walls = walls_of(kind)
    case = two_lattices(shared_tmp_path / "m.vtu", "central_differences", velocity=(2.0, -0.3, -2.0))
    case["wall"], case["contact_pair"][0]["friction"] = walls, friction
    rows, run = rows_of(case, comm, shared_tmp_path)
    names = run.model.contact.names
    forces = np.array([[np.abs(row[f"wall/{name}/force"]).max() for name in names] for row in rows])
    pairs = np.array([np.abs(row["pair/faces/force"]).max() for row in rows])
    assert (forces.max(axis=0) > 0.0).all() and ((forces > 0.0).any(axis=1) & (pairs > 0.0)).any()
    momenta = [
        row["momentum"] + sum(w["mass"] * row[f"wall/{name}/velocity"] for w, name in zip(walls, names, strict=True))
        for row in rows
    ]
    np.testing.assert_allclose(momenta, [momenta[0]] * len(rows), rtol=0.0, atol=1e-12 * np.abs(momenta[0]).max())
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-12
    assert run.model.contact.gaps(run.state.position, run.state.time).min(initial=0.0) > -1e-9


def test_masses_in_a_row_stop_together(comm, shared_tmp_path):
    """Two nodes one behind the other, touching as a pair, hit a plate: all have a common velocity afterwards."""
    plate, speed, mass = 0.5, 1.0, 0.01
    points = [[0.0, 0.0, 0.0015], [0.0, 0.0, 0.1015], [0.3, 0.0, 1.0], [0.4, 0.0, 1.0]]
    case = {
        "mesh": {"generator": "arrays", "points": points, "bars": [[0, 2], [1, 3]]},
        "material": {"m": {"young_modulus": 1e-9, "density": 1e-9}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "node_set": {"low": {"indices": [0]}, "high": {"indices": [1]}, "struck": {"indices": [0, 1]}},
        "mass": [{"node_set": "struck", "value": mass}],
        "initial": {"on": [{"node_set": "struck", "velocity": [0.0, 0.0, -speed]}]},
        "contact_pair": [{"name": "p", "first": "low", "second": "high", "direction": [0.0, 0.0, 1.0], "gap": 0.1}],
        "wall": [{"name": "w", "type": "plane", "point": [0.0] * 3, "normal": [0.0, 0.0, 1.0], "mass": plate}],
        "time": {"integrator": "central_differences", "step": 1e-3, "end": 8e-3},
        "output": {"fields_every": 0},
    }
    rows, run = rows_of(case, comm, shared_tmp_path)
    common = -2.0 * mass * speed / (2.0 * mass + plate)
    np.testing.assert_allclose(rows[-1]["wall/w/velocity"], [0.0, 0.0, common], atol=1e-12)
    np.testing.assert_allclose(rows[-1]["momentum"], [0.0, 0.0, 2.0 * mass * common], atol=1e-9)
    np.testing.assert_allclose(rows[-1]["wall/w/impulse"], [0.0, 0.0, 2.0 * mass * (speed + common)], atol=1e-9)
    np.testing.assert_allclose(rows[-1]["pair/p/impulse"], [0.0, 0.0, mass * (speed + common)], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("kind", "friction"), [("planes", 0.3), ("rough", 0.0), ("elastic", 0.0)])
def test_restart_and_ranks(kind, friction, comm, shared_tmp_path):
    """A stop and a restart leave no trace, nor does the number of ranks, but for the order of sums over ranks."""
    case = two_lattices(shared_tmp_path / "m.vtu", "central_differences", velocity=(2.0, -0.3, -2.0), end=0.012)
    case["wall"], case["contact_pair"][0]["friction"] = walls_of(kind), friction
    case = Case.from_dict(case)
    # PT-Scotch goes on with its random numbers: the second run of a process may have the bodies on other ranks, and
    # sums then begin with other parts; in processes of their own, runs on several ranks go on to the bit
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 25, 45, allowed=1e-9 if comm.size > 1 else 0.0)
    wall = "ball" if kind != "planes" else "wall1"
    assert np.abs(history[f"wall/{wall}/force"]).max() > 0.0
    names = "kinetic_energy", f"wall/{wall}/impulse", f"wall/{wall}/position", "pair/faces/impulse"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names)
