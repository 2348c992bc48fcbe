"""Works of moving walls: V . impulse for a constant velocity V, and impacts seen from the wall are the same."""

import moving_walls as table
import numpy as np
import pytest
from helpers.lattices import TRAPEZOID, rows_of
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case

MASS, FALL, RISE = 0.1, -1.0, 0.3
HALF = {key: value for key, value in TRAPEZOID.items() if key != "integrator"}


def falling_bar(integrator, treatment, restitution=0.0, gap=0.013, parameters=(), **wall):
    """A bar that falls flat on a plate that rises."""
    plate = {"name": "plate", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
    plate |= wall or {"velocity": [0.0, 0.0, RISE]}
    return {
        "mesh": {"generator": "arrays", "points": [[0.0, 0.0, gap], [1.0, 0.0, gap]], "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e6, "density": 1e3}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "initial": {"velocity": [0.0, 0.0, FALL]},
        "wall": [plate | {"restitution": restitution}],
        "contact": {"treatment": treatment},
        "time": {"integrator": integrator, "step": 1e-3, "end": 0.03, **dict(parameters)},
        "solver": {"rtol": 1e-12},
        "output": {"fields_every": 0},
    }


@pytest.mark.parametrize(
    ("integrator", "treatment", "restitution", "gap"),
    [
        ("central_differences", "stick", 0.0, 0.013),
        ("central_differences", "stick", 0.0, 0.0137),
        ("central_differences", "stick", 0.0, 0.0),
        ("central_differences", "scheme", 0.0, 0.0),
        ("central_differences", "scheme", 0.5, 0.0137),
        ("chung_lee", "stick", 0.0, 0.0137),
        ("chung_lee", "scheme", 1.0, 0.0132),
        ("hulbert_chung", "stick", 0.0, 0.0137),
        *(("newmark", treatment, e, 0.0135) for treatment, e in (("stick", 0.0), ("stick", 0.5), ("scheme", 1.0))),
        *(("houbolt", treatment, e, 0.013) for treatment, e in (("stick", 0.0), ("scheme", 0.5))),
        ("wilson", "stick", 0.0, 0.013),
        ("generalized_alpha", "stick", 0.5, 0.0131),
        ("energy_momentum", "stick", 0.0, 0.0131),
    ],
)
def test_bar_that_falls_on_a_rising_plate(integrator, treatment, restitution, gap, comm, shared_tmp_path):
    """It leaves with e times the approach: the plate works V . J, and only the impact dissipates."""
    rows, _ = rows_of(falling_bar(integrator, treatment, restitution, gap), comm, shared_tmp_path)
    last, approach = rows[-1], RISE - FALL
    given = last["wall/plate/impulse"] + last["wall/plate/jump_impulse"]
    np.testing.assert_allclose(given, [0.0, 0.0, MASS * approach * (1.0 + restitution)], atol=1e-11)
    assert last["contact_work"] == pytest.approx(RISE * given[2], abs=1e-13)
    assert last["impact_dissipation"] == pytest.approx(0.5 * MASS * approach**2 * (1.0 - restitution**2), abs=1e-11)
    assert last["numerical_dissipation"] == pytest.approx(0.0, abs=1e-11)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "treatment", "restitution", "wall", "body"),
    [
        (("central_differences", {}), "scheme", 0.5, "plate", "node"),
        (("central_differences", {}), "stick", 0.0, "rough", "rod"),
        (("central_differences", {}), "mass_redistribution", 0.0, "plane", "rod"),
        (("chung_lee", {}), "scheme", 1.0, "plane", "rod"),
        (("souza_moura", {}), "stick", 0.5, "sphere", "rod"),
        (("newmark", {}), "stick", 0.0, "rough", "rod"),  # nodes that are let go
        (("newmark", {}), "conserving", 0.0, "plane", "node"),
        (("newmark", HALF), "scheme", 0.5, "sphere", "node"),
        (("houbolt", {}), "stick", 0.5, "sphere", "rod"),
        (("wilson", {"theta": 2.0}), "scheme", 1.0, "plane", "rod"),
        (("generalized_alpha", {}), "scheme", 0.0, "plate", "rod"),
        (("energy_momentum", {}), "conserving", 0.0, "sphere", "node"),
        (("central_differences", {}), "scheme", 0.5, "triangles", "truss"),
        (("generalized_alpha", {}), "stick", 0.0, "triangles", "node"),
    ],
)
def test_impact_seen_from_the_wall(scheme, treatment, restitution, wall, body):
    """Works are V . J; motion and dissipations are the same; energy and momentum, of plates too, are balanced."""
    errors = table.errors_of(scheme, treatment, restitution, wall, body)
    assert errors.work < 1e-12
    assert max(errors.balance, errors.momentum) < 1e-12
    assert errors.frames < 1e-11


