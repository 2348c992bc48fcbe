"""A block of a space lattice: built-in or own unit cells, graded, curved, or cut to a closed surface.

A rank has its part of the nodes and bars of a whole block, or of what is left of one: struts may be missing at random,
or lie outside a surface or where the expression ``keep`` is false, or dangle. The rest is renumbered in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from ....errors import InputError
from ....parallel.agreement import agreed, on_root
from ...exchange import Router
from ...slab import MeshSlab, index_type, slab_of, slab_range
from .block import FACES, PIECE, Block, Parameters, Places, fitted, random_numbers
from .cells import mechanism_warning
from .surface import ON, Surface, read_surface

__all__ = ["Parameters", "generate", "generate_on"]

_MISSING = 8  # stream of random numbers; those below belong to perturbations


class _Wanted(NamedTuple):
    """Names of the cell fields and bar groups to make."""

    fields: list[str]
    groups: list[str]

    @classmethod
    def of(cls, block: Block, fields: Collection[str], groups: Collection[str] | None) -> _Wanted:
        """Return these fields, and all bar groups unless none of ``groups`` can be one."""
        # a name that is not known may be misspelt: the message about it lists them all
        every = groups is None or any(name not in ("surface", *FACES) for name in groups)
        return cls(list(fields), [*block.cell.groups, *["skin"] * bool(block.cell.skin)] if every else [])


def generate(parameters: Parameters, rank: int, size: int) -> MeshSlab:
    """Generate this rank's part of a lattice from which nothing is cut, by index arithmetic and without messages.

    Corners without a bar, of kinds such as ``diamond``, are still in it.

    Node groups: ``bottom`` and ``top`` (z faces), ``left`` and ``right`` (x faces), ``front`` and ``back`` (y faces).
    Bar groups: those of the unit cell.
    """
    block = Block(parameters, plain=True)
    return _uncut(block, rank, size, _Wanted.of(block, (), None))


def generate_on(
    parameters: Parameters, comm: MPI.Comm, fields: Mapping[str, str], groups: Collection[str] | None
) -> MeshSlab:
    """Generate this rank's part; no rank has the whole lattice. Collective.

    Parameters
    ----------
    fields : names of cell fields to make, each with the key that asks for it, for messages
    groups : names of the bar groups to make; None: all

    Raises
    ------
    InputError
        On all ranks.
    """
    keys = parameters
    with agreed(comm):
        for name, key in fields.items():
            if name not in (keys.bar_fields or {}):
                known = ", ".join(keys.bar_fields or {}) or "none"
                raise InputError(f"{key} = {name!r}: mesh.bar_fields has no such field; it has {known}")
    surface = None if keys.surface is None else on_root(comm, read_surface, Path(keys.surface.file), keys.surface.scale)
    partial = bool(keys.missing or surface or keys.keep is not None)
    with agreed(comm):
        block = Block(fitted(keys, surface) if surface is not None else keys, plain=not partial)
        wanted, bare = _Wanted.of(block, fields, groups), block.has_bare_nodes()
        if keys.map is not None:  # what cannot be computed is found before anything is sent
            block.nodes.arrays(slab_range(block.nodes.total, comm.rank, comm.size), lambda *at: [block.positions(*at)])
    if not (partial or bare or keys.dangling == "remove"):
        with agreed(comm):
            try:
                return _uncut(block, comm.rank, comm.size, wanted)
            except MemoryError:
                raise InputError("mesh: the lattice does not fit in this machine's memory") from None
    left = _Left(block, comm, surface)
    if keys.dangling == "remove" or (keys.dangling is None and partial):
        left.remove_dangling()
    if comm.allreduce(len(left.bars)) == 0:
        remedy = "use a smaller pitch" if surface else 'use more cells, leave out less, or dangling = "keep"'
        raise InputError(f"mesh: no strut is {'inside the surface' if surface else 'left'}; {remedy}")
    return left.renumbered(wanted)


def _uncut(block: Block, rank: int, size: int, wanted: _Wanted) -> MeshSlab:
    nodes, bars = (slab_range(numbering.total, rank, size) for numbering in (block.nodes, block.bars))

    def of_nodes(numbers: np.ndarray, places: Places) -> list[np.ndarray]:
        return [block.positions(numbers, places), *(block.on_face(places, name) for name in block.faces)]

    def of_bars(_numbers: np.ndarray, places: Places) -> list[np.ndarray]:
        ends = [block.end(places, which) for which in (0, 1)]
        numbers = np.stack([ends[0][0], ends[1][0]], axis=1).astype(index_type(block.nodes.total))
        at = [block.positions(*end) for end in ends] if wanted.fields else []
        return [numbers, *_of_bars(block, places, wanted, at)]

    points, *faces = block.nodes.arrays(nodes, of_nodes)
    ends, *marks = block.bars.arrays(bars, of_bars)
    groups = {name: nodes[0] + np.flatnonzero(mark) for name, mark in zip(block.faces, faces)}
    slab = MeshSlab(block.nodes.total, block.bars.total, nodes[0], points, bars[0], ends, groups)
    slab.volume = block.volume if block.keys.map is None else None
    if block.disturbed:
        (slab.undisturbed,) = block.nodes.arrays(nodes, lambda *at: [block.positions(*at, disturbed=False)])
    return _completed(slab, block, wanted, marks)


def _of_bars(block: Block, places: Places, wanted: _Wanted, ends: list[np.ndarray]) -> list[np.ndarray]:
    """Return the memberships (n,) of bars in the groups wanted, and the fields (n,) at the middles of their ends."""
    groups = block.groups_of(places) if wanted.groups else {}
    middles = 0.5 * (ends[0] + ends[1]) if ends else np.empty((0, 3))
    fields = [block.expressions.at(middles, f"bar_fields.{name}") for name in wanted.fields]
    return [groups[name] for name in wanted.groups] + fields


def _completed(slab: MeshSlab, block: Block, wanted: _Wanted, marks: list[np.ndarray]) -> MeshSlab:
    """Give a slab what is wanted of its bars, see :func:`_of_bars`, its source and warnings."""
    slab.bar_groups = {name: slab.first_bar + np.flatnonzero(mark) for name, mark in zip(wanted.groups, marks)}
    slab.bar_fields = dict(zip(wanted.fields, marks[len(wanted.groups) :]))
    slab.structured = block.keys.map is None  # a map may make nodes of a bar meet
    slab.source = f"generator lattice ({block.keys.kind})"
    slab.warnings = mechanism_warning(block.keys.kind, block.cell)
    return slab


class _Left:
    """This rank's bars that are left of its range of a block, in the order of their numbers. Collective."""

    bars: np.ndarray
    """(b,) int64: numbers in the block; twice where a bar was divided."""
    ends: np.ndarray
    """(b, 2) int64: numbers of nodes in the block, or -1 - m for the new node m of this rank."""
    points: np.ndarray
    """(m, 3) [m]: new nodes, in the order of their bars."""
    lost: np.ndarray
    """Nodes of the block, as often as they have lost a bar to a surface or an expression."""

    def __init__(self, block: Block, comm: MPI.Comm, surface: Surface | None) -> None:
        self.block, self._comm, self._surface = block, comm, surface
        keys, total = block.keys, block.nodes.total
        self._slab = slab_range(total, comm.rank, comm.size)
        pieces = [(np.empty(0, np.int64), np.empty((0, 2), np.int64))]
        for numbers, places in block.bars.pieces(*slab_range(block.bars.total, comm.rank, comm.size)):
            ends = np.stack([block.end(places, which)[0] for which in (0, 1)], axis=1)
            if keys.missing:
                drawn = random_numbers(keys.seed or 0, _MISSING, numbers) >= keys.missing
                numbers, ends = numbers[drawn], ends[drawn]
            pieces.append((numbers, ends))
        self.bars, self.ends = (np.concatenate(parts) for parts in zip(*pieces))
        self.points, self.lost = np.empty((0, 3)), np.empty(0, np.int64)
        # the range of nodes at which these bars end, most of which are in the slab of this rank
        self._first = int(self.ends.min(initial=total))
        used = np.arange(self._first, int(self.ends.max(initial=-1)) + 1)
        self._n_used, self._router = len(used), Router(comm, slab_of(used, total, comm.size))
        self._asked = self._router.send(used) - self._slab[0]
        if keys.keep is not None:
            with agreed(comm):
                (values,) = block.nodes.arrays(
                    self._slab, lambda *nodes: [block.expressions.at(block.positions(*nodes), "keep")]
                )
            there = self._fetched(values != 0.0)[self.ends - self._first]
            whole = there.all(axis=1)
            self.lost = self.ends[there & ~whole[:, None]]
            self.bars, self.ends = self.bars[whole], self.ends[whole]
        if surface is not None:
            self._cut(surface)

    def _fetched(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the range of nodes from those (nodes of the slab,) of all ranks. Collective."""
        return self._router.reply(values[self._asked])

    def _counts(self, nodes: np.ndarray) -> np.ndarray:
        """Return how often (nodes of the slab,) each node is in the lists of all ranks. Collective."""
        sums = np.zeros(self._slab[1] - self._slab[0], np.int64)
        np.add.at(sums, self._asked, self._router.send(np.bincount(nodes - self._first, minlength=self._n_used)))
        return sums

    def _end_points(self, rows: slice | np.ndarray) -> list[np.ndarray]:
        """Return the positions (n, 3) [m] of the first and the second ends of some bars."""
        at, found = self.block.bars.decode(self.bars[rows]), []
        for which, ends in enumerate(self.ends[rows].T):
            points = self.block.positions(*self.block.end(at, which))
            points[ends < 0] = self.points[-1 - ends[ends < 0]]
            found.append(points)
        return found

    def _longest(self) -> float:
        """Return a length [m] that no bar of any rank exceeds. Collective."""
        used, longest = (self._first, self._first + self._n_used), 0.0
        (points,) = self.block.nodes.arrays(used, lambda *nodes: [self.block.positions(*nodes)])
        for start in range(0, len(self.bars), PIECE):
            ends = points[self.ends[start : start + PIECE] - self._first]
            longest = max(longest, float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max()))
        return self._comm.allreduce(longest, op=MPI.MAX) * (1.0 + 1e-9)

    def _cut(self, surface: Surface) -> None:
        """Leave out what of the bars is outside the surface. Collective."""
        clip, longest = self.block.keys.surface.cut == "clip", self._longest()
        # at a face, struts are left out up to their length, or belong to cells of which half is outside
        self._unsure = 0.5 * surface.area * longest
        (distance,) = self.block.nodes.arrays(
            self._slab, lambda *nodes: [surface.rough_distances(self.block.positions(*nodes), longest)]
        )
        distance = self._fetched(distance)[self.ends - self._first]
        inside = distance <= ON * longest
        # The distances of two points differ by no more than they are apart: a bar whose ends are far enough from the
        # surface does not reach it.
        clear = np.abs(distance).sum(axis=1) > longest
        touching = np.flatnonzero(~clear & (inside.any(axis=1) if clip else inside.all(axis=1)))
        starts, stops = self._end_points(touching)
        line, span = surface.inside_parts(starts, stops, (distance[touching] < -ON * longest).all(axis=1))
        entire = (span == (0.0, 1.0)).all(axis=1)
        whole = clear & inside.all(axis=1)
        whole[touching[line[entire]]] = True
        held = np.repeat(whole[:, None], 2, axis=1)
        bars, ends = [self.bars[whole]], [self.ends[whole]]
        if clip:
            # what is left of a bar is joined to the lattice at one end, and ends on the surface at the other
            shortest = self.block.keys.surface.shortest
            part = ~entire & (span == (0.0, 1.0)).any(axis=1) & (span[:, 1] - span[:, 0] >= shortest)
            line, span = line[part], span[part]
            bar, cut_end = touching[line], np.where(span[:, 0] == 0.0, 1, 0)
            new = np.arange(len(line))
            t = span[new, cut_end][:, None]
            self.points = (1.0 - t) * starts[line] + t * stops[line]
            joined = self.ends[bar]
            joined[new, cut_end] = -1 - new
            bars.append(self.bars[bar])
            ends.append(joined)
            held[bar, 1 - cut_end] = True
        self.lost = np.concatenate([self.lost, self.ends[inside & ~held]])
        self.bars, self.ends = np.concatenate(bars), np.concatenate(ends)
        order = np.argsort(self.bars, kind="stable")
        self.bars, self.ends = self.bars[order], self.ends[order]

    def remove_dangling(self) -> None:
        """Leave out bars that end at a node of the block with no other, until there are none. Collective."""
        while True:
            old = self.ends >= 0
            loose = self._fetched(self._counts(self.ends[old]) == 1)
            dangling = np.zeros(old.shape, bool)
            dangling[old] = loose[self.ends[old] - self._first]
            kept = ~dangling.any(axis=1)
            if self._comm.allreduce(bool(kept.all()), op=MPI.LAND):
                return
            self.bars, self.ends = self.bars[kept], self.ends[kept]
            new = self.ends < 0
            used = -1 - self.ends[new]  # ascending, as the bars are
            self.points, self.ends[new] = self.points[used], -1 - np.arange(len(used))

    def _filled(self) -> float:
        """Return the volume [m3] that the struts left fill: each has its share of its cell, or what is left of that.
        Collective."""
        share, cut = np.ones(len(self.bars)), np.flatnonzero((self.ends < 0).any(axis=1))
        at = self.block.bars.decode(self.bars)
        if len(cut):
            places = self.block.bars.decode(self.bars[cut])
            whole = [self.block.positions(*self.block.end(places, which)) for which in (0, 1)]
            left = self._end_points(cut)
            share[cut] = np.linalg.norm(left[1] - left[0], axis=1) / np.linalg.norm(whole[1] - whole[0], axis=1)
        return self._comm.allreduce(float(share @ self.block.cell_volumes(at)) / len(self.block.cell.ends))

    def renumbered(self, wanted: _Wanted) -> MeshSlab:
        """Return this rank's part of what is left. Collective.

        Nodes of the block come first, in its order, then new ones in the order of their bars; bars keep their order.
        With a surface or ``keep`` there is a node group ``surface``: new nodes, and nodes that have lost a bar.
        """
        block, comm, keys = self.block, self._comm, self.block.keys
        used = self._counts(self.ends[self.ends >= 0]) > 0
        before, total = _counted(comm, int(used.sum()))
        number = np.where(used, before + np.cumsum(used) - 1, -1)
        new_before, n_new = _counted(comm, len(self.points))
        old = self._slab[0] + np.flatnonzero(used)
        places = block.nodes.decode(old)
        masks = {name: block.on_face(places, name) for name in block.faces}
        if self._surface is not None or keys.keep is not None:
            masks["surface"] = self._counts(self.lost)[used] > 0
        new = new_before + np.arange(len(self.points))
        first_node, moved = _moved(comm, np.concatenate([number[used], total + new]), total + n_new)
        points, undisturbed = (
            moved(np.concatenate([block.positions(old, places, disturbed), self.points]))
            if disturbed or block.disturbed
            else None
            for disturbed in (True, False)
        )
        groups = {
            name: first_node + np.flatnonzero(moved(np.concatenate([mask, np.full(len(new), name == "surface")])))
            for name, mask in masks.items()
        }
        is_new, in_range = self.ends < 0, self._fetched(number)
        ends = np.empty_like(self.ends)
        ends[is_new] = total + new_before - 1 - self.ends[is_new]
        ends[~is_new] = in_range[self.ends[~is_new] - self._first]
        bars_before, n_bars = _counted(comm, len(self.bars))
        with agreed(comm):
            at = self._end_points(slice(None)) if wanted.fields else []
            marks = _of_bars(block, block.bars.decode(self.bars), wanted, at)
        first_bar, moved = _moved(comm, bars_before + np.arange(len(self.bars)), n_bars)
        ends, *marks = (moved(rows) for rows in (ends.astype(index_type(total + n_new)), *marks))
        slab = MeshSlab(total + n_new, n_bars, first_node, points, first_bar, ends, groups)
        slab.undisturbed = undisturbed
        if keys.keep is None and keys.map is None:  # else it is not known what the lattice fills
            slab.volume = self._surface.volume if self._surface is not None else block.volume
        _completed(slab, block, wanted, marks)
        if self._surface is not None:
            slab.warnings = self._surface.warnings + slab.warnings
            if slab.volume is not None and keys.curved is None and not keys.missing:
                slab.filled = self._filled()
                if abs(slab.filled - slab.volume) > self._unsure:
                    slab.warnings.append(
                        f"mesh.surface: the cells of the struts fill {slab.filled:.4g} m3, and the surface encloses "
                        f"{slab.volume:.4g} m3, which differs by more than the size of cells explains: use more cells "
                        "or a smaller pitch, and look at the surface and the lattice"
                    )
        return slab


def _counted(comm: MPI.Comm, count: int) -> tuple[int, int]:
    """Return the sum of the counts of lower ranks, and of all. Collective."""
    return comm.scan(count) - count, comm.allreduce(count)


def _moved(comm: MPI.Comm, numbers: np.ndarray, n: int) -> tuple[int, Callable[[np.ndarray], np.ndarray]]:
    """Return the first number of this rank's slab of ``n``, and what sends rows with their numbers to the slabs.

    Both are collective; rows arrive in the order of their numbers.
    """
    router = Router(comm, slab_of(numbers, n, comm.size))
    order = np.argsort(router.send(numbers))
    return slab_range(n, comm.rank, comm.size)[0], lambda rows: router.send(rows)[order]
