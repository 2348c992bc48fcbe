"""Nastran bulk data against hand calculation, pyNastran's own sums and counts of the text."""

import re
import sys
import tomllib

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_slab, read_whole, write_whole
from pfem_petsc.mesh.tools import scaled
from pfem_petsc.mesh.whole import skeleton

TRUSS = """SOL 101
CEND
SPC = 2
SUBCASE 1
  SUBTITLE = first
  LABEL = down
  LOAD = 13
SUBCASE 2
  LABEL = side
  LOAD = 14
BEGIN BULK
PROD,11,5,100.
PTUBE,12,5,20.,2.
CROD,1,11,1,2
CTUBE,2,12,1,3
CONROD,3,1,4,5,100.
MAT1,5,210000.,,.3,7.85-9,1.2-5
CORD2R,7,,0.,0.,0.,0.,0.,1.,
,0.,1.,0.
GRID,1,,0.,0.,0.,,456
GRID,2,,-1000.,1000.,0.
GRID,3,7,1000.,0.,0.
GRID,4,,1000.,1000.,0.
SPCADD,2,11,12
SPC1,11,123,2,THRU,4
SPC,12,1,3,0.
LOAD,13,2.,.5,8,1.,9
FORCE,8,1,7,1000.,-1.,0.,0.
GRAV,9,0,9810.,0.,-1.,0.
FORCE,14,1,0,500.,1.,0.,0.
CONM2,20,1,0,.01
CELAS2,30,100.,1,1
CELAS2,31,100.,1,2
ENDDATA
"""
"""Three bars from one node, in millimetres, newtons and tonnes."""
MIDDLE = "PARAM,AUTOSPC,NO\nMAT1,1,1.+6,,.3,2.\nPROD,1,1,3.\nGRID,1,,0.,0.,0.\nGRID,2,,2.,0.,0.\nGRID,3,,2.,1.,0.\n"
MIDDLE += "CROD,1,1,1,2\nCROD,2,1,2,3\n"


@pytest.fixture(autouse=True)
def bdf_module(request):
    return None if "absent" in request.node.name else pytest.importorskip("pyNastran.bdf.bdf")


def read(folder, text, scale=1.0, name="a.bdf"):
    (folder / name).write_text(text)
    mesh = scaled(read_whole(folder / name), scale)
    mesh.warnings = [text.partition(f"{name}: ")[2] for text in mesh.warnings]
    return mesh


def test_a_deck_becomes_a_case(tmp_path):
    mesh = read(tmp_path, TRUSS, 0.001)
    np.testing.assert_allclose(mesh.points, [[0, 0, 0], [-1, 1, 0], [0, 1, 0], [1, 1, 0]], atol=1e-15)
    assert mesh.bars.tolist() == [[0, 1], [0, 2], [0, 3]]
    tube = np.pi * (0.01**2 - 0.008**2)
    np.testing.assert_allclose(mesh.bar_fields["area"], [1e-4, tube, 1e-4], rtol=1e-12)
    assert {name: own.tolist() for name, own in mesh.bar_groups.items()} == {
        "prod_11": [0],
        "ptube_12": [1],
        "conrod": [2],
    }
    tables = mesh.tables
    assert tables["material"] == {"mat1_5": {"young_modulus": 2.1e11, "density": 7850.0, "thermal_expansion": 1.2e-5}}
    assert tables["section"]["ptube_12"]["shape"] == "tube" and tables["section"]["ptube_12"]["thickness"] == 0.002
    assert tables["mass"] == {"node_1": {"node_set": "node_1", "value": 10.0}}
    assert tables["load_case"] == {
        "down": {
            "load": [{"node_set": "node_1", "force": [0.0, -1000.0, 0.0]}],
            "gravity": {"acceleration": [0.0, -19.62, 0.0]},
        },
        "side": {"load": [{"node_set": "node_1", "force": [500.0, 0.0, 0.0]}]},
    }
    assert {(keys["node_set"], keys["fix"]) for keys in tables["support"].values()} == {
        ("node_1", "z"),
        ("fixed_xyz", "xyz"),
    }
    assert tables["analysis"] == {"static": {"step": 1.0}}
    left, linear = mesh.warnings
    assert left == "left out cards that are not read: 2 CELAS2"
    assert linear == "SOL 101 is linear: the case has large displacements, as all cases do"


