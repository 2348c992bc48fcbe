"""Unique vectors of the lowest eigenvalues, the same on any number of ranks.

Eigenvalue solvers return an arbitrary basis of a repeated eigenvalue, with arbitrary signs. Here the basis depends on
the space only: its first vectors are the nonzero projections of the rigid motions (translations along x, y, z,
rotations about them), the next have the largest component that a vector of the space can have. The largest component of
each shape, the first in mesh numbering if there are several, is positive.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

__all__ = ["Basis"]

_EQUAL = 1e-9  # relative difference below which eigenvalues count as equal
_TIE = 1e-6  # relative difference below which components count as equal
_SEEN = 1e-3  # smallest projection of a unit rigid motion on a space that is used


class Basis:
    """Makes vectors unique, given each rank's components.

    Parameters
    ----------
    comm : MPI.Comm
    numbers : (owned,) mesh numbers of the nodes
    points : (owned, 3) [m]
    mass : (owned,) lumped mass [kg], the weight of the projections
    """

    def __init__(self, comm: MPI.Comm, numbers: np.ndarray, points: np.ndarray, mass: np.ndarray) -> None:
        self._comm, self._mass = comm, mass
        self._places = (3 * numbers[:, None] + np.arange(3)).ravel()
        sums = comm.allreduce(np.append(mass @ points, mass.sum()))
        arms = points - sums[:3] / sums[3]
        translations = np.broadcast_to(np.eye(3)[:, None], (3, len(numbers), 3))
        rotations = np.stack([np.cross(axis, arms) for axis in np.eye(3)])
        self._motions = np.concatenate([translations, rotations])

    def unique(self, values: np.ndarray, shapes: np.ndarray, zero: float) -> np.ndarray:
        """Make B-orthonormal shapes (k, owned, 3) of ascending eigenvalues (k,) unique. Collective.

        ``zero`` : difference of eigenvalues within rounding.
        """
        shapes, first = shapes.copy(), 0
        while first < len(values):
            last = first + 1
            while last < len(values) and same(values[last - 1], values[last], zero):
                last += 1
            if last > first + 1:
                turn = self._basis(shapes[first:last])
                shapes[first:last] = np.einsum("ij,jnc->inc", turn, shapes[first:last])
            first = last
        return shapes * self._signs(shapes)[:, None, None]

    def _basis(self, space: np.ndarray) -> np.ndarray:
        """Return the orthogonal matrix whose rows are the new basis in terms of the given one. Collective."""
        weighted = space * self._mass[:, None]
        mine = np.concatenate(
            [np.einsum("knc,mnc->mk", weighted, self._motions), [np.einsum("knc,knc->k", weighted, space)]]
        )
        lengths = np.einsum("mnc,n,mnc->m", self._motions, self._mass, self._motions)
        total = self._comm.allreduce(np.append(mine.ravel(), lengths))
        mine, lengths = total[: mine.size].reshape(mine.shape), total[mine.size :]
        largest = np.sqrt(mine[-1].max())
        rows: list[np.ndarray] = []
        for motion, length in zip(mine[:-1], lengths, strict=True):
            rest = _without(motion, rows)
            if len(rows) < len(space) and np.linalg.norm(rest) > _SEEN * np.sqrt(length) * largest:
                rows.append(rest / np.linalg.norm(rest))
        while len(rows) < len(space):
            rest = _without(self._peak(space, rows), rows)
            rows.append(rest / np.linalg.norm(rest))
        return np.array(rows)

    def _peak(self, space: np.ndarray, rows: list[np.ndarray]) -> np.ndarray:
        """Return coefficients (k,) of the vector orthogonal to ``rows`` with the largest component. Collective."""
        left = np.eye(len(space)) - sum((np.outer(row, row) for row in rows), np.zeros((len(space),) * 2))
        components = left @ space.reshape(len(space), len(self._places))
        at = self._first_largest(np.sqrt((components**2).sum(axis=0)))
        return self._comm.allreduce(components[:, at].copy() if at >= 0 else np.zeros(len(space)))

    def _signs(self, shapes: np.ndarray) -> np.ndarray:
        signs = np.zeros(len(shapes))
        for k in range(len(shapes)):
            shape = shapes[k].ravel()
            at = self._first_largest(np.abs(shape))
            signs[k] = np.sign(shape[at]) if at >= 0 else 0.0
        self._comm.Allreduce(MPI.IN_PLACE, signs)
        return np.where(signs < 0.0, -1.0, 1.0)

    def _first_largest(self, sizes: np.ndarray) -> int:
        """Return the local index of the largest value of all ranks, the first in mesh numbering; -1 elsewhere."""
        largest = self._comm.allreduce(float(sizes.max(initial=0.0)), op=MPI.MAX)
        near = np.flatnonzero(sizes >= (1.0 - _TIE) * largest)
        none = np.iinfo(np.int64).max
        first = int(self._places[near].min()) if len(near) else none
        winner = self._comm.allreduce(first, op=MPI.MIN)
        if first != winner or not len(near):
            return -1
        return int(near[np.argmin(self._places[near])])


def same(one: float, other: float, zero: float) -> bool:
    """Return whether two eigenvalues are equal up to rounding."""
    if not np.isfinite(one) or not np.isfinite(other):
        return one == other
    return abs(other - one) <= max(zero, _EQUAL * max(abs(one), abs(other)))


def _without(vector: np.ndarray, rows: list[np.ndarray]) -> np.ndarray:
    for _ in range(2):
        for row in rows:
            vector = vector - (row @ vector) * row
    return vector
