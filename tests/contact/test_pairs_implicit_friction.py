"""Bodies that rub on each other in implicit and static steps: closed forms, and the same at walls and explicitly."""

import numpy as np
import pytest
from helpers.bodies import HELD, MASSES, G, bodies, case_points, rows_of, upper
from helpers.lattices import planes, rotation, simulation, two_lattices
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case
from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.mesh.generators.arrays import Truss

SCHEMES = [("newmark", {}), ("generalized_alpha", {"rho_inf": 0.0}), ("energy_momentum", {})]
OTHERS = [
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("houbolt", {}),
    ("wilson", {"theta": 1.8}),
    ("bathe", {}),
    ("hht_alpha", {"alpha": -0.1}),
    ("central_differences", {"mass": "consistent"}),
]
EVERY = SCHEMES + [pytest.param(*scheme, marks=pytest.mark.slow) for scheme in OTHERS]
ACCURATE = {"rtol": 1e-13}


def pressed(force):
    """Loads that press the bodies on each other, as uneven as their masses."""
    parts = ("lower_end", 0.5 * force), ("lower_middle", force), ("upper_end", -0.5 * force), ("upper_middle", -force)
    return [{"node_set": name, "force": [0.0, 0.0, f]} for name, f in parts]


@pytest.mark.parallel
@pytest.mark.parametrize(("integrator", "parameters"), EVERY)
def test_block_stops_after_its_way(integrator, parameters, comm, shared_tmp_path):
    """v^2/(2 mu g) along the face, as with the explicit scheme; friction dissipates the energy of the motion."""
    friction, speed, found = 0.4, 0.3, []
    for scheme, keys in ((integrator, parameters), ("central_differences", {})):
        case = bodies(
            comm,
            scheme,
            pair={"friction": friction},
            on={"upper": [0.0, speed, 0.0]},
            parameters=keys,
            solver=ACCURATE,
            **HELD,
        )
        rows, run = rows_of(case, comm, shared_tmp_path, f"{scheme}{len(keys)}")
        found.append((rows, upper(run)))
    rows, (x, v) = found[0]
    np.testing.assert_allclose(x[:, 1], speed**2 / (2.0 * friction * G), rtol=1e-3)
    np.testing.assert_allclose(x[:, 1], found[1][1][0][:, 1], rtol=1e-3)
    # the velocities of some schemes go to and fro about that of a node that is held
    assert np.abs(v).max() < 0.5 * friction * G * 1e-3
    assert rows[-1]["friction_dissipation"] == pytest.approx(0.5 * MASSES[1] * speed**2, rel=2e-2)
    sliding = [row["pair/faces/force"] for row in rows if 0.01 < row["time"] < 0.07]
    expected = np.array([0.0, -friction * G * MASSES[1], G * MASSES[1]])
    np.testing.assert_allclose(sliding, np.tile(expected, (len(sliding), 1)), rtol=1e-9, atol=1e-11)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14


@pytest.mark.parallel
@pytest.mark.parametrize(("integrator", "parameters"), EVERY)
def test_bodies_that_drag_each_other(integrator, parameters, comm, shared_tmp_path):
    """Pressed together, both free: they end with one velocity, momentum is kept, and the rest of the energy is lost."""
    on = {"lower": [0.0, -0.1, 0.0], "upper": [0.0, 0.2, 0.0]}
    case = bodies(
        comm,
        integrator,
        gravity=(0.0, 0.0, 0.0),
        pair={"friction": 0.3},
        on=on,
        load=pressed(0.02),
        end=0.2,
        parameters=parameters,
        solver=ACCURATE,
    )
    rows, run = rows_of(case, comm, shared_tmp_path)
    momentum = np.array([row["momentum"] for row in rows])
    start = MASSES @ [-0.1, 0.2]
    np.testing.assert_allclose(momentum, np.tile([0.0, start, 0.0], (len(rows), 1)), atol=1e-10 * start)
    every = run.gather(run.state.v)
    if comm.rank == 0:
        np.testing.assert_allclose(every.mean(axis=0)[1], start / MASSES.sum(), rtol=2e-2)
    lost = 0.5 * MASSES.prod() / MASSES.sum() * 0.3**2
    assert rows[-1]["friction_dissipation"] == pytest.approx(lost, rel=3e-2)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14
    row = rows[5]["pair/faces/force"]
    assert row[1] / row[2] == pytest.approx(-0.3, rel=1e-9)


