import numpy as np
import pytest
from helpers.meshes import slab_from, whole

from pfem_petsc.mesh.distribution import distribute
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.ordering import hilbert_keys

PARTITIONERS = ["coordinates", "ptscotch"]


def irregular(comm):
    """Random points joined to some others, numbered at random, with groups."""
    random = np.random.default_rng(5)
    points = random.uniform(-1, 3, (200, 3)) * [4.0, 1.0, 0.2]
    pairs = random.integers(0, 200, (900, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    pairs = np.concatenate([pairs, np.stack([np.arange(199), np.arange(1, 200)], 1)])
    _, first = np.unique(np.sort(pairs, axis=1), axis=0, return_index=True)
    pairs = random.permutation(pairs[first])
    return slab_from(points, pairs, comm, {"some": range(0, 200, 7)}, {"third": range(0, len(pairs), 3)})


def cube(comm):
    keys = lattice.Parameters(kind="cubic", cells=[4, 3, 5], pitch=0.1)
    return lattice.generate(keys, comm.rank, comm.size)


MESHES = {"irregular": irregular, "cube": cube}


@pytest.fixture(params=[(mesh, partitioner) for mesh in MESHES for partitioner in PARTITIONERS], ids="-".join)
def case(request, comm):
    """(whole mesh, its sections, the distributed mesh)"""
    name, partitioner = request.param
    slab = MESHES[name](comm)
    section = ((np.arange(len(slab.bars)) + slab.first_bar) % 3).astype(np.int32)
    slab.structured = partitioner == "coordinates"
    mesh = distribute(slab, section, comm)
    yield whole(slab, comm), np.arange(slab.n_bars) % 3, mesh
    mesh.close()


@pytest.mark.parallel
def test_parts_are_balanced(comm, case):
    original, _, mesh = case
    if mesh.partitioner == "coordinates":
        works = 4 + np.bincount(original.bars.ravel(), minlength=original.n_nodes)  # in halves of that of a bar
        mine = works[mesh.node_ids[: mesh.n_owned]].sum()
        assert abs(mine - works.sum() / comm.size) <= works.max()
    else:
        assert mesh.n_owned < 1.3 * original.n_nodes / comm.size + 2


@pytest.mark.parallel
def test_partitioner_is_chosen_by_the_mesh(comm):
    one_rank = "none (one rank)"
    for slab, used in ((cube(comm), "coordinates"), (irregular(comm), "ptscotch")):
        mesh = distribute(slab, np.zeros(len(slab.bars), np.int32), comm)
        assert mesh.partitioner in (used, one_rank, "coordinates")
        assert (mesh.partitioner == one_rank) == (comm.size == 1)


def test_hilbert_curve_visits_neighbour_after_neighbour():
    n = 8
    points = np.indices((n, n, n)).reshape(3, -1).T.astype(float)
    order = np.argsort(hilbert_keys(points, np.zeros(3), float(n - 1)))
    steps = np.abs(np.diff(points[order], axis=0)).sum(axis=1)
    np.testing.assert_array_equal(steps, 1.0)


def test_bars_lie_close_to_each_other_in_memory(comm):
    """A lattice numbered at random is brought back to bars that span little more than a layer of nodes."""
    n = 9
    mesh = lattice.generate(lattice.Parameters(kind="cubic", cells=[n, n, n], pitch=1.0), 0, 1)
    shuffled = np.random.default_rng(1).permutation(mesh.n_nodes)
    points = np.empty_like(mesh.points)
    points[shuffled] = mesh.points
    slab = slab_from(points, shuffled[mesh.bars], comm)
    slab.structured = True
    local = distribute(slab, np.zeros(len(slab.bars), np.int32), comm)
    span = np.abs(np.diff(local.bars[(local.bars < local.n_owned).all(axis=1)], axis=1))
    assert span.max() <= (n + 1) ** 2 + (n + 1)


@pytest.mark.parallel
@pytest.mark.parametrize("structured", [False, True])
def test_ranks_have_equal_work_where_nodes_have_different_numbers_of_bars(comm, structured):
    """A chain joined to a block: as many nodes, far fewer bars."""
    block = whole(
        lattice.generate(lattice.Parameters(kind="octet", cells=[6, 6, 6], pitch=1.0), comm.rank, comm.size), comm
    )
    n = block.n_nodes
    chain = np.column_stack([np.arange(1, n + 1) + block.points[-1, 0], np.full((n, 2), block.points[-1, 1])])
    links = np.column_stack([np.arange(n - 1, 2 * n - 1), np.arange(n, 2 * n)])
    slab = slab_from(np.concatenate([block.points, chain]), np.concatenate([block.bars, links]), comm)
    slab.structured = structured
    mesh = distribute(slab, np.zeros(len(slab.bars), np.int32), comm)
    work = np.array(comm.allgather(len(mesh.bars) + 2 * mesh.n_owned))
    assert work.max() <= 1.25 * work.mean()  # bars between ranks are evaluated on both
    mesh.close()
