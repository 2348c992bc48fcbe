"""The guard of implicit steps: solutions unrelated to the previous state are rejected, and motions are not."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.errors import NotConverged, SimulationFailure
from pfem_petsc.stepping.guard import LARGEST, NOTICEABLE, StepGuard


def star_dome():
    """The hexagonal star dome with 24 bars; nodes 7 to 12 are its feet."""
    inner, outer = np.arange(6) * np.pi / 3.0, np.arange(6) * np.pi / 3.0 + np.pi / 6.0
    ring = np.column_stack([25.0 * np.cos(inner), 25.0 * np.sin(inner), np.full(6, 6.216)])
    feet = np.column_stack([50.0 * np.cos(outer), 50.0 * np.sin(outer), np.zeros(6)])
    bars = [(0, 1 + i) for i in range(6)] + [(1 + i, 1 + (i + 1) % 6) for i in range(6)]
    bars += [(1 + i, 7 + i) for i in range(6)] + [(1 + (i + 1) % 6, 7 + i) for i in range(6)]
    return Truss(np.vstack([[[0.0, 0.0, 8.216]], ring, feet]) / 100.0, bars)


def dome(comm, folder, step, end, guard=True, **tables):
    """The dome under its own weight from rest."""
    case = {
        "node_set": {"feet": {"indices": list(range(7, 13))}, "apex": {"indices": [0]}},
        "material": {"m": {"young_modulus": 3.03e9, "density": 7850.0}},
        "section": {"s": {"area": 3.17e-4, "material": "m"}},
        "support": [{"node_set": "feet", "fix": "xyz"}],
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "time": {"integrator": "newmark", "step": step, "end": end},
        "output": {"fields_every": 0, "probe": [{"name": "apex", "node_set": "apex"}]},
        "solver": {"guard": guard, "linear": "mumps"},
        **tables,
    }
    return Simulation(Case.from_dict(case, mesh=star_dome()), comm, output=folder / "dome", quiet=True)


def last_of(simulation):
    """The last row of a run."""
    return [step.row for step in simulation][-1]


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize("step", [0.1, 1.0, 10.0])
def test_a_dome_is_not_turned_inside_out(step, comm, shared_tmp_path):
    """Its own weight moves the apex by 0.16 mm; one large step turns it inside out otherwise."""
    small = last_of(dome(comm, shared_tmp_path, 0.01, 0.5))
    large = dome(comm, shared_tmp_path, step, 3.0 * step)
    told = []
    large.start()
    large.stepper.message = told.append
    row = last_of(large)
    assert row["elastic_energy"] == pytest.approx(small["elastic_energy"], rel=1e-5)
    place = [r["probe/apex/position"][0, 2] for r in (row, small)]
    assert place[0] == pytest.approx(place[1], abs=1e-8) and 0.0819 < place[0] < 0.0821
    assert told and "bisecting the step" in told[0] and "solver.guard = false" in told[0]
    assert any("energy without a source" in text or "too far from the previous state" in text for text in told)


@pytest.mark.parallel
@pytest.mark.slow
def test_a_step_that_is_refused_leaves_the_state_as_it_was(comm, shared_tmp_path):
    """A blow throws the apex away in the smallest part of a step: status 3 with reason and way out, and nothing of the
    state has changed."""
    blow = {"node_set": "apex", "force": [0.0, 0.0, -1e13], "table": [[0.03, 0.0], [0.0301, 1.0]]}
    simulation = dome(comm, shared_tmp_path, 0.01, 1.0, load=[blow])
    simulation.start()
    stepper = simulation.stepper
    for _ in range(3):
        stepper.step()
    state = stepper.state
    before = {name: getattr(state, name).copy() for name in ("x", "v", "a", "f", "external", "contact", "support")}
    held, ledger = stepper.held.copy(), simulation.outputs.history.ledger.sums.copy()
    with pytest.raises(NotConverged, match="step 4, .*too far from.*guard = false.*bisected 10 times") as failure:
        stepper.step()
    assert isinstance(failure.value, SimulationFailure) and failure.value.exit_status == 3
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(state, name), array)
    np.testing.assert_array_equal(stepper.held, held)
    np.testing.assert_array_equal(simulation.outputs.history.ledger.sums, ledger)
    assert state.step == 3 and state.time == pytest.approx(0.03)


def lattice(comm, folder):
    """A guard and the positions (local, 3) of a block of octet cells."""
    case = {
        "mesh": {"generator": "lattice", "kind": "octet", "cells": [2, 2, 2], "pitch": 0.01},
        "material": {"m": {"young_modulus": 210e9, "density": 7850.0}},
        "section": {"s": {"area": 1e-6, "material": "m"}},
        "time": {"integrator": "newmark", "step": 1e-3, "end": 1e-2},
    }
    model = Simulation(Case.from_dict(case), comm, output=folder / "it", quiet=True, check_only=True).model
    return StepGuard(model), model.mesh.points.copy(), model.mesh.n_owned


@pytest.mark.parallel
def test_mirrored_cells_keep_their_lengths_and_are_found(comm, shared_tmp_path):
    guard, x, owned = lattice(comm, shared_tmp_path)
    mirrored = x.copy()
    mirrored[:, 2] = 0.02 - x[:, 2]
    text = guard.check(x, mirrored, x[:owned], 1e9)
    assert text is not None and "turns by 90 degrees" in text
    assert comm.allgather(text) == [text] * comm.size


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.6])
def test_rotations_pass(angle, comm, shared_tmp_path):
    """A body that turns rigidly, predicted by its velocity: up to 0.6 rad a step, with the energy of a slow turn."""
    guard, x, owned = lattice(comm, shared_tmp_path)
    c, s = np.cos(angle), np.sin(angle)
    turned = x @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    predicted = x[:owned] + angle * np.column_stack([-x[:owned, 1], x[:owned, 0], np.zeros(owned)])
    assert 0.5 * angle**2 < LARGEST and (angle < 0.15 or 0.5 * angle**2 > NOTICEABLE)
    energy = 10.0 * angle**8 / comm.size  # of the step; the parabola is 0.003 angle^4 off a circle
    assert guard.check(x, turned, predicted, energy) is None


def guard_of(comm, folder, points, bars, feet, fix="xyz", modulus=1e8):
    """A guard, the positions (local, 3) of bars with EA = ``modulus``, and their mesh."""
    case = {
        "node_set": {"feet": {"indices": feet}},
        "material": {"m": {"young_modulus": modulus, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "support": [{"node_set": "feet", "fix": fix}],
        "time": {"integrator": "newmark", "step": 1e-3, "end": 1e-2},
    }
    case = Case.from_dict(case, mesh=Truss(np.array(points, dtype=float), bars))
    model = Simulation(case, comm, output=folder / "it", quiet=True, check_only=True).model
    return StepGuard(model), model.mesh.points.copy(), model.mesh


@pytest.mark.parallel
@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_stiff_bars_that_turn_pass_whatever_their_stiffness(degrees, comm, shared_tmp_path):
    """Two bars of 10^8 N turn about their joints by an angle and twice that, with the noise of vibrating bars in the
    prediction, and nothing but the energy of a slow motion: the lengths at the ends are those at rest."""
    guard, x, mesh = guard_of(comm, shared_tmp_path, [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1], [1, 2]], [0])
    angle = np.radians(degrees)
    ways = np.array([[0, 0, 0], *np.cumsum([[np.cos(a), np.sin(a), 0.0] for a in (angle, -0.5 * angle)], axis=0)])
    noise = 0.1 * angle * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0]])
    speeds = np.array([[0, 0, 0], [0, angle, 0], [0, 0.5 * angle, 0]])
    after = ways[mesh.node_ids]
    predicted = x[: mesh.n_owned] + (speeds + noise)[mesh.node_ids[: mesh.n_owned]]
    energy = angle**2 / comm.size  # of the motion in 1 s; the chord of the first bar stores 8e5 angle^4
    assert guard.check(x, after, predicted, energy) is None


@pytest.mark.parametrize(("share", "told"), [(0.8, True), (1.1, False)])
def test_a_shallow_arch_keeps_its_barrier(share, told, comm, shared_tmp_path):
    """Flat bars cannot give way: the barrier of two bars that rise by a tenth is EA l (strain)^2. The end is not the
    mirror image, so that the middle of the path is beside the top of the barrier."""
    guard, x, mesh = guard_of(comm, shared_tmp_path, [[-1, 0, 0], [0, 0, 0.1], [1, 0, 0]], [[0, 1], [1, 2]], [0, 2])
    strain = 1.0 - 1.0 / np.hypot(1.0, 0.1)
    barrier = 1e8 * np.hypot(1.0, 0.1) * strain**2
    after = x.copy()
    after[mesh.node_ids == 1, 2] = -0.094
    predicted = x[: mesh.n_owned].copy()
    predicted[mesh.node_ids[: mesh.n_owned] == 1, 2] = -0.06
    text = guard.check(x, after, predicted, share * barrier / comm.size)
    assert told == (text is not None and "barrier" in text)


@pytest.mark.parametrize("integrator", ["newmark", "houbolt", "wilson", "generalized_alpha", "energy_momentum"])
@pytest.mark.parametrize("degrees", [1.0, 10.0])
def test_a_stiff_pendulum_is_not_bisected(degrees, integrator, comm, shared_tmp_path):
    """It falls from the horizontal, at most by the angle a step: every step is accepted by the guard."""
    step = np.radians(degrees) / np.sqrt(2.0 * 9.81)
    case = {
        "node_set": {"pin": {"indices": [0]}},
        "material": {"m": {"young_modulus": 1e8, "density": 2.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "support": [{"node_set": "pin", "fix": "xyz"}],
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "time": {"integrator": integrator, "step": step, "end": 12 * step, "mass": "lumped"},
        "output": {"fields_every": 0},
    }
    case = Case.from_dict(case, mesh=Truss(np.array([[0.0, 0, 0], [1, 0, 0]]), [[0, 1]]))
    simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
    told = []
    simulation.start()
    simulation.stepper.message = told.append
    row = last_of(simulation)
    assert not [text for text in told if "guard" in text]
    # the energy of the fall of the free end, as far as the scheme keeps it
    fallen = -9.81 * (row["centre_of_mass"][2]) * 2.0
    assert 0.0 < row["kinetic_energy"] < 1.05 * fallen


@pytest.mark.parametrize("integrator", ["newmark", "generalized_alpha", "energy_momentum", "houbolt"])
def test_a_snap_that_the_step_resolves_passes(integrator, comm, shared_tmp_path):
    """Two shallow bars that a growing load turns inside out in a hundred steps: no step is halved."""
    arch = Truss(np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.1], [1.0, 0.0, 0.0]]), [[0, 1], [1, 2]])
    case = {
        "node_set": {"feet": {"indices": [0, 2]}, "apex": {"indices": [1]}},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "apex", "fix": "xy"}],
        "load": [{"node_set": "apex", "force": [0.0, 0.0, -1.0], "table": [[0.0, 0.0], [2.0, 1.0]]}],
        "time": {"integrator": integrator, "step": 0.02, "end": 2.0},
        "output": {"fields_every": 0, "probe": [{"name": "apex", "node_set": "apex"}]},
    }
    simulation = Simulation(Case.from_dict(case, mesh=arch), comm, output=shared_tmp_path / "arch", quiet=True)
    rows = [step.row for step in simulation]
    heights = [row["probe/apex/position"][0, 2] for row in rows]
    assert heights[0] > 0.09 and min(heights) < -0.1
    assert all(row["step_size"] == 0.02 for row in rows)


def pushed_block(comm, folder, guard):
    """Octet cells that fly before a plane at 0.1 m/s, by the trapezoidal rule."""
    case = {
        "mesh": {"generator": "lattice", "kind": "octet", "cells": [2, 2, 2], "pitch": 0.01},
        "material": {"m": {"young_modulus": 210e9, "density": 7850.0}},
        "section": {"s": {"area": 1e-6, "material": "m"}},
        "wall": [
            {"type": "plane", "name": "press", "point": [0, 0, 0.02], "normal": [0, 0, -1], "velocity": [0, 0, -0.1]}
        ],
        "contact": {"treatment": "stick"},
        "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": 1e-3, "end": 4e-3},
        "output": {"fields_every": 0},
        "solver": {"guard": guard, "linear": "mumps"},
    }
    return Simulation(Case.from_dict(case), comm, output=folder / str(guard), quiet=True)


def mirror_guess(stepper, comm):
    """Let Newton's method begin the first attempt of the fourth step at the mirror image of the block.

    From there it finds another solution of the step, as it may by the errors of an iterative linear solver.
    """
    usual, tried = stepper._guess, []

    def guess(balance):
        if stepper.number != 3 or tried:
            return usual(balance)
        tried.append(balance.time)
        z = stepper.state.position[:, 2]
        low, high = (
            comm.allreduce(z.min(initial=np.inf), op=MPI.MIN),
            comm.allreduce(z.max(initial=-np.inf), op=MPI.MAX),
        )
        mirrored = stepper.state.position.copy()
        # a block that flies on by the way of a step
        mirrored[:, 2] = low + high - z - 1e-4
        return mirrored - balance.predictor

    stepper._guess = guess
    return tried


def turns(simulation):
    """Angles (bars of this rank,) by which bars have turned since the start [degrees]."""
    mesh, x = simulation.model.mesh, simulation.state.x
    now, first = (y[mesh.bars[:, 1]] - y[mesh.bars[:, 0]] for y in (x, mesh.points))
    cosines = (now * first).sum(axis=1) / np.linalg.norm(now, axis=1) / np.linalg.norm(first, axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


@pytest.mark.slow
def pushed(comm, folder, guard):
    """The run, its rows, its messages, and the largest turn of a bar [degrees]."""
    simulation = pushed_block(comm, folder, guard)
    told = []
    simulation.start()
    simulation.stepper.message = told.append
    tried = mirror_guess(simulation.stepper, comm)
    rows = [step.row for step in simulation]
    assert len(tried) == 1
    return rows, told, max(comm.allgather(float(turns(simulation).max(initial=0.0))))


def test_a_pushed_block_is_not_mirrored(comm, shared_tmp_path):
    """The attempt that ends in the mirror image is rejected, and the bisected step moves the block as before."""
    rows, told, turn = pushed(comm, shared_tmp_path, True)
    assert turn < 0.1
    assert all(row["kinetic_energy"] + row["elastic_energy"] < 1e-3 for row in rows)
    assert abs(rows[-1]["numerical_dissipation"]) < 1e-3
    assert comm.bcast(any("step 4" in text and "bisecting the step" in text for text in told))
