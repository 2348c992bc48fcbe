"""Coulomb friction: closed forms of sliding and sticking."""

import numpy as np
import pytest
from helpers.lattices import lattice_case, simulation

from pfem_petsc.errors import InputError, SimulationFailure

ANGLE, G = 0.4, 9.81


def block(integrator, friction, *, velocity=0.0, end=0.1, static=None, step=2e-4, **wall):
    """A stiff lattice on a plane, in axes of the plane: gravity leans downhill (x)."""
    gravity = [G * np.sin(ANGLE), 0.0, -G * np.cos(ANGLE)]
    floor = {
        "type": "plane",
        "name": "floor",
        "point": [0, 0, 0.0],
        "normal": [0, 0, 1.0],
        "friction": friction,
        **wall,
    }
    if static is not None:
        floor["static_friction"] = static
    # damping keeps the nodes on the floor; it would slow the block down too, so the floor alone carries it
    return lattice_case(
        [floor],
        velocity=[velocity, 0, 0],
        integrator=integrator,
        gravity=gravity,
        step=step,
        end=end,
        cells=[3, 2, 1],
        solver={"rtol": 1e-12},
    )


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
def test_sticking_block(integrator, comm, shared_tmp_path):
    """Where tan(angle) < mu the block stays: no node slips on the floor."""
    case = block(integrator, 0.6)
    case["material"]["m"]["damping"] = 1e5
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    foot = np.abs(run.mesh.points[: run.mesh.n_owned, 2]) < 1e-9
    slipped = np.abs(run.state.position - run.mesh.points[: run.mesh.n_owned])[foot, :2].max(initial=0.0)
    assert max(comm.allgather(float(slipped))) < 1e-4  # bounces of single nodes
    force = np.mean([row["wall/floor/force"] for row in rows[100:]], axis=0)
    assert force[0] / force[2] == pytest.approx(-np.tan(ANGLE), rel=0.1)


def test_pulled_by_a_moving_floor(comm, shared_tmp_path):
    """A floor that moves sideways drags a resting truss with mu times its weight until both move together."""
    floor = {
        "type": "plane",
        "name": "floor",
        "point": [0, 0, 0.0],
        "normal": [0, 0, 1.0],
        "friction": 0.4,
        "velocity": [0.0, 1.0, 0.0],
    }
    case = lattice_case([floor], integrator="central_differences", gravity=[0, 0, -G], end=0.05, cells=[3, 2, 1])
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    impulse = rows[-1]["wall/floor/impulse"]
    assert impulse[1] == pytest.approx(0.4 * impulse[2], rel=2e-3)
    assert rows[-1]["momentum"][1] == pytest.approx(impulse[1], rel=0.02)


def test_refused(comm, shared_tmp_path):
    with pytest.raises(InputError, match="no less than friction"):
        simulation(block("central_differences", 0.5, static=0.2), comm, shared_tmp_path)
    with pytest.raises(InputError, match='friction needs contact.treatment = "scheme" or "stick"'):
        simulation(block("newmark", 0.5) | {"contact": {"treatment": "conserving"}}, comm, shared_tmp_path)


def guided(integrator, friction, wall, speed=0.0):
    """A bar that is guided along z, and a slope at 60 degrees at one end."""
    slope = {"point": [0.0, 0.0, -0.01053], "normal": [-np.sqrt(0.75), 0.0, 0.5], "friction": friction, **wall}
    return {
        "mesh": {"generator": "rod", "length": 0.2, "elements": 2},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "node_set": {"all": {"all": True}, "start": {"group": "start"}},
        "support": [{"node_set": "all", "fix": "xy"}],
        "initial": {"velocity": [0.0, 0.0, speed]},
        "wall": [{"type": "plane", "name": "slope", "node_set": "start", **slope}],
        "time": {"integrator": integrator, "step": 1e-3, "end": 0.15},
        "output": {"fields_every": 0},
        "solver": {"linear": "mumps"},
    }


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
@pytest.mark.parametrize("friction", [0.3, 0.6, 1.5, 8.0])
def test_guided_node_is_stopped_by_any_friction(integrator, friction, comm, shared_tmp_path):
    """Falling on the slope, normal force and drag both push it up: their ratio is that of the law.

    From cot 60 = 0.577 on the drag moves the node more than the normal force does, and sweeps over both overshoot.
    """
    rows = [step.row for step in simulation(guided(integrator, friction, {}, -0.1), comm, shared_tmp_path)]
    x, _, z = next(row["wall/slope/force"] for row in rows if row["wall/slope/force"][2] > 0.0)
    normal, slope = np.sqrt(0.75), 0.5
    assert x / z == pytest.approx((friction * slope - normal) / (slope + friction * normal), rel=1e-6)
    assert rows[-1]["friction_dissipation"] > 0.0
    assert abs(rows[-1]["energy_imbalance"]) < 1e-12


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_guided_node_meets_a_wall_that_is_almost_parallel(integrator, comm, shared_tmp_path):
    """One that only touches it at the start: the slip of its first step is nothing beside what the drag must stop."""
    steep = {"normal": [np.sqrt(1.0 - 0.0138**2), 0.0, 0.0138], "point": [0.0, 0.0, -1e-8]}
    rows = [step.row for step in simulation(guided(integrator, 0.95, steep, -0.1), comm, shared_tmp_path)]
    x, _, z = next(row["wall/slope/force"] for row in rows if row["wall/slope/force"][2] > 0.0)
    n = steep["normal"]
    assert x / z == pytest.approx((n[0] - 0.95 * n[2]) / (n[2] + 0.95 * n[0]), rel=1e-6)
    assert rows[-1]["friction_dissipation"] > 0.0
    assert abs(rows[-1]["energy_imbalance"]) < 1e-12


