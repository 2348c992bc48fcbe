"""A lattice mast of three legs on the z axis, with guys in three directions at several heights."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveInt, StrictModel
from ...errors import InputError
from ..slab import MeshSlab
from .base import Length, Part


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
    guys, inner = 3 * p.levels, p.elements - 1
    mast_nodes, mast_bars = 3 * (n + 1), 9 * n + 3
    n_nodes, n_bars = mast_nodes + 3 + guys * inner, mast_bars + guys * p.elements
    part = Part(n_nodes, n_bars, rank, size, "mesh.bays")
    numbers = part.nodes

    def place(nodes: np.ndarray) -> np.ndarray:
        """Points (k, 3) of mast nodes and anchors."""
        level, leg = np.divmod(nodes, 3)
        anchor = level > n
        angle, distance = 2.0 * np.pi * leg / 3.0, np.where(anchor, p.radius, p.width / np.sqrt(3.0))
        height = np.where(anchor, 0.0, p.height * level / n)
        return np.stack([distance * np.cos(angle), distance * np.sin(angle), height], axis=1)

    def ends(guy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Anchor and node of the mast of guys (k,): three at each level, from below."""
        level, leg = np.divmod(guy, 3)
        return mast_nodes + leg, 3 * ((level + 1) * n // p.levels) + leg

    points = place(np.minimum(numbers, mast_nodes + 2))
    within = numbers >= mast_nodes + 3
    guy, k = np.divmod(numbers[within] - mast_nodes - 3, max(inner, 1))
    low, high = (place(node) for node in ends(guy))
    points[within] = low + (high - low) * ((k + 1) / p.elements)[:, None]

    of_mast = part.bars < mast_bars
    bay, kind = np.divmod(part.bars, 9)
    leg = kind % 3
    after, ground = (leg + 1) % 3, bay == n  # the last three bars of the mast: horizontals at the ground
    # legs, diagonals that wind about the mast, horizontals; guys
    kind = np.where(of_mast, np.where(ground, 2, kind // 3), 3)
    bottom, top = np.where(ground, 0, 3 * bay), np.where(ground, 0, 3 * (bay + 1))
    guy, k = np.divmod(part.bars - mast_bars, p.elements)
    anchor, head = ends(guy)
    before = mast_nodes + 3 + guy * inner + k - 1
    first = np.choose(kind, [bottom + leg, bottom + leg, top + leg, np.where(k == 0, anchor, before)])
    second = np.choose(kind, [top + leg, top + after, top + after, np.where(k == inner, head, before + 1)])
    node_groups = {
        "base": numbers < 3,
        "top": (numbers >= mast_nodes - 3) & (numbers < mast_nodes),
        "mast": numbers < mast_nodes,
        "anchors": (numbers >= mast_nodes) & (numbers < mast_nodes + 3),
    }
    bar_groups = {name: kind == k for k, name in enumerate(("legs", "diagonals", "horizontals", "guys"))}
    return part.slab("mast", points, (first, second), node_groups, bar_groups)
