"""Mass and damping, lumped at the nodes or consistent with the linear shape functions of the bar.

The consistent mass of a bar is rho A l0 / 6 [[2, 1], [1, 2]] for each direction; its row sums are the lumped mass
rho A l0 / 2. Damping is c_m per reference volume, distributed in the same way. Masses of ``[[mass]]`` are those of
their nodes, on the diagonal of both matrices, and so are dashpots to the ground in the damping.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .compiled import kernel
from .motion import Table

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from .bars import Bars

__all__ = ["Inertia", "PointInertia", "add_at_ends", "consistent_product", "scale_rows"]


@kernel
def add_at_ends(bars, values, out):
    """Add the value (b,) of each bar at both of its ends to ``out`` (local nodes,)."""
    for k in range(len(bars)):
        out[bars[k, 0]] += values[k]
        out[bars[k, 1]] += values[k]


@kernel
def consistent_product(bars, lengths, start, stop, density, u, out):
    """Add the consistent mass matrix of a line density [kg/m], (1,) or (stop - start,), times ``u`` to ``out``;
    both (local nodes, 3)."""
    for k in range(start, stop):
        a = bars[k, 0]
        b = bars[k, 1]
        m = density[k - start if len(density) > 1 else 0] * lengths[k] / 6.0
        for i in range(3):
            out[a, i] += m * (2.0 * u[a, i] + u[b, i])
            out[b, i] += m * (u[a, i] + 2.0 * u[b, i])


class PointInertia:
    """Masses and dashpots of nodes in addition to those of their bars. A node in several tables gets their sum.

    Attributes
    ----------
    mass, damping : (owned,) [kg], [kg/s]
    any : whether the case has any, the same on all ranks
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        self.mass, self.damping = np.zeros((2, mesh.n_owned))
        for entry in case.point_mass:
            self.mass[nodes[entry.node_set]] += entry.value
            self.damping[nodes[entry.node_set]] += entry.damping * entry.value
        grounded = [entry for entry in case.dashpot if entry.node_set is not None]
        for entry in grounded:
            self.damping[nodes[entry.node_set]] += entry.coefficient
        self.any = bool(case.point_mass or grounded)

    def nodal(self, alpha: float, eta: float) -> np.ndarray:
        """Return alpha m + eta c (owned,) [N/m]."""
        return alpha * self.mass + eta * self.damping


@kernel
def scale_rows(factors, vectors, out):
    """Write each vector times its factor; NumPy takes several times as long for rows of three."""
    for i in range(len(factors)):
        for c in range(3):
            out[i, c] = factors[i] * vectors[i, c]


class Inertia:
    """Mass M [kg] and damping C [kg/s] of the nodes that this rank owns.

    Attributes
    ----------
    mass, damping : (owned,) lumped values; also the row sums of the consistent matrices
    points : PointInertia, part of ``mass`` and ``damping``
    consistent : whether products use the consistent matrices
    damped : whether the whole model has any damping, at any time
    factor : of the damping of materials at the time of the last :meth:`change`
    """

    def __init__(self, mesh: DistributedMesh, bars: Bars, consistent: bool, points: PointInertia) -> None:
        self.mesh = mesh
        self.bars = bars
        self.consistent = consistent
        self._table: Table | None = None
        self.factor = 1.0
        self.redistribution = None  # of contact nodes' masses; see pfem_petsc.contact.treatments.mass_redistribution
        mass = np.zeros(mesh.n_local)
        damping = np.zeros(mesh.n_local)
        for block in bars.blocks:
            ends, lengths = bars.ends[block.start : block.stop], bars.mass_lengths[block.start : block.stop]
            add_at_ends(ends, 0.5 * (block.density * block.area) * lengths, mass)
            if block.damping:
                add_at_ends(ends, 0.5 * (block.damping * block.area) * lengths, damping)
        self.points = points
        self.mass = mass[: mesh.n_owned] + points.mass
        self._of_bars = damping[: mesh.n_owned].copy()
        self.damping = self._of_bars + points.damping
        self.damped = bool(mesh.comm.allreduce(float(self.damping.sum())) > 0.0)
        if consistent:
            self._u = np.zeros((mesh.n_local, 3))
            self._out = np.zeros((mesh.n_local, 3))

    def vary(self, rows: tuple | None) -> None:
        """Multiply the damping of materials by rows [t, factor] over time, from here on."""
        if rows is not None:
            self._table = Table(rows)
            self.change(0.0)

    @property
    def varies(self) -> bool:
        """Whether the damping of materials is multiplied by a table over time."""
        return self._table is not None

    @property
    def largest_factor(self) -> float:
        """Largest factor of the table, 1 without one."""
        return 1.0 if self._table is None else float(self._table.values.max())

    def change(self, time: float) -> None:
        """Take the damping at a time [s], if it varies."""
        if self._table is None:
            return
        self.factor = float(self._table(time)[0])
        self.damping = self.factor * self._of_bars + self.points.damping

    def damp(self, damping: np.ndarray) -> None:
        """Replace the damping, that of dashpots included, by values of nodes (owned,). Collective."""
        self.damping, self.points.damping, self._table = damping, np.zeros_like(damping), None
        self.damped = bool(self.mesh.comm.allreduce(float(damping.sum())) > 0.0)

    @property
    def products(self) -> bool:
        """Whether M is not diagonal with one value per node, so that products need :meth:`mass_times`."""
        return self.consistent or self.redistribution is not None

    def mass_times(self, a: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Compute ``out`` = M a for owned nodes, both (owned, 3). Collective with consistent mass."""
        return self._times(a, out, 1.0, 0.0)

    def damping_times(self, v: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Compute ``out`` = C v for owned nodes, both (owned, 3). Collective with consistent mass."""
        if not self.damped:
            out[:] = 0.0
            return out
        return self._times(v, out, 0.0, 1.0)

    def _times(self, u: np.ndarray, out: np.ndarray, alpha: float, eta: float) -> np.ndarray:
        """Compute ``out`` = (alpha M + eta C) u."""
        if not self.consistent:
            scale_rows(alpha * self.mass + eta * self.damping, u, out)
            if self.redistribution is not None:
                self.redistribution.add_times(alpha, u, out)
            return out
        owned = self.mesh.n_owned
        self._u[:owned] = u
        self.mesh.update_ghosts(self._u)
        self._out[:] = 0.0
        self.add_consistent(alpha, eta, self._u, self._out)
        out[:] = self._out[:owned]
        return out

    def add_consistent(self, alpha: float, eta: float, u: np.ndarray, out: np.ndarray) -> None:
        """Add (alpha M + eta C) u of consistent matrices to the owned rows of ``out``; both (local, 3)."""
        bars, owned = self.bars, self.mesh.n_owned
        for block, coefficient in zip(bars.blocks, self.coefficients(alpha, eta), strict=True):
            density = np.atleast_1d(6.0 * coefficient)
            consistent_product(bars.ends, bars.mass_lengths, block.start, block.stop, density, u, out)
        if self.points.any:
            out[:owned] += self.points.nodal(alpha, eta)[:, None] * u[:owned]

    def coefficients(self, alpha: float, eta: float) -> list[float | np.ndarray]:
        """Return (alpha rho + eta c_m) A / 6 [kg/(m s2)] per block, the consistent part of a Hessian; or zeros.

        What :attr:`points` add to its diagonal is besides.
        """
        if not self.consistent:
            return [0.0] * len(self.bars.blocks)
        return [(alpha * b.density + eta * self.factor * b.damping) * b.area / 6.0 for b in self.bars.blocks]