@pytest.mark.parametrize(("integrator", "parameters"), SCHEMES)
def test_incline_holds_up_to_static_friction(integrator, parameters, comm, tmp_path):
    """It sticks where tan(angle) is below the static coefficient, and slides by g (sin - mu cos) above."""
    angle = 0.3
    gravity = [0.0, G * np.sin(angle), -G * np.cos(angle)]
    for static, holds in ((1.02, True), (0.98, False)):
        pair = {"friction": 0.1, "static_friction": static * np.tan(angle)}
        case = bodies(
            comm, integrator, gravity=gravity, pair=pair, parameters=parameters, solver=ACCURATE, end=0.05, **HELD
        )
        rows, run = rows_of(case, comm, tmp_path, f"{holds}")
        x, _ = upper(run)
        slides = 0.0 if holds else G * (np.sin(angle) - 0.1 * np.cos(angle))
        np.testing.assert_allclose(x[:, 1], 0.5 * slides * 0.05**2, rtol=5e-2, atol=1e-15)
        force = rows[-1]["pair/faces/force"] / (G * MASSES[1])
        drag = np.sin(angle) if holds else 0.1 * np.cos(angle)
        np.testing.assert_allclose(force, [0.0, -drag, np.cos(angle)], rtol=1e-9, atol=1e-11)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14


def spring_case(comm, table, friction, method="newton", **pair):
    """A node that is pressed on another, held one, with a bar of 100 N/m along y that holds it back."""
    mesh = Truss(
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.2], [0.0, -1.0, 0.2]],
        [[1, 2], [0, 2]],
        node_groups={"ground": [0], "block": [1], "anchor": [2]},
    )
    case = {
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "node_set": {name: {"group": name} for name in ("ground", "block", "anchor")},
        "support": [
            {"node_set": "ground", "fix": "xyz"},
            {"node_set": "anchor", "fix": "xyz"},
            {"node_set": "block", "fix": "x"},
        ],
        "load": [
            {"node_set": "block", "force": [0.0, 0.0, -10.0], "table": [[0.0, 1.0], [table[-1][0], 1.0]]},
            {"node_set": "block", "force": [0.0, 1.0, 0.0], "table": table},
        ],
        "contact_pair": [
            {
                "name": "faces",
                "first": "ground",
                "second": "block",
                "direction": [0.0, 0.0, 1.0],
                "gap": 0.2,
                "friction": friction,
                **pair,
            }
        ],
        "static": {"step": 0.05, "end": table[-1][0]},
        "output": {"fields_every": 0},
        "solver": ACCURATE,
    }
    return Case(case, mesh=mesh)


@pytest.mark.parallel
def test_static_friction_holds_up_to_its_limit(comm, shared_tmp_path):
    """Pulled to 5 N and pushed back to -5 N at a limit of 3 N: the block stays, follows, stays and follows back."""
    limit, stiffness = 3.0, 100.0
    case = spring_case(comm, [[0.0, 0.0], [1.0, 5.0], [3.0, -5.0]], 0.3)
    rows, run = rows_of(case, comm, shared_tmp_path)
    reached = (5.0 - limit) / stiffness
    for row in rows:
        factor = row["load_factor"]
        pull = 5.0 * factor if factor <= 1.0 else 5.0 - 5.0 * (factor - 1.0)
        if factor <= 1.0:
            u = max(pull - limit, 0.0) / stiffness
        else:
            u = min(reached, (pull + limit) / stiffness)
        drag = stiffness * u - pull
        np.testing.assert_allclose(row["pair/faces/force"], [0.0, drag, 10.0], atol=1e-8)
        assert row["elastic_energy"] == pytest.approx(0.5 * stiffness * u**2, rel=1e-8, abs=1e-12)
    way = reached + (reached - (-5.0 + limit) / stiffness)
    assert rows[-1]["friction_dissipation"] == pytest.approx(limit * way, rel=1e-8)
    assert np.abs([row["energy_imbalance"] for row in rows]).max() < 1e-10


