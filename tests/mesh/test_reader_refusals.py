"""Any mesh file is read, or refused with a message that names the file."""

import random

import numpy as np
import pytest
from helpers.files import BARS, GMSH, POINTS, mutated_bytes, sound_meshes, write_hdf5, write_vtk
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI

from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_slab
from pfem_petsc.mesh.whole import check_mesh

ALONE = MPI.COMM_SELF
TEXT = {version: GMSH[f"{version} ascii"].decode() for version in ("2.2", "4.1")}


def refusal(path):
    with pytest.raises(InputError) as caught:
        check_mesh(read_slab(path, ALONE), ALONE)
    assert str(path) in str(caught.value)
    return str(caught.value).replace(str(path), "FILE")


@pytest.mark.parametrize(
    ("version", "old", "new", "message"),
    [
        ("2.2", "2.2 0 8", "4.0 0 8", "FILE: section $MeshFormat: version 4.0 is not read; save the mesh as version"),
        ("2.2", "2.2 0 8", "2.2 0", "'2.2 0' is not 'version file-type data-size'"),
        ("2.2", "2.2 0 8", "2.2 1 8", "the binary number 1 that shows the byte order is missing"),
        ("2.2", "$MeshFormat", "# vtk", "FILE: does not start with $MeshFormat"),
        ("2.2", "$EndElements", "", "section $Elements has no end; the file is truncated"),
        (
            "2.2",
            "$Nodes\n4",
            "$Nodes\n5",
            "section $Nodes: its counts declare more numbers than it has; is it truncated?",
        ),
        ("2.2", "$Nodes\n4", "$Nodes\n3", "section $Nodes: has more numbers than its counts declare"),
        ("2.2", "$Nodes\n4", "$Nodes\n4e17", "section $Nodes: 4e+17 is not a count"),
        (
            "2.2",
            "$Nodes\n4",
            "$Nodes\n999999999999",
            "section $Nodes: its counts declare more numbers than it has; is it truncated?",
        ),
        ("2.2", "$Nodes\n4", "$Nodes\n-4", "section $Nodes: -4 ... -4 are not counts"),
        ("2.2", "7 1.0 0.0 0.0", "7 1.0 zero 0.0", "section $Nodes, line 3: 'zero' is not a number"),
        ("2.2", "7 1.0 0.0 0.0", "10 1.0 0.0 0.0", "section $Nodes: node 10 is listed more than once"),
        ("2.2", "7 1.0 0.0 0.0", "7.5 1.0 0.0 0.0", "7.5 is not a count or a tag"),
        ("2.2", "7 1.0 0.0 0.0", "7 1.0 inf 0.0", "1 nodes have coordinates that are not numbers"),
        ("2.2", "2 1 2 0 1 10 7", "2 1 2 0 1 10 8", "section $Elements: node 8 is not in $Nodes"),
        ("2.2", "2 1 2 0 1 10 7", "2 8 2 0 1 10 7 21", "section $Elements: curved lines (type 8); make the mesh of"),
        ("2.2", "2 1 2 0 1 10 7", "2 77 2 0 1 10 7", "section $Elements: 77 is not a known type of element"),
        ("2.2", "2 1 2 0 1 10 7", "2 1 -2 0 1 10 7", "section $Elements: -2 tags of element 1 of 8"),
        ("2.2", "2 1 2 0 1 10 7", "2 1 2 0 1 10 10", "1 bars start and end at the same node"),
        ("2.2", "$Elements\n8", "$Elements\n9", "section $Elements"),
        (
            "2.2",
            "$PhysicalNames\n2",
            "$PhysicalNames\n3",
            "section $PhysicalNames: its 2 lines after the first are not the 3",
        ),
        ("2.2", '0 5 "top"', "0 5 top", "section $PhysicalNames: its 2 lines"),
        ("2.2", '0 5 "top"', '0 v "top"', "section $PhysicalNames: its 2 lines"),
        ("4.1", "$Nodes\n1 4", "$Nodes\n1 5", "section $Nodes declares 5 nodes, its blocks hold 4"),
        ("4.1", "1 1 0 4\n", "7 1 1 4\n", "section $Nodes: a block of entities of dimension 7"),
        ("4.1", "1 1 0 4\n", "1 1 0 99999999999\n", "section $Nodes declares 4 nodes, its blocks hold 99999999999"),
        ("4.1", "$Elements\n4 8", "$Elements\n4 9", "section $Elements declares 9 elements, its blocks hold 8"),
        (
            "4.1",
            "$Elements\n4 8",
            "$Elements\n9 8",
            "section $Elements: its counts declare more numbers than it has; is it truncated?",
        ),
        ("4.1", "$Entities\n1 2", "$Entities\n1 999999999", "section $Entities: its counts declare"),
        ("4.1", "$Elements", "$Triangles", "section $Triangles has no end"),
        ("4.1", "300\n21", "300\n300", "section $Nodes: node 300 is listed more than once"),
        ("4.1", "3 7 300", "3 7 301", "section $Elements: node 301 is not in $Nodes"),
        ("4.1", "$EndElements", "7\n$EndElements", "section $Elements: has more numbers than its counts declare"),
        (
            "4.1",
            "5 10 21\n6 21 7\n7 300 21\n2 1 2 1\n99 10 7 300\n$EndElements\n",
            "5 10 21\n6 21 7\n8 300 21\n2 1 2 1\n99 10 7 300\n$EndElements\n"
            "$Comments\nbars in the order of their tags\n$EndComments\n",
            "the tags of the lines do not follow one another, as $Comments says: remove that section",
        ),
        ("4.1", "$Entities", "$PartitionedEntities\n0\n$EndPartitionedEntities\n$Entities", "without partitions"),
    ],
)
def test_gmsh_text_with_one_thing_wrong(tmp_path, version, old, new, message):
    assert old in TEXT[version]
    path = tmp_path / "wrong.msh"
    path.write_text(TEXT[version].replace(old, new, 1))
    assert message in refusal(path)


