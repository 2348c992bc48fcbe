"""The result file after its writer was killed or the disk ran full."""

import os
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.launch import environment
from helpers.synthetic import Truss, assert_grid_is, assert_history_is, options, read_with_vtk, write
from mpi4py import MPI

from pfem_petsc.errors import InputError
from pfem_petsc.output.integrity import repair
from pfem_petsc.output.layout import Kept
from pfem_petsc.output.result import open_result
from pfem_petsc.output.vtkhdf import ResultWriter

HERE = f"{Path(__file__).parent}:{Path(__file__).parents[1]}"

WRITER = """
import sys
import time
from mpi4py import MPI
sys.path[:0] = sys.argv[1].split(':')
from helpers.launch import environment
from helpers.synthetic import Truss, options, write
from pfem_petsc.output.vtkhdf import ResultWriter
truss = Truss(MPI.COMM_SELF, n_nodes=400, n_bars=900)
writer = ResultWriter(sys.argv[2], MPI.COMM_SELF, truss.mesh, **options(compressed=sys.argv[3] == "True"))
print("open", flush=True)
for step in range(80):
    write(writer, truss, [step], every=1)
time.sleep(60.0)
"""

# VTK in a process of its own: what it cannot read might end it.
READER = """
import sys
sys.path[:0] = sys.argv[1].split(':')
from mpi4py import MPI
from helpers.synthetic import assert_grid_is, read_with_vtk
from helpers.synthetic import Truss
truss = Truss(MPI.COMM_SELF, n_nodes=400, n_bars=900)
for path in sys.argv[2:]:
    _, n_steps = read_with_vtk(path, 0)
    for i in {0, n_steps // 2, n_steps - 1}:
        assert_grid_is(read_with_vtk(path, i)[0], truss, i)
    print(n_steps)
"""


def killed_writer(path, seconds, compressed):
    """Write a step at a time until killed."""
    command = [sys.executable, "-c", WRITER, str(HERE), str(path), str(compressed)]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
    try:
        assert writer.stdout.readline() == "open\n"
        while not path.exists() or len(open_result(path).times) == 0:
            time.sleep(0.005)
        time.sleep(seconds)
    finally:
        writer.kill()
        writer.wait()
        writer.stdout.close()


@pytest.mark.thorough
@pytest.mark.slow
def test_killed_at_any_moment_the_file_is_readable_and_can_be_continued(tmp_path, chance):
    truss = Truss(MPI.COMM_SELF, n_nodes=400, n_bars=900)
    paths = [tmp_path / f"{i}.vtkhdf" for i in range(12)]
    for i, path in enumerate(paths):
        killed_writer(path, chance.uniform(0.0, 0.2), compressed=i % 2 == 1)
    done = subprocess.run(
        [sys.executable, "-c", READER, str(HERE), *map(str, paths)],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    for path, n_vtk in zip(paths, map(int, done.stdout.split()), strict=True):
        result = open_result(path)
        n = len(result.times)
        # One may be complete but for its time, which comes last.
        assert n <= n_vtk <= n + 1
        np.testing.assert_array_equal(result.steps, np.arange(n))
        np.testing.assert_array_equal(result.times, 0.01 * np.arange(n))
        for i in {0, n // 2, n - 1}:
            assert_grid_is(result.mesh(i), truss, i)
        n_rows = len(result.history["step"])
        assert n_rows >= n
        assert_history_is(result.history, truss, range(n_rows))
        # A restart from a step before goes on without gap and without repetition.
        again = n // 2
        with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options(append_after_step=again)) as writer:
            write(writer, truss, range(again + 1, n + 3), every=1)
        result = open_result(path)
        np.testing.assert_array_equal(result.steps, np.arange(n + 3))
        assert_history_is(result.history, truss, range(n + 3))
        grid, n_vtk = read_with_vtk(path, n + 2)
        assert n_vtk == n + 3
        assert_grid_is(grid, truss, n + 2)


def written(path, steps=range(23)):
    truss = Truss(MPI.COMM_SELF)
    with ResultWriter(path, MPI.COMM_SELF, truss.mesh, **options()) as writer:
        write(writer, truss, steps)
    return truss


def test_repair_killed_between_its_flushes_leaves_a_file_that_vtk_reads(tmp_path, monkeypatch):
    """Times never outnumber steps, nor steps or rows what they count: what is counted goes last."""
    path = tmp_path / "result.vtkhdf"
    written(path)
    states = []
    flush = h5py.File.flush

    def watched(file):
        flush(file)
        steps, rows = file["VTKHDF/Steps"], file["history"].attrs["rows"]
        data = min(
            len(file["VTKHDF/Points"]) // 23, len(file["VTKHDF/CellData/stress"]) // 41, len(file["snapshots/time"])
        )
        states.append((len(steps["Values"]), int(steps.attrs["NSteps"]), data, int(rows), len(file["history/time"])))

    monkeypatch.setattr(h5py.File, "flush", watched)
    assert repair(path, Kept(8, 8, 8)) == (2, 9)
    assert states[0][0] == 2
    assert states[0][1:] == (5, 5, 23, 23)
    assert states[1] == (2, 2, 5, 9, 23)


def longer_values(file):
    file["VTKHDF/Steps/Values"].resize(6, axis=0)


def longer_everything(file):
    file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(6))
    file["VTKHDF/Points"].resize(6 * 23, axis=0)
    file["snapshots/step"].resize(6, axis=0)
    file["history/time"].resize(99, axis=0)


