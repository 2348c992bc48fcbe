"""Overlapping bars, and nodes that lie on bars they are not connected to.

A common mistake is a bar from node 0 to node 2 together with bars 0-1 and 1-2 on the same line. The truss is then
stiffer and heavier there than intended. Bars that cross at an angle, such as bracings, are valid and not reported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI

from ..mechanics.compiled import kernel

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

__all__ = ["LARGEST", "NodesOnBars", "nodes_on_bars", "overlapping_bars"]

ANGLE = 1e-6
"""Bars that meet at a node at a smaller angle overlap [rad]; a node whose distance from a bar is less than this
fraction of its length lies on it. Coordinates saved in single precision have this accuracy."""

LARGEST = 20_000_000
"""Maximum number of nodes for :func:`nodes_on_bars`: every rank has the coordinates of all of them."""

_SHOWN = 5
_WINDOW = 64  # neighbours in the order of directions that are compared with a bar

# A generic direction, to which bars of a mesh are unlikely to be perpendicular.
_GENERIC = np.array([0.6180339887, 0.4656766723, 0.6335178142])

# Maximum work per bar: cells to be searched, and nodes per cell.
_PIECES, _CROWD = 50.0, 200.0


class NodesOnBars(NamedTuple):
    """Numbers of nodes on bars between their ends and of coinciding nodes, with descriptions of the first ones."""

    between: int
    shown_between: list[str]
    coinciding: int
    shown_coinciding: list[str]


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


def nodes_on_bars(mesh: DistributedMesh) -> NodesOnBars | None:
    """Find nodes that lie on bars to which they are not connected. Collective.

    Every rank searches along its bars in a grid of all nodes. Time and memory are proportional to their number if the
    lengths of bars and the distances of nodes do not differ too much.

    Returns
    -------
    NodesOnBars, or None if this would take too long: more nodes than :data:`LARGEST`, or lengths that differ too much
    """
    comm = mesh.comm
    if mesh.n_nodes > LARGEST:
        return None
    points = np.empty((mesh.n_nodes, 3))
    counts = np.array(comm.allgather(3 * mesh.n_owned))
    ids = np.empty(mesh.n_nodes, np.int64)
    gathered = np.empty_like(points)
    comm.Allgatherv(np.ascontiguousarray(mesh.node_ids[: mesh.n_owned], dtype=np.int64), [ids, counts // 3])
    comm.Allgatherv(np.ascontiguousarray(mesh.points[: mesh.n_owned]), [gathered, counts])
    points[ids] = gathered
    del ids, gathered
    counted = np.arange(len(mesh.bars))[mesh.counted]
    counted = counted[mesh.bar_ids[counted] < mesh.n_bars - mesh.n_connectors]
    bars = mesh.node_ids[mesh.bars[counted]].astype(np.int64).reshape(-1, 2)
    length = np.sqrt(((points[bars[:, 1]] - points[bars[:, 0]]) ** 2).sum(axis=1))
    low, high = points.min(axis=0), points.max(axis=0)
    total = comm.allreduce(float(length.sum()))
    cell = total / mesh.n_bars
    while True:
        # one more cell on each side, for nodes on the border
        shape = np.ceil((high - low) / cell).astype(np.float64) + 3.0
        if comm.allreduce(float((length / cell + 1.0).sum())) > _PIECES * mesh.n_bars or shape.prod() > 2.0**62:
            return None
        places = ((points - low) / cell).astype(np.int64) + 1
        across = shape.astype(np.int64)
        keys = (places[:, 2] * across[1] + places[:, 1]) * across[0] + places[:, 0]
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        crowd = np.diff(np.append(np.flatnonzero(np.diff(keys, prepend=-1)), len(keys)))
        if (crowd.astype(float) ** 2).sum() <= _CROWD * mesh.n_nodes:
            break
        cell *= 0.5
    found = np.empty((1000, 3), np.int64)
    twins = np.zeros(mesh.n_nodes, np.uint8)
    between, taken = _look(points, bars, length, low, cell, across, keys, order, found, twins)
    comm.Allreduce(MPI.IN_PLACE, twins, op=MPI.MAX)
    texts: tuple[list, list] = ([], [])
    for k, node, at in found[:taken].tolist():
        if at < 0:
            number = int(mesh.bar_ids[counted[k]])
            texts[0].append((number, node, f"node {node} on bar {number} (nodes {bars[k, 0]} and {bars[k, 1]})"))
        else:
            texts[1].append((min(at, node), max(at, node)))
    on_bars = sorted(line for some in comm.allgather(sorted(texts[0])[:_SHOWN]) for line in some)
    # a pair is found once for each bar of its nodes
    together = sorted({pair for some in comm.allgather(sorted(set(texts[1]))[:_SHOWN]) for pair in some})
    return NodesOnBars(
        comm.allreduce(between),
        [text for *_, text in on_bars[:_SHOWN]],
        int(twins.sum()),
        [f"nodes {a} and {b}" for a, b in together[:_SHOWN]],
    )


@kernel
def _look(points, bars, length, low, cell, across, keys, order, found, twins):
    """Return the number of nodes between the ends of bars, and of rows of ``found``: bar, node, and the coinciding end
    or -1; ``twins`` marks coinciding nodes."""
    between = taken = 0
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for k in range(len(bars)):
        a = bars[k, 0]
        b = bars[k, 1]
        tolerance = ANGLE * length[k]
        axis = (points[b] - points[a]) / length[k]
        n = int(np.ceil(length[k] / cell))
        for piece in range(n):
            begin = length[k] * piece / n
            end = length[k] * (piece + 1) / n
            for i in range(3):
                p = points[a, i] + begin * axis[i]
                q = points[a, i] + end * axis[i]
                first[i] = int(np.floor((min(p, q) - tolerance - low[i]) / cell)) + 1
                last[i] = int(np.floor((max(p, q) + tolerance - low[i]) / cell)) + 1
            for z in range(first[2], last[2] + 1):
                for y in range(first[1], last[1] + 1):
                    row = (z * across[1] + y) * across[0]
                    at = np.searchsorted(keys, row + first[0])
                    while at < len(keys) and keys[at] <= row + last[0]:
                        node = order[at]
                        at += 1
                        if node in (a, b):
                            continue
                        d = points[node] - points[a]
                        along = (d * axis).sum()
                        # a node between two pieces belongs to the first of them
                        if along > end + tolerance * (piece == n - 1) or (along <= begin and piece > 0):
                            continue
                        if along < -tolerance:
                            continue
                        away = d - along * axis
                        if (away * away).sum() > tolerance * tolerance:
                            continue
                        twin = -1
                        if along <= tolerance:
                            twin = a
                        elif along >= length[k] - tolerance:
                            twin = b
                        if twin < 0:
                            between += 1
                        else:
                            twins[node] = 1
                            twins[twin] = 1
                        if taken < len(found):
                            found[taken, 0] = k
                            found[taken, 1] = node
                            found[taken, 2] = twin
                            taken += 1
    return between, taken


def _directions(mesh: DistributedMesh, bars: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) of bars from their first to their second ends."""
    direction = mesh.points[mesh.bars[bars, 1]]
    direction -= mesh.points[mesh.bars[bars, 0]]
    direction /= np.sqrt(np.einsum("ij,ij->i", direction, direction))[:, None]
    return direction


def _name(mesh: DistributedMesh, k: int) -> str:
    a, b = mesh.node_ids[mesh.bars[k]].tolist()
    return f"bar {mesh.bar_ids[k]} (nodes {a} and {b})"