def test_static_friction_beyond_which_it_breaks_loose(comm, tmp_path):
    """Held up to 5 N by static friction; then it slips until 3 N are left, and is held there again."""
    rows, _ = rows_of(spring_case(comm, [[0.0, 0.0], [1.0, 6.0]], 0.3, static_friction=0.5), comm, tmp_path)
    slipped = 0.0
    for row in rows:
        pull = 6.0 * row["load_factor"]
        if not slipped and pull > 5.0:
            slipped = pull - 3.0
        assert row["pair/faces/force"][1] == pytest.approx(slipped - pull, abs=1e-8)
        assert row["elastic_energy"] == pytest.approx(0.005 * slipped**2, rel=1e-8, abs=1e-12)
    assert slipped > 0.0


@pytest.mark.parametrize(("integrator", "parameters"), SCHEMES)
@pytest.mark.parametrize("moved", ["lower", "upper"])
def test_a_moving_body_takes_the_other_along(integrator, parameters, moved, comm, tmp_path):
    """A body that supports move drags the other with mu times the force between them until it has its velocity."""
    speed, friction, force = np.array([0.06, -0.08, 0.05]), 0.3, 0.02
    other = "upper" if moved == "lower" else "lower"
    mass = MASSES[1 if other == "upper" else 0]
    support = [{"node_set": moved, "fix": "xyz", "velocity": speed.tolist()}]
    case = bodies(
        comm,
        integrator,
        gravity=(0.0, 0.0, 0.0),
        pair={"friction": friction},
        on={other: [0.0, 0.0, speed[2]]},
        load=pressed(force),
        support=support,
        parameters=parameters,
        solver=ACCURATE,
        end=0.08,
    )
    rows, run = rows_of(case, comm, tmp_path)
    total = 2.0 * force
    late = 0.1 * mass / (friction * total)
    assert late < 0.06
    nodes = slice(3, 6) if other == "upper" else slice(0, 3)
    x, v = run.gather(run.state.position)[nodes] - case_points()[nodes], run.gather(run.state.v)[nodes]
    way = speed[:2] * (0.08 - 0.5 * late)
    np.testing.assert_allclose(x[:, :2], np.tile(way, (3, 1)), rtol=5e-3)
    np.testing.assert_allclose(x[:, 2], 0.08 * speed[2], rtol=1e-9)
    np.testing.assert_allclose(v, np.tile(speed, (3, 1)), atol=4e-3)
    assert rows[-1]["friction_dissipation"] == pytest.approx(0.5 * friction * total * 0.1 * late, rel=1e-2)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-13


@pytest.mark.parallel
@pytest.mark.parametrize(("integrator", "parameters"), SCHEMES)
def test_a_held_body_is_a_wall(integrator, parameters, comm, shared_tmp_path):
    """Nodes that fall askew on held ones do the same at a plane wall."""
    direction, found = np.array([0.0, -0.2, 1.0]), []
    on = {"upper_end": [0.3, 0.4, -0.2], "upper_middle": [0.3, 0.1, -0.4]}
    pair = {"direction": direction.tolist(), "gap": 0.0085, "friction": 0.35, "static_friction": 0.5}
    wall = planes([direction], [0.0085], node_set="upper", friction=0.35, static_friction=0.5)
    for name, tables in (("pair", {"pair": pair}), ("wall", {"pairs": False, "wall": wall})):
        case = bodies(comm, integrator, on=on, parameters=parameters, solver=ACCURATE, end=0.05, **tables, **HELD)
        rows, run = rows_of(case, comm, shared_tmp_path, name)
        found.append((rows, *upper(run)))
    (pairs, *motion), (walls, *expected) = found
    np.testing.assert_allclose(motion[0], expected[0], rtol=0.0, atol=1e-9 * np.abs(expected[0]).max())
    np.testing.assert_allclose(motion[1], expected[1], rtol=0.0, atol=1e-8)
    forces = (
        np.array([row[name] for row in rows])
        for rows, name in ((pairs, "pair/faces/force"), (walls, "wall/wall1/force"))
    )
    force, other = forces
    np.testing.assert_allclose(force, other, rtol=0.0, atol=1e-8 * np.abs(other).max())
    assert (other[:, 2] > 0.0).sum() > 3
    for name in ("friction_dissipation", "impact_dissipation", "numerical_dissipation", "kinetic_energy"):
        assert pairs[-1][name] == pytest.approx(walls[-1][name], rel=1e-7, abs=1e-13)


