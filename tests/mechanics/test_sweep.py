"""Runs and chunks of bars, and the order that makes runs of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pfem_petsc.mechanics.runs import make_sweep
from pfem_petsc.mesh.ordering import LEAST_RUN, NODE_BLOCK, bar_order


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=60), st.booleans(), st.data())
def test_every_bar_is_in_one_run_of_one_chunk(ends, drawn_in_order, data):
    bars = np.array(ends, dtype=np.int32).reshape(-1, 2)
    if drawn_in_order:
        bars = bars[bar_order(bars, None, 7)]
    start = data.draw(st.integers(0, len(bars)))
    stop = data.draw(st.integers(start, len(bars)))
    counted = data.draw(st.integers(start, stop))
    chunk = data.draw(st.integers(1, 9))
    sweep = make_sweep(bars, start, counted, stop, chunk)
    starts, chunks = sweep.starts, sweep.chunks
    low, high = bars.min(axis=1), bars.max(axis=1)
    assert len(starts) == len(sweep.heads) + 1 and starts[-1] == stop
    assert chunks[0] == 0 and chunks[-1] == len(sweep.heads)
    assert len(sweep.heads) == 0 or starts[0] == start
    for number in range(len(chunks) - 1):
        first, last = int(starts[chunks[number]]), int(starts[chunks[number + 1]])
        assert 0 < last - first <= chunk
        assert last <= counted if number < sweep.counted else first >= counted
        for run in range(chunks[number], chunks[number + 1]):
            bar = np.arange(starts[run], starts[run + 1])
            assert len(bar)
            step = bar - bar[0] if sweep.diagonal[number] else 0
            np.testing.assert_array_equal(low[bar], sweep.heads[run] + step)
            if sweep.diagonal[number]:
                np.testing.assert_array_equal(high[bar], sweep.fars[run] + step)
    assert sweep.parts[0] == 0 and sweep.parts[-1] == sweep.counted or not sweep.counted


def lattice(n):
    """Ends of the edges and diagonals of n^3 cubes, by node numbers."""
    number = np.arange((n + 1) ** 3).reshape(3 * (n + 1,))
    inner = slice(0, n), slice(1, n + 1)
    low, high = inner
    every = slice(None)
    pairs = [((low, every, every), (high, every, every)), ((every, low, every), (every, high, every))]
    pairs += [((every, every, low), (every, every, high)), ((low, low, every), (high, high, every))]
    pairs += [((high, low, every), (low, high, every)), ((every, low, low), (every, high, high))]
    return np.concatenate([np.column_stack([number[a].ravel(), number[b].ravel()]) for a, b in pairs]).astype(np.int32)


def test_a_lattice_goes_by_diagonals_and_chance_by_stars():
    bars, random = lattice(12), np.random.default_rng(3)
    nodes = int(bars.max()) + 1
    mixed = bars[random.permutation(len(bars))]
    mixed = mixed[bar_order(mixed, None, nodes)]
    sweep = make_sweep(mixed, 0, len(mixed), len(mixed))
    assert sweep.diagonal.all()
    assert len(mixed) > 8 * len(sweep.heads)
    numbers = random.permutation(nodes).astype(np.int32)
    scattered = numbers[bars]
    scattered = scattered[bar_order(scattered, None, nodes)]
    sweep = make_sweep(scattered, 0, len(scattered), len(scattered))
    assert not sweep.diagonal.any()
    low = scattered.min(axis=1)
    assert (np.diff(low) >= 0).all()
    assert len(sweep.heads) <= len(np.unique(low)) + len(sweep.diagonal)


@pytest.mark.parametrize("chunk", [5, 512])
def test_parts_are_blocks_of_nodes(chunk):
    bars = lattice(12)
    bars = bars[bar_order(bars, None, int(bars.max()) + 1)]
    sweep = make_sweep(bars, 0, len(bars), len(bars), chunk)
    blocks = bars.min(axis=1) // NODE_BLOCK
    for part in range(len(sweep.parts) - 1):
        first, last = (int(sweep.starts[sweep.chunks[sweep.parts[part + k]]]) for k in (0, 1))
        assert (blocks[first:last] == part).all()
    assert last == len(bars) and LEAST_RUN > 1
