"""What all elements share: strain measures, what elements besides bars do, and loops over bars that know no law."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numba.extending import register_jitable
from petsc4py import PETSc
from scipy.sparse import bsr_array

from .compiled import inlined, kernel

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

COLLAPSED_STRETCH = 1e-3  # below this fraction of its rest length a bar is crushed, and no truss model applies
SHORTENED_STRETCH = math.sqrt(0.8)  # only bars shorter than this are checked for passing through zero length


@register_jitable
def engineering(stretch: float) -> tuple[float, float, float]:
    """Return the engineering strain l/l0 - 1 and its derivatives."""
    return stretch - 1.0, 1.0, 0.0


@register_jitable
def green(stretch: float) -> tuple[float, float, float]:
    """Return Green's strain ((l/l0)^2 - 1)/2 and its derivatives."""
    return 0.5 * (stretch * stretch - 1.0), stretch, 1.0


@register_jitable
def logarithmic(stretch: float) -> tuple[float, float, float]:
    """Return the logarithmic strain ln(l/l0) and its derivatives."""
    return math.log(stretch), 1.0 / stretch, -1.0 / (stretch * stretch)


MEASURES = {"engineering": engineering, "green": green, "logarithmic": logarithmic}
ENGINEERING, GREEN, LOGARITHMIC = range(3)  # their numbers in compiled loops


@register_jitable
def measured(measure: int, stretch: float) -> tuple[float, float, float]:
    """Return the strain of a measure by its number, and its derivatives."""
    if measure == ENGINEERING:
        return engineering(stretch)
    return green(stretch) if measure == GREEN else logarithmic(stretch)


@register_jitable
def mean_ratio(measure: int, s0: float, s1: float) -> tuple[float, float]:
    """Return L^2 R and L^2 dR/ds1 of a measure for the stretches s0 = l0/L, s1 = l1/L."""
    if measure == ENGINEERING:
        return 2.0 / (s0 + s1), -2.0 / ((s0 + s1) * (s0 + s1))
    if measure == GREEN:
        return 1.0, 0.0
    q = s1 / s0 - 1.0
    if abs(q) < 1e-4:
        # ln(1+q)/(q (1 + q/2)) = 1 - q + 5/6 q^2 - 2/3 q^3 + ...
        value = 1.0 - q * (1.0 - q * (5.0 / 6.0 - q * (2.0 / 3.0)))
        slope = -1.0 + q * (5.0 / 3.0 - 2.0 * q)
    else:
        bottom = q * (1.0 + 0.5 * q)
        value = math.log1p(q) / bottom
        slope = (1.0 / (1.0 + q) - value * (1.0 + q)) / bottom
    return value / (s0 * s0), slope / (s0 * s0 * s0)


class ForceElements(Protocol):
    """Elements besides the bars whose forces :class:`~pfem_petsc.mechanics.bars.Bars` adds up, such as bars that touch.

    Each rank adds what acts on the nodes that it owns.

    Attributes
    ----------
    energies : names of their energies, of :data:`~pfem_petsc.columns.BAR_ENERGIES`
    """

    energies: tuple[str, ...]

    def add_forces(self, x: np.ndarray, f: np.ndarray, commit: bool) -> tuple[float, ...]:
        """Add the internal forces at positions ``x`` to ``f``, both (local, 3); return the energies [J]. What elements
        remember is updated only if ``commit``."""

    def add_step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Add the discrete gradient of a step from ``x0`` to ``x``, whose work is the change of the energy."""


class ElementFamily(ForceElements, Protocol):
    """Elements with forces and stiffness, such as springs to the ground. The stiffness is that at the positions of the
    last forces."""

    def add_product(self, weight: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add ``weight`` times the stiffness times ``u`` to ``out``, with a row for each owned node at least."""

    def add_tangents(self, weight: float, pattern: Any, values: np.ndarray) -> None:
        """Add ``weight`` times the stiffness to the values of a matrix with a ``BlockPattern``."""


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
        shape = 3 * (len(self.ptr) - 1), 3 * self._n
        rows = bsr_array((np.zeros((len(self.columns), 3, 3), np.int8), self.columns, self.ptr), shape=shape).tocsr()
        return rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType)

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


