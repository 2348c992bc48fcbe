"""Rest lengths and temperatures of bars: prescribed by sections or by the forces in the initial state."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import numpy as np

from ..case.base import has_rows
from ..errors import InputError
from ..mesh.distribution import bars_of_group
from .elements import COLLAPSED_STRETCH, MEASURES
from .materials.base import law_of
from .motion import Table
from .rupture import intact

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..case.schema import Case
    from ..case.tables import Section
    from ..mesh.distribution import DistributedMesh
    from .bars import BarBlock, Bars
    from .materials.base import Law

    Bar = tuple[Law, tuple, Callable]
    """Material law of intact bars, its parameters, and the strain measure."""


_ITERATIONS = 100
_LARGEST = 1e9  # stretch


class RestLengths:
    """Rest lengths that follow from the sections of a case.

    Attributes
    ----------
    any : whether a section prescribes them
    varying : whether any of them changes over time
    found : whether the analysis finds them
    """

    def __init__(self, case: Case, bars: Bars) -> None:
        stages = case.editor[0].stages
        self.found = any(each.static is not None and each.static.method == "force_density" for each in stages)
        given = {name: section.prestressed for name, section in case.section.items()}
        self.any, self.varying = any(key is not None for key in given.values()), False
        # in later stages they stay as they are, unless the stage gives those of a section
        held = {name for name in given if case.number > 0 and name not in case.stressed}
        self._bars = bars
        self._held = [slice(block.start, block.stop) for block in bars.blocks if block.section in held]
        self._entries: list[_Entry] = []
        if not self.any:
            return
        bars.rest = bars.mesh_lengths.copy()
        for name, key in given.items():
            if key is None:
                continue
            section = case.section[name]
            where = f"{case.source}: section.{name}.{key}"
            entries = [
                _Entry(block, bar_of(case, section), *self._in_mesh(block, section, key, where), where)
                for block in bars.blocks
                if block.section == name
            ]
            for entry in entries:
                entry.largest()  # refuses what the law cannot bear
            if name in held:
                for entry in entries:
                    entry.apply(bars, math.inf)
                continue
            self.varying |= has_rows(getattr(section, key)) and len(getattr(section, key)) > 1
            self._entries += entries
        self.apply(0.0)
        if self.varying:
            bars.rest_at_start = bars.rest.copy()

    def _in_mesh(
        self, block: BarBlock, section: Section, key: str, where: str
    ) -> tuple[str, Sequence[tuple[float, float]], np.ndarray | float]:
        """Return what a section prescribes in the mesh, as :func:`prescribed`.

        Raises
        ------
        InputError
            If no form is found in which bars could have given lengths.
        """
        kind, rows, factor = prescribed(self._bars, block, section, key, where)
        if kind == "target_length":
            if not self.found:
                raise InputError(
                    f'{where}: lengths are found in a form, by a stage with static.method = "force_density"; in the '
                    "mesh give rest_length, a factor on the length there"
                )
            return "rest_length", ((0.0, 1.0),), 1.0
        if kind == "force_density":
            return "pretension", rows, factor * self._bars.mesh_lengths[block.start : block.stop]
        return kind, rows, factor

    def hold(self, rest: np.ndarray) -> None:
        """Take over the rest lengths (b,) [m] of the previous stage if they remain in force."""
        if self.any:
            for part in self._held:
                self._bars.set_rest(part, rest[part])
            if self.varying:
                self._bars.rest_at_start = self._bars.rest.copy()

    def apply(self, time: float) -> None:
        """Set the rest lengths at a time [s], or at a load factor."""
        for entry in self._entries:
            entry.apply(self._bars, time)

    def take(self, part: slice, rest: np.ndarray) -> None:
        """Give the bars of a block the rest lengths [m] of a form that is found, instead of those of the case."""
        self._bars.set_rest(part, rest)
        self._entries = [entry for entry in self._entries if entry.block.start != part.start]

    def shorten(self) -> None:
        """Give all bars the smallest rest lengths that they have at any time, which make them stiffest."""
        for entry in self._entries:
            part = slice(entry.block.start, entry.block.stop)
            self._bars.set_rest(part, self._bars.mesh_lengths[part] / entry.largest())


class _Entry:
    """The bars of a block, with the values that they have over time."""

    def __init__(
        self,
        block: BarBlock,
        bar: Bar,
        key: str,
        rows: Sequence[tuple[float, float]],
        factor: np.ndarray | float,
        where: str,
    ) -> None:
        self.block, self.bar, self.key, self.factor, self.where = block, bar, key, factor, where
        self.values = [value for _, value in rows]
        self._table = Table(rows)
        self._found: tuple[float, np.ndarray | float] | None = None  # the last value and its stretch

    def _stretch(self, value: float) -> np.ndarray | float:
        if self._found is None or self._found[0] != value:
            self._found = value, stretches(self.block, self.bar, self.key, self.factor * value, self.where)
        return self._found[1]

    def apply(self, bars: Bars, time: float) -> None:
        """Set the rest lengths of the bars at a time [s], or at a load factor."""
        value = float(self._table(time)[0])
        part = slice(self.block.start, self.block.stop)
        bars.set_rest(part, bars.mesh_lengths[part] / self._stretch(value))

    def largest(self) -> np.ndarray | float:
        """Return the largest stretch in the mesh at any time."""
        return functools.reduce(np.maximum, map(self._stretch, self.values))


def unstressed_lengths(case: Case, bars: Bars) -> np.ndarray:
    """Return the lengths (b,) [m] that bars are made with, which have their mass: those in the mesh, or constant rest
    lengths that sections of the case give."""
    lengths = bars.mesh_lengths
    for block in bars.blocks:
        section = case.section.get(block.section)
        factor = getattr(section, "rest_length", None)
        field = getattr(section, "rest_length_field", None)
        part = slice(block.start, block.stop)
        if field is not None:
            factor = bars.mesh.bar_fields[field][part]
        if factor is not None and not has_rows(factor):
            lengths = lengths.copy() if lengths is bars.mesh_lengths else lengths
            lengths[part] *= factor
    return lengths


def bar_of(case: Case, section: Section) -> Bar:
    """Return what :func:`stretches` needs of the material of a section."""
    material = case.material[section.material]
    return law_of(material), material.numbers(), MEASURES[material.strain]  # intact, also if it can break


def prescribed(
    bars: Bars, block: BarBlock, section: Section, key: str, where: str
) -> tuple[str, Sequence[tuple[float, float]], np.ndarray | float]:
    """Return what a section prescribes of the bars of a block: the kind, rows over time, and a factor of their values.

    Raises
    ------
    InputError
        If a value of a field is not finite, or no factor on a length, or no length.
    """
    part, factor, value = slice(block.start, block.stop), 1.0, getattr(section, key)
    kind = key.removesuffix("_field")
    if kind != key:
        factor, value = bars.mesh.bar_fields[value][part], 1.0
        sound = np.isfinite(factor)
        if kind == "rest_length":
            sound &= (factor > 1e-3) & (factor < 1e3)
        elif kind == "target_length":
            sound &= factor > 0.0
        wrong = np.flatnonzero(~sound)
        if len(wrong):
            known = {"rest_length": "a factor on its length in the mesh, like 0.99", "target_length": "a length [m]"}
            expected = known.get(kind, "a finite number")
            bar = bars.mesh.bar_ids[block.start + wrong[0]]
            raise InputError(
                f"{where}: bar {bar} (and {len(wrong) - 1} more here) has {factor[wrong[0]]:g}; expected {expected}"
            )
    return kind, value if has_rows(value) else ((0.0, value),), factor


def stretches(block: BarBlock, bar: Bar, key: str, value: np.ndarray | float, where: str) -> np.ndarray | float:
    """Return the stretch in the mesh of the bars of a block, with a value of ``pretension``, ``prestress`` or
    ``rest_length``, one or one of each bar (b,)."""
    if key == "rest_length":
        return 1.0 / value
    law, parameters, measure = bar
    as_force = key == "pretension"
    target = value / block.area if as_force else value
    try:
        if not law.bar_data and np.ndim(target) == 0:
            return stretch_of(law, measure, parameters, target, as_force)
        data = block.history[len(block.law.rows) :]
        rows = np.vstack([np.broadcast_to(target, block.stop - block.start), data])
        kinds, which = np.unique(rows, axis=1, return_inverse=True)
        each = [(force, (*parameters, *given)) for force, *given in kinds.T.tolist()]
        return np.array([stretch_of(law, measure, p, force, as_force) for force, p in each])[np.ravel(which)]
    except ValueError as error:
        unit = "N" if key == "pretension" else "Pa"
        given = f" = {value:g} {unit}" if np.ndim(value) == 0 else ""
        slack = any(name == "slack" for name, _ in law.internal) and np.min(target) < 0.0
        text = "bars of this law take no compression" if slack else str(error)
        raise InputError(f"{where}{given}: {text}") from error


def stretch_of(law: Law, measure: Callable, parameters: tuple[float, ...], target: float, as_force: bool) -> float:
    """Return the stretch of a virgin bar at a stress, or at an axial force over area [Pa], by Newton's method.

    Raises
    ------
    ValueError
        If the law does not reach it, or only by changing its internal variables, as by yielding.
    """
    if target == 0.0:
        return 1.0
    law, parameters = intact(law, parameters)
    response, start = law.response, (0.0,) * len(law.internal)
    stretch = kept = 1.0
    best = miss = math.inf
    for _ in range(_ITERATIONS):
        strain, slope, curvature = measure(stretch)
        stress, modulus, _, _ = response(strain, 0.0, 0.0, 0.0, parameters, start)
        found, tangent = stress, modulus * slope
        if as_force:
            found, tangent = stress * slope, modulus * slope**2 + stress * curvature
        miss = target - found
        if abs(miss) >= best or miss == 0.0:  # rounding
            break
        best = abs(miss)
        kept = stretch
        if not tangent > 0.0:
            break
        stretch = min(max(stretch + miss / tangent, 0.5 * stretch), 2.0 * stretch)
        if not COLLAPSED_STRETCH < stretch < _LARGEST:
            break
    if miss != 0.0:
        stretch = kept
    # a stretch is known up to rounding, which is much of a small prestress
    if not best <= max(1e-9 * abs(target), 4.0 * np.finfo(float).eps * abs(tangent)) and miss != 0.0:
        raise ValueError("the material law does not reach it at any length; give a smaller one")
    strain, _, _ = measure(stretch)
    _, _, _, densities = response(strain, 0.0, 0.0, 0.0, parameters, start)
    energies = dict(zip(law.energies, densities, strict=True))
    elastic = energies.pop("elastic_energy", 0.0)
    if any(abs(density) > 1e-12 * abs(elastic) for density in energies.values()):
        raise ValueError("the material yields or is damaged before it is reached; give a smaller one")
    return stretch


class Temperatures:
    """Temperature of each local bar.

    Attributes
    ----------
    values : (b,) temperatures [K], or (0,)
    any : whether the case has temperatures
    varying : whether any of them changes over time
    """

    def __init__(self, case: Case, mesh: DistributedMesh, bars: Bars) -> None:
        self.any, self._holds = bool(case.temperature), case.holds("temperature")
        self.varying = not self._holds and any(entry.table is not None for entry in case.temperature)
        self._case, self._bars = case, bars
        self._entries = []
        for index, entry in enumerate(case.temperature):
            members = slice(None)
            if entry.bars is not None:
                members = bars_of_group(case, mesh, f"temperature[{index}].bars", str(entry.bars))
            rows = [(0.0, entry.value)] if entry.table is None else entry.table
            self._entries.append((members, Table(rows, entry.interpolation == "smooth")))
        if self.any:
            bars.heat = np.zeros((2, len(mesh.bars)))
        self.values = bars.heat[1]
        if self._holds:
            self._entries = []
        if self.any:
            self.apply(0.0)
            bars.heat_at_start = bars.heat.copy()

    def hold(self, heat: np.ndarray) -> None:
        """Take over the thermal strains and temperatures [K] (2, b) of the previous stage if they remain in force."""
        if self._holds and self.any:
            self._bars.heat[:] = heat
            self._bars.heat_at_start = self._bars.heat.copy()

    def stiffen(self) -> None:
        """Give bars that soften the temperature at which their modulus is largest."""
        for block in self._bars.blocks:
            if block.law.modulus is not None:
                rows = np.array(self._case.material[self._case.section[block.section].material].softening)
                self.values[block.start : block.stop] = rows[np.argmax(rows[:, 1]), 0]

    def apply(self, time: float) -> None:
        """Set the thermal strains of the bars at a time [s]; later entries of the case override earlier ones."""
        for members, table in self._entries:
            self.values[members] = table(time)[0]
        for block in self._bars.blocks:
            part = slice(block.start, block.stop)
            self._bars.heat[0, part] = block.thermal_expansion * self.values[part]
