"""What bars have in all snapshots, once in the file: values, readers, ranks, restarts, damage; texts of results."""

import csv

import h5py
import numpy as np
import pytest
import pyvista
from helpers.kills import differences
from helpers.runs import run
from helpers.stopped import assert_restart_is_bitwise, everywhere
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.output.integrity import damages, repair
from pfem_petsc.output.table import Table

POINTS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.0]]
BARS = [[0, 4], [1, 4], [2, 4], [3, 4], [0, 1], [1, 2], [2, 3], [3, 0]]
AREAS = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 5.0, 5.0, 5.0]) * 1e-4
SECTIONS = ["leg"] * 4 + ["ring"] * 4


def tower(comm, **tables):
    """Four legs with areas of their own from a field, and a ring."""
    truss = Truss(
        POINTS,
        BARS,
        node_groups={"feet": [0, 1, 2, 3], "top": [4]},
        bar_groups={"legs": [0, 1, 2, 3], "some_of them": [1, 6]},
        bar_fields={"size": AREAS},
        comm=comm,
    )
    return Case(
        name="tower",
        title="A tower <of> legs",
        mesh=truss,
        node_set={"feet": {"group": "feet"}, "top": {"group": "top"}},
        material={
            "steel": {"young_modulus": 2e11, "density": 7850.0},
            "wood": {"young_modulus": 1e10, "density": 500.0},
        },
        section={
            "leg": {"bars": "legs", "area_field": "size", "material": "wood"},
            "ring": {"area": 5e-4, "material": "steel"},
        },
        support=[{"node_set": "feet", "fix": "xyz"}],
        load=[{"node_set": "top", "force": [0, 0, -1e3]}],
        **{
            "time": {"integrator": "newmark", "step": 1e-4, "end": 1e-3},
            "output": {"fields_every": 2, "bar_probe": [{"name": "odd", "bars": "some_of them"}]},
            **tables,
        },
    )


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tower")
    run(tower(MPI.COMM_SELF), folder, MPI.COMM_SELF)
    return open_result(folder)


def assert_bar_data(path):
    result = open_result(path)
    assert result.bar_data == ["area", "group:legs", "group:some_of them", "material", "section"]
    assert result.field("section").tolist() == SECTIONS
    assert result.field("material").tolist() == ["wood"] * 4 + ["steel"] * 4
    np.testing.assert_array_equal(result.field("area"), AREAS)
    assert np.flatnonzero(result.field("group:some_of them")).tolist() == [1, 6]
    assert not {*result.bar_data} & {*result.cell_fields}


@pytest.mark.parallel
def test_bar_data_are_the_same_on_any_number_of_ranks(comm, shared_tmp_path):
    history = run(tower(comm), shared_tmp_path / "out", comm)
    everywhere(comm, assert_bar_data, shared_tmp_path / "out")
    assert history["bar/odd/stress"].shape == (11, 2)
    np.testing.assert_allclose(
        history["bar/odd/stress"] * AREAS[[1, 6]], history["bar/odd/axial_force"], rtol=1e-9, atol=1e-9
    )
    if comm.rank == 0:
        run(tower(MPI.COMM_SELF), shared_tmp_path / "alone", MPI.COMM_SELF)
        files = [shared_tmp_path / name / "result.vtkhdf" for name in ("out", "alone")]
        assert not [name for name in differences(*files) if name.startswith(("bars", "checks/bars"))]
        structures = []
        for file in files:
            with h5py.File(file) as opened:
                names = {}
                opened.visititems(lambda name, item, names=names: names.update({name: getattr(item, "shape", None)}))
                structures.append(names)
        assert structures[0] == structures[1]


def found_in(path):
    with h5py.File(path) as file:
        return list(damages(file))


@pytest.mark.slow
@pytest.mark.parallel
def test_restarts_keep_the_bar_data(comm, shared_tmp_path):
    assert_restart_is_bitwise(tower(comm), comm, shared_tmp_path, 5, allowed=1e-9 if comm.size > 1 else 0.0)
    everywhere(comm, assert_bar_data, shared_tmp_path / "stopped at 5")
    assert everywhere(comm, found_in, shared_tmp_path / "stopped at 5" / "result.vtkhdf") == []


def test_they_take_their_place_once(result):
    """Not for each of six snapshots; the offsets of VTK are zero for each."""
    with h5py.File(result.path) as file:
        assert len(result.times) == 6 and file["bars/area"].shape == (8,)
        assert file["VTKHDF/CellData/area"] == file["bars/area"]
        assert file["VTKHDF/Steps/CellDataOffsets/area"][:].tolist() == [0] * 6
        assert file["VTKHDF/CellData/stress"].shape == (48,)
        assert file["bars/area"].attrs["unit"].decode() == "m²"
        assert list(file["bars/section"].attrs["names"]) == ["leg", "ring"]


def test_readers_of_vtk_have_them_at_every_step(result):
    reader = pyvista.get_reader(result.path)
    assert reader.reader.GetNumberOfSteps() == 6
    for step in range(6):
        reader.reader.SetStep(step)
        grid = reader.read()
        assert reader.reader.GetTimeValue() == pytest.approx(result.times[step])
        np.testing.assert_array_equal(grid["stress"], result.field("stress", step))
        np.testing.assert_array_equal(grid.points, result.positions(step))
        np.testing.assert_array_equal(grid["area"], AREAS)
        assert grid["section"].tolist() == [0] * 4 + [1] * 4
        own = result.mesh(step)
        assert {*own.cell_data} == {*grid.cell_data} and {*own.point_data} == {*grid.point_data}
        assert own.field_data["material_names"].tolist() == ["steel", "wood"]


