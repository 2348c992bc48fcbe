"""Files that all ranks read together: each its share, in pieces, and what one rank alone would get."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from helpers.gathered import whole

from pfem_petsc.errors import InputError
from pfem_petsc.mesh import load_slab
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.readers import _shares, read_whole, vtk
from pfem_petsc.mesh.slab import slab_range
from pfem_petsc.mesh.whole import WholeMesh
from pfem_petsc.mesh.writers import write_whole

pytestmark = pytest.mark.parallel


@pytest.fixture
def small_pieces(monkeypatch):
    """Several pieces a rank."""
    monkeypatch.setattr(_shares, "PIECE", 7)


def lattice_file(comm, path):
    """Write a lattice with groups that overlap and a field, on rank 0; return it."""
    slab = lattice.generate(lattice.Parameters(kind="octet", cells=[2, 2, 3], pitch=0.37), 0, 1)
    groups = {"third": np.arange(0, slab.n_bars, 3), "none": np.empty(0, np.int64), **slab.bar_groups}
    fields = {"area": 1e-6 * (1.0 + np.arange(slab.n_bars))}
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
