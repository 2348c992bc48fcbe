"""Snapshots that are written beside the steps: order, failures, memory, and that they are those written at once."""

import errno
import os

import h5py
import numpy as np
import pytest
from helpers.synthetic import COMM, Truss, assert_grid_is, options
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.output import hdf5, vtkhdf
from pfem_petsc.output.integrity import damages
from pfem_petsc.output.result import open_result

STEPS = range(0, 40, 5)


@pytest.fixture(autouse=True)
def all_beside(monkeypatch):
    """Also small ones."""
    monkeypatch.setattr(vtkhdf, "_BESIDE", 0)


def begin(writer, truss, step):
    """Record a step and begin its snapshot; gives its arrays."""
    writer.append_history(truss.row(step) if truss.comm.rank == 0 else None)
    points, point_data, cell_data = truss.snapshot(step)
    writer.begin_snapshot(0.01 * step, step, points, point_data, cell_data)
    return [points, *point_data.values(), *cell_data.values()]


def values(path):
    """All datasets of a file but those that name the run."""
    found = {}
    with h5py.File(path, "r", locking=False) as file:
        file.visititems(
            lambda name, item: (
                found.update({name: item[()]}) if isinstance(item, h5py.Dataset) and "case" not in name else None
            )
        )
    return found


@pytest.mark.parallel
@pytest.mark.parametrize("shares", [True, False], ids=["one machine", "several"])
def test_file_of_snapshots_beside_the_steps_equals_that_of_one_rank(shared_tmp_path, monkeypatch, shares):
    """Values change after the write, as those of the next steps; ranks of several machines share no memory."""
    if not shares:
        monkeypatch.setattr(hdf5, "share_memory", lambda comm: False)
    path, truss = shared_tmp_path / "beside.vtkhdf", Truss(COMM, idle=(1,) if COMM.size > 1 else ())
    with vtkhdf.ResultWriter(path, COMM, truss.mesh, **options()) as writer:
        for step in STEPS:
            arrays = begin(writer, truss, step)
            writer.wait()
            if COMM.rank == 0:
                result = open_result(path)
                assert result.steps[-1] == step
                assert_grid_is(result.mesh(-1), truss, step)
            COMM.Barrier()
            for array in arrays:
                array[:] = 7
    if COMM.rank == 0:
        one = Truss(MPI.COMM_SELF)
        with vtkhdf.ResultWriter(shared_tmp_path / "one.vtkhdf", MPI.COMM_SELF, one.mesh, **options()) as writer:
            for step in STEPS:
                writer.append_history(one.row(step))
                writer.write_snapshot(0.01 * step, step, *one.snapshot(step))
        beside, alone = values(path), values(shared_tmp_path / "one.vtkhdf")
        assert beside.keys() == alone.keys()
        for name in alone:
            np.testing.assert_array_equal(beside[name], alone[name])
        with h5py.File(path) as file:
            assert list(damages(file)) == []


@pytest.mark.parallel
@pytest.mark.parametrize("then", ["begin", "flush", "close"])
def test_failure_beside_the_steps_is_raised_by_the_next_call_on_all_ranks(shared_tmp_path, monkeypatch, then):
    mark = vtkhdf._Snapshots.mark

    def full(self, n, *given):
        if n == 2 and COMM.rank == 0:
            with self._shared.writing():
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        mark(self, n, *given)

    monkeypatch.setattr(vtkhdf._Snapshots, "mark", full)
    path, truss = shared_tmp_path / "result.vtkhdf", Truss(COMM)
    writer = vtkhdf.ResultWriter(path, COMM, truss.mesh, **options())
    for step in (0, 5, 10):
        begin(writer, truss, step)
    calls = {"flush": writer.flush_history, "close": writer.close, "begin": lambda: begin(writer, truss, 15)}
    with pytest.raises(SimulationFailure, match="is the disk full"):
        calls[then]()
    if then != "close":
        with pytest.raises(SimulationFailure, match="is the disk full"):
            writer.wait()
        writer.close()
    if COMM.rank == 0:
        result = open_result(path)
        np.testing.assert_array_equal(result.steps, [0, 5])
        assert_grid_is(result.mesh(-1), truss, 5)
        np.testing.assert_array_equal(result.history["step"], [0, 5])
    COMM.Barrier()


@pytest.mark.slow
@pytest.mark.parallel
def test_functions_and_loops_over_steps_see_the_snapshot_of_their_step(shared_tmp_path):
    case = Case.load("lattice_drop")
    case.mesh.cells, case.time.step, case.time.end, case.output.fields_every = [3, 3, 3], 1e-6, 6e-5, 10
    seen = []

    def look(step):
        if COMM.rank == 0:
            seen.append((step.step, int(open_result(folder).steps[-1])))
        COMM.Barrier()

    folder = shared_tmp_path / "function"
    simulation = Simulation(case, output=folder, quiet=True)
    simulation.on_step(look, every=5)
    simulation.run()
    for batches in (False, True):
        folder = shared_tmp_path / f"loop-{batches}"
        with Simulation(case, output=folder, quiet=True) as simulation:
            for made in simulation.batches() if batches else simulation:
                look(made)
    if COMM.rank == 0:
        assert len(seen) > 60
        assert seen == [(step, step - step % 10) for step, _ in seen]
    COMM.Barrier()
