"""Minimum memory traffic of a step, the bound with which measured times are compared.

The count is that of an ideal program that moves everything once and finds nodes in the cache while it processes their
bars. As in STREAM, an array that is overwritten counts as written only. Arrays are float64 (8 B), ends of bars 32-bit.
"""

from __future__ import annotations

__all__ = ["ASSUMED", "bytes_per_step"]

_VECTOR = 24  # B per node: three components

ASSUMED = {
    "bar": 16,  # both ends 2 x 4, rest length 8
    "plastic bar": 16,  # plastic and accumulated plastic strain
    "explicit node": 6 * _VECTOR + 8,  # x, v, f read and written; mass read
    "residual node": 4 * _VECTOR + 8,  # increment, predictor, known terms read, residual written; mass read
    "linearised bar": 16,  # two stiffnesses
    "product node": _VECTOR,  # positions, from which bars have their directions
    "matrix entry": 12,  # value 8, column 4
    "conjugate gradients node": 12 * _VECTOR,  # x, r, p read and written; A p, z written and read; r . z; diagonal
}
"""Bytes per item."""


def bytes_per_step(
    bars: int, nodes: int, *, implicit: bool, assembled: bool, plastic: bool, newton: float, linear: float
) -> float:
    """Return the minimum number of bytes that a step moves, over all ranks.

    Parameters
    ----------
    bars, nodes : of the whole mesh
    implicit, assembled, plastic : kind of the step
    newton, linear : iterations of an implicit step
    """
    size = ASSUMED
    bar = size["bar"] + (size["plastic bar"] if plastic else 0)
    total = bars * bar + nodes * size["explicit node"]
    if not implicit:
        return float(total)
    evaluation = bars * bar + nodes * size["residual node"]
    entries = 9 * (nodes + 2 * bars)
    if assembled:
        matrix = entries * size["matrix entry"]
        update = bars * (bar + 16) + 8 * entries  # indices of a bar's four blocks, and their values
    else:
        matrix = bars * (8 + size["linearised bar"]) + nodes * size["product node"]
        update = bars * (bar + size["linearised bar"])
    iteration = matrix + nodes * size["conjugate gradients node"]
    return float(total + (newton + 1.0) * evaluation + newton * update + linear * iteration)
