"""Checksums by compiled loops, and from rows as vectors, are those of their definitions in NumPy."""

import numpy as np
import pytest

from pfem_petsc.columns import Layout
from pfem_petsc.output.integrity import COMPILED, RowDigests, word_sum


@pytest.mark.parametrize("dtype", ["float64", "float32", "int8"])
def test_sums_are_those_of_their_parts(dtype):
    """The whole by a compiled loop, its parts by NumPy."""
    values = np.random.default_rng(1).integers(-100, 100, (COMPILED, 3)).astype(dtype)
    part = COMPILED // 4
    parts = sum(word_sum(values[first : first + part], 7 + first) for first in range(0, COMPILED, part))
    assert word_sum(values, 7) == parts % 2**64
    assert word_sum(values[::-1], 7) != parts % 2**64


def test_rows_as_vectors_have_the_checksums_of_their_columns():
    rng = np.random.default_rng(2)
    columns = {"time": rng.random(5), "step": rng.integers(0, 9, 5), "word": rng.integers(0, 3, 5).astype(np.uint8)}
    columns["force"] = -rng.random((5, 3))
    digests = RowDigests(Layout({name: np.dtype((values.dtype, values.shape[1:])) for name, values in columns.items()}))
    vectors = np.column_stack([values.reshape(5, -1).astype(float) for values in columns.values()])
    assert np.array_equal(digests.of_vectors(vectors, 11), digests.of_columns(columns, 11))
