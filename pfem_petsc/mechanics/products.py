"""The stiffness of bars times vectors, bar by bar: c d d^T + g I of each bar with end difference d."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..mesh.ordering import NODE_BLOCK
from .chunk_laws import ROW
from .compiled import inlined, kernel
from .layout import DIFFERENCES, FORCES, BarLayout, Group, aligned, new_components, split_components, spread_values

if TYPE_CHECKING:
    from .bars import Bars


_X, _Y, _Z = (np.uint64(row * ROW) for row in range(3))


class BarProducts:
    """Products with the stiffness of all bars of a rank, and its diagonal.

    Attributes
    ----------
    x : (local, 3) positions [m]
    stored : (2, b) c [N/m3] and g [N/m] of each bar
    """

    def __init__(self, bars: Bars) -> None:
        self.bars = bars
        nodes, self._layout = bars.mesh.n_local, bars.arrays.layout
        self.x = np.zeros((nodes, 3))
        self.stored = np.zeros((2, len(bars.ends)))
        self._columns = self.stored
        columns = int(self._layout.starts[-1])
        if columns > len(bars.ends):
            self._columns = aligned(2 * columns).reshape(2, columns)
        self._places, self._vectors = new_components(nodes), new_components(nodes)
        self._sums = new_components(nodes, FORCES)
        self._work = aligned(3 * ROW, DIFFERENCES)
        self._needed, self._complete = _order(self._layout, nodes)

    @classmethod
    def tangent(cls, bars: Bars, x: np.ndarray) -> BarProducts:
        """Return products with the tangent stiffness at positions ``x`` (local, 3), without springs."""
        made = cls(bars)
        made.x[:] = x
        bars.stiffnesses(x, 1.0, made.stored)
        made.take()
        return made

    def take(self) -> None:
        """Take account of changes of :attr:`x` and :attr:`stored`."""
        split_components(self.x, self._places)
        if self._columns is self.stored:
            return
        for block in self.bars.blocks:
            part = self._layout.columns(block.index)
            for values, spread in zip(self.stored[:, block.start : block.stop], self._columns[:, part], strict=True):
                spread_values(self._layout, block.index, values, 0.0, spread)

    def times(self, nodal: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Write nodal u + K u to ``out``, both (local, 3); ``nodal`` (owned,) [N/m]."""
        task = ProductTask(nodal, u.reshape(-1), out.reshape(-1), self._needed, self._complete)
        multiply(self._layout, self._places, self._vectors, self._columns, self._sums, self._work, task)

    def diagonal(self) -> np.ndarray:
        """Return the diagonal of K (local, 3)."""
        diagonal = np.zeros_like(self.x)
        add_diagonals(self.bars.ends, self.x, self.stored, diagonal)
        return diagonal