@pytest.mark.parametrize(
    ("scheme", "treatment", "body"),
    [
        (("central_differences", {}), "stick", "rod"),
        (("newmark", HALF), "stick", "node"),
        (("energy_momentum", {}), "scheme", "truss"),  # whose forces are those between the ends of steps
    ],
)
def test_impact_seen_from_a_wall_that_turns(scheme, treatment, body):
    """About a centre so far away that it moves on a straight line: works are moments times angles then."""
    errors = table.errors_of(scheme, treatment, 0.0, "turning", body)
    assert errors.balance < 1e-12
    assert max(errors.work, errors.momentum, errors.frames) < 2e-6


@pytest.mark.parametrize(
    ("integrator", "treatment"),
    [("central_differences", "stick"), ("newmark", "stick"), ("houbolt", "stick"), ("energy_momentum", "stick")],
)
def test_bar_that_a_plate_carries(integrator, treatment, comm, shared_tmp_path):
    """Lifted by ever slower rises, what the plate works is what the bar has."""
    motion = [[0.0, 0.0, 0.0, 0.0], [0.01, 0.0, 0.0, 1e-3], [0.02, 0.0, 0.0, 3e-3], [0.04, 0.0, 0.0, 6e-3]]
    case = falling_bar(integrator, treatment, gap=0.0, motion=motion)
    case["initial"]["velocity"] = [0.0, 0.0, 0.0]
    case["gravity"] = {"acceleration": [0.0, 0.0, -200.0]}
    rows, _ = rows_of(case, comm, shared_tmp_path)
    for row in rows[1:]:
        height, speed = row["wall/plate/position"][2], row["wall/plate/velocity"][2]
        has = MASS * (0.5 * speed**2 + 200.0 * height)
        assert row["contact_work"] == pytest.approx(has, rel=0.02, abs=2e-4)
        assert abs(row["energy_imbalance"]) < 1e-14
    assert rows[-1]["contact_work"] > 0.05


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    ("integrator", "treatment", "restitution"), [("central_differences", "stick", 0.0), ("newmark", "scheme", 0.5)]
)
def test_corner_that_moves_on_any_number_of_ranks(integrator, treatment, restitution, comm, shared_tmp_path):
    """Nodes in a corner of walls of different velocities; stopped and continued to the bit; on all ranks as on one."""
    scheme = integrator, {}
    case = table.case_of(scheme, treatment, restitution, "plane", "truss", table.MOTION, shared_tmp_path).to_dict()
    other = np.array([-0.5, 0.2, 0.1])
    point = [-0.004, 0.0, 0.0]
    case["wall"].append(case["wall"][0] | {"name": "other", "point": point, "normal": [1.0, 0.2, 0.1]})
    case["wall"][1]["velocity"] = other.tolist()
    case["initial"]["velocity"] = [-1.0, 0.0, -1.0]
    case["solver"] = {"rtol": 1e-13, "linear": "cg"}
    history = assert_restart_is_bitwise(Case.from_dict(case), comm, shared_tmp_path, 33)
    given = [history[f"wall/{name}/impulse"] + history[f"wall/{name}/jump_impulse"] for name in ("wall", "other")]
    work = given[0] @ table.MOTION + given[1] @ other
    assert np.abs(given).max(axis=(1, 2)).min() > 1e-3
    np.testing.assert_allclose(history["contact_work"], work, atol=1e-12 * np.abs(work).max())
    assert_as_on_one_rank(history, Case.from_dict(case), comm, shared_tmp_path, "contact_work", within=1e-8)
