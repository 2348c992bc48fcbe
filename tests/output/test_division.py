"""A result file after a kill before any single write, at the snapshots at which an index of chunks grows."""

import io
import subprocess
import sys

import h5py
import numpy as np
import pytest
from helpers.launch import environment
from helpers.synthetic import Truss, assert_history_is, options, write
from mpi4py import MPI
from test_interrupted import HERE, READER

from pfem_petsc.output.result import open_result
from pfem_petsc.output.vtkhdf import ResultWriter


class Disk(io.FileIO):
    """A file that keeps what it held before each write, while it is told to."""

    def __init__(self, path):
        super().__init__(path, "r+")
        self.path, self.states, self.watched = path, [], False

    def write(self, data):
        if self.watched:
            self.states.append(self.path.read_bytes())
        return super().write(data)


def states_before_each_write(path, truss, snapshots, monkeypatch):
    """Write 134 snapshots; {snapshot: states of the file before each of its writes}."""
    disks, opened = [], h5py.File

    def watched(name, mode, locking=None, **options):
        if mode != "r+":
            return opened(name, mode, locking=locking, **options)
        disks.append(Disk(name))
        return opened(disks[-1], mode, **options)

    monkeypatch.setattr(h5py, "File", watched)
    found = {}
    with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options()) as writer:
        for n in range(max(snapshots) + 1):
            disks[0].watched, disks[0].states = n in snapshots, []
            # the file has its own name after the first snapshot
            disks[0].path = path if n else disks[0].path
            write(writer, truss, [n], every=1)
            if n in snapshots:
                found[n] = disks[0].states
    disks[0].close()
    monkeypatch.undo()
    return found


@pytest.mark.thorough
@pytest.mark.slow
def test_killed_before_any_write_of_a_snapshot_that_grows_the_index_nothing_is_lost(tmp_path, monkeypatch):
    truss = Truss(MPI.COMM_SELF, n_nodes=400, n_bars=900)
    found = states_before_each_write(tmp_path / "whole.vtkhdf", truss, (64, 65, 96, 97), monkeypatch)
    paths = []
    for n, states in found.items():
        assert len(states) > 10
        for k, state in enumerate(states):
            path = tmp_path / f"{n}-{k}.vtkhdf"
            path.write_bytes(state)
            result = open_result(path)
            assert len(result.times) in (n, n + 1), (n, k)
            for i in (0, n // 2, n - 1):
                np.testing.assert_array_equal(result.positions(i), truss.whole(i)[0])
                np.testing.assert_array_equal(result.field("stress", i), truss.whole(i)[2]["stress"])
            assert_history_is(result.history, truss, range(len(result.history["step"])))
            assert len(result.history["step"]) in (n, n + 1)
            paths.append(path)
    # VTK reads them all, and a few are continued, each of which starts a process that verifies the file
    done = subprocess.run(
        [sys.executable, "-c", READER, str(HERE), *map(str, paths)],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    for path in paths[5 :: len(paths) // 8]:
        n = len(open_result(path).times)
        with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options(append_after_step=n - 1)) as writer:
            write(writer, truss, range(n, n + 40), every=1)
        result = open_result(path)
        np.testing.assert_array_equal(result.steps, np.arange(n + 40))
        np.testing.assert_array_equal(result.positions(n + 39), truss.whole(n + 39)[0])
