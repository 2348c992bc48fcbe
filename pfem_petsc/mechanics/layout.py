"""The order in which loops over bars find them: runs of bars whose ends are known from the first one, padded to long
rows for loops over components of positions and forces, and stars of bars with a common node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mesh.ordering import LEAST_RUN, NODE_BLOCK
from .chunk_laws import CHUNK
from .compiled import inlined, kernel, record

if TYPE_CHECKING:
    from collections.abc import Sequence

LANES = 8  # numbers in a line of the cache, and of a vector


PAGE = 512
"""Numbers in a page of memory. Loads wait for earlier stores to other arrays whose addresses end with the bits of a
place in a page. What loops over bars read and write at the same time therefore begins at different places of a page."""

PLACES, DIFFERENCES, FORCES, LAWS = 0, 168, 336, 384


def aligned(count: int, place: int = 0) -> np.ndarray:
    """Return ``count`` zeros that begin at a place in a page, which is a multiple of a line of the cache."""
    room = np.zeros(count + PAGE)
    first = (place - room.ctypes.data // room.itemsize) % PAGE
    return room[first : first + count]


def new_components(nodes: int, place: int = PLACES) -> np.ndarray:
    """Return zeros (3, stride) for vectors of nodes by components, and for columns without a bar beyond them."""
    stride = -(-(nodes + 2 * LANES) // PAGE) * PAGE + 5 * LANES  # each row begins at another place of a page
    return aligned(3 * stride, place).reshape(3, stride)


@kernel
def split_components(x, out):
    """Write vectors (n, 3) to components (3, stride)."""
    nodes, xs, ys, zs = x.reshape(-1), out[0], out[1], out[2]
    for i in range(len(x)):
        xs[i] = nodes[3 * i]
        ys[i] = nodes[3 * i + 1]
        zs[i] = nodes[3 * i + 2]


@kernel
def clear(components):
    """Set components (3, stride) to zero."""
    flat = components.reshape(-1)
    for i in range(len(flat)):
        flat[i] = 0.0


@kernel
def join_components(components, out):
    """Write components (3, stride) to vectors (n, 3)."""
    nodes, xs, ys, zs = out.reshape(-1), components[0], components[1], components[2]
    for i in range(len(out)):
        nodes[3 * i] = xs[i]
        nodes[3 * i + 1] = ys[i]
        nodes[3 * i + 2] = zs[i]


NO_BAR = -1.0
"""Rest length of a column without a bar [m]."""

_NONE = np.empty(0, dtype=np.int64)
_MOST = 1.25  # columns for each bar; beyond, they cost more than the begin and end of each run


@record
class BarLayout(NamedTuple):
    """The bars of a rank as compiled loops find them, by sections, groups and runs.

    A group has up to CHUNK columns. In a group of runs, column i joins the nodes ``heads + i`` and ``fars + i``, and
    some columns may have no bar; in a group of stars, each run consists of bars with the same lower node, and there
    are no other columns. Bars of a section, in their order in memory, are in ascending columns.

    Attributes
    ----------
    sections : (s + 1,) first group of each section, and the end
    counted : (s,) end of the groups of each section whose bars are counted on this rank; others follow
    stars : (groups,) bool
    heads, fars : (groups,) ends of the first column of a group of runs
    starts : (groups + 1,) first column of each group, and the end
    runs : (groups + 1,) first run of each group, and the end
    nodes : (runs,) uint32, lower end of the first bar of each run
    bars : (runs + 1,) uint32, first bar of each run, and the end
    far : (b,) uint32, upper end of each bar, or (0,) without stars
    column_of : (b,) uint32, column of each bar
    """

    sections: np.ndarray
    counted: np.ndarray
    stars: np.ndarray
    heads: np.ndarray
    fars: np.ndarray
    starts: np.ndarray
    runs: np.ndarray
    nodes: np.ndarray
    bars: np.ndarray
    far: np.ndarray
    column_of: np.ndarray

    def columns(self, section: int) -> slice:
        """Return the columns of a section."""
        first, last = self.starts[self.sections[section : section + 2]].tolist()
        return slice(first, last)


def make_layout(bars: np.ndarray, blocks: Sequence[tuple[int, int, int]]) -> BarLayout:
    """Make the layout of ``bars`` (b, 2) of sections [start, stop) that follow each other, of which [start, counted)
    are counted; ``blocks``: (start, counted, stop) of each section."""
    found = [_make_groups(bars, *block) for block in blocks]
    counts = np.array([[len(part.runs) - 1, part.starts[-1], len(part.nodes)] for part in found]).reshape(-1, 3)
    sections, columns, runs = np.pad(np.cumsum(counts, axis=0), ((1, 0), (0, 0))).T

    def joined(arrays: list[np.ndarray], kind: type, *end: int) -> np.ndarray:
        return np.concatenate([*arrays, end]).astype(kind)

    stars = joined([part.stars for part in found], np.bool_)
    far = np.empty(len(bars) if stars.any() else 0, dtype=np.uint32)
    np.maximum(bars[: len(far), 0], bars[: len(far), 1], out=far, casting="unsafe")
    made = BarLayout(
        sections.astype(np.int64),
        np.array([part.counted + first for part, first in zip(found, sections, strict=False)], dtype=np.int64),
        stars,
        joined([part.heads for part in found], np.int64),
        joined([part.fars for part in found], np.int64),
        joined([part.starts[:-1] + at for part, at in zip(found, columns, strict=False)], np.int64, columns[-1]),
        joined([part.runs[:-1] + at for part, at in zip(found, runs, strict=False)], np.int64, runs[-1]),
        joined([part.nodes for part in found], np.uint32),
        joined([part.bars for part in found], np.uint32, blocks[-1][2] if len(blocks) else 0),
        far,
        _NONE,
    )
    group, begin = np.repeat(np.arange(len(stars)), np.diff(made.runs)), made.bars.astype(np.int64)
    ahead = np.where(stars[group], begin[:-1] - begin[made.runs[group]], made.nodes - made.heads[group])
    lead = made.starts[group] + ahead - begin[:-1]
    return made._replace(column_of=(np.repeat(lead, np.diff(begin)) + np.arange(begin[-1])).astype(np.uint32))


def _make_groups(bars: np.ndarray, start: int, counted: int, stop: int) -> BarLayout:
    """Return the layout of one section, without ``sections``, ``far`` and ``column_of``, and with the first of ``bars``
    of each run.

    Its bars are divided where CHUNK are reached, where the lower end passes to another block of nodes, and at
    ``counted``, into chunks of diagonal runs, whose ends are the nodes after those of the bar before, or of stars. A
    group is a chunk of stars, or consists of diagonal runs of one offset and one block of nodes.
    """
    low, high = np.sort(bars[start:stop], axis=1).T.astype(np.int64)
    begins = np.ones(stop - start, dtype=np.bool_)
    begins[1:] = np.diff(low // NODE_BLOCK) != 0
    begins[counted - start :][:1] = True
    at = np.flatnonzero(begins)
    since = np.arange(stop - start) - np.repeat(at, np.diff(at, append=stop - start))
    at = np.flatnonzero(since % CHUNK == 0)
    follows, alike = np.zeros((2, stop - start), dtype=np.bool_)
    follows[1:] = (np.diff(low) == 1) & (np.diff(high) == 1)
    alike[1:] = np.diff(low) == 0
    follows[at] = alike[at] = False
    sizes = np.diff(at, append=stop - start)
    diagonal = sizes >= LEAST_RUN * np.add.reduceat(~follows, at, dtype=np.int64) if len(at) else sizes > 0
    every = np.repeat(diagonal, sizes)
    first_bars = np.flatnonzero(~np.where(every, follows, alike))
    nodes, ends, star = low[first_bars], high[first_bars], ~every[first_bars]
    begins = np.ones(len(at), dtype=np.bool_)  # chunks that begin a group in any case
    begins[1:] = ~diagonal[1:] | ~diagonal[:-1] | (np.diff(low[at] // NODE_BLOCK) != 0)
    begins |= at == counted - start
    fresh = np.isin(first_bars, at[begins])
    limits = np.append(first_bars, stop - start)
    group_of_run = np.empty(len(nodes), dtype=np.int64)
    count = _group_runs(nodes, ends, limits, fresh, star, group_of_run)
    runs = np.searchsorted(group_of_run, np.arange(count + 1))
    stars, first, last = star[runs[:-1]], runs[:-1], runs[1:] - 1
    lead = nodes[first] % LANES
    wide = nodes[last] + limits[last + 1] - limits[last] - (nodes[first] - lead)
    sizes = np.where(stars, limits[last + 1] - limits[first], -(-wide // LANES) * LANES)
    heads, fars = (np.where(stars, 0, each[first] - lead) for each in (nodes, ends))
    before = np.searchsorted(runs, np.searchsorted(first_bars, counted - start))
    columns = np.append(0, np.cumsum(sizes))
    return BarLayout(_NONE, before, stars, heads, fars, columns, runs, nodes, first_bars + start, _NONE, _NONE)


@kernel
def _group_runs(heads, fars, starts, fresh, star, group_of):
    """Return the number of groups of runs; write the group of each run."""
    groups = 0
    first = 0  # run that begins the group
    bars = 0
    for run in range(len(heads)):
        count, head = starts[run + 1] - starts[run], heads[run]
        alike = run > 0 and not fresh[run]
        if alike and not star[run]:
            alike = fars[run] - head == fars[run - 1] - heads[run - 1] and head > heads[run - 1]
            span = head + count - heads[first] // LANES * LANES
            alike = alike and span <= CHUNK and span <= _MOST * (bars + count) + LANES
        if not alike:
            groups += 1
            first = run
            bars = 0
        bars += count
        group_of[run] = groups - 1
    return groups


class Group(NamedTuple):
    """A group of a :class:`BarLayout`: its first column and their number, the ends of the first column, the first run
    and the end, and whether it consists of stars; and where rows of the columns of its section have the first column,
    and the distance from one row to the next."""

    first: int
    n: int
    head: int
    far: int
    run: int
    end: int
    star: bool
    at: int
    stride: int


@inlined
def group_of(layout, section, number, place):
    """Return a group of a section, whose rows begin at a ``place``."""
    first, begin = layout.starts[number], layout.starts[layout.sections[section]]
    return Group(
        first,
        layout.starts[number + 1] - first,
        layout.heads[number],
        layout.fars[number],
        layout.runs[number],
        layout.runs[number + 1],
        layout.stars[number],
        place + first - begin,
        layout.starts[layout.sections[section + 1]] - begin,
    )


@inlined
def run_column(g, run, nodes, bars):
    """Return the column of the first bar of a run, counted from the first one of its group."""
    return np.int64(bars[run]) - np.int64(bars[g.run]) if g.star else np.int64(nodes[run]) - g.head
