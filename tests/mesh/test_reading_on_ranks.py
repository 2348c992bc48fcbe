"""Files that all ranks read together: each its share, in pieces, and what one rank alone would get."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from helpers.meshes import whole

from pfem_petsc.errors import InputError
from pfem_petsc.formats import hdf5, read_slab, write_whole
from pfem_petsc.mesh import load_slab
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.slab import slab_range
from pfem_petsc.mesh.whole import WholeMesh

pytestmark = pytest.mark.parallel


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    """Several pieces of rows a rank."""
    monkeypatch.setattr(hdf5, "PIECE", 7)


def on_rank_0(comm, path, write):
    """Write a file on rank 0; return its name."""
    if comm.rank == 0:
        write(path) if callable(write) else path.write_bytes(write)
    comm.Barrier()
    return path


def lattice_file(comm, path):
    """Write a lattice with groups that overlap and a field, on rank 0; return it."""
    slab = lattice.generate(lattice.Parameters(kind="octet", cells=[2, 2, 3], pitch=0.37), 0, 1)
    groups = {"third": np.arange(0, slab.n_bars, 3), "none": np.empty(0, np.int64), **slab.bar_groups}
    fields = {"area": 1e-6 * (1.0 + np.arange(slab.n_bars))}
    mesh = WholeMesh(slab.points, slab.bars.astype(np.int64), slab.node_groups, groups, fields)
    on_rank_0(comm, path, lambda path: write_whole(path, mesh))
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


def test_every_rank_reads_its_share(comm, shared_tmp_path):
    path = shared_tmp_path / "lattice.h5"
    mesh = lattice_file(comm, path)
    slab = load_slab(SimpleNamespace(generator=None, file=path), comm, {"area": "area_field"})
    check(slab, mesh, comm)
    first, last = slab_range(len(mesh.bars), comm.rank, comm.size)
    np.testing.assert_array_equal(slab.bar_fields["area"], mesh.bar_fields["area"][first:last])


def test_members_of_a_group_in_any_order_and_several_times(comm, shared_tmp_path):
    path = shared_tmp_path / "lattice.h5"
    lattice_file(comm, path)
    members = np.random.default_rng(1).permutation(np.tile(np.arange(0, 100, 3), 2))

    def write(path, members=members):
        with h5py.File(path, "r+", locking=False) as file:
            file.pop("bar_groups", None)
            file["bar_groups/third"] = members

    on_rank_0(comm, path, write)
    slab = read_slab(path, comm)
    assert np.concatenate(comm.allgather(slab.bar_groups["third"])).tolist() == list(range(0, 100, 3))
    members[-1] = 10**6  # on the last rank alone
    on_rank_0(comm, path, write)
    with pytest.raises(InputError, match="/bar_groups/third has member 1000000, but numbers go from 0 to"):
        read_slab(path, comm)


def test_gmsh_with_tags_far_apart_and_in_any_order(comm, shared_tmp_path):
    tags = [7_000_000_000_000, 3, 900, 12, 5]
    nodes = "\n".join([*map(str, tags), *(f"{k} 0 {k * k}" for k in range(5))])
    lines = "\n".join(f"{90 - k} {tags[k]} {tags[(k + 2) % 5]}" for k in range(5))
    text = (
        f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 5 3 {max(tags)}\n1 1 0 5\n{nodes}\n$EndNodes\n"
        f"$Elements\n1 5 86 90\n1 1 1 5\n{lines}\n$EndElements\n"
    )
    slab = read_slab(on_rank_0(comm, shared_tmp_path / "sparse.msh", text.encode()), comm)
    assert whole(slab, comm).bars.tolist() == [[k, (k + 2) % 5] for k in range(5)]
