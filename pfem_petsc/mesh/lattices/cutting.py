"""What is left of a block: struts that are missing at random, and those that lie outside a surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from ...parallel.agreement import agreed
from ..slab import slab_range
from .block import Block
from .numbering import CellByCell, Places
from .pruning import Kept, end_points
from .region import Region
from .shape import random_numbers
from .surface import ON, Surface

__all__ = ["Cut", "cut_block"]

_MISSING = 8  # stream of random numbers; those below belong to perturbations


@dataclass
class Cut:
    """What leaves out bars of a block."""

    missing: float = 0.0
    """Probability with which a strut is left out."""
    seed: int = 0
    surface: Surface | None = None
    """Bars outside of it are left out."""
    clip: bool = False
    """Whether bars that pass the surface end there, else they are left out."""
    keep: Callable[[np.ndarray], np.ndarray] | None = None
    """Which nodes at points (n, 3) are kept."""
    shortest: float = 0.0
    """Fraction of its length that must be left of a bar."""


def cut_block(block: Block, cut: Cut, longest: float, comm: MPI.Comm) -> tuple[Kept, Region]:
    """Return this rank's bars that are left, and the region of their nodes. Collective.

    Parameters
    ----------
    longest : a length [m] that no bar exceeds
    """
    bars = slab_range(block.bars.total, comm.rank, comm.size)
    region = Region(comm, block.nodes.total, *_used_nodes(block, *bars))
    first, last = slab_range(block.nodes.total, comm.rank, comm.size)
    distance = there = np.empty(0)
    if cut.surface is not None:
        slab = [np.empty(0)]
        for numbers, places in block.nodes.pieces(first, last):
            slab.append(cut.surface.rough_distances(block.positions(numbers, places), longest))
        distance = region.fetch(np.concatenate(slab))
    if cut.keep is not None:
        slab = [np.empty(0, bool)]
        with agreed(comm):
            for numbers, places in block.nodes.pieces(first, last):
                slab.append(cut.keep(block.positions(numbers, places)))
        there = region.fetch(np.concatenate(slab))
    pieces = []
    for numbers, places in block.bars.pieces(*bars):
        if cut.missing:
            drawn = random_numbers(cut.seed, _MISSING, numbers) >= cut.missing
            numbers, places = numbers[drawn], places.chosen(drawn)
        ends = np.stack([block.end(places, which)[0] for which in (0, 1)], axis=1)
        lost = np.empty(0, np.int64)
        if cut.keep is not None:
            both = there[ends - region.first]
            whole = both.all(axis=1)
            lost = ends[both & ~whole[:, None]]
            numbers, places, ends = numbers[whole], places.chosen(whole), ends[whole]
        piece = Kept(numbers, ends)
        if cut.surface is not None:
            piece = _within(block, cut, numbers, places, ends, distance[ends - region.first], longest)
        piece.cut = np.concatenate([piece.cut, lost])
        pieces.append(piece)
    return _joined(pieces), region


def _used_nodes(block: Block, first: int, last: int) -> tuple[int, int]:
    """Return a range that has the nodes of a range of bars."""
    if first == last:
        return 0, 0
    if isinstance(block.nodes, CellByCell) and not block.closed:
        # ends of a bar are in its cell and the next ones along each axis
        _, i, j, _ = block.bars.decode(np.array([first, last - 1]))
        return block.nodes.row(int(i[0]), int(j[0])), block.nodes.row(int(i[1]) + 1, int(j[1]) + 2)
    low, high = block.nodes.total, 0
    for _, places in block.bars.pieces(first, last):
        for which in (0, 1):
            numbers = block.end(places, which)[0]
            low, high = min(low, int(numbers.min())), max(high, int(numbers.max()) + 1)
    return low, high


def _within(
    block: Block,
    cut: Cut,
    numbers: np.ndarray,
    places: Places,
    ends: np.ndarray,
    distance: np.ndarray,
    longest: float,
) -> Kept:
    """Return what of some bars is inside the surface; ``distance`` (b, 2) [m] of their ends from it."""
    surface = cut.surface
    assert surface is not None
    inside = distance <= ON * longest
    # The distances of two points differ by no more than they are apart: a bar whose ends are far enough from the
    # surface does not reach it.
    clear = np.abs(distance).sum(axis=1) > longest
    touching = np.flatnonzero(~clear & (inside.any(axis=1) if cut.clip else inside.all(axis=1)))
    whole = clear & inside.all(axis=1)
    starts, stops = end_points(block, Kept(numbers[touching], ends[touching]), places.chosen(touching))
    strictly = (distance[touching] < -ON * longest).all(axis=1)
    line, span = surface.inside_parts(starts, stops, strictly)
    entire = (span == (0.0, 1.0)).all(axis=1)
    whole[touching[line[entire]]] = True
    pieces = [Kept(numbers[whole], ends[whole])]
    held = np.repeat(whole[:, None], 2, axis=1)
    if cut.clip:
        # what is left of a bar is joined to the lattice at one end, and ends on the surface at the other
        part = ~entire & (span == (0.0, 1.0)).any(axis=1) & (span[:, 1] - span[:, 0] >= cut.shortest)
        line, span = line[part], span[part]
        bar, at_start = touching[line], span[:, 0] == 0.0
        t = np.where(at_start, span[:, 1], span[:, 0])[:, None]
        new = -1 - np.arange(len(line))
        joined = np.where(at_start[:, None], np.stack([ends[bar, 0], new], 1), np.stack([new, ends[bar, 1]], 1))
        pieces.append(Kept(numbers[bar], joined, (1.0 - t) * starts[line] + t * stops[line]))
        held[bar, np.where(at_start, 0, 1)] = True
    kept = _joined(pieces)
    kept.cut = ends[inside & ~held]
    return kept


def _joined(pieces: list[Kept]) -> Kept:
    """Return all bars, in the order of their numbers, with the new nodes in the order of their bars."""
    bars = np.concatenate([np.empty(0, np.int64), *(piece.bars for piece in pieces)])
    before = np.cumsum([0, *(len(piece.points) for piece in pieces)])
    ends = [np.where(piece.ends < 0, piece.ends - start, piece.ends) for piece, start in zip(pieces, before)]
    order = np.argsort(bars, kind="stable")
    joined = np.concatenate([np.empty((0, 2), np.int64), *ends])[order]
    new = -1 - joined[joined < 0]
    points = np.concatenate([np.empty((0, 3)), *(piece.points for piece in pieces)])[new]
    joined[joined < 0] = -1 - np.arange(len(new))
    cut = np.concatenate([np.empty(0, np.int64), *(piece.cut for piece in pieces)])
    return Kept(bars[order], joined, points, cut)
