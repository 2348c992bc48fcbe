"""The same wall as planes, as triangles and as an analytic shape: the same motion, forces and energies."""

import numpy as np
import pytest
from helpers.lattices import box as six_planes
from helpers.lattices import lattice_case, planes, rows_of
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise
from helpers.triangles import ball, box, groove

from pfem_petsc import Case

ENERGIES = "kinetic_energy", "friction_dissipation", "impact_dissipation", "contact_work", "numerical_dissipation"
SLOPES = [[0.5, 0.0, 1.0], [-0.5, 0.0, 1.0]]
"""Normals of the groove."""
VALLEY = [[0.3, 0.0, 0.151], [0.4, 0.4, 0.206]]
ABOVE = [[0.3, 0.0, 0.004], [0.3, 0.2, 0.007]]


@pytest.fixture
def surface(comm, shared_tmp_path):
    """A function that writes a surface and returns the keys of a wall."""

    def keys(points, corners, name="surface"):
        path = shared_tmp_path / f"{name}.obj"
        if comm.rank == 0:
            lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
            path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (corners + 1).tolist()), ""]))
        comm.Barrier()
        return {"type": "surface", "file": str(path)}

    return keys


def bar(walls, integrator, points, velocity, steps=50, **tables):
    """A soft bar; the walls are named by their numbers."""
    return {
        "mesh": {"generator": "arrays", "points": points, "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e3, "density": 1e3}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "initial": {"velocity": velocity},
        "wall": [{"name": f"w{k}", **wall} for k, wall in enumerate(walls)],
        "time": {"integrator": integrator, "step": 1e-3, "end": 1e-3 * steps},
        "solver": {"rtol": 1e-13, "linear": "mumps"},
        "output": {"fields_every": 0},
        **tables,
    }


def assert_alike(cases, comm, folder, atol=1e-9, names=ENERGIES):
    """Runs of two cases have the same positions, velocities and energies in all steps; return the rows of the first."""
    (one, first), (other, second) = (rows_of(case, comm, folder, f"case{k}") for k, case in enumerate(cases))
    for name, error in (("position", atol), ("v", 1e2 * atol)):  # divisions of the mesh may differ
        found, expected = (run.gather(np.asarray(getattr(run.state, name))) for run in (first, second))
        if comm.rank == 0:
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=error, err_msg=name)
    scale = max(abs(row["kinetic_energy"]) for row in one)
    for name in names:
        expected = [row[name] for row in other]
        np.testing.assert_allclose(
            [row[name] for row in one], expected, rtol=0.0, atol=1e2 * atol * scale, err_msg=name
        )
    assert max(row["active_contacts"] for row in one) > 0
    return one


LAWS = {
    "smooth": {},
    "rough": {"friction": 0.3, "static_friction": 0.4},
    "bouncing": {"restitution": 0.5},
}


@pytest.mark.parallel
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "newmark", "bathe"])
def test_a_groove_is_two_planes(integrator, law, surface, comm, shared_tmp_path):
    """A bar slides down one side and hits the other: each node then touches two faces."""
    if integrator == "bathe" and law == "bouncing":
        pytest.skip("the jumps of velocity are not known with bathe")
    walls = [surface(*groove())], planes(SLOPES, [0.0, 0.0])
    cases = [bar([{**wall, **LAWS[law]} for wall in own], integrator, VALLEY, [-3.0, 0.2, -1.7], 150) for own in walls]
    rows = assert_alike(cases, comm, shared_tmp_path)
    assert (rows[-1]["friction_dissipation"] > 1e-3) == (law == "rough")


BLOCK = {
    "mass": {"mass": 0.03, "velocity": [0.1, 0.0, 0.3], "friction": 0.3},
    "motion": {"motion": [[0.0, 0.0, 0.0, 0.0], [0.05, 0.01, 0.0, 0.02]], "friction": 0.2},
    "rotation": {
        "rotation": {"centre": [0.1, 0.0, 0.2], "axis": [0.2, 1.0, 0.1], "angles": [[0.0, 0.0], [0.1, -0.2]]},
        "friction": 0.2,
    },
    "tied": {"tied": True, "velocity": [0.2, 0.0, 0.3]},
    "far turn": {"rotation": {"centre": [30.0, 0.0, 0.0], "axis": [0.0, 1.0, 0.0], "angular_velocity": 0.02}},
}


