from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.files import BARS, GMSH, LEGS, POINTS, TOP, write_hdf5, write_vtk
from helpers.meshes import stiffness_modes, whole

from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_slab
from pfem_petsc.mesh import load_slab
from pfem_petsc.mesh.generators import ring
from pfem_petsc.mesh.slab import slab_range

MESHES = Path(__file__).parents[2] / "meshes"


def written(comm, folder, name, content):
    path = folder / name
    if comm.rank == 0:
        content(path) if callable(content) else path.write_bytes(content)
    comm.Barrier()
    return path


def read(path, comm):
    return load_slab(SimpleNamespace(generator=None, file=path), comm)


def check_sample(mesh, tops=("top",), legs=("legs",)):
    np.testing.assert_array_equal(mesh.points, POINTS)
    np.testing.assert_array_equal(mesh.bars, BARS)
    for name in tops:
        assert mesh.node_groups[name].tolist() == TOP
    for name in legs:
        assert sorted(mesh.bar_groups[name].tolist()) == LEGS


@pytest.mark.parallel
@pytest.mark.parametrize("kind", GMSH)
def test_gmsh(comm, shared_tmp_path, kind):
    slab = read(written(comm, shared_tmp_path, "truss.msh", GMSH[kind]), comm)
    assert slab.first_bar == slab_range(6, comm.rank, comm.size)[0]
    check_sample(whole(slab, comm))
    (warning,) = slab.warnings
    assert warning.endswith("left out 1 elements that are neither lines nor points")


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["2.2 ascii", "4.1 ascii"])
def test_gmsh_as_editors_of_windows_save_it(comm, shared_tmp_path, kind):
    """With a byte order mark, other line ends, and sections of other programs."""
    text = GMSH[kind].decode().replace("$Nodes", "$Comments\n5 $ x\n$EndComments\n$Nodes").replace("\n", "\r\n")
    path = written(comm, shared_tmp_path, "truss.msh", text.encode("utf-8-sig"))
    check_sample(whole(read(path, comm), comm))


@pytest.mark.parallel
@pytest.mark.parametrize("version", ["gmsh22", "gmsh"])
@pytest.mark.parametrize("binary", [False, True])
def test_gmsh_written_by_meshio(comm, shared_tmp_path, version, binary):
    meshio = pytest.importorskip("meshio")

    def write(path):
        mesh = meshio.Mesh(POINTS, [("line", BARS)])
        mesh.write(path, file_format=version, binary=binary)

    check_sample(whole(read(written(comm, shared_tmp_path, "truss.msh", write), comm), comm), (), ())


@pytest.mark.parallel
@pytest.mark.parametrize("suffix", ["vtu", "vtkhdf"])
def test_vtk(comm, shared_tmp_path, suffix):
    mesh = whole(read(written(comm, shared_tmp_path, f"truss.{suffix}", write_vtk), comm), comm)
    check_sample(mesh, ("group_2",), ("legs" if suffix == "vtu" else "section_1",))
    assert list(mesh.node_groups) == ["group_2"]


@pytest.mark.parallel
def test_vtk_with_other_cells_and_lines_of_several_points(comm, shared_tmp_path):
    """A line of n points is n - 1 bars, each with its group and number; vertices and triangles are left out."""

    def write(path):
        import pyvista

        cells = [1, 0, 5, 0, 1, 2, 0, 3, 2, 3, 1, 2, 2, 3, 3, 0, 1, 2]
        grid = pyvista.UnstructuredGrid(cells, np.array([1, 4, 3, 3, 5], np.uint8), POINTS)
        grid.cell_data["section"] = np.array([1, 0, 1, 1, 1], np.int32)
        grid.cell_data["area"] = np.array([9.0, 1.0, 2.0, 3.0, 9.0])
        grid.point_data["group"] = np.where(np.isin(np.arange(len(POINTS)), TOP), 2, -1)
        grid.save(path)

    path = written(comm, shared_tmp_path, "mixed.vtu", write)
    slab = load_slab(SimpleNamespace(generator=None, file=path), comm, {"area": "area_field"})
    (warning,) = slab.warnings
    assert warning.endswith("mixed.vtu: left out 2 cells that are not lines")
    mesh = whole(slab, comm)
    check_sample(mesh, ("group_2",), ())
    assert sorted(mesh.bar_groups["section_0"].tolist()) == [0, 1, 2, 3]
    assert sorted(mesh.bar_groups["section_1"].tolist()) == [4, 5]
    assert np.concatenate(comm.allgather(slab.bar_fields["area"])).tolist() == [1.0, 1.0, 1.0, 1.0, 2.0, 3.0]


