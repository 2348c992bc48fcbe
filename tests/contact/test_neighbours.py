"""The search of close segments; against distances of all pairs in test_crossing.py and test_overlaps.py."""

import numpy as np
import pytest

from pfem_petsc.contact.neighbours import NeighbourSearch, Segments

pytestmark = pytest.mark.parallel


def test_segments_in_one_place_are_too_many(comm):
    rows = np.arange(comm.rank, 5000, comm.size)
    ends = np.zeros((len(rows), 2, 3))
    ends[:, 1, 0] = 1.0
    crowd = Segments(rows, np.stack([rows, rows], axis=1), ends, np.full(len(rows), 0.1))
    assert NeighbourSearch(comm, crowd).crowded


def test_ranks_without_segments(comm):
    none = Segments(np.empty(0, np.int64), np.empty((0, 2), np.int64), np.empty((0, 2, 3)), np.empty(0))
    assert list(NeighbourSearch(comm, none).pairs()) == []
    one = Segments(np.arange(2), np.array([[0, 1], [2, 3]]), np.eye(3)[[[0, 1], [1, 2]]], np.ones(2))
    search = NeighbourSearch(comm, one if comm.rank == 0 else none)
    assert sum(comm.allgather(sum(len(pairs.ids) for pairs in search.pairs()))) == 1
