"""The section of each bar of a mesh, and the shape of the bars of a section.

A solid circle of radius R has the area pi R^2, the second moment pi R^4/4 and the plastic modulus 4 R^3/3. A tube of
thickness t and area A has the outer radius R = A/(2 pi t) + t/2, and with the inner radius r = R - t the second moment
pi (R^4 - r^4)/4 and the plastic modulus 4 (R^3 - r^3)/3. A given second moment I stands for the tube of this area and
second moment, R^2 + r^2 = 4 I/A and R^2 - r^2 = A/pi; where there is none because I is less than that of a solid
circle, for the rectangle of thickness h = (12 I/A)^(1/2), which has the plastic modulus A h/4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..mesh.node_sets import group_hint
from .materials.base import BarShapes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import Section
    from ..mesh.distribution import Block, DistributedMesh
    from ..mesh.slab import MeshSlab

__all__ = ["area_fields", "areas_of", "bar_shapes", "check_areas", "named_groups", "section_of_bars"]


def bar_shapes(section: Section, length: np.ndarray, area: np.ndarray) -> BarShapes:
    """Return the shapes of bars of a section from their lengths [m] and areas [m2], both (b,)."""
    nothing = np.zeros_like(length)
    outer, inner, moment, modulus = np.sqrt(area / np.pi), nothing, nothing, nothing
    if section.thickness is not None:
        outer = area / (2.0 * np.pi * section.thickness) + 0.5 * section.thickness
        inner = np.maximum(outer - section.thickness, 0.0)
    if section.second_moment is not None:
        moment = np.full_like(length, section.second_moment)
        squares, difference = 4.0 * moment / area, area / np.pi
        hollow = squares >= difference
        outer = np.where(hollow, np.sqrt(0.5 * (squares + difference)), outer)
        inner = np.where(hollow, np.sqrt(0.5 * np.maximum(squares - difference, 0.0)), 0.0)
        flat = 0.25 * area * np.sqrt(3.0 * squares)
        modulus = np.where(hollow, 4.0 / 3.0 * (outer**3 - inner**3), flat)
    elif section.shape is not None:
        moment = 0.25 * np.pi * (outer**4 - inner**4)
        modulus = 4.0 / 3.0 * (outer**3 - inner**3)
    return BarShapes(length, area, moment, modulus, outer, section.effective_length * length)


def area_fields(case: Case) -> dict[str, str]:
    """Return the cell fields of the mesh that sections take their areas from, each with the key that names it."""
    named = [(s.area_field, f"{case.source}: section.{name}.area_field") for name, s in case.section.items()]
    return {field: key for field, key in reversed(named) if field is not None}


def named_groups(case: Case) -> set[str]:
    """Return the names of all groups of the mesh that a case uses."""
    names = [section.bars for section in case.section.values()]
    names += [node_set.group for node_set in case.node_set.values()]
    names += [entry.bars for entry in (*case.temperature, *case.remove)]
    return {name for name in names if name is not None}


def areas_of(section: Section, block: Block, mesh: DistributedMesh) -> float | np.ndarray:
    """Return the area of the bars of a block [m2]: a number, or (stop - start,)."""
    if section.area_field is None:
        return float(section.area)
    return np.ascontiguousarray(mesh.bar_fields[section.area_field][block.start : block.stop])


def check_areas(case: Case, slab: MeshSlab, sections: np.ndarray) -> None:
    """Refuse areas of a mesh field that are not positive. ``sections``: of :func:`section_of_bars`.

    Raises
    ------
    InputError
        Names the first such bar of this rank.
    """
    for index, (name, section) in enumerate(case.section.items()):
        if section.area_field is None:
            continue
        values = slab.bar_fields[section.area_field]
        wrong = np.flatnonzero((sections == index) & ~((values > 0.0) & np.isfinite(values)))
        if len(wrong):
            key = f"{case.source}: section.{name}.area_field = {section.area_field!r}"
            raise InputError(
                f"{key}: bar {wrong[0] + slab.first_bar} of {slab.source} (and {len(wrong) - 1} more here) has "
                f"{values[wrong[0]]:g} m2; give each bar of the section an area > 0"
            )
        least = 0.0 if section.thickness is None else np.pi * section.thickness**2
        thin = np.flatnonzero((sections == index) & (values < least))
        if len(thin):
            raise InputError(
                f"{case.source}: section.{name}.thickness = {section.thickness!r} m is too much for the tube of bar "
                f"{thin[0] + slab.first_bar}, whose area is {values[thin[0]]:g} m2"
            )


def section_of_bars(case: Case, slab: MeshSlab) -> np.ndarray:
    """Return the section index (m,) int32 of each bar of a slab: the section that names its group, else the default.

    Raises
    ------
    InputError
        If a section names a group that the mesh does not have, or a bar has two sections or none.
    """
    if [section.bars for section in case.section.values()] == [None]:
        return np.broadcast_to(np.int32(0), len(slab.bars))  # without memory of its own
    chosen = np.full(len(slab.bars), -1, dtype=np.int32)
    for index, (name, section) in enumerate(case.section.items()):
        if section.bars is None:
            continue
        if section.bars not in slab.bar_groups:
            hint = group_hint(case, section.bars, sorted(slab.bar_groups), "Curve")
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
