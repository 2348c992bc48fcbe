"""Wall types: position, nodes that they stop, motion, and initial positions of nodes."""

import numpy as np
import pytest
from helpers.lattices import box, lattice_case, planes, simulation

from pfem_petsc import Case
from pfem_petsc.contact.walls import cylinder, rectangle, sphere
from pfem_petsc.errors import InputError, SimulationFailure

EXPLICIT = ("central_differences", {})
IMPLICIT = ("newmark", {})


def run_of(case, comm, folder, name="result"):
    """Rows of a run, and the final positions on rank 0."""
    run = simulation(case, comm, folder, name)
    rows = [step.row for step in run]
    return rows, run.gather(run.state.position), run


def test_curved_surfaces_are_distances():
    """n . x - d is the distance of x, and x less the distance times n is on the surface."""
    rng = np.random.default_rng(0)
    common = {"name": "w", "radius": 0.7, "point": (0.1, -0.2, 0.3)}
    ball = sphere.Wall(sphere.Parameters(type="sphere", **common))
    bowl = sphere.Wall(sphere.Parameters(type="sphere", side="inside", **common))
    tube = cylinder.Wall(cylinder.Parameters(type="cylinder", axis=(1.0, 2.0, -0.5), **common))
    x = rng.normal(size=(50, 3))
    for wall, sign in ((ball, 1.0), (bowl, -1.0), (tube, 1.0)):
        normals, offsets = wall.planes(x)
        gap = np.einsum("ij,ij->i", normals, x) - offsets
        arm = x - np.array(common["point"])
        if wall is tube:
            arm = arm - np.outer(arm @ tube.axis, tube.axis)
        np.testing.assert_allclose(gap, sign * (np.linalg.norm(arm, axis=1) - 0.7), atol=1e-14)
        foot = x - gap[:, None] * normals
        np.testing.assert_allclose(
            np.einsum("ij,ij->i", wall.planes(foot)[0], foot) - wall.planes(foot)[1], 0, atol=1e-14
        )
    normals, offsets = ball.planes(np.array([common["point"]]))  # the very centre has no direction of its own
    assert np.linalg.norm(normals[0]) == 1.0 and normals[0] @ np.array(common["point"]) - offsets[0] == pytest.approx(
        -0.7
    )


def test_rectangle_stops_what_comes_through_it():
    wall = rectangle.Wall(
        rectangle.Parameters(
            name="w", type="rectangle", point=(0, 0, 1.0), normal=(0, 0, 2.0), along=(1.0, 0, 5.0), size=(2.0, 1.0)
        )
    )
    before = np.array([[0.0, 0, 2], [0.9, 0.4, 1.1], [1.1, 0, 2], [0.0, 0.0, 0.5], [0.0, 0, 1.0], [1.9, 0, 2]])
    after = np.array([[0.0, 0, 0], [0.95, 0.45, 0.9], [1.1, 0, 0], [0.0, 0.0, 0.4], [0.0, 0, 0.9], [-0.1, 0, 0]])
    expected = [True, True, False, False, True, True]  # the fourth was beyond it already, the last crosses at 0.9
    assert wall.stops(before, after, np.full(6, 1e-9)).tolist() == expected


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", [EXPLICIT, IMPLICIT])
def test_rectangle_beside_the_truss(integrator, parameters, comm, shared_tmp_path):
    """A lattice falls on a plate under its left half: only nodes over it are held, the others fall past."""
    wall = {
        "type": "rectangle",
        "name": "plate",
        "point": [0.0, 0.05, -0.02],
        "normal": [0, 0, 1.0],
        "along": [1.0, 0, 0],
        "size": [0.15, 0.3],
    }
    case = lattice_case([wall], velocity=[0, 0, -3.0], integrator=integrator, step=2e-4, end=0.05)
    rows, x, _ = run_of(case, comm, shared_tmp_path)
    assert max(row["wall/plate/contacts"] for row in rows) >= 2
    if comm.rank == 0:
        over = (np.abs(x[:, 0]) <= 0.075) & (np.abs(x[:, 1] - 0.05) <= 0.15)
        assert x[:, 2].min() < -0.06 and (x[~over, 2] < -0.02).any()


