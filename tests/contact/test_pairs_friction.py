"""Bodies that rub on each other in explicit steps: sliding and sticking, momentum, energy, ranks and restarts."""

import numpy as np
import pytest
from helpers.bodies import HELD, MASSES, G, bodies, case_points, rows_of, upper
from helpers.lattices import planes, simulation, two_lattices
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case
from pfem_petsc.errors import InputError, SimulationFailure

ANGLE = 0.3
SCHEMES = ["central_differences", "chung_lee", "hulbert_chung"]


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", SCHEMES)
def test_block_stops_after_its_way(integrator, comm, shared_tmp_path):
    """v^2/(2 mu g), in all directions along the face; what friction dissipates is the energy of the motion."""
    friction, velocity = 0.4, np.array([0.0, 0.3, 0.0])
    rows, run = rows_of(
        bodies(comm, integrator, pair={"friction": friction}, on={"upper": velocity.tolist()}, **HELD),
        comm,
        shared_tmp_path,
    )
    x, v = upper(run)
    way = x[:, 1]
    np.testing.assert_allclose(way, 0.3**2 / (2.0 * friction * G), rtol=3e-3)
    assert np.abs(v).max() < 1e-8
    assert rows[-1]["friction_dissipation"] == pytest.approx(0.5 * MASSES[1] * 0.3**2, rel=3e-3)
    sliding = [row["pair/faces/force"] for row in rows if row["time"] < 0.07]
    np.testing.assert_allclose(
        sliding, np.tile([0.0, -friction * G * MASSES[1], G * MASSES[1]], (len(sliding), 1)), rtol=1e-9, atol=1e-12
    )
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14
    assert abs(rows[-1]["numerical_dissipation"]) < 1e-3 * rows[-1]["friction_dissipation"]
    assert np.diff([row["centre_of_mass"][1] for row in rows]).min() > -1e-12  # never reversed


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("rough", [False, True])
def test_bodies_that_drag_each_other(integrator, rough, comm, shared_tmp_path):
    """Pressed together, both free: they end with one velocity, momentum is kept, and the rest of the energy is lost."""
    friction, force = 0.3 * rough, 0.02
    parts = ("lower_end", 0.5 * force), ("lower_middle", force), ("upper_end", -0.5 * force), ("upper_middle", -force)
    pushes = [{"node_set": name, "force": [0.0, 0.0, f]} for name, f in parts]
    on = {"lower": [0.0, -0.1, 0.0], "upper": [0.0, 0.2, 0.0]}
    pair = {"friction": friction}
    case = bodies(comm, integrator, gravity=(0.0, 0.0, 0.0), pair=pair, on=on, load=pushes, end=0.2)
    rows, run = rows_of(case, comm, shared_tmp_path)
    momentum = np.array([row["momentum"] for row in rows])
    start = MASSES @ [-0.1, 0.2]
    np.testing.assert_allclose(momentum, np.tile([0.0, start, 0.0], (len(rows), 1)), atol=1e-12 * MASSES.sum())
    _, v = upper(run)
    np.testing.assert_allclose(v[:, 1], start / MASSES.sum() if rough else 0.2, atol=1e-8)
    lost = 0.5 * MASSES.prod() / MASSES.sum() * 0.3**2
    assert rows[-1]["friction_dissipation"] == pytest.approx(lost * rough, rel=3e-3)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14
    if rough:  # whether uneven masses slip: node by node the drag is mu times the force of the pair
        sliding = np.array([row["pair/faces/force"] for row in rows[3:5]])
        np.testing.assert_allclose(sliding[:, 1] / sliding[:, 2], -friction, rtol=1e-9)


@pytest.mark.parametrize("integrator", SCHEMES)
def test_incline_holds_up_to_static_friction(integrator, comm, tmp_path):
    """It sticks where tan(angle) is below the static coefficient, and slides by g (sin - mu cos) above."""
    gravity = [0.0, G * np.sin(ANGLE), -G * np.cos(ANGLE)]
    for static, holds in ((1.02, True), (0.98, False)):
        pair = {"friction": 0.1, "static_friction": static * np.tan(ANGLE)}
        rows, run = rows_of(bodies(comm, integrator, gravity=gravity, pair=pair, **HELD), comm, tmp_path, f"{holds}")
        x, v = upper(run)
        slides = 0.0 if holds else G * (np.sin(ANGLE) - 0.1 * np.cos(ANGLE))
        np.testing.assert_allclose(x[:, 1], 0.5 * slides * 0.1**2, rtol=1e-2, atol=1e-15)
        np.testing.assert_allclose(v[:, 1], slides * 0.1, rtol=1e-2, atol=1e-14)
        force = rows[-1]["pair/faces/force"] / (G * MASSES[1])
        drag = np.sin(ANGLE) if holds else 0.1 * np.cos(ANGLE)
        np.testing.assert_allclose(force, [0.0, -drag, np.cos(ANGLE)], rtol=1e-9, atol=1e-12)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("axis", [0, 1])
