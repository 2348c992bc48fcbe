"""Bars that touch walls between their nodes: impacts against closed forms, and where walls hold them."""

import numpy as np
import pytest
from helpers.lattices import rows_of
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise
from helpers.triangles import box, write_surface

from pfem_petsc import Case, InputError, SimulationFailure
from pfem_petsc.contact.bar_springs import damping_of

BALL = {"type": "sphere", "point": [0.0, 0.0, 0.0], "radius": 0.5}
ACROSS = [[-1.0, 0.0, 0.52], [1.0, 0.0, 0.52]]
MASS = 0.2
EXPLICIT = "central_differences", "chung_lee"


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
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "generalized_alpha", "bathe"])
@pytest.mark.parametrize("restitution", [1.0, 0.5, 0.2])
def test_bar_that_falls_on_a_sphere(integrator, restitution, comm, shared_tmp_path):
    """Its middle hits the sphere, and it leaves with e times its velocity; the energies of its own account for it."""
    case = falling({**BALL, "restitution": restitution})
    case["time"]["integrator"] = integrator
    # dampers of implicit steps follow a step later
    error = 0.01 if integrator in EXPLICIT or restitution == 1.0 else 0.03
    rows, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, 2], restitution, rtol=error)
    last = rows[-1]
    given = comm.allreduce(float(run.state.v[:, 2].sum())) * 0.5 * MASS + MASS
    np.testing.assert_allclose(last["wall/w/impulse"], [0.0, 0.0, given], atol=1e-12)
    lost = 0.5 * MASS - last["kinetic_energy"]
    assert last["self_contact_dissipation"] == pytest.approx(lost, abs=0.01 * error)
    damping = damping_of(restitution)  # most energy of a damped oscillator from rest: at its largest deflection
    stored = 0.5 * MASS * np.exp(-2.0 * damping / np.sqrt(1.0 - damping**2) * np.arccos(damping))
    assert max(row["self_contact_energy"] for row in rows) == pytest.approx(stored, rel=0.01 + 2.0 * error)
    assert abs(last["numerical_dissipation"]) < 0.01 * error


@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha"])
def test_sphere_with_mass_and_bar(integrator, comm, shared_tmp_path):
    """Free bodies leave with e times the velocity at which they met, and both keep the momentum. Walls with mass have
    restitution in central differences only; without it the damper is critical, e = exp(-2)."""
    case, restitution = falling({**BALL, "mass": 0.4}), np.exp(-2.0)
    case["time"]["integrator"] = integrator
    if integrator in EXPLICIT:
        case["wall"][0]["restitution"] = restitution = 1.0
    rows, run = rows_of(case, comm, shared_tmp_path)
    after = -(0.2 - 0.4 * restitution) / 0.6
    np.testing.assert_allclose(run.state.v[:, 2], after, rtol=2e-3 if integrator in EXPLICIT else 0.02)
    of_wall = 0.4 * rows[-1]["wall/w/velocity"][2]
    assert 0.5 * MASS * run.state.v[:, 2].sum() + of_wall == pytest.approx(-MASS, abs=1e-11)


@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha"])
def test_wall_that_moves_works_on_the_bar(integrator, comm, shared_tmp_path):
    """Seen from a sphere that rises the impact is the same: the bar leaves with v + 2 V, and the wall works V J."""
    case = falling({**BALL, "restitution": 1.0, "velocity": [0.0, 0.0, 0.5]})
    case["time"]["integrator"] = integrator
    rows, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, 2], 2.0, rtol=2e-3)
    last = rows[-1]
    assert last["contact_work"] == pytest.approx(0.5 * last["wall/w/impulse"][2], rel=1e-10)
    assert abs(last["numerical_dissipation"]) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha"])
