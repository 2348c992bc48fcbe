"""Walls with inertia: closed forms of tops, pendulums, impacts off the centre and rolling, and what they conserve."""

import numpy as np
import pytest
from helpers.lattices import rotation, rows_of
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise
from helpers.triangles import box, write_surface
from scipy.special import ellipj, ellipk

from pfem_petsc import Case
from pfem_petsc.contact.rotations import changes_of_turns, steps_of_bodies, turns_by, vectors_of
from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.post.motion import walls_at

MASS, INERTIA = 0.5, [0.02, 0.03, 0.04]
BODY = {"mass": MASS, "inertia": INERTIA, "centre_of_mass": [0.0, 0.0, -0.1]}
ARM, NODES = 0.3, 0.01  # of the place that nodes hit [m], and their mass [kg]
SHAPES = {
    "plane": {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]},
    "rectangle": {
        "type": "rectangle",
        "point": [0.2, 0.0, 0.0],
        "normal": [0.0, 0.0, 1.0],
        "along": [1.0, 0.0, 0.0],
        "size": [0.6, 0.4],
    },
    "sphere": {"type": "sphere", "point": [ARM, 0.0, -0.2], "radius": 0.2},
    "cylinder": {"type": "cylinder", "point": [ARM, 0.0, -0.2], "axis": [0.0, 1.0, 0.0], "radius": 0.2},
}
GAP = 2.5e-3


