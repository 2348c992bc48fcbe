"""The order of loops over bars: runs of bars whose ends are known from the first one, gathered into chunks.

In a *diagonal* run both ends advance by one node from bar to bar, as in lattices and in all meshes with constant
offsets between the numbers of neighbours: their loops load and store consecutive numbers. In a *star* all bars have the
same lower end, whose force is summed in registers. Square roots and divisions are evaluated for a whole chunk by vector
instructions, between the end differences and the sums of forces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..mesh.ordering import FEW, LEAST_RUN, NODE_BLOCK
from .compiled import kernel
from .rows import CHUNK

__all__ = ["Sweep", "make_sweep"]


class Sweep(NamedTuple):
    """Runs and chunks of the bars [start, stop) of a block. Indices are unsigned, so compiled loops need not handle
    negative ones.

    Attributes
    ----------
    heads : (runs,) uint32, lower end of the first bar of each run
    fars : (runs,) uint32, its upper end
    starts : (runs + 1,) uint32, first bar of each run, and the end
    chunks : (chunks + 1,) uint32, first run of each chunk, and the end
    diagonal : (chunks,) bool, whether the runs of a chunk are diagonal, else stars
    counted : number of leading chunks whose bars are counted on this rank
    parts : (parts + 1,) int64, first chunk of each part, and the end: the counted bars by their lower ends, part k with
        those of the nodes [k, k + 1) times :data:`~pfem_petsc.mesh.ordering.NODE_BLOCK`
    """

    heads: np.ndarray
    fars: np.ndarray
    starts: np.ndarray
    chunks: np.ndarray
    diagonal: np.ndarray
    counted: int
    parts: np.ndarray


def make_sweep(bars: np.ndarray, start: int, counted: int, stop: int, chunk: int = CHUNK) -> Sweep:
    """Make the sweep over ``bars`` (b, 2) [start, stop), of which [start, counted) are counted.

    Chunks end after ``chunk`` bars, at ``counted``, and where the lower end passes to another block of nodes.
    """
    firsts = np.empty(_cut(bars, start, counted, stop, chunk, np.empty(0, dtype=np.uint32)) + 1, dtype=np.uint32)
    _cut(bars, start, counted, stop, chunk, firsts)
    firsts[-1] = stop
    diagonal = np.empty(len(firsts) - 1, dtype=np.bool_)
    chunks = np.empty(len(firsts), dtype=np.uint32)
    none = np.empty(0, dtype=np.uint32)
    runs = _find_runs(bars, firsts, False, diagonal, chunks, none, none, none)
    short = np.diff(firsts.astype(np.int64))[~diagonal].sum()
    forced = bool(0 < short <= FEW * (stop - start))
    if forced:  # few bars: the others have faster loops if all chunks are alike
        diagonal[:] = True
        runs = _find_runs(bars, firsts, True, diagonal, chunks, none, none, none)
    heads, fars, starts = (np.empty(n, dtype=np.uint32) for n in (runs, runs, runs + 1))
    _find_runs(bars, firsts, forced, diagonal, chunks, heads, fars, starts)
    starts[runs] = stop
    chunks_counted = int(np.searchsorted(firsts[:-1], counted))
    lower = bars[firsts[:chunks_counted]].min(axis=1) // NODE_BLOCK
    parts = np.searchsorted(lower, np.arange((int(lower[-1]) if len(lower) else -1) + 2))
    return Sweep(heads, fars, starts, chunks, diagonal, chunks_counted, parts.astype(np.int64))


@kernel
def _cut(bars, start, counted, stop, chunk, firsts):
    """Return the number of chunks; write their first bars unless ``firsts`` is empty."""
    count = 0
    first = start
    block = -1
    for k in range(start, stop):
        here = min(bars[k, 0], bars[k, 1]) // NODE_BLOCK
        if k in (start, counted) or here != block or k - first == chunk:
            if len(firsts) > 0:
                firsts[count] = k
            count += 1
            first = k
            block = here
    return count


@kernel
def _find_runs(bars, firsts, forced, diagonal, chunks, heads, fars, starts):
    """Return the number of runs; write chunks, the first run of each, and the runs unless ``heads`` is empty, and which
    chunks are ``diagonal``, unless ``forced``."""
    count = 0
    for c in range(len(firsts) - 1):
        chunks[c] = count
        breaks = 1
        for k in range(firsts[c] + 1, firsts[c + 1]):
            breaks += 0 if _follows(bars, k) else 1
        if not forced:
            diagonal[c] = firsts[c + 1] - firsts[c] >= LEAST_RUN * breaks
        for k in range(firsts[c], firsts[c + 1]):
            low = min(bars[k, 0], bars[k, 1])
            if k > firsts[c]:
                if diagonal[c]:
                    if _follows(bars, k):
                        continue
                elif low == min(bars[k - 1, 0], bars[k - 1, 1]):
                    continue
            if len(heads) > 0:
                heads[count] = low
                fars[count] = max(bars[k, 0], bars[k, 1])
                starts[count] = k
            count += 1
    chunks[len(firsts) - 1] = count
    return count


@kernel
def _follows(bars, k):
    """Whether both ends of bar k are the nodes after those of bar k - 1."""
    low = min(bars[k, 0], bars[k, 1]) == min(bars[k - 1, 0], bars[k - 1, 1]) + 1
    return low and max(bars[k, 0], bars[k, 1]) == max(bars[k - 1, 0], bars[k - 1, 1]) + 1
