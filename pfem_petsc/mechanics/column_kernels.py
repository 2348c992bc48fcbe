"""Compiled loop over columns of bars: internal forces alone, of laws without history.

It computes the same forces as :mod:`~pfem_petsc.mechanics.force_kernels`, and adds them to each node in the same order,
so the results are bitwise identical.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from .compiled import inlined
from .force_kernels import COLLAPSED_STRETCH, SHORTENED_STRETCH
from .materials.base import Law
from .planes import add_rows, address, difference_of_ends, number_at, subtract_rows
from .rows import CHUNK, bar_value, put_apart

__all__ = ["make_column_kernels"]


def make_column_kernels(law: Law, measure: Callable) -> dict[str, Any]:
    """Make ``pull_columns``, which adds internal forces.

    Laws that have a history or data of each bar have no such loop: it is replaced by a function that does nothing.
    """
    response = law.response
    serves = not law.rows and not law.bar_data

    @inlined
    def pull_none(x, planes, sums, base, sweep, columns, begun, ended, p, step, work):
        """Replace :func:`pull_columns` where it does not apply."""
        return -1, False

    @inlined
    def pull_columns(x, planes, sums, base, sweep, columns, begun, ended, p, step, work):
        """Add the internal forces of the groups [begun, ended) of ``columns`` to ``sums`` (3 stride,); return the first
        failed bar, or -1, and whether any bar is so short that it may be inverted.

        ``x`` (n, 3) positions, which are also in ``planes`` (3 stride,) from node ``base`` on; ``sweep``: of the bars;
        ``work``: three rows; see :func:`~pfem_petsc.mechanics.kernels.make_kernels`.
        """
        failed = -1
        shortened = False
        stride = len(planes) // 3
        heads, fars, starts, runs = columns.heads, columns.fars, columns.starts, columns.runs
        for group in range(begun, ended):
            first = starts[group]
            n = starts[group + 1] - first
            head, tail = heads[group] - base, fars[group] - base
            low, high, lengths = address(planes, head), address(planes, tail), address(columns.rest, first)
            short = 0
            for i in range(n):
                rest = number_at(lengths, i)
                real = rest > 0.0
                dx, dy, dz = difference_of_ends(low, high, stride, i)
                squared = dx * dx + dy * dy + dz * dz
                length = math.sqrt(squared if real else 1.0)
                stretch = length / (rest if real else 1.0)
                short += 0 if stretch >= SHORTENED_STRETCH else 1  # NaN counts
                strain, slope, _ = measure(stretch)
                stress, _, _, _ = response(strain, 0.0, step, 0.0, p, ())
                section = bar_value(columns.area, first + i) if real else 0.0
                put_apart(work, 0, i, section * stress * slope / length, (dx, dy, dz))
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

    return {"pull_columns": pull_columns if serves else pull_none}