def test_gmsh_without_bars(tmp_path):
    path = tmp_path / "empty.msh"
    path.write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n0\n$EndNodes\n$Elements\n0\n$EndElements\n")
    assert refusal(path) == "FILE: 0 nodes and 0 bars: nothing to simulate"
    path.write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n0\n$EndNodes\n")
    assert refusal(path) == "FILE: has no section $Elements"


def test_gmsh_nodes_without_bars_say_the_way_out(tmp_path):
    path = tmp_path / "points.msh"
    path.write_text(TEXT["2.2"].replace("$Nodes\n4\n", "$Nodes\n5\n77 9 9 9\n"))
    assert "1 nodes belong to no bar: node 0; remove them" in refusal(path)
    assert "each point of a physical group" in refusal(path)


def test_gmsh_points_without_lines_say_what_gmsh_saves(tmp_path):
    """A physical group of points and none of lines: Gmsh saves the points alone."""
    path = tmp_path / "points.msh"
    path.write_text(
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n1 0 0 0\n$EndNodes\n"
        "$Elements\n1\n1 15 2 1 1 1\n$EndElements\n"
    )
    assert refusal(path) == (
        "FILE: 1 nodes and 0 bars: nothing to simulate; if there are physical groups, Gmsh saves nothing else: put "
        'the lines into one (Physical Curve("bars") = {:}), or save all (Mesh.SaveAll = 1)'
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": None}, "no dataset /points"),
        ({"bars": POINTS}, "/bars has shape (4, 3) and type float64; expected (n, 2) integers"),
        ({"points": POINTS[:, :2]}, "/points has shape (4, 2)"),
        ({"points": POINTS.astype("S8")}, "/points has shape (4, 3) and type |S8; expected (n, 3) floats"),
        ({"bars": BARS + 1}, "3 bars have an end that does not exist: bar 3 (nodes 1 and 4)"),
        ({"bars": BARS[:2], "bar_groups/legs": None}, "1 nodes belong to no bar: node 3"),
        ({"node_groups/top": np.array([4])}, "/node_groups/top has member 4, but numbers go from 0 to 3"),
        ({"bar_groups/legs": np.array([[1]])}, "/bar_groups/legs is not a list of integers"),
        ({"bar_groups": np.array([1])}, "/bar_groups is not a group of datasets"),
    ],
)
def test_hdf5_with_one_thing_wrong(tmp_path, change, message):
    import h5py

    path = tmp_path / "wrong.h5"
    write_hdf5(path)
    with h5py.File(path, "r+", locking=False) as file:
        for name, data in change.items():
            del file[name]
            if data is not None:
                file[name] = data
    assert message in refusal(path)


