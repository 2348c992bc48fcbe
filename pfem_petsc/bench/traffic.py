"""Memory traffic and operations of a step: the bound with which measured times are compared.

The bytes are those that the loops move if they find nodes in the cache while they process their bars. As in STREAM, an
array that is overwritten counts as written only. Arrays are float64 (8 B), ends of bars 32-bit; where bars go by runs
of constant offset, their ends are not read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..parallel.petsc_log import OF_BALANCE, OF_FORCE, OF_PRODUCT

if TYPE_CHECKING:
    from ..mechanics.bars import Bars

__all__ = ["ASSUMED", "OPERATIONS", "Work", "bytes_per_step", "operations_per_step", "share_in_runs"]

_VECTOR = 24  # B per node: three components

ASSUMED = {
    "bar in a run": 8,  # rest length 8
    "other bar": 12,  # and the far end 4
    "plastic bar": 16,  # plastic and accumulated plastic strain
    "explicit node": 4 * _VECTOR + 8,  # x, v read and written; mass read
    "kept force": 2 * _VECTOR,  # f written and read
    "node of a row": 2 * _VECTOR,  # velocity and acceleration written
    "residual node": 4 * _VECTOR + 8,  # increment, predictor, known terms read, residual written; mass read
    "linearised bar": 16,  # two stiffnesses
    "ends of a linearised bar": 8,
    "product node": _VECTOR,  # positions, from which bars have their directions
    "matrix entry": 12,  # value 8, column 4
    "conjugate gradients node": 12 * _VECTOR,  # x, r, p read and written; A p, z written and read; r . z; diagonal
}
"""Bytes per item."""

OPERATIONS = {
    "bar": OF_FORCE,
    "plastic bar": 12,  # trial stress, yield function, return
    "explicit node": OF_BALANCE + 6 + 6 + 6,  # balance; position, velocity, work of the internal forces
    "residual node": 15,
    "linearised bar": 20,
    "product": OF_PRODUCT,
    "matrix entry": 2,
    "conjugate gradients node": 36,  # three sums of vectors, two products, the diagonal
}
"""Floating-point operations per item, of linear elastic bars."""


class Work(NamedTuple):
    """What a step does.

    Attributes
    ----------
    bars, nodes : of the whole mesh
    implicit, assembled, plastic : kind of the step
    newton, linear : iterations of an implicit step
    runs : share of the bars that go by runs of constant offset
    rows : rows of the history a step
    """

    bars: int
    nodes: int
    implicit: bool = False
    assembled: bool = False
    plastic: bool = False
    newton: float = 0.0
    linear: float = 0.0
    runs: float = 0.0
    rows: float = 0.0

    @property
    def entries(self) -> int:
        """Entries of an assembled matrix."""
        return 9 * (self.nodes + 2 * self.bars)


def bytes_per_step(work: Work) -> float:
    """Return the number of bytes that a step moves, over all ranks."""
    size = ASSUMED
    bars, nodes = work.bars, work.nodes
    far = (1.0 - work.runs) * (size["other bar"] - size["bar in a run"])
    bar = size["bar in a run"] + far + (size["plastic bar"] if work.plastic else 0)
    total = bars * bar + nodes * (size["explicit node"] + work.rows * size["node of a row"])
    # forces that no row reads stay in the cache, if all bars go by runs and keep nothing
    unread = work.runs == 1.0 and not work.plastic and not work.implicit
    total += nodes * size["kept force"] * (work.rows if unread else 1.0)
    if not work.implicit:
        return float(total)
    evaluation = bars * bar + nodes * size["residual node"]
    if work.assembled:
        matrix = work.entries * size["matrix entry"]
        update = bars * (bar + 16) + 8 * work.entries  # indices of a bar's four blocks, and their values
    else:
        matrix = bars * (far + size["linearised bar"]) + nodes * size["product node"]
        update = bars * (bar + size["ends of a linearised bar"] + size["linearised bar"])
    iteration = matrix + nodes * size["conjugate gradients node"]
    return float(total + (work.newton + 1.0) * evaluation + work.newton * update + work.linear * iteration)


def operations_per_step(work: Work) -> float:
    """Return the number of floating-point operations of a step, over all ranks."""
    size = OPERATIONS
    bars, nodes = work.bars, work.nodes
    bar = size["bar"] + (size["plastic bar"] if work.plastic else 0)
    total = bars * bar + nodes * size["explicit node"]
    if not work.implicit:
        return float(total)
    evaluation = bars * bar + nodes * size["residual node"]
    product = work.entries * size["matrix entry"] if work.assembled else bars * size["product"]
    iteration = product + nodes * size["conjugate gradients node"]
    update = bars * size["linearised bar"]
    return float(total + (work.newton + 1.0) * evaluation + work.newton * update + work.linear * iteration)


def share_in_runs(bars: Bars) -> float:
    """Return the share of this rank's bars that go by runs of constant offset."""
    here = 0
    for block in bars.blocks:
        sweep = block.sweep
        firsts = sweep.bars if hasattr(sweep, "bars") else sweep.starts[sweep.chunks[:-1]]
        sizes = np.diff(np.append(firsts, block.stop).astype(np.int64))
        here += int(sizes[sweep.diagonal].sum())
    return here / max(len(bars.ends), 1)
