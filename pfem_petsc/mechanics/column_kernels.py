"""Compiled loop over columns of bars: internal forces, and the history of laws that have one, but no energies.

It computes the same forces as :mod:`~pfem_petsc.mechanics.force_kernels`, and adds them to each node in the same order,
so the results are bitwise identical.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from .compiled import borrowing
from .force_kernels import COLLAPSED_STRETCH, SHORTENED_STRETCH
from .law_rows import last_row, no_bar_data, no_variables
from .materials.base import Law
from .planes import add_rows, address, copy_run, difference_of_ends, number_at, subtract_rows
from .rows import CHUNK, bar_value, differ, extend, put_apart, take

__all__ = ["make_column_kernels"]


def make_column_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``pull_columns``, which adds internal forces, and the number ``column_rows`` of rows of CHUNK numbers in its
    workspace.

    Laws of bars that can break have no such loop, since a step in which a bar breaks needs the energies: it is replaced
    by a function that does nothing.
    """
    response, like, of_bar, by_rate = law.response, no_variables(law), no_bar_data(law), law.rate
    n_rows, last = len(law.rows), last_row(law)
    keeps = n_rows + len(law.bar_data) > 0

    @borrowing
    def pull_none(x, planes, sums, base, sweep, columns, begun, ended, p, step, work):
        """Replace :func:`pull_columns` where it does not apply."""
        return -1, False

    @borrowing
    def pull_columns(x, planes, sums, base, sweep, columns, begun, ended, p, step, work):
        """Add the internal forces of the groups [begun, ended) of ``columns`` to ``sums`` (3 stride,), and update the
        history in ``columns.kept``; return the first failed bar, or -1, and whether any bar is so short that it may be
        inverted.

        ``x`` (n, 3) positions, which are also in ``planes`` (3 stride,) from node ``base`` on; ``sweep``: of the bars;
        ``work`` (``column_rows`` CHUNK,): forces of a group by components, and its new history; see
        :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
        """
        failed = -1
        shortened = False
        stride = len(planes) // 3
        heads, fars, starts, runs = columns.heads, columns.fars, columns.starts, columns.runs
        kept, wide = columns.kept, len(columns.rest)
        flat = kept.reshape(-1)
        for group in range(begun, ended):
            first = starts[group]
            n = starts[group + 1] - first
            head, tail = heads[group] - base, fars[group] - base
            low, high, lengths = address(planes, head), address(planes, tail), address(columns.rest, first)
            short = 0
            changed = 0
            for i in range(n):
                rest = number_at(lengths, i)
                real = rest > 0.0
                dx, dy, dz = difference_of_ends(low, high, stride, i)
                squared = dx * dx + dy * dy + dz * dz
                length = math.sqrt(squared if real else 1.0)
                stretch = length / (rest if real else 1.0)
                short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
                strain, slope, _ = measure(stretch)
                q = take(kept, first + i, like)
                rate = 0.0
                if by_rate and step > 0.0:
                    rate = (strain - kept[last, first + i]) / step
                given = extend(p, kept, n_rows, first + i, of_bar)
                stress, _, new, _ = response(strain, rate, step, 0.0, given, q)
                section = bar_value(columns.area, first + i) if real else 0.0
                pull = section * stress * slope / length
                if keeps:
                    pull = pull if real else 0.0  # what a column without a bar keeps may be anything
                put_apart(work, 0, i, pull, (dx, dy, dz))
                if n_rows > 0:
                    put_apart(work, 3, i, 1.0, new)
                    changed += 1 if real and (by_rate or differ(new, q)) else 0
                if by_rate:
                    put_apart(work, 3 + last, i, 1.0, (strain, stress))
            if n_rows > 0 and changed > 0:
                for j in range(n_rows):
                    copy_run(work, (3 + j) * CHUNK, flat, j * wide + first, n)
            if short > 0:
                for run in range(runs[group], runs[group + 1]):
                    ahead = sweep.heads[run] - heads[group]
                    for k in range(sweep.starts[run + 1] - sweep.starts[run]):
                        i = ahead + k
                        a, b = heads[group] + i, fars[group] + i
                        dx, dy, dz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
                        stretch = math.sqrt(dx * dx + dy * dy + dz * dz) / columns.rest[first + i]
                        if stretch < SHORTENED_STRETCH:
                            shortened = True
                        if not (stretch > COLLAPSED_STRETCH):  # NaN fails this test too
                            if failed < 0:
                                failed = np.int64(sweep.starts[run] + k)  # signed, like -1
                            for c in range(3):
                                work[c * CHUNK + i] = 0.0
            if columns.close[group]:
                for run in range(runs[group], runs[group + 1]):
                    at, count = sweep.heads[run] - heads[group], sweep.starts[run + 1] - sweep.starts[run]
                    subtract_rows(sums, stride, head + at, count, work, at)
                    add_rows(sums, stride, tail + at, count, work, at)
            else:
                add_rows(sums, stride, tail, n, work, 0)
                subtract_rows(sums, stride, head, n, work, 0)
        return failed, shortened

    return {"pull_columns": pull_columns if law.rupture < 0 else pull_none, "column_rows": 3 + n_rows}
