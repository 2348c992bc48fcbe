"""A lattice mast of three legs on the z axis, with guys in three directions at several heights."""

from __future__ import annotations

import numpy as np

from ...case.base import PositiveFloat, PositiveInt, StrictModel
from ...errors import InputError
from ..slab import MeshSlab, check_length, check_size, index_type, slab_range

__all__ = ["Parameters", "generate"]


class Parameters(StrictModel):
    """Keys of ``[mesh]`` with ``generator = "mast"``."""

    height: PositiveFloat
    """Height of the mast [m]."""
    width: PositiveFloat
    """Distance of its legs [m]."""
    bays: PositiveInt
    """Number of bays over the height."""
    radius: PositiveFloat
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
    check_size(n_nodes, "mesh.bays")
    check_length(p.height / n, "mesh.height (over mesh.bays)")
    check_length(p.width, "mesh.width")
    check_length(p.radius / p.elements, "mesh.radius (over mesh.elements)")
    first_node, last_node = slab_range(n_nodes, rank, size)
    first_bar, last_bar = slab_range(n_bars, rank, size)
    numbers, bars = np.arange(first_node, last_node), np.arange(first_bar, last_bar)

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

    connected = np.empty((len(bars), 2), dtype=index_type(n_nodes))
    of_mast = bars < mast_bars
    bay, kind = np.divmod(bars[of_mast], 9)
    leg = kind % 3
    after = (leg + 1) % 3
    ground = bay == n  # the last three: horizontals at the ground
    kind = np.where(ground, 2, kind // 3)
    bottom, top = 3 * bay, np.where(ground, 0, 3 * (bay + 1))
    bottom = np.where(ground, 0, bottom)
    # legs, diagonals that wind about the mast, horizontals
    connected[of_mast, 0] = np.choose(kind, [bottom + leg, bottom + leg, top + leg])
    connected[of_mast, 1] = np.choose(kind, [top + leg, top + after, top + after])
    guy, k = np.divmod(bars[~of_mast] - mast_bars, p.elements)
    anchor, head = ends(guy)
    before = mast_nodes + 3 + guy * inner + k - 1
    connected[~of_mast, 0] = np.where(k == 0, anchor, before)
    connected[~of_mast, 1] = np.where(k == inner, head, before + 1)
    mast = bars[of_mast]
    return MeshSlab(
        n_nodes=n_nodes,
        n_bars=n_bars,
        first_node=first_node,
        points=points,
        first_bar=first_bar,
        bars=connected,
        node_groups={
            "base": numbers[numbers < 3],
            "top": numbers[(numbers >= mast_nodes - 3) & (numbers < mast_nodes)],
            "mast": numbers[numbers < mast_nodes],
            "anchors": numbers[(numbers >= mast_nodes) & (numbers < mast_nodes + 3)],
        },
        bar_groups={
            "legs": mast[kind == 0],
            "diagonals": mast[kind == 1],
            "horizontals": mast[kind == 2],
            "guys": bars[~of_mast],
        },
        source="generator mast",
        structured=True,
    )