@pytest.mark.slow
def test_load_cases_of_a_deck_run(tmp_path):
    """500 N along x pull and push the inclined bars by 500/sqrt(2); loads along y are shared by stiffness."""
    mesh = read(tmp_path, TRUSS, 0.001)
    path = write_whole(tmp_path / "a.h5", mesh)
    case = Case.from_toml(skeleton(mesh, path, tmp_path / "a.toml"), tmp_path)
    assert Simulation(case, output=tmp_path / "out", quiet=True).run() == 0
    result = open_result(tmp_path / "out")
    down, side = result.field("axial_force", -2), result.field("axial_force", -1)
    np.testing.assert_allclose(side, [500 / 2**0.5, 0.0, -500 / 2**0.5], rtol=1e-4, atol=0.02)
    tube = np.pi * (0.01**2 - 0.008**2)
    mass = 10.0 + 7850.0 * 0.5 * (tube + 2e-4 * 2**0.5)
    stiff = np.array([1e-4 / 8**0.5, tube, 1e-4 / 8**0.5])  # of each bar along y, times E/L
    share = (1000.0 + mass * 19.62) * stiff / stiff.sum()
    np.testing.assert_allclose(down, share * [2**0.5, 1.0, 2**0.5], rtol=1e-4)


@pytest.mark.slow
def test_three_bars_as_msc_nastran_prints_them(tmp_path):
    """Forces and displacements of SOL 101; a load times 1e-4 keeps displacements small, as in the linear solution."""
    text = """SOL 101
CEND
SPC = 2
LOAD = 13
BEGIN BULK
MAT1    5       3.+7            .3      .284
PROD    11      5       1.
PROD    12      5       2.
PROD    13      5       3.
CROD    1       11      1       2
CROD    2       12      1       3
CROD    3       13      1       4
GRID    1               0.      0.      0.
GRID    2               -100.   100.    0.
GRID    3               0.      100.    0.
GRID    4               100.    100.    0.
SPC1    2       123456  2       3       4
LOAD    13      1.-4    1.      8
FORCE   8       1       0       1.      50000.  100000. 0.
ENDDATA
"""
    mesh = read(tmp_path, text)
    case = Case.from_toml(skeleton(mesh, write_whole(tmp_path / "a.h5", mesh), tmp_path / "a.toml"), tmp_path)
    assert Simulation(case, output=tmp_path / "out", quiet=True).run() == 0
    result = open_result(tmp_path / "out")
    np.testing.assert_allclose(result.field("axial_force", -1) * 1e4, [-700.7184, -49009.04, -71411.40], rtol=4e-6)
    moved = (result.positions(-1) - result.positions(0))[0] * 1e4
    np.testing.assert_allclose(moved, [7.701027e-2, 8.168172e-2, 0.0], rtol=1e-6, atol=1e-12)


def test_coordinate_systems_and_the_sums_of_pynastran(tmp_path):
    """Cylindrical places, rotated supports, forces along lines and across planes."""
    text = MIDDLE + (
        "CORD2C,5,,2.,0.,0.,2.,0.,1.,\n,3.,0.,0.\nGRID,4,5,2.,90.,3.,7\nCROD,3,1,3,4\n"
        "CORD2R,7,,0.,0.,0.,0.,0.,1.,\n,0.,1.,0.\nCORD2R,8,,0.,0.,0.,0.,0.,1.,\n,1.,1.,0.\n"
        "GRID,5,,9.,9.,9.,8\nCROD,4,1,4,5\nSPC1,1,2,4\nSPC1,1,1,5\nSPC1,1,123,1\n"
        "FORCE,3,2,8,10.,1.,0.,1.\nFORCE1,3,3,7.,1,3\nFORCE2,3,4,5.,1,2,1,3\nMOMENT,3,4,0,5.,1.,0.,0.\n"
    )  # fmt: skip
    mesh = read(tmp_path, text, name="a.nas")
    np.testing.assert_allclose(mesh.points[3], [2.0, 2.0, 3.0], atol=1e-12)
    supports = {name: keys["fix"] for name, keys in mesh.tables["support"].items()}
    assert supports == {"node_1": "xyz", "node_4": "x"}  # along 2 of the system 7, which is -x
    assert "the support of GRID 5 along 1 of 8 is left out: not an axis" in mesh.warnings
    assert "left out cards that are not read: 1 MOMENT" in mesh.warnings
    forces = {name: keys["force"] for name, keys in mesh.tables["load"].items()}
    half = 0.5**0.5
    np.testing.assert_allclose(forces["node_2"], [10 * half, 10 * half, 10.0], rtol=1e-12)
    np.testing.assert_allclose(forces["node_3"], np.array([2.0, 1.0, 0.0]) * 7 / 5**0.5, rtol=1e-12)
    np.testing.assert_allclose(forces["node_4"], [0.0, 0.0, 5.0], atol=1e-12)
    from pyNastran.bdf.bdf import BDF
    from pyNastran.bdf.mesh_utils.loads import sum_forces_moments

    deck = BDF(debug=None)
    deck.read_bdf(str(tmp_path / "a.nas"), punch=True)
    total, _ = sum_forces_moments(deck, 1, 3, include_grav=False)
    np.testing.assert_allclose(np.sum(list(forces.values()), axis=0), total, rtol=1e-12)