@pytest.mark.parallel
@pytest.mark.parametrize("integrator, parameters", [EXPLICIT, IMPLICIT])
def test_ball_stays_on_the_surface(integrator, parameters, comm, shared_tmp_path):
    """While a lattice lies on a sphere, no node is inside of it, and those pressed are on it to 1e-12."""
    wall = {"type": "sphere", "name": "ball", "point": [0.1, 0.05, -0.32], "radius": 0.3}
    case = lattice_case(
        [wall],
        velocity=[0.3, 0, -2.0],
        integrator=integrator,
        step=2e-4,
        end=0.02,
        cells=[2, 2, 1],
        solver={"rtol": 1e-12},
    )
    run = simulation(case, comm, shared_tmp_path)
    centre, most = np.array(wall["point"]), 0
    for step in run:
        x = run.state.position
        assert (np.linalg.norm(x - centre, axis=1) >= 0.3 - 1e-12 * 0.2).all()
        if integrator == "newmark":  # central differences solve for the position after the next
            pressed = np.linalg.norm(run.state.contact, axis=1) > 0.0
            np.testing.assert_allclose(np.linalg.norm(x[pressed] - centre, axis=1), 0.3, atol=1e-12 * 0.2)
        most = max(most, step.row["wall/ball/contacts"])
    assert most >= 1


@pytest.mark.parallel
def test_adjust_moves_nodes_onto_the_wall(comm, shared_tmp_path):
    """Nodes that start beyond the wall start on it, and their bars without stress."""
    walls = planes([[0.0, 0.1, 1.0]], [0.004], adjust=True, friction=0.1, restitution=0.2)
    rows, _, run = run_of(lattice_case(walls, end=0.002), comm, shared_tmp_path)
    points = run.mesh.points[: run.mesh.n_owned]
    normal = run.model.contact.walls[0].normal
    lowest = min(comm.allgather(float((points @ normal).min(initial=np.inf))))
    assert lowest == pytest.approx(0.004, abs=1e-15)
    assert rows[-1]["elastic_energy"] == 0.0 and rows[-1]["kinetic_energy"] == 0.0
    assert any("moved onto" in warning for warning in run.model.warnings)


def test_starting_beyond_a_wall_is_refused(comm, shared_tmp_path):
    with pytest.raises(InputError, match=r"wall 'wall1': node \d+ starts 0.01 m beyond the wall \(\d+ nodes in all\)"):
        simulation(lattice_case(planes([[0.0, 0.0, 1.0]], [0.01])), comm, shared_tmp_path)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator, parameters", [EXPLICIT, IMPLICIT])
def test_walls_that_leave_no_room(integrator, parameters, comm, shared_tmp_path):
    """Walls that close in on a node until they overlap: a failure that names it, step and time, on all ranks."""
    walls = planes([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], [-0.001, -0.0041], node_set="corner")
    walls[0]["velocity"], walls[1]["velocity"] = [0.0, 0.0, 2.0], [0.0, 0.0, -2.0]  # they meet at 1.275 ms
    case = lattice_case(walls, node_set={"corner": {"nearest": [0.0, 0.0, 0.0]}}, step=2e-4, end=0.01)
    case["time"] |= {"integrator": integrator, **parameters}
    told = "step 7, t = 0.0014 s: no position of node 0 satisfies all walls"
    with pytest.raises(SimulationFailure, match=told):
        simulation(case, comm, shared_tmp_path).run()


