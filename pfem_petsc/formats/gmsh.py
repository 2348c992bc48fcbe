"""Gmsh files (.msh): versions 2 to 2.2 and 4.1 are read, ASCII and binary, 4.1 ASCII is written.

Two-node lines (element type 1) are the bars, in file order; points (type 15) with a physical group define node groups;
surfaces and volumes are left out with a warning. Nodes are numbered from 0 in file order. Data of elements
($ElementData) with one component and a value for every line are bar fields. Rank 0 parses the file in pieces, each of
which goes to all ranks: no rank has the whole mesh.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..mesh.exchange import Router
from ..mesh.slab import MeshSlab, check_memory, index_type, slab_of, slab_range
from ..mesh.whole import WholeMesh, missing_field
from ._numbers import numbers_of, shown

SUFFIXES = (".msh",)

PIECE = 1 << 14
"""Number of rows that are parsed and sent at a time."""

BYTES = 1 << 18
"""Bytes of a file that are read at a time."""

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
groups; ``marked`` (n, 2): tag of a node, place of its groups; ``("field", k, name)`` (n, 2): tag of a line, value."""


@dataclass
class _Head:
    """What a file says besides its rows; all ranks have it after these."""

    names: dict[tuple[int, int], str]
    """Of physical groups, by dimension and tag."""
    ordered: bool
    """Whether bars are numbered by the tags of the lines."""
    repeated: bool
    """Whether a line is listed once for each of its groups, as in version 2."""
    n_others: int = 0
    """Elements that are neither lines nor points."""
    groups: dict[tuple[int, tuple[int, ...]], int] = field(default_factory=dict)
    """Places of dimension and tags of the physical groups that a line or point has."""
    fields: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def place(self, dimension: int, tags: Iterable[int]) -> int:
        """Return the place of groups; a negative tag is the same group with reversed orientation, 0 is none."""
        combination = tuple(sorted({abs(tag) for tag in tags if tag}))
        return self.groups.setdefault((dimension, combination), len(self.groups))


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str] | None = None) -> MeshSlab:
    """Return this rank's slab of the mesh in a Gmsh file, with the named bar fields; None: with all. Collective.

    Raises
    ------
    InputError
        On all ranks, naming the section, for any content that is not a mesh of bars.
    """
    pieces = _pieces(path, fields) if comm.rank == 0 else iter(())
    parts = _Parts(comm, str(path))
    while not isinstance(piece := comm.bcast(next(pieces, None)), _Head | InputError):
        parts.add(*piece)
    if isinstance(piece, InputError):
        raise piece
    slab = parts.slab(piece)
    if fields is not None:
        missing = missing_field(path, fields, {*piece.fields} - ({*fields} - {*slab.bar_fields}))
        if missing is not None:
            raise InputError(missing)
        slab.bar_fields = {name: slab.bar_fields[name] for name in fields}
    return slab


# ---- rank 0: from the file to rows


class _Layout(NamedTuple):
    """Content of the section $MeshFormat; ``size_type`` is the NumPy type of C's size_t in a binary file."""

    version: str
    binary: bool
    order: str
    size_type: str


def _layout(path: Path, payload: bytes) -> _Layout:
    first, _, rest = payload.partition(b"\n")
    words = first.split()
    where = f"{path}: section $MeshFormat"
    if len(words) != 3 or words[1] not in (b"0", b"1") or words[2] not in (b"4", b"8"):
        raise InputError(f"{where}: {shown(first)!r} is not 'version file-type data-size', such as '4.1 0 8'")
    # versions 2 to 2.2 differ in nothing that is read here
    version = {**dict.fromkeys((b"2", b"2.0", b"2.1", b"2.2"), "2.2"), b"4.1": "4.1"}.get(words[0])
    if version is None:
        raise InputError(
            f"{where}: version {shown(words[0])} is not read; save the mesh as version 4.1 or 2.2 "
            "(in Gmsh: Mesh.MshFileVersion)"
        )
    binary = words[1] == b"1"
    if binary and rest[:4] not in (b"\x01\0\0\0", b"\0\0\0\x01"):
        raise InputError(f"{where}: the binary number 1 that shows the byte order is missing")
    return _Layout(version, binary, ">" if binary and rest[:1] == b"\0" else "<", "u" + words[2].decode())


