"""Gmsh files (.msh): versions 2 to 2.2 and 4.1 are read, ASCII and binary, 4.1 ASCII is written.

Two-node lines (element type 1) are the bars, in file order; points (type 15) with a physical group define node groups;
surfaces and volumes are left out with a warning. Nodes are numbered from 0 in file order. Data of elements
($ElementData) and nodes ($NodeData) with one component and a value for every line or node are fields. Rank 0 parses the
file in pieces, each of which goes to all ranks: no rank has the whole mesh, but for the lines of version 2, which rank
0 has at once.
"""

from __future__ import annotations

import codecs
import mmap
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import Router
from ..mesh.slab import MeshSlab, check_memory, index_type, slab_of, slab_range
from ..mesh.whole import WholeMesh, check_fields
from ..parallel.agreement import on_root
from ._numbers import numbers_of, shown, whole_numbers

SUFFIXES = (".msh",)

PIECE = 1 << 14
"""Number of rows that are parsed and sent at a time."""

BYTES = 1 << 18
"""Bytes of a text that are parsed at a time."""

_ORDERED = b"bars in the order of their tags"
"""In $Comments of a file whose elements are sorted by groups: the bars are numbered by their tags."""

_POINT, _LINE = 15, 1
_NONE = np.iinfo(np.int64).max
"""Above all tags: no tag."""

# Nodes of each type of element in Gmsh's documentation; curved lines are refused, the others skipped.
_NODES = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 7: 5, 8: 3, 9: 6, 10: 9, 11: 10, 12: 27, 13: 18, 14: 14, 15: 1, 16: 8}
_NODES |= {17: 20, 18: 15, 19: 13, 20: 9, 21: 10, 22: 12, 23: 15, 24: 15, 25: 21, 26: 4, 27: 5, 28: 6, 29: 20, 30: 35}
_NODES |= {31: 56, 92: 64, 93: 125}
_CURVED = (8, 26, 27, 28)

Rows = Iterator[tuple[Any, np.ndarray]]
"""Kind and rows: ``tags`` (n,) and ``points`` (n, 3) of nodes; ``lines`` (n, 4): tag, tags of both nodes, place of the
groups; ``marked`` (n, 2): tag of a node, place of its groups; ``("ElementData" or "NodeData", k, name)`` (n, 2): tag of
a line or node, value."""


@dataclass
class _Head:
    """What a file says besides its rows; all ranks have it after these."""

    names: dict[tuple[int, int], str]
    """Of physical groups, by dimension and tag."""
    ordered: bool
    """Whether bars are numbered by the tags of the lines."""
    n_others: int = 0
    """Elements that are neither lines nor points."""
    groups: dict[tuple[int, tuple[int, ...]], int] = field(default_factory=dict)
    """Places of dimension and tags of the physical groups that a line or point has."""
    fields: dict[str, list[str]] = field(default_factory=lambda: {"ElementData": [], "NodeData": []})
    """Names, by section."""
    warnings: list[str] = field(default_factory=list)

    def place(self, dimension: int, tags: Iterable[int]) -> int:
        """Return the place of groups; a negative tag is the same group with reversed orientation, 0 is none."""
        combination = tuple(sorted({abs(tag) for tag in tags if tag}))
        return self.groups.setdefault((dimension, combination), len(self.groups))


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Return this rank's slab of the mesh in a Gmsh file, with the named fields; None: with all. Collective.

    Raises
    ------
    InputError
        On all ranks, naming the section, for any content that is not a mesh of bars.
    """
    pieces, parts = _pieces(path, fields), _Parts(comm, str(path))
    while not isinstance(piece := on_root(comm, next, pieces), _Head):
        parts.add(*piece)
    slab = parts.slab(piece)
    if fields is not None:
        others = {name for names in piece.fields.values() for name in names if name not in fields}
        check_fields(path, fields, others | {*slab.bar_fields, *slab.node_fields})
    return slab


# ---- rank 0: from the file to rows


class _Layout(NamedTuple):
    """Content of the section $MeshFormat; ``size_type`` is the NumPy type of C's size_t in a binary file."""

    old: bool
    binary: bool
    order: str
    size_type: str