@pytest.mark.parallel
@pytest.mark.parametrize(
    "support",
    [[], [{"node_set": "upper", "fix": "xyz"}], [{"node_set": "upper", "fix": "xy"}]],
    ids=["free", "held", "guided"],
)
def test_either_node_may_be_held(support, comm, shared_tmp_path):
    """A pair is the same from both sides: bodies, direction and loads reversed."""
    found = []
    for first, second, sign in (("lower", "upper", 1.0), ("upper", "lower", -1.0)):
        pair = {"first": first, "second": second, "direction": [0.0, 0.1 * sign, sign], "friction": 0.3}
        case = bodies(
            comm,
            "newmark",
            gravity=(0.0, 0.0, 0.0),
            pair={**pair, "gap": 0.0099},
            on={"lower": [0.05, -0.1, 0.1]},
            load=pressed(0.02),
            support=support,
            solver=ACCURATE,
            end=0.04,
        )
        rows, run = rows_of(case, comm, shared_tmp_path, first)
        found.append(([sign * row["pair/faces/force"] for row in rows], run.gather(run.state.position)))
        assert rows[-1]["friction_dissipation"] > 0.0
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-10)
    if comm.rank == 0:
        np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-12)


@pytest.mark.parametrize(("integrator", "parameters"), SCHEMES)
@pytest.mark.parametrize("axis", [0, 1])
def test_held_nodes_and_a_floor_with_friction(integrator, parameters, axis, comm, tmp_path):
    """The lower body rests on a rough floor: what rubs on it moves it only beyond the friction of the floor."""
    for floor, moves in ((0.5, False), (0.1, True)):
        wall = planes([[0.0, 0.0, 1.0]], [0.0], friction=floor, name="floor")
        velocity = [0.0, 0.0, 0.0]
        velocity[axis] = 1.0
        case = bodies(
            comm,
            integrator,
            pair={"friction": 0.4},
            on={"upper": velocity},
            wall=wall,
            parameters=parameters,
            solver=ACCURATE,
            end=0.03,
        )
        rows, run = rows_of(case, comm, tmp_path, f"{moves}")
        dragged = max(0.4 * G * MASSES[1] - floor * G * MASSES.sum(), 0.0) / MASSES[0]
        x = run.gather(run.state.position)[:3] - case_points()[:3]
        np.testing.assert_allclose(x[:, axis], 0.5 * dragged * 0.03**2, rtol=0.1, atol=1e-14)
        weights = [G * MASSES[1], G * MASSES.sum()]
        pair_force, wall_force = rows[-1]["pair/faces/force"], rows[-1]["wall/floor/force"]
        np.testing.assert_allclose([pair_force[2], wall_force[2]], weights, rtol=1e-9)
        assert pair_force[axis] == pytest.approx(-0.4 * weights[0], rel=1e-9)
        assert wall_force[axis] == pytest.approx(-floor * weights[1] if moves else -0.4 * weights[0], rel=1e-9)
        assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-13