def bar(wall, points, integrator="central_differences", step=1e-3, end=6e-3, mass=NODES, velocity=(0.0, 0.0, 0.0)):
    """Two nodes with a bar of no stiffness, and a wall."""
    length = float(np.linalg.norm(np.subtract(*points)))
    return {
        "mesh": {"generator": "arrays", "points": points, "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e-6, "density": mass / (1e-4 * length)}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "initial": {"velocity": list(velocity)},
        "wall": [{"name": "w"} | wall],
        "time": {"integrator": integrator, "step": step, "end": end},
        "solver": {"rtol": 1e-12},
        "output": {"fields_every": 0},
    }


def falling(wall, integrator="central_differences", velocity=(0.0, 0.0, -1.0), **keys):
    """Nodes that hit the place (ARM, 0, 0) of a wall along -z in the third step."""
    points = [[ARM, -1e-4, GAP], [ARM, 1e-4, GAP]]
    return bar(wall, points, integrator, velocity=velocity, **keys)


def totals(row, mass=MASS):
    """Momentum and angular momentum of truss and wall together."""
    v = row["wall/w/velocity"]
    spin = row["wall/w/angular_momentum"] + mass * np.cross(row["wall/w/position"], v)
    return np.concatenate([row["momentum"] + mass * v, row["angular_momentum"] + spin])


FAR = [[9.0, 0.0, 0.0], [9.0, 0.1, 0.0]]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_free_top(integrator, comm, shared_tmp_path):
    """Angular velocities in the axes of the body are Jacobi's functions, with errors of h^2; angular momentum stays.

    Landau and Lifshitz, Mechanics, section 37, for M^2 > 2 E I2.
    """
    moments, spin, axes = np.array([0.02, 0.03, 0.04]), np.array([1.0, 0.0, 2.5]), rotation(3)
    first, second, third = moments
    twice, square = float(moments @ spin**2), float(moments**2 @ spin**2)
    rate = np.sqrt((third - second) * (square - twice * first) / (first * second * third))
    modulus = (second - first) * (twice * third - square) / ((third - second) * (square - twice * first))
    errors, drifts = [], []
    for step in (0.04, 0.02):
        wall = {**SHAPES["sphere"], "mass": 1.0, "inertia": (axes @ np.diag(moments) @ axes.T).tolist()}
        wall["angular_velocity"] = (axes @ spin).tolist()
        rows, _ = rows_of(bar(wall, FAR, integrator, step, 2.4), comm, shared_tmp_path, f"{step}")
        momenta = np.array([row["wall/w/angular_momentum"] for row in rows])
        np.testing.assert_allclose(momenta, [momenta[0]] * len(rows), rtol=0.0, atol=1e-15)
        energies = np.array([row["wall_kinetic_energy"] for row in rows])
        drifts.append(np.ptp(energies) / energies[0])
        last = rows[-1]
        turn = turns_by(last["wall/w/rotation"][None])[0]
        sn, cn, dn, _ = ellipj(rate * last["time"], modulus)
        exact = [spin[0] * cn, np.sqrt((twice * third - square) / (second * (third - second))) * sn, spin[2] * dn]
        errors.append(np.abs(axes.T @ turn.T @ last["wall/w/angular_velocity"] - exact).max())
        np.testing.assert_allclose(turn @ wall["inertia"] @ turn.T @ last["wall/w/angular_velocity"], momenta[0])
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-13
    assert errors[0] < 0.01 and errors[1] == pytest.approx(errors[0] / 4.0, rel=0.05)
    assert drifts[0] < 1e-3 and drifts[1] == pytest.approx(drifts[0] / 4.0, rel=0.05)


@pytest.mark.parametrize("shape", [*SHAPES, pytest.param("surface", marks=pytest.mark.slow)])
def test_nodes_hit_a_body_off_its_centre(shape, comm, shared_tmp_path):
    """The impulse is that of two masses, of which that of the body contains the lever: 1/M + r^2/I."""
    wall = SHAPES.get(shape)
    if wall is None:
        file = write_surface(shared_tmp_path / "box.obj", *box((0.0, -0.2, -0.3), (0.6, 0.2, 0.0)), comm)
        wall = {"type": "surface", "file": file}
    rows, _ = rows_of(falling({**wall, **BODY}), comm, shared_tmp_path)
    assert_struck(rows, 0.0, 1.0 / MASS + ARM**2 / INERTIA[1], ARM / INERTIA[1], 1.0 / MASS)


def assert_struck(rows, restitution, mobility, turned, moved):
    """Velocities after an impact with 1 m/s, and the energy lost, of a body by whose mobility nodes are stopped."""
    impulse = (1.0 + restitution) / (1.0 / NODES + mobility)
    last = rows[-1]
    assert last["momentum"][2] / NODES == pytest.approx(impulse / NODES - 1.0, abs=1e-5)
    np.testing.assert_allclose(last["wall/w/velocity"], [0.0, 0.0, -impulse * moved], atol=2e-6)
    np.testing.assert_allclose(last["wall/w/angular_velocity"], [0.0, impulse * turned, 0.0], atol=1e-5)
    lost = 0.5 * (1.0 - restitution**2) / (1.0 / NODES + mobility)
    assert last["impact_dissipation"] == pytest.approx(lost, rel=1e-6, abs=1e-15)
    assert abs(last["numerical_dissipation"]) < 1e-7
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-15
    start = totals(rows[0])
    for row in rows:
        np.testing.assert_allclose(totals(row), start, rtol=0.0, atol=1e-14)


@pytest.mark.parallel
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_restitution_off_the_centre(restitution, comm, shared_tmp_path):
    """With e = 1 the relative velocity is turned round and no energy lost."""
    wall = {**SHAPES["plane"], **BODY, "restitution": restitution}
    rows, _ = rows_of(falling(wall), comm, shared_tmp_path)
    assert_struck(rows, restitution, 1.0 / MASS + ARM**2 / INERTIA[1], ARM / INERTIA[1], 1.0 / MASS)


@pytest.mark.parametrize("integrator", ["noh_bathe", "energy_momentum"])
def test_plastic_impact_of_other_schemes(integrator, comm, shared_tmp_path):
    """Of those that stop nodes at walls; momentum and angular momentum are conserved in steps of all."""
    rows, _ = rows_of(falling({**SHAPES["plane"], **BODY}, integrator), comm, shared_tmp_path)
    impulse = 1.0 / (1.0 / NODES + 1.0 / MASS + ARM**2 / INERTIA[1])
    np.testing.assert_allclose(rows[-1]["wall/w/angular_velocity"][1], impulse * ARM / INERTIA[1], rtol=0.01)
    np.testing.assert_allclose(totals(rows[-1]), totals(rows[0]), rtol=0.0, atol=1e-11)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-15


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_paddle_on_a_hinge(restitution, comm, shared_tmp_path):
    """The hinge takes the momentum: only r^2/I stops the nodes, with I about the axis, and L_y is conserved there."""
    hinge = {"centre": [0.1, 7.0, 0.0], "axis": [0.0, -2.0, 0.0]}
    wall = {**SHAPES["rectangle"], **BODY, "hinge": hinge, "restitution": restitution}
    rows, _ = rows_of(falling(wall), comm, shared_tmp_path)
    about = INERTIA[1] + MASS * (0.1**2 + 0.1**2)
    impulse = (1.0 + restitution) / (1.0 / NODES + 0.2**2 / about)
    np.testing.assert_allclose(rows[-1]["wall/w/angular_velocity"], [0.0, 0.2 * impulse / about, 0.0], atol=1e-5)
    assert rows[-1]["momentum"][2] / NODES == pytest.approx(impulse / NODES - 1.0, abs=1e-5)
    place, velocity = rows[-1]["wall/w/position"], rows[-1]["wall/w/velocity"]
    np.testing.assert_allclose(
        velocity, np.cross(rows[-1]["wall/w/angular_velocity"], place - hinge["centre"]) * [1, 0, 1]
    )
    lost = 0.5 * (1.0 - restitution**2) / (1.0 / NODES + 0.2**2 / about)
    assert rows[-1]["impact_dissipation"] == pytest.approx(lost, rel=1e-9, abs=1e-15)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "generalized_alpha"])
