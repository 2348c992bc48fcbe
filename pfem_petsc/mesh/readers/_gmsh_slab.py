"""From the parts of a Gmsh file that the ranks have to slabs: tags become numbers from 0."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI

from ..exchange import Router
from ..slab import MeshSlab, check_size, index_type, slab_of, slab_range
from ._gmsh_parts import Parsed
from ._shares import Members

__all__ = ["assemble"]


class _Directory:
    """Numbers of nodes by their tags, distributed over the ranks by ranges of tags. Collective."""

    def __init__(self, comm: MPI.Comm, tags: np.ndarray, first: int) -> None:
        self._comm = comm
        low = np.array([tags.min(initial=np.iinfo(np.int64).max), -tags.max(initial=0)])
        comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
        self._low, self._span = int(low[0]), int(-low[1] - low[0]) + 1
        router = Router(comm, slab_of(tags - self._low, self._span, comm.size))
        own, numbers = router.send(tags), router.send(np.arange(first, first + len(tags)))
        order = np.argsort(own, kind="stable")
        self._tags, self._numbers = own[order], numbers[order]
        self.unique = not comm.allreduce(int((self._tags[1:] == self._tags[:-1]).any()))

    def numbers(self, tags: np.ndarray) -> np.ndarray:
        """Return the numbers of nodes, -1 for tags that no node has."""
        wanted, place = np.unique(tags, return_inverse=True)
        inside = (wanted >= self._low) & (wanted < self._low + self._span)
        asking = Router(self._comm, slab_of(np.where(inside, wanted - self._low, 0), self._span, self._comm.size))
        asked = asking.send(wanted.astype(np.int64))
        at = np.minimum(np.searchsorted(self._tags, asked), max(len(self._tags) - 1, 0))
        found = np.full(len(asked), -1, np.int64)
        if len(self._tags):
            found = np.where(self._tags[at] == asked, self._numbers[at], -1)
        return asking.reply(found)[place.reshape(tags.shape)]


def assemble(
    parsed: Parsed, comm: MPI.Comm, names: dict[tuple[int, int], str], by_tags: bool, source: str
) -> MeshSlab | None:
    """Return this rank's slab; None on all ranks if tags are not unique or not there. Collective.

    ``by_tags``: the bars are numbered by the tags of the lines, which follow each other, else in the order of the file.
    """
    check_size(parsed.n_nodes, source)
    first_node, last_node = slab_range(parsed.n_nodes, comm.rank, comm.size)
    first_bar, last_bar = slab_range(parsed.n_lines, comm.rank, comm.size)
    directory = _Directory(comm, parsed.tags, first_node)
    parsed.tags = parsed.tags[:0]
    numbered = _numbered(parsed, comm, by_tags)
    bars = np.full((last_bar - first_bar, 2), -1, index_type(parsed.n_nodes))
    place = np.full(last_bar - first_bar, -1, np.int32)
    sound = directory.unique
    for rows in numbered:
        number = rows[:, 0].astype(np.int64)
        inside = (number >= 0) & (number < parsed.n_lines)
        sound &= bool(inside.all())
        router = Router(comm, slab_of(np.where(inside, number, 0), parsed.n_lines, comm.size))
        here = router.send(np.where(inside, number, 0)) - first_bar
        ends, of_groups = router.send(rows[:, 1:3].astype(np.int64)), router.send(rows[:, 3])
        bars[here] = directory.numbers(ends)
        place[here] = of_groups
    sound &= bool((bars >= 0).all()) and bool((place >= 0).all())
    marked = directory.numbers(parsed.marked[:, 0])
    sound &= bool((marked >= 0).all())
    if not comm.allreduce(int(sound), op=MPI.MIN):
        return None
    router = Router(comm, slab_of(marked, parsed.n_nodes, comm.size))
    nodes, node_place = router.send(marked), router.send(parsed.marked[:, 1])

    def members(dimension: int, numbers: np.ndarray | None, of_groups: np.ndarray, first: int, last: int) -> dict:
        used = np.zeros(len(parsed.groups), np.int64)
        used[np.unique(of_groups)] = 1
        comm.Allreduce(MPI.IN_PLACE, used, op=MPI.MAX)
        tags = sorted({tag for at in np.flatnonzero(used) for tag in parsed.groups[at]})
        found: dict[str, Members] = {}
        for tag in tags:
            group = found.setdefault(names.get((dimension, tag), f"group_{tag}"), Members(first, last))
            has = np.array([tag in combination for combination in parsed.groups])[of_groups]
            group.add(np.flatnonzero(has) + first if numbers is None else numbers[has])
        for (of, _), name in names.items():
            if of == dimension:
                found.setdefault(name, Members(first, last))
        return {name: group.numbers() for name, group in found.items()}

    warnings = []
    if parsed.others:
        warnings.append(f"{source}: left out {parsed.others} elements that are neither lines nor points")
    return MeshSlab(
        n_nodes=parsed.n_nodes,
        n_bars=parsed.n_lines,
        first_node=first_node,
        points=parsed.points,
        first_bar=first_bar,
        bars=bars,
        node_groups=members(0, nodes, node_place, first_node, last_node),
        bar_groups=members(1, None, place, first_bar, last_bar),
        source=source,
        warnings=warnings,
    )


def _numbered(parsed: Parsed, comm: MPI.Comm, by_tags: bool) -> Iterator[np.ndarray]:
    """Yield pieces of lines with their numbers in the place of tags, as many on each rank. Collective."""
    lowest = 0
    if by_tags:
        own = min((int(rows[:, 0].min()) for rows in parsed.lines), default=np.iinfo(np.int64).max)
        lowest = comm.allreduce(own, op=MPI.MIN)
    counts = comm.allgather([len(rows) for rows in parsed.lines])
    before = 0
    none = np.empty((0, 4), np.int64)
    for turn in range(max(map(len, counts))):
        # pieces went to the ranks in turn
        sizes = [some[turn] if turn < len(some) else 0 for some in counts]
        rows = none
        if turn < len(parsed.lines):
            rows = parsed.lines[turn].astype(np.int64)
            parsed.lines[turn] = none
            if by_tags:
                rows[:, 0] -= lowest
            else:
                start = before + sum(sizes[: comm.rank])
                rows[:, 0] = np.arange(start, start + len(rows))
        before += sum(sizes)
        yield rows