@pytest.mark.parallel
def test_hdf5_of_another_writer(comm, shared_tmp_path):
    check_sample(whole(read(written(comm, shared_tmp_path, "truss.h5", write_hdf5), comm), comm))


def test_the_ring_in_the_repository_is_the_generators(comm):
    keys = {"outer_radius": 22.83, "inner_radius": 22.37, "bays": 14, "bracing": "x", "orientation": "vertex"}
    original = ring.generate(ring.Parameters(**keys), 0, 1)
    mesh = whole(read(MESHES / "ring.msh", comm), comm)
    # The file holds the numbers of the machine that made it, whose sines may differ in the last digit.
    np.testing.assert_allclose(mesh.points, original.points, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(mesh.bars, original.bars)
    assert mesh.node_groups["impact"].tolist() == [0]
    assert mesh.node_groups["opposite"].tolist() == [7]
    for name, members in original.bar_groups.items():
        np.testing.assert_array_equal(np.sort(mesh.bar_groups[name]), members)


@pytest.mark.parametrize(
    ("name", "nodes", "bars", "node_groups", "bar_groups"),
    [
        ("space_truss.msh", 261, 1565, {"lowest": 1, "highest": 1}, {"skin": 354, "core": 1211}),
        ("mast.vtu", 52, 222, {"base": 4, "head": 4}, {"legs": 48, "horizontals": 52, "braces": 122}),
    ],
)
def test_the_other_meshes_in_the_repository_are_braced_trusses(comm, name, nodes, bars, node_groups, bar_groups):
    slab = read(MESHES / name, comm)
    assert slab.warnings == []
    mesh = whole(slab, comm)
    assert (mesh.n_nodes, mesh.n_bars) == (nodes, bars)
    assert {group: len(members) for group, members in mesh.node_groups.items()} == node_groups
    assert {group: len(members) for group, members in mesh.bar_groups.items()} == bar_groups
    assert stiffness_modes(mesh.points, mesh.bars) == 6


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rnig.msh", "mesh.file: there is no file .*rnig.msh, did you mean 'ring.msh'"),
        ("ring.vtu", "there is no file .*ring.vtu, did you mean 'ring.msh'"),
        ("house.vtu", "there is no file .*house.vtu; that folder has ring.msh"),
        ("sub/ring.msh", "there is no file .*sub/ring.msh: there is no folder .*sub"),
        ("ring.dxf", "no reader for 'ring.dxf'; known.*.msh.*; export its lines as Wavefront OBJ"),
        ("ring.geo", "no reader for 'ring.geo'; .*: mesh its curves by `gmsh -1 -clmin 1e22 .*ring.geo -o .*ring.msh`"),
        ("ring.xdmf", "no reader for 'ring.xdmf'; .*; convert it by `meshio convert .*ring.xdmf .*ring.vtk`"),
        ("ring.unv", "no reader for 'ring.unv'; .*; convert it by `gmsh .*ring.unv -save -o .*ring.msh`"),
    ],
)
def test_files_that_are_not_there_or_not_known(comm, shared_tmp_path, name, text):
    for there in ("ring.msh", "ring.dxf", "ring.geo", "ring.xdmf", "ring.unv"):
        written(comm, shared_tmp_path, there, b"solid")
    with pytest.raises(InputError, match=text):
        read_slab(shared_tmp_path / name, comm)