def _layout(path: Path, payload: bytes) -> _Layout:
    first, _, rest = payload.partition(b"\n")
    words = first.split()
    where = f"{path}: section $MeshFormat"
    if len(words) != 3 or words[1] not in (b"0", b"1") or words[2] not in (b"4", b"8"):
        raise InputError(f"{where}: {shown(first)!r} is not 'version file-type data-size', such as '4.1 0 8'")
    if words[0] not in (b"2", b"2.0", b"2.1", b"2.2", b"4.1"):
        raise InputError(
            f"{where}: version {shown(words[0])} is not read; save the mesh as version 4.1 or 2.2 "
            "(in Gmsh: Mesh.MshFileVersion)"
        )
    binary = words[1] == b"1"
    if binary and rest[:4] not in (b"\x01\0\0\0", b"\0\0\0\x01"):
        raise InputError(f"{where}: the binary number 1 that shows the byte order is missing")
    # versions 2 to 2.2 differ in nothing that is read here
    return _Layout(words[0] != b"4.1", binary, ">" if rest[:1] == b"\0" else "<", "u" + words[2].decode())


class _Section:
    """Numbers of one section of a file, from byte ``begin`` to ``end``, parsed in pieces.

    Every method raises InputError if the section ends early or has other content than requested.
    """

    def __init__(self, where: str, content: mmap.mmap, place: tuple[int, int], layout: _Layout) -> None:
        self._where, self._content, self._layout = where, content, layout
        self._begin, self._stop = place
        self._at = self._begin  # the next byte
        self._ahead = np.empty(0)  # numbers of a text that were parsed and not taken

    def count(self) -> int:
        """Return the count at the start of a section of version 2.2, which is text in a binary file too."""
        if not self._layout.binary:
            return int(self.sizes(1)[0])
        self._content.seek(self._at)
        line = self._content.readline()
        self._at += len(line)
        if not re.fullmatch(rb"\s*\d{1,18}\s*", line):
            raise InputError(f"{self._where}: {shown(line)!r} is not a count")
        return int(line)

    def ints(self, n: int) -> np.ndarray:
        """Return the next ``n`` integers (C's int)."""
        return self._whole(self._take(n, "i4"))

    def sizes(self, n: int) -> np.ndarray:
        """Return the next ``n`` counts or tags (C's size_t), as int64."""
        values = self._take(n, self._layout.size_type)
        if n and (values.min() < 0 or values.max() > _NONE):
            raise InputError(
                f"{self._where}: {float(values.min()):g} ... {float(values.max()):g} are not counts or tags"
            )
        return self._whole(values)

    def reals(self, n: int) -> np.ndarray:
        """Return the next ``n`` floating-point numbers."""
        return self._take(n, "f8").astype(np.float64)

    def rows(self, n: int, n_reals: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Return the next ``n`` rows of an integer and ``n_reals`` floating-point numbers, in pieces."""
        for some in _steps(n):
            if self._layout.binary:
                rows = self._take(some, f"i4,({n_reals},)f8")
                yield self._whole(rows["f0"]), rows["f1"].astype(np.float64)
            else:
                rows = self._take(some * (1 + n_reals)).reshape(some, 1 + n_reals)
                yield self._whole(rows[:, 0]), rows[:, 1:]

    def peek(self, n: int) -> np.ndarray:
        """Return at most the next ``n`` numbers of a text without taking them."""
        while len(self._ahead) < n and self._at < self._stop:
            end = min(self._at + BYTES, self._stop)
            if end < self._stop:  # not within a number
                cut = max(self._content.rfind(b"\n", self._at, end), self._content.rfind(b" ", self._at, end)) + 1
                end = cut or end
            self._ahead = np.concatenate([self._ahead, self._parsed(self._content[self._at : end])])
            self._at = end
        return self._ahead[:n]

    def end(self) -> None:
        """Refuse surplus numbers."""
        left = self._content[self._at : self._stop].strip() if self._layout.binary else self.peek(1)
        if len(left):
            raise InputError(f"{self._where}: has more numbers than its counts declare")

    def _take(self, n: int, kind: str = "f8") -> np.ndarray:
        if self._layout.binary:
            dtype = np.dtype(kind).newbyteorder(self._layout.order)
            start, self._at = self._at, self._at + n * dtype.itemsize
            short = not start <= self._at <= self._stop
        else:
            found = self.peek(n)
            self._ahead = self._ahead[n:]
            short = len(found) < n
        if short:
            raise InputError(f"{self._where}: its counts declare more numbers than it has; is it truncated?")
        return np.frombuffer(self._content, dtype, n, start) if self._layout.binary else found

    def _parsed(self, text: bytes) -> np.ndarray:
        try:
            return numbers_of(text)
        except ValueError:
            line = self._content[self._begin : self._at].count(b"\n") + 1
            for number, words in enumerate(text.split(b"\n"), line):
                for word in words.split():
                    try:
                        float(word)
                    except ValueError:
                        raise InputError(f"{self._where}, line {number}: {shown(word)!r} is not a number") from None
            raise InputError(f"{self._where}: contains text other than numbers") from None

    def _whole(self, values: np.ndarray) -> np.ndarray:
        if values.dtype.kind != "f":
            return values.astype(np.int64)
        refused = f"{self._where}: {{}} is not a count or a tag: a whole number"
        return whole_numbers(values, 1 - 2**53, 2**53, refused.format)


def _steps(n: int) -> Iterator[int]:
    """Divide a count into counts of at most :data:`PIECE`."""
    for start in range(0, n, PIECE):
        yield min(PIECE, n - start)


def _sections(path: Path, content: mmap.mmap) -> dict[str, list[tuple[int, int]]]:
    """Return where in a file the payloads of its sections begin and end, by name."""
    # editors on Windows insert a byte order mark
    if not content[:1000].removeprefix(codecs.BOM_UTF8).lstrip().startswith(b"$MeshFormat"):
        raise InputError(f"{path}: does not start with $MeshFormat: not a Gmsh mesh of version 2.2 or 4.1")
    found: dict[str, list[tuple[int, int]]] = {}
    at = 0
    while (at := content.find(b"$", at)) >= 0:
        content.seek(at + 1)
        line = content.readline()
        name = line.strip()
        if not name.isalnum() or not line.endswith(b"\n"):
            raise InputError(f"{path}: {shown(name)!r} is not the name of a section")
        end = content.find(b"$End" + name, at + len(line))
        if end < 0:
            raise InputError(f"{path}: section ${shown(name)} has no end; the file is truncated")
        found.setdefault(name.decode(), []).append((at + 1 + len(line), end))
        at = end + 4 + len(name)
    return found


def _pieces(path: Path, fields: Mapping[str, str] | None) -> Iterator[tuple[Any, Any] | _Head]:
    """Yield the number of nodes, pieces of rows, and at the end what there is to know about them."""
    try:
        with open(path, "rb") as file:
            # an empty file cannot be mapped
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if file.read(1) else mmap.mmap(-1, 1)
        yield from _parsed(path, content, fields)
    except MemoryError:
        raise InputError(f"{path}: the mesh does not fit in memory; write it as .h5 for many ranks") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


def _parsed(path: Path, content: mmap.mmap, fields: Mapping[str, str] | None) -> Iterator[tuple[Any, Any] | _Head]:
    places = _sections(path, content)

    def text(name: str) -> bytes:
        return b"".join(content[begin:end] for begin, end in places.get(name, []))

    layout = _layout(path, text("MeshFormat"))
    if "PartitionedEntities" in places:
        raise InputError(f"{path}: section $PartitionedEntities: save the mesh without partitions")
    for name in ("Nodes", "Elements"):
        if name not in places:
            raise InputError(f"{path}: has no section ${name}")

    def section(name: str) -> _Section:
        return _Section(f"{path}: section ${name}", content, places[name][0], layout)

    head = _Head(_physical_names(path, text("PhysicalNames")), _ORDERED in text("Comments"))
    numbers = section("Nodes")
    n_blocks, n_nodes = (0, numbers.count()) if layout.old else numbers.sizes(4)[:2].tolist()
    yield "nodes", n_nodes
    plain = (piece for rows in numbers.rows(n_nodes, 3) for piece in zip(("tags", "points"), rows))
    yield from _batched(plain if layout.old else _nodes_4(path, numbers, n_blocks, n_nodes))
    numbers.end()
    numbers = section("Elements")
    if layout.old:
        yield from _joined(_elements_2(path, numbers, layout.binary, head), head)
    else:
        groups = _entities(section("Entities")) if "Entities" in places else {}
        yield from _batched(_elements_4(path, numbers, groups, head))
    numbers.end()
    for kind in head.fields:
        for k, (begin, end) in enumerate(places.get(kind, [])):
            content.seek(begin)
            name, n = _data_head(f"{path}: section ${kind}", content, kind, head)
            if n is not None and (fields is None or name in fields):
                place = min(content.tell(), end), end
                numbers = _Section(f"{path}: section ${kind} {name!r}", content, place, layout)
                yield from _batched(((kind, k, name), np.column_stack(rows)) for rows in numbers.rows(n, 1))
                numbers.end()
    yield head


def _batched(rows: Rows) -> Rows:
    """Join rows of a kind to pieces: a file may have a block for each point."""
    waiting: dict[Any, list[np.ndarray]] = {}
    count: dict[Any, int] = {}
    for kind, some in rows:
        waiting.setdefault(kind, []).append(some)
        count[kind] = count.get(kind, 0) + len(some)
        if count[kind] >= PIECE:
            yield kind, np.concatenate(waiting.pop(kind))
            count[kind] = 0
    for kind, parts in waiting.items():
        yield kind, np.concatenate(parts)


def _joined(rows: Rows, head: _Head) -> Rows:
    """Join the copies of a line, which version 2 lists once for each of its groups, and yield pieces."""
    parts: dict[str, list[np.ndarray]] = {"lines": [np.empty((0, 4), np.int64)], "marked": []}
    for kind, some in rows:
        parts[kind].append(some)
    lines = np.concatenate(parts["lines"])
    grouped = np.array([bool(tags) for _, tags in head.groups] or [False])[lines[:, 3]]
    if grouped.any():
        _, ends = np.unique(lines[:, 1:3], return_inverse=True)
        ends = ends.reshape(-1, 2)
        _, first, leader = np.unique(ends[:, 0] * (ends.max() + 1) + ends[:, 1], return_index=True, return_inverse=True)
        leader = first[leader.ravel()]
        # two lines of the same group are no copies
        pairs, times = np.unique(np.column_stack([leader, lines[:, 3]])[grouped], axis=0, return_counts=True)
        copy = (leader != np.arange(len(lines))) & grouped & grouped[leader]
        copy &= ~np.isin(leader, pairs[times > 1, 0])
        tags = [tags for _, tags in head.groups]
        joined: dict[int, list[int]] = {}
        for line, place in zip(leader[copy].tolist(), lines[copy, 3].tolist()):
            joined.setdefault(line, list(tags[lines[line, 3]])).extend(tags[place])
        for line, several in joined.items():
            lines[line, 3] = head.place(1, several)
        lines = lines[~copy]
    for kind, found in (("lines", [lines]), ("marked", parts["marked"])):
        yield from ((kind, part[k : k + PIECE]) for part in found for k in range(0, len(part), PIECE))


def _physical_names(path: Path, payload: bytes) -> dict[tuple[int, int], str]:
    """Return names by dimension and tag; this section is text even in binary files."""
    count, *lines = payload.decode("utf-8", "replace").split("\n") if payload.strip() else ["0"]
    found = [re.fullmatch(r'\s*(-?\d{1,18})\s+(-?\d{1,18})\s+"(.+?)"+\s*', line) for line in lines if line.strip()]
    if None in found or count.strip() != str(len(found)):
        raise InputError(
            f"{path}: section $PhysicalNames: its {len(found)} lines after the first are not the {count[:20].strip()} "
            "lines 'dimension tag \"name\"' that it declares"
        )
    return {(int(match[1]), int(match[2])): match[3] for match in found}


def _entities(numbers: _Section) -> dict[tuple[int, int], list[int]]:
    """Return the tags of physical groups of every point and curve."""
    groups = {}
    counts = numbers.sizes(4)
    for dimension in (0, 1):
        for _ in range(counts[dimension]):
            tag = int(numbers.ints(1)[0])
            numbers.reals(3 if dimension == 0 else 6)
            groups[dimension, tag] = numbers.ints(int(numbers.sizes(1)[0])).tolist()
            if dimension == 1:
                numbers.ints(int(numbers.sizes(1)[0]))
    # Surfaces and volumes follow, which have no bars.
    return groups


def _nodes_4(path: Path, numbers: _Section, n_blocks: int, n_nodes: int) -> Rows:
    done = 0
    for _ in range(n_blocks):
        dimension, _, parametric = numbers.ints(3).tolist()
        if dimension not in (0, 1, 2, 3):
            raise InputError(f"{path}: section $Nodes: a block of entities of dimension {dimension}")
        n = int(numbers.sizes(1)[0])
        done += n
        if done > n_nodes:
            break
        yield from (("tags", numbers.sizes(some)) for some in _steps(n))
        width = 3 + (dimension if parametric else 0)
        for some in _steps(n):
            yield "points", numbers.reals(some * width).reshape(some, width)[:, :3]
    if done != n_nodes:
        raise InputError(f"{path}: section $Nodes declares {n_nodes} nodes, its blocks hold {done}")


def _elements_4(path: Path, numbers: _Section, groups: dict[tuple[int, int], list[int]], head: _Head) -> Rows:
    n_blocks, declared = numbers.sizes(4)[:2].tolist()
    done = 0
    for _ in range(n_blocks):
        dimension, entity, kind = numbers.ints(3).tolist()
        n, nodes = int(numbers.sizes(1)[0]), _nodes_of(path, kind)
        done += n
        named = groups.get((dimension, entity), ()) if kind in (_LINE, _POINT) else ()
        place = head.place(int(kind == _LINE), named)
        for some in _steps(n):
            rows = numbers.sizes(some * (1 + nodes)).reshape(some, 1 + nodes)
            yield from _kept(kind, rows, np.full(some, place), head)
    if done != declared:
        raise InputError(f"{path}: section $Elements declares {declared} elements, its blocks hold {done}")


def _elements_2(path: Path, numbers: _Section, binary: bool, head: _Head) -> Rows:
    """Elements follow one another in runs of the same type and number of tags: in text, these are searched for."""
    declared, done, left, run = numbers.count(), 0, 0, 1
    while done < declared:
        if not binary:
            words = numbers.peek(3)
            known = len(words) == 3 and (abs(words) < 1e9).all()
            kind, n_tags = words[1:].astype(np.int64).tolist() if known else (0, 0)
        elif left == 0:
            kind, left, n_tags = numbers.ints(3).tolist()
        nodes = _nodes_of(path, kind)
        first = 1 if binary else 3
        width = first + n_tags + nodes
        if not 0 <= n_tags < 1000:
            raise InputError(f"{path}: section $Elements: {n_tags} tags of element {done} of {declared}")
        if binary:
            n = min(left, PIECE)
            left -= n
        else:
            ahead = numbers.peek(min(run, declared - done, PIECE) * width)
            ahead = ahead[: len(ahead) // width * width].reshape(-1, width)
            alike = (ahead[:, 1] == kind) & (ahead[:, 2] == n_tags)
            n = max(1, len(alike) if alike.all() else int(alike.argmin()))
            run = 2 * n
        if not 0 < n <= declared - done:
            raise InputError(f"{path}: section $Elements declares {declared} elements, its blocks hold others")
        done += n
        rows = numbers.ints(n * width).reshape(n, width)
        tags, which = np.unique(rows[:, first] if n_tags else np.zeros(n, np.int64), return_inverse=True)
        named = [[tag] if kind in (_LINE, _POINT) else [] for tag in tags.tolist()]
        places = np.array([head.place(int(kind == _LINE), own) for own in named])
        yield from _kept(kind, rows[:, [0, *range(first + n_tags, width)]], places[which.ravel()], head)


def _nodes_of(path: Path, kind: int) -> int:
    if kind in _CURVED:
        raise InputError(f"{path}: section $Elements: curved lines (type {kind}); make the mesh of order 1")
    if kind not in _NODES:
        raise InputError(f"{path}: section $Elements: {kind} is not a known type of element")
    return _NODES[kind]


def _kept(kind: int, rows: np.ndarray, places: np.ndarray, head: _Head) -> Rows:
    """Yield elements (n, tag and nodes) that are lines or points, and count the others."""
    if kind == _LINE:
        yield "lines", np.column_stack([rows, places])
    elif kind == _POINT:
        yield "marked", np.column_stack([rows[:, 1], places])
    else:
        head.n_others += len(rows)


def _data_head(where: str, content: mmap.mmap, kind: str, head: _Head) -> tuple[str, int | None]:
    """Return name and number of rows of a section of data, None if it is left out; its head is always text."""
    words: list[list[bytes]] = []
    for _ in range(3):  # texts, real numbers, whole numbers
        count = content.readline().strip()
        if not re.fullmatch(rb"\d{1,2}", count):
            raise InputError(f"{where}: {shown(count)!r} is not the number of its tags")
        words.append([content.readline().strip() for _ in range(int(count))])
    name = words[0][0].decode("utf-8", "replace").strip('"') if words[0] else ""
    if len(words[2]) < 3 or not all(re.fullmatch(rb"\d{1,18}", word) for word in words[2][:3]):
        raise InputError(f"{where} {name!r}: expected three whole numbers: time step, components, number of elements")
    if int(words[2][1]) != 1 or not name or "/" in name:
        head.warnings.append(f"{where} {name!r} is left out: a field has a name without slash and one component")
        return name, None
    head.fields[kind].append(name)
    return name, int(words[2][2])


# ---- all ranks: from rows to slabs


class _Directory:
    """Values by tags, distributed over the ranks by ranges of tags. Collective."""

    def __init__(self, comm: MPI.Comm, tags: np.ndarray, values: np.ndarray) -> None:
        self._comm = comm
        self._low = _lowest(comm, tags)
        self._span = max(comm.allreduce(int(tags.max(initial=self._low)), op=MPI.MAX) - self._low + 1, 1)
        router = Router(comm, slab_of(tags - self._low, self._span, comm.size))
        own, values = router.send(tags), router.send(values)
        order = np.argsort(own, kind="stable")
        self._tags, self._values = own[order], values[order]
        self.twice = _lowest(comm, self._tags[1:][self._tags[1:] == self._tags[:-1]])

    def find(self, tags: np.ndarray, missing: float) -> np.ndarray:
        """Return the values for tags; ``missing`` for those that are not there."""
        wanted, at = np.unique(tags, return_inverse=True)
        ahead = wanted - self._low
        inside = (ahead >= 0) & (ahead < self._span)
        router = Router(self._comm, slab_of(np.where(inside, ahead, 0), self._span, self._comm.size))
        asked = router.send(wanted)
        found = np.full(len(asked), missing, self._values.dtype)
        if len(self._tags):
            place = np.minimum(np.searchsorted(self._tags, asked), len(self._tags) - 1)
            found = np.where(self._tags[place] == asked, self._values[place], found)
        return router.reply(found)[at.reshape(tags.shape)]


def _lowest(comm: MPI.Comm, tags: np.ndarray) -> int:
    """Return the lowest tag of all ranks, :data:`_NONE` if there is none. Collective."""
    return comm.allreduce(int(tags.min()) if tags.size else _NONE, op=MPI.MIN)


class _Parts:
    """This rank's part of the rows: of nodes its slab, of all others its share of each piece."""

    def __init__(self, comm: MPI.Comm, source: str) -> None:
        self._comm, self._source = comm, source
        self._count: dict[Any, int] = {}
        self._rows: dict[Any, list[tuple[int, np.ndarray]]] = {}
        self._n_nodes = 0

    def add(self, kind: Any, rows: Any) -> None:
        """Keep this rank's part of a piece that all ranks have."""
        if kind == "nodes":
            self._n_nodes = rows
            return
        start = self._count.get(kind, 0)
        self._count[kind] = start + len(rows)
        if kind in ("tags", "points"):
            first, last = slab_range(self._n_nodes, self._comm.rank, self._comm.size)
            first, last = max(first - start, 0), max(last - start, 0)
        else:
            first, last = slab_range(len(rows), self._comm.rank, self._comm.size)
        part = rows[first:last]
        small = kind == "lines" and part.size and part.max() < 1 << 31 and part.min() >= 0
        self._rows.setdefault(kind, []).append((start + first, part.astype(np.int32) if small else part.copy()))

    def _all(self, kind: Any, none: np.ndarray) -> np.ndarray:
        return np.concatenate([none, *(rows for _, rows in self._rows.pop(kind, []))])

    def _refuse(self, tag: int, text: str) -> None:
        if tag != _NONE:
            raise InputError(f"{self._source}: section {text.format(tag)}")

    def slab(self, head: _Head) -> MeshSlab:
        """Return this rank's slab of the mesh. Collective.

        Raises
        ------
        InputError
            On all ranks, if tags of nodes are not unique or not there.
        """
        comm, n_nodes, n_bars = self._comm, self._n_nodes, self._count.get("lines", 0)
        check_memory(n_nodes, self._source)
        first_node, _ = slab_range(n_nodes, comm.rank, comm.size)
        first_bar, last_bar = slab_range(n_bars, comm.rank, comm.size)
        tags = self._all("tags", np.empty(0, np.int64))
        nodes = _Directory(comm, tags, np.arange(first_node, first_node + len(tags)))
        self._refuse(nodes.twice, "$Nodes: node {} is listed more than once")
        slab = MeshSlab(
            n_nodes=n_nodes,
            n_bars=n_bars,
            first_node=first_node,
            points=self._all("points", np.empty((0, 3))),
            first_bar=first_bar,
            bars=np.empty((last_bar - first_bar, 2), index_type(n_nodes)),
            source=self._source,
            warnings=head.warnings,
        )
        lines, places = self._take_bars(slab, head, nodes)
        marked = self._all("marked", np.empty((0, 2), np.int64))
        own = nodes.find(marked[:, 0], -1)
        self._refuse(_lowest(comm, marked[own < 0, 0]), "$Elements: node {} is not in $Nodes")
        router = Router(comm, slab_of(own, n_nodes, comm.size))
        own, marks = router.send(own), router.send(marked[:, 1])
        slab.node_groups = _groups(0, head, (first_node, len(tags)), own, marks)
        slab.bar_groups = _groups(1, head, (first_bar, len(places)), np.arange(first_bar, last_bar), places)
        for kind in sorted(key for key in self._count if isinstance(key, tuple)):
            rows, of_nodes = self._all(kind, np.empty((0, 2))), kind[0] == "NodeData"
            own = tags if of_nodes else lines
            values = _Directory(comm, rows[:, 0].astype(np.int64), rows[:, 1]).find(own, np.nan)
            if comm.allreduce(bool(np.isnan(values).any()), op=MPI.LOR):
                text = f"{kind[2]!r} is left out: it does not have a value for each {'node' if of_nodes else 'line'}"
                head.warnings.append(f"{self._source}: section ${kind[0]} {text}")
            else:
                (slab.node_fields if of_nodes else slab.bar_fields)[kind[2]] = values
        if head.n_others:
            text = f"left out {head.n_others} elements that are neither lines nor points"
            head.warnings.insert(0, f"{self._source}: {text}")
        return slab

    def _take_bars(self, slab: MeshSlab, head: _Head, nodes: _Directory) -> tuple[np.ndarray, np.ndarray]:
        """Put the ends of this rank's range of lines into a slab, piece by piece; return their tags (none without
        fields), and the places of their groups."""
        comm, n = self._comm, slab.n_bars
        places = np.full(len(slab.bars), -1, np.int32)
        tags = np.empty(len(slab.bars) if head.fields["ElementData"] else 0, np.int64)
        pieces = self._rows.pop("lines", [])
        lowest = min((_lowest(comm, rows[:, 0]) for _, rows in pieces), default=_NONE) if head.ordered else 0
        lost = _NONE
        for k, (start, rows) in enumerate(pieces):
            pieces[k] = None  # type: ignore[call-overload]
            rows = rows.astype(np.int64)
            number = np.arange(start, start + len(rows))
            if head.ordered:  # a number that is too large leaves another one without a line
                number = np.where(rows[:, 0] - lowest < n, rows[:, 0] - lowest, 0)
            router = Router(comm, slab_of(number, n, comm.size))
            number, rows = router.send(number) - slab.first_bar, router.send(rows)
            found = nodes.find(rows[:, 1:3], -1)
            lost = min(lost, int(rows[:, 1:3][found < 0].min(initial=_NONE)))
            slab.bars[number], places[number] = found, rows[:, 3]
            if len(tags):
                tags[number] = rows[:, 0]
        self._refuse(comm.allreduce(lost, op=MPI.MIN), "$Elements: node {} is not in $Nodes")
        if head.ordered and not comm.allreduce(bool((places >= 0).all()), op=MPI.LAND):
            text = "the tags of the lines do not follow one another, as $Comments says: remove that section"
            raise InputError(f"{self._source}: section $Elements: {text}")
        return tags, places


def _groups(
    dimension: int, head: _Head, here: tuple[int, int], members: np.ndarray, places: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the members on this rank of groups by name, the same names on all ranks; ``here`` are the first and the
    count of this rank's nodes or bars, of which ``members`` (n,) have groups at ``places`` (n,)."""
    first, n = here
    names = {tag: name for (own, tag), name in head.names.items() if own == dimension}
    tags = sorted({tag for own, tags in head.groups if own == dimension for tag in tags})
    masks: dict[str, np.ndarray] = {}
    for tag in [*tags, *names]:
        has = np.array([own == dimension and tag in some for own, some in head.groups] or [False])[places]
        masks.setdefault(names.get(tag, f"group_{tag}"), np.zeros(n, bool))[members[has] - first] = True
    return {name: first + np.flatnonzero(mask) for name, mask in masks.items()}


# ---- writing


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, to the last digit: bars of the same groups are a curve, each node of a group is a point.

    Tags are the numbers from 1.
    """
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        for line in _lines(mesh):
            file.write(line + "\n")


def _lines(mesh: WholeMesh) -> Iterator[str]:
    curves, curve_of = _combinations(mesh.bar_groups, len(mesh.bars))
    points, point_of = _combinations(mesh.node_groups, len(mesh.points))
    # every node of a group is a point of its own, where Gmsh expects one node
    grouped = np.flatnonzero([len(points[number]) > 0 for number in point_of.tolist()])
    yield from ("$MeshFormat", "4.1 0 8", "$EndMeshFormat", "$Comments", _ORDERED.decode(), "$EndComments")
    yield from ("$PhysicalNames", str(len(mesh.node_groups) + len(mesh.bar_groups)))
    for dimension, groups in enumerate((mesh.node_groups, mesh.bar_groups)):
        yield from (f'{dimension} {tag} "{_quoted(name)}"' for tag, name in enumerate(groups, 1))
    yield from ("$EndPhysicalNames", "$Entities", f"{len(grouped)} {len(curves)} 0 0")
    for node in grouped.tolist():
        yield f"{node + 1} {_numbers(mesh.points[node])} {_tags(points[point_of[node]])}"
    for number, groups in enumerate(curves):
        ends = mesh.points[np.unique(mesh.bars[curve_of == number])]
        yield f"{number + 1} {_numbers(ends.min(axis=0))} {_numbers(ends.max(axis=0))} {_tags(groups)} 0"
    n, m = len(mesh.points), len(mesh.bars)
    yield from ("$EndEntities", "$Nodes", f"1 {n} 1 {n}", f"1 1 0 {n}")
    yield from map(str, range(1, n + 1))
    yield from (f"{x!r} {y!r} {z!r}" for x, y, z in mesh.points.tolist())
    total = m + len(grouped)
    yield from ("$EndNodes", "$Elements", f"{len(curves) + len(grouped)} {total} 1 {total}")
    for number in range(len(curves)):
        members = np.flatnonzero(curve_of == number)
        yield f"1 {number + 1} 1 {len(members)}"
        rows = np.column_stack([members, mesh.bars[members]]) + 1
        yield from (f"{tag} {a} {b}" for tag, a, b in rows.tolist())
    for tag, node in enumerate(grouped.tolist(), m + 1):
        yield from (f"0 {node + 1} 15 1", f"{tag} {node + 1}")
    yield "$EndElements"
    for kind, fields in (("ElementData", mesh.bar_fields), ("NodeData", mesh.node_fields)):
        yield from chain.from_iterable(_data_section(kind, name, values) for name, values in fields.items())


def _data_section(kind: str, name: str, values: np.ndarray) -> Iterator[str]:
    """Return a section of data: name, time 0, step 0, one component, a value for each bar or node."""
    yield from (f"${kind}", "1", f'"{_quoted(name)}"', "1", "0.0", "3", "0", "1", str(len(values)))
    yield from (f"{tag} {value!r}" for tag, value in enumerate(values.tolist(), 1))
    yield f"$End{kind}"


def _combinations(groups: dict[str, np.ndarray], n: int) -> tuple[list[list[int]], np.ndarray]:
    """Return the combinations of groups (tags from 1) that occur, and the number (n,) of the combination of each."""
    number = np.zeros(n, np.int64)
    found: list[list[int]] = [[]]
    for tag, members in enumerate(groups.values(), 1):
        own, place = np.unique(number[members], return_inverse=True)
        number[members] = len(found) + place.ravel()
        found += [[*found[before], tag] for before in own.tolist()]
    present, number = np.unique(number, return_inverse=True)
    return [found[i] for i in present.tolist()], number.ravel()


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(value) for value in values.tolist())


def _tags(tags: list[int]) -> str:
    return " ".join(map(str, [len(tags), *tags]))


def _quoted(name: str) -> str:
    return re.sub(r"\s", " ", name.replace('"', "'"))
