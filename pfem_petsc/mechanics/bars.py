"""All bars of a rank, in blocks of one section each, evaluated by the compiled loops of their material."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..case.materials import internal_variables, law_of
from ..energies import BAR_ENERGIES
from ..errors import InputError
from ..fields import STATUS
from .compiled import kernel
from .conserving import make_conserving_kernels
from .kernels import make_kernels
from .materials.base import Law, UnsuitableBarError
from .rupture import breakable, limit_values, make_release
from .sections import areas_of, bar_shapes
from .strain import MEASURES
from .sweep import Sweep, make_sweep

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..solvers.matrix import BlockPattern
    from .springs import Springs

__all__ = ["BarBlock", "Bars", "StrainEnergy", "first_inverted"]

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


@dataclass(frozen=True)
class BarBlock:
    """Local bars [start, stop) of one section, of which [start, counted) are counted on this rank.

    ``area`` [m2] is a number, or (stop - start,) if it differs from bar to bar. ``modulus`` is the largest tangent
    modulus of the law [Pa]; ``history`` (rows, stop - start) holds ``law.rows`` and, after them, ``law.bar_data``;
    ``release`` removes bars, if they can leave the model.
    """

    section: str
    start: int
    counted: int
    stop: int
    area: float | np.ndarray
    density: float
    damping: float
    thermal_expansion: float
    law: Law
    measure: Callable
    parameters: tuple[float, ...]
    modulus: float
    history: np.ndarray
    sweep: Sweep
    kernels: SimpleNamespace
    conserving: SimpleNamespace | None
    release: Callable | None

    @property
    def counted_area(self) -> float | np.ndarray:
        """Area of the counted bars [m2], a number or (counted - start,)."""
        return self.area if isinstance(self.area, float) else self.area[: self.counted - self.start]

    def variables(self) -> Iterator[tuple[str, str, np.ndarray]]:
        """Yield name, unit and values (stop - start,) of all data kept from step to step."""
        for (name, unit), values in zip(self.law.rows, self.history, strict=False):
            yield name, unit, values


@kernel
def _lengths(points, bars, rest):
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = points[b, 0] - points[a, 0]
        dy = points[b, 1] - points[a, 1]
        dz = points[b, 2] - points[a, 2]
        rest[k] = (dx * dx + dy * dy + dz * dz) ** 0.5


@kernel
def first_inverted(x, before, bars, rest):
    """Return the first shortened bar whose direction has reversed, or -1; those with zero ``rest`` are not checked."""
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = x[b, 0] - x[a, 0]
        dy = x[b, 1] - x[a, 1]
        dz = x[b, 2] - x[a, 2]
        if dx * dx + dy * dy + dz * dz < 0.8 * rest[k] * rest[k]:
            back = dx * (before[b, 0] - before[a, 0])
            back += dy * (before[b, 1] - before[a, 1])
            back += dz * (before[b, 2] - before[a, 2])
            if back < 0.0:
                return k
    return -1


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
    springs : from nodes to the ground, whose forces and stiffness are added to those of the bars; None without
    """

    springs: Springs | None = None

    def __init__(self, mesh: DistributedMesh, case: Case) -> None:
        self.mesh, self.case = mesh, case
        self.ends = mesh.bars
        self.mesh_lengths = np.empty(len(mesh.bars))
        _lengths(mesh.points, mesh.bars, self.mesh_lengths)
        self.rest = self.mesh_lengths
        self.rest_at_start = np.empty(0)
        self.heat = np.empty((2, 0))
        self.heat_at_start = self.heat
        self.step = 0.0
        self.internal = internal_variables(case.material)
        laws = {section.material: law_of(case.material[section.material]) for section in case.section.values()}
        intact = dict(laws)
        for name in laws:
            if case.material[name].rupture is not None or case.removes_bars:
                laws[name] = breakable(laws[name])
        self.can_break = any(law.rupture >= 0 for law in laws.values())
        self._watched = np.empty(len(mesh.bars) if self.can_break else 0)
        self.kept_names = list(dict.fromkeys(name for law in laws.values() for name, _ in law.rows))
        self.far = np.maximum(
            mesh.bars[:, 0], mesh.bars[:, 1], out=np.empty(len(mesh.bars), dtype=np.uint32), casting="unsafe"
        )
        names = list(case.section)
        self.blocks: list[BarBlock] = []
        for block in mesh.blocks:
            section = case.section[names[block.section]]
            material = case.material[section.material]
            law, measure = laws[section.material], MEASURES[material.strain]
            self.blocks.append(
                BarBlock(
                    section=names[block.section],
                    start=block.start,
                    counted=block.counted,
                    stop=block.stop,
                    area=areas_of(section, block, mesh),
                    density=material.density,
                    damping=material.damping,
                    thermal_expansion=material.thermal_expansion,
                    law=law,
                    measure=measure,
                    parameters=(*(limit_values(material.rupture) if law.rupture >= 0 else ()), *material.numbers()),
                    modulus=material.upper_modulus(),
                    history=np.zeros((len(law.rows) + len(law.bar_data), block.stop - block.start)),
                    sweep=make_sweep(mesh.bars, block.start, block.counted, block.stop),
                    kernels=make_kernels(law, measure),
                    conserving=None if law.mean_stress is None else make_conserving_kernels(law, measure),
                    release=make_release(intact[section.material], measure) if law.rupture >= 0 else None,
                )
            )
        self.fill_bar_data()

    def fill_bar_data(self) -> None:
        """Give laws what they read of each bar, with its length in the mesh; to be repeated when areas have changed.

        Raises
        ------
        InputError
            On this rank, if a law cannot describe one of its bars.
        """
        for block in self.blocks:
            if not block.law.bar_data:
                continue
            section, part = self.case.section[block.section], slice(block.start, block.stop)
            shapes = bar_shapes(section, self.mesh_lengths[part], np.broadcast_to(block.area, block.stop - block.start))
            try:
                data = self.case.material[section.material].pack_bars(shapes)
            except UnsuitableBarError as error:
                bar = self.mesh.bar_ids[block.start + error.bar]
                raise InputError(
                    f"{self.case.source}: section.{block.section} with material.{section.material}: bar {bar}: "
                    f"{error.reason}"
                ) from error
            block.history[len(block.law.rows) :] = data

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
                x, *block.sweep, self.far, self.rest, self.heat, *law, commit, f, part
            )
            energies += part
            shortened |= short
            changed += broke
            if failed < 0:
                failed = at
        if self.springs is not None:
            energies[_OF_SPRINGS] = self.springs.add_forces(x, f)
        return StrainEnergy(tuple(energies.tolist()), failed, shortened, changed)

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
        """Fill ``stored`` (b, 5) with n, dN/dl - N/l [N/m] and N/l [N/m], times ``weight``, for each bar at ``x``;
        without springs."""
        for block in self.blocks:
            block.kernels.linearise(*self._arguments(x, block), block.start, block.stop, weight, stored)

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
        _lengths(x, self.ends, lengths)
        return lengths

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

    def put_history(self, history: np.ndarray) -> None:
        """Restore the result of :meth:`history`."""
        for block in self.blocks:
            for name, _, values in block.variables():
                values[:] = history[block.start : block.stop, self.kept_names.index(name)]