def test_hdf5_that_declares_more_than_it_holds(tmp_path):
    import h5py

    path = tmp_path / "huge.h5"
    for chunks in (None, (1024, 2)):
        with h5py.File(path, "w", locking=False) as file:
            file["points"] = POINTS
            file.create_dataset("bars", (10**13, 2), np.int64, chunks=chunks)
        assert "/bars declares (10000000000000, 2) values but holds 0 bytes" in refusal(path)


GARBAGE = [b"", b"\0" * 1000, b"$", b"*", b"<VTKFile", b"\x89HDF\r\n\x1a\n" + b"\xff" * 500, b"PK\3\4" + b"\xff" * 500]


@pytest.mark.parametrize(
    "suffix", ["msh", "vtu", "vtp", "vtk", "vtkhdf", "h5", "inp", "stl", "3mf", "obj", "ply", "json"]
)
@pytest.mark.parametrize("content", GARBAGE)
def test_garbage_is_refused_without_a_word_on_stderr(tmp_path, capfd, suffix, content):
    path = tmp_path / f"garbage.{suffix}"
    path.write_bytes(content)
    refusal(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("suffix", ["vtu", "vtkhdf", "h5"])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.97])
def test_truncated_files_are_refused(tmp_path, suffix, share):
    path = tmp_path / f"short.{suffix}"
    (write_hdf5 if suffix == "h5" else write_vtk)(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refusal(path)


def test_vtu_on_which_vtk_aborts_is_refused(tmp_path):
    """A number of compressed blocks in the billions, for which VTK throws where nothing catches."""
    path = tmp_path / "blocks.vtu"
    write_vtk(path)
    content = path.read_bytes()
    assert b"AQAAAACA" in content
    path.write_bytes(content.replace(b"AQAAAACA", b"AQAA5ACA"))
    refusal(path)


@pytest.mark.slow
def test_vtk_with_other_cells(tmp_path):
    import pyvista

    path = tmp_path / "solid.vtu"
    pyvista.ImageData(dimensions=(2, 2, 2)).cast_to_unstructured_grid().save(path)
    assert "cells of types [11]; bars are lines (type 3) or edges of faces (types 5, 7, 9), and" in refusal(path)
    pyvista.Sphere().save(tmp_path / "sphere.vtp")
    (tmp_path / "sphere.vtp").rename(path)
    assert "FILE" in refusal(path)


@pytest.mark.slow
@settings(max_examples=200)
@given(st.data())
def test_changed_words_of_gmsh_text_are_read_or_refused(tmp_path_factory, data):
    words = TEXT[data.draw(st.sampled_from(sorted(TEXT)))].split(" ")
    new = st.sampled_from(["-1", "0", "1", "2", "1e9", "1e400", "nan", "", "9" * 30, "4294967297", "x", "\n", "$End"])
    for _ in range(data.draw(st.integers(1, 3))):
        words[data.draw(st.integers(0, len(words) - 1))] = data.draw(new)
    path = tmp_path_factory.getbasetemp() / "words.msh"
    path.write_text(" ".join(words))
    read_or_refused(path)


def read_or_refused(path):
    try:
        slab = read_slab(path, ALONE)
        check_mesh(slab, ALONE)
    except InputError as error:
        assert str(path.parent) in str(error)
    else:
        assert len(slab.points) == slab.n_nodes > 0
        assert len(slab.bars) == slab.n_bars


NAMES = [f"{kind.replace(' ', '-')}.msh" for kind in GMSH]
NAMES += [
    "mesh.h5",
    "mesh.inp",
    "parts.inp",
    "mesh.3mf",
    "mesh_bars.csv",
    "mesh_nodes.csv",
    "mesh.stl",
    "mesh.obj",
    "mesh.ply",
    "mesh.json",
]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_changed_files_are_read_or_refused(tmp_path, name):
    sound_meshes(tmp_path)
    content = (tmp_path / name).read_bytes()
    for seed in range(150):
        (tmp_path / name).write_bytes(mutated_bytes(content, random.Random(seed)))
        read_or_refused(tmp_path / name)


@pytest.mark.parallel
@pytest.mark.parametrize("name", ["a.inp", "a.stl", "a.3mf", "a.msh"])
def test_all_ranks_refuse(comm, shared_tmp_path, name):
    if comm.rank == 0:
        (shared_tmp_path / name).write_text("*NODE\n1, zero\n" if name == "a.inp" else "x,y\n")
    comm.Barrier()
    with pytest.raises(InputError, match=rf"{name}: ") as caught:
        read_slab(shared_tmp_path / name, comm)
    assert len(set(comm.allgather(str(caught.value)))) == 1
