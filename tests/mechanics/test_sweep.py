"""Runs and chunks of bars."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pfem_petsc.mechanics.sweep import make_sweep


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=60), st.data())
def test_every_bar_is_in_one_run_of_one_chunk(ends, data):
    bars = np.array(ends, dtype=np.int32).reshape(-1, 2)
    start = data.draw(st.integers(0, len(bars)))
    stop = data.draw(st.integers(start, len(bars)))
    counted = data.draw(st.integers(start, stop))
    chunk = data.draw(st.integers(1, 9))
    heads, starts, chunks, counted_chunks = make_sweep(bars, start, counted, stop, chunk)
    assert len(starts) == len(heads) + 1 and starts[-1] == stop
    assert chunks[0] == 0 and chunks[-1] == len(heads)
    assert len(heads) == 0 or starts[0] == start
    for run, head in enumerate(heads):
        assert starts[run + 1] > starts[run]
        assert (bars[starts[run] : starts[run + 1]].min(axis=1) == head).all()
    for number in range(len(chunks) - 1):
        first, last = int(starts[chunks[number]]), int(starts[chunks[number + 1]])
        assert 0 < last - first <= chunk
        assert last <= counted if number < counted_chunks else first >= counted