def test_held_nodes_and_a_floor_with_friction(integrator, axis, comm, tmp_path):
    """The lower body rests on a rough floor: what rubs on it moves it only beyond the friction of the floor."""
    for floor, moves in ((0.5, False), (0.1, True)):
        wall = {
            "type": "plane",
            "name": "floor",
            "point": [0.0, 0.0, 0.0],
            "normal": [0.0, 0.0, 1.0],
            "friction": floor,
        }
        velocity = [0.0, 0.0, 0.0]
        velocity[axis] = 1.0
        pair = {"friction": 0.4}
        rows, run = rows_of(
            bodies(comm, integrator, pair=pair, on={"upper": velocity}, wall=[wall], end=0.05),
            comm,
            tmp_path,
            f"{moves}",
        )
        upwards = G * MASSES
        dragged = max(0.4 * upwards[1] - floor * upwards.sum(), 0.0) / MASSES[0]
        x = run.gather(run.state.position)[:3] - case_points()[:3]
        np.testing.assert_allclose(x[:, axis], 0.5 * dragged * 0.05**2, rtol=0.05, atol=1e-15)
        weights = [G * MASSES[1], G * MASSES.sum()]
        pair_force, wall_force = rows[-1]["pair/faces/force"], rows[-1]["wall/floor/force"]
        np.testing.assert_allclose([pair_force[2], wall_force[2]], weights, rtol=1e-9)
        assert pair_force[axis] == pytest.approx(-0.4 * weights[0], rel=1e-9)
        assert wall_force[axis] == pytest.approx(-floor * weights[1] if moves else -0.4 * weights[0], rel=1e-9)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
@pytest.mark.parametrize("kind", ["pairs", "beside a wall"])
def test_any_number_of_ranks(kind, integrator, comm, shared_tmp_path):
    """Lattices that meet, rub and rebound: the run on all ranks is that on one, and one in two parts that in one."""
    keys = {"friction": 0.3, "static_friction": 0.4}
    case = two_lattices(shared_tmp_path / "m.vtu", integrator, step=2e-4, end=0.02)
    case["contact_pair"][0] |= keys | ({"restitution": 0.6} if integrator == "central_differences" else {})
    if kind == "beside a wall":
        case["wall"] = planes([[0.0, 0.1, 1.0]], [-0.001], **keys)
        case["contact_pair"].append({**case["contact_pair"][0], "name": "across", "direction": [1.0, -0.4, 0.3]})
    case = Case.from_dict(case)
    # two bodies may be divided among ranks in another way in each run
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 5, 12, allowed=1e-9 if comm.size > 1 else 0.0)
    assert history["friction_dissipation"][-1] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-10
    names = "pair/faces/force", "impact_dissipation", "friction_dissipation", "centre_of_mass", "elastic_energy"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names, within=1e-9)


