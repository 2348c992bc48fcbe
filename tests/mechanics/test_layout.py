"""Runs and groups of bars, and the order that makes runs of them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pfem_petsc.mechanics.chunk_laws import CHUNK
from pfem_petsc.mechanics.layout import (
    group_of,
    make_layout,
    run_column,
)
from pfem_petsc.mesh.ordering import LEAST_RUN, NODE_BLOCK, bar_order


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=60), st.booleans(), st.data())
def test_every_bar_is_in_one_run_of_one_group(ends, drawn_in_order, data):
    bars = np.array(ends, dtype=np.int32).reshape(-1, 2)
    if drawn_in_order:
        bars = bars[bar_order(bars, None, 7)]
    start = data.draw(st.integers(0, len(bars)))
    stop = data.draw(st.integers(start, len(bars)))
    counted = data.draw(st.integers(start, stop))
    check_layout(bars, (start, counted, stop))


def check_layout(bars, block):
    """Each bar is in one column, which joins its ends; values of bars come back from their columns."""
    start, counted, stop = block
    layout = make_layout(bars[:stop], [(0, 0, start), block] if start else [block])
    section = len(layout.counted) - 1
    low, high = bars.min(axis=1), bars.max(axis=1)
    places = np.full(int(layout.starts[-1]), -1)
    for group in range(layout.sections[section], layout.sections[section + 1]):
        g, (first, last) = group_of(layout, section, group, 0), layout.starts[group : group + 2].tolist()
        assert 0 < last - first <= CHUNK
        for run in range(layout.runs[group], layout.runs[group + 1]):
            here = np.arange(layout.bars[run], layout.bars[run + 1])
            assert (here < counted).all() if group < layout.counted[section] else (here >= counted).all()
            column = g.first + run_column(g, run, layout.nodes, layout.bars)
            places[column : column + len(here)] = here
            if layout.stars[group]:
                assert (low[here] == layout.nodes[run]).all()
                np.testing.assert_array_equal(layout.far[here], high[here])
            else:
                inside = np.arange(column, column + len(here)) - first
                np.testing.assert_array_equal(low[here], layout.heads[group] + inside)
                np.testing.assert_array_equal(high[here], layout.fars[group] + inside)
    columns = layout.columns(section)
    np.testing.assert_array_equal(places[columns][places[columns] >= 0], np.arange(start, stop))
    np.testing.assert_array_equal(places[layout.column_of[start:stop]], np.arange(start, stop))


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
    layout = make_layout(mixed, [(0, len(mixed), len(mixed))])
    assert not layout.stars.any()
    assert len(mixed) > 8 * len(layout.nodes)
    numbers = random.permutation(nodes).astype(np.int32)
    scattered = numbers[bars]
    scattered = scattered[bar_order(scattered, None, nodes)]
    layout = make_layout(scattered, [(0, len(scattered), len(scattered))])
    assert layout.stars.all()
    low = scattered.min(axis=1)
    assert (np.diff(low) >= 0).all()
    assert len(layout.nodes) <= len(np.unique(low)) + len(layout.heads)


def test_groups_are_of_blocks_of_nodes():
    bars = lattice(12)
    bars = bars[bar_order(bars, None, int(bars.max()) + 1)]
    layout = make_layout(bars, [(0, len(bars), len(bars))])
    low = bars.min(axis=1)
    for group in range(len(layout.heads)):
        first, last = (int(layout.bars[layout.runs[group + k]]) for k in (0, 1))
        assert len(np.unique(low[first:last] // NODE_BLOCK)) == 1
    assert layout.starts[-1] < 1.3 * len(bars) and not layout.stars.any() and LEAST_RUN > 1