@pytest.mark.parametrize("phase", [0.05, 0.8])
@pytest.mark.parametrize(
    ("integrator", "parameters"),
    [
        ("chung_lee", {}),
        ("hulbert_chung", {}),
        ("newmark", {"beta": 0.25, "gamma": 0.5}),
        ("newmark", {}),
        ("houbolt", {}),
        ("wilson", {}),
        ("generalized_alpha", {}),
        ("energy_momentum", {}),
    ],
)
def test_impact_drags_by_its_momentum(integrator, parameters, phase, comm, shared_tmp_path):
    """A bar that meets a rough floor loses mu m v along it, wherever in a step that is, and the energy of that."""
    step, friction = 1e-3, 0.2
    floor = {"type": "plane", "name": "floor", "normal": [0.0, 0.0, 1.0], "friction": friction}
    case = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
        "material": {"m": {"young_modulus": 1.0, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "initial": {"velocity": [1.0, 0.0, -1.0]},
        "wall": [floor | {"point": [0.0, 0.0, -(5 + phase) * step]}],
        "contact": {"treatment": "stick"},
        "time": {"integrator": integrator, "step": step, "end": 12 * step, **parameters},
    }
    rows = [step.row for step in simulation(case, comm, shared_tmp_path)]
    assert rows[-1]["momentum"] == pytest.approx([1.0 - friction, 0.0, 0.0], abs=1e-7)
    assert rows[-1]["kinetic_energy"] == pytest.approx(0.5 * (1.0 - friction) ** 2, rel=1e-6)
    assert all(row["friction_dissipation"] >= 0.0 for row in rows)
    assert abs(rows[-1]["energy_imbalance"]) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_wedge_that_locks_itself(integrator, comm, shared_tmp_path):
    """The slope is driven under the node, and drags it down by its friction: it lifts it below cot 60 = 0.577 alone."""
    wall = {"velocity": [-0.1, 0.0, 0.0], "point": [0.0, 0.0, -0.0003]}
    run = simulation(guided(integrator, 0.4, wall), comm, shared_tmp_path, "lifts")
    rows = [step.row for step in run]
    assert rows[-1]["wall/slope/impulse"][2] > 0.0 and rows[-1]["friction_dissipation"] > 0.0
    run = simulation(guided(integrator, 0.6, wall), comm, shared_tmp_path, "locks")
    with pytest.raises(
        SimulationFailure, match=r"step \d+, .*jams node 0: .*'slope'.* 0\.577 or more, and it is 0\.6;"
    ):
        list(run)


def test_wedge_that_locks_itself_with_consistent_mass(comm, shared_tmp_path):
    """The explicit step has moved the nodes before its balance fails: it is not repeated with smaller parts."""
    case = guided("central_differences", 0.6, {"velocity": [-0.1, 0.0, 0.0], "point": [0.0, 0.0, -0.0003]})
    case["time"]["mass"] = "consistent"
    run = simulation(case, comm, shared_tmp_path, "locks")
    with pytest.raises(SimulationFailure, match=r"jams node 0: .*'slope'.* 0\.577 or more, and it is 0\.6;"):
        list(run)


PHASES = (np.arange(10) + 0.5) / 10.0
FRAME = np.linalg.qr([[0.3, 2.0, 1.0], [-0.5, 0.5, 1.0], [0.8, 1.0, -1.0]])[0].T  # normal and tangents of a wall
LATE = [  # schemes whose velocity at the end of a step is not that of its motion
    ("chung_lee", {}),
    ("hulbert_chung", {"rho_b": 1.0}),
    ("souza_moura", {}),
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("newmark", {}),
    ("houbolt", {}),
    ("wilson", {"theta": 1.0}),
    ("wilson", {"theta": 1.4}),
    ("generalized_alpha", {}),
    ("energy_momentum", {}),
]


def thrown(integrator, parameters, relative, wall, *, gravity=(0.0, 0.0, 0.0), step=1e-3, steps=12):
    """Bars that meet an oblique wall flat, each at another phase of a step; axes of FRAME."""
    n, t, b = FRAME * np.sign(FRAME[0] @ [0.3, -0.5, 0.8])
    start = [-relative[0] * step * (3.0 + p) * n + 3.0 * k * t for k, p in enumerate(PHASES)]
    points = np.array([[x, x + b] for x in start]).reshape(-1, 3)
    walls = {"type": "plane", "name": "wall", "point": [0.0] * 3, "normal": n.tolist()} | wall
    velocity = np.array(relative) @ [n, t, b] + walls.get("velocity", np.zeros(3))
    return {
        "mesh": {
            "generator": "arrays",
            "points": points.tolist(),
            "bars": np.arange(len(points)).reshape(-1, 2).tolist(),
        },
        "material": {"m": {"young_modulus": 1e-3, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "initial": {"velocity": velocity.tolist()},
        "gravity": {"acceleration": (np.array(gravity) @ [n, t, b]).tolist()},
        "wall": [walls],
        "contact": {"treatment": "stick"},
        "time": {"integrator": integrator, "step": step, "end": steps * step, **parameters},
        "solver": {"rtol": 1e-12, "linear": "mumps"},
        "output": {"fields_every": 0},
    }, (n, t, b)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("friction", [0.2, 0.9])
@pytest.mark.parametrize(("integrator", "parameters"), LATE)
def test_friction_does_not_turn_the_motion_round(integrator, parameters, friction, moving, comm, shared_tmp_path):
    """A particle that meets a wall with v_n = 6 and v_t = 3 keeps max(v_t - mu v_n, 0) in any phase of a step."""
    wall = {"friction": friction} | ({"velocity": [1.0, 2.0, -0.5]} if moving else {})
    case, axes = thrown(integrator, parameters, (-6.0, 2.4, -1.8), wall)
    run = simulation(case, comm, shared_tmp_path)
    rows, along = [], []
    for step in run:
        rows.append(step.row)
        relative = (run.state.v - wall.get("velocity", np.zeros(3))) @ np.transpose(axes)
        along.append(relative @ [0.0, 0.8, -0.6])
    assert np.min(along, initial=0.0) > -1e-9
    left = max(3.0 - 6.0 * friction, 0.0)
    np.testing.assert_allclose(relative, left * np.array([[0.0, 0.8, -0.6]] * len(relative)), atol=1e-9)
    mass, dissipated = run.model.total_mass, np.array([row["friction_dissipation"] for row in rows])
    assert (np.diff(dissipated) >= -1e-12 * mass).all()
    if integrator == "energy_momentum" and friction == 0.2:  # no node sticks in the step of the impact
        assert dissipated[-1] == pytest.approx(0.5 * mass * (9.0 - left**2), rel=1e-9)
    assert np.abs([row["energy_imbalance"] for row in rows]).max() < 1e-10 * mass


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "parameters"), LATE)
def test_friction_that_a_slope_reverses(integrator, parameters, comm, shared_tmp_path):
    """Thrown up a slope, a particle is stopped by friction and weight, and slides down again by the difference."""
    g, friction, step, steps, speed = 100.0, 0.3, 1e-3, 60, 2.0
    along, across = g * np.sin(ANGLE), g * np.cos(ANGLE)
    wall = {"friction": friction}
    case, axes = thrown(
        integrator, parameters, (-1.0, -speed, 0.0), wall, gravity=(-across, along, 0.0), step=step, steps=steps
    )
    run = simulation(case, comm, shared_tmp_path)
    rows = [each.row for each in run]
    met = (np.sqrt(1.0 + 2.0 * across * step * (3.0 + PHASES)) - 1.0) / across
    after = -speed + along * met + friction * (1.0 + across * met)
    stop = met - after / (along + friction * across)
    exact = (along - friction * across) * (steps * step - stop)
    assert after.max() < 0.0 and stop.max() < 0.5 * steps * step
    bars = run.mesh.node_ids[: run.mesh.n_owned] // 2
    np.testing.assert_allclose(run.state.v @ axes[1], exact[bars], atol=0.5 * g * step)
    assert (np.diff([row["friction_dissipation"] for row in rows]) >= -1e-12 * run.model.total_mass).all()
