"""All bars of a rank, in blocks of one section each, evaluated by the compiled loops of their material."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..energies import BAR_ENERGIES
from ..fields import STATUS
from .bar_blocks import BarBlock, laws_of, make_blocks
from .bar_geometry import bar_lengths, first_inverted
from .materials.base import internal_variables
from .sections import bar_shapes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..solvers.matrix import BlockPattern
    from .materials.base import BarShapes
    from .springs import Springs

__all__ = ["Bars", "StrainEnergy"]

_LOADING = 1e-8  # relative change of all lengths that distinguishes the tangents of loading and unloading
_KINK = 1e-6  # relative difference of these tangents above which the bar is at a kink of its law

_OF_SPRINGS = BAR_ENERGIES.index("spring_energy")


class StrainEnergy(NamedTuple):
    """Sums over the bars counted on this rank, and its springs, in the order of
    :data:`~pfem_petsc.energies.BAR_ENERGIES` [J], the first collapsed bar (local index, -1: none), whether any bar is
    so short that it may be inverted, and how many local bars have changed their state of rupture."""

    energies: tuple[float, ...] = (0.0,) * len(BAR_ENERGIES)
    failed: int = -1
    shortened: bool = False
    changed: int = 0

    def of(self, name: str) -> float:
        """Return the energy of a name [J]."""
        return self.energies[BAR_ENERGIES.index(name)]

    @property
    def total(self) -> float:
        """Stored and dissipated energy [J]."""
        return sum(self.energies)


class Bars:
    """Internal forces, tangents and energies of the bars of this rank.

    Attributes
    ----------
    ends : (b, 2) int32, local node indices of each bar
    far : (b,) uint32, the end of each bar with the larger index
    mesh_lengths : (b,) float64, lengths in the mesh [m], which determine mass and damping
    rest : (b,) float64, rest lengths [m]: the same array where no section prescribes them
    rest_at_start : (b,) the same at the start of the step, or (0,) if they are constant
    heat : (2, b) thermal strains and temperatures [K], or (2, 0) without temperatures
    heat_at_start : the same at the start of the step, if they vary
    can_break : whether bars of the case can leave the model
    step : time from the start of the step to the evaluated positions [s]; 0 at the start of a run, infinite in static
        analyses
    internal : name and unit of the internal variables of all laws of the case
    kept_names : names of all data that laws keep from step to step, the same on all ranks
    blocks : bars by section
    viscous : whether bars of the case have a viscous stress, the same on all ranks
    viscous_blocks : those of them on this rank
    springs : from nodes to the ground, whose forces and stiffness are added to those of the bars; None without
    """

    springs: Springs | None = None

    def __init__(self, mesh: DistributedMesh, case: Case) -> None:
        self.mesh, self.case = mesh, case
        self.ends = mesh.bars
        self.mesh_lengths = np.empty(len(mesh.bars))
        bar_lengths(mesh.points, mesh.bars, self.mesh_lengths)
        self.rest = self.mesh_lengths
        self.rest_at_start = np.empty(0)
        self.heat = np.empty((2, 0))
        self.heat_at_start = self.heat
        self.step = 0.0
        self.internal = internal_variables(case.material)
        self.blocks = make_blocks(mesh, case, self.mesh_lengths)
        self.viscous_blocks = [block for block in self.blocks if block.law.known_rate >= 0]
        laws = laws_of(case).values()
        self.can_break = any(law.rupture >= 0 for law in laws)
        self.viscous = any(law.known_rate >= 0 for law in laws)
        self._watched = np.empty(len(mesh.bars) if self.can_break else 0)
        self.kept_names = list(dict.fromkeys(name for law in laws for name, _ in law.rows))
        # loops over diagonal runs know the ends from those of the first bar
        count = 0 if all(block.sweep.diagonal.all() for block in self.blocks) else len(mesh.bars)
        self.far = np.empty(count, dtype=np.uint32)
        np.maximum(mesh.bars[:count, 0], mesh.bars[:count, 1], out=self.far, casting="unsafe")

    @property
    def slackens(self) -> bool:
        """Whether bars of the case can be slack, the same on all ranks."""
        return "slack" in self.internal

    @property
    def has_status(self) -> bool:
        """Whether bars of the case can have another status than intact, the same on all ranks."""
        return self.slackens or self.can_break

    def slack_count(self) -> int:
        """Return the number of counted bars that are slack."""
        slack = self.status() == STATUS.index("slack")
        return sum(int(np.count_nonzero(slack[b.start : b.counted])) for b in self.blocks)

    def status(self) -> np.ndarray:
        """Return the status (b,) of each local bar, of :data:`~pfem_petsc.fields.STATUS`."""
        status = np.full(len(self.ends), float(STATUS.index("intact")))
        for block in self.blocks:
            if block.law.slack_row >= 0:
                slack = block.history[block.law.slack_row] != 0.0
                status[block.start : block.stop][slack] = STATUS.index("slack")
        if self.can_break:
            status[self.rupture() != 0.0] = STATUS.index("broken")
        return status

    def _arguments(self, x: np.ndarray, block: BarBlock) -> tuple:
        law = (block.parameters, block.area, self.step, block.history)
        return (x, self.ends, self.rest, self.heat, *law)

    def forces(self, x: np.ndarray, f: np.ndarray, commit: bool) -> StrainEnergy:
        """Compute internal forces ``f`` (local nodes, 3) [N] at positions ``x``; valid for owned nodes. Internal
        variables are updated only if ``commit``."""
        f[:] = 0.0
        energies = np.zeros(len(BAR_ENERGIES))
        failed, shortened, changed = -1, False, 0
        for block in self.blocks:
            law = (block.parameters, block.area, self.step, block.history)
            part = np.zeros(len(BAR_ENERGIES))
            at, short, broke = block.kernels.forces(
                x, block.sweep, self.far, self.rest, self.heat, *law, commit, f, part
            )
            energies += part
            shortened |= short
            changed += broke
            if failed < 0:
                failed = at
        if self.springs is not None:
            energies[_OF_SPRINGS] = self.springs.add_forces(x, f)
        return StrainEnergy(tuple(energies.tolist()), failed, shortened, changed)

    def set_rates(self, x0: np.ndarray, x: np.ndarray, v: np.ndarray, eta: float) -> None:
        """Give viscous bars the strain rate at the positions x + dx with the velocities v + eta dx, linear in the
        strain; all (local nodes, 3), with ghosts, and ``x0`` at the start of the step. ``x`` is held fixed for eta = 0.
        """
        for block in self.viscous_blocks:
            geometry = (self.ends, self.rest, self.heat)
            block.kernels.rates(x0, x, v, *geometry, eta, self.step, block.history, block.start, block.stop)
            if self.step > 0.0:
                block.parameters = (*block.parameters[:-1], eta * self.step)

    @contextmanager
    def without_rates(self) -> Iterator[None]:
        """Evaluate bars at rest: laws with a rate have the step zero, and there is no viscous stress."""
        step, kept = self.step, [block.history[block.law.known_rate].copy() for block in self.viscous_blocks]
        self.step = 0.0
        self.forget_rates()
        try:
            yield
        finally:
            self.step = step
            for block, rates in zip(self.viscous_blocks, kept, strict=True):
                block.history[block.law.known_rate] = rates

    def forget_rates(self) -> None:
        """Set the known strain rates of viscous bars to zero."""
        for block in self.viscous_blocks:
            block.history[block.law.known_rate] = 0.0

    def keep_start(self) -> None:
        """Store temperatures and rest lengths as those of the start of the next step."""
        self.heat_at_start[:] = self.heat
        if len(self.rest_at_start):
            self.rest_at_start[:] = self.rest

    def first_inverted(self, x: np.ndarray, before: np.ndarray) -> int:
        """Return the first local bar that passed through zero length from positions ``before`` to ``x``, or -1.

        Lengths alone do not show this, because a bar can jump over zero in one step. Stretched bars are not checked.
        """
        return first_inverted(x, before, self.ends, self.watched)

    def tangents(
        self, x: np.ndarray, weight: float, inertia: list[float], pattern: BlockPattern, values: np.ndarray
    ) -> None:
        """Add ``weight`` K_t(x) and the consistent inertia (a coefficient per block) to the values of a matrix."""
        for block, m in zip(self.blocks, inertia, strict=True):
            block.kernels.tangents(
                *self._arguments(x, block),
                block.start,
                block.stop,
                m,
                self.mesh_lengths,
                weight,
                pattern.ptr,
                pattern.slots,
                values,
            )
        if self.springs is not None:
            self.springs.add_tangents(weight, pattern, values)

    def linearise(self, x: np.ndarray, weight: float, stored: np.ndarray) -> None:
        """Fill ``stored`` (5, b) with n, dN/dl - N/l [N/m] and N/l [N/m], times ``weight``, for each bar at ``x``;
        without springs."""
        for block in self.blocks:
            block.kernels.linearise(*self._arguments(x, block), block.start, block.stop, weight, stored)

    def state_stiffness(self, x: np.ndarray) -> np.ndarray:
        """Return the stiffness of the bars (5, b) in the state at ``x``, as :meth:`linearise`.

        If the law has a kink at the state, as on the yield surface, dN/dl is the larger one, that of unloading: small
        motions about the state do not yield further. The strain rate has no effect.
        """
        stored, *around = np.zeros((3 if self.kept_names else 1, 5, len(self.rest)))
        with self.without_rates():
            self.linearise(x, 1.0, stored)
            for sign, side in zip((-1.0, 1.0), around, strict=False):
                self.linearise((1.0 + sign * _LOADING) * x, 1.0, side)
        if around:
            tangent = stored[3] + stored[4]
            larger = np.maximum(*(side[3] + side[4] for side in around))
            kink = larger - tangent > _KINK * np.abs(larger)
            stored[3, kink] = (larger - stored[4])[kink]
        return stored

    def stiffnesses(self, x: np.ndarray, weight: float, stored: np.ndarray) -> None:
        """Fill ``stored`` (2, b) with c = (dN/dl - N/l)/l^2 [N/m3] and g = N/l [N/m], times ``weight``: the stiffness
        of a bar with end difference d is c d d^T + g I; without springs."""
        for block in self.blocks:
            law = (block.parameters, block.area, self.step, block.history)
            block.kernels.stiffnesses(x, block.sweep, self.far, self.rest, self.heat, *law, weight, stored)

    def step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Compute discrete-gradient forces ``f`` (local nodes, 3) [N] of a step from ``x0`` to ``x``."""
        f[:] = 0.0
        for block in self.blocks:
            arguments = self._arguments(x, block)
            block.conserving.forces(x0, self.heat_at_start, self.rest_at_start, *arguments, block.start, block.stop, f)
        if self.springs is not None:
            self.springs.add_step_forces(x0, x, f)

    def step_tangents(
        self,
        x0: np.ndarray,
        x: np.ndarray,
        weight: float,
        inertia: list[float],
        pattern: BlockPattern,
        values: np.ndarray,
    ) -> None:
        """As :meth:`tangents`, for :meth:`step_forces`."""
        for block, m in zip(self.blocks, inertia, strict=True):
            start = (x0, self.heat_at_start, self.rest_at_start)
            arguments = (*start, *self._arguments(x, block), block.start, block.stop)
            block.conserving.tangents(*arguments, m, self.mesh_lengths, weight, pattern.ptr, pattern.slots, values)
        if self.springs is not None:  # the force at mid-step
            self.springs.add_tangents(0.5 * weight, pattern, values)

    def product(self, x: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Compute ``out`` = K_t(x) u for local arrays (nodes, 3); valid for owned nodes."""
        out[:] = 0.0
        for block in self.blocks:
            block.kernels.product(*self._arguments(x, block), block.start, block.stop, u, out)
        if self.springs is not None:
            self.springs.add_product(1.0, u, out)

    def lengths(self, x: np.ndarray) -> np.ndarray:
        """Return the length (b,) of each local bar [m]."""
        lengths = np.empty_like(self.rest)
        bar_lengths(x, self.ends, lengths)
        return lengths

    def _shapes(self, block: BarBlock) -> BarShapes:
        lengths = self.mesh_lengths[block.start : block.stop]
        return bar_shapes(self.case.section[block.section], lengths, np.broadcast_to(block.area, lengths.shape))

    def radii(self) -> np.ndarray:
        """Return the outer radius (b,) [m] of each local bar: of its shape, else of the circle of its area."""
        radii = np.empty(len(self.ends))
        for block in self.blocks:
            radii[block.start : block.stop] = self._shapes(block).radius
        return radii

    def euler_loads(self) -> np.ndarray:
        """Return pi^2 E I/(K L)^2 (b,) [N] of each local bar, with its length L in the mesh and I, K of its section;
        infinite if the section has neither a shape nor a second moment."""
        loads = np.full(len(self.ends), np.inf)
        for block in self.blocks:
            section, shapes = self.case.section[block.section], self._shapes(block)
            young = self.case.material[section.material].young_modulus
            known = shapes.second_moment > 0.0
            loads[block.start : block.stop][known] = (
                np.pi**2 * young * shapes.second_moment[known] / shapes.effective_length[known] ** 2
            )
        return loads

    def fields(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return, per local bar at the end of the last step, ``strain``, ``stress`` [Pa], ``axial_force`` [N],
        ``plastic_strain``, and the internal variables of the case's laws; zero for bars without such a variable."""
        out = {name: np.empty(len(self.ends)) for name in ("strain", "stress", "axial_force")}
        out |= {name: np.zeros(len(self.ends)) for name in ("plastic_strain", *self.internal)}
        for block in self.blocks:
            arguments = (*self._arguments(x, block), block.start, block.stop)
            block.kernels.fields(*arguments, out["strain"], out["stress"], out["axial_force"])
            for name, _, values in block.variables():
                if name in out:
                    out[name][block.start : block.stop] = values
        return out

    def densities(self, x: np.ndarray) -> np.ndarray:
        """Return stored and dissipated energy per rest volume (b,) [J/m3] at the end of the last step."""
        out = np.zeros(len(self.ends))
        for block in self.blocks:
            block.kernels.densities(*self._arguments(x, block), block.start, block.stop, out)
        return out

    def history(self) -> np.ndarray:
        """Return the data that laws keep of all local bars (b, names), one column for each of :attr:`kept_names`; zero
        for bars without such data."""
        history = np.zeros((len(self.ends), len(self.kept_names)))
        for block in self.blocks:
            for name, _, values in block.variables():
                history[block.start : block.stop, self.kept_names.index(name)] = values
        return history

    def rupture(self) -> np.ndarray:
        """Return the state of rupture (b,) of all local bars, see :mod:`~pfem_petsc.mechanics.rupture`."""
        state = np.zeros(len(self.ends))
        for block in self.blocks:
            if block.law.rupture >= 0:
                state[block.start : block.stop] = block.history[block.law.rupture]
        return state

    @property
    def watched(self) -> np.ndarray:
        """Rest lengths (b,) [m], zero for bars that have left the model; the same array in each call."""
        if not self.can_break:
            return self.rest
        np.copyto(self._watched, np.where(np.abs(self.rupture()) >= 1.0, 0.0, self.rest))
        return self._watched

    @property
    def stiffness(self) -> np.ndarray:
        """Largest axial stiffness (b,) of all local bars [N/m]; zero for bars that have left the model."""
        rest, axial = self.watched, np.empty(len(self.ends))
        for block in self.blocks:
            axial[block.start : block.stop] = block.area * block.modulus
        return np.divide(axial, rest, out=np.zeros_like(axial), where=rest > 0.0)

    def put_history(self, history: np.ndarray) -> None:
        """Restore the result of :meth:`history`."""
        for block in self.blocks:
            for name, _, values in block.variables():
                values[:] = history[block.start : block.stop, self.kept_names.index(name)]
