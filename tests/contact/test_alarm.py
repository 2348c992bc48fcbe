"""Check of positions: a node beyond a wall ends the run, except by the margin that a scheme legitimately leaves."""

import re

import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.contact.contact import check_positions
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.tolerances import BEYOND


def run(comm, folder, *keys):
    """A finished run of the rod in which its tip is on the wall."""
    keys = ["output.fields_every=1", "initial.velocity=[0.1, 0, 0]", "time.end=0.7", *keys]
    simulation = Simulation(Case.load("rod_impact", keys), comm, output=folder / "rod", quiet=True)
    assert simulation.run() == 0
    return simulation


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "chung_lee", "newmark", "wilson"])
def test_a_node_beyond_a_wall_is_an_error(scheme, comm, shared_tmp_path):
    simulation = run(comm, shared_tmp_path, f"time.integrator={scheme}")
    stepper = simulation.stepper
    tip = simulation.model.nodes["tip"]
    where = stepper.state.position if stepper.scheme.solves_end else stepper.balance.predictor
    solved = where if stepper.scheme.solves_end else where + stepper.solution.u
    where[tip, 0] += 1.05 - solved[tip, 0] + 0.5 * BEYOND
    check_positions(simulation.model, *stepper.held_by_contact(), "here")
    where[tip, 0] += 2e-3
    with pytest.raises(SimulationFailure) as failure:
        simulation.outputs.snapshots.observe()
    messages = comm.allgather(str(failure.value))
    assert messages == [messages[0]] * comm.size and failure.value.exit_status == 3
    assert messages[0].startswith("step 70, t = 0.7") and "node 20 is 0.002 m beyond wall 'wall' (1 node" in messages[0]


def test_wilson_may_leave_x1_beyond(comm, shared_tmp_path):
    """x1 is beyond the wall by up to (theta - 1) h v; x_tau, which the step is solved for, is not."""
    case = Case.load("rod_impact", ["time.integrator=wilson", "output.fields_every=1", "time.end=0.2"])
    run = Simulation(case, comm, output=shared_tmp_path / "rod", quiet=True)
    depth = max(step.row["probe/tip/position"][0, 0] for step in run) - 1.05
    assert 1e-4 < depth < 0.4 * 0.01 * 0.6


@pytest.mark.slow
@pytest.mark.parallel
def test_what_is_no_concern_of_a_wall_may_be_beyond_it(comm, shared_tmp_path):
    """Nodes out of its node set, and whoever passed beside a rectangle."""
    free = ["initial.velocity=[0.5, 0, 0]", "node_set.base.nearest=[0,0,0]", 'wall.0.node_set="base"']
    last = run(comm, shared_tmp_path, *free)
    assert max(comm.allgather(float(last.state.position[:, 0].max(initial=0.0)))) > 1.3
    rectangle = "along=[0,1,0], size=[0.1,0.1], node_set='tip'"
    keys = [f'wall=[{{name="wall", type="rectangle", point=[1.05,1,0], normal=[-1,0,0], {rectangle}}}]']
    run(comm, shared_tmp_path, "initial.velocity=[0.5, 0, 0]", *keys)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("tied", ["false", "true"])
def test_supports_that_carry_a_node_through_a_wall_are_told(mass, tied, comm, shared_tmp_path):
    """What is prescribed along the normal decides over the wall; both cannot be meant."""
    motion = "motion=[[0.0, 0.0, 0.0, 0.0], [0.7, 0.2, 0.0, 0.0]]"
    keys = [f'support=[{{node_set="tip", fix="x", {motion}}}]', f"wall.0.tied={tied}", f'time.mass="{mass}"']
    with pytest.raises(SimulationFailure) as failure:
        run(comm, shared_tmp_path, "output.fields_every=10", *keys)
    message = r"node 20 is 0.0\d+ m beyond wall 'wall' \(1 node in all\), moved there by its supports"
    assert all(re.search(message, text) for text in comm.allgather(str(failure.value)))


def test_walls_with_mass_that_meet_held_nodes_are_told(comm, shared_tmp_path):
    """Nothing that the program solves for stops such a wall."""
    keys = ['support=[{node_set="tip", fix="xyz"}]', "initial.velocity=[0.0, 0.0, 0.0]", "output.fields_every=10"]
    with pytest.raises(SimulationFailure) as failure:
        run(comm, shared_tmp_path, *keys, "wall.0.mass=1.0", "wall.0.velocity=[-1.0, 0.0, 0.0]")
    message = r"node 20 is 0.\d+ m beyond wall 'wall' .*, held there by its supports, and a wall with mass is stopped"
    assert all(re.search(message, text) for text in comm.allgather(str(failure.value)))


@pytest.mark.parallel
@pytest.mark.parametrize("scheme", ["central_differences", "houbolt"])
@pytest.mark.parametrize("beside, told", [(0.0, True), (0.2, False)])
def test_supports_that_carry_a_node_through_a_rectangle_are_told(scheme, beside, told, comm, shared_tmp_path):
    """The step that crosses it is found, whenever results are written; whoever passes beside is not meant."""
    motion = "motion=[[0.0, 0.0, 0.0, 0.0], [0.7, 0.2, 0.0, 0.0]]"
    point = f"point=[1.05, {beside}, 0.0], velocity=[-0.1, 0.0, 0.0]"
    keys = [
        f'support=[{{node_set="tip", fix="x", {motion}}}]',
        f'wall=[{{name="plate", type="rectangle", {point}, normal=[-1,0,0], along=[0,1,0], size=[0.1, 0.1]}}]',
        "output.fields_every=0",
        f"time.integrator={scheme}",
        "initial.velocity=[0.0, 0.0, 0.0]",
    ]
    if not told:
        run(comm, shared_tmp_path, *keys)
        return
    with pytest.raises(SimulationFailure) as failure:
        run(comm, shared_tmp_path, *keys)
    message = r"node 20 is 0.0\d+ m beyond wall 'plate' \(1 node in all\), moved there by its supports"
    assert all(re.search(message, text) for text in comm.allgather(str(failure.value)))