class _Section:
    """Numbers of one section of a file, from byte ``begin`` to ``end``, read and parsed in pieces.

    Every method raises InputError if the section ends early or has other content than requested.
    """

    def __init__(self, where: str, file: IO[bytes], place: tuple[int, int], layout: _Layout) -> None:
        self._where, self._file, self._layout = where, file, layout
        self._next, self._stop = place
        self._have: Any = b"" if layout.binary else np.empty(0)  # bytes, or numbers
        self._at = 0
        self._rest, self._line = b"", 1  # of text: a word that may go on, number of the line

    def count(self) -> int:
        """Return the count at the start of a section of version 2.2, which is text in a binary file too."""
        if not self._layout.binary:
            return int(self.sizes(1)[0])
        self._file.seek(self._next)
        line = self._file.readline(200)
        self._next += len(line)
        found = self._parsed(line)
        if len(found) != 1:
            raise InputError(f"{self._where}: {shown(line)!r} is not a count")
        return int(self._whole(found)[0])

    def ints(self, n: int) -> np.ndarray:
        """Return the next ``n`` integers (C's int)."""
        return self._take(n, "i4").astype(np.int64) if self._layout.binary else self._whole(self._take(n))

    def sizes(self, n: int) -> np.ndarray:
        """Return the next ``n`` counts or tags (C's size_t), as int64."""
        values = self._take(n, self._layout.size_type) if self._layout.binary else self._whole(self._take(n))
        if n and (values.min() < 0 or values.max() > _NONE):
            raise InputError(f"{self._where}: {values.min()} ... {values.max()} are not counts or tags")
        return values.astype(np.int64)

    def reals(self, n: int) -> np.ndarray:
        """Return the next ``n`` floating-point numbers."""
        return self._take(n).astype(np.float64)

    def rows(self, n: int, n_reals: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Return the next ``n`` rows of an integer and ``n_reals`` floating-point numbers, in pieces."""
        row = f"i4,({n_reals},)f8" if self._layout.binary else ""
        self.require(n if row else n * (1 + n_reals), row)
        for some in _steps(n):
            if row:
                rows = self._take(some, row)
                yield rows["f0"].astype(np.int64), rows["f1"].astype(np.float64)
            else:
                rows = self._take(some * (1 + n_reals)).reshape(some, 1 + n_reals)
                yield self._whole(rows[:, 0]), rows[:, 1:]

    def peek(self, n: int) -> np.ndarray:
        """Return at most the next ``n`` numbers of an ASCII section without consuming them."""
        self._fill(n)
        return self._have[self._at : self._at + n]

    def end(self) -> None:
        """Refuse surplus numbers."""
        self._fill(100)
        left = self._have[self._at :]
        if len(left.strip() if self._layout.binary else left):
            what = "bytes" if self._layout.binary else "numbers"
            raise InputError(f"{self._where}: {self._left()} {what} more than its counts declare")

    def require(self, n: int, kind: str = "") -> None:
        """Refuse a count that is more than the bytes of the section can have: a number and a blank have two or more."""
        n *= self._type(kind).itemsize if self._layout.binary else 1
        bytes_left = self._stop - self._next + len(self._rest)
        most = len(self._have) - self._at + (bytes_left if self._layout.binary else (bytes_left + 1) // 2)
        if not 0 <= n <= most:
            what = "bytes" if self._layout.binary else "numbers"
            left = self._left()
            raise InputError(f"{self._where}: its counts declare {n} {what} where {left} are left; is it truncated?")

    def _type(self, kind: str) -> np.dtype:
        return np.dtype(kind or "f8").newbyteorder(self._layout.order)

    def _take(self, n: int, kind: str = "") -> np.ndarray:
        self.require(n, kind)
        size = n * self._type(kind).itemsize if self._layout.binary else n
        self._fill(size)
        if len(self._have) - self._at < size:
            self._next, self._rest = self._stop, b""
            self.require(n, kind)  # which fails now
        start, self._at = self._at, self._at + size
        if self._layout.binary:
            return np.frombuffer(self._have, self._type(kind), n, start)
        return self._have[start : self._at]

    def _fill(self, n: int) -> None:
        """Have at least n numbers, or bytes of a binary file, in memory, as far as there are so many."""
        left = len(self._have) - self._at
        if left >= n or self._next >= self._stop:
            return
        parts = [self._have[self._at :]]
        while left < n and self._next < self._stop:
            parts.append(self._read())
            left += len(parts[-1])
        self._at = 0
        self._have = b"".join(parts) if self._layout.binary else np.concatenate(parts)

    def _read(self) -> Any:
        self._file.seek(self._next)
        text = self._file.read(min(BYTES, self._stop - self._next))
        self._next = self._next + len(text) if text else self._stop
        if self._layout.binary:
            return text
        text = self._rest + text
        cut = max(text.rfind(b"\n"), text.rfind(b" ")) + 1 if self._next < self._stop else len(text)
        text, self._rest = text[:cut], text[cut:]
        if len(self._rest) > max(BYTES, 1000):
            raise InputError(f"{self._where}, line {self._line}: {shown(self._rest)!r} is not a number")
        return self._parsed(text)

    def _left(self) -> int:
        """Return how many numbers or bytes are left, which are read."""
        left = len(self._have) - self._at
        while self._next < self._stop:
            left += len(self._read())
        return left

    def _parsed(self, text: bytes) -> np.ndarray:
        try:
            found = numbers_of(text)
        except ValueError:
            for number, line in enumerate(text.split(b"\n"), self._line):
                for word in line.split():
                    try:
                        float(word)
                    except ValueError:
                        raise InputError(f"{self._where}, line {number}: {shown(word)!r} is not a number") from None
            raise InputError(f"{self._where}: contains text other than numbers") from None
        self._line += text.count(b"\n")
        return found

    def _whole(self, values: np.ndarray) -> np.ndarray:
        wrong = values[~((np.abs(values) < 2.0**53) & (values == np.rint(values)))]
        if wrong.size:
            raise InputError(f"{self._where}: {wrong.flat[0]:g} is not a count or a tag: a whole number")
        return values.astype(np.int64)


def _steps(n: int) -> Iterator[int]:
    """Divide a count into counts of at most :data:`PIECE`."""
    for start in range(0, n, PIECE):
        yield min(PIECE, n - start)


def _sections(path: Path, file: IO[bytes]) -> dict[str, list[tuple[int, int]]]:
    """Return where in a file the payloads of its sections begin and end, by name, without reading it whole."""
    # editors on Windows insert a byte order mark
    if not file.read(1000).removeprefix(codecs.BOM_UTF8).lstrip().startswith(b"$MeshFormat"):
        raise InputError(f"{path}: does not start with $MeshFormat: not a Gmsh mesh of version 2.2 or 4.1")
    found: dict[str, list[tuple[int, int]]] = {}
    at = 0
    while (at := _find(file, b"$", at)) >= 0:
        file.seek(at + 1)
        line = file.readline(200)
        name = line.strip()
        if not name.isalnum() or not line.endswith(b"\n"):
            raise InputError(f"{path}: {shown(name)!r} is not the name of a section")
        end = _find(file, b"$End" + name, at + len(line))
        if end < 0:
            raise InputError(f"{path}: section ${name.decode()} has no end; the file is truncated")
        found.setdefault(name.decode(), []).append((at + 1 + len(line), end))
        at = end + 4 + len(name)
    return found


def _find(file: IO[bytes], text: bytes, at: int) -> int:
    """Return the first place of a text in a file from ``at`` on, -1 if there is none."""
    file.seek(at)
    rest = b""
    while block := file.read(1 << 20):
        place = (rest + block).find(text)
        if place >= 0:
            return at - len(rest) + place
        at += len(block)
        rest = (rest + block)[-(len(text) - 1) :] if len(text) > 1 else b""
    return -1


def _pieces(path: Path, fields: Mapping[str, str] | None) -> Iterator[tuple[Any, Any] | _Head | InputError]:
    """Yield the number of nodes, pieces of rows, and at the end what there is to know about them, or what is wrong."""
    try:
        with open(path, "rb") as file:
            yield from _parsed(path, file, fields)
    except InputError as error:
        yield error
    except MemoryError:
        yield InputError(f"{path}: the mesh does not fit in memory; write it as .h5 for many ranks")
    except OSError as error:
        yield InputError(f"{path}: cannot be read: {error.strerror}")


def _parsed(path: Path, file: IO[bytes], fields: Mapping[str, str] | None) -> Iterator[tuple[Any, Any] | _Head]:
    places = _sections(path, file)

    def text(name: str) -> bytes:
        found = b""
        for begin, end in places.get(name, []):
            file.seek(begin)
            found += file.read(end - begin)
        return found

    layout = _layout(path, text("MeshFormat"))
    if "PartitionedEntities" in places:
        raise InputError(f"{path}: section $PartitionedEntities: save the mesh without partitions")
    for name in ("Nodes", "Elements"):
        if name not in places:
            raise InputError(f"{path}: has no section ${name}")

    def section(name: str) -> _Section:
        return _Section(f"{path}: section ${name}", file, places[name][0], layout)

    old = layout.version == "2.2"
    head = _Head(_physical_names(path, text("PhysicalNames") or b"0"), _ORDERED in text("Comments"), old)
    numbers = section("Nodes")
    n_blocks, n_nodes = (0, numbers.count()) if old else numbers.sizes(4)[:2].tolist()
    yield "nodes", n_nodes
    yield from _batched(_nodes_2(numbers, n_nodes) if old else _nodes_4(path, numbers, n_blocks, n_nodes))
    numbers.end()
    numbers = section("Elements")
    if old:
        yield from _batched(_elements_2(path, numbers, layout.binary, head))
    else:
        groups = _entities(section("Entities")) if "Entities" in places else {}
        yield from _batched(_elements_4(path, numbers, groups, head))
    numbers.end()
    for k, place in enumerate(places.get("ElementData", [])):
        where = f"{path}: section $ElementData"
        file.seek(place[0])
        name, n = _data_head(where, file, head)
        if n is not None and (fields is None or name in fields):
            numbers = _Section(f"{where} {name!r}", file, (min(file.tell(), place[1]), place[1]), layout)
            yield from _batched((("field", k, name), np.column_stack(rows)) for rows in numbers.rows(n, 1))
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


def _physical_names(path: Path, payload: bytes) -> dict[tuple[int, int], str]:
    """Return names by dimension and tag; this section is text even in binary files."""
    lines = payload.decode("utf-8", "replace").splitlines() or [""]
    names = {}
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        where = f"{path}: section $PhysicalNames, line {number}"
        words = line.split(None, 2)
        if len(words) != 3 or len(words[2].strip()) < 3 or not words[2].strip().startswith('"'):
            raise InputError(f"{where}: {line[:60]!r} is not 'dimension tag \"name\"'")
        try:
            names[int(words[0]), int(words[1])] = words[2].strip().strip('"')
        except ValueError:
            raise InputError(f"{where}: dimension and tag must be whole numbers, not {line[:60]!r}") from None
    if lines[0].strip() != str(len(names)):
        raise InputError(f"{path}: section $PhysicalNames declares {lines[0][:20]!r} names and has {len(names)}")
    return names


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


def _nodes_2(numbers: _Section, n_nodes: int) -> Rows:
    for tags, points in numbers.rows(n_nodes, 3):
        yield from (("tags", tags), ("points", points))


def _nodes_4(path: Path, numbers: _Section, n_blocks: int, n_nodes: int) -> Rows:
    done = 0
    for _ in range(n_blocks):
        dimension, _, parametric = numbers.ints(3).tolist()
        if dimension not in (0, 1, 2, 3):
            raise InputError(f"{path}: section $Nodes: a block of entities of dimension {dimension}")
        n = int(numbers.sizes(1)[0])
        numbers.require(n)
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
        numbers.require(n * (1 + nodes))
        done += n
        place = head.place(int(kind == _LINE), groups.get((dimension, entity), ()))
        for some in _steps(n):
            rows = numbers.sizes(some * (1 + nodes)).reshape(some, 1 + nodes)
            yield from _kept(kind, rows, np.full(some, place), head)
    if done != declared:
        raise InputError(f"{path}: section $Elements declares {declared} elements, its blocks hold {done}")


def _elements_2(path: Path, numbers: _Section, binary: bool, head: _Head) -> Rows:
    """Elements follow one another in runs of the same type and number of tags: in text, these are searched for."""
    declared, done, left, run = numbers.count(), 0, 0, 1
    while done < declared:
        if binary and left == 0:
            kind, left, n_tags = numbers.ints(3).tolist()
        elif not binary:
            words = numbers.peek(3)
            _, kind, n_tags = (
                words.astype(np.int64).tolist() if len(words) == 3 and (abs(words) < 1e9).all() else [0] * 3
            )
        nodes = _nodes_of(path, kind)
        if not 0 <= n_tags < 1000:
            raise InputError(f"{path}: section $Elements: {n_tags} tags of element {done} of {declared}")
        if binary:
            width, first = 1 + n_tags + nodes, 1
            n = min(left, PIECE)
            left -= n
        else:
            width, first = 3 + n_tags + nodes, 3
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
        places = np.array([head.place(int(kind == _LINE), [tag]) for tag in tags.tolist()])
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


def _data_head(where: str, file: IO[bytes], head: _Head) -> tuple[str, int | None]:
    """Return name and number of rows of a section $ElementData, None if it is left out; its head is always text."""
    words: list[list[bytes]] = []
    for _ in range(3):  # texts, real numbers, whole numbers
        count = file.readline(200)
        if not count.strip().isdigit() or int(count) > 100:
            raise InputError(f"{where}: {shown(count.rstrip())!r} is not the number of its tags")
        words.append([file.readline(1000).strip() for _ in range(int(count))])
    name = words[0][0].decode("utf-8", "replace").strip('"') if words[0] else ""
    if len(words[2]) < 3 or not all(word.lstrip(b"-").isdigit() for word in words[2][:3]):
        raise InputError(f"{where} {name!r}: expected three whole numbers: time step, components, number of elements")
    if int(words[2][1]) != 1 or not name or "/" in name:
        head.warnings.append(f"{where} {name!r} is left out: a bar field has a name without slash and one component")
        return name, None
    head.fields.append(name)
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

    def _joined(self, kind: Any, none: np.ndarray) -> np.ndarray:
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
        tags = self._joined("tags", np.empty(0, np.int64))
        nodes = _Directory(comm, tags, np.arange(first_node, first_node + len(tags)))
        self._refuse(nodes.twice, "$Nodes: node {} is listed more than once")
        bars = self._bars(head, nodes, n_bars)
        marked = self._joined("marked", np.empty((0, 2), np.int64))
        own = nodes.find(marked[:, 0], -1)
        self._refuse(_lowest(comm, marked[own < 0, 0]), "$Elements: node {} is not in $Nodes")
        router = Router(comm, slab_of(own, n_nodes, comm.size))
        first_bar, _ = slab_range(bars.n, comm.rank, comm.size)
        node_groups = _groups(
            (0, first_node, len(tags)), head, router.send(own) - first_node, router.send(marked[:, 1])
        )
        bar_groups = _groups((1, first_bar, len(bars.ends)), head, bars.rows, bars.places)
        bar_fields = {}
        for kind in sorted(key for key in self._count if isinstance(key, tuple)):
            rows = self._joined(kind, np.empty((0, 2)))
            values = _Directory(comm, rows[:, 0].astype(np.int64), rows[:, 1]).find(bars.tags, np.nan)
            if comm.allreduce(bool(np.isnan(values).any()), op=MPI.LOR):
                text = f"{kind[2]!r} is left out: it does not have a value for each line"
                head.warnings.append(f"{self._source}: section $ElementData {text}")
            else:
                bar_fields[kind[2]] = values
        if head.n_others:
            text = f"left out {head.n_others} elements that are neither lines nor points"
            head.warnings.insert(0, f"{self._source}: {text}")
        return MeshSlab(
            n_nodes=n_nodes,
            n_bars=bars.n,
            first_node=first_node,
            points=self._joined("points", np.empty((0, 3))),
            first_bar=first_bar,
            bars=bars.ends,
            node_groups=node_groups,
            bar_groups=bar_groups,
            bar_fields=bar_fields,
            source=self._source,
            warnings=head.warnings,
        )

    def _bars(self, head: _Head, nodes: _Directory, n: int) -> _Bars:
        """Return the lines of this rank's range, piece by piece, with numbers of nodes in the place of tags."""
        comm = self._comm
        first, last = slab_range(n, comm.rank, comm.size)
        ends = np.empty((last - first, 2), index_type(self._n_nodes))
        places = np.full(last - first, -1, np.int32)
        tags = np.empty(last - first if head.repeated or head.fields else 0, np.int64)
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
            number, rows = router.send(number) - first, router.send(rows)
            found = nodes.find(rows[:, 1:3], -1)
            lost = min(lost, int(rows[:, 1:3][found < 0].min(initial=_NONE)))
            ends[number], places[number] = found, rows[:, 3]
            if len(tags):
                tags[number] = rows[:, 0]
        self._refuse(comm.allreduce(lost, op=MPI.MIN), "$Elements: node {} is not in $Nodes")
        if head.ordered and not comm.allreduce(bool((places >= 0).all()), op=MPI.LAND):
            text = "the tags of the lines do not follow one another, as $Comments says: remove that section"
            raise InputError(f"{self._source}: section $Elements: {text}")
        bars = _Bars(n, ends, tags, np.arange(last - first, dtype=np.int32), places)
        return bars.joined(comm, head, self._n_nodes) if head.repeated else bars


class _Bars(NamedTuple):
    """Bars of this rank's range: ends (m, 2), tags (m,) of their lines (none if nobody needs them); and their groups,
    ``rows`` of bars and the ``places`` of groups that they have, perhaps several times."""

    n: int
    ends: np.ndarray
    tags: np.ndarray
    rows: np.ndarray
    places: np.ndarray

    def joined(self, comm: MPI.Comm, head: _Head, n_nodes: int) -> _Bars:
        """Join the copies of a bar, which version 2 lists once for each of its groups. Collective."""
        # copies meet where the first node is, in the order of their numbers
        meet = Router(comm, slab_of(self.ends[:, 0], n_nodes, comm.size))
        first, last = slab_range(self.n, comm.rank, comm.size)
        own = (self.ends, self.tags, np.arange(first, last), self.places)
        ends, tags, number, places = (meet.send(each) for each in own)
        order = np.lexsort((number, ends[:, 1], ends[:, 0]))
        ends, tags, number, places = ends[order], tags[order], number[order], places[order]
        begins = np.ones(len(ends), bool)
        begins[1:] = (ends[1:] != ends[:-1]).any(axis=1)
        leader = np.flatnonzero(begins)[np.cumsum(begins) - 1]
        grouped = np.array([bool(tags) for _, tags in head.groups] or [False])[places]
        # two lines of the same group are no copies
        pairs, times = np.unique(np.column_stack([leader, places])[grouped], axis=0, return_counts=True)
        copy = ~begins & grouped & grouped[leader] & ~np.isin(leader, pairs[times > 1, 0])
        if not comm.allreduce(bool(copy.any()), op=MPI.LOR):
            return self
        # those that are kept are numbered anew, in their order
        kept = np.where(copy, number[leader], number)
        ask = Router(comm, slab_of(kept, self.n, comm.size))
        stays = np.zeros(last - first, bool)
        at = ask.send(kept) - first
        stays[at] = True
        counts = comm.allgather(int(stays.sum()))
        number = ask.reply((np.cumsum(stays) - 1 + sum(counts[: comm.rank]))[at])
        n = sum(counts)
        first, last = slab_range(n, comm.rank, comm.size)
        home = Router(comm, slab_of(number, n, comm.size))
        number, places = home.send(number), home.send(places)
        of_bars, rows = ~home.send(copy), number - first
        new_ends, new_tags = np.empty((last - first, 2), ends.dtype), np.empty(last - first, np.int64)
        new_ends[rows[of_bars]], new_tags[rows[of_bars]] = home.send(ends)[of_bars], home.send(tags)[of_bars]
        return _Bars(n, new_ends, new_tags, rows, places)


def _groups(of: tuple[int, int, int], head: _Head, rows: np.ndarray, places: np.ndarray) -> dict[str, np.ndarray]:
    """Return the members on this rank of groups by name, the same names on all ranks; ``of`` are the dimension, and the
    first and the count of this rank's nodes or bars, of which ``rows`` have groups."""
    dimension, first, n = of
    names = [name for (own, _), name in head.names.items() if own == dimension]
    tags = sorted({tag for own, tags in head.groups if own == dimension for tag in tags})
    masks: dict[str, np.ndarray] = {}
    for tag in tags:
        has = np.array([tag in tags for _, tags in head.groups], bool)[places]
        masks.setdefault(head.names.get((dimension, tag), f"group_{tag}"), np.zeros(n, bool))[rows[has]] = True
    masks |= {name: np.zeros(n, bool) for name in names if name not in masks}
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
    yield from chain.from_iterable(_data_section(name, values) for name, values in mesh.bar_fields.items())


def _data_section(name: str, values: np.ndarray) -> Iterator[str]:
    """Return a section $ElementData: name, time 0, step 0, one component, a value for each bar."""
    yield from ("$ElementData", "1", f'"{_quoted(name)}"', "1", "0.0", "3", "0", "1", str(len(values)))
    yield from (f"{tag} {value!r}" for tag, value in enumerate(values.tolist(), 1))
    yield "$EndElementData"


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
