"""The stiffness of bars times vectors, bar by bar: c d d^T + g I of each bar with end difference d."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..mesh.ordering import NODE_BLOCK
from .compiled import borrowing, borrowing_apart, inlined, kernel
from .mass import scale_rows
from .runs import (
    Groups,
    Sweep,
    add_lower_ends,
    aligned,
    clear_lower_ends,
    fill,
    make_groups,
    new_planes,
    new_rows,
    split_components,
    spread_values,
)
from .tuples import accumulate

if TYPE_CHECKING:
    from .bars import Bars

_add_force = accumulate(3)


class PaddedBars(NamedTuple):
    """Bars of a section by columns of padded runs: ``groups``, c [N/m3] and g [N/m] (columns,), zero where there is no
    bar, and whether the groups are in the order of their blocks of nodes."""

    groups: Groups
    along: np.ndarray
    across: np.ndarray
    ascending: bool


def pad(sweep: Sweep) -> PaddedBars | None:
    """Return the columns of the bars of a sweep; None if they are not all in diagonal runs."""
    if not sweep.diagonal.all():
        return None
    groups = make_groups(sweep)
    count = int(groups.starts[-1])
    ascending = bool((np.diff(groups.heads.astype(np.int64) // NODE_BLOCK) >= 0).all())
    return PaddedBars(groups, aligned(count), aligned(count), ascending)


class BarProducts:
    """Products with the stiffness of all bars of a rank, and its diagonal.

    The bars of a section that are all in diagonal runs are evaluated by columns of :class:`~.runs.Groups`, from
    positions and vectors by components; others run by run.

    Attributes
    ----------
    x : (local, 3) positions [m]
    stored : (2, b) c [N/m3] and g [N/m] of each bar
    """

    def __init__(self, bars: Bars) -> None:
        self.bars = bars
        nodes = bars.mesh.n_local
        self.x = np.zeros((nodes, 3))
        self.stored = np.zeros((2, len(bars.ends)))
        self._padded = [pad(block.sweep) for block in bars.blocks]
        some = any(padded is not None for padded in self._padded)
        count = nodes if some else 0
        places, sums = new_planes(count)
        self._planes = places, new_planes(count)[0], sums

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
        if len(self._planes[0]):
            split(self.x, self._planes[0])
        for block, padded in zip(self.bars.blocks, self._padded, strict=True):
            if padded is not None:
                for values, spread in zip(self.stored[:, block.start : block.stop], padded[1:3], strict=True):
                    spread_values(values, block.sweep, padded.groups, 0.0, spread)

    def times(self, nodal: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Write nodal u + K u to ``out``, both (local, 3); ``nodal`` (owned,) [N/m]."""
        padded = [bars for bars in self._padded if bars is not None]
        for k, bars in enumerate(padded):
            add_padded_products(bars, self._planes, Task(u, out, nodal, k == 0, k == len(padded) - 1))
        if not padded:
            scale_rows(nodal, u, out)
        out[len(nodal) :] = 0.0  # those of ghosts are not complete
        for block, bars in zip(self.bars.blocks, self._padded, strict=True):
            if bars is None:
                add_products(block.sweep, self.bars.far, self.x, self.stored, u, out)

    def diagonal(self) -> np.ndarray:
        """Return the diagonal of K (local, 3)."""
        diagonal = np.zeros_like(self.x)
        for block, padded in zip(self.bars.blocks, self._padded, strict=True):
            if padded is None:
                add_diagonals(self.bars.ends, self.x, self.stored, block.start, block.stop, diagonal)
            else:
                add_padded_diagonals(padded, self._planes, diagonal)
        return diagonal