def test_physical_pendulum(integrator, comm, shared_tmp_path):
    """It is at the bottom after a quarter of its period, 4 K(sin(a/2)) sqrt(I/(m g d)), as fast as it has fallen."""
    away, angle, gravity = 0.3, 1.0, 9.81
    place = [away * np.sin(angle), 0.0, -away * np.cos(angle)]
    hinge = {"centre": [0.0, 0.5, 0.0], "axis": [0.0, 1.0, 0.0]}
    wall = {"type": "sphere", "point": place, "radius": 0.1, "mass": 2.0, "inertia": [0.05, 0.06, 0.07]}
    about = 0.06 + 2.0 * away**2
    quarter = ellipk(np.sin(0.5 * angle) ** 2) * np.sqrt(about / (2.0 * gravity * away))
    case = bar({**wall, "hinge": hinge, "gravity": True}, FAR, integrator, quarter / 200.0, quarter)
    case["gravity"] = {"acceleration": [0.0, 0.0, -gravity]}
    rows, _ = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(rows[-1]["wall/w/position"], [0.0, 0.0, -away], atol=1e-5)
    fallen = away * (1.0 - np.cos(angle))
    speed = np.sqrt(2.0 * 2.0 * gravity * fallen / about)
    np.testing.assert_allclose(rows[-1]["wall/w/angular_velocity"], [0.0, speed, 0.0], rtol=2e-4)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
def test_ball_slides_and_rolls(integrator, comm, shared_tmp_path):
    """A solid ball that slides on a mass m, which is pressed against it, loses mu g of its speed until it rolls.

    The impulse of friction is then v/(1/m + 1/M + R^2/I); on a floor, m infinite, 5/7 of the speed are left.
    """
    radius, speed, friction, pressed, floor = 0.5, 0.02, 0.2, 10.0, 200.0
    inertia = 0.4 * MASS * radius**2
    ball = {
        "type": "sphere",
        "point": [0.0, 0.0, np.sqrt(radius**2 - 1e-6)],
        "radius": radius,
        "friction": friction,
        "mass": MASS,
    }
    wall = {**ball, "inertia": [inertia] * 3, "velocity": [speed, 0.0, 0.0]}
    points = [[0.0, -1e-3, 0.0], [0.0, 1e-3, 0.0]]
    case = bar(wall, points, integrator, 1e-4, 5e-3, floor)
    case["material"]["m"]["young_modulus"] = 1e6
    case["node_set"] = {"floor": {"all": True}}
    case["load"] = [{"node_set": "floor", "force": [0.0, 0.0, 0.5 * pressed * (MASS + floor)]}]
    rows, _ = rows_of(case, comm, shared_tmp_path)
    for row in rows[2:22]:
        np.testing.assert_allclose(row["wall/w/velocity"][0], speed - friction * pressed * row["time"], rtol=2e-3)
        spin = friction * pressed * row["time"] * MASS * radius / inertia
        np.testing.assert_allclose(row["wall/w/angular_velocity"][1], spin, rtol=4e-3)
    impulse = speed / (1.0 / floor + 1.0 / MASS + radius**2 / inertia)
    assert impulse / MASS == pytest.approx(2.0 / 7.0 * speed, rel=2e-3)
    last = rows[-1]
    np.testing.assert_allclose(last["wall/w/velocity"][0], speed - impulse / MASS, rtol=1e-3)
    np.testing.assert_allclose(last["wall/w/angular_velocity"], [0.0, impulse * radius / inertia, 0.0], atol=4e-5)
    np.testing.assert_allclose(last["momentum"][0], impulse, rtol=2e-3)
    assert last["friction_dissipation"] == pytest.approx(0.5 * impulse * speed, rel=0.06)