def test_bar_across_the_edge_of_a_box(integrator, comm, shared_tmp_path):
    """A bar that falls across the edge of a box of triangles is pushed across the edge and its axis."""
    file = write_surface(shared_tmp_path / "box.obj", *box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0)), comm)
    points = [[0.51, 0.0, 0.51], [1.51, 0.0, -0.49]]
    case = falling({"type": "surface", "file": file, "restitution": 1.0}, points, (-0.5, 0.0, -0.5))
    case["time"]["integrator"] = integrator
    _, run = rows_of(case, comm, shared_tmp_path)
    assert comm.allreduce(float(run.state.v[:, 1].sum())) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(run.state.v[:, [0, 2]], 0.5, rtol=0.01)  # it was hit in its middle


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha"])
@pytest.mark.parametrize("restitution", [1.0, 0.5, 0.2])
def test_coulomb_and_restitution_at_an_edge(integrator, restitution, comm, shared_tmp_path):
    """A bar across an edge, at any angle to the faces, rubs by Coulomb's law with the force across both, and rebounds
    by the velocity across both, though the distance from a face changes by less."""
    file = write_surface(shared_tmp_path / "box.obj", *box((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0)), comm)
    for k, angle in enumerate(np.deg2rad([45.0, 20.0])):
        across, along = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, -np.sin(angle)])
        points = np.array([1.0, 0.0, 0.0]) + 0.02 * across + 0.7 * np.outer([-1.0, 1.0], along)
        sticky = 0.0 if integrator != "central_differences" else 0.1
        wall = {"type": "surface", "file": file, "restitution": restitution, "friction": sticky}
        case = falling(wall, points.tolist(), -across + [0.0, 0.9, 0.0], step=1e-4, end=0.1)
        case["time"]["integrator"] = integrator
        rows, run = rows_of(case, comm, shared_tmp_path, f"{k}")
        leaves = 0.5 * comm.allreduce(float((run.state.v @ across).sum()))
        assert leaves == pytest.approx(restitution, rel=0.01 if sticky else 0.03)
        if sticky:
            impulse = np.array(rows[-1]["wall/w/impulse"])
            rubbed = np.hypot(impulse @ along, impulse[1])  # less, as the force grows with an elastic slip
            assert rubbed == pytest.approx(sticky * impulse @ across, rel=0.06)


@pytest.mark.parametrize("integrator", ["central_differences", "generalized_alpha"])
def test_bar_on_the_edge_of_a_sheet(integrator, comm, shared_tmp_path):
    """A sheet with a thickness is round at its edge: the bar leaves as it came; one that is thin lets it pass."""
    corners = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]
    file = write_surface(shared_tmp_path / "sheet.obj", np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]), comm)
    wall = {"type": "surface", "file": file, "side": "both", "thickness": 0.2, "restitution": 1.0}
    points = np.array([[0.5, 0.0, 0.5], [1.5, 0.0, -0.5]]) + 0.11 * np.array([0.5, 0.0, 0.5]) * np.sqrt(2.0)
    case = falling(wall, points.tolist(), (-0.5, 0.0, -0.5))
    case["time"]["integrator"] = integrator
    _, run = rows_of(case, comm, shared_tmp_path)
    np.testing.assert_allclose(run.state.v[:, [0, 2]], 0.5, rtol=0.01)
    del case["wall"][0]["thickness"]
    _, run = rows_of(case, comm, shared_tmp_path, "thin")
    np.testing.assert_allclose(run.state.v[:, [0, 2]], -0.5, rtol=1e-12)


def test_bar_that_is_driven_through_a_sheet_ends_the_run(comm, shared_tmp_path):
    wall = {"type": "cylinder", "point": [0.0, 0.0, 0.0], "axis": [0.0, 1.0, 0.0], "radius": 0.02}
    case = falling(wall, [[-1.0, 0.0, 0.03], [1.0, 0.0, 0.03]], (0.0, 0.0, -40.0), step=2e-4, end=0.01)
    with pytest.raises(SimulationFailure, match="bar 0 passes through wall 'w', which the stiffness of"):
        rows_of(case, comm, shared_tmp_path)


