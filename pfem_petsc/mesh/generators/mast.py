"""A lattice mast of three legs on the z axis, with guys in three directions at several heights."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveInt, StrictModel
from ...errors import InputError
from ..slab import MeshSlab, check_size, slab_of_whole
from .base import Length


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "mast"``."""

    height: Length
    """Height of the mast [m]."""
    width: Length
    """Distance of its legs [m]."""
    bays: PositiveInt
    """Number of bays over the height."""
    radius: Length
    """Distance of the guys' anchors from the axis [m]."""
    levels: PositiveInt = 1
    """Number of heights at which guys are attached, evenly spread up to the top."""
    elements: PositiveInt = 1
    """Number of bars of each guy."""


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """This rank's part: legs at 0, 120 and 240 degrees about z; nodes of the mast from the ground up, three each level.

    After them come the three anchors, in the directions of the legs, and the nodes within guys, from the anchor up.
    Bars: for each bay three legs, three diagonals and the three horizontals above; the horizontals at the ground; the
    guys. Node groups ``base``, ``top``, ``mast``, ``anchors``; bar groups ``legs``, ``diagonals``, ``horizontals``,
    ``guys``.
    """
    p, n = parameters, parameters.bays
    if p.levels > n:
        raise InputError(f"mesh.levels = {p.levels} is more than mesh.bays = {n}: guys are attached at the bays' ends")
    n_mast, n_guys = 3 * (n + 1), 3 * p.levels
    check_size(n_mast + 3 + n_guys * (p.elements - 1), "mesh.bays", 9 * n + 3 + n_guys * p.elements)
    leg = np.arange(3)
    after, angle = (leg + 1) % 3, 2.0 * np.pi * leg / 3.0
    way = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    mast = np.tile(p.width / np.sqrt(3.0) * way, (n + 1, 1, 1))  # (levels, legs, 3)
    mast[..., 2] = (p.height * np.arange(n + 1) / n)[:, None]
    ends = np.arange(1, p.levels + 1) * n // p.levels  # levels of the mast at which guys end
    anchors, share = p.radius * way[:, None], (np.arange(1, p.elements) / p.elements)[:, None]
    inner = anchors + (mast[ends][:, :, None] - anchors) * share
    points = np.concatenate([mast.reshape(-1, 3), anchors[:, 0], inner.reshape(-1, 3)])
    # legs, diagonals that wind about the mast, and horizontals of each bay; horizontals at the ground; guys
    low = 3 * np.arange(n)[:, None]
    sides = (low + leg, low + leg, low + 3 + leg), (low + 3 + leg, low + 3 + after, low + 3 + after)
    within = n_mast + 3 + np.arange(n_guys * (p.elements - 1)).reshape(p.levels, 3, -1)
    feet, heads = np.broadcast_to(n_mast + leg, (p.levels, 3)), 3 * ends[:, None] + leg
    chain = np.concatenate([feet[..., None], within, heads[..., None]], axis=2)
    guys = np.stack([chain[..., :-1], chain[..., 1:]], axis=-1)
    of_bays = np.stack([np.stack(each, axis=1) for each in sides], axis=-1)
    bars = np.concatenate([of_bays.reshape(-1, 2), np.stack([leg, after], axis=1), guys.reshape(-1, 2)])
    number = np.arange(len(bars))
    kind = np.where(number < 9 * n, number // 3 % 3, np.where(number < 9 * n + 3, 2, 3))
    nodes = np.arange(n_mast + 3)
    node_groups = {"base": nodes[:3], "top": nodes[-6:-3], "mast": nodes[:-3], "anchors": nodes[-3:]}
    kinds = ("legs", "diagonals", "horizontals", "guys")
    bar_groups = {name: np.flatnonzero(kind == k) for k, name in enumerate(kinds)}
    return slab_of_whole(points, bars, node_groups, bar_groups, "generator mast", rank, size)