@pytest.mark.parallel
@pytest.mark.parametrize("operator", ["assembled", "matrix_free"])
def test_guided_nodes_slip_on_a_floor_beside_pairs(operator, comm, shared_tmp_path):
    """Supports drag the lower body in one direction, while the other one rubs on it: what they prescribe is exact."""
    wall = planes([[0.0, 0.0, 1.0]], [0.0], friction=0.1, name="floor")
    case = bodies(
        comm,
        "newmark",
        pair={"friction": 0.4},
        on={"upper": [0.0, 0.5, 0.0], "lower": [0.2, 0.0, 0.0]},
        wall=wall,
        support=[{"node_set": "lower", "fix": "x", "velocity": [0.2, 0.0, 0.0]}],
        solver=ACCURATE | {"operator": operator},
        end=0.02,
    )
    rows, run = rows_of(case, comm, shared_tmp_path)
    x = comm.bcast(run.gather(run.state.position))[:3] - case_points()[:3]
    np.testing.assert_allclose(x[:, 0], 0.2 * 0.02, rtol=0.0, atol=1e-15)
    gained = rows[-1]["momentum"] - rows[0]["momentum"]
    names = "external_impulse", "support_impulse", "wall/floor/impulse"
    given = sum(rows[-1][name] - rows[0][name] for name in names)
    np.testing.assert_allclose(gained, given, rtol=0.0, atol=1e-10 * np.abs(given).max())
    force = rows[-1]["wall/floor/force"]
    assert np.hypot(force[0], force[1]) == pytest.approx(0.1 * force[2], rel=1e-9)
    assert force[0] < 0.0 and force[1] < 0.0 and x[:, 1].min() > 0.0
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-13


def tower(comm, frictions, integrator, pushed, ring=(), **tables):
    """Four nodes above each other, each but the lowest with a bar to a node of its own that it takes along."""
    z = 0.01 * np.arange(4)
    points = np.concatenate([np.column_stack([x + 0.0 * z, 0.0 * z, z]) for x in (0.0, 0.1)])
    names = [f"level{k}" for k in range(4)]
    mesh = Truss(points, [[k, k + 4] for k in range(4)], node_groups={name: [k, k + 4] for k, name in enumerate(names)})
    pairs = [(k, k + 1, mu) for k, mu in enumerate(frictions)]
    pair = {"direction": [0.0, 0.0, 1.0], "gap": 0.01}
    case = {
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "node_set": {name: {"group": name} for name in names},
        "support": [{"node_set": "level0", "fix": "xyz"}],
        "initial": {"on": [{"node_set": names[pushed], "velocity": [0.0, 1.0, 0.0]}]},
        "gravity": {"acceleration": [0.0, 0.0, -G]},
        "contact_pair": [
            {"name": f"p{a}", "first": names[a], "second": names[b], "friction": mu, **pair} for a, b, mu in pairs
        ]
        + list(ring),
        "time": {"integrator": integrator, "step": 1e-3, "end": 0.02},
        "output": {"fields_every": 0},
        "solver": ACCURATE,
        **tables,
    }
    return Case(case, mesh=mesh)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["newmark", "energy_momentum"])
def test_nodes_in_several_pairs(integrator, comm, shared_tmp_path):
    """The third level of a tower is shot out: it drags those below and above with mu times the weight on each face."""
    mass, weights = 1e-3, G * 1e-3 * np.array([3.0, 2.0, 1.0])
    rows, run = rows_of(tower(comm, [0.1, 0.3, 0.2], integrator, 2), comm, shared_tmp_path)
    drags = np.array([0.1, 0.3, 0.2]) * weights
    expected = np.array([0.0, drags[1] - drags[0], -drags[1] - drags[2], drags[2]]) / mass
    v = run.gather(run.state.v)
    if comm.rank == 0:
        np.testing.assert_allclose(v[:4, 1], [0.0, *(0.02 * expected[1:] + [0.0, 1.0, 0.0])], rtol=1e-9, atol=1e-13)
        np.testing.assert_allclose(v[4:], v[:4], atol=1e-12)
    for k, sign in enumerate((1.0, 1.0, -1.0)):
        force = rows[-1][f"pair/p{k}/force"]
        np.testing.assert_allclose(force, [0.0, -sign * drags[k], weights[k]], rtol=1e-9, atol=1e-12)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-13


