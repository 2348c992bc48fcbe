"""The verb mesh: each action on files, cases that it writes, messages."""

import re
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.cli.main import main
from pfem_petsc.formats import read_whole
from pfem_petsc.mesh import load_slab
from pfem_petsc.mesh.tools import summary
from pfem_petsc.mesh.whole import WholeMesh

MESHES = Path(__file__).parents[2] / "meshes"


@pytest.fixture
def mesh(tmp_path, monkeypatch, capfd):
    """Run the verb in a folder of its own; return status, output and errors."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        status = main(["mesh", *map(str, words)])
        return (status, *capfd.readouterr())

    return call


@pytest.mark.slow
def test_a_file_in_millimetres_becomes_a_case_that_runs(mesh, tmp_path):
    status, out, err = mesh("clean", MESHES / "tower.inp", "tower.vtu", "--scale", "0.001", "--case", "tower.toml")
    assert (status, err) == (0, "")
    assert "4 nodes merged with others" in out and "tower.vtu: 12 nodes, 26 bars" in out
    text = Path("tower.toml").read_text()
    assert "not known" not in text and "steel" not in text  # all is in the file
    assert "area = 0.000314159265\n" in text and "young_modulus = 210000000000.0\n" in text
    case = Case.load("tower.toml")
    assert case.material["Steel"].young_modulus == pytest.approx(2.1e11)
    assert case.section["Legs"].area == pytest.approx(314.159265e-6) and case.section["Braces"].bars == "Braces"
    assert set(case.node_set) == {"Feet", "Head"}
    assert [(entry.node_set, entry.fix) for entry in case.support] == [("Feet", "xyz")]
    assert case.load[0].force == (250.0, 0.0, -1000.0) and case.gravity.acceleration == pytest.approx((0, 0, -9.81))
    assert (case.static.parameters.step, case.static.parameters.max_step, case.time) == (0.1, 1.0, None)
    with Simulation(case, output=tmp_path / "out", quiet=True) as run:
        run.run()
        mass = run.model.total_mass
    head = open_result(tmp_path / "out").history["probe/Head/position"]
    moved = head[-1] - head[0]
    assert (moved[:, 0] > 1e-5).all() and moved[:, 2].mean() < -1e-5  # where its loads push it
    truss = Truss.read("tower.vtu")
    volume = truss.lengths @ truss.bar_fields["area"]
    assert mass == pytest.approx(7850.0 * volume, rel=1e-6)  # of the geometry in metres
    areas = sorted(set(np.round(truss.bar_fields["area"], 12)))
    assert areas == pytest.approx([78.5e-6, 314.159265e-6])


def test_generated_meshes(mesh):
    assert mesh("generate", "rod", "rod.inp", "--set", "length=2", "mesh.elements=4", "--area", "1e-4")[0] == 0
    rod = Truss.read("rod.inp")
    assert (rod.n_bars, rod.lengths.sum(), set(rod.node_groups)) == (4, pytest.approx(2.0), {"start", "end"})
    assert rod.bar_fields["area"].tolist() == [1e-4] * 4
    # that of a case has its areas and materials
    status, out, _ = mesh("generate", "ring_impact", "ring.inp", "--set", "mesh.bays=6")
    assert status == 0
    case = Case.load("ring_impact", ["mesh.bays=6"])
    ring = read_whole("ring.inp")
    assert out == f"ring.inp: {len(ring.points)} nodes, {len(ring.bars)} bars\n"
    material = next(iter(case.material))
    assert ring.tables["material"][material]["young_modulus"] == case.material[material].young_modulus
    assert set(ring.bar_fields["area"]) == {section.area for section in case.section.values()}
    # fields of lattices are expressions
    keys = ["cells=[1,1,1]", "pitch=1", 'bar_fields={w = "1 + z"}']
    assert mesh("generate", "lattice", "l.vtu", "--set", *keys)[0] == 0
    assert read_whole("l.vtu").bar_fields["w"].max() == 2.0


@pytest.mark.slow
def test_convert_info_refine_merge_picture(mesh):
    assert mesh("convert", MESHES / "mast.vtu", "mast.msh")[0] == 0
    assert mesh("refine", "mast.msh", "fine.h5", "--parts", "3")[0] == 0
    status, out, _ = mesh("info", "fine.h5", MESHES / "mast.vtu")
    assert status == 0 and re.search(r"^  bars +666$", out, re.MULTILINE) and re.search(r"^  bars +222$", out, re.M)
    status, out, _ = mesh("merge", "mast.msh", MESHES / "mast.vtu", "-o", "same.h5")
    assert status == 0 and "52 nodes merged" in out and "same.h5: 52 nodes, 222 bars" in out
    assert mesh("picture", "mast.msh", "--size", "640x360", "--view", "iso")[0] == 0
    content = Path("mast.png").read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n" and content[16:24] == (640).to_bytes(4, "big") + (360).to_bytes(4, "big")


def test_info_shows_vectors_and_counts_rows():
    mesh = WholeMesh(np.eye(2, 3), np.array([[0, 1]]), tables={"load": {"top": {"force": [0.0, 0.5, -1.0]}}})
    mesh.tables["gravity"] = {"g": {"acceleration": [[0.0, 0, 0, 0], [1.0, 0, 0, -9.81]]}}
    told = dict(summary(mesh))
    assert (told["load top"], told["gravity g"]) == ("force [0, 0.5, -1]", "acceleration of 2 rows")


def test_pictures_have_the_colours_of_groups():
    import io

    from matplotlib.image import imread

    from pfem_petsc.post.page import mesh_page as draw

    image = imread(io.BytesIO(draw(read_whole(MESHES / "mast.vtu"), (640, 360), "xz")))
    assert image.shape[:2] == (360, 640)
    for colour in ((0.0, 0x72 / 255, 0xB2 / 255), (0xE6 / 255, 0x9F / 255, 0.0)):
        assert (np.abs(image[:, :, :3] - colour).max(axis=2) < 0.02).sum() > 20
    assert (image[[0, -1], :, :3] == 1.0).all() and (image[:, [0, -1], :3] == 1.0).all()  # nothing is cut off


def test_a_case_for_a_mesh_that_tells_nothing(mesh):
    Truss([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1], [1, 2]], node_groups={"none": []}).write("a.h5")
    assert mesh("convert", "a.h5", "sub/b.vtu", "--case", "c.toml")[0] == 0
    text = Path("c.toml").read_text()
    for key in ("material.steel.young_modulus", "material.steel.density", "section.bars.area"):
        assert f"#   {key}\n" in text
    case = Case.load("c.toml")
    assert case.mesh.file == Path("sub/b.vtu").resolve() and not case.node_set
    assert load_slab(case.mesh, MPI.COMM_SELF).n_bars == 2
    Path("t_nodes.csv").write_text("x,y\n0,0\n1,0\n")
    Path("t_bars.csv").write_text("node1,node2,A_m2\n0,1,3e-4\n")
    assert mesh("convert", "t_bars.csv", "t.h5", "--case", "t.toml")[0] == 0
    assert "#   section.bars.area_field, by the name of the field\n" in Path("t.toml").read_text()
    assert Case.load("t.toml").section["bars"].area_field == "A_m2"
    # an existing case is not replaced
    status, _, err = mesh("convert", "a.h5", "b.vtu", "--case", "c.toml")
    assert status == 2 and "--case c.toml: this file exists" in err and not Path("b.vtu").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "the following arguments are required: ACTION"),
        (["turn"], "invalid choice: 'turn'"),
        (["info"], "the following arguments are required: FILE"),
        (["info", "no.msh"], "error: there is no file no.msh"),
        (["convert", MESHES / "ring.msh", "ring.dwg"], "ring.dwg: no writer for .dwg; known suffixes: .inp"),
        (["convert", MESHES / "ring.msh", "ring.3mf"], "error: ring.3mf: 3MF needs a radius of each bar"),
        (["convert", MESHES / "ring.msh", "a.h5", "--scale", "-1"], "scale: -1.0 is not a positive number"),
        (["convert", MESHES / "ring.msh", "t.csv"], "error: t.csv: a mesh in tables is a pair of files, t_nodes.csv"),
        (["refine", MESHES / "ring.msh", "a.h5", "--parts", "0"], "refine: 0 parts of a bar"),
        (["clean", MESHES / "ring.msh", "a.h5", "--tolerance", "x"], "'x' is not a positive number"),
        (["picture", MESHES / "ring.msh", "-o", "a.svg"], "a.svg: a picture is written as .png"),
        (["picture", MESHES / "ring.msh", "--size", "9x9"], "'9x9' is not a size in pixels"),
        (["picture", MESHES / "ring.msh", "--view", "askew"], "view = 'askew' is not known"),
        (["generate", "rod", "a.h5"], "mesh generate rod: mesh.length: this key is missing"),
        (
            ["generate", "rod", "a.h5", "--set", "pitch=1"],
            "mesh.pitch (given by --set): a key of lattice, not of generator rod",
        ),
        (["generate", "rood", "a.h5"], "rood"),
        (["generate", "rod", "a.xyz", "--set", "length=1", "elements=2"], "no writer for .xyz"),
    ],
)
def test_messages(mesh, words, text):
    status, _, err = mesh(*words)
    assert status == 2 and text in err and err.startswith("error: ") and "Traceback" not in err


@pytest.mark.slow
def test_on_ranks_one_works_and_refusals_end_all(on_ranks, tmp_path):
    done = on_ranks(2, "-m", "pfem_petsc", "mesh", "info", MESHES / "ring.msh", timeout=240.0)
    assert done.returncode == 0 and done.stdout.count("node groups") == 1
    (tmp_path / "bad.inp").write_text("*NODE\n1, 0, zero\n")
    done = on_ranks(2, "-m", "pfem_petsc", "mesh", "convert", "bad.inp", "b.h5", cwd=tmp_path, timeout=240.0)
    assert done.returncode == 2 and done.stderr.count("bad.inp: line 2: *NODE: 'zero' is not a number") == 1