def test_beams_motions_and_masses(tmp_path):
    text = MIDDLE + (
        "PARAM,WTMASS,.5\nPBAR,2,1,4.\nGRID,4,,5.,1.,0.\nGRID,9,,8.,8.,8.\nCBAR,5,2,1,3,0.,0.,1.\nCBAR,6,2,3,4,0.,0.,1.\n"
        ",56,456\nCONM2,7,2,,6.\nCONM2,8,9,,6.\nSPC,1,1,12,0.,2,1,.25\nSPC,1,9,1,0.\nSPC1,3,1,4\nRBE2,9,1,123,9\n"
    )
    mesh = read(tmp_path, text, name="a.dat")
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [0, 2], [2, 3]]
    assert mesh.bar_fields["area"].tolist() == [3.0, 3.0, 4.0, 4.0]
    assert mesh.tables["material"]["mat1_1"]["density"] == 1.0 and mesh.tables["mass"]["node_2"]["value"] == 3.0
    assert mesh.tables["support"]["node_2"] == {
        "node_set": "node_2", "fix": "x", "motion": [[0, 0, 0, 0], [1, 0.25, 0, 0]], "interpolation": "linear",
    }  # fmt: skip
    assert mesh.warnings == [
        "left out 1 GRID where no bar ends",
        "left out cards that are not read: 1 RBE2",
        "1 CBAR, without bending stiffness, are read as bars",  # the other one has hinges
        "left out the SPC sets [3]: the case has 1",
        "left out 1 CONM2 where no bar ends",
    ]


@pytest.mark.parametrize(
    ("head", "tables", "told"),
    [
        ("SOL 103\nCEND\nMETHOD = 4\nBEGIN BULK\nEIGRL,4,,,6\n", {"modes": {"count": 6, "kind": "vibration"}}, []),
        ("SOL 105\nCEND\nMETHOD = 4\nBEGIN BULK\nEIGRL,4,0.,9.\n",
         {"modes": {"count": 10, "kind": "buckling", "linear": True}}, ["a limit of the eigenvalues is not supported"]),
        ("SOL 106\nCEND\nBEGIN BULK\nPARAM,G,.1\n", {"static": {"step": 0.1}},
         ["left out cards that are not read: PARAM G"]),
        ("SOL 106\nCEND\nNLPARM = 2\nBEGIN BULK\nNLPARM,2,4\n", {"static": {"step": 0.25}}, []),
        ("SOL 103\nCEND\nMETHOD = 4\nBEGIN BULK\nEIGR,4,LAN,,,,5\n", {"modes": {"count": 5, "kind": "vibration"}}, []),
        ("SOL 129\nCEND\nBEGIN BULK\n", None, ["SOL 129 is left out: the case has no analysis"]),
        ("SOL 153\nCEND\nBEGIN BULK\nSPC,1,1,1,5.\n", None, ["left out supports, loads and the analysis"]),
        ("", None, []),
    ],
)  # fmt: skip
def test_solutions(tmp_path, head, tables, told):
    mesh = read(tmp_path, head + MIDDLE + "ENDDATA\n" * bool(head))
    assert mesh.tables.get("analysis") == tables
    assert len(mesh.warnings) == len(told) and all(a.startswith(b) for a, b in zip(mesh.warnings, told))


def test_supports_and_areas_that_are_not_there_are_told(tmp_path):
    mesh = read(tmp_path, MIDDLE + "SPC1,1,123,1,7,8\nPROD,2,1,0.\nCROD,3,2,3,1\n")
    assert list(mesh.tables["support"]) == ["node_1"]
    assert mesh.warnings == [
        "prod_2 have the area 0: a case needs a positive one",
        "left out the supports of 2 GRID that do not exist: 7, 8",
    ]


@pytest.mark.parametrize("encoding", ["latin1", "utf-8-sig", "utf-8"])
def test_encodings_and_title_of_a_deck(tmp_path, encoding):
    """Comments and the title have letters that are not ASCII; an included file is in a folder beside the deck."""
    head = "$ Brücke\nSOL 101\nCEND\nTITLE = Brücke\nSUBTITLE = dead load\nBEGIN BULK\n$ Stäbe\n"
    body = MIDDLE.replace("GRID,3,,2.,1.,0.", "INCLUDE 'parts/grid.inc'")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "grid.inc").write_text("GRID,3,,2.,1.,0.\n$ Stäbe\n", encoding=encoding.removesuffix("-sig"))
    (tmp_path / "a.bdf").write_text(head + body + "ENDDATA\n", encoding=encoding)
    mesh = read_whole(tmp_path / "a.bdf")
    assert mesh.points.tolist() == [[0, 0, 0], [2, 0, 0], [2, 1, 0]] and mesh.title == "Brücke: dead load"
    text = skeleton(scaled(mesh, 0.001), tmp_path / "a.bdf", tmp_path / "a.toml")
    assert tomllib.loads(text)["title"] == "Brücke: dead load"


