"""The order of loops over bars: runs of bars with the same head node, gathered into chunks.

The force on the head node of a run is summed in registers. Square roots and divisions are evaluated for a whole chunk
by vector instructions, between gathering the end differences and scattering the forces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .compiled import kernel

__all__ = ["CHUNK", "Sweep", "make_sweep"]

CHUNK = 256
"""Maximum number of bars of a chunk, whose working arrays then fit into the fastest cache."""


class Sweep(NamedTuple):
    """Runs and chunks of the bars [start, stop) of a block. Indices are unsigned, so compiled loops need not handle
    negative ones.

    Attributes
    ----------
    heads : (runs,) uint32, head node of each run
    starts : (runs + 1,) uint32, first bar of each run, and the end
    chunks : (chunks + 1,) uint32, first run of each chunk, and the end
    counted : number of leading chunks whose bars are counted on this rank
    """

    heads: np.ndarray
    starts: np.ndarray
    chunks: np.ndarray
    counted: int


def make_sweep(bars: np.ndarray, start: int, counted: int, stop: int, chunk: int = CHUNK) -> Sweep:
    """Make the sweep over ``bars`` (b, 2) [start, stop), of which [start, counted) are counted, by their smaller ends.

    Runs end where this node changes, at ``counted``, and after ``chunk`` bars.
    """
    none = np.empty(0, dtype=np.uint32)
    runs, chunks, counted_chunks = _cut(bars, start, counted, stop, chunk, none, none, none)
    heads, starts, firsts = (np.empty(n, dtype=np.uint32) for n in (runs, runs + 1, chunks + 1))
    _cut(bars, start, counted, stop, chunk, heads, starts, firsts)
    starts[runs], firsts[chunks] = stop, runs
    return Sweep(heads, starts, firsts, counted_chunks)


@kernel
def _cut(bars, start, counted, stop, chunk, heads, starts, chunks):
    """Return the numbers of runs, chunks and counted chunks; fill the arrays unless they are empty."""
    fill = len(heads) > 0
    n_runs = 0
    n_chunks = 0
    counted_chunks = 0
    chunk_start = start
    k = start
    while k < stop:
        if k == counted:
            counted_chunks = n_chunks
        node = min(bars[k, 0], bars[k, 1])
        limit = min(stop, k + chunk)
        if k < counted:
            limit = min(limit, counted)
        end = k + 1
        while end < limit and min(bars[end, 0], bars[end, 1]) == node:
            end += 1
        if n_chunks == 0 or k == counted or end - chunk_start > chunk:
            if fill:
                chunks[n_chunks] = n_runs
            n_chunks += 1
            chunk_start = k
        if fill:
            heads[n_runs] = node
            starts[n_runs] = k
        n_runs += 1
        k = end
    if counted == stop:
        counted_chunks = n_chunks
    return n_runs, n_chunks, counted_chunks
