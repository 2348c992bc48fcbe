"""Compiled loops over bars, made once for each material law.

Bar from node a to node b with d = x_b - x_a, l = |d|, n = d/l (Greco & Coda's positional bar; design equations):
internal force on a is -N n, on b is +N n; the Hessian block is (dN/dl) n n^T + (N/l)(I - n n^T), added to the diagonal
blocks of both ends and subtracted from the two blocks between them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

from .column_kernels import make_column_kernels
from .field_kernels import make_field_kernels
from .force_kernels import make_force_kernels
from .materials.base import Law
from .tangent_kernels import make_tangent_kernels

__all__ = ["fused_parts", "make_kernels"]


@cache
def make_kernels(law: Law, measure: Callable) -> SimpleNamespace:
    """Make the kernels of a law and strain measure: ``forces``, ``tangents``, ``product``, ``linearise``, ``fields``,
    ``densities``, ``rates``.

    Common arguments: ``x`` (local nodes, 3) [m]; ``bars`` (b, 2) local ends; ``rest`` (b,) rest lengths [m]; ``heat``
    (2, b) thermal strains and temperatures [K], or (2, 0) for none; ``p`` the law's parameters; ``area`` [m2], a number
    or (n,); ``step`` from the start of the step to ``x`` [s]; ``history`` (rows, n) of the bars of this block:
    ``law.rows`` of bar ``k`` in column ``k - start``, and after them its ``law.bar_data``, which no loop writes. No
    array is passed to an inner function: reference counting would cost more than the bar.
    """
    return SimpleNamespace(
        **make_force_kernels(law, measure),
        **make_column_kernels(law, measure),
        **make_tangent_kernels(law, measure),
        **make_field_kernels(law, measure),
    )


def fused_parts(kernels: SimpleNamespace) -> tuple:
    """Return the kernels of which :func:`~pfem_petsc.stepping.fused_loop.make_fused_loop` makes its loop."""
    return (
        kernels.sweep_part,
        kernels.sum_energies,
        kernels.clear_energies,
        kernels.work_rows,
        kernels.pull_columns,
        kernels.column_rows,
    )
