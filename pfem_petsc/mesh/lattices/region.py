"""Values of a range of nodes that lie in the slabs of other ranks."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from ..exchange import Router
from ..slab import slab_of, slab_range

__all__ = ["Region"]


class Region:
    """The nodes [first, last) of a mesh, whose values are on the ranks of their slabs. Collective.

    Parameters
    ----------
    n : nodes of the mesh
    first, last : the range that this rank uses
    """

    def __init__(self, comm: MPI.Comm, n: int, first: int, last: int) -> None:
        self.first, self.last = first, last
        self._slab = slab_range(n, comm.rank, comm.size)
        self._shared = (max(first, self._slab[0]), min(last, self._slab[1]))
        if self._shared[0] >= self._shared[1]:
            self._shared = (first, first)
        numbers = np.concatenate([np.arange(first, self._shared[0]), np.arange(self._shared[1], last)])
        self._router = Router(comm, slab_of(numbers, n, comm.size))
        self._asked = self._router.send(numbers) - self._slab[0]
        self._comm = comm

    def fetch(self, values: np.ndarray) -> np.ndarray:
        """Return the values (last - first,) of the region from those (nodes of the slab,) of all ranks. Collective."""
        found = np.empty(self.last - self.first, values.dtype)
        low, high = self._shared
        found[low - self.first : high - self.first] = values[low - self._slab[0] : high - self._slab[0]]
        others = self._router.reply(values[self._asked])
        found[: low - self.first] = others[: low - self.first]
        found[high - self.first :] = others[low - self.first :]
        return found

    def add(self, values: np.ndarray) -> np.ndarray:
        """Return sums (nodes of the slab,) of the values (last - first,) of the regions of all ranks. Collective."""
        low, high = self._shared
        sums = np.zeros(self._slab[1] - self._slab[0], values.dtype)
        sums[low - self._slab[0] : high - self._slab[0]] = values[low - self.first : high - self.first]
        others = np.concatenate([values[: low - self.first], values[high - self.first :]])
        np.add.at(sums, self._asked, self._router.send(others))
        return sums
