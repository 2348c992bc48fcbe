"""The result file: values, structure, and reading by VTK and ``open_result``, the same for any number of ranks."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyvista
from helpers.synthetic import (
    COMM,
    STEPS,
    Truss,
    assert_grid_is,
    assert_history_is,
    options,
    read_with_vtk,
    write,
    write_all,
)
from mpi4py import MPI
from vtkmodules.util.numpy_support import vtk_to_numpy

from pfem_petsc.columns import DECLARED, OF_MODES
from pfem_petsc.errors import InputError
from pfem_petsc.output import hdf5 as growing
from pfem_petsc.output.integrity import damages
from pfem_petsc.output.result import open_result
from pfem_petsc.output.units import unit_of
from pfem_petsc.output.vtkhdf import ResultWriter

WRITTEN = [0, 5, 10, 15, 20]


def tree(path):
    """All there is in a file but what depends on the number of ranks: shapes, types, chunks, attributes, values."""
    found = {}

    def visit(name, item):
        if isinstance(item, h5py.Dataset):
            found[name] = (item.shape, item.maxshape, item.dtype.str, item.chunks, item[()].tobytes())
        else:
            # Names, not objects: a dataset with two names is visited once.
            found[name] = sorted(item)
        found[name + " attributes"] = {k: str(v) for k, v in item.attrs.items() if k != "ranks"}

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


@pytest.mark.parallel
def test_values_by_vtk_and_by_open_result(shared_tmp_path):
    truss = write_all(shared_tmp_path / "deep" / "er" / "result.vtkhdf")
    path = shared_tmp_path / "deep" / "er" / "result.vtkhdf"
    if COMM.rank == 0:
        with open_result(path.parent) as result:
            assert (result.n_nodes, result.n_bars) == (23, 41)
            np.testing.assert_array_equal(result.steps, WRITTEN)
            np.testing.assert_array_equal(result.times, 0.01 * np.array(WRITTEN))
            np.testing.assert_array_equal(result.bars, truss.ends)
            for i, step in enumerate(WRITTEN):
                grid, n_steps = read_with_vtk(path, i)
                assert n_steps == len(WRITTEN)
                assert grid.field_data["Time"][0] == 0.01 * step if "Time" in grid.field_data else True
                assert_grid_is(grid, truss, step)
                assert_grid_is(result.mesh(i), truss, step)
            assert_grid_is(result.mesh(-1), truss, WRITTEN[-1])
            assert_history_is(result.history, truss, STEPS)
            assert result.history["newton_iterations"].dtype == np.int32
            np.testing.assert_array_equal(result.history.wall.floor.force, result.history["wall/floor/force"])
            np.testing.assert_array_equal(result.history["wall"]["floor"]["force"][:, 2], 2.0 * np.array(STEPS))
            assert result.case_text == options()["contents"].case_text
            assert result.attributes["ranks"] == COMM.size
            assert result.attributes["argv"] == [1, 2]
            assert {"petsc", "numpy", "h5py", "python", "pfem_petsc"} <= set(result.attributes)
            with pytest.raises(IndexError):
                result.positions(5)
            with pytest.raises(InputError, match="no field 'stresss', did you mean 'stress'"):
                result.field("stresss", 0)
            with pytest.raises(KeyError, match="did you mean 'momentum'"):
                result.history["momentums"]
        assert_grid_is(pyvista.read(path), truss, WRITTEN[0])


@pytest.mark.parallel
def test_the_file_of_all_ranks_equals_that_of_one(shared_tmp_path):
    write_all(shared_tmp_path / "together.vtkhdf")
    if COMM.rank == 0:
        write_all(shared_tmp_path / "alone.vtkhdf", MPI.COMM_SELF)
        together, alone = tree(shared_tmp_path / "together.vtkhdf"), tree(shared_tmp_path / "alone.vtkhdf")
        assert together.keys() == alone.keys()
        for name in alone:
            assert together[name] == alone[name], name
        assert alone["VTKHDF/Points"][0] == (5 * 23, 3)
        assert alone["VTKHDF/Points"][3] == (23, 3)


@pytest.mark.parallel
def test_readable_while_it_is_written(shared_tmp_path):
    path = shared_tmp_path / "result.vtkhdf"
    truss = Truss(COMM)
    writer = ResultWriter(path, COMM, truss.mesh, **options())
    if COMM.rank == 0:
        # a kill now would leave a file that nobody can open
        assert not path.exists()
    result = None
    for i, step in enumerate(WRITTEN):
        write(writer, truss, range(step, step + 5))
        if COMM.rank == 0:
            grid, n_steps = read_with_vtk(path, i)
            assert n_steps == i + 1
            assert_grid_is(grid, truss, step)
            assert_grid_is(pyvista.read(path), truss, 0)
            result = result or open_result(path)
            result.reload()
            assert_grid_is(result.mesh(i), truss, step)
            # Rows since the snapshot are still in memory.
            assert_history_is(result.history, truss, range(step + 1))
        COMM.Barrier()
    writer.flush_history()
    if COMM.rank == 0:
        assert_history_is(open_result(path).history, truss, range(25))
    writer.close()


@pytest.mark.parallel
def test_single_precision_is_for_fields(shared_tmp_path):
    path = shared_tmp_path / "result.vtkhdf"
    truss = write_all(path, precision="float32")
    if COMM.rank == 0:
        result = open_result(path)
        for name in ("displacement", "stress"):
            assert result.field(name, 0).dtype == np.float32
        assert result.field("reached", 0).dtype == np.int64
        np.testing.assert_array_equal(result.positions(2), truss.whole(10)[0])
        np.testing.assert_array_equal(result.field("displacement", 2), truss.whole(10)[1]["displacement"].astype("f4"))
        grid, _ = read_with_vtk(path, 2)
        assert vtk_to_numpy(grid.GetCellData().GetArray("stress")).dtype == np.float32


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("after", [-1, 0, 7, 12, 20])
def test_going_on_after_a_step_gives_the_same_file(shared_tmp_path, after):
    write_all(shared_tmp_path / "straight.vtkhdf")
    path = shared_tmp_path / "restarted.vtkhdf"
    truss = write_all(path)
    with ResultWriter(path, COMM, truss.mesh, **options(append_after_step=after)) as writer:
        write(writer, truss, range(after + 1, STEPS.stop))
    if COMM.rank == 0:
        straight, restarted = tree(shared_tmp_path / "straight.vtkhdf"), tree(path)
        assert restarted.pop("case attributes")["restarts_after_step"] == str(f"json:[{after}]".encode())
        straight.pop("case attributes")
        assert straight == restarted
        grid, n_steps = read_with_vtk(path, 4)
        assert n_steps == 5
        assert_grid_is(grid, truss, 20)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(("n_nodes", "n_bars"), [(24, 40), (23, 41)])
def test_compressed_snapshots(shared_tmp_path, monkeypatch, n_nodes, n_bars):
    """Chunks that several ranks share, of parts of a snapshot or, for prime numbers of rows, of a whole one."""
    monkeypatch.setattr(growing, "CHUNK_BYTES", 128)
    monkeypatch.setattr(growing, "_SMALLER", 4)
    paths = [shared_tmp_path / f"{name}.vtkhdf" for name in ("together", "restarted", "alone", "plain")]
    truss = Truss(COMM, n_nodes, n_bars, idle=(1,) if COMM.size > 1 else ())
    for path in paths[:2]:
        with ResultWriter(path, COMM, truss.mesh, **options(compressed=True)) as writer:
            write(writer, truss, STEPS)
    with ResultWriter(paths[1], COMM, truss.mesh, **options(append_after_step=7, compressed=True)) as writer:
        write(writer, truss, range(8, STEPS.stop))
    if COMM.rank == 0:
        one = Truss(MPI.COMM_SELF, n_nodes, n_bars)
        for path, compressed in zip(paths[2:], (True, False), strict=True):
            with ResultWriter(path, MPI.COMM_SELF, one.mesh, **options(compressed=compressed)) as writer:
                write(writer, one, STEPS)
        together, restarted, alone, plain = (tree(path) for path in paths)
        assert together == alone
        restarted.pop("case attributes"), alone.pop("case attributes")
        assert restarted == alone
        values = [{name: item[-1] for name, item in each.items() if type(item) is tuple} for each in (alone, plain)]
        assert values[0] == values[1]
        with h5py.File(paths[1]) as file:
            points, stress = file["VTKHDF/Points"], file["VTKHDF/CellData/stress"]
            assert (points.compression, stress.compression) == ("gzip", "gzip")
            # no chunk has rows of two snapshots, so that none is written twice
            assert (n_nodes % points.chunks[0], n_bars % stress.chunks[0]) == (0, 0)
            assert (points.chunks[0] < n_nodes) == (n_nodes == 24)
            assert list(damages(file)) == []
        for i, step in enumerate(WRITTEN):
            assert_grid_is(read_with_vtk(paths[1], i)[0], truss, step)


@pytest.mark.parallel
def test_many_history_rows_come_in_blocks(shared_tmp_path):
    path = shared_tmp_path / "result.vtkhdf"
    truss = Truss(COMM)
    with ResultWriter(path, COMM, truss.mesh, **options()) as writer:
        for step in range(5000):
            writer.append_history(truss.row(step) if COMM.rank == 0 else None)
            if step == 3000 and COMM.rank == 0:
                assert len(open_result(path).history["time"]) == 2048
        assert writer.n_snapshots == 0
    if COMM.rank == 0:
        assert_history_is(open_result(path).history, truss, range(5000))


@pytest.mark.parallel
def test_no_fields_and_no_history(shared_tmp_path):
    path = shared_tmp_path / "result.vtkhdf"
    truss = Truss(COMM)
    nothing = options(point_fields=[], cell_fields=[], columns={})
    with ResultWriter(path, COMM, truss.mesh, **nothing) as writer:
        for step in (0, 5):
            writer.write_snapshot(0.01 * step, step, truss.snapshot(step)[0], {}, {})
    if COMM.rank == 0:
        np.testing.assert_array_equal(read_with_vtk(path, 1)[0].points, truss.whole(5)[0])
        assert len(open_result(path).history) == 0


@pytest.mark.slow
@pytest.mark.parallel
def test_attributes_of_any_length_come_back(shared_tmp_path):
    path = shared_tmp_path / "result.vtkhdf"
    given = {"probe_nodes/tip": list(range(30_000)), "base": [1], "yes": True, "step": 0.1}
    given = {**given, "nothing": None, "long": "é" * 50_000, "empty": ""}
    truss = write_all(path, attributes=given)
    for changed in (given, {**given, "long": "short", "base": list(range(30_000))}):
        ResultWriter(path, COMM, truss.mesh, **options(append_after_step=99, attributes=changed)).close()
        if COMM.rank == 0:
            found = open_result(path).attributes
            assert {name: found[name] for name in given} == changed


def test_documented_columns_have_the_units_of_the_declaration():
    """Those of docs/python.md; energies are in docs/contact.md."""
    pages = Path(__file__).parents[2] / "docs"
    rows = re.findall(r"^\| (`[^|]*`) \| ([^|]*)\| ", (pages / "python.md").read_text(), re.MULTILINE)
    told = {name: unit.strip() for names, unit in rows for name in re.findall("`([^`]+)`", names)}
    assert {name: unit_of(name) for name in told} == told
    named = {name.rsplit("/")[-1] for name in told} | set(told)
    energies = set(re.findall("`([a-z_]+)`", (pages / "contact.md").read_text()))
    assert set(DECLARED) - {one.name for one in OF_MODES} <= named | energies