def tumbling(integrator, **keys):
    """A bar that meets a turning plate off its centre, with friction."""
    spin = {"angular_velocity": [0.5, -1.0, 2.0], "velocity": [0.1, 0.0, 0.2]}
    case = falling({**SHAPES["plane"], **BODY, **spin, **keys}, integrator, (0.3, 0.2, -1.0), end=0.012)
    case["material"]["m"]["young_modulus"] = 10.0
    case["mesh"]["points"] = [[ARM, -0.1, 4e-3], [ARM, 0.1, 6e-3]]
    case["material"]["m"]["density"] = 1e3
    return case


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "hinged"])
def test_bodies_on_any_rank_count(integrator, comm, shared_tmp_path):
    case = tumbling("central_differences" if integrator == "hinged" else integrator, friction=0.3)
    if integrator == "hinged":
        case["gravity"] = {"acceleration": [0.0, 0.0, -10.0]}
        hinge = {"hinge": {"centre": [0.5, 0.0, 0.1], "axis": [0.0, 1.0, 0.0]}, "gravity": True}
        case["wall"][0] |= {**hinge, "velocity": None, "angular_velocity": [0.0, 0.2, 0.0]}
    case = Case.from_dict(case)
    allowed = 1e-9 if integrator == "newmark" else 1e-14 if comm.size > 1 else 0.0
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 5, 9, allowed=allowed)
    names = "momentum", "wall_kinetic_energy", "friction_dissipation", "wall/w/rotation", "wall/w/angular_momentum"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names)
    assert np.abs(history["wall/w/moment"]).max() > 0.0


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["friction", "tied", "restitution"])
def test_momenta_are_shared_by_tumbling_bodies(kind, comm, shared_tmp_path):
    """Momentum and angular momentum stay to rounding, and energies close; tied nodes turn with the plate."""
    keys = {"friction": {"friction": 0.3}, "tied": {"tied": True}, "restitution": {"restitution": 0.8}}
    rows, run = rows_of(tumbling("central_differences", **keys[kind]), comm, shared_tmp_path)
    assert rows[-1]["wall/w/impulse"][2] > 1e-3
    for row in rows:
        np.testing.assert_allclose(totals(row), totals(rows[0]), rtol=0.0, atol=1e-14)
        assert abs(row["energy_imbalance"]) < 1e-14
    assert run.model.contact.gaps(run.state.position, run.state.time).min(initial=0.0) > -1e-12
    if kind == "tied":
        x, motion = run.state.position, run.model.contact.motion
        rates = motion.rates_at(x, run.state.time)[:, 0]
        assert run.model.contact.log.touching.all()
        np.testing.assert_allclose(run.state.v, rates, atol=5e-3)


@pytest.mark.slow
def test_contact_holds_where_wilson_solves(comm, shared_tmp_path):
    """The check at the end of a run finds nodes on bodies at t + theta h."""
    rows, run = rows_of(tumbling("wilson", tied=True), comm, shared_tmp_path)
    x, time = run.stepper.held_by_contact()
    assert time > run.state.time
    assert np.abs(run.model.contact.gaps(x, time)).max(initial=0.0) < 1e-9
    assert rows[-1]["wall/w/contacts"] == 2


