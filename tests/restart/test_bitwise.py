"""A run continued from a checkpoint equals an uninterrupted one: bitwise on as many ranks, nearly on other numbers."""

import numpy as np
import pytest
from helpers.kills import differences
from helpers.stopped import CASES, SHORT, TWO_RODS, assert_restart_is_bitwise, everywhere, simulate
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.run.observers import History, Snapshots


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_restart_on_as_many_ranks_is_bitwise(comm, shared_tmp_path, name):
    case, overrides = CASES[name]
    folders = shared_tmp_path / "whole", shared_tmp_path / "stopped"
    simulate(case, overrides, folders[0], comm)
    stopped = simulate(case, overrides, folders[1], comm, stop_after=33)
    assert 33 <= stopped < 150
    # again, between rows of the history and snapshots
    assert simulate(case, overrides, folders[1], comm, stop_after=stopped + 5, restart=True) > stopped
    simulate(case, overrides, folders[1], comm, restart=True)
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}


ROD = {
    "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
    "material": {"m": {"young_modulus": 1e6, "density": 1000.0, "damping": 1e4}},
    "section": {"s": {"area": 1.0, "material": "m"}},
    "initial": {"velocity": [0.1, 0.0, 0.0]},
    "time": {"integrator": "newmark", "step": 0.04, "end": 4.0},
}


@pytest.mark.slow
def test_motion_that_has_come_to_rest_is_not_taken_for_unstable_after_a_restart(tmp_path):
    """What energies are compared with is that of the start; nothing of it is left."""
    assert_restart_is_bitwise(Case.from_dict(ROD), MPI.COMM_SELF, tmp_path, 50)


def _watched(simulation):
    history = simulation.outputs.history
    return history.blow_up.kept, history.recorder.energy_scale, simulation.model.links.force.copy()


@pytest.mark.slow
@pytest.mark.parallel
def test_all_that_is_looked_at_in_later_steps_is_put_back(comm, shared_tmp_path):
    """Also what only messages and rows show: the watch, the largest energy, the forces of pairs."""
    overrides = (*SHORT, *TWO_RODS, "output.checkpoint_every=10")
    found = []
    for end in (0.3, 0.6):
        case = Case.load("rod_impact", [*overrides, f"time.end={end}"])
        simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True, restart=end > 0.3)
        simulation.start()
        found.append(_watched(simulation))
        while simulation.state.step < simulation.plan.steps:
            simulation._advance()
        found.append(_watched(simulation))
        simulation.close()
    (_, before, after, _) = found
    assert before[:2] == after[:2]
    assert before[0]["most"] > 0.0 and before[0]["start"]
    np.testing.assert_array_equal(before[2], after[2])
    assert comm.allreduce(int(before[2].any())) > 0  # pairs live on the ranks of their nodes


EXTENDED = {
    "central differences": ("rod_impact", ("time.step=0.01",), 0.01),
    "newmark": ("rod_impact", ("time.step=0.01", "time.integrator=newmark"), 0.01),
    "houbolt": ("pendulum", ("time.step=1e-3", "time.integrator=houbolt"), 1e-3),
    "plastic lattice": ("lattice_drop", ("mesh.cells=[3,3,3]", "time.step=1e-6"), 1e-6),
}
SPARSE = ("output.history_every=4", "output.fields_every=6", "output.checkpoint_every=25")


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    ("name", "end"), [("central differences", 33), ("newmark", 42), ("houbolt", 36), ("plastic lattice", 33)]
)
def test_finished_run_with_a_later_end_is_the_run_that_had_it_from_the_start(comm, shared_tmp_path, name, end):
    """The former end is off the schedule of rows, of snapshots, or both: what was written for it goes."""
    case, overrides, step = EXTENDED[name]
    folders = shared_tmp_path / "whole", shared_tmp_path / "longer"
    overrides = (*overrides, *SPARSE)
    simulate(case, (*overrides, f"time.end={70 * step}"), folders[0], comm)
    assert simulate(case, (*overrides, f"time.end={end * step}"), folders[1], comm) == end
    assert everywhere(comm, _last_steps, folders[1]) == (end, end)
    assert simulate(case, (*overrides, f"time.end={70 * step}"), folders[1], comm, restart=True) == 70
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}