def test_sets_that_no_subcase_names_are_left_out(tmp_path):
    sets = "SPC1,1,123,1\nFORCE,3,2,0,10.,1.,0.,0.\n"
    mesh = read(tmp_path, "SOL 106\nCEND\nBEGIN BULK\n" + MIDDLE + sets)
    assert "support" not in mesh.tables and "load" not in mesh.tables
    assert mesh.warnings == [
        "left out the SPC sets [1]: the case has none",
        "left out the load sets [3]: the case has none",
    ]
    mesh = read(tmp_path, "SOL 103\nCEND\nSPC = 1\nLOAD = 3\nBEGIN BULK\n" + MIDDLE + sets)
    assert list(mesh.tables["support"]) == ["node_1"] and "load" not in mesh.tables


def test_a_flat_truss_is_held_as_by_autospc(tmp_path):
    mesh = read(tmp_path, MIDDLE.replace("AUTOSPC,NO", "AUTOSPC,YES"))
    assert [keys["fix"] for keys in mesh.tables["support"].values()] == ["z"]
    assert mesh.warnings == ["the case holds 3 nodes of a flat truss along z, as AUTOSPC does"]
    mesh = read(tmp_path, MIDDLE.replace(",.3,2.", ",.3,,,,.02"))
    assert mesh.warnings == [
        "left out the damping GE of MAT1 [1]",
        "MAT1 [1] have no density, which is 0 in Nastran: a case needs a positive one",
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (MIDDLE.replace("PROD,1,1,3.", "PROD,1,1,three"), "pyNastran cannot read it: A = 'THREE'"),
        (MIDDLE.replace("GRID,3,,2.,1.,0.\n", ""), "there is no GRID 3, at which a bar ends"),
        (MIDDLE.replace("D,3", f"D,{9**25}").replace("2,3", f"2,{9**25}"), f"GRID {9**25}, .* at most 8 digits"),
        (MIDDLE.replace("0.,0.,0.", "nan,0.,0."), r"1 nodes .* not numbers below .*: node 0 at \(nan, 0, 0\)"),
        (MIDDLE.replace("2.,0.,0.", "2.,inf,0."), r"1 nodes .* not numbers below .*: node 1 at \(2, inf, 0\)"),
        (MIDDLE.replace("PROD,1,1,3.", "PROD,1,1,-3."), "PROD 1 has the area -3: expected a positive one"),
        (MIDDLE + "CONROD,3,1,3,1,-2.\n", "CONROD 3 has the area -2: expected a positive one"),
        (MIDDLE.replace("GRID,3,", "GRID,3,4") + "CORD1R,4,1,2,3\n", "coordinate systems .* in a circle"),
        (MIDDLE + "INCLUDE 'other.bdf'\n", "pyNastran cannot read it: .*other.bdf"),
        ("GRID,1,,0.,0.,0.\nGRID,2,,0.,1.,0.\nCELAS2,1,3.,1,1,2,1\n", "has no CROD, .*: it has 1 CELAS2"),
        ("", "has no CROD"),
    ],
)
def test_what_is_wrong(tmp_path, monkeypatch, capfd, text, told):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f"a.bdf: {told}"):
        read(tmp_path, text)
    assert [path.name for path in tmp_path.iterdir()] == ["a.bdf"]  # no file of a crash
    assert "".join(capfd.readouterr()) == ""


def test_pynastran_is_absent(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyNastran.bdf.bdf", None)
    monkeypatch.setitem(sys.modules, "cpylog", None)
    with pytest.raises(InputError, match=re.escape("which is not installed: pip install pyNastran")):
        read(tmp_path, MIDDLE)


@pytest.mark.parallel
def test_ranks_share_a_deck(comm, shared_tmp_path):
    if comm.rank == 0:
        (shared_tmp_path / "a.bdf").write_text(TRUSS)
    comm.Barrier()
    slab = read_slab(shared_tmp_path / "a.bdf", comm, {"area": "section.area_field"})
    assert slab.n_nodes == 4 and slab.n_bars == 3 and len(slab.warnings) == 1  # of the cards
    assert comm.allreduce(len(slab.bars)) == 3
    assert comm.allreduce(slab.bar_fields["area"].sum()) == pytest.approx(200.0 + np.pi * (10**2 - 8**2))
