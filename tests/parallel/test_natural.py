"""Transfers between owned rows and slabs: every value arrives unchanged, for any type, shape and ownership."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc.parallel.natural import NaturalOrder

pytestmark = pytest.mark.parallel
COMM = MPI.COMM_WORLD


def owned_ids(n, kind):
    """Mesh numbers owned by this rank: shuffled over all ranks, in order, or all on the last rank."""
    if kind == "in order":
        return np.array_split(np.arange(n), COMM.size)[COMM.rank]
    if kind == "last rank":
        return np.arange(n)[::-1] if COMM.rank == COMM.size - 1 else np.empty(0, dtype=np.int64)
    shuffled = np.random.default_rng(n).permutation(n)
    owner = np.random.default_rng(n + 1).integers(COMM.size, size=n)
    return shuffled[owner == COMM.rank]


@pytest.mark.parametrize("kind", ["shuffled", "in order", "last rank"])
@pytest.mark.parametrize("n", [0, 1, 2, 5, 1000])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64, np.int32, np.uint8])
@pytest.mark.parametrize("row_shape", [(), (3,), (2, 3)])
def test_slab_holds_the_rows_in_mesh_order_and_back(kind, n, dtype, row_shape):
    ids = owned_ids(n, kind)
    order = NaturalOrder(COMM, ids, n)
    everything = np.random.default_rng(7).integers(0, 250, size=(n, *row_shape)).astype(dtype)
    slab = order.to_slab(everything[ids])
    assert slab.dtype == dtype
    np.testing.assert_array_equal(slab, everything[order.first : order.first + order.count])
    np.testing.assert_array_equal(np.concatenate(COMM.allgather(slab)), everything)
    np.testing.assert_array_equal(order.from_slab(slab), everything[ids])


def test_slabs_are_the_split_of_petsc():
    from petsc4py import PETSc

    for n in (0, 1, 2, 3, 10, 11):
        order = NaturalOrder(COMM, owned_ids(n, "shuffled"), n)
        vector = PETSc.Vec().createMPI(n, comm=COMM)
        assert (order.first, order.first + order.count) == vector.getOwnershipRange()
        vector.destroy()


def test_strided_arrays_and_nan_pass_unchanged():
    n = 12
    ids = owned_ids(n, "shuffled")
    order = NaturalOrder(COMM, ids, n)
    wide = np.full((n, 6), np.nan)
    wide[:, ::2] = np.arange(3 * n).reshape(n, 3)
    np.testing.assert_array_equal(order.to_slab(wide[ids][:, ::2]), wide[order.first : order.first + order.count, ::2])


@pytest.mark.parametrize("wrong", [[0, 0], [0, 2], [-1, 0]])
def test_numbers_not_owned_exactly_once_are_refused_on_all_ranks(wrong):
    ids = np.array(wrong) if COMM.rank == 0 else np.empty(0, dtype=np.int64)
    with pytest.raises(ValueError, match="mesh numbers"):
        NaturalOrder(COMM, ids, 2)


def test_wrong_length_is_refused():
    order = NaturalOrder(COMM, owned_ids(9, "shuffled"), 9)
    with pytest.raises(ValueError, match="rows"):
        order.to_slab(np.zeros(order.n_owned + 1))