def test_faces_in_two_directions(comm, tmp_path):
    """A node in a groove of another, smooth on one face: the drag is that of the other."""
    points = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.1, 0.0, 0.1], [0.1, 0.0, 0.0]]
    mesh = Truss(points, [[1, 2], [0, 3]], node_groups={"one": [0, 3], "two": [1, 2]})
    normals = np.array([[0.0, 1.0, 1.0], [0.0, -1.0, 1.0]]) / np.sqrt(2.0)
    pair = {"first": "one", "second": "two"}
    case = Case(
        {
            "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
            "section": {"s": {"area": 1e-5, "material": "m"}},
            "node_set": {"one": {"group": "one"}, "two": {"group": "two"}},
            "support": [{"node_set": "one", "fix": "xyz"}],
            "load": [{"node_set": "two", "force": [0.4, 0.0, -1.0]}],
            "contact_pair": [
                {"name": name, "direction": n.tolist(), "gap": float(n @ [0.0, 0.0, 0.1]), "friction": mu, **pair}
                for name, n, mu in zip(("a", "b"), normals, (0.3, 0.0), strict=True)
            ],
            "time": {"integrator": "newmark", "step": 1e-4, "end": 2e-3},
            "output": {"fields_every": 0},
            "solver": ACCURATE,
        },
        mesh=mesh,
    )
    rows, _ = rows_of(case, comm, tmp_path)
    normal = 1.0 / np.sqrt(2.0)
    for row in rows[2:]:
        np.testing.assert_allclose(row["pair/a/force"], 2.0 * normal * (normals[0] - [0.3, 0.0, 0.0]), atol=1e-9)
        np.testing.assert_allclose(row["pair/b/force"], 2.0 * normal * normals[1], atol=1e-9)
        assert row["momentum"][0] == pytest.approx((0.8 - 0.6 * normal) * row["time"], rel=1e-9)


def small_lattices(file, integrator, turn=None, solver=None, **tables):
    """Two cells that meet askew, rub and part."""
    case = two_lattices(
        file,
        integrator,
        turn=turn,
        cells=(1, 1, 1),
        velocity=(2.0, 1.2, -0.7),
        step=5e-4,
        end=8e-3,
        solver={"rtol": 1e-12, "linear": "cg", **(solver or {})},
    )
    case["contact_pair"][0] |= {"friction": 0.2, "static_friction": 0.3}
    return case | tables


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["pairs", "beside a wall"])
def test_any_number_of_ranks(kind, comm, shared_tmp_path):
    """Lattices that meet and rub: the run on all ranks is that on one, and one in two parts that in one."""
    case = small_lattices(shared_tmp_path / "m.vtu", "newmark")
    if kind == "beside a wall":
        case["wall"] = planes([[0.0, 0.1, 1.0]], [-0.001], friction=0.3, node_set="left")
    case = Case.from_dict(case)
    # two bodies may be divided among ranks in another way in each run
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 8, allowed=1e-7 if comm.size > 1 else 0.0)
    assert history["friction_dissipation"][-1] > 0.0
    assert np.abs(history["energy_imbalance"]).max() < 1e-10
    names = "pair/faces/force", "impact_dissipation", "friction_dissipation", "centre_of_mass", "elastic_energy"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names, within=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [{"linear": "mumps"}, {"operator": "matrix_free"}, {"linear": "gamg"}], ids=str)
def test_lattices_turned_in_space(solver, comm, tmp_path):
    """The same in another frame, by any solver."""
    found = []
    for k, turn in enumerate((np.eye(3), rotation(6))):
        case = small_lattices(tmp_path / f"{k}.vtu", "newmark", turn, solver if k else {"linear": "mumps"})
        run = simulation(case, comm, tmp_path, f"r{k}")
        rows = [step.row for step in run]
        found.append(
            (np.array([row["pair/faces/force"] for row in rows]) @ turn, run.gather(run.state.position) @ turn)
        )
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-8 * np.abs(found[0][0]).max())
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-10)


