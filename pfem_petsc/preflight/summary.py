"""Summary before a run: sizes, distribution, time step, solver."""

from __future__ import annotations

import resource
from typing import TYPE_CHECKING

import numpy as np

from ..modes.find import describe_modes
from ..output.units import engineering

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..contact.walls.base import WallKeys
    from ..stepping.model import Model
    from ..stepping.plan import Plan

__all__ = ["summarise"]

_THICK = 0.3
"""Relative density above which struts are no lattice of slender bars (Gibson and Ashby, Cellular Solids, 1997)."""


def summarise(case: Case, model: Model, plan: Plan) -> dict[str, str]:
    """Return label and text of the entries. Collective."""
    mesh, comm = model.mesh, model.comm
    counts = comm.allgather((mesh.n_owned, mesh.n_local - mesh.n_owned))
    # kibibytes on Linux
    peak = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0)
    ranks = f"{comm.size}"
    if comm.size > 1:
        ranks += f", owning {min(c[0] for c in counts):,} to {max(c[0] for c in counts):,} nodes ({mesh.partitioner})"
        ranks += f", at most {max(c[1] for c in counts):,} ghosts"
    return {
        "nodes": f"{mesh.n_nodes:,}",
        "bars": f"{mesh.n_bars:,}",
        "ranks": ranks,
        "extent": " x ".join(engineering(float(d), "m") for d in model.high - model.low),
        **_density(model),
        "mass": engineering(model.total_mass, "kg") + f" ({case.mass})",
        "wave speed": engineering(model.wave_speed, "m/s"),
        **plan.entries(case),
        **describe_modes(model),
        "linear solver": plan.linear.why if plan.linear is not None else "none: nodes are solved independently",
        "walls": ", ".join(map(_described, case.every_wall)) or "none",
        **({"contact pairs": ", ".join(pair.name for pair in case.contact_pair)} if case.contact_pair else {}),
        **({"constraints": ", ".join(f"{c.name} ({c.kind})" for c in case.constraint)} if case.constraint else {}),
        "memory": f"{engineering(peak, 'B', 3)} in use on all ranks",
    }


def _density(model: Model) -> dict[str, str]:
    """Return the relative density of a lattice: the volume of its bars over that of what it fills. Collective."""
    mesh, blocks = model.mesh, model.bars.blocks
    if mesh.volume is None:
        return {}
    lengths = model.bars.mesh_lengths
    own = 0.0
    for block in blocks:
        counted = slice(block.start, block.counted)
        area = block.area if np.ndim(block.area) == 0 else block.area[: block.counted - block.start]
        own += float((area * lengths[counted]).sum())
    ratio = model.comm.allreduce(own) / mesh.volume
    thick = "; struts so thick overlap at nodes, where this counts them more than once" if ratio > _THICK else ""
    return {"relative density": f"{ratio:.4g} (volume of bars over {engineering(mesh.volume, 'm3')}){thick}"}


def _described(wall: WallKeys) -> str:
    """Return the name of a wall, with its mass if it has one."""
    return wall.name if wall.mass is None else f"{wall.name} ({engineering(wall.mass, 'kg')})"
