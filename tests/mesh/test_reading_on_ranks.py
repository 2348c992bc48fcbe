"""Files that all ranks read together: each its share, in pieces, and what one rank alone would get."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from helpers.gathered import whole
from helpers.samples import GMSH

from pfem_petsc.errors import InputError
from pfem_petsc.mesh import load_slab
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.readers import _gmsh_stream, _shares, gmsh, read_whole, vtk
from pfem_petsc.mesh.slab import slab_range
from pfem_petsc.mesh.whole import WholeMesh
from pfem_petsc.mesh.writers import write_whole

pytestmark = pytest.mark.parallel


@pytest.fixture
def small_pieces(monkeypatch):
    """Several pieces a rank."""
    monkeypatch.setattr(_shares, "PIECE", 7)


def lattice_file(comm, path, fields=True):
    """Write a lattice with groups that overlap and a field, on rank 0; return it."""
    slab = lattice.generate(lattice.Parameters(kind="octet", cells=[2, 2, 3], pitch=0.37), 0, 1)
    groups = {"third": np.arange(0, slab.n_bars, 3), "none": np.empty(0, np.int64), **slab.bar_groups}
    fields = {"area": 1e-6 * (1.0 + np.arange(slab.n_bars))} if fields else {}
    mesh = WholeMesh(slab.points, slab.bars.astype(np.int64), slab.node_groups, groups, fields)
    if comm.rank == 0:
        write_whole(path, mesh)
    comm.Barrier()
    return mesh


def check(slab, mesh, comm):
    again = whole(slab, comm)
    np.testing.assert_array_equal(again.points, mesh.points)
    np.testing.assert_array_equal(again.bars, mesh.bars)
    for kind in ("node_groups", "bar_groups"):
        one, other = getattr(again, kind), getattr(mesh, kind)
        assert sorted(one) == sorted(other)
        for name in one:
            assert one[name].tolist() == np.sort(other[name]).tolist()


@pytest.mark.parametrize("suffix", ["vtkhdf", "h5"])
def test_every_rank_reads_its_share(comm, shared_tmp_path, monkeypatch, small_pieces, suffix):
    path = shared_tmp_path / f"lattice.{suffix}"
    mesh = lattice_file(comm, path)
    monkeypatch.setattr(vtk, "read", None)
    rows = []
    read = h5py.Dataset.__getitem__

    def counted(dataset, key, *more):
        found = read(dataset, key, *more)
        rows.append(len(found))
        return found

    monkeypatch.setattr(h5py.Dataset, "__getitem__", counted)
    slab = load_slab(SimpleNamespace(generator=None, file=path), comm, {"area": "area_field"})
    assert max(rows) <= 2 * 7 + 1
    check(slab, mesh, comm)
    first, last = slab_range(len(mesh.bars), comm.rank, comm.size)
    np.testing.assert_array_equal(slab.bar_fields["area"], mesh.bar_fields["area"][first:last])
    assert slab.bars.dtype == np.int32


def test_vtkhdf_that_is_not_plain_is_left_to_vtk(comm, shared_tmp_path, small_pieces):
    """One cell that is no line, on the last rank's share."""
    path = shared_tmp_path / "mixed.vtkhdf"
    mesh = lattice_file(comm, path)
    if comm.rank == 0:
        with h5py.File(path, "r+") as file:
            file["VTKHDF/Types"][-1] = 4  # a line of several points, here two
    comm.Barrier()
    assert vtk.read_on(path, comm, {}) is None
    check(load_slab(SimpleNamespace(generator=None, file=path), comm), mesh, comm)


def test_a_field_that_vtkhdf_has_not_is_named(comm, shared_tmp_path):
    path = shared_tmp_path / "lattice.vtkhdf"
    lattice_file(comm, path)
    with pytest.raises(InputError, match=r"section.strut.area_field = 'thickness'.*it has area"):
        load_slab(SimpleNamespace(generator=None, file=path), comm, {"thickness": "section.strut.area_field"})


def test_members_of_a_group_are_read_once_by_all_ranks_together(comm, small_pieces):
    """In any order, and several times."""
    members = np.random.default_rng(1).permutation(np.tile(np.arange(0, 100, 3), 2))
    rows = []

    class Dataset:
        name = "/bar_groups/third"

        def __len__(self):
            return len(members)

        def __getitem__(self, key):
            rows.append(len(members[key]))
            return members[key]

    mine = _shares.route_members(Dataset(), 100, comm, "FILE")
    assert np.concatenate(comm.allgather(mine)).tolist() == list(range(0, 100, 3))
    assert comm.allreduce(sum(rows)) == len(members) and max(rows) <= 7
    members[-1] = 100  # on the last rank alone
    with pytest.raises(InputError, match="FILE: /bar_groups/third has member 100, but numbers go from 0 to 99"):
        _shares.route_members(Dataset(), 100, comm, "FILE")