class MatrixRows(NamedTuple):
    """Where bars add blocks to a matrix in compressed rows, see :class:`~.elements.BlockPattern`:
    ``ptr`` (owned + 1,), ``slots`` (b, 4), ``values``; ``ends`` (b, 2) of the bars."""

    ptr: np.ndarray
    slots: np.ndarray
    values: np.ndarray
    ends: np.ndarray


@inlined
def _add_blocks(rows, k, c, d, n, g, mass):
    """Add the stiffness c d n^T + g I of a bar, and its inertia, to the rows of its owned ends."""
    values = rows.values
    for side in range(4):
        slot = rows.slots[k, side]
        if slot < 0:
            continue
        row = rows.ends[k, side // 2]
        sign = 1.0 if side % 2 == 0 else -1.0
        at = 6 * rows.ptr[row] + 3 * slot
        wide = 3 * (rows.ptr[row + 1] - rows.ptr[row])
        factor = sign * c
        diagonal = sign * g + (2.0 * mass if side % 2 == 0 else mass)
        for i in range(3):
            for j in range(3):
                part = factor * d[i] * n[j]
                values[at + i * wide + j] += part + diagonal if i == j else part


@inlined
def end_difference(x, ends, k):
    """Return the end difference (dx, dy, dz) of a bar."""
    a = ends[k, 0]
    b = ends[k, 1]
    return x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]


@kernel
def add_tangents(x, stored, inertia, rows):
    """Add the stiffness ``stored`` (2, b) of bars, see ``Bars.stiffnesses``, and ``inertia`` (b,) [kg/s2], which is
    added twice on the diagonal and once off it, to the rows of a matrix."""
    for k in range(len(rows.ends)):
        d = end_difference(x, rows.ends, k)
        _add_blocks(rows, k, stored[0, k], d, d, stored[1, k], inertia[k])


@kernel
def add_step_tangents(x0, x, coefficients, weight, inertia, rows):
    """Add ``weight`` times the derivative of the forces of steps, not symmetric; ``coefficients``: of
    :func:`~.internal_forces.step_coefficients`."""
    for k in range(len(rows.ends)):
        d0, d = end_difference(x0, rows.ends, k), end_difference(x, rows.ends, k)
        middle = (0.5 * (d0[0] + d[0]), 0.5 * (d0[1] + d[1]), 0.5 * (d0[2] + d[2]))
        c, dc = coefficients[0, k], coefficients[1, k]
        _add_blocks(rows, k, weight * dc, middle, d, weight * 0.5 * c, inertia[k])


@kernel
def add_step_forces(x0, x, ends, coefficients, f):
    """Add the forces of a step with ``coefficients`` (2, b) to ``f`` (local, 3)."""
    for k in range(len(ends)):
        a, b = ends[k, 0], ends[k, 1]
        d0, d = end_difference(x0, ends, k), end_difference(x, ends, k)
        for i in range(3):
            force = coefficients[0, k] * (0.5 * (d0[i] + d[i]))
            f[a, i] -= force
            f[b, i] += force


@kernel
def bar_lengths(points, bars, lengths):
    """Write the lengths (b,) of bars (b, 2) between points (n, 3)."""
    for k in range(len(bars)):
        dx, dy, dz = end_difference(points, bars, k)
        lengths[k] = (dx * dx + dy * dy + dz * dz) ** 0.5


@kernel
def first_inverted(x, before, bars, rest):
    """Return the first shortened bar whose direction has reversed, or -1; those with zero ``rest`` are not checked."""
    for k in range(len(bars)):
        dx, dy, dz = end_difference(x, bars, k)
        if dx * dx + dy * dy + dz * dz < 0.8 * rest[k] * rest[k]:
            ax, ay, az = end_difference(before, bars, k)
            if dx * ax + dy * ay + dz * az < 0.0:
                return k
    return -1
