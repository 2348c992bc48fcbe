"""Result files that cannot be written: cases, folders, fields and libraries that are refused."""

import h5py
import numpy as np
import pytest
from helpers.synthetic import COLUMNS, COMM, Truss, assert_history_is, options, write, write_all

from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.output.result import open_result
from pfem_petsc.output.vtkhdf import ResultWriter


@pytest.mark.slow
@pytest.mark.parallel
def test_going_on_with_another_case_is_refused(shared_tmp_path):
    path = shared_tmp_path / "result.vtkhdf"
    truss = write_all(path)
    columns = {name: dtype for name, dtype in COLUMNS.items() if name != "momentum"}
    for changes, message in (
        ({"cell_fields": ["strain"]}, "has the fields section, stress .CellData., the case requests strain"),
        (
            {"columns": {**columns, "momentum": np.dtype((float, (4,)))}},
            r"history/momentum: the run records rows of shape \(4,\)",
        ),
        (
            {"columns": {**COLUMNS, "wall/roof/force": COLUMNS["wall/floor/force"]}},
            "history/wall/roof/force.*the file has nothing",
        ),
    ):
        with pytest.raises(InputError, match=message):
            ResultWriter(path, COMM, truss.mesh, **options(append_after_step=5, **changes))
    larger = Truss(COMM, n_nodes=24)
    with pytest.raises(InputError, match="has 23 nodes and 41 bars, the case has 24 and 41"):
        ResultWriter(path, COMM, larger.mesh, **options(append_after_step=5))
    with pytest.raises(InputError, match="no such result file"):
        ResultWriter(path.with_name("none.vtkhdf"), COMM, truss.mesh, **options(append_after_step=5))


def test_the_folder_of_a_sweep_is_no_result(tmp_path):
    (tmp_path / "sweep.csv").write_text("run,status\n0,0\n")
    for named in (tmp_path, tmp_path / "sweep.csv"):
        with pytest.raises(InputError) as told:
            open_result(named)
        assert f"the results of its runs are {tmp_path}/*/" in str(told.value)
    with pytest.raises(InputError, match="no such result file"):
        open_result(tmp_path / "0000")


@pytest.mark.parallel
def test_unwritable_folder_is_refused_on_all_ranks(shared_tmp_path):
    if COMM.rank == 0:
        (shared_tmp_path / "file").write_text("not a folder")
    COMM.Barrier()
    with pytest.raises(InputError, match="file/result.vtkhdf: cannot write there"):
        write_all(shared_tmp_path / "file" / "result.vtkhdf")


@pytest.mark.parallel
def test_a_folder_that_vanishes_ends_the_run_on_all_ranks(shared_tmp_path):
    path = shared_tmp_path / "out" / "result.vtkhdf"
    truss = Truss(COMM)
    with ResultWriter(path, COMM, truss.mesh, **options()) as writer:
        write(writer, truss, range(10))
        COMM.Barrier()
        if COMM.rank == 0:
            path.parent.rename(shared_tmp_path / "moved")
        COMM.Barrier()
        with pytest.raises(SimulationFailure, match="gone or unreachable"):
            write(writer, truss, range(10, 20))
        with pytest.raises(SimulationFailure, match="gone or unreachable"):
            writer.flush_history()
    if COMM.rank == 0:
        assert_history_is(open_result(shared_tmp_path / "moved").history, truss, range(6))


@pytest.mark.parallel
def test_a_serial_h5py_is_refused_on_several_ranks(shared_tmp_path, monkeypatch):
    class Config:
        mpi = False

    monkeypatch.setattr(h5py, "get_config", Config)
    if COMM.size == 1:
        write_all(shared_tmp_path / "result.vtkhdf")
    else:
        with pytest.raises(InputError, match="serial build.*install h5py built with MPI"):
            write_all(shared_tmp_path / "result.vtkhdf")