@pytest.mark.parametrize(("integrator", "step"), [("central_differences", 1e-3), ("generalized_alpha", 2e-3)])
def test_bar_does_not_jump_over_a_wall(integrator, step, comm, shared_tmp_path):
    """Fast bars pass a thin wall within a step, which ends the run, or reduces an implicit step until they touch."""
    wall = {"type": "cylinder", "point": [0.0, 0.0, 0.0], "axis": [0.0, 1.0, 0.0], "radius": 0.02, "restitution": 1.0}
    case = falling(wall, [[-1.0, 0.0, 0.05], [1.0, 0.0, 0.05]], (0.0, 0.0, -90.0), step=step, end=4e-3)
    case["material"]["m"]["young_modulus"] = 1e9
    case["time"]["integrator"] = integrator
    with pytest.raises(SimulationFailure, match="ar 0 (and|passes through) wall 'w'"):
        rows_of(case, comm, shared_tmp_path)


def test_light_wall_with_mass(comm, shared_tmp_path):
    """The stiffness is limited by its mass: a bar of 200 g throws a sphere of 1 g ahead, v2 = 2 m1/(m1 + m2) v."""
    case = falling({**BALL, "restitution": 1.0, "mass": 1e-3}, step=1e-3, end=0.06)
    rows, run = rows_of(case, comm, shared_tmp_path)
    assert rows[-1]["wall/w/velocity"][2] == pytest.approx(-2.0 * 0.2 / 0.201, rel=0.01)
    np.testing.assert_allclose(run.state.v[:, 2], -(0.2 - 1e-3) / 0.201, rtol=1e-3)
    assert abs(rows[-1]["numerical_dissipation"]) < 1e-3 * 0.5 * MASS


@pytest.mark.parametrize("count", [4, 40])
def test_bar_at_several_walls(count, comm, shared_tmp_path):
    """They share the stiffness that a step allows: an elastic impact keeps its energy, and dampers take from it."""
    places = np.linspace(-0.5, 0.5, count).tolist()
    balls = [{"name": f"w{x}", "type": "sphere", "point": [x, 0.0, 0.415], "radius": 0.1} for x in places]
    for restitution in (1.0, 0.0):
        case = falling(BALL, step="auto", end=0.25)
        case["wall"] = [{**ball, "restitution": restitution} for ball in balls]
        rows, run = rows_of(case, comm, shared_tmp_path, f"{restitution}")
        if restitution:
            np.testing.assert_allclose(run.state.v[:, 2], 1.0, rtol=0.01)
        else:
            assert (np.abs(run.state.v[:, 2]) < 0.5).all()
        assert abs(rows[-1]["numerical_dissipation"]) < 0.06 * 0.5 * MASS


@pytest.mark.parallel
def test_bar_that_starts_in_a_wall_is_refused(comm, shared_tmp_path):
    case = falling(BALL, [[-1.0, 0.0, 0.4], [1.0, 0.0, 0.4]])
    with pytest.raises(InputError, match="wall 'w': bar 0 starts 0.1 m in it, between its nodes; move the wall"):
        rows_of(case, comm, shared_tmp_path)


def test_tied_wall_is_told(comm, shared_tmp_path):
    _, run = rows_of(falling({**BALL, "tied": True}, end=2e-4), comm, shared_tmp_path)
    assert any("wall 'w' ties nodes only" in text for text in run.model.warnings)


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
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "generalized_alpha"])
def test_on_any_rank_count_and_restarted(integrator, comm, shared_tmp_path):
    wall = {**BALL, "friction": 0.3, "restitution": 0.4}
    wall["rotation"] = {"centre": [0.0, 0.0, 0.0], "axis": [1.0, 0.0, 0.0], "angular_velocity": 4.0}
    points = [[-1.0, 0.1, 0.52], [0.4, 0.1, 0.52], [1.2, 0.0, 0.53]]
    case = falling(wall, points, (0.0, 0.3, -1.0), step=4e-4, end=0.03)
    case["mesh"]["bars"] = [[0, 1], [1, 2]]
    case["time"]["integrator"] = integrator
    if integrator != "central_differences":  # which alone has restitution beside friction
        del case["wall"][0]["restitution"]
    case = Case.from_dict(case)
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 55, 63)
    names = "momentum", "kinetic_energy", "self_contact_dissipation", "wall/w/impulse", "wall/w/moment"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names)


