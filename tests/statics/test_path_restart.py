"""Paths continued from checkpoints: the same to the last bit, events and branches included."""

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result

DOME = [
    "static.branch_at=[2]",
    "static.step=0.05",
    "static.max_points=17",
    "output.fields_every=7",
    "output.checkpoint_every=1",
]


def case_of(name):
    overrides = DOME if name == "dome_16" else ["output.checkpoint_every=5"]
    if name == "von_mises by displacement":
        data = Case.load("von_mises").to_dict()
        del data["static"]["constraint"]
        data["static"]["method"] = "displacement"
        return Case.from_dict(data, name="von_mises", overrides=overrides)
    return Case.load(name, overrides)


def contents(path):
    """Every dataset of a result file but the text and the attributes of the run."""
    found = {}
    with h5py.File(path / "result.vtkhdf") as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return {name: values for name, values in found.items() if not name.startswith("case/")}


def run_until(case, comm, folder, step):
    """Run up to a step, and stop without a checkpoint of it beyond those that the case asks for."""
    simulation = Simulation(case, comm, output=folder, quiet=True)
    for made in simulation:
        if made.step == step:
            break
    simulation.close()


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("name", "at"), [("dome_16", 12), ("dome_16", 13), ("von_mises by displacement", 9)])
def test_restart_is_bitwise(name, at, tmp_path):
    """In the middle of a path, before and at the point where it leaves for a branch, with events before and after."""
    comm = MPI.COMM_WORLD
    folder, case = comm.bcast(tmp_path), case_of(name)
    Simulation(case, comm, output=folder / "whole", quiet=True).run()
    run_until(case, comm, folder / "parts", at)
    Simulation(case, comm, output=folder / "parts", restart=True, quiet=True).run()
    if comm.rank == 0:
        whole, parts = contents(folder / "whole"), contents(folder / "parts")
        assert whole.keys() == parts.keys()
        for column, values in whole.items():
            np.testing.assert_array_equal(parts[column], values, err_msg=column)
        assert len(whole["event/kind"]) >= 2


@pytest.mark.slow
def test_events_after_the_checkpoint_are_cut_off(tmp_path):
    """A run that was killed after more events than its checkpoint has seen finds them once."""
    case = Case.load("von_mises", ["output.checkpoint_every=5", "output.history_every=3"])
    simulation = Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", quiet=True)
    for made in simulation:
        if made.step == 9:
            break
    simulation.close()  # the event before point 7 is in the file, the checkpoint is that of step 5
    assert open_result(tmp_path / "a").history["event/step"].tolist() == [7]
    Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", restart=True, quiet=True).run()
    history = open_result(tmp_path / "a").history
    assert history["event/kind"].tolist() == ["limit", "limit"]
    assert history["event/step"].tolist() == [7, 18]


@pytest.mark.slow
def test_restart_of_a_finished_path_ends_at_once(tmp_path):
    case = Case.load("von_mises", ["output.checkpoint_every=5"])
    Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", quiet=True).run()
    before = contents(tmp_path / "a")
    simulation = Simulation(case, MPI.COMM_SELF, output=tmp_path / "a", restart=True, quiet=True)
    assert simulation.run() == 0
    after = contents(tmp_path / "a")
    for column, values in before.items():
        np.testing.assert_array_equal(after[column], values, err_msg=column)


@pytest.mark.slow
def test_damaged_event_is_found(tmp_path):
    """Events have checksums as rows of the history have."""
    from pfem_petsc.output.verify import examine

    Simulation(Case.load("von_mises"), MPI.COMM_SELF, output=tmp_path / "a", quiet=True).run()
    path = tmp_path / "a" / "result.vtkhdf"
    assert examine(path, deep=True) == []
    with h5py.File(path, "r+") as file:
        file["event/load_factor"][1] += 1e-9
    assert any("event" in line for line in examine(path, deep=True))
