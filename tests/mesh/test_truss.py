"""Trusses from arrays as meshes of cases."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, InputError, Simulation, Truss, open_result, write_mesh
from pfem_petsc.mesh.generators import arrays as module

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.8]])
BARS = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
GROUPS = {"node_groups": {"feet": [0, 1, 2], "top": [3]}, "bar_groups": {"legs": np.arange(6) > 2}}
AREAS = {"bar_fields": {"area": np.linspace(1e-4, 2e-4, 6)}}
TABLES = {
    "node_set": {"feet": {"group": "feet"}, "top": {"group": "top"}},
    "material": {"steel": {"young_modulus": 210e9, "density": 7850.0}},
    "section": {
        "legs": {"bars": "legs", "area": 2e-4, "material": "steel"},
        "ring": {"area_field": "area", "material": "steel"},
    },
    "support": [{"node_set": "feet", "fix": "xyz"}],
    "load": [{"node_set": "top", "force": [0.0, 0.0, -1e3]}],
    "time": {"integrator": "central_differences", "step": 1e-5, "end": 1e-4},
}


def tripod(**more):
    return Truss(POINTS, BARS, **GROUPS, **AREAS, **more)


def history(case, comm, folder):
    with Simulation(case, comm, output=folder, quiet=True) as simulation:
        simulation.run()
    return {name: column for name, column in open_result(folder).history.items()}


@pytest.mark.slow
@pytest.mark.parallel
def test_same_results_as_from_a_file(comm, shared_tmp_path, monkeypatch):
    path = write_mesh(shared_tmp_path / "tripod.h5", POINTS, BARS, **GROUPS, **AREAS, comm=comm)
    expected = history(Case({**TABLES, "mesh": {"file": path}}), comm, shared_tmp_path / "file")
    root = comm.rank == 0
    given = (POINTS, BARS) if root else (None, None)
    small = Truss(*given, **(GROUPS | AREAS if root else {}), comm=comm)
    with monkeypatch.context() as patch:
        patch.setattr(module, "INLINE", 5)
        of_rank_0 = Truss(*given, **(GROUPS | AREAS if root else {}), comm=comm)
    assert (of_rank_0.points is None) == (comm.rank > 0) and of_rank_0 == small == tripod()
    assert small.table() == tripod().table()
    for name, truss in (("all", small), ("root", of_rank_0), ("read", Truss.read(path, ["area"]))):
        case = Case(TABLES, mesh=truss, name="tripod")
        assert case.mesh.truss is truss
        found = history(case, comm, shared_tmp_path / name)
        for column, values in expected.items():
            # PT-Scotch divides the same mesh differently in each run of a process
            scale = 0.0 if comm.size == 1 else 1e-9 * np.abs(values).max() + 1e-15
            assert np.abs(found[column] - values).max() <= scale, (name, column)
    # the text of the result makes the same case, which the title of a nameless case is part of
    result = open_result(shared_tmp_path / "all")
    assert result.case == Case(TABLES, mesh=tripod(), name="tripod")
    assert result.case.mesh.truss == tripod()


@pytest.mark.parallel
def test_ranks_must_agree(comm):
    points = POINTS + (0.0 if comm.rank < comm.size - 1 else 0.1)
    case = Case(TABLES, mesh=Truss(points, BARS, **GROUPS, **AREAS))
    if comm.size == 1:
        Simulation(case, comm, check_only=True).close()
        return
    with pytest.raises(InputError, match=f"arrays of rank {comm.size - 1} differ from those of rank 0"):
        Simulation(case, comm, check_only=True)
    with pytest.raises(InputError, match="bars start and end at the same node: bar 0"):
        Truss(POINTS, [[0, 0]] if comm.rank == 0 else None, comm=comm)


@pytest.mark.parametrize(
    ("points", "bars", "groups", "told"),
    [
        (POINTS, BARS[:3], {}, "1 nodes belong to no bar: node 3; remove them"),
        (POINTS, [*BARS, [1, 0]], {}, "bars 0 and 6 (nodes 0 and 1); keep one of each"),
        (POINTS[[0, 0, 2, 3]], BARS, {}, "length that is zero or overflows double precision: bar 0 (nodes 0 and 1)"),
        (POINTS, [*BARS, [1, 4]], {}, "bars have an end that does not exist: bar 6 (nodes 1 and 4)"),
        (POINTS * np.nan, BARS, {}, "coordinates that are not numbers"),
        (POINTS[:, :2], BARS, {}, "Truss: points has shape (4, 2) and type float64; expected (points, 3) positions"),
        (POINTS, BARS * 1.0, {}, "bars has shape (6, 2) and type float64; expected (bars, 2) integers"),
        (POINTS, BARS, {"node_groups": {"a": [4]}}, "node_groups['a'] has member 4, but numbers go from 0 to 3"),
        (POINTS, BARS, {"bar_groups": {"a/b": [1]}}, "bar_groups['a/b']: expected a name without slashes"),
        ([[0, 0, 0], [1, 0]], BARS, {}, "points has shape"),
        (POINTS + 1j, BARS, {}, "complex128"),
        (POINTS, [], {}, "bars has shape (0,)"),
        (POINTS, BARS, {"node_groups": {"a": [-1]}}, "has member -1"),
        (POINTS, BARS, {"bar_groups": {"a": [0.0]}}, "bar_groups['a'] has shape (1,) and type float64"),
        (POINTS, BARS, {"bar_groups": {"a": np.ones(3, bool)}}, "(6,) booleans"),
        (POINTS, BARS, {"bar_fields": {"c": ["x"] * 6}}, "bar_fields['c']"),
        (POINTS, BARS, {"bar_fields": {"area": [1.0]}}, "bar_fields['area'] has shape (1,)"),
    ],
)
def test_refused_as_mesh_files_are(tmp_path, points, bars, groups, told):
    with pytest.raises(InputError) as caught:
        Truss(points, bars, **groups)
    assert told in str(caught.value)
    with pytest.raises(InputError) as by_file:
        write_mesh(tmp_path / "a.h5", points, bars, **groups)
    assert str(by_file.value) == str(caught.value).replace("Truss", str(tmp_path / "a.h5"), 1)


def test_arrays_are_kept_and_read_only():
    points = POINTS.copy()
    truss = Truss(points, BARS.tolist(), **GROUPS)
    points[:] = 0.0
    assert np.array_equal(truss.points, POINTS) and truss.bars.dtype == np.int64
    assert truss.bar_groups["legs"].tolist() == [3, 4, 5]
    assert truss.lengths[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        truss.points[0] = 1.0
    assert repr(truss) == "<Truss of 4 nodes and 6 bars, groups feet, top, legs>"
    assert pickle.loads(pickle.dumps(truss)) == truss != Truss(POINTS * 2, BARS, **GROUPS)
    grid = tripod().grid()
    assert (grid.n_points, grid.n_cells, grid["group:legs"].sum()) == (4, 6, 3)


def test_arrays_in_a_case_file():
    case = Case(TABLES, mesh=tripod())
    again = Case.from_toml(case.to_toml())
    assert again == case and again.mesh.truss == tripod()
    with pytest.raises(InputError, match="mesh: expected the keys points and bars; bars is missing"):
        Case(TABLES, mesh={"generator": "arrays", "points": POINTS})
    with pytest.raises(InputError, match="case: mesh: 1 nodes belong to no bar: node 3"):
        Case(TABLES, mesh={"generator": "arrays", "points": POINTS, "bars": BARS[:3]})
    with pytest.raises(InputError, match=r"mesh.length: a key of rod.*, not of generator arrays, which takes points"):
        case.mesh.length = 1.0
    case.mesh = {"generator": "rod", "length": 1.0, "elements": 3}
    assert case.mesh.elements == 3


def test_large_trusses_are_a_digest_in_the_text(monkeypatch):
    monkeypatch.setattr(module, "INLINE", 5)
    case = Case(TABLES, mesh=tripod())
    text = case.to_toml()
    assert "points" not in text and tripod().digest in text
    without = Case.from_toml(text)
    with pytest.raises(InputError, match=r"case: mesh: the arrays of this case \(digest .*\) are not in its text"):
        Simulation(without, MPI.COMM_SELF, check_only=True)
    assert Case.from_toml(text, mesh=tripod()) == case == without
    with pytest.raises(InputError, match="the arrays are not those that the case was made with"):
        Case.from_toml(text, mesh=Truss(POINTS * 2, BARS, **GROUPS))


def test_missing_fields_and_groups_are_told():
    bare = Truss(POINTS, BARS, node_groups=GROUPS["node_groups"])
    with pytest.raises(InputError, match="section.ring.area_field = 'area': mesh has no field of this name"):
        Simulation(Case(TABLES, mesh=bare), MPI.COMM_SELF, check_only=True)
    grouped = {**TABLES, "section": {"legs": {"bars": "leg", "area": 2e-4, "material": "steel"}}}
    with pytest.raises(InputError, match="did you mean 'legs'"):
        Simulation(Case(grouped, mesh=tripod()), MPI.COMM_SELF, check_only=True)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("most", [5, 10_000])
def test_restart_with_the_same_truss_only(comm, shared_tmp_path, monkeypatch, most):
    monkeypatch.setattr(module, "INLINE", most)
    given = (POINTS, BARS) if comm.rank == 0 else (None, None)
    mesh = Truss(*given, **(GROUPS | AREAS if comm.rank == 0 else {}), comm=comm)
    case = Case({**TABLES, "output": {"checkpoint_every": 5}}, mesh=mesh)
    history(case, comm, shared_tmp_path / "out")
    longer = case.copy({"time.end": 2e-4})
    other = longer.copy({"mesh": Truss(1.01 * POINTS, BARS, **GROUPS, **AREAS)})
    with pytest.raises(InputError, match=r"belongs to a different case than case: mesh\.(digest|points)"):
        Simulation(other, comm, output=shared_tmp_path / "out", restart=True)
    with Simulation(longer, comm, output=shared_tmp_path / "out", restart=True, quiet=True) as simulation:
        simulation.run()
    assert len(open_result(shared_tmp_path / "out").history["time"]) == 21


def test_checks_of_a_users_mesh_apply(tmp_path):
    """Generated meshes are free of nodes on bars, and those from arrays are not."""
    points = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]]
    mesh = Truss(points, [[0, 1], [1, 2], [0, 2], [0, 3], [2, 3], [1, 3]])
    tables = {key: TABLES[key] for key in ("material", "time")} | {
        "section": {"s": {"area": 1e-4, "material": "steel"}}
    }
    with Simulation(Case(tables, mesh=mesh), MPI.COMM_SELF, tmp_path, check_only=True) as simulation:
        _, warnings = simulation.inspect()
    assert any("lies on a bar" in text for text in warnings)