def at_rest(wall, **table):
    """A bar on springs, which a wall that moves with the load factor presses between its nodes."""
    case = falling({**wall, **table})
    del case["time"], case["initial"]
    return {
        **case,
        "node_set": {"both": {"indices": [0, 1]}},
        "spring": [{"node_set": "both", "stiffness": [200.0, 300.0, 100.0]}],
        "static": {"method": "newton", "step": 0.05},
        "output": {"fields_every": 0},
    }


CYLINDER = {"type": "cylinder", "point": [0.0, 0.0, 0.0], "axis": [0.0, 1.0, 0.0], "radius": 0.5}


@pytest.mark.parallel
@pytest.mark.parametrize("wall", [BALL, CYLINDER], ids=["sphere", "cylinder"])
def test_wall_presses_a_bar_on_springs(wall, comm, shared_tmp_path):
    """Statics: the springs at both ends and that of the contact, k = E A/l, in series, F = g/(1/k + 1/(2 c))."""
    case = at_rest(wall, motion=[[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.05]])
    rows, run = rows_of(case, comm, shared_tmp_path)
    force = 0.03 / (1.0 / 500.0 + 1.0 / 200.0)
    assert rows[-1]["wall/w/force"][2] == pytest.approx(force, rel=1e-9)
    np.testing.assert_allclose(run.state.position[:, 2], 0.52 + force / 200.0, rtol=1e-9)
    assert rows[-1]["self_contact_energy"] == pytest.approx(0.5 * force**2 / 500.0, rel=1e-9)
    assert abs(rows[-1]["energy_imbalance"]) < 1e-12


def test_wall_rubs_a_bar_on_springs(comm, shared_tmp_path):
    """Statics: a cylinder drags the bar along until friction slips, then the force is on Coulomb's cone; the work of
    the wall is stored, or dissipated."""
    motion = [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.05], [1.0, 0.2, 0.0, 0.05]]
    rows, run = rows_of(at_rest(CYLINDER, motion=motion, friction=0.3), comm, shared_tmp_path)
    x = run.state.position
    along = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
    force = np.array(rows[-1]["wall/w/force"])
    pushed = force @ along
    assert pushed == pytest.approx(0.3 * np.sqrt(force @ force - pushed**2), rel=1e-6)
    assert pushed > 0.0 and abs(force[1]) < 1e-12
    assert rows[-1]["self_contact_dissipation"] > 0.1 * rows[-1]["contact_work"] > 0.0
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-12
    stuck = [row["self_contact_dissipation"] for row in rows if row["load_factor"] <= 0.5]
    assert max(stuck) < 1e-12


@pytest.mark.parallel
@pytest.mark.parametrize("clear", [0.0, 1e-4])
def test_friction_alone_holds_a_bar(clear, comm, shared_tmp_path):
    """Statics: a bar on two cylinders, that no support nor spring holds, presses each with half of its weight."""
    case = at_rest({**CYLINDER, "radius": 0.1, "friction": 0.5})
    (wall,) = case["wall"]
    case["wall"] = [{**wall, "name": f"w{k}", "point": [x, 0.0, 0.42 - clear]} for k, x in enumerate((-0.5, 0.5))]
    case["gravity"] = {"acceleration": [0.0, 0.0, -9.81]}
    case["static"]["step"] = 0.25
    del case["spring"]
    rows, run = rows_of(case, comm, shared_tmp_path)
    for k in range(2):
        force = [0.0, 0.0, 0.5 * MASS * 9.81]
        np.testing.assert_allclose(rows[-1][f"wall/w{k}/force"], force, rtol=1e-9, atol=1e-9)
    assert abs(rows[-1]["energy_imbalance"]) < 1e-9


def test_wall_that_presses_more_than_a_contact_bears(comm, shared_tmp_path):
    """Statics: where the springs of a bar would pull it through a thin wall, the run ends and names both."""
    case = at_rest({**CYLINDER, "radius": 0.05, "point": [0.0, 0.0, 0.4]}, motion=[[0.0, 0, 0, 0], [1.0, 0, 0, 0.8]])
    told = r"no equilibrium .* 0\.36.*: bar 0 and wall 'w' would pass through each"
    with pytest.raises(SimulationFailure, match=told):
        rows_of(case, comm, shared_tmp_path)