@pytest.mark.slow
def test_bar_turns_a_ball_that_it_rubs_between_its_nodes(comm, shared_tmp_path):
    """The springs and friction of bars turn bodies as nodes do."""
    ball = {"type": "sphere", "point": [0.0, 0.0, -0.5], "radius": 0.5, "mass": MASS, "inertia": [0.05] * 3}
    points = [[-1.0, 0.0, 4e-3], [1.0, 0.0, 4e-3]]
    case = bar(
        {**ball, "friction": 0.3, "restitution": 0.9}, points, step=2e-4, end=0.03, velocity=(0.2, 0.5, -1.0), mass=0.2
    )
    case["material"]["m"]["young_modulus"] = 1e7
    case["self_contact"] = {}
    rows, _ = rows_of(case, comm, shared_tmp_path)
    assert rows[-1]["wall/w/impulse"][2] > 0.1
    spin = rows[-1]["wall/w/angular_velocity"]
    assert spin[0] < -0.1 and spin[1] > 0.1
    for row in rows:
        np.testing.assert_allclose(totals(row), totals(rows[0]), rtol=0.0, atol=1e-13)
        assert abs(row["energy_imbalance"]) < 1e-13


def test_body_goes_on_in_a_later_stage(comm, shared_tmp_path):
    """A top that two stages share turns as in one."""
    wall = {**SHAPES["sphere"], **BODY, "angular_velocity": [1.0, 2.0, 0.5]}
    case = bar(wall, FAR, step=0.01, end=0.2)
    whole, _ = rows_of(case, comm, shared_tmp_path, "whole")
    time = case.pop("time")
    half = {"time": {**time, "end": 0.1}}
    case["stage"] = [{"name": "one", **half}, {"name": "two", **half}]
    rows, _ = rows_of(case, comm, shared_tmp_path, "stages")
    for name in ("rotation", "angular_momentum", "angular_velocity"):
        np.testing.assert_allclose(rows[-1][f"wall/w/{name}"], whole[-1][f"wall/w/{name}"], rtol=1e-4)


def test_pictures_turn_with_bodies(comm, shared_tmp_path):
    """Between rows of the history walls turn uniformly, through half a turn too, at which rotation vectors jump."""
    wall = {**SHAPES["sphere"], "mass": 1.0, "inertia": [1.0] * 3, "angular_velocity": [0.0, 0.0, 2.0]}
    rows, run = rows_of(bar(wall, FAR, step=0.5, end=3.0), comm, shared_tmp_path)
    history = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    result = type("Result", (), {"case": run.case, "history": history})
    times = np.array([0.75, 1.6, 2.9])
    _, turns, _ = walls_at(result, times)
    angles = 2.0 * times
    np.testing.assert_allclose(turns[:, 0, 0, 0], np.cos(angles), atol=1e-12)
    np.testing.assert_allclose(turns[:, 0, 1, 0], np.sin(angles), atol=1e-12)


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_step_that_turns_too_far(integrator, comm, shared_tmp_path):
    """The angle told is that of the angular velocity: 0.02 s times sqrt(14) 100 rad/s."""
    wall = {**SHAPES["sphere"], **BODY, "angular_velocity": [300.0, 100.0, 200.0]}
    told = r"^step 1, t = 0.02 s: wall 'w' with inertia turns by about 7.48 rad in the step; .* reduce time.step"
    with pytest.raises(SimulationFailure, match=told):
        rows_of(bar(wall, FAR, integrator, step=0.02), comm, shared_tmp_path)


@pytest.mark.parametrize(
    ("integrator", "told"),
    [
        ("central_differences", "step 6, t = 0.12 s: wall 'w' with inertia turns by about 5.3 rad in the step"),
        ("newmark", "step 21, t = 0.42 s: wall 'w' with inertia turns by about 4.71 rad in the step"),
    ],
)
def test_later_step_that_turns_too_far(integrator, told, comm, shared_tmp_path):
    """A pendulum falls from its highest place; later steps of central differences are compiled."""
    hinge = {"centre": [0.299, 0.0, -0.5], "axis": [0.0, 1.0, 0.0]}
    wall = {**SHAPES["sphere"], "mass": 1.0, "inertia": [0.01] * 3, "gravity": True, "hinge": hinge}
    case = bar(wall, FAR, integrator, step=0.02, end=1.0)
    case["gravity"] = {"acceleration": [0.0, 0.0, -2500.0]}
    with pytest.raises(SimulationFailure, match=f"^{told}"):
        rows_of(case, comm, shared_tmp_path)


