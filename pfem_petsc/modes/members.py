"""Buckling of single bars as columns, which modes of the truss do not contain: nodes move, bars remain straight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..mechanics.sections import areas_of, bar_shapes

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["weakest_member"]


def weakest_member(model: Model, x: np.ndarray) -> tuple[float, int] | None:
    """Return the smallest factor pi^2 E I/((K L)^2 |N|) of the compressed bars, and the number of that bar. Collective.

    L is the length in the mesh, and I, K are those of the section; bars whose section has no shape are left out. None
    if there are no such bars.

    Parameters
    ----------
    model : Model
    x : local positions of the state [m]
    """
    mesh, best = model.mesh, (np.inf, -1)
    sections = list(model.case.section.values())
    force = model.bars.fields(x)["axial_force"]
    for block in mesh.blocks:
        if block.section >= len(sections):  # springs and dashpots
            continue
        section = sections[block.section]
        if section.shape is None and section.second_moment is None:
            continue
        here = slice(block.start, block.counted)
        lengths = model.bars.mesh_lengths[block.start : block.stop]
        shapes = bar_shapes(section, lengths, np.broadcast_to(areas_of(section, block, mesh), lengths.shape))
        young = model.case.material[section.material].young_modulus
        euler = np.pi**2 * young * shapes.second_moment / shapes.effective_length**2
        pressed = np.flatnonzero(force[here] < 0.0)
        if len(pressed):
            factors = euler[pressed] / -force[here][pressed]
            at = int(np.lexsort((mesh.bar_ids[here][pressed], factors))[0])
            best = min(best, (float(factors[at]), int(mesh.bar_ids[here][pressed[at]])))
    factor, bar = min(model.comm.allgather(best))
    return (factor, bar) if bar >= 0 else None
