"""Input that has no end, or far too much of it, is refused before it is read or built."""

import os
import zipfile

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.cli.main import main
from pfem_petsc.errors import InputError
from pfem_petsc.files import memory_of_machine
from pfem_petsc.formats import read_whole
from pfem_petsc.mesh.generators.lattice.expressions import Expression

ROD = {
    "mesh": {"generator": "rod", "length": 1.0, "elements": 2},
    "node_set": {"end": {"group": "end"}},
    "material": {"m": {"young_modulus": 1e6, "density": 1e3}},
    "section": {"s": {"area": 1e-3, "material": "m"}},
    "time": {"integrator": "central_differences", "step": 1e-4, "end": 1e-3},
}
LOAD = {"node_set": "end", "force": [1.0, 0.0, 0.0]}


@pytest.fixture
def pipe(tmp_path):
    """A function that makes a pipe, which nobody writes into, of a name."""

    def make(name):
        os.mkfifo(tmp_path / name)
        return tmp_path / name

    return make


@pytest.mark.parametrize(
    "tables",
    [
        {"mesh": {"file": "x.csv"}},
        {"mesh": {"file": "x.msh"}},
        {"mesh": {"file": "x.h5"}},
        {"load": [{**LOAD, "table_file": "x.csv"}]},
        {"load": [{"file": "x.npz"}]},
        {"mesh": {"generator": "lattice", "pitch": 0.1, "surface": {"file": "x.stl"}}},
    ],
)
def test_pipes_are_no_files(tables, pipe, tmp_path):
    (entry,) = (row for table in tables.values() for row in (table if isinstance(table, list) else [table]))
    path = pipe(entry.get("table_file") or entry.get("file") or "x.stl")
    with pytest.raises(InputError, match=r"no regular file but a pipe") as raised:
        Simulation(Case.from_dict({**ROD, **tables}, folder=tmp_path), output=tmp_path / "out", quiet=True)
    assert path.name in str(raised.value)


def test_a_case_file_without_end(pipe, capsys):
    assert main(["check", str(pipe("case.toml"))]) == 2
    assert main(["check", "/dev/zero"]) == 2
    assert capsys.readouterr().err.count("no regular file but a pipe, socket or device") == 2


def test_a_file_larger_than_the_memory(tmp_path):
    """Sparse files take no room on the disk."""
    with open(tmp_path / "large.csv", "wb") as file:
        file.truncate(int(2 * memory_of_machine()))
    with pytest.raises(InputError, match="more than the memory"):
        Case.from_dict({**ROD, "load": [{**LOAD, "table_file": "large.csv"}]}, folder=tmp_path)


@pytest.mark.parametrize(
    "tables",
    [
        {"mesh": {"file": "a\0b.h5"}},
        {"load": [{**LOAD, "table_file": "a\0b.csv"}]},
        {"load": [{**LOAD, "table_file": {"file": "a\0b.csv"}}]},
        {"load": [{"file": "a\0b.npz"}]},
        {"mesh": {"generator": "lattice", "pitch": 0.1, "surface": {"file": "a\0b.stl"}}},
    ],
)
def test_names_with_a_nul(tables, tmp_path):
    with pytest.raises(InputError, match="cannot contain a NUL character"):
        Case.from_dict({**ROD, **tables}, folder=tmp_path)


@pytest.mark.parametrize(
    "mesh",
    [
        {"generator": "lattice", "cells": [1000000, 30, 10], "pitch": 1.0},
        {"generator": "net", "cells": [10000000, 60], "size": [1.0, 1.0]},
        {"generator": "rod", "length": 1.0, "elements": 700000000},
    ],
)
def test_a_mesh_larger_than_the_memory(mesh):
    with pytest.raises(InputError, match=r"mesh\.(cells|elements): [\d,]+ nodes.* GB of memory or more"):
        Simulation(Case.from_dict({**ROD, "mesh": mesh, "node_set": {}}), quiet=True, check_only=True)


