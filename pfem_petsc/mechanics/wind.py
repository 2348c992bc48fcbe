"""Drag of bars in wind: per length rho C_d d |w| w/2, with w the relative velocity across the bar.

For a bar with the current direction t, whose middle moves at v in a fluid of velocity U, w = (I - t t^T)(U - v): the
component along the bar has no drag (the cross-flow principle for yawed cylinders; S. F. Hoerner, Fluid-Dynamic Drag,
1965, ch. 3). Each end of a bar of length l gets half of the force rho C_d d l |w| w/2. With an angle b between bar and
flow this is rho C_d d (l sin b) (U sin b) U/2 across the bar: drag of its projected length.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..case.tables import VaryingWind
from .compiled import kernel
from .sections import bar_shapes
from .state_forces import ForceState
from .time_tables import Table

if TYPE_CHECKING:
    from ..case.schema import Case
    from .bars import Bars

__all__ = ["Wind"]


@kernel
def _add_drag(bars, x, v, factor, wind, owned, out):
    """Add the drag of bars at positions and velocities (local, 3) to the forces ``out`` (owned, 3) of their ends."""
    for k in range(len(bars)):
        a, b = bars[k, 0], bars[k, 1]
        tx, ty, tz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        length = (tx * tx + ty * ty + tz * tz) ** 0.5
        if factor[k] == 0.0 or length == 0.0:
            continue
        tx, ty, tz = tx / length, ty / length, tz / length
        wx = wind[0] - 0.5 * (v[a, 0] + v[b, 0])
        wy = wind[1] - 0.5 * (v[a, 1] + v[b, 1])
        wz = wind[2] - 0.5 * (v[a, 2] + v[b, 2])
        along = wx * tx + wy * ty + wz * tz
        wx, wy, wz = wx - along * tx, wy - along * ty, wz - along * tz
        f = factor[k] * length * (wx * wx + wy * wy + wz * wz) ** 0.5
        for end in (a, b):
            if end < owned:
                out[end, 0] += f * wx
                out[end, 1] += f * wy
                out[end, 2] += f * wz


class Wind:
    """The drag of all bars; a :class:`~pfem_petsc.mechanics.state_forces.StateForce`.

    Attributes
    ----------
    held : (3,) velocity at the start of a stage that does not give its own [m/s], None for none
    """

    failure = None

    def __init__(self, case: Case, bars: Bars) -> None:
        wind = case.wind
        self.held: np.ndarray | None = None
        self._holds = case.holds("wind")
        self._table, self._constant = None, np.zeros(3)
        if isinstance(wind, VaryingWind):
            self._table = Table(wind.velocity, wind.interpolation == "smooth")
        else:
            self._constant = np.array(wind.velocity, dtype=np.float64)
        mesh = bars.mesh
        self._bars, self._mesh, self._rate = bars, mesh, 0.0
        self._factor = np.zeros(len(mesh.bars))
        for block in bars.blocks:
            if block.section not in case.section:  # springs and dashpots
                continue
            section, part = case.section[block.section], slice(block.start, block.stop)
            rest = bars.rest[part]
            diameter = section.diameter
            if diameter is None:
                diameter = 2.0 * bar_shapes(section, rest, np.full_like(rest, block.area)).radius
            coefficient = wind.drag_coefficient if section.drag_coefficient is None else section.drag_coefficient
            self._factor[part] = 0.25 * wind.density * coefficient * diameter
            # dF/dw over the mass of the bar, for w = 1 m/s
            most = float(np.max(4.0 * self._factor[part] / (block.density * block.area), initial=0.0))
            self._rate = max(self._rate, most)
        self._x, self._v = np.zeros((mesh.n_local, 3)), np.zeros((mesh.n_local, 3))

    def velocity(self, time: float) -> np.ndarray:
        """Return the velocity of the wind (3,) [m/s] at a time [s]."""
        if self._holds and self.held is not None:
            return self.held
        return self._constant if self._table is None else self._table(time)

    def add(self, time: float, state: ForceState, out: np.ndarray) -> None:
        """Add the drag at a time [s] to ``out`` (owned, 3) [N]. Collective."""
        owned = self._mesh.n_owned
        for local, given in ((self._x, state.position), (self._v, state.v)):
            local[:owned] = given
            self._mesh.update_ghosts(local)
        # the share of a bar that is left has its drag: the ends of a broken bar may be far from each other
        left = 1.0 - np.abs(self._bars.rupture()) if self._bars.can_break else 1.0
        _add_drag(self._mesh.bars, self._x, self._v, self._factor * left, self.velocity(time), owned, out)

    def rate(self, speed: float) -> float:
        """Return the largest rate [1/s] of a bar's drag over its velocity and mass, at a speed [m/s]. Collective."""
        return max(self._mesh.comm.allgather(self._rate)) * speed

    def fastest(self) -> float:
        """Largest speed of the wind [m/s]."""
        if self._holds and self.held is not None:
            return float(np.linalg.norm(self.held))
        rows = self._constant if self._table is None else self._table.values
        return float(np.linalg.norm(np.atleast_2d(rows), axis=1).max())