BESIDE = {
    "rough": planes([[0.0, 0.1, 1.0], [0.1, 1.0, -0.2]], [-0.001, -0.04], friction=0.3),
    "static": planes([[0.0, 0.1, 1.0], [0.1, 1.0, -0.2]], [-0.001, -0.04], friction=0.2, static_friction=0.4),
    "rebounding": planes([[0.0, 0.1, 1.0]], [-0.001], restitution=0.5),
    "tied": planes([[0.0, 0.1, 1.0]], [-0.001], tied=True),
    "sphere": [{"type": "sphere", "point": [0.1, 0.1, -1.003], "radius": 1.0}],
    "rough sphere": [{"type": "sphere", "point": [0.1, 0.1, -1.003], "radius": 1.0, "friction": 0.2}],
    "rough cylinder": [
        {
            "type": "cylinder",
            "point": [0.1, 0.1, 0.1],
            "axis": [1, 0, 0],
            "radius": 0.15,
            "side": "inside",
            "friction": 0.2,
        }
    ],
    "moving": planes([[0.0, 0.1, 1.0]], [-0.001], friction=0.3, velocity=[0.5, 0.0, 0.2]),
    "rectangle": [
        {"type": "rectangle", "point": [0.1, 0.1, -0.002], "normal": [0, 0, 1], "along": [1, 0, 0], "size": [0.5, 0.5]}
        | {"friction": 0.2, "restitution": 0.3}
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("crowded", [False, True], ids=["single", "crowded"])
@pytest.mark.parametrize("kind", BESIDE)
def test_every_step_obeys_all_laws(kind, crowded, comm, tmp_path):
    """Pairs and walls at the same nodes: no row is violated, none pulls, and drags obey Coulomb's law."""
    case = two_lattices(tmp_path / "m.vtu", "central_differences", step=1e-4, end=0.01)
    static = 0.35 if kind == "static" else 0.25
    case["contact_pair"][0] |= {"friction": 0.25, "static_friction": static}
    if crowded:
        case["contact_pair"].append({**case["contact_pair"][0], "name": "across", "direction": [1.0, -0.4, 0.3]})
    case["wall"] = BESIDE[kind]
    run = simulation(case, comm, tmp_path)
    stepper, links, contact, both = run.stepper, run.model.links, run.model.contact, 0
    rows = links.rows
    for step in run:
        x = stepper.state.position + 1e-4 * stepper.state.memory["half_velocity"]  # those of the next step
        gaps, before = rows.values(rows.gather(x)), rows.gather(stepper.state.position)
        pressed = links.force > 0.0
        assert gaps.min() > -1e-12 and links.force.min() >= 0.0
        assert np.abs(gaps[pressed]).max(initial=0.0) < 1e-12
        if not contact.partial:
            assert contact.gaps(x, stepper.balance.time).min() > -1e-12
        slip = rows.slips(rows.gather(x) - before)
        slip -= np.einsum("ri,ri->r", slip, links.two.normals)[:, None] * links.two.normals
        size, drag = np.linalg.norm(slip, axis=1), np.linalg.norm(links.drag, axis=1)
        assert (drag <= static * links.force * (1.0 + 1e-12) + 1e-15).all()
        slides = pressed & (size > 1e-9)
        against = -0.25 * (links.force / np.maximum(size, 1e-300))[:, None] * slip
        np.testing.assert_allclose(links.drag[slides], against[slides], rtol=1e-4, atol=1e-9)
        both += int(np.isin(stepper.solution.walls.nodes, links.pressed()).sum())
        assert abs(step.row["energy_imbalance"]) < 1e-10
    assert both > 0


@pytest.mark.parametrize(
    ("integrator", "tables", "message"),
    [
        (
            "chung_lee",
            {"contact": {"treatment": "stick"}},
            "contact_pair 'faces': friction needs contact.treatment = \"scheme\"",
        ),
        ("central_differences", {"static_friction": 0.1}, "static_friction must be no less than friction = 0.3"),
    ],
)
def test_refusals(integrator, tables, message, comm, tmp_path):
    pair = {"friction": 0.3} | {key: value for key, value in tables.items() if key == "static_friction"}
    with pytest.raises(InputError, match=message):
        rows_of(bodies(comm, integrator, pair=pair, contact=tables.get("contact", {})), comm, tmp_path)


@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
@pytest.mark.parametrize("friction", [0.3, 0.6, 1.5, 8.0])
def test_guided_body_is_stopped_by_any_friction(integrator, friction, comm, tmp_path):
    """Falling on a slope at 60 degrees, normal force and drag both push it up: their ratio is that of the law."""
    normal, slope = np.sqrt(0.75), 0.5
    guided = [{"node_set": "lower", "fix": "xyz"}, {"node_set": "upper", "fix": "xy"}]
    pair = {"direction": [-normal, 0.0, slope], "gap": 0.00474, "friction": friction}
    case = bodies(comm, integrator, gravity=(0.0, 0.0, 0.0), pair=pair, on={"upper": [0.0, 0.0, -0.1]}, support=guided)
    rows, _ = rows_of(case, comm, tmp_path)
    x, _, z = next(row["pair/faces/force"] for row in rows if row["pair/faces/force"][2] > 0.0)
    assert x / z == pytest.approx((friction * slope - normal) / (slope + friction * normal), rel=1e-6)
    assert rows[-1]["friction_dissipation"] > 0.0
    assert abs(rows[-1]["energy_imbalance"]) < 1e-12


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
def test_a_jam_ends_the_run(integrator, comm, shared_tmp_path):
    """A body that moves pushes one that is guided at 60 degrees to the normal of their faces: beyond cot 60 = 0.577."""
    guided = [{"node_set": "lower", "fix": "xyz", "velocity": [0.1, 0.0, 0.0]}, {"node_set": "upper", "fix": "xz"}]
    for friction in (0.5, 0.7):
        pair = {"direction": [np.sqrt(0.75), 0.5, 0.0], "gap": 0.0, "friction": friction}
        case = bodies(comm, integrator, gravity=(0.0, 0.0, 0.0), pair=pair, support=guided, end=0.02)
        if friction < 0.577:
            rows, _ = rows_of(case, comm, shared_tmp_path, "free")
            assert rows[-1]["friction_dissipation"] > 0.0
            assert abs(rows[-1]["energy_imbalance"]) < 1e-12
            continue
        with pytest.raises(SimulationFailure, match=r"the friction of nodes .* on walls did not converge"):
            rows_of(case, comm, shared_tmp_path, "jammed")