def test_impact_that_turns_a_light_body_too_far(comm, shared_tmp_path):
    wall = {**SHAPES["sphere"], "mass": 1e-4, "inertia": [1e-8] * 3, "centre_of_mass": [0.0, 0.0, -0.1]}
    case = falling(wall, "newmark", velocity=(0.0, 0.0, -5.0), end=1e-2)
    told = r"^step 1, t = 0.001 s: wall 'w' with inertia turns by about .* rad in the step; .* reduce time.step"
    with pytest.raises(SimulationFailure, match=told):
        rows_of(case, comm, shared_tmp_path)


def test_rotation_vectors():
    """Logarithms, changes and steps of rotations against matrices."""
    vectors = np.random.default_rng(5).normal(size=(40, 3))
    vectors[:8] *= (np.pi - np.geomspace(1e-12, 1e-2, 8))[:, None] / np.linalg.norm(vectors[:8], axis=1)[:, None]
    vectors[8:16] *= 1e-6
    vectors[16] = 0.0
    turns = turns_by(vectors)
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (40, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(vectors_of(turns), vectors, atol=1e-13)
    change = 1e-7 * np.random.default_rng(6).normal(size=(40, 3))
    small = vectors_of(turns_by(vectors + change) @ turns_by(vectors - change).swapaxes(1, 2))
    np.testing.assert_allclose(small, 2.0 * np.einsum("wij,wj->wi", changes_of_turns(vectors), change), atol=1e-13)
    inertia = np.array([rotation(k) @ np.diag(INERTIA) @ rotation(k).T for k in range(3)])
    ways, change = 0.02 * vectors[20:23], 1e-7 * change[20:23]
    steps, slopes = steps_of_bodies(ways, inertia)
    halfway = turns_by(0.5 * steps)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", halfway, np.einsum("tij,tj->ti", inertia, steps)), ways)
    moved = steps_of_bodies(ways + change, inertia)[0] - steps_of_bodies(ways - change, inertia)[0]
    np.testing.assert_allclose(np.einsum("tij,tj->ti", slopes, 2.0 * change), moved, atol=1e-15)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"inertia": INERTIA}, "inertia needs the wall's mass"),
        (
            {"mass": 1.0, "hinge": {"centre": [0.0] * 3, "axis": [0.0, 0.0, 1.0]}},
            "hinge is that of a wall with inertia",
        ),
        ({"mass": 1.0, "angular_velocity": [0.0, 0.0, 1.0]}, "angular_velocity is that of a wall with inertia"),
        ({**BODY, "inertia": [1.0, 1.0, 2.1]}, "which no body has"),
        ({**BODY, "inertia": [1.0, -1.0, 1.0]}, "which no body has"),
        ({**BODY, "inertia": [[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}, "not symmetric"),
        ({**BODY, "rotation": {"centre": [0.0] * 3, "axis": [0.0, 0.0, 1.0], "angular_velocity": 1.0}}, "at most one"),
        ({**BODY, "velocity": [1.0, 0.0, 0.0], "hinge": {"centre": [0.0] * 3, "axis": [0.0, 0.0, 1.0]}}, "at most one"),
        (
            {**BODY, "angular_velocity": [1.0, 0.0, 0.0], "hinge": {"centre": [0.0] * 3, "axis": [0.0, 0.0, 1.0]}},
            "along the axis",
        ),
        ({**BODY, "hinge": {"centre": [0.0] * 3, "axis": [0.0, 0.0, 0.0]}}, "zero length"),
        ({**BODY, "type": "surface", "file": "box.obj", "centre_of_mass": None}, "needs its centre_of_mass"),
    ],
)
def test_bad_bodies(keys, message):
    wall = {name: value for name, value in {**SHAPES["sphere"], **keys}.items() if value is not None}
    if wall["type"] == "surface":
        del wall["radius"]
    with pytest.raises(InputError, match=message):
        Case.from_dict(bar(wall, FAR), name="bad")
