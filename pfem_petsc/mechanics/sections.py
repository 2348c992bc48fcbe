"""The section of each bar of a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..mesh.node_sets import group_hint

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.slab import MeshSlab

__all__ = ["section_of_bars"]


def section_of_bars(case: Case, slab: MeshSlab) -> np.ndarray:
    """Return the section index (m,) int32 of each bar of a slab: the section that names its group, else the default.

    Raises
    ------
    InputError
        If a section names a group that the mesh does not have, or a bar has two sections or none.
    """
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