def test_a_file_that_loses_all_snapshots_keeps_them(tmp_path):
    run(tower(MPI.COMM_SELF), tmp_path, MPI.COMM_SELF)
    path = tmp_path / "result.vtkhdf"
    with h5py.File(path, "r+") as file:
        file["VTKHDF/Steps"].attrs["NSteps"] = 0
    repair(path)
    assert_bar_data(path)
    with h5py.File(path) as file:
        assert sorted(file["VTKHDF/CellData"]) == sorted(file["bars"])


def test_damaged_bar_data_are_found(tmp_path):
    run(tower(MPI.COMM_SELF), tmp_path, MPI.COMM_SELF)
    path = tmp_path / "result.vtkhdf"
    assert found_in(path) == []
    with h5py.File(path, "r+") as file:
        file["bars/area"][3] = 7e-4
    assert found_in(path) == ["what bars have in all snapshots does not match its checksum"]


def test_tables_of_bars(tmp_path, result):
    """Written and read back by csv; the force is the stress times area, the row the number of the bar."""
    file = result.bar_table(3).to_csv(tmp_path / "bars.csv")
    rows = list(csv.DictReader(file.open()))
    assert list(rows[0])[:6] == ["bar", "node1", "node2", "material", "section", "area"]
    assert [row["section"] for row in rows] == SECTIONS
    assert [[int(row["node1"]), int(row["node2"])] for row in rows] == BARS
    force = [float(row["stress"]) * area for row, area in zip(rows, AREAS, strict=True)]
    np.testing.assert_allclose([float(row["axial_force"]) for row in rows], force, rtol=1e-9)
    np.testing.assert_array_equal([float(row["axial_force"]) for row in rows], result.field("axial_force", 3))


def test_a_result_that_is_a_mesh_has_its_areas_and_groups(tmp_path, result, capsys):
    assert main(["mesh", "convert", str(result.path), str(tmp_path / "it_bars.csv")]) == 0
    mesh = Truss.read(tmp_path / "it_bars.csv")
    assert mesh.bar_groups["legs"].tolist() == [0, 1, 2, 3] and mesh.bar_groups["some_of them"].tolist() == [1, 6]
    np.testing.assert_array_equal(mesh.bar_fields["area"], AREAS)
    np.testing.assert_allclose(mesh.bar_fields["axial_force"], result.field("axial_force", -1), rtol=1e-15)


def test_printed_results_show_what_matters(result):
    lines = str(result).splitlines()
    rows = {line[2:].split("  ")[0]: line for line in lines[1:]}
    assert lines[0] == "A tower <of> legs" and len(lines) <= 16
    assert rows["file"].endswith(str(result.path)) and "5 nodes, 8 bars" in rows["mesh"]
    assert "step 10, t = 1.000 ms, which is the end of the run" in rows["end"]
    peak = np.linalg.norm(result.history["support_force"], axis=1).max()
    assert peak > 0.0 and "largest support_force" in str(result)
    kinetic = 1e3 * result.history["kinetic_energy"].max()
    assert f"{kinetic:.3f}"[:4] in rows["kinetic energy"] and "mJ" in rows["kinetic energy"]
    assert "A tower &lt;of&gt; legs" in result._repr_html_()


def test_a_run_that_stopped_says_so(tmp_path):
    with Simulation(tower(MPI.COMM_SELF), MPI.COMM_SELF, output=tmp_path, quiet=True) as simulation:
        for made in simulation:
            if made.step == 4:
                break
    assert "step 4, t = 400.0 µs, of 10 steps" in str(open_result(tmp_path))


def test_wide_tables_show_a_dozen_columns_that_are_not_zero(result):
    table = result.table()
    assert list(table)[:2] == ["step", "time"]
    head, *_, more = str(table).splitlines()
    names = head.split()
    assert len(names) == 12 and names[:2] == ["step", "time"]
    assert all(np.any(table[name]) for name in names)
    assert more.startswith(f"and {len(table) - 12} more columns: ") and more.endswith(", ...")
    wide = Table({f"c{k}": [1.0 + k] for k in range(14)})
    assert str(wide).splitlines()[-1] == "and 2 more columns: c12, c13"
    assert str(Table(dict(list(wide.items())[:13]))).splitlines()[-1] == "and 1 more column: c12"
    assert "support_force.x" in table.text(1)


def test_a_printed_result_of_a_failed_analysis_tells_where_it_ended(tmp_path):
    """The limit of the load is 38 N of 100 N."""
    words = ["von_mises", "-o", str(tmp_path), "--quiet", "--set", "static.method=newton"]
    assert main([*words, *(f"static.{key}=" for key in ("node_set", "direction", "displacement"))]) == 3
    (end,) = (line for line in str(open_result(tmp_path)).splitlines() if line.startswith("  end"))
    assert "load factor 0.3" in end and end.endswith(", of 1")
