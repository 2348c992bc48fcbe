"""Buckling of single bars as columns, which modes of the truss do not contain: nodes move, bars remain straight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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
    counted, force = model.mesh.counted, model.bars.fields(x)["axial_force"]
    ids, force, euler = (values[counted] for values in (model.mesh.bar_ids, force, model.bars.euler_loads()))
    pressed = np.flatnonzero((force < 0.0) & (euler < np.inf))
    factors = euler[pressed] / -force[pressed]
    best = min(zip(factors.tolist(), ids[pressed].tolist(), strict=True), default=(np.inf, -1))
    factor, bar = min(model.comm.allgather(best))
    return (factor, bar) if bar >= 0 else None
