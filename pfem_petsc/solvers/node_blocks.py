"""Blocks of matrices at nodes whose unknowns or equations are combined."""

from __future__ import annotations

import numpy as np

from ..mechanics.compiled import kernel

__all__ = ["turn_blocks"]


@kernel
def turn_blocks(ptr, local_columns, place, left, right, values):
    """Multiply the rows of nodes by matrices ``left`` (m, 3, 3), and their columns by ``right``, from the right.

    ``ptr``, ``local_columns``, ``values``: of a :class:`~pfem_petsc.solvers.matrix.BlockPattern`; ``place`` (local,):
    of a node among the m, -1 for others.
    """
    block = np.zeros((3, 3))
    for row in range(len(ptr) - 1):
        width = 3 * (ptr[row + 1] - ptr[row])
        r = place[row]
        for k in range(ptr[row], ptr[row + 1]):
            c = place[local_columns[k]]
            if r < 0 and c < 0:
                continue
            at = 6 * ptr[row] + 3 * k
            for i in range(3):
                for j in range(3):
                    block[i, j] = values[at + i * width + j]
            if r >= 0:
                for j in range(3):
                    x, y, z = block[0, j], block[1, j], block[2, j]
                    for i in range(3):
                        block[i, j] = left[r, i, 0] * x + left[r, i, 1] * y + left[r, i, 2] * z
            if c >= 0:
                for i in range(3):
                    x, y, z = block[i, 0], block[i, 1], block[i, 2]
                    for j in range(3):
                        block[i, j] = x * right[c, 0, j] + y * right[c, 1, j] + z * right[c, 2, j]
            for i in range(3):
                for j in range(3):
                    values[at + i * width + j] = block[i, j]
