"""Bars of a rank in blocks of one section each: their data, and the compiled loops of their material."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .conserving import make_conserving_kernels
from .kernels import make_kernels
from .materials.base import Law, UnsuitableBarError, law_of
from .rupture import breakable, limit_values, make_release
from .sections import areas_of, bar_shapes
from .strain import MEASURES
from .sweep import Sweep, make_sweep

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh

__all__ = ["BarBlock", "laws_of", "make_blocks"]


@dataclass(eq=False)
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


def laws_of(case: Case) -> dict[str, Law]:
    """Return the law of each material that a section has, by its name; that of bars that can leave the model is
    breakable."""
    laws = {section.material: law_of(case.material[section.material]) for section in case.section.values()}
    for name, law in laws.items():
        if case.material[name].rupture is not None or case.removes_bars:
            laws[name] = breakable(law)
    return laws


def make_blocks(mesh: DistributedMesh, case: Case, lengths: np.ndarray) -> list[BarBlock]:
    """Return the blocks of this rank; ``lengths`` (b,): of the bars in the mesh [m].

    Raises
    ------
    InputError
        On this rank, if a law cannot describe one of its bars.
    """
    laws, names, blocks = laws_of(case), list(case.section), []
    for block in mesh.blocks:
        section = case.section[names[block.section]]
        material = case.material[section.material]
        law, measure = laws[section.material], MEASURES[material.strain]
        blocks.append(
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
                release=make_release(law_of(material), measure) if law.rupture >= 0 else None,
            )
        )
    for block in blocks:
        if block.law.bar_data:
            _fill_bar_data(mesh, case, block, lengths[block.start : block.stop])
    return blocks


def _fill_bar_data(mesh: DistributedMesh, case: Case, block: BarBlock, lengths: np.ndarray) -> None:
    """Give the law of a block what it reads of each bar."""
    section = case.section[block.section]
    shapes = bar_shapes(section, lengths, np.broadcast_to(block.area, block.stop - block.start))
    try:
        data = case.material[section.material].pack_bars(shapes)
    except UnsuitableBarError as error:
        bar = mesh.bar_ids[block.start + error.bar]
        raise InputError(
            f"{case.source}: section.{block.section} with material.{section.material}: bar {bar}: {error.reason}"
        ) from error
    block.history[len(block.law.rows) :] = data