def test_vtk_reads_plain_files_as_the_ranks_do(comm, shared_tmp_path):
    path = shared_tmp_path / "lattice.vtkhdf"
    lattice_file(comm, path)
    mesh = read_whole(path) if comm.rank == 0 else None
    check(vtk.read_on(path, comm, {}), comm.bcast(mesh), comm)


@pytest.fixture
def small_parts(monkeypatch):
    """Several pieces of text and of rows a rank."""
    monkeypatch.setattr(_gmsh_stream, "PIECE", 5)
    monkeypatch.setattr(_gmsh_stream, "_BYTES", 61)


def same_as_of_one_rank(comm, path):
    """Read a .msh file in parts, and compare with the reader of whole files; return the slab."""
    slab = gmsh.read_on(path, comm, {})
    assert slab is not None
    mesh = comm.bcast(read_whole(path) if comm.rank == 0 else None)
    check(slab, mesh, comm)
    assert list(slab.node_groups) == list(mesh.node_groups) and list(slab.bar_groups) == list(mesh.bar_groups)
    assert slab.warnings == mesh.warnings
    return slab


@pytest.mark.parametrize("kind", ["4.1 ascii", "4.1 binary"])
def test_gmsh_is_read_in_parts(comm, shared_tmp_path, small_parts, kind):
    path = shared_tmp_path / "truss.msh"
    if comm.rank == 0:
        path.write_bytes(GMSH[kind])
    comm.Barrier()
    same_as_of_one_rank(comm, path)


def test_gmsh_of_bars_in_the_order_of_their_tags_is_read_in_parts(comm, shared_tmp_path, small_parts):
    path = shared_tmp_path / "lattice.msh"
    mesh = lattice_file(comm, path, fields=False)
    check(same_as_of_one_rank(comm, path), mesh, comm)


def test_gmsh_with_tags_far_apart_and_in_any_order_is_read_in_parts(comm, shared_tmp_path, small_parts):
    path = shared_tmp_path / "sparse.msh"
    if comm.rank == 0:
        tags = [7_000_000_000_000, 3, 900, 12, 5]
        nodes = "\n".join([*map(str, tags), *(f"{k} 0 {k * k}" for k in range(5))])
        lines = "\n".join(f"{90 - k} {tags[k]} {tags[(k + 2) % 5]}" for k in range(5))
        path.write_text(
            f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 5 3 {max(tags)}\n1 1 0 5\n{nodes}\n$EndNodes\n"
            f"$Elements\n1 5 86 90\n1 1 1 5\n{lines}\n$EndElements\n"
        )
    comm.Barrier()
    slab = same_as_of_one_rank(comm, path)
    assert whole(slab, comm).bars.tolist() == [[k, (k + 2) % 5] for k in range(5)]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("1 5 3 900", "1 6 3 900"),
        ("\n900\n", "\n3\n"),
        ("1 3 900", "1 3 901"),
        ("0 0 0", "0 zero 0"),
        ("$EndElements", "7\n$EndElements"),
        ("4.1 0 8", "2.2 0 8"),
    ],
)
def test_gmsh_with_something_wrong_is_left_to_the_reader_of_whole_files(comm, shared_tmp_path, small_parts, old, new):
    path = shared_tmp_path / "wrong.msh"
    text = (
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 5 3 900\n1 1 0 5\n3\n900\n12\n5\n6\n"
        "0 0 0\n1 0 0\n2 1 0\n3 0 1\n4 4 4\n"
        "$EndNodes\n$Elements\n1 4 1 4\n1 1 1 4\n1 3 900\n2 900 12\n3 12 5\n4 5 6\n$EndElements\n"
    )
    if comm.rank == 0:
        path.write_text(text)
    comm.Barrier()
    assert gmsh.read_on(path, comm, {}) is not None
    comm.Barrier()
    if comm.rank == 0:
        assert old in text
        path.write_text(text.replace(old, new, 1))
    comm.Barrier()
    assert gmsh.read_on(path, comm, {}) is None