FLOOR = planes([[0.0, 0.1, 1.0]], [-0.001], node_set="left")[0]
BALL = {"type": "sphere", "point": [0.05, 0.1, -1.003], "radius": 1.0, "node_set": "left"}
BESIDE = {
    "nothing": [],
    "rough": planes([[0.0, 0.1, 1.0], [0.1, 1.0, -0.2]], [-0.001, -0.04], friction=0.3, node_set="left"),
    "smooth": planes([[0.0, 0.1, 1.0]], [-0.001], node_set="right"),
    "sphere": [BALL | {"friction": 0.3}],
    "tied": [FLOOR | {"tied": True}],
    "moving": [FLOOR | {"velocity": [0.5, 0.0, 0.2], "friction": 0.3}],
    "mass": [FLOOR | {"mass": 0.01, "friction": 0.3}],
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", BESIDE)
@pytest.mark.parametrize(("integrator", "parameters"), SCHEMES)
def test_every_step_obeys_the_law_of_coulomb(integrator, parameters, kind, comm, tmp_path):
    """Rows are satisfied and none pulls; drags are within the cone, and on it against the slip where there is any."""
    case = small_lattices(tmp_path / "m.vtu", integrator, wall=BESIDE[kind])
    case["time"] |= parameters
    run = simulation(case, comm, tmp_path)
    links, solve, n = run.model.links, run.stepper.solve, np.array(case["contact_pair"][0]["direction"])
    rows, n, count = links.rows, n / np.linalg.norm(n), np.zeros(2, dtype=int)

    def observed(balance):
        before = rows.gather(run.state.position)
        solution = solve(balance)
        x = rows.gather(balance.predictor + solution.u)
        pressed, values = links.force > 0.0, rows.values(x)
        assert links.force.min() >= 0.0 and values.min() > -1e-10
        assert np.abs(values[pressed]).max(initial=0.0) < 1e-10
        slip = rows.slips(x - before)
        slip -= np.outer(slip @ n, n)
        size, largest = np.linalg.norm(slip, axis=1), links.force.max()
        slides, held = pressed & (size > 1e-9), pressed & (size <= 1e-9)
        against = -0.2 * links.force[slides, None] * slip[slides] / size[slides, None]
        np.testing.assert_allclose(links.drag[slides], against, atol=1e-6 * largest)
        assert (np.linalg.norm(links.drag[held], axis=1) <= 0.3 * links.force[held] + 1e-8 * largest).all()
        assert np.abs(links.drag[~pressed]).max(initial=0.0) == 0.0
        count[:] += slides.sum(), held.sum()
        return solution

    run.stepper.solve = observed
    history = [step.row for step in run]
    assert count.min() > 0
    assert max(abs(row["energy_imbalance"]) for row in history) < 1e-9 * history[0]["kinetic_energy"]
    if kind == "nothing":
        momentum = np.array([row["momentum"] for row in history])
        assert np.abs(momentum - momentum[0]).max() < 1e-10 * np.abs(momentum[0]).max()


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"contact": {"treatment": "stick"}}, 'contact_pair .faces.: friction needs contact.treatment = "scheme"'),
        ({"pair": {"restitution": 0.5}}, "restitution together with friction needs central_differences"),
    ],
)
def test_refusals(tables, message, comm, tmp_path):
    pair = {"friction": 0.3, **tables.pop("pair", {})}
    with pytest.raises(InputError, match=message):
        rows_of(bodies(comm, "newmark", pair=pair, **tables), comm, tmp_path)


@pytest.mark.parallel
def test_nodes_that_nothing_else_may_hold(comm, shared_tmp_path):
    """Walls on both sides of a pair, supports of different components and rings of pairs end the run with a message."""
    message = r"none of the nodes .* of pair .* can move freely .* walls stop each of them, supports .* in a ring"
    sides = planes([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], [0.0, -0.01])
    mixed = [{"node_set": "lower", "fix": "x"}, {"node_set": "upper", "fix": "y"}]
    cases = [
        bodies(comm, "newmark", pair={"friction": 0.3}, end=2e-3, wall=sides),
        bodies(comm, "newmark", pair={"friction": 0.3}, end=2e-3, support=mixed, load=pressed(0.01)),
    ]
    for k, case in enumerate(cases):
        with pytest.raises(SimulationFailure, match=message):
            rows_of(case, comm, shared_tmp_path, f"{k}")
    pair = {"name": "ring", "first": "level1", "second": "level3", "direction": [0.0, 1.0, 0.0], "friction": 0.1}
    with pytest.raises(SimulationFailure, match=message):
        rows_of(tower(comm, [0.1, 0.3, 0.2], "newmark", 2, [pair]), comm, shared_tmp_path, "ring")
