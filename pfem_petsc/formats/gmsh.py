"""Gmsh files (.msh): versions 2 to 2.2 and 4.1 are read, ASCII and binary, 4.1 ASCII is written.

Two-node lines (element type 1) are the bars, in file order; points (type 15) with a physical group define node groups;
surfaces and volumes are left out with a warning. Nodes are numbered from 0 in file order. Data of elements
($ElementData) and nodes ($NodeData) with one component and a value for every line or node are fields.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Collection, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._common import NumberStream, numbers_of, places_of, shown, whole_numbers

SUFFIXES = (".msh",)

_ORDERED = b"bars in the order of their tags"
"""In $Comments of a file whose elements are sorted by groups: the bars are numbered by their tags."""

_POINT, _LINE = 15, 1

# Nodes of each type of element in Gmsh's documentation; curved lines are refused, the others skipped.
_NODES = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 7: 5, 8: 3, 9: 6, 10: 9, 11: 10, 12: 27, 13: 18, 14: 14, 15: 1, 16: 8}
_NODES |= {17: 20, 18: 15, 19: 13, 20: 9, 21: 10, 22: 12, 23: 15, 24: 15, 25: 21, 26: 4, 27: 5, 28: 6, 29: 20, 30: 35}
_NODES |= {31: 56, 92: 64, 93: 125}
_CURVED = (8, 26, 27, 28)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in a Gmsh file, with all fields.

    Raises
    ------
    InputError
        Naming the section, for any content that is not a mesh of bars.
    """
    content = path.read_bytes().removeprefix(codecs.BOM_UTF8)  # which editors on Windows insert
    sections = _sections(path, content)
    layout = _layout(path, b"".join(sections.get("MeshFormat", [])))
    if "PartitionedEntities" in sections:
        raise InputError(f"{path}: section $PartitionedEntities: save the mesh without partitions")
    for name in [name for name in ("Nodes", "Elements") if name not in sections]:
        raise InputError(f"{path}: has no section ${name}")

    def numbers(name: str) -> _Numbers:
        return _Numbers(f"{path}: section ${name}", sections[name][0], layout)

    names = _physical_names(path, b"".join(sections.get("PhysicalNames", [])))
    node_tags, points = _nodes(numbers("Nodes"))
    entities = _entities(numbers("Entities")) if "Entities" in sections and not layout.old else {}
    elements = _Elements(numbers("Elements"), entities)
    order = np.argsort(node_tags, kind="stable")
    known = node_tags[order]
    for twice in known[1:][known[1:] == known[:-1]][:1]:
        raise InputError(f"{path}: section $Nodes: node {twice} is listed more than once")
    lines, marked = elements.joined_lines() if layout.old else elements.lines, elements.marked
    if any(_ORDERED in comments for comments in sections.get("Comments", [])):
        lines = lines[np.argsort(lines[:, 0], kind="stable")]
        if (np.diff(lines[:, 0]) != 1).any():
            raise InputError(
                f"{path}: section $Elements: the tags of the lines do not follow one another, as $Comments says: "
                "remove that section"
            )
    used = np.concatenate([lines[:, 1:3].ravel(), marked[:, 0]])
    place, there = places_of(known, used)
    if not there.all():
        raise InputError(f"{path}: section $Elements: node {used[~there].min()} is not in $Nodes")
    ends, of_points = np.split(order[place], [2 * len(lines)])
    mesh = WholeMesh(points, ends.reshape(-1, 2))
    mesh.node_groups = elements.groups(names[0], len(points), of_points, marked[:, 1])
    mesh.bar_groups = elements.groups(names[1], len(lines), np.arange(len(lines)), lines[:, 3])
    mesh.tell(elements.others, f"{path}: left out {elements.others} elements that are neither lines nor points")
    for kind, what, tags, found in (
        ("ElementData", "line", lines[:, 0], mesh.bar_fields),
        ("NodeData", "node", node_tags, mesh.node_fields),
    ):
        for payload in sections.get(kind, []):
            name, own, values = _data(f"{path}: section ${kind}", payload, layout)
            order = np.argsort(own, kind="stable")
            place, there = places_of(own[order], tags)
            whole = values is not None and there.all() and not np.isnan(values).any()
            why = f"it does not have a value for each {what}"
            why = "a field has a name without slash and one component" if values is None else why
            mesh.tell(not whole, f"{path}: section ${kind} {name!r} is left out: {why}")
            found |= {name: values[order[place], 0]} if whole else {}
    return mesh


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


