"""The search of close segments, against distances of all pairs."""

import numpy as np
import pytest

from pfem_petsc.contact.neighbours import NeighbourSearch, Segments

pytestmark = pytest.mark.parallel


def near(ends, one, two, samples=401):
    """Least distance of many points on segment ``one`` from segment ``two``."""
    t = np.linspace(0.0, 1.0, samples)[:, None]
    a = ends[one, 0] + t * (ends[one, 1] - ends[one, 0])
    way = ends[two, 1] - ends[two, 0]
    s = np.clip(((a - ends[two, 0]) @ way) / max(way @ way, 1e-300), 0.0, 1.0)
    return np.linalg.norm(a - ends[two, 0] - s[:, None] * way, axis=1).min()


@pytest.mark.parametrize("sets", [1, 2])
@pytest.mark.parametrize("flat", [False, True])
def test_pairs_are_those_of_all_segments(comm, sets, flat):
    """Long and short segments and points, with margins and common labels, dealt to the ranks at random."""
    random = np.random.default_rng(2)
    n = 100
    ends = random.random((n, 1, 3)) + np.concatenate([np.zeros((n, 1, 3)), random.normal(size=(n, 1, 3))], axis=1)
    ends[10:30, 1] = ends[10:30, 0] + 0.1 * (ends[10:30, 1] - ends[10:30, 0])
    ends[50:, 1] = ends[50:, 0]  # points
    ends[:, :, 2] *= not flat
    labels, margin = random.integers(0, n, (n, 2)), 0.1 * random.random(n)
    owner = random.integers(0, comm.size, n)

    def own(rows):
        rows = rows[owner[rows] == comm.rank]
        return Segments(rows, labels[rows], ends[rows], margin[rows])

    first = np.arange(n if sets == 1 else n // 2)
    second = np.arange(n // 2, n)
    search = NeighbourSearch(comm, own(first), None if sets == 1 else own(second))
    assert not search.crowded
    found = {}
    for pairs in search.pairs():
        for (a, b), (s, t), distance in zip(pairs.ids.tolist(), pairs.at, pairs.distance, strict=True):
            assert (a, b) not in found
            found[a, b] = distance
            apart = ends[a, 0] + s * (ends[a, 1] - ends[a, 0]) - ends[b, 0] - t * (ends[b, 1] - ends[b, 0])
            assert np.linalg.norm(apart) == pytest.approx(distance, abs=1e-14)
    everywhere = comm.allgather(found)
    every = {pair: distance for some in everywhere for pair, distance in some.items()}
    assert len(every) == sum(map(len, everywhere))  # each is found by one rank
    close = 0
    for a in first.tolist():
        for b in range(a + 1, n) if sets == 1 else second.tolist():
            if set(labels[a]) & set(labels[b]):
                assert (a, b) not in every
                continue
            distance, reach = near(ends, a, b), margin[a] + margin[b]
            if distance < reach:
                assert every[a, b] == pytest.approx(distance, abs=0.01)
                close += 1
            elif (a, b) in every:
                assert every[a, b] <= reach < distance < reach + 0.01
    assert close > 20


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
