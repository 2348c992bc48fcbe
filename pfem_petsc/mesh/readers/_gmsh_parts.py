"""Gmsh files of version 4.1 read in parts: rank 0 parses pieces of the file and sends them on; no rank has the whole.

What is not as it should be, or needs all lines at once (data of elements), is left to the reader of whole files, which
says what is wrong.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ...errors import InputError
from ._gmsh_sections import Format, Numbers, find_sections, read_entities
from ._gmsh_stream import END, FAILED, LINES, MARKED, POINTS, TAGS, Sender, Stream, receive, steps

__all__ = ["Parsed", "parse"]


class Parsed:
    """What a rank has of a file after :func:`parse`.

    Attributes
    ----------
    tags, points : of the nodes of this rank's slab
    lines : pieces of rows: number or tag, both tags of nodes, place in ``groups``
    marked : rows: tag of a node with groups, place in ``groups``
    n_nodes, n_lines, others : of the whole file; other elements than lines and points
    groups : combinations of tags of physical groups, of nodes and of lines
    """

    def __init__(self) -> None:
        self.tags = np.empty(0, np.int64)
        self.points = np.empty((0, 3))
        self.lines: list[np.ndarray] = []
        self.marked = np.empty((0, 2), np.int64)
        self.n_nodes = self.n_lines = self.others = 0
        self.groups: list[tuple[int, ...]] = []


def parse(path: Path, comm: MPI.Comm, line: int, point: int, nodes_of: Any) -> tuple[Parsed, dict[str, Any]] | None:
    """Parse a file on rank 0 and send each rank its parts; None on all ranks for files that are read whole. Collective.

    Parameters
    ----------
    line, point : types of elements
    nodes_of : function of the path, the head of a file's elements and a type, its number of nodes

    Returns
    -------
    parsed : Parsed
    texts : payloads of the small sections by name
    """
    held: dict[int, list[np.ndarray]] = {kind: [] for kind in (TAGS, POINTS, LINES, MARKED)}
    head = None
    if comm.rank == 0:
        # what is wrong is told by the reader of whole files
        with contextlib.suppress(InputError, ValueError, OSError, OverflowError, MemoryError):
            head = _send_all(path, comm, held, line, point, nodes_of)
        for rank in range(1, comm.size):
            comm.Send(np.empty(0), rank, END if head is not None else FAILED)
    elif not receive(comm, held):
        held = {}
    head = comm.bcast(head)
    if head is None:
        return None
    parsed = Parsed()
    parsed.n_nodes, parsed.n_lines, parsed.others, parsed.groups, texts = head
    parsed.tags = np.concatenate([parsed.tags, *held.pop(TAGS)])
    parsed.points = np.concatenate([parsed.points, *held.pop(POINTS)])
    parsed.marked = np.concatenate([parsed.marked, *held.pop(MARKED)])
    parsed.lines = held.pop(LINES)
    return parsed, texts


def _send_all(path: Path, comm: MPI.Comm, held: dict[int, list], line: int, point: int, nodes_of: Any) -> tuple | None:
    """Rank 0: parse nodes and elements, and send them; return what all ranks need, None if the file is read whole."""
    with open(path, "rb") as file:
        places = find_sections(path, file)
        unfit = {"PartitionedEntities", "ElementData"} & set(places)
        if unfit or any(len(places.get(name, [])) != 1 for name in ("MeshFormat", "Nodes", "Elements")):
            return None

        def payload(name: str) -> bytes:
            begin, end = places[name][0]
            file.seek(begin)
            return file.read(end - begin)

        layout = Format(path, payload("MeshFormat"))
        if layout.version != "4.1":
            return None
        texts = {name: payload(name) for name in ("PhysicalNames", "Comments") if name in places}

        def stream(name: str) -> Stream:
            return Stream(f"{path}: section ${name}", file, *places[name][0], layout)

        entities = read_entities(stream("Entities")) if "Entities" in places else {}
        groups = {entity: tuple(abs(tags).tolist()) for entity, tags in entities.items()}
        n_nodes = _nodes(stream("Nodes"), comm, held, places["Nodes"][0])
        return (n_nodes, *_elements(path, stream("Elements"), comm, held, groups, line, point, nodes_of), texts)


def _nodes(numbers: Numbers, comm: MPI.Comm, held: dict[int, list], place: tuple[int, int]) -> int:
    n_blocks, n_nodes, _, _ = numbers.sizes(4).tolist()
    if n_nodes > place[1] - place[0]:
        raise ValueError("more nodes than bytes")
    tags = Sender(comm, TAGS, held[TAGS], n_nodes)
    points = Sender(comm, POINTS, held[POINTS], n_nodes)
    for _ in range(n_blocks):
        dimension, _, parametric = numbers.ints(3).tolist()
        if dimension not in (0, 1, 2, 3):
            raise ValueError("a block of no dimension")
        n = int(numbers.sizes(1)[0])
        if tags.sent + n > n_nodes:
            raise ValueError("more nodes than declared")
        width = 3 + (dimension if parametric else 0)
        for some in steps(n):
            tags.add(numbers.sizes(some))
        for some in steps(n):
            points.add(numbers.reals(some * width).reshape(some, width)[:, :3])
    numbers.end()
    tags.flush()
    points.flush()
    if tags.sent != n_nodes:
        raise ValueError("fewer nodes than declared")
    return n_nodes


def _elements(
    path: Path,
    numbers: Numbers,
    comm: MPI.Comm,
    held: dict[int, list],
    groups: dict,
    line: int,
    point: int,
    nodes_of: Any,
) -> tuple[int, int, list[tuple[int, ...]]]:
    """Send lines and marked nodes; return the number of lines and of other elements, and combinations of groups."""
    n_blocks, declared, _, _ = numbers.sizes(4).tolist()
    lines, marked = Sender(comm, LINES, held[LINES]), Sender(comm, MARKED, held[MARKED])
    known: dict[tuple[int, ...], int] = {}
    n_lines = others = found = 0
    for _ in range(n_blocks):
        dimension, entity, kind = numbers.ints(3).tolist()
        n, nodes = int(numbers.sizes(1)[0]), nodes_of(path, kind)
        combination = groups.get((dimension, entity), ())
        # groups of points and of lines are different ones
        combination = tuple(sorted({tag for tag in combination if tag}))
        at = known.setdefault(combination, len(known))
        for some in steps(n):
            rows = numbers.sizes(some * (1 + nodes)).reshape(some, 1 + nodes)
            if kind == line:
                lines.add(np.column_stack([rows, np.full(some, at)]))
            elif kind == point:
                marked.add(np.column_stack([rows[:, 1], np.full(some, at)]))
        n_lines += n * (kind == line)
        others += n * (kind not in (line, point))
        found += n
    numbers.end()
    lines.flush()
    marked.flush()
    if found != declared:
        raise ValueError("other elements than declared")
    return n_lines, others, list(known)
