"""The search of close segments, against distances of all pairs; those of bars and nodes are in other files."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc.contact.neighbours import (
    Points,
    Segments,
    find_pairs,
    largest_change,
    segment_distance,
)


def segments(ends, ids, margin):
    """Segments without common ends."""
    ends = np.asarray(ends, float).reshape(-1, 3)
    at = np.arange(len(ends), dtype=np.int32).reshape(-1, 2)
    names = 2 * np.repeat(ids, 2) + np.tile([0, 1], len(ids))
    return Points(ends, names), Segments(np.asarray(ids), at, np.full(len(ids), margin))


def test_segments_in_one_place_are_too_many(comm):
    rows = np.arange(comm.rank, 5000, comm.size)
    ends = np.zeros((len(rows), 2, 3))
    ends[:, 1, 0] = 1.0
    assert find_pairs(comm, *segments(ends, rows, 0.1)) is None


@pytest.mark.parallel
def test_ranks_without_segments(comm):
    none = segments(np.empty((0, 2, 3)), np.empty(0, np.int64), 1.0)
    found = find_pairs(comm, *none, skin=0.1)
    assert len(found.ids) == 0
    assert found.gap == np.inf
    one = segments(np.eye(3)[[[0, 1], [1, 2]]], np.arange(2), 1.0)
    found = find_pairs(comm, *(one if comm.rank == 0 else none))
    assert sum(comm.allgather(len(found.ids))) == 1


@pytest.mark.parallel
@pytest.mark.parametrize(
    ("spread", "flat", "thick"),
    [(1.0, 1.0, 1.0), (40.0, 1.0, 1.0), (1.0, 0.0, 1.0), (3.0, 1.0, 30.0), (1e6, 1e-3, 1.0)],
)
def test_pairs_and_gaps_are_those_of_all_pairs(comm, spread, flat, thick):
    """Among segments of lengths, margins and directions of all kinds: some parallel, some points, some far away."""
    random, n, margin, skin = np.random.default_rng(7), 700, 0.012, 0.1
    ways = random.normal(size=(n, 3)) * [1.0, 1.0, flat]
    ways[::3] = np.eye(3)[random.integers(0, 3, n)][::3] * [1.0, 1.0, flat]
    ways *= 0.2 * np.where(random.random(n) < 0.05, spread, 1.0)[:, None]
    ways[::50] = 0.0
    first = random.random((n, 3)) * [1.0, 1.0, flat]
    first[::90] *= spread
    ends = np.stack([first, first + ways], axis=1)
    margins = np.where(random.random(n) < 0.02, thick, 1.0) * margin
    rows = np.arange(comm.rank, n, comm.size)
    points, own = segments(ends[rows], rows, 0.0)
    found = find_pairs(comm, points, own._replace(margin=margins[rows]), skin)
    i, j = np.triu_indices(n, 1)
    beyond = distances(ends[i], ends[j]) - margins[i] - margins[j]
    lengths = np.linalg.norm(ways, axis=1)
    skin *= (lengths + 2.0 * margins).sum() / np.count_nonzero(lengths)
    expected = {(a, b) for a, b in zip(i[beyond < 0.0].tolist(), j[beyond < 0.0].tolist())}
    every = [tuple(pair) for pairs in comm.allgather(found.ids.tolist()) for pair in pairs]
    assert len(expected) > 20
    assert len(every) == len(expected)  # each is found once
    assert set(every) == expected
    assert found.gap == pytest.approx(min(np.abs(beyond).min(), skin), rel=1e-6, abs=1e-12)


def distances(one, two):
    """Distances of segments (m, 2, 3): the least of those at 4 x 4 combinations of ends and feet, refined by turns."""
    p, u, q, v = one[:, 0], one[:, 1] - one[:, 0], two[:, 0], two[:, 1] - two[:, 0]
    least = np.full(len(p), np.inf)
    uu, vv, uv = ((a * b).sum(axis=1) for a, b in ((u, u), (v, v), (u, v)))
    w = p - q
    with np.errstate(all="ignore"):
        inner = (uv * (v * w).sum(axis=1) - vv * (u * w).sum(axis=1)) / (uu * vv - uv * uv)
        for s in (0.0, 1.0, np.clip(np.nan_to_num(inner), 0.0, 1.0)):
            s = np.broadcast_to(s, least.shape)
            for _ in range(2):  # the foot on one of a point of the other, and back
                t = np.clip(np.nan_to_num(((p + s[:, None] * u - q) * v).sum(axis=1) / vv), 0.0, 1.0)
                apart = np.linalg.norm(p + s[:, None] * u - q - t[:, None] * v, axis=1)
                least = np.minimum(least, apart)
                s = np.clip(np.nan_to_num(((q + t[:, None] * v - p) * u).sum(axis=1) / uu), 0.0, 1.0)
                least = np.minimum(least, np.linalg.norm(p + s[:, None] * u - q - t[:, None] * v, axis=1))
    return least


def test_changes_of_distances_are_bounded():
    """No distance up to a reach changes by more than the bound, and none from beyond falls below it by more."""
    random, comm, reach = np.random.default_rng(12), MPI.COMM_SELF, 0.6
    for size, wide, amplitude in ((6.0, 6.0, 0.3), (20.0, 20.0, 4.0), (200.0, 3.0, 1.0)):
        start = random.uniform(0.0, [size, wide, wide], (60, 3))
        ends = np.column_stack([start, start + random.normal(size=(60, 3)) / 3.0]).reshape(-1, 3)
        spin = np.linalg.qr(np.eye(3) + 0.3 * random.normal(size=(3, 3)))[0]
        now = ends @ (spin * np.linalg.det(spin)) * 1.01
        now += amplitude * np.sin(5.0 * ends[:, [1, 2, 0]] / size) + 0.01 * random.normal(size=ends.shape) + 5.0
        change = largest_change(comm, (ends, now), len(ends), reach)
        before, after = (
            np.array([segment_distance(x, pairs, 2 * i, 2 * i + 1)[0] for i in range(len(pairs) // 2)])
            for pairs in [every_pair(len(start))]
            for x in (ends, now)
        )
        close = before <= reach
        assert np.abs(after - before)[close].max(initial=0.0) <= change
        assert after[~close].min() >= reach - change


def every_pair(n):
    """Segments (n (n - 1), 2) of all pairs of n, one after the other."""
    first, second = np.triu_indices(n, 1)
    both = np.column_stack([first, second]).reshape(-1)
    return np.column_stack([2 * both, 2 * both + 1])
