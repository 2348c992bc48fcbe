"""All bars of a rank: blocks of one section each, evaluated by the compiled loops of their material."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from .compiled import kernel
from .conserving import make_conserving_kernels
from .kernels import make_kernels
from .materials import elastic, elastoplastic
from .strain import MEASURES
from .sweep import Sweep, make_sweep

__all__ = ["BarBlock", "Bars", "StrainEnergy", "first_inverted"]


class StrainEnergy(NamedTuple):
    """Sums over the bars counted on this rank [J], the first bar that collapsed (local index, -1: none), and
    whether any is so short that it may have turned over."""

    elastic: float
    plastic_heat: float
    hardening: float
    failed: int
    shortened: bool = False


@dataclass(frozen=True)
class BarBlock:
    """Local bars [start, stop) of one section, of which [start, counted) are counted on this rank."""

    section: str
    start: int
    counted: int
    stop: int
    area: float
    density: float
    damping: float
    thermal_expansion: float
    parameters: tuple[float, ...]
    history: np.ndarray
    sweep: Sweep
    kernels: SimpleNamespace
    conserving: SimpleNamespace


@kernel
def _rest_lengths(points, bars, rest):
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        dx = points[b, 0] - points[a, 0]
        dy = points[b, 1] - points[a, 1]
        dz = points[b, 2] - points[a, 2]
        rest[k] = (dx * dx + dy * dy + dz * dz) ** 0.5


@kernel
def first_inverted(x, before, bars, rest):
    """First bar that is shortened and points back against where it pointed before, or -1."""
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
    far : (b,) uint32, that end of each bar whose index is larger
    rest : (b,) float64, rest lengths [m]
    thermal : (b,) thermal strains, or (0,) where no temperature acts
    thermal_at_start : thermal strains at the start of the step, where they vary
    blocks : bars by section
    """

    def __init__(self, mesh, case) -> None:
        self.mesh = mesh
        self.ends = mesh.bars
        self.rest = np.empty(len(mesh.bars))
        _rest_lengths(mesh.points, mesh.bars, self.rest)
        self.thermal = np.empty(0)
        self.thermal_at_start = self.thermal
        self.far = np.maximum(
            mesh.bars[:, 0], mesh.bars[:, 1], out=np.empty(len(mesh.bars), dtype=np.uint32), casting="unsafe"
        )
        names = list(case.section)
        self.blocks: list[BarBlock] = []
        for block in mesh.blocks:
            section = case.section[names[block.section]]
            material = case.material[section.material]
            law = elastic if material.yield_stress is None else elastoplastic
            count = block.stop - block.start
            self.blocks.append(
                BarBlock(
                    section=names[block.section],
                    start=block.start,
                    counted=block.counted,
                    stop=block.stop,
                    area=section.area,
                    density=material.density,
                    damping=material.damping,
                    thermal_expansion=material.thermal_expansion,
                    parameters=law.pack(material),
                    history=np.zeros((2, count if law.REMEMBERS else 0)),
                    sweep=make_sweep(mesh.bars, block.start, block.counted, block.stop),
                    kernels=make_kernels(law.response, law.REMEMBERS, MEASURES[material.strain]),
                    conserving=make_conserving_kernels(law.response, law.REMEMBERS, MEASURES[material.strain]),
                )
            )

    def _arguments(self, x: np.ndarray, block: BarBlock) -> tuple:
        return (x, self.ends, self.rest, self.thermal, block.parameters, block.area, block.history)

    def forces(self, x: np.ndarray, f: np.ndarray, commit: bool) -> StrainEnergy:
        """Internal forces ``f`` (local nodes, 3) [N] at positions ``x``; valid for owned nodes. Keeps the plastic state
        reached only where ``commit``."""
        f[:] = 0.0
        elastic_energy = heat = hardening = 0.0
        failed, shortened = -1, False
        for block in self.blocks:
            u, q, w, at, short = block.kernels.forces(
                x,
                *block.sweep,
                self.far,
                self.rest,
                self.thermal,
                block.parameters,
                block.area,
                block.history,
                commit,
                f,
            )
            elastic_energy += u
            heat += q
            hardening += w
            shortened |= short
            if failed < 0:
                failed = at
        return StrainEnergy(elastic_energy, heat, hardening, failed, shortened)

    def first_inverted(self, x: np.ndarray, before: np.ndarray) -> int:
        """First local bar that went through zero length from positions ``before`` to ``x``, or -1.

        Its length alone does not tell: in one step a bar jumps over zero. Stretched bars are not looked at.
        """
        return first_inverted(x, before, self.ends, self.rest)

    def tangents(self, x: np.ndarray, weight: float, inertia: list[float], pattern, values: np.ndarray) -> None:
        """Add ``weight`` K_t(x) and the consistent inertia (a coefficient per block) to a matrix's values."""
        for block, m in zip(self.blocks, inertia, strict=True):
            block.kernels.tangents(
                *self._arguments(x, block), block.start, block.stop, m, weight, pattern.ptr, pattern.slots, values
            )

    def linearise(self, x: np.ndarray, weight: float, stored: np.ndarray) -> None:
        """Fill ``stored`` (b, 5) with n, dN/dl - N/l [N/m] and N/l [N/m], times ``weight``, of each bar at ``x``."""
        for block in self.blocks:
            block.kernels.linearise(*self._arguments(x, block), block.start, block.stop, weight, stored)

    def step_forces(self, x0: np.ndarray, x: np.ndarray, f: np.ndarray) -> None:
        """Discrete-gradient forces ``f`` (local nodes, 3) [N] of a step from ``x0`` to ``x``."""
        f[:] = 0.0
        for block in self.blocks:
            arguments = self._arguments(x, block)
            block.conserving.forces(x0, self.thermal_at_start, *arguments, block.start, block.stop, f)

    def step_tangents(self, x0, x, weight: float, inertia: list[float], pattern, values: np.ndarray) -> None:
        """As :meth:`tangents`, for :meth:`step_forces`."""
        for block, m in zip(self.blocks, inertia, strict=True):
            arguments = (x0, self.thermal_at_start, *self._arguments(x, block), block.start, block.stop)
            block.conserving.tangents(*arguments, m, weight, pattern.ptr, pattern.slots, values)

    def product(self, x: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """``out`` = K_t(x) u for local arrays (nodes, 3); valid for owned nodes."""
        out[:] = 0.0
        for block in self.blocks:
            block.kernels.product(*self._arguments(x, block), block.start, block.stop, u, out)

    def fields(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Per local bar: ``strain``, ``stress`` [Pa], ``axial_force`` [N], ``plastic_strain``."""
        out = {name: np.empty(len(self.ends)) for name in ("strain", "stress", "axial_force")}
        out["plastic_strain"] = np.zeros(len(self.ends))
        for block in self.blocks:
            block.kernels.fields(
                *self._arguments(x, block),
                block.start,
                block.stop,
                out["strain"],
                out["stress"],
                out["axial_force"],
            )
            if block.history.size:
                out["plastic_strain"][block.start : block.stop] = block.history[0]
        return out

    def history(self) -> np.ndarray:
        """Plastic history (b, 2) of all local bars, zero where a bar cannot yield."""
        history = np.zeros((len(self.ends), 2))
        for block in self.blocks:
            if block.history.size:
                history[block.start : block.stop] = block.history.T
        return history

    def put_history(self, history: np.ndarray) -> None:
        """Set what :meth:`history` gives."""
        for block in self.blocks:
            if block.history.size:
                block.history[:] = history[block.start : block.stop].T

    @property
    def plastic(self) -> bool:
        """Whether any bar of this rank can yield."""
        return any(block.history.size for block in self.blocks)


def section_of_bars(case, slab) -> np.ndarray:
    """Section index (m,) int32 of each bar of a slab: the section that names its group, else the default one.

    Raises
    ------
    InputError
        Where a section names a group that the mesh lacks, or a bar has two sections or none.
    """
    from ..registry import nearest

    chosen = np.full(len(slab.bars), -1, dtype=np.int32)
    for index, (name, section) in enumerate(case.section.items()):
        if section.bars is None:
            continue
        if section.bars not in slab.bar_groups:
            hint = nearest(section.bars, sorted(slab.bar_groups)) if slab.bar_groups else "; the mesh has no bar groups"
            raise InputError(
                f"{case.source}: section.{name}.bars = {section.bars!r}: no such bar group in {slab.source}{hint}"
            )
        members = slab.bar_groups[section.bars] - slab.first_bar
        taken = members[chosen[members] >= 0]
        if len(taken):
            other = list(case.section)[chosen[taken[0]]]
            raise InputError(
                f"{case.source}: section.{name}.bars: bar {taken[0] + slab.first_bar} already belongs to section "
                f"{other!r}; give each bar one section"
            )
        chosen[members] = index
    default = [i for i, section in enumerate(case.section.values()) if section.bars is None]
    if default:
        chosen[chosen < 0] = default[0]
    bare = np.flatnonzero(chosen < 0)
    if len(bare):
        raise InputError(
            f"{case.source}: section: bar {bare[0] + slab.first_bar} of {slab.source} (and {len(bare) - 1} more here) "
            "has no section; add a section without 'bars' as the default"
        )
    return chosen
