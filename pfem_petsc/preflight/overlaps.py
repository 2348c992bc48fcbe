"""Overlapping bars: bars with a common node and the same direction.

A common mistake is a bar from node 0 to node 2 together with bars 0-1 and 1-2 on the same line. The truss is then
stiffer and heavier there than intended. Bars that cross at an angle, such as bracings, are valid and not reported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["ANGLE", "overlapping_bars"]

ANGLE = 1e-6
"""Bars that meet at a node at a smaller angle overlap [rad]; a node whose distance from a bar is less than this
fraction of its length lies on it. Coordinates saved in single precision have this accuracy."""

_SHOWN = 5
_WINDOW = 64  # neighbours in the order of directions that are compared with a bar

# A generic direction, to which bars of a mesh are unlikely to be perpendicular.
_GENERIC = np.array([0.6180339887, 0.4656766723, 0.6335178142])


def overlapping_bars(mesh: DistributedMesh) -> tuple[int, list[str]]:
    """Return the number of pairs of bars with a common node and direction, and the first few as texts. Collective.

    The bars of a node are compared in the order of their directions along a generic line: O(n log n) for n bars.
    """
    along = _directions(mesh, np.arange(len(mesh.bars))) @ _GENERIC
    # bar k has the halves 2 k and 2 k + 1 at its ends, the second one reversed
    half = np.flatnonzero(mesh.bars.ravel() < mesh.n_owned)
    half = half[mesh.bar_ids[half // 2] < mesh.n_bars - mesh.n_connectors]  # springs lie where they like
    # one number sorts by node, then by direction; for 10^7 nodes its last digit is 1e-9
    key = along[half // 2]
    key[half % 2 == 1] *= -1.0
    key *= 0.25
    key += mesh.bars.ravel()[half]
    order = np.argsort(key)
    key, half = key[order], half[order]
    one, two = [np.empty(0, np.intp)], [np.empty(0, np.intp)]
    for shift in range(1, min(_WINDOW, len(key))):
        near = np.flatnonzero(key[shift:] - key[:-shift] < ANGLE)
        if len(near) == 0:
            break
        a, b = half[near], half[near + shift]
        apart = _directions(mesh, a // 2) * (1 - 2 * (a % 2))[:, None]
        apart -= _directions(mesh, b // 2) * (1 - 2 * (b % 2))[:, None]
        same = np.einsum("ij,ij->i", apart, apart) < ANGLE**2
        same &= mesh.bars.ravel()[a] == mesh.bars.ravel()[b]
        one.append(a[same])
        two.append(b[same])
    first, second = np.concatenate(one) // 2, np.concatenate(two) // 2
    pairs = np.sort(np.stack([mesh.bar_ids[first], mesh.bar_ids[second]], axis=1), axis=1)
    name = {int(mesh.bar_ids[k]): _name(mesh, k) for k in np.concatenate([first, second])[:1000]}
    found = sorted((int(a), int(b)) for a, b in pairs.tolist() if a in name and b in name)[:_SHOWN]
    shown = [((a, b), f"{name[a]} and {name[b]}") for a, b in found]
    every = sorted(text for some in mesh.comm.allgather(shown) for text in some)
    return mesh.comm.allreduce(len(pairs)), [text for _, text in every[:_SHOWN]]


def _directions(mesh: DistributedMesh, bars: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) of bars from their first to their second ends."""
    direction = mesh.points[mesh.bars[bars, 1]]
    direction -= mesh.points[mesh.bars[bars, 0]]
    direction /= np.sqrt(np.einsum("ij,ij->i", direction, direction))[:, None]
    return direction


def _name(mesh: DistributedMesh, k: int) -> str:
    a, b = mesh.node_ids[mesh.bars[k]].tolist()
    return f"bar {mesh.bar_ids[k]} (nodes {a} and {b})"