@kernel
def split(x, planes):
    """Write vectors (n, 3) to ``planes`` (3 stride,)."""
    split_components(x, 0, len(x), planes, len(planes) // 3, 0)


@inlined
def _add_components(planes, f):
    """Add vectors in ``planes`` (3 stride,) to ``f`` (n, 3)."""
    stride = len(planes) // 3
    xs, ys, zs = planes, planes[stride:], planes[2 * stride :]
    nodes = f.reshape(-1)
    for i in range(len(f)):
        nodes[3 * i] += xs[i]
        nodes[3 * i + 1] += ys[i]
        nodes[3 * i + 2] += zs[i]


class Task(NamedTuple):
    """A product of all bars: ``u`` and ``out`` (local, 3), ``nodal`` (owned,); and whether those of a section are its
    ``first``, before which u is split, and its ``last``, after which nodal u and the sums are written to out."""

    u: np.ndarray
    out: np.ndarray
    nodal: np.ndarray
    first: bool
    last: bool


@borrowing
def _begin(task, first, end, vectors, sums):
    """Write the vectors of the nodes [first, end) to planes, and clear their sums."""
    stride = len(sums) // 3
    split_components(task.u, first, end - first, vectors, stride, 0)
    for c in range(3):
        fill(sums[c * stride + first : c * stride + end], 0.0)


@borrowing
def _end(task, first, end, sums):
    """Write the products of the nodes [first, end)."""
    nodal = task.nodal[first:end]
    end = first + len(nodal)
    _join(nodal, task.u[first:end].reshape(-1), sums[first:], len(sums) // 3, task.out[first:end].reshape(-1))


@borrowing_apart
def _join(nodal, u, sums, stride, out):
    """Write nodal u and sums in planes to vectors (3 n,)."""
    xs, ys, zs = sums, sums[stride:], sums[2 * stride :]
    for i in range(len(nodal)):
        out[3 * i] = nodal[i] * u[3 * i] + xs[i]
        out[3 * i + 1] = nodal[i] * u[3 * i + 1] + ys[i]
        out[3 * i + 2] = nodal[i] * u[3 * i + 2] + zs[i]


def _group_loop(diagonal: bool) -> Callable[..., Any]:
    """Make the loop over groups of padded runs that adds products, or the diagonal of the stiffness."""
    sign = 1.0 if diagonal else -1.0

    @borrowing_apart
    def add_groups(bars, places, vectors, sums, task, work):
        """Add to ``sums`` (3 stride,); ``work``: what is due to the lower ends of the bars of a block of nodes.

        Vectors are split shortly before they are needed, and products written as soon as they are complete.
        """
        heads, fars, starts = bars.groups.heads, bars.groups.fars, bars.groups.starts
        stride = len(places) // 3
        along, across = bars.along, bars.across
        origin = -1  # first node of the block whose sums are in the workspace
        wide = 0
        nodes = len(task.u)
        ready, done = (0 if task.first else nodes), 0
        for group in range(len(heads)):
            first = starts[group]
            n = starts[group + 1] - first
            node, far = np.int64(heads[group]), np.int64(fars[group])
            block = node // NODE_BLOCK * NODE_BLOCK
            if block != origin:
                if origin >= 0:
                    add_lower_ends(work, wide, sums, origin)
                clear_lower_ends(work)
                origin = block
                wide = 0
                if not diagonal and task.last and bars.ascending:
                    _end(task, done, block, sums)
                    done = block
            if not diagonal and ready < min(far + n, nodes):
                _begin(task, ready, min(far + n, nodes), vectors, sums)
                ready = min(far + n, nodes)
            lower = work[node - block :]
            wide = max(wide, node - block + n)
            x0, x1 = node, far
            y0, y1, z0, z1 = x0 + stride, x1 + stride, x0 + 2 * stride, x1 + 2 * stride
            for i in range(n):
                # unsigned: negative indices need not be handled
                dx = places[np.uint64(x1 + i)] - places[np.uint64(x0 + i)]
                dy = places[np.uint64(y1 + i)] - places[np.uint64(y0 + i)]
                dz = places[np.uint64(z1 + i)] - places[np.uint64(z0 + i)]
                c, g = along[first + i], across[first + i]
                if diagonal:
                    fx, fy, fz = c * (dx * dx) + g, c * (dy * dy) + g, c * (dz * dz) + g
                else:
                    ux = vectors[np.uint64(x1 + i)] - vectors[np.uint64(x0 + i)]
                    uy = vectors[np.uint64(y1 + i)] - vectors[np.uint64(y0 + i)]
                    uz = vectors[np.uint64(z1 + i)] - vectors[np.uint64(z0 + i)]
                    c *= dx * ux + dy * uy + dz * uz
                    fx, fy, fz = c * dx + g * ux, c * dy + g * uy, c * dz + g * uz
                _add_force(lower, i, sign, (fx, fy, fz))
                sums[np.uint64(x1 + i)] += fx
                sums[np.uint64(y1 + i)] += fy
                sums[np.uint64(z1 + i)] += fz
        if origin >= 0:
            add_lower_ends(work, wide, sums, origin)
        if not diagonal:
            if ready < nodes:
                _begin(task, ready, nodes, vectors, sums)
            if task.last:
                _end(task, done, nodes, sums)

    return add_groups


_add_group_products, _add_group_diagonals = _group_loop(False), _group_loop(True)


@kernel
def add_padded_products(bars, planes, task):
    """Add the products of :class:`PaddedBars` for a :class:`Task`; ``planes`` (3 stride,) of positions, vectors and
    sums."""
    places, vectors, sums = planes
    _add_group_products(bars, places, vectors, sums, task, new_rows(3))


@kernel
def add_padded_diagonals(bars, planes, diagonal):
    """Add the diagonal of :class:`PaddedBars` to ``diagonal`` (n, 3); ``planes`` as for products."""
    places, vectors, sums = planes
    fill(sums, 0.0)
    _add_group_diagonals(bars, places, vectors, sums, Task(diagonal, diagonal, sums, False, False), new_rows(3))
    _add_components(sums, diagonal)


@kernel
def add_products(sweep, far, x, stored, u, out):
    """Add K u to ``out``, run by run of a :class:`~pfem_petsc.mechanics.runs.Sweep`."""
    heads, starts, chunks = sweep.heads, sweep.starts, sweep.chunks
    for chunk in range(len(sweep.diagonal)):
        if sweep.diagonal[chunk]:
            _add_diagonal_runs(sweep, chunk, x, stored, u, out)
            continue
        for run in range(chunks[chunk], chunks[chunk + 1]):
            a = heads[run]
            ax, ay, az = x[a, 0], x[a, 1], x[a, 2]
            px, py, pz = u[a, 0], u[a, 1], u[a, 2]
            sx = sy = sz = 0.0
            for k in range(starts[run], starts[run + 1]):
                b = far[k]
                dx, dy, dz = x[b, 0] - ax, x[b, 1] - ay, x[b, 2] - az
                ux, uy, uz = u[b, 0] - px, u[b, 1] - py, u[b, 2] - pz
                c = stored[0, k] * (dx * ux + dy * uy + dz * uz)
                g = stored[1, k]
                fx, fy, fz = c * dx + g * ux, c * dy + g * uy, c * dz + g * uz
                sx += fx
                sy += fy
                sz += fz
                out[b, 0] += fx
                out[b, 1] += fy
                out[b, 2] += fz
            out[a, 0] -= sx
            out[a, 1] -= sy
            out[a, 2] -= sz


@inlined
def _add_diagonal_runs(sweep, chunk, x, stored, u, out):
    """Add the products of a chunk of diagonal runs."""
    heads, fars, starts = sweep.heads, sweep.fars, sweep.starts
    for run in range(sweep.chunks[chunk], sweep.chunks[chunk + 1]):
        for k in range(starts[run], starts[run + 1]):
            a, b = heads[run] + k - starts[run], fars[run] + k - starts[run]
            dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            ux, uy, uz = u[b, 0] - u[a, 0], u[b, 1] - u[a, 1], u[b, 2] - u[a, 2]
            c = stored[0, k] * (dx * ux + dy * uy + dz * uz)
            g = stored[1, k]
            fx, fy, fz = c * dx + g * ux, c * dy + g * uy, c * dz + g * uz
            out[a, 0] -= fx
            out[a, 1] -= fy
            out[a, 2] -= fz
            out[b, 0] += fx
            out[b, 1] += fy
            out[b, 2] += fz


@kernel
def add_diagonals(bars, x, stored, begun, ended, diagonal):
    """Add the diagonal of K by the bars (b, 2) [begun, ended) to ``diagonal`` (local nodes, 3)."""
    for k in range(begun, ended):
        a, b = bars[k, 0], bars[k, 1]
        for i in range(3):
            d = x[b, i] - x[a, i]
            part = stored[0, k] * (d * d) + stored[1, k]
            diagonal[a, i] += part
            diagonal[b, i] += part
