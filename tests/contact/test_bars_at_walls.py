"""Bars that touch walls between their nodes: impacts against closed forms, and where walls hold them."""

import numpy as np
import pytest
from helpers.lattices import rows_of
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise
from helpers.triangles import box, write_surface

from pfem_petsc import Case
from pfem_petsc.contact.bars_at_walls import damping_of

BALL = {"type": "sphere", "point": [0.0, 0.0, 0.0], "radius": 0.5}
ACROSS = [[-1.0, 0.0, 0.52], [1.0, 0.0, 0.52]]
MASS = 0.2


def falling(wall, points=ACROSS, velocity=(0.0, 0.0, -1.0), step=2e-4, end=0.12, **tables):
    """A stiff bar that moves across a wall that is smaller than it."""
    return {
        "mesh": {"generator": "arrays", "points": points, "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e7, "density": 1e3}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "initial": {"velocity": list(velocity)},
        "wall": [{"name": "w", **wall}],
        "self_contact": {},
        "time": {"integrator": "central_differences", "step": step, "end": end},
        "output": {"fields_every": 0},
        **tables,
    }


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
@pytest.mark.parametrize("restitution", [1.0, 0.5, 0.2])
def test_bar_that_falls_on_a_sphere(integrator, restitution, comm, shared_tmp_path):
    """Its middle hits the sphere, and it leaves with e times its velocity; the energies of its own account for it."""
    case = falling({**BALL, "restitution": restitution})
    case["time"]["integrator"] = integrator
    rows, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, 2], restitution, rtol=0.01)
    last = rows[-1]
    given = comm.allreduce(float(run.state.v[:, 2].sum())) * 0.5 * MASS + MASS
    np.testing.assert_allclose(last["wall/w/impulse"], [0.0, 0.0, given], atol=1e-12)
    lost = 0.5 * MASS - last["kinetic_energy"]
    assert last["self_contact_dissipation"] == pytest.approx(lost, abs=1e-4)
    damping = damping_of(restitution)  # most energy of a damped oscillator from rest: at its largest deflection
    stored = 0.5 * MASS * np.exp(-2.0 * damping / np.sqrt(1.0 - damping**2) * np.arccos(damping))
    assert max(row["self_contact_energy"] for row in rows) == pytest.approx(stored, rel=0.02)
    assert abs(last["numerical_dissipation"]) < 1e-4


def test_sphere_with_mass_and_bar(comm, shared_tmp_path):
    """An elastic impact of free bodies: v1 = (m1 - m2)/(m1 + m2) v, and both keep the momentum."""
    case = falling({**BALL, "restitution": 1.0, "mass": 0.4})
    rows, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, 2], -(0.2 - 0.4) / 0.6, rtol=2e-3)
    of_wall = 0.4 * rows[-1]["wall/w/velocity"][2]
    assert 0.5 * MASS * run.state.v[:, 2].sum() + of_wall == pytest.approx(-MASS, abs=1e-13)


def test_wall_that_moves_works_on_the_bar(comm, shared_tmp_path):
    """Seen from a sphere that rises the impact is the same: the bar leaves with v + 2 V, and the wall works V J."""
    rows, run = rows_of(falling({**BALL, "restitution": 1.0, "velocity": [0.0, 0.0, 0.5]}), comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, 2], 2.0, rtol=2e-3)
    last = rows[-1]
    assert last["contact_work"] == pytest.approx(0.5 * last["wall/w/impulse"][2], rel=1e-10)
    assert abs(last["numerical_dissipation"]) < 2e-4


@pytest.mark.slow
def test_bar_across_the_edge_of_a_box(comm, shared_tmp_path):
    """A bar that falls across the edge of a box of triangles is pushed across the edge and its axis."""
    file = write_surface(shared_tmp_path / "box.obj", *box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0)), comm)
    points = [[0.51, 0.0, 0.51], [1.51, 0.0, -0.49]]
    case = falling({"type": "surface", "file": file, "restitution": 1.0}, points, (-0.5, 0.0, -0.5))
    _, run = rows_of(case, comm, shared_tmp_path)
    assert comm.allreduce(float(run.state.v[:, 1].sum())) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(run.state.v[:, [0, 2]], 0.5, rtol=0.01)  # it was hit in its middle


@pytest.mark.slow
def test_bar_rests_between_its_nodes(comm, shared_tmp_path):
    """Balanced on a cylinder, damped, it is pressed with its weight; without the table, it falls through."""
    wall = {"type": "cylinder", "point": [0.0, 0.0, 0.0], "axis": [0.0, 1.0, 0.0], "radius": 0.5}
    points = [[-1.0, 0.0, 0.5], [1.0, 0.0, 0.5]]
    case = falling(wall, points, (0.0, 0.0, 0.0), end=0.2, gravity={"acceleration": [0.0, 0.0, -10.0]})
    rows, run = rows_of(case, comm, shared_tmp_path)
    assert np.mean([row["wall/w/force"][2] for row in rows[800:]]) == pytest.approx(MASS * 10.0, rel=0.02)
    np.testing.assert_allclose(run.state.position[:, 2], 0.5 - MASS * 10.0 / 500.0, atol=1e-4)
    del case["self_contact"]
    _, run = rows_of(case, comm, shared_tmp_path, "free")
    assert run.state.position[:, 2].max(initial=-1.0) < 0.5 - 0.07


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
def test_on_any_rank_count_and_restarted(integrator, comm, shared_tmp_path):
    wall = {**BALL, "friction": 0.3, "restitution": 0.4}
    wall["rotation"] = {"centre": [0.0, 0.0, 0.0], "axis": [1.0, 0.0, 0.0], "angular_velocity": 4.0}
    points = [[-1.0, 0.1, 0.52], [0.4, 0.1, 0.52], [1.2, 0.0, 0.53]]
    case = falling(wall, points, (0.0, 0.3, -1.0), step=4e-4, end=0.03)
    case["mesh"]["bars"] = [[0, 1], [1, 2]]
    case["time"]["integrator"] = integrator
    if integrator == "chung_lee":  # which has no restitution beside friction
        del case["wall"][0]["restitution"]
    case = Case.from_dict(case)
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 55, 63)
    names = "momentum", "kinetic_energy", "self_contact_dissipation", "wall/w/impulse", "wall/w/moment"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names)