def _sections(path: Path, content: bytes) -> dict[str, list[bytes]]:
    """Return the payloads of the sections of a file by name."""
    if not content[:1000].lstrip().startswith(b"$MeshFormat"):
        raise InputError(f"{path}: does not start with $MeshFormat: not a Gmsh mesh of version 2.2 or 4.1")
    found: dict[str, list[bytes]] = {}
    at = 0
    while (at := content.find(b"$", at)) >= 0:
        begin = content.find(b"\n", at) + 1
        name = content[at + 1 : begin].strip()
        if not name.isalnum():
            raise InputError(f"{path}: {shown(name)!r} is not the name of a section")
        end = content.find(b"$End" + name, begin)
        if end < 0:
            raise InputError(f"{path}: section ${shown(name)} has no end; the file is truncated")
        found.setdefault(name.decode(), []).append(content[begin:end])
        at = end + 4 + len(name)
    return found


class _Numbers(NumberStream):
    """Numbers of one section of a file.

    Every method raises InputError if the section ends early or has other content than requested.
    """

    def __init__(self, where: str, payload: bytes, layout: _Layout) -> None:
        self.where, self.layout = where, layout
        try:
            super().__init__(payload, layout.order if layout.binary else "")
        except ValueError:
            for number, line in enumerate(payload.split(b"\n"), 1):
                try:
                    numbers_of(line)
                except ValueError as error:
                    raise InputError(f"{self.where}, line {number}: {error}") from None
            raise

    def count(self) -> int:
        """Return the count at the start of a section of version 2.2, which is text in a binary file too."""
        if not self.layout.binary:
            return int(self.sizes(1)[0])
        line, _, self._all = self._all.partition(b"\n")
        if not re.fullmatch(rb"\s*\d{1,18}\s*", line):
            raise InputError(f"{self.where}: {shown(line)!r} is not a count")
        return int(line)

    def ints(self, n: int) -> np.ndarray:
        """Return the next ``n`` integers (C's int)."""
        return self._whole(self.reals(n, "i4"))

    def sizes(self, n: int) -> np.ndarray:
        """Return the next ``n`` counts or tags (C's size_t), as int64."""
        values = self.reals(n, self.layout.size_type)
        if n and (values.min() < 0 or values.max() > np.iinfo(np.int64).max):
            span = f"{float(values.min()):g} ... {float(values.max()):g}"
            raise InputError(f"{self.where}: {span} are not counts or tags")
        return self._whole(values)

    def reals(self, n: int, kind: str = "f8") -> np.ndarray:
        """Return the next ``n`` numbers, of a NumPy type in a binary file."""
        return self.take(n, kind)["0"]

    def take(self, n: int, *kinds: str) -> np.ndarray:
        """Return the next ``n`` rows of numbers of these types."""
        try:
            return super().take(n, *kinds)
        except EOFError:
            text = "its counts declare more numbers than it has; is it truncated?"
            raise InputError(f"{self.where}: {text}") from None

    def rows(self, n: int, n_reals: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the next ``n`` rows of an integer and ``n_reals`` floating-point numbers."""
        rows = self.take(n, "i4", *["f8"] * n_reals)
        reals = np.stack([rows[name] for name in rows.dtype.names[1:]], axis=1)
        return self._whole(rows["0"]), reals.astype(np.float64)

    def ahead(self, n: int) -> np.ndarray:
        """Return at most the next ``n`` numbers of a text without taking them."""
        return np.frombuffer(self._all)[self._at // 8 : self._at // 8 + n]

    def blocks(self, what: str) -> Iterator[list[int]]:
        """Yield three integers and the number of ``what`` at the head of each block of version 4."""
        n_blocks, declared = self.sizes(4)[:2].tolist()
        done = 0
        for _ in range(n_blocks):
            head = [*self.ints(3).tolist(), int(self.sizes(1)[0])]
            done += head[-1]
            if done > declared:
                break
            yield head
        if done != declared:
            raise InputError(f"{self.where} declares {declared} {what}, its blocks hold {done}")

    def end(self) -> None:
        """Refuse surplus numbers."""
        if self.left:
            raise InputError(f"{self.where}: has more numbers than its counts declare")

    def _whole(self, values: np.ndarray) -> np.ndarray:
        if values.dtype.kind != "f":
            return values.astype(np.int64)
        return whole_numbers(values, 1 - 2**53, 2**53, f"{self.where}: ", " is not a count or a tag: a whole number")


def _physical_names(path: Path, payload: bytes) -> list[dict[int, str]]:
    """Return names of groups of points and lines by tag; this section is text even in binary files."""
    count, *lines = payload.decode("utf-8", "replace").split("\n") if payload.strip() else ["0"]
    found = [re.fullmatch(r'\s*(-?\d{1,18})\s+(-?\d{1,18})\s+"(.+?)"+\s*', line) for line in lines if line.strip()]
    if None in found or count.strip() != str(len(found)):
        raise InputError(
            f"{path}: section $PhysicalNames: its {len(found)} lines after the first are not the {count[:20].strip()} "
            "lines 'dimension tag \"name\"' that it declares"
        )
    return [{int(match[2]): match[3] for match in found if int(match[1]) == dimension} for dimension in (0, 1)]


def _entities(numbers: _Numbers) -> dict[tuple[int, int], list[int]]:
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


def _nodes(numbers: _Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Return tags (n,) and points (n, 3) of the nodes."""
    if numbers.layout.old:
        tags, points = numbers.rows(numbers.count(), 3)
        numbers.end()
        return tags, points
    tags, points = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for dimension, _, parametric, n in numbers.blocks("nodes"):
        if dimension not in (0, 1, 2, 3):
            raise InputError(f"{numbers.where}: a block of entities of dimension {dimension}")
        tags.append(numbers.sizes(n))
        width = 3 + (dimension if parametric else 0)
        points.append(numbers.reals(n * width).reshape(n, width)[:, :3].astype(np.float64))
    numbers.end()
    return np.concatenate(tags), np.concatenate(points)


class _Elements:
    """The elements of a file; ``groups`` of its points and curves are those of version 4.

    Attributes
    ----------
    lines : (n, 4) tag, tags of both nodes, number of the combination of groups
    marked : (n, 2) tag of a node, number of the combination of its groups
    others : number of elements that are neither lines nor points
    """

    def __init__(self, numbers: _Numbers, groups: dict[tuple[int, int], list[int]]) -> None:
        self._numbers, self._groups = numbers, groups
        self._combinations: dict[tuple[int, ...], int] = {}
        self.others, found = 0, {_LINE: [np.empty((0, 4), np.int64)], _POINT: [np.empty((0, 3), np.int64)]}
        for kind, rows, which in self._blocks_2() if numbers.layout.old else self._blocks_4():
            if kind in found:
                found[kind].append(np.column_stack([rows, np.broadcast_to(which, len(rows))]))
            else:
                self.others += len(rows)
        numbers.end()
        self.lines, self.marked = np.concatenate(found[_LINE]), np.concatenate(found[_POINT])[:, 1:]

    def _number(self, tags: Iterable[int]) -> int:
        """Return the number of a combination; a negative tag is the same group with reversed orientation, 0 is none."""
        combination = tuple(sorted({abs(tag) for tag in tags if tag}))
        return self._combinations.setdefault(combination, len(self._combinations))

    def _nodes_of(self, kind: int) -> int:
        if kind in _CURVED:
            raise InputError(f"{self._numbers.where}: curved lines (type {kind}); make the mesh of order 1")
        if kind not in _NODES:
            raise InputError(f"{self._numbers.where}: {kind} is not a known type of element")
        return _NODES[kind]

    def _blocks_4(self) -> Iterator[tuple[int, np.ndarray, int]]:
        """Yield the type, rows of tag and nodes, and combination of groups of elements."""
        for dimension, entity, kind, n in self._numbers.blocks("elements"):
            width = 1 + self._nodes_of(kind)
            rows = self._numbers.sizes(n * width).reshape(n, width)
            yield kind, rows, self._number(self._groups.get((dimension, entity), ()))

    def _blocks_2(self) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Elements follow one another in runs of the same type and number of tags: in text, these are searched for."""
        numbers, binary = self._numbers, self._numbers.layout.binary
        declared, done, run = numbers.count(), 0, 1
        first = 1 if binary else 3
        while done < declared:
            if binary:
                kind, n, n_tags = numbers.ints(3).tolist()
            else:
                words = numbers.ahead(3)
                known = len(words) == 3 and (abs(words) < 1e9).all()
                kind, n_tags = words[1:].astype(np.int64).tolist() if known else (0, 0)
            width = first + n_tags + self._nodes_of(kind)
            if not 0 <= n_tags < 1000:
                raise InputError(f"{numbers.where}: {n_tags} tags of element {done} of {declared}")
            if not binary:
                ahead = numbers.ahead(min(run, declared - done) * width)
                ahead = ahead[: len(ahead) // width * width].reshape(-1, width)
                alike = (ahead[:, 1] == kind) & (ahead[:, 2] == n_tags)
                n = max(1, len(alike) if alike.all() else int(alike.argmin()))
                run = 2 * n
            if not 0 < n <= declared - done:
                raise InputError(f"{numbers.where} declares {declared} elements, its blocks hold others")
            done += n
            rows = numbers.ints(n * width).reshape(n, width)
            tags, which = np.unique(rows[:, first] if n_tags else np.zeros(n, np.int64), return_inverse=True)
            of_tags = np.array([self._number([tag]) for tag in tags.tolist()])
            yield kind, rows[:, [0, *range(first + n_tags, width)]], of_tags[which.ravel()]

    def joined_lines(self) -> np.ndarray:
        """Return the lines without copies: version 2 lists a line once for each of its groups."""
        lines, combinations = self.lines, list(self._combinations)
        grouped = np.array([bool(tags) for tags in combinations] or [False])[lines[:, 3]]
        if not grouped.any():
            return lines
        _, first, leader = np.unique(lines[:, 1:3], axis=0, return_index=True, return_inverse=True)
        leader = first[leader.ravel()]
        # two lines of the same group are no copies
        pairs, times = np.unique(np.column_stack([leader, lines[:, 3]])[grouped], axis=0, return_counts=True)
        copy = (leader != np.arange(len(lines))) & grouped & grouped[leader]
        copy &= ~np.isin(leader, pairs[times > 1, 0])
        joined: dict[int, list[int]] = {}
        for line, number in zip(leader[copy].tolist(), lines[copy, 3].tolist()):
            joined.setdefault(line, [*combinations[lines[line, 3]]]).extend(combinations[number])
        for line, tags in joined.items():
            lines[line, 3] = self._number(tags)
        return lines[~copy]

    def groups(self, names: dict[int, str], n: int, members: np.ndarray, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Return groups of ``n`` nodes or bars, of which ``members`` (m,) have combinations of these ``numbers``."""
        combinations, masks = list(self._combinations), {}
        for tag in [*sorted({tag for k in np.unique(numbers) for tag in combinations[k]}), *names]:
            has = np.array([tag in combination for combination in combinations] or [False])[numbers]
            masks.setdefault(names.get(tag, f"group_{tag}"), np.zeros(n, bool))[members[has]] = True
        return {name: np.flatnonzero(mask) for name, mask in masks.items()}


def _data(where: str, payload: bytes, layout: _Layout) -> tuple[str, np.ndarray, np.ndarray | None]:
    """Return the name of a section of data, whose head is always text, with its tags (n,) and values (n, 1); without
    values if they cannot be a field."""
    text = BytesIO(payload)
    words: list[list[bytes]] = []
    for _ in range(3):  # texts, real numbers, whole numbers
        count = text.readline().strip()
        if not re.fullmatch(rb"\d{1,2}", count):
            raise InputError(f"{where}: {shown(count)!r} is not the number of its tags")
        words.append([text.readline().strip() for _ in range(int(count))])
    name = words[0][0].decode("utf-8", "replace").strip('"') if words[0] else ""
    if len(words[2]) < 3 or not all(re.fullmatch(rb"\d{1,18}", word) for word in words[2][:3]):
        raise InputError(f"{where} {name!r}: expected three whole numbers: time step, components, number of elements")
    if int(words[2][1]) != 1 or not name or "/" in name:
        return name, np.empty(0, np.int64), None
    numbers = _Numbers(f"{where} {name!r}", text.read(), layout)
    tags, values = numbers.rows(int(words[2][2]), 1)
    numbers.end()
    return name, tags, values


# ---- writing


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, to the last digit: bars of the same groups are a curve, each node of a group is a point.

    Tags are the numbers from 1.
    """
    path.write_text("".join(f"{line}\n" for line in _lines(mesh)), encoding="utf-8", newline="\n")


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
        tags = points[point_of[node]]
        yield _row(node + 1, *mesh.points[node].tolist(), len(tags), *tags)
    for number, groups in enumerate(curves):
        ends = mesh.points[np.unique(mesh.bars[curve_of == number])]
        box = (*ends.min(axis=0).tolist(), *ends.max(axis=0).tolist())
        yield _row(number + 1, *box, len(groups), *groups, 0)
    n, m = len(mesh.points), len(mesh.bars)
    yield from ("$EndEntities", "$Nodes", f"1 {n} 1 {n}", f"1 1 0 {n}", *map(str, range(1, n + 1)))
    yield from (f"{x!r} {y!r} {z!r}" for x, y, z in mesh.points.tolist())
    total = m + len(grouped)
    yield from ("$EndNodes", "$Elements", f"{len(curves) + len(grouped)} {total} 1 {total}")
    for number in range(len(curves)):
        members = np.flatnonzero(curve_of == number)
        rows = (np.column_stack([members, mesh.bars[members]]) + 1).tolist()
        yield from (f"1 {number + 1} 1 {len(rows)}", *(f"{tag} {a} {b}" for tag, a, b in rows))
    for tag, node in enumerate(grouped.tolist(), m + 1):
        yield from (f"0 {node + 1} 15 1", f"{tag} {node + 1}")
    yield "$EndElements"
    for kind, fields in (("ElementData", mesh.bar_fields), ("NodeData", mesh.node_fields)):
        for name, values in fields.items():  # time 0, step 0, one component, a value for each bar or node
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


def _row(*numbers: float) -> str:
    return " ".join(map(repr, numbers))


def _quoted(name: str) -> str:
    return re.sub(r"\s", " ", name.replace('"', "'"))