def test_curved_walls_that_leave_no_room(comm, shared_tmp_path):
    """A node in a small bowl that carries it into another wall: smaller steps are not the only way out that is told."""
    bowl = {"type": "sphere", "side": "inside", "point": [0.0, 0.0, 0.0], "radius": 1e-6, "node_set": "corner"}
    bowl["velocity"] = [-1.0, 0.0, 0.0]
    post = {"type": "cylinder", "axis": [0.0, 0.3, 1.0], "point": [-0.5, 0.0, 0.0], "radius": 0.5, "node_set": "corner"}
    case = lattice_case([bowl, post], node_set={"corner": {"nearest": [0.0, 0.0, 0.0]}}, velocity=[-1.0, 0.5, 0.0])
    with pytest.raises(SimulationFailure, match=r"node 0 on curved walls .* infeasible together; move the walls apart"):
        simulation(case, comm, shared_tmp_path).run()


@pytest.mark.parametrize(
    "keys, message",
    [
        ({"velocity": [1.0, 0, 0], "motion": [[0.0, 0, 0, 0]]}, "at most one of the keys velocity, motion"),
        ({"motion": [[0.0, 0, 0, 0], [0.0, 1, 0, 0]]}, "times must increase"),
        ({"type": "sphere", "radius": -1.0}, "radius"),
        ({"type": "rectangle", "along": [0, 0, 2.0], "size": [1.0, 1.0]}, "parallel"),
    ],
)
def test_refusals(keys, message):
    wall = {"type": "plane", "point": [0.0, 0, -1], "normal": [0.0, 0, 1]} | keys
    if wall["type"] == "sphere":
        del wall["normal"]
    with pytest.raises(InputError, match=message):
        Case.from_dict(lattice_case([wall]))


@pytest.mark.parallel
def test_reports_of_a_bounce(comm, shared_tmp_path):
    """Impulse, contact time and releases of a lattice that bounces off the floor."""
    case = lattice_case(box([-1.0, -1, -0.01], [1.0, 1, 5.0]), velocity=[0, 0, -2.0], step=2e-4, end=0.03)
    rows, _, run = run_of(case, comm, shared_tmp_path)
    last = rows[-1]
    change = (last["momentum"] - np.array([0, 0, -2.0]) * run.model.total_mass)[2]
    force = np.array([row["wall/wall3/force"] for row in rows])
    contacts = np.array([row["wall/wall3/contacts"] for row in rows])
    assert last["wall/wall3/impulse"][2] == pytest.approx(2e-4 * force[:, 2].sum(), rel=1e-12)
    assert last["wall/wall3/impulse"][2] == pytest.approx(change, rel=0.02)
    assert last["wall/wall3/contact_time"] == pytest.approx(2e-4 * (contacts > 0).sum())
    case["output"] = case.get("output", {}) | {"history_every": 7}
    seldom, _, _ = run_of(case, comm, shared_tmp_path, "seldom")
    assert [seldom[k]["wall/wall3/contact_time"] for k in (6, -1)] == [
        rows[6]["wall/wall3/contact_time"],
        last["wall/wall3/contact_time"],
    ]
    assert last["wall/wall3/releases"] >= contacts.max()
    assert sum(row["active_set_changes"] for row in rows) == 2 * last["wall/wall3/releases"]
    touching = rows[int(np.argmax(force[:, 2]))]
    assert touching["wall/wall3/moment"][1] == pytest.approx(-0.1 * touching["wall/wall3/force"][2], rel=1e-6)


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_inside_of_a_tiny_sphere(integrator, comm, shared_tmp_path):
    """A node that crosses the sphere in one step: the plane of the side it comes from does not stop it at the other."""
    ball = {"type": "sphere", "name": "ball", "point": [1.0, 0, 0], "radius": 1e-8, "side": "inside", "node_set": "tip"}
    case = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
        "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "node_set": {"tip": {"nearest": [1.0, 0.0, 0.0]}},
        "initial": {"velocity": [0.01, 0.0, 0.0]},
        "wall": [ball],
        "time": {"integrator": integrator, "mass": "consistent", "step": 0.02, "end": 0.4},
        "output": {"fields_every": 0},
    }
    run = simulation(case, comm, shared_tmp_path)
    for _ in run:
        gaps = run.model.contact.gaps(run.state.position, run.state.time)
        assert gaps.min(initial=0.0) > -1e-12
