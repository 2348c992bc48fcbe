"""The pseudo-motion of dynamic relaxation: nodes with fictitious mass move towards equilibrium, losing their energy.

The pseudo-steps are explicit steps of size 1 with suitable masses. For bars with axial stiffness k and geometric
stiffness g >= 0 the energy of a displacement is at most twice that of their ends alone,
u.K u <= 2 sum_i u_i.K_ii u_i. Hence the highest frequency with masses m_i = s K_i/2, with K_i the largest eigenvalue of
the diagonal block K_ii, is at most 2/sqrt(s), the limit of central differences at s = 1. This is the choice
m = dt^2/2 S of Barnes (1999) with the smallest safe S. The bound of K_i is updated every few steps, as bars rotate and
tighten.

Damping ends the motion: see :mod:`~pfem_petsc.statics.dampings`.

Walls: positions are projected onto the region that the walls allow in each step, as in explicit time steps. The
residual of a node with the wall forces is m (P(x + r/m) - x).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..errors import SimulationFailure
from ..mechanics.bars import StrainEnergy
from ..parallel.agreement import agreed
from ..solvers.newton import Tolerance
from ..tolerances import PROJECTED
from .dampings import DAMPINGS
from .relaxation_loops import (
    BARS,
    FAILED,
    RESIDUAL,
    SUPPORTS,
    WALLS,
    WIDTH,
    add_up,
    free_residual,
    move_freely,
    node_stiffness,
    shortest_bars,
)

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["PseudoMotion"]

_SAFETY = 1.1  # s of the mass: bars turn and tighten between two estimates
_ESTIMATE_EVERY = 10  # pseudo-steps
_REACH = 0.1  # of its shortest bar: no node moves farther in a pseudo-step, so that none passes through another
_UNHURRIED = 10.0  # pseudo-steps in which a support moves as far as a node may in one: bars must turn out of its way
_SELF_STRESS = 1e-6  # of bar forces: smaller loads and reactions are none, the structure stresses itself


class PseudoMotion:
    """Moves a copy of the positions towards an equilibrium of the model. Construction is collective.

    Attributes
    ----------
    x : (local, 3) positions with ghosts [m]
    f : (local, 3) internal force there [N]
    v : (owned, 3) pseudo-velocity [m per step]
    residual : (owned, 3) unbalanced force [N]
    contact : (owned, 3) force of walls [N]; ``walls`` their sums, ``held`` the nodes in contact
    mass : (owned,) [N/m]: the pseudo-step is 1
    energy : StrainEnergy at ``x``
    sums : (9,) see :data:`~pfem_petsc.statics.relaxation_loops.RESIDUAL`
    steps : pseudo-steps since :meth:`begin`
    """

    def __init__(self, model: Model, damping: str) -> None:
        self.model = model
        mesh = model.mesh
        owned, local = mesh.n_owned, mesh.n_local
        self.x, self.f = np.zeros((local, 3)), np.zeros((local, 3))
        self.v, self.residual = np.zeros((owned, 3)), np.zeros((owned, 3))
        self.contact, self.walls = np.zeros((owned, 3)), model.contact.nothing
        self.held = np.empty(0, dtype=np.int64)
        self.external = np.zeros((owned, 3))
        self.mass = np.ones(owned)
        self.energy = StrainEnergy()
        self.steps = 0
        self.time = 0.0
        self.sums = np.zeros(WIDTH)
        self.damping = DAMPINGS[damping]()
        self._u = np.zeros((owned, 3))
        self._stored = np.zeros((5, len(mesh.bars)))
        self._axial = np.empty(len(mesh.bars))
        for block in model.bars.blocks:
            part = slice(block.start, block.stop)
            self._axial[part] = block.area * block.modulus / model.bars.rest[part]
        self._counted = np.zeros(len(mesh.bars), dtype=bool)
        self._counted[mesh.counted] = True
        self._blocks = np.zeros((local, 6))
        reach = np.full(local, np.inf)
        shortest_bars(mesh.bars, model.bars.rest, _REACH, reach)
        self._reach = reach[:owned].copy()
        self._tolerance = PROJECTED * model.size
        self._failure: SimulationFailure | None = None
        self._external_norm = 0.0

    def begin(self, state: State, time: float, external: np.ndarray) -> None:
        """Start from the positions of a state, at rest, for the loads (owned, 3) [N] of a load factor. Collective."""
        owned, supports = self.model.mesh.n_owned, self.model.supports
        self.x[:owned] = state.position
        self.time, self.external, self.steps = time, external, 0
        self._lead_supports(supports.coordinates(state.position), supports.positions(time))
        self.v[:] = 0.0
        self._external_norm = float(np.sqrt(self.model.comm.allreduce(float((external**2).sum()))))
        self.damping.begin(self)
        self._evaluate()

    def _lead_supports(self, start: np.ndarray, end: np.ndarray) -> None:
        """Move prescribed components (k,) to their positions in enough pseudo-steps to avoid crushed bars."""
        supports = self.model.supports
        self._start, self._end, self._arrival = start, end, 0
        if supports.any:
            needed = float((np.abs(end - start) / self._reach[supports.every_node]).max(initial=0.0))
            self._arrival = int(np.ceil(_UNHURRIED * self.model.comm.allreduce(needed, op=MPI.MAX)))
            self._place_supports()

    def _place_supports(self) -> None:
        part = min(self.steps / self._arrival, 1.0) if self._arrival else 1.0
        places = self._end if part == 1.0 else self._start + part * (self._end - self._start)
        self.model.supports.place(self.x[: self.model.mesh.n_owned], places)

    @property
    def load(self) -> float:
        """Reference of the residual [N]: 2-norm of loads or reactions, or of bar forces if there are none."""
        acting = max(self._external_norm, float(np.sqrt(self.sums[SUPPORTS] + self.sums[WALLS])))
        bars = float(np.sqrt(self.sums[BARS]))
        return acting if acting > _SELF_STRESS * bars else bars

    @property
    def norm(self) -> float:
        """2-norm of the residual [N]."""
        return float(np.sqrt(self.sums[RESIDUAL]))

    def balanced(self, tolerance: float) -> bool:
        """Return whether the residual is at most a fraction of the load, or rounding. Collective."""
        model, required = self.model, tolerance * self.load
        if self.norm <= required:
            return True
        rounding = Tolerance(required, required, model.node_rounding, model.rounding)
        return rounding.rounded(self.norm, self.residual, 1.0, model.comm)

    def relax(self, tolerance: float, most: int) -> bool:
        """Move until the residual is ``tolerance`` of the load, or ``most`` pseudo-steps are made. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, for collapsed bars, infeasible walls, or positions that are not finite.
        """
        while self.steps < self._arrival or not self.balanced(tolerance):
            if self.steps >= most:
                return False
            self.damping.move(self)
            self.steps += 1
            if self.steps <= self._arrival:
                self._place_supports()
            self._evaluate()
        return True

    def shift(self, keep: float, push: float, step: float) -> None:
        """Compute v = keep v + push residual/m, x = x + step v, both with the constraints of walls."""
        owned = self.model.mesh.n_owned
        u = self._u
        move_freely(self.residual, self.mass, keep, push, step, self._reach, self.v, u)
        if self.model.contact.any:
            self._project(u)
            np.divide(u, step, out=self.v)
        self.x[:owned] += u

    def go_back(self, u: np.ndarray) -> None:
        """Subtract (owned, 3) from the positions [m]; the next step projects them onto the walls again."""
        self.x[: self.model.mesh.n_owned] -= u

    def _project(self, u: np.ndarray) -> None:
        """Project increments (owned, 3) from ``x`` onto the walls, and store the forces."""
        owned, contact = self.model.mesh.n_owned, self.model.contact
        try:
            self.held, force, self.walls = contact.explicit(self.x[:owned], u, self.mass, self.time, self._tolerance)
        except SimulationFailure as failure:
            self._failure = self._failure or failure
            return
        self.contact[:] = 0.0
        self.contact[self.held] = force

    def _evaluate(self) -> None:
        """Compute forces, residual and sums at the positions."""
        model = self.model
        model.mesh.update_ghosts(self.x)
        self.energy = model.bars.forces(self.x, self.f, commit=False)
        sums = np.zeros(WIDTH)
        if self.steps % _ESTIMATE_EVERY == 0:
            self._estimate()
        sums[BARS] = self._bar_forces
        sums[SUPPORTS] = free_residual(self.external, self.f, model.supports.fixed, self.residual)
        if model.supports.inclined is not None:
            sums[SUPPORTS] += (model.supports.inclined.get(self.residual) ** 2).sum()
            model.supports.inclined.clear(self.residual)
        if model.contact.any:
            u = self.residual / self.mass[:, None]
            self._project(u)
            np.multiply(u, self.mass[:, None], out=self.residual)
            sums[WALLS] = (self.contact**2).sum()
        add_up(self.residual, self.v, self.mass, sums[:SUPPORTS])
        sums[FAILED] = self.energy.failed >= 0 or self._failure is not None or not np.isfinite(sums).all()
        if model.comm.size > 1:
            model.comm.Allreduce(MPI.IN_PLACE, sums)
        self.sums = sums
        if sums[FAILED]:
            self._fail()

    def _estimate(self) -> None:
        """Compute masses at the current positions."""
        model = self.model
        bars = model.bars
        bars.linearise(self.x, 1.0, self._stored)
        self._bar_forces = node_stiffness(
            self.x, bars.ends, self._stored, self._axial, self._counted, self._blocks, self.mass
        )
        self.mass *= 0.5 * _SAFETY
        # a node without bars has no stiffness of its own
        self.mass[self.mass == 0.0] = 1.0

    def _fail(self) -> None:
        """Raise on all ranks a failure of any rank."""
        model, when = self.model, f"load factor {self.time:.6g}, pseudo-step {self.steps}"
        with agreed(model.comm):
            if self._failure is not None:
                raise SimulationFailure(f"{when}: {self._failure}")
            if self.energy.failed >= 0:
                bar = model.mesh.bar_ids[self.energy.failed]
                raise SimulationFailure(
                    f"{when}: bar {bar} collapsed to zero length: the load crushes it; reduce the load or static.step"
                )
            if not np.isfinite(self.x).all() or not np.isfinite(self.f).all():
                raise SimulationFailure(f"{when}: positions or forces are not finite; reduce static.step")
        raise SimulationFailure(f"{when}: sums of forces overflow double precision; correct loads and stiffness")

    def worst(self) -> tuple[float, int]:
        """Return the largest residual of a node [N], and its mesh number. Collective."""
        size = np.linalg.norm(self.residual, axis=1)
        mine = (0.0, -1)
        if len(size):
            at = int(np.argmax(size))
            mine = (float(size[at]), int(self.model.mesh.node_ids[at]))
        return max(self.model.comm.allgather(mine))

    def potential(self, x: np.ndarray, energy: StrainEnergy) -> tuple[float, float]:
        """Return the strain energy minus the work of the loads from the current positions to ``x`` (owned, 3), and the
        sum of their magnitudes [J]. Collective."""
        works = self.external * (x - self.x[: len(x)])
        sums = np.array([energy.total - works.sum(), abs(energy.total) + np.abs(works).sum()])
        self.model.comm.Allreduce(MPI.IN_PLACE, sums)
        return float(sums[0]), float(sums[1])
