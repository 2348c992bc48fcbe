"""A truss that is written in any format and read back is the same truss; so are files of other programs."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.meshes import whole

from pfem_petsc import Truss, write_mesh
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole, suffixes, write_whole
from pfem_petsc.mesh import load_slab

NAMES = ["t.h5", "t.vtu", "t.vtp", "t.vtk", "t.vtkhdf", "t.msh", "t.inp", "t.3mf", "t_bars.csv"]
EXACT = ("t.h5", "t.vtu", "t.vtp", "t.vtk", "t.vtkhdf", "t.msh", "t_bars.csv")
"""Have all bar fields; the others the areas."""


def irregular():
    """Coordinates with all digits, groups that overlap, with other letters, and bars in no order."""
    random = np.random.default_rng(5)
    points = random.normal(size=(12, 3))
    points[0] = [1.0 / 3.0, -1e-17, 1e5]
    bars = np.array([(i, j) for i in range(12) for j in range(i + 1, min(i + 4, 12))])
    random.shuffle(bars)
    n = len(bars)
    return Truss(
        points,
        bars,
        node_groups={"feet": [0, 1, 2], "top": [2, 7, 11], "all nodes": np.arange(12)},
        bar_groups={"legs": [3, 4, 5], "Träger": [5, 9, n - 1], "third": np.arange(0, n, 3)},
        bar_fields={"area": random.choice([1e-4, 2e-4, 1.0 / 3e4], n), "load": random.normal(size=n)},
    )


@pytest.mark.parallel
@pytest.mark.parametrize("name", NAMES)
def test_a_case_reads_what_was_written(comm, shared_tmp_path, name):
    truss = irregular()
    path = write_mesh(
        shared_tmp_path / name,
        truss.points,
        truss.bars,
        node_groups=truss.node_groups,
        bar_groups=truss.bar_groups,
        bar_fields=truss.bar_fields,
        comm=comm,
    )
    slab = load_slab(SimpleNamespace(generator=None, file=path), comm, {"area": "section.s.area_field"})
    mesh = whole(slab, comm)
    np.testing.assert_array_equal(mesh.points, truss.points)
    np.testing.assert_array_equal(mesh.bars, truss.bars)
    areas = np.concatenate(comm.allgather(slab.bar_fields["area"]))
    np.testing.assert_allclose(areas, truss.bar_fields["area"], rtol=4e-16)
    with pytest.raises(InputError, match=r"section.s.area_field = 'aera': .* has no field of this name"):
        load_slab(SimpleNamespace(generator=None, file=path), comm, {"aera": "section.s.area_field"})


def test_sections_and_materials_of_abaqus_come_back(tmp_path):
    truss = irregular()
    truss.tables = {
        "material": {
            "STEEL": {"young_modulus": 2.1e11, "density": 7850.0, "yield_stress": 2e8, "kinematic_hardening": 1e9},
            "rope": {"young_modulus": 1e11, "density": 1000.0, "thermal_expansion": 1e-5, "damping": 500.0},
            "curve": {"law": "multilinear", "young_modulus": 1e9, "density": 1.0, "curve": [[1e-3, 1e6], [0.5, 2e6]]},
        },
        "section": {
            "rest": {"area_field": "area", "material": "STEEL"},
            "legs": {"bars": "legs", "area_field": "area", "material": "rope"},
        },
    }
    text = truss.write(tmp_path / "t.inp").read_text()
    assert text.count("MATERIAL=rope") == len(set(truss.bar_fields["area"][[3, 4, 5]]))
    again = read_whole(tmp_path / "t.inp")
    assert list(again.tables["material"]) == ["STEEL", "rope", "curve"]
    for name, keys in again.tables["material"].items():
        own = truss.tables["material"][name]
        assert set(keys) == set(own)
        for key, value in keys.items():
            assert value == own[key] if key == "law" else np.allclose(value, own[key], rtol=1e-14)
    np.testing.assert_array_equal(again.bar_fields["area"], truss.bar_fields["area"])
    of = {m: again.bar_groups[s["bars"]].tolist() for s in again.tables["section"].values() if (m := s["material"])}
    assert {3, 4, 5} & set(of["STEEL"]) == set()


def test_every_format_that_is_written_is_read():
    read = set(suffixes("read", "read_on"))
    written = {".inp", ".msh", ".vtu", ".vtp", ".vtk", ".vtkhdf", ".3mf", ".csv", ".h5"}
    assert set(suffixes("write")) == written
    assert read - written == {".stl", ".obj", ".ply", ".json", ".bdf", ".nas", ".dat"}


def test_gmsh_and_vtk_as_meshio_reads_them(tmp_path):
    meshio = pytest.importorskip("meshio")
    truss = irregular()
    truss = Truss(truss.points, truss.bars)  # it refuses files in which only some elements are in groups
    for name in ("t.msh", "t.vtu"):
        mesh = meshio.read(truss.write(tmp_path / name))
        np.testing.assert_array_equal(mesh.points, truss.points)
        lines = [block.data for block in mesh.cells if block.type == "line"]
        found = {tuple(sorted(bar)) for bar in np.concatenate(lines).tolist()}
        assert found == {tuple(sorted(bar)) for bar in truss.bars.tolist()}


def test_abaqus_as_meshio_reads_it(tmp_path):
    meshio = pytest.importorskip("meshio")
    truss = irregular()
    mesh = meshio.read(truss.write(tmp_path / "t.inp"))
    np.testing.assert_array_equal(mesh.points, truss.points)
    np.testing.assert_array_equal(mesh.cells_dict["line"], truss.bars)
    assert mesh.point_sets["top"].tolist() == [2, 7, 11]
    assert [members.tolist() for members in mesh.cell_sets["legs"]] == [[3, 4, 5]]
    with open(tmp_path / "t.inp") as file:
        areas = re.findall(r"^\*SOLID SECTION, ELSET=(\S+)\n(\S+),$", file.read(), flags=re.MULTILINE)
    for name, area in areas:
        assert (truss.bar_fields["area"][mesh.cell_sets[name][0]] == float(area)).all()


def test_vtkhdf_as_pyvista_reads_it(tmp_path):
    import pyvista

    truss = irregular()
    grid = pyvista.read(truss.write(tmp_path / "t.vtkhdf"))
    np.testing.assert_array_equal(grid.points, truss.points)
    np.testing.assert_array_equal(grid.cells_dict[3], truss.bars)
    np.testing.assert_array_equal(grid.cell_data["area"], truss.bar_fields["area"])
    assert np.flatnonzero(grid.point_data["group:feet"]).tolist() == [0, 1, 2]
    truss.grid().save(tmp_path / "grid.vtu")
    assert Truss.read(tmp_path / "grid.vtu") == truss


def gmsh_elements(physical):
    """Lines with number, type, tags, nodes: one of two groups, listed twice, as Gmsh does in version 2.2."""
    lines = [f"{k} 1 2 {group} {curve} {a} {b}" for k, (group, curve, a, b) in enumerate(physical, 1)]
    return (
        '$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n2\n1 1 "one"\n1 2 "two"\n$EndPhysicalNames\n'
        "$Nodes\n3\n1 0 0 0\n2 1 0 0\n3 0 1 0\n$EndNodes\n"
        f"$Elements\n{len(lines)}\n" + "\n".join(lines) + "\n$EndElements\n"
        '$ElementData\n1\n"area"\n1\n0.0\n3\n0\n1\n'
        + f"{len(lines)}\n"
        + "".join(f"{k} {k}e-4\n" for k in range(len(lines), 0, -1))
        + "$EndElementData\n"
        '$ElementData\n1\n"part"\n1\n0.0\n3\n0\n1\n1\n1 5.0\n$EndElementData\n'
    )


def test_bars_of_several_groups_in_gmsh_2(tmp_path):
    path = tmp_path / "two.msh"
    path.write_text(gmsh_elements([(1, 7, 1, 2), (2, 7, 1, 2), (1, 8, 2, 3), (2, 9, 3, 1)]))
    mesh = read_whole(path)
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [2, 0]]
    assert {name: members.tolist() for name, members in mesh.bar_groups.items()} == {"one": [0, 1], "two": [0, 2]}
    assert mesh.bar_fields["area"].tolist() == [1e-4, 3e-4, 4e-4]
    (warning,) = mesh.warnings
    assert "section $ElementData 'part' is left out: it does not have a value for each line" in warning
    # of the same group they are two bars at the same place, which a case refuses
    path.write_text(gmsh_elements([(1, 7, 1, 2), (1, 7, 1, 2), (1, 8, 2, 3), (2, 9, 3, 1)]))
    assert len(read_whole(path).bars) == 4


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('1\n"area"', 'x\n"area"', r"section \$ElementData: 'x' is not the number of its tags"),
        ("3\n0\n1\n4", "3\n0\nmany\n4", r"section \$ElementData 'area': expected three whole numbers"),
        ("3\n0\n1\n4", "3\n0\n1\n400", r"\$ElementData 'area': its counts declare more numbers than it has"),
    ],
)
def test_gmsh_data_with_one_thing_wrong(tmp_path, old, new, text):
    path = tmp_path / "wrong.msh"
    content = gmsh_elements([(1, 7, 1, 2), (2, 7, 1, 2), (1, 8, 2, 3), (2, 9, 3, 1)])
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(InputError, match=text):
        read_whole(path)


@pytest.mark.parametrize("name", NAMES)
def test_odd_names(tmp_path, name):
    """Of groups and numbers of bars; only what a format cannot have is replaced. All else is the same."""
    odd = [
        "a b",
        "A b",
        "x,y",
        "<tag>&",
        "#hash",
        "a=b",
        "*star",
        "nan",
        "Ü",
        "_section_1",
        "1",
        'q"uote',
        "semi;colon",
    ]
    own = irregular()
    truss = Truss(
        own.points,
        own.bars,
        node_groups={text: [k % 12] for k, text in enumerate(odd)},
        bar_groups={text: [k, k + 1] for k, text in enumerate(odd)},
        bar_fields={"area": own.bar_fields["area"], "Load case": own.bar_fields["load"], "<w>": np.zeros(30)},
    )
    again = Truss.read(truss.write(tmp_path / name))
    changed = {"t.msh": ('"', "'"), "t.inp": ('"', "'"), "t_bars.csv": (";", "_")}.get(name, ("", ""))
    expected = [text.replace(*changed) if changed[0] else text for text in odd]
    if name == "t.inp":
        expected[1] = "A b_"  # capitals are small letters there
    for groups, kept in ((again.node_groups, truss.node_groups), (again.bar_groups, truss.bar_groups)):
        found = {text: members.tolist() for text, members in groups.items()}
        assert found == {new: kept[text].tolist() for new, text in zip(expected, odd)}
    assert set(again.bar_fields) == (set(truss.bar_fields) if name in EXACT else {"area"})
    for field, values in again.bar_fields.items():
        np.testing.assert_allclose(values, truss.bar_fields[field], rtol=0 if name in EXACT else 4e-16)
    np.testing.assert_array_equal(again.points, truss.points)
    np.testing.assert_array_equal(again.bars, truss.bars)
    assert again.warnings == []


@pytest.mark.parametrize("name", ["a.h5", "a.vtkhdf"])
def test_names_with_slashes(tmp_path, name):
    """Gmsh has such names, HDF5 cannot."""
    mesh = irregular().to_mesh()
    mesh.bar_groups = {"a/b": np.array([1]), "a_b": np.array([2])}
    write_whole(tmp_path / "s.msh", mesh)
    write_whole(tmp_path / name, read_whole(tmp_path / "s.msh"))
    for file in ("s.msh", name):
        truss = Truss.read(tmp_path / file)
        assert {key: members.tolist() for key, members in truss.bar_groups.items()} == {"a_b_": [1], "a_b": [2]}


def test_what_cannot_be_written_leaves_the_earlier_file(tmp_path):
    path = Truss([[0, 0, 0], [1, 0, 0]], [[0, 1]], bar_fields={"area": [1.0]}).write(tmp_path / "a.3mf")
    before = path.read_bytes()
    with pytest.raises(InputError, match="3MF needs a radius"):
        Truss([[0, 0, 0], [1, 0, 0]], [[0, 1]]).write(path)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["a.3mf"]