def _order(layout: BarLayout, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each group how many leading nodes must be begun before it, and how many no later one adds to."""
    lowest, highest = layout.heads // NODE_BLOCK * NODE_BLOCK, layout.fars + np.diff(layout.starts)
    for group in np.flatnonzero(layout.stars):
        first, last = layout.runs[group : group + 2]
        lowest[group] = layout.nodes[first:last].min()
        highest[group] = layout.far[layout.bars[first] : layout.bars[last]].max() + 1
    complete = np.append(np.minimum.accumulate(lowest[::-1])[::-1], nodes)[1:]
    return np.minimum(np.maximum(np.maximum.accumulate(highest), complete), nodes), complete


class ProductTask(NamedTuple):
    """What a product reads and writes: ``nodal`` (owned,), vectors ``u`` and ``out`` (3 local,), and for each group how
    many leading nodes are ``needed``, and which are ``complete`` after it."""

    nodal: np.ndarray
    u: np.ndarray
    out: np.ndarray
    needed: np.ndarray
    complete: np.ndarray


@inlined
def _begin(first, end, u, vectors, sums):
    """Write the vectors of nodes to components, and clear their sums."""
    for k in range(first, end):
        i, at = np.uint64(k), np.uint64(3 * k)
        vectors[0, i], vectors[1, i], vectors[2, i] = u[at], u[np.uint64(3 * k + 1)], u[np.uint64(3 * k + 2)]
        sums[0, i] = 0.0
        sums[1, i] = 0.0
        sums[2, i] = 0.0


@inlined
def _end(first, end, nodal, u, sums, out):
    """Write the products of nodes; those of ghosts are not complete, and zero."""
    for k in range(first, min(end, len(nodal))):
        i, at, after, last = np.uint64(k), np.uint64(3 * k), np.uint64(3 * k + 1), np.uint64(3 * k + 2)
        out[at] = nodal[i] * u[at] + sums[0, i]
        out[after] = nodal[i] * u[after] + sums[1, i]
        out[last] = nodal[i] * u[last] + sums[2, i]
    for k in range(3 * max(first, len(nodal)), 3 * end):
        out[k] = 0.0


@inlined
def _add_products_of_runs(g, x, u, stored, sums, work):
    """Add the products of a group of runs to the upper ends, and subtract them from the lower ones in a workspace for
    the nodes of a block, at the place of the group in it."""
    for k in range(g.n):
        a, b, i, at = np.uint64(g.head + k), np.uint64(g.far + k), np.uint64(g.first + k), np.uint64(g.at + k)
        dx, dy, dz = x[0, b] - x[0, a], x[1, b] - x[1, a], x[2, b] - x[2, a]
        ux, uy, uz = u[0, b] - u[0, a], u[1, b] - u[1, a], u[2, b] - u[2, a]
        c, across = stored[0, i] * (dx * ux + dy * uy + dz * uz), stored[1, i]
        px, py, pz = c * dx + across * ux, c * dy + across * uy, c * dz + across * uz
        work[_X + at] -= px
        work[_Y + at] -= py
        work[_Z + at] -= pz
        sums[0, b] += px
        sums[1, b] += py
        sums[2, b] += pz


@inlined
def _flush(origin, count, sums, work):
    """Add what is due to the first nodes of a block, and clear it."""
    for k in range(count):
        i, at = np.uint64(origin + k), np.uint64(k)
        sums[0, i] += work[_X + at]
        sums[1, i] += work[_Y + at]
        sums[2, i] += work[_Z + at]
        work[_X + at] = 0.0
        work[_Y + at] = 0.0
        work[_Z + at] = 0.0


@inlined
def _add_products_of_stars(g, runs, x, u, stored, sums):
    """Add the products of a group of stars; ``runs``: nodes, bars and far ends of the layout."""
    nodes, bars, far = runs
    ahead = g.first - np.int64(bars[g.run])
    for run in range(g.run, g.end):
        a = np.uint64(nodes[run])
        ax, ay, az = x[0, a], x[1, a], x[2, a]
        px, py, pz = u[0, a], u[1, a], u[2, a]
        sx = sy = sz = 0.0
        for k in range(np.int64(bars[run]), np.int64(bars[run + 1])):
            b, i = np.uint64(far[k]), np.uint64(ahead + k)
            dx, dy, dz = x[0, b] - ax, x[1, b] - ay, x[2, b] - az
            ux, uy, uz = u[0, b] - px, u[1, b] - py, u[2, b] - pz
            c, across = stored[0, i] * (dx * ux + dy * uy + dz * uz), stored[1, i]
            fx, fy, fz = c * dx + across * ux, c * dy + across * uy, c * dz + across * uz
            sx += fx
            sy += fy
            sz += fz
            sums[0, b] += fx
            sums[1, b] += fy
            sums[2, b] += fz
        sums[0, a] -= sx
        sums[1, a] -= sy
        sums[2, a] -= sz


@kernel
def multiply(layout, x, vectors, stored, sums, work, task):
    """Write nodal u + K u; positions, vectors and sums by components, ``stored`` (2, columns) of a
    :class:`~.layout.BarLayout`, ``work`` (3 ROW,) zeros.

    Vectors are split shortly before they are needed, and products written as soon as they are complete.
    """
    nodal, u, out, runs = task.nodal, task.u, task.out, (layout.nodes, layout.bars, layout.far)
    begun, ended, origin, wide = np.int64(0), np.int64(0), np.int64(-1), np.int64(0)
    for group in range(len(layout.heads)):
        first, head, star = layout.starts[group], layout.heads[group], layout.stars[group]
        n = layout.starts[group + 1] - first
        block = np.int64(-1) if star else head // NODE_BLOCK * NODE_BLOCK
        g = Group(first, n, head, layout.fars[group], layout.runs[group], layout.runs[group + 1], star, head - block, n)
        if block != origin and origin >= 0:
            _flush(origin, wide, sums, work)
            wide = np.int64(0)
        if (block != origin or star) and group > 0 and task.complete[group - 1] > ended:
            _end(ended, task.complete[group - 1], nodal, u, sums, out)
            ended = task.complete[group - 1]
        origin = block
        if task.needed[group] > begun:
            _begin(begun, task.needed[group], u, vectors, sums)
            begun = task.needed[group]
        if star:
            _add_products_of_stars(g, runs, x, vectors, stored, sums)
        else:
            wide = max(wide, g.at + n)
            _add_products_of_runs(g, x, vectors, stored, sums, work)
    if origin >= 0:
        _flush(origin, wide, sums, work)
    nodes = len(u) // 3
    _begin(begun, nodes, u, vectors, sums)
    _end(ended, nodes, nodal, u, sums, out)


@kernel
def add_diagonals(bars, x, stored, diagonal):
    """Add the diagonal of K by the bars (b, 2) to ``diagonal`` (local nodes, 3)."""
    for k in range(len(bars)):
        a, b = bars[k, 0], bars[k, 1]
        for i in range(3):
            d = x[b, i] - x[a, i]
            part = stored[0, k] * (d * d) + stored[1, k]
            diagonal[a, i] += part
            diagonal[b, i] += part
