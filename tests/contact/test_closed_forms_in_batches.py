"""Closed forms of bodies whose nodes all do the same at rough, moving and elastic walls, in batches of steps."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result

G = 9.81
STEP, STEPS = 1e-3, 200


def history(tables, comm, folder):
    """Return the history of a ring in batches, its mass [kg], and the largest difference of displacements [m]."""
    case = {
        "mesh": {"generator": "ring", "outer_radius": 1.0, "inner_radius": 0.8, "bays": 12},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "time": {"integrator": "central_differences", "step": STEP, "end": STEPS * STEP},
        "output": {"fields_every": 0, "history_every": 1},
        **tables,
    }
    run = Simulation(Case.from_dict(case), comm, output=folder / "result", quiet=True)
    assert len(list(run.batches())) < STEPS / 4
    ways = comm.allreduce((run.state.position - run.mesh.points[: run.mesh.n_owned]).tolist())
    rows = open_result(run.folder).history
    scale = max(np.abs(rows[column]).max() for column in rows if column.endswith(("_energy", "_work")))
    assert len(rows["step"]) == STEPS + 1 and np.abs(rows["energy_imbalance"]).max() < 1e-11 * scale
    return rows, run.model.total_mass, np.ptp(ways, axis=0).max()


def slope(angle, friction, velocity):
    """A ring that lies on an incline, in axes of the incline: x leads downhill."""
    return {
        "wall": [{"name": "slope", "type": "plane", "point": [0, 0, 0.0], "normal": [0, 0, 1.0], "friction": friction}],
        "gravity": {"acceleration": [G * np.sin(angle), 0.0, -G * np.cos(angle)]},
        "initial": {"velocity": [velocity, 0.0, 0.0]},
    }


@pytest.mark.parallel
def test_sliding_down_an_incline(comm, shared_tmp_path):
    """The acceleration is g (sin a - mu cos a); friction dissipates mu m g cos a on each metre."""
    angle, friction, start = 0.4, 0.3, 0.2
    rows, mass, apart = history(slope(angle, friction, start), comm, shared_tmp_path)
    t, rubbing = rows["time"], friction * G * np.cos(angle)
    a = G * np.sin(angle) - rubbing
    way = start * t + 0.5 * a * t**2
    moved = rows["centre_of_mass"][:, 0] - rows["centre_of_mass"][0, 0]
    assert apart < 1e-12
    np.testing.assert_allclose(moved, way, atol=1e-12)
    np.testing.assert_allclose(rows["momentum"][1:-1, 0] / mass, start + a * t[1:-1], rtol=1e-11)
    np.testing.assert_allclose(rows["friction_dissipation"], mass * rubbing * way, atol=1e-12 * mass)
    np.testing.assert_allclose(rows["wall/slope/force"][1:, 2], mass * G * np.cos(angle), rtol=1e-11)


@pytest.mark.parallel
def test_stopping_on_an_incline(comm, shared_tmp_path):
    """Where mu > tan a a ring that slides stops after v^2 / (2 g (mu cos a - sin a)), and stays."""
    angle, friction, start = 0.4, 0.8, 0.3
    rows, mass, apart = history(slope(angle, friction, start), comm, shared_tmp_path)
    rubbing = friction * G * np.cos(angle)
    a = rubbing - G * np.sin(angle)
    stop = start / a
    way = rows["centre_of_mass"][:, 0] - rows["centre_of_mass"][0, 0]
    late = rows["time"] > stop + 2.0 * STEP
    assert 10 < late.sum() and apart < 1e-12
    assert way[-1] == pytest.approx(0.5 * start**2 / a, abs=a * STEP**2)
    np.testing.assert_allclose(way[late], way[-1], atol=1e-13)
    np.testing.assert_allclose(rows["momentum"][late], 0.0, atol=1e-12 * mass)
    np.testing.assert_allclose(rows["friction_dissipation"][late], rows["friction_dissipation"][-1], rtol=1e-12)
    lost = 0.5 * start**2 + G * np.sin(angle) * way[-1]
    dissipated = rows["friction_dissipation"] + rows["numerical_dissipation"]  # of the scheme where the ring stops
    assert dissipated[-1] == pytest.approx(mass * lost, rel=1e-11)
    assert abs(rows["numerical_dissipation"]).max() < mass * (a * STEP) ** 2
    np.testing.assert_allclose(rows["wall/slope/force"][late, 0], -mass * G * np.sin(angle), rtol=1e-11)


@pytest.mark.parallel
@pytest.mark.parametrize("restitution", [1.0, 0.6])
def test_thrown_at_a_moving_wall(restitution, comm, shared_tmp_path):
    """The velocity relative to the wall is turned round and multiplied by e; the wall works p . w on the ring."""
    speed, wall, along = -2.0, 1.5, 0.3
    tables = {
        "initial": {"velocity": [along, 0.0, speed]},
        "wall": [
            {"name": "bat", "type": "plane", "point": [0, 0, -0.1], "normal": [0, 0, 1.0], "restitution": restitution}
            | {"velocity": [0.4, 0.0, wall]}
        ],
    }
    rows, mass, apart = history(tables, comm, shared_tmp_path)
    after = wall - restitution * (speed - wall)
    met = 0.1 / (wall - speed)
    before, late = rows["time"] < met - 2.0 * STEP, rows["time"] > met + 3.0 * STEP
    assert apart < 1e-12 and before.sum() > 10 and late.sum() > 10
    np.testing.assert_allclose(rows["momentum"][before, 2], mass * speed, rtol=1e-12)
    np.testing.assert_allclose(rows["momentum"][late] / mass, np.tile([along, 0.0, after], (late.sum(), 1)), atol=1e-11)
    pushed = mass * (after - speed)
    np.testing.assert_allclose(rows["wall/bat/impulse"][late, 2], pushed, rtol=1e-11)
    np.testing.assert_allclose(rows["contact_work"][late], pushed * wall, rtol=1e-10)
    lost = 0.5 * mass * (1.0 - restitution**2) * (speed - wall) ** 2
    np.testing.assert_allclose(rows["impact_dissipation"][late], lost, atol=1e-10 * mass)
    assert (rows["wall/bat/releases"][late] == 24).all()
