"""The pattern of matrices that couple the nodes of a mesh by its bars, in blocks of 3 x 3."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from .compiled import kernel

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh


class BlockPattern:
    """Block-compressed rows of the owned nodes, with one 3 x 3 block per node and per neighbour connected by a bar.

    Parameters
    ----------
    mesh : DistributedMesh
    others : (k,) keys of further blocks, see :meth:`keys_of`

    Attributes
    ----------
    ptr : (owned + 1,) int32, first block of each block row
    columns : (blocks,) int64, PETSc node number of each block's column, ascending in a row
    slots : (b, 4) int32, blocks (a, a), (a, b), (b, b), (b, a) of each bar, -1 if the row is not owned
    diagonal : (owned,) int32, the diagonal block of each row
    """

    def __init__(self, mesh: DistributedMesh, others: np.ndarray | None = None) -> None:
        owned = mesh.n_owned
        numbers = np.concatenate([mesh.first_node + np.arange(owned, dtype=np.int64), mesh.ghost_numbers])
        a, b = mesh.bars[:, 0].astype(np.int64), mesh.bars[:, 1].astype(np.int64)
        first, second = np.flatnonzero(a < owned), np.flatnonzero(b < owned)
        n = max(mesh.n_nodes, 1)
        keys = np.concatenate(
            [
                np.arange(owned, dtype=np.int64) * n + numbers[:owned],
                a[first] * n + numbers[b[first]],
                b[second] * n + numbers[a[second]],
                *([] if others is None else [others]),
            ]
        )
        unique, place = np.unique(keys, return_inverse=True)
        place = place.astype(np.int32)
        self._keys, self._n = unique, n
        rows = unique // n
        self.columns = unique - rows * n
        self.ptr = np.zeros(owned + 1, dtype=np.int32)
        np.cumsum(np.bincount(rows, minlength=owned), out=self.ptr[1:])
        self.diagonal = place[:owned].copy()
        self.slots = np.full((len(a), 4), -1, dtype=np.int32)
        self.slots[first, 0] = self.diagonal[a[first]]
        self.slots[first, 1] = place[owned : owned + len(first)]
        self.slots[second, 2] = self.diagonal[b[second]]
        self.slots[second, 3] = place[owned + len(first) :][: len(second)]

    def keys_of(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return keys (k,) of the blocks of owned nodes (k,) and PETSc's numbers of others (k,)."""
        return rows * self._n + columns

    def scalar_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return row pointers and PETSc column numbers of the pattern in scalar compressed rows (PETSc integers)."""
        blocks = np.repeat(np.diff(self.ptr), 3)
        pointers = np.zeros(len(blocks) + 1, dtype=PETSc.IntType)
        np.cumsum(3 * blocks, out=pointers[1:])
        columns = np.empty(pointers[-1], dtype=PETSc.IntType)
        expand_columns(self.ptr, self.columns, columns)
        return pointers, columns

    def add_blocks(
        self, nodes: np.ndarray, blocks: np.ndarray, values: np.ndarray, keys: np.ndarray | None = None
    ) -> None:
        """Add blocks (k, 3, 3) to the diagonal blocks of owned nodes (k,), or to those in their rows with ``keys``."""
        ptr = self.ptr.astype(np.int64)
        start = 6 * ptr[nodes] + 3 * (self.diagonal[nodes] if keys is None else np.searchsorted(self._keys, keys))
        width = 3 * (ptr[nodes + 1] - ptr[nodes])
        for i in range(3):
            for j in range(3):
                np.add.at(values, start + i * width + j, blocks[:, i, j])


@kernel
def expand_columns(ptr, columns, out):
    """Write the columns of a matrix in scalar compressed rows; ``ptr``, ``columns``: of its blocks."""
    for row in range(len(ptr) - 1):
        width = 3 * (ptr[row + 1] - ptr[row])
        for k in range(ptr[row], ptr[row + 1]):
            at = 6 * ptr[row] + 3 * k
            for i in range(3):
                for j in range(3):
                    out[at + i * width + j] = 3 * columns[k] + j