@pytest.mark.parallel
@pytest.mark.parametrize("kind", BLOCK)
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_the_top_of_a_box_is_a_plane(integrator, kind, surface, comm, shared_tmp_path):
    walls = surface(*box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0))), planes([[0.0, 0.0, 1.0]], [0.0])[0]
    cases = [bar([{**wall, **BLOCK[kind]}], integrator, ABOVE, [0.3, 0.0, -1.0]) for wall in walls]
    assert_alike(cases, comm, shared_tmp_path)


@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "generalized_alpha", "energy_momentum"])
def test_the_work_of_a_wall_that_turns_is_torque_times_angle(integrator, surface, comm, shared_tmp_path):
    """With a wall that turns about a far centre, for the mean torques of the steps; the balance of energy closes."""
    turn, angle = BLOCK["far turn"]["rotation"], 0.02 * 1e-3
    wall = {**surface(*box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0))), **BLOCK["far turn"]}
    rows, _ = rows_of(bar([wall], integrator, ABOVE, [0.3, 0.0, -1.0]), comm, shared_tmp_path)
    force, moment = (np.array([row[f"wall/w0/{name}"] for row in rows]) for name in ("force", "moment"))
    torque = (moment - np.cross(turn["centre"], force)) @ turn["axis"]
    assert rows[-1]["contact_work"] == pytest.approx(angle * torque.sum(), rel=1e-11)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-12


@pytest.mark.parametrize(
    ("treatment", "keys"),
    [("stick", {"friction": 0.2}), ("stick", {"restitution": 0.5}), ("stick", {"tied": True}), ("conserving", {})],
)
def test_treatments_of_impact_are_those_of_a_plane(treatment, keys, surface, comm, shared_tmp_path):
    walls = surface(*box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0))), planes([[0.0, 0.0, 1.0]], [0.0])[0]
    cases = [
        bar(
            [{**wall, "velocity": [0.0, 0.1, 0.2], **keys}],
            "newmark",
            ABOVE,
            [0.3, 0.0, -1.0],
            contact={"treatment": t},
        )
        for wall, t in zip(walls, 2 * [treatment], strict=True)
    ]
    assert_alike(cases, comm, shared_tmp_path)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_a_room_is_six_planes(integrator, surface, comm, shared_tmp_path):
    """A lattice tumbles in a box of twelve triangles: its nodes touch faces, edges and corners from inside."""
    low, high = (-0.005, -0.006, -0.003), (0.208, 0.107, 0.106)
    walls = [{**surface(*box(low, high)), "flip": True}], six_planes(low, high)
    cases = [
        lattice_case(
            [{"name": f"w{k}", **wall} for k, wall in enumerate(own)],
            integrator=integrator,
            velocity=(1.0, 0.7, -2.0),
            spin=(5.0, 3.0, 8.0),
            end=0.01,
            solver={"rtol": 1e-13, "linear": "mumps"},
        )
        for own in walls
    ]
    rows = assert_alike(cases, comm, shared_tmp_path)
    assert max(row["wall/w0/contacts"] for row in rows) > 4


def test_balls_of_triangles_approach_the_sphere(surface, comm, shared_tmp_path):
    """The distance of a bar that slides down falls with the square of the size of the faces, as their depth does."""

    def path(wall):
        case = bar([wall], "central_differences", [[0.3, 0.0, 0.956], [0.3, 0.2, 0.935]], [0.5, 0.0, 0.0], 100)
        case["gravity"] = {"acceleration": [0.0, 0.0, -10.0]}
        rows, run = rows_of(case, comm, shared_tmp_path, wall["type"])
        assert rows[-1]["wall/w0/contacts"] == 2
        return run.state.position.copy()

    expected = path({"type": "sphere", "point": [0.0, 0.0, 0.0], "radius": 1.0})
    apart = [np.abs(path(surface(*ball(level), f"ball{level}")) - expected).max() for level in (3, 4, 5)]
    assert apart[0] < 2e-2 and apart[2] < 0.2 * apart[0] and apart[1] < 0.6 * apart[0]


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_a_groove_that_turns_on_any_rank_count(integrator, surface, comm, shared_tmp_path):
    """Stopped on one face and at the line between both, the run goes on with the same bits."""
    turn = {"centre": [0.0, 0.0, 1.0], "axis": [0.1, 1.0, 0.0], "angular_velocity": 0.3}
    wall = {**surface(*groove()), "friction": 0.2, "rotation": turn}
    case = Case.from_dict(bar([wall], integrator, VALLEY, [-3.0, 0.2, -1.7], 110))
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 30, 105, allowed=1e-9 * (integrator == "newmark"))
    assert history["wall/w0/contacts"].max() == 2
    names = "momentum", "kinetic_energy", "contact_work", "friction_dissipation", "wall/w0/impulse"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names)