def shorter_field(file):
    file["VTKHDF/CellData/stress"].resize(3 * 41 + 7, axis=0)


def shorter_history(file):
    file["history/wall/floor/force"].resize(11, axis=0)


def more_steps_than_times(file):
    file["VTKHDF/Steps/Values"].resize(4, axis=0)


@pytest.mark.parametrize(
    ("damage", "n", "n_rows"),
    [
        (longer_values, 5, 23),
        (longer_everything, 5, 23),
        (shorter_field, 3, 23),
        (shorter_history, 5, 11),
        (more_steps_than_times, 4, 23),
    ],
)
def test_torn_ends_are_not_seen_and_are_repaired(tmp_path, damage, n, n_rows):
    path = tmp_path / "result.vtkhdf"
    truss = written(path)
    with h5py.File(path, "r+") as file:
        damage(file)
    result = open_result(path)
    assert len(result.times) == n
    assert_history_is(result.history, truss, range(n_rows))
    assert repair(path) == (n, n_rows)
    with h5py.File(path) as file:
        steps = file["VTKHDF/Steps"]
        assert steps.attrs["NSteps"] == n
        np.testing.assert_array_equal(steps["Values"], 0.01 * (5 * np.arange(n)))
        for name in ("PointOffsets", "CellOffsets", "PointDataOffsets/displacement", "CellDataOffsets/stress"):
            assert len(steps[name]) == n
        assert len(file["VTKHDF/Points"]) == 23 * n
        assert len(file["history/probe/tip/position"]) == file["history"].attrs["rows"] == n_rows
    grid, n_steps = read_with_vtk(path, n - 1)
    assert n_steps == n
    assert_grid_is(grid, truss, 5 * (n - 1))


def test_what_is_not_a_result_is_refused(tmp_path):
    with pytest.raises(InputError, match="there is no such result file"):
        open_result(tmp_path)
    path = tmp_path / "result.vtkhdf"
    path.write_text("no HDF5")
    os.utime(path, (0, 0))
    with pytest.raises(InputError, match="it is not HDF5"):
        open_result(tmp_path)
    with h5py.File(path, "w") as file:
        file["x"] = 1
    os.utime(path, (0, 0))
    for function in (open_result, repair):
        with pytest.raises(InputError, match="not a result of pfem_petsc"):
            function(path)


FULL = """
import sys
from mpi4py import MPI
sys.path[:0] = sys.argv[1].split(':')
from helpers.launch import environment
from helpers.synthetic import Truss, options, write
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.output import vtkhdf
vtkhdf.require_room = lambda *given, **named: None  # as where a quota, not the disk, is full
truss = Truss(MPI.COMM_SELF, n_nodes=int(sys.argv[3]), n_bars=2 * int(sys.argv[3]))
try:
    with vtkhdf.ResultWriter(sys.argv[2], MPI.COMM_SELF, truss.mesh, **options()) as writer:
        write(writer, truss, range(1000), every=1)
except SimulationFailure as error:
    sys.exit(f"failed: {error}")
"""


@pytest.mark.slow
@pytest.mark.parametrize("n_nodes", [2000, 3500], ids=["at once", "beside the steps"])
def test_disk_full_inside_hdf5_is_a_failure_and_no_crash(small_disk, n_nodes):
    path = small_disk / "result.vtkhdf"
    command = [sys.executable, "-c", FULL, str(HERE), str(path), str(n_nodes)]
    done = subprocess.run(command, capture_output=True, env=environment(), text=True)
    assert done.returncode == 1, done.stderr
    assert "failed: " in done.stderr
    assert "is the disk full" in done.stderr
    truss = Truss(MPI.COMM_SELF, n_nodes=n_nodes, n_bars=2 * n_nodes)
    result = open_result(path)
    n = len(result.times)
    assert n > 3
    assert_grid_is(result.mesh(n - 1), truss, n - 1)
    assert_history_is(result.history, truss, range(len(result.history["step"])))