def model_of_3mf(path, objects, items, blanks=0):
    core = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    lattice = "http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02"
    head = f'<model xmlns="{core}" xmlns:b="{lattice}" unit="meter"><resources>{objects}</resources>'
    text = f"{head}{' ' * blanks}<build>{items}</build></model>"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", text)


BEAM = """<object id="0"><mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/></vertices>
<b:beamlattice radius="0.1"><b:beams><b:beam v1="0" v2="1"/></b:beams></b:beamlattice></mesh></object>"""


def nested(levels, each):
    rows = "".join(
        f'<object id="{k}"><components>{each * f"""<component objectid="{k - 1}"/>"""}</components></object>'
        for k in range(1, levels + 1)
    )
    return BEAM + rows


def test_a_3mf_file_of_nested_copies(tmp_path):
    """10 copies of 10 copies ...: 111 objects of 100 beams in 2 levels are read, 10^8 in 8 levels are not."""
    model_of_3mf(tmp_path / "few.3mf", nested(2, 10), '<item objectid="2"/>')
    assert len(read_whole(tmp_path / "few.3mf").bars) == 100
    model_of_3mf(tmp_path / "many.3mf", nested(8, 10), '<item objectid="8"/>')
    with pytest.raises(InputError, match="111,111,111 objects and components, and at most 1,000,000"):
        read_whole(tmp_path / "many.3mf")


@pytest.mark.slow
def test_a_3mf_file_of_blanks(tmp_path):
    model_of_3mf(tmp_path / "blank.3mf", BEAM, '<item objectid="0"/>', 3 * 10**7)
    with pytest.raises(InputError, match=r"3D/3dmodel.model has 30,\d+,\d+ bytes in [\d,]+ compressed ones"):
        read_whole(tmp_path / "blank.3mf")


def test_long_expressions():
    """900 terms and 90 signs are computed; what Python cannot read is refused."""
    x = np.array([0.5, 2.0])
    np.testing.assert_allclose(Expression("+".join(["x"] * 900), ("x",))({"x": x}), 900.0 * x, rtol=1e-13)
    np.testing.assert_array_equal(Expression("-" * 600 + "x", ("x",))({"x": x}), x)
    with pytest.raises(ValueError, match="nested too deep|too many nested"):
        Expression("(" * 900 + "x" + ")" * 900, ("x",))
    keep = "+".join(["x"] * 900)
    mesh = {"generator": "lattice", "cells": [2, 1, 1], "pitch": 1.0, "keep": f"{keep} < 1e9"}
    Simulation(Case.from_dict({**ROD, "mesh": mesh, "node_set": {}}), quiet=True, check_only=True)


def test_an_output_within_a_file(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["rod_impact", "-o", str(tmp_path / "file" / "x"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path / 'file'} is no folder" in said and "another run" not in said


def test_a_second_run_does_nothing(tmp_path):
    """With checkpoints, whose file is closed by then; the history keeps its rows."""
    simulation = Simulation(Case.from_dict({**ROD, "output": {"checkpoint_every": 3}}), output=tmp_path, quiet=True)
    assert simulation.run() == 0
    assert simulation.run() == 0
    assert list(simulation) == []
    assert simulation.state.step == 10


def test_unstressed_cables_are_not_slack(tmp_path):
    """Bars of a turned truss at rest: their strains are rounding, of either sign; one that is shortened is slack."""
    random = np.random.default_rng(3)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    points = random.normal(size=(40, 3)) @ turn * 3.7
    bars = [[k, k + 1] for k in range(39)]
    data = {
        "node_set": {"all": {"all": True}, "first": {"indices": [0]}},
        "material": {"m": {"law": "cable", "young_modulus": 1e9, "density": 1e3}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "support": [{"node_set": "all", "fix": "xyz", "velocity": [0.1, -0.2, 0.3]}],
        "time": {"integrator": "newmark", "step": 0.1, "end": 1.0},
        "output": {"fields_every": 0},
    }
    with Simulation(Case(data, mesh=Truss(points, bars)), output=tmp_path / "out", quiet=True) as simulation:
        rows = [step.row["slack_bars"] for step in simulation]
    assert set(rows) == {0}