def _last_steps(folder):
    with open_result(folder) as result:
        return int(result.history["step"][-1]), int(result.steps[-1])


class Killed(Exception):  # noqa: N818
    """In place of a signal that nobody can catch."""


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("lost", ["row", "snapshot"])
def test_killed_between_the_last_checkpoint_and_the_end_of_the_results(comm, shared_tmp_path, monkeypatch, lost):
    case, overrides, step = EXTENDED["newmark"]
    folders = shared_tmp_path / "whole", shared_tmp_path / "killed"
    overrides = (*overrides, *SPARSE, f"time.end={33 * step}")
    simulate(case, overrides, folders[0], comm)

    def killed(self):
        if self._stepper.state.step != 33:
            return done(self)
        if lost == "snapshot":
            self.writer.flush_history()
        raise Killed

    with monkeypatch.context() as patch:
        writer, name = (History, "record") if lost == "row" else (Snapshots, "observe")
        done = getattr(writer, name)
        patch.setattr(writer, name, killed)
        simulation = Simulation(Case.load(case, overrides), comm, output=folders[1], quiet=True)
        with pytest.raises(Killed):
            simulation.run()
        simulation._finish("failed")
    assert everywhere(comm, _last_steps, folders[1]) == (32 if lost == "row" else 33, 30)
    assert simulate(case, overrides, folders[1], comm, restart=True) == 33
    assert everywhere(comm, differences, *(folder / "result.vtkhdf" for folder in folders)) == {}
    assert everywhere(comm, _last_steps, folders[1]) == (33, 33)


VISCOUS = {
    "mesh": {"generator": "rod", "length": 1.0, "elements": 3},
    "node_set": {"start": {"group": "start"}, "every": {"all": True}},
    "material": {
        "m": {
            "law": "perzyna", "young_modulus": 1e6, "density": 1000.0, "yield_stress": 500.0,
            "isotropic_hardening": 2e4, "fluidity": 20.0, "stiffness_damping": 1e-3,
        }
    },
    "section": {"s": {"area": 1e-3, "material": "m"}},
    "support": [{"node_set": "start", "fix": "x"}, {"node_set": "every", "fix": "yz"}],
    "initial": {"velocity": [0.3, 0.0, 0.0]},
    "time": {"integrator": "wilson", "step": 0.07, "end": 0.7},
    "solver": {"linear": "gamg"},
}  # fmt: skip


@pytest.mark.slow
def test_preconditioner_is_set_up_again_with_the_step_of_its_set_up(tmp_path):
    """The step of rate-dependent bars, t + theta h less t, differs in its last bits from step to step."""
    history = assert_restart_is_bitwise(Case.from_dict(VISCOUS), MPI.COMM_SELF, tmp_path, 3, 6)
    assert history["plastic_heat"][3] > 0.0


TUMBLING = {
    "mesh": {"generator": "lattice", "kind": "octet", "cells": [2, 2, 1], "pitch": 0.1},
    "material": {"m": {"young_modulus": 1e7, "density": 1000.0}},
    "section": {"s": {"area": 1e-5, "material": "m"}},
    "node_set": {"low": {"box": [[-1.0, -1.0, -1.0], [1.0, 1.0, 0.01]]}},
    "initial": {"velocity": [1.3, -0.7, 0.4], "angular_velocity": [3.0, 5.0, -2.0]},
    "stage": [
        {"name": name, "time": {"integrator": "central_differences", "step": 1e-4, "end": 1e-3}, **more}
        for name, more in (("free", {}), ("held", {"support": [{"node_set": "low", "fix": "xyz"}]}))
    ],
}


@pytest.mark.slow
def test_sums_at_the_end_of_a_batch_of_steps_are_put_back(tmp_path):
    """What supports of the next stage take is the difference from them; a batch adds nodes in another order."""
    history = assert_restart_is_bitwise(Case.from_dict(TUMBLING), MPI.COMM_SELF, tmp_path, 5, 10)
    assert history["kinetic_energy"][10] > 1.2 * history["kinetic_energy"][11]
