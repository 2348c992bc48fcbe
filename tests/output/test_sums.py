"""Checksums by compiled loops, and from rows as vectors, are those of their definitions in NumPy."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc.columns import Layout
from pfem_petsc.output import integrity
from pfem_petsc.output.integrity import RowDigests, word_sum
from pfem_petsc.output.vtkhdf import _permuted
from pfem_petsc.parallel.natural import NaturalOrder


@pytest.mark.parametrize("dtype", ["float64", "float32", "int8"])
def test_compiled_sums_are_those_of_numpy(dtype, monkeypatch):
    values = np.random.default_rng(1).integers(-100, 100, (integrity.COMPILED, 3)).astype(dtype)
    compiled = word_sum(values, 7)
    monkeypatch.setattr(integrity, "COMPILED", 1 << 62)
    assert word_sum(values, 7) == compiled
    assert word_sum(values[::-1], 7) != compiled


def test_rows_as_vectors_have_the_checksums_of_their_columns():
    rng = np.random.default_rng(2)
    columns = {"time": rng.random(5), "step": rng.integers(0, 9, 5), "word": rng.integers(0, 3, 5).astype(np.uint8)}
    columns["force"] = -rng.random((5, 3))
    digests = RowDigests(Layout({name: np.dtype((values.dtype, values.shape[1:])) for name, values in columns.items()}))
    vectors = np.column_stack([values.reshape(5, -1).astype(float) for values in columns.values()])
    assert np.array_equal(digests.of_vectors(vectors, 11), digests.of_columns(columns, 11))


@pytest.mark.parametrize(("shape", "dtype"), [((3,), "float64"), ((), "float64"), ((), "int8")])
def test_compiled_permutation_is_that_of_the_order(shape, dtype):
    rng = np.random.default_rng(3)
    order = NaturalOrder(MPI.COMM_SELF, rng.permutation(50), 50)
    array = rng.integers(-100, 100, (50, *shape)).astype(dtype)
    assert order.permutes
    assert np.array_equal(_permuted(order, array), order.to_slab(array))
