"""Gmsh .msh files, versions 2 to 2.2 and 4.1, ASCII and binary: lines are bars, physical groups are groups.

Two-node lines (element type 1) are the bars, in file order; points (type 15) with a physical group define node groups;
surfaces and volumes are ignored with a warning. Nodes are numbered from 0 in file order. Data of elements
($ElementData) with one component and a value for every line are bar fields.
"""

from __future__ import annotations

import codecs
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh
from ._gmsh_lines import element_data, in_order, once
from ._gmsh_parts import parse
from ._gmsh_sections import Format, Numbers, read_entities, sections
from ._gmsh_slab import assemble

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..slab import MeshSlab

__all__ = ["ORDERED", "SUFFIXES", "read", "read_on"]

SUFFIXES = (".msh",)

ORDERED = b"bars in the order of their tags"
"""In $Comments of a file whose elements are sorted by groups: the bars are numbered by their tags."""

_POINT, _LINE = 15, 1

# Nodes of each type of element in Gmsh's documentation; curved lines are refused, the others skipped.
_NODES = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 7: 5, 8: 3, 9: 6, 10: 9, 11: 10, 12: 27, 13: 18, 14: 14, 15: 1, 16: 8}
_NODES |= {17: 20, 18: 15, 19: 13, 20: 9, 21: 10, 22: 12, 23: 15, 24: 15, 25: 21, 26: 4, 27: 5, 28: 6, 29: 20, 30: 35}
_NODES |= {31: 56, 92: 64, 93: 125}
_CURVED = (8, 26, 27, 28)

Elements = list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]
"""Runs of elements: type, (n,) tags, (n, nodes of an element) tags of nodes, (n, physical groups) tags, 0 for none."""


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in a Gmsh file, with all data of elements.

    Raises
    ------
    InputError
        Naming the section, for any content that is not a mesh of bars.
    """
    # editors on Windows insert a byte order mark
    content = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    if not content.lstrip().startswith(b"$MeshFormat"):
        raise InputError(f"{path}: does not start with $MeshFormat: not a Gmsh mesh of version 2.2 or 4.1")
    parts = sections(path, content)
    del content
    layout = Format(path, parts["MeshFormat"][0])
    if "PartitionedEntities" in parts:
        raise InputError(f"{path}: section $PartitionedEntities: save the mesh without partitions")
    for name in ("Nodes", "Elements"):
        if name not in parts:
            raise InputError(f"{path}: has no section ${name}")

    def numbers(name: str) -> Numbers:
        return Numbers(f"{path}: section ${name}", parts.pop(name)[0], layout, layout.version == "2.2")

    names = _physical_names(path, parts.get("PhysicalNames", [b"0"])[0])
    if layout.version == "2.2":
        tags, points = _nodes_2(numbers("Nodes"))
        elements = _elements_2(path, numbers("Elements"), layout.binary)
    else:
        tags, points = _nodes_4(path, numbers("Nodes"))
        groups = read_entities(numbers("Entities")) if "Entities" in parts else {}
        elements = _elements_4(path, numbers("Elements"), groups)
    mesh = _assemble(path, tags, points, elements, names)
    lines = [own for kind, own, _, _ in elements if kind == _LINE]
    bar_tags = np.concatenate([np.empty(0, np.int64), *lines])
    if any(ORDERED in text for text in parts.get("Comments", [])):
        bar_tags = in_order(mesh, bar_tags)
    if layout.version == "2.2":
        bar_tags = once(mesh, bar_tags)
    for payload in parts.get("ElementData", []):
        element_data(path, payload, layout, bar_tags, mesh)
    return mesh


def read_on(path: Path, comm: MPI.Comm, fields: Mapping[str, str]) -> MeshSlab | None:
    """Return this rank's slab of a file of version 4.1 without data of elements, which rank 0 parses in pieces; None on
    all ranks for files that are read whole, and for those with something wrong. Collective."""
    if fields:
        return None
    found = parse(path, comm, _LINE, _POINT, _nodes_of)
    if found is None:
        return None
    parsed, texts = found
    try:
        names = _physical_names(path, texts.get("PhysicalNames", b"0"))
    except InputError:
        return None  # the same on all ranks
    return assemble(parsed, comm, names, ORDERED in texts.get("Comments", b""), str(path))


def _physical_names(path: Path, payload: bytes) -> dict[tuple[int, int], str]:
    """Return names by dimension and tag; this section is text even in binary files."""
    lines = payload.decode("utf-8", "replace").splitlines() or [""]
    names = {}
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        where = f"{path}: section $PhysicalNames, line {number}"
        fields = line.split(None, 2)
        if len(fields) != 3 or len(fields[2].strip()) < 3 or not fields[2].strip().startswith('"'):
            raise InputError(f"{where}: {line[:60]!r} is not 'dimension tag \"name\"'")
        try:
            names[int(fields[0]), int(fields[1])] = fields[2].strip().strip('"')
        except ValueError:
            raise InputError(f"{where}: dimension and tag must be whole numbers, not {line[:60]!r}") from None
    if lines[0].strip() != str(len(names)):
        raise InputError(f"{path}: section $PhysicalNames declares {lines[0][:20]!r} names and has {len(names)}")
    return names


def _nodes_2(numbers: Numbers) -> tuple[np.ndarray, np.ndarray]:
    tags, points = numbers.rows(numbers.count(), 1, 3)
    numbers.end()
    return tags[:, 0], points


def _nodes_4(path: Path, numbers: Numbers) -> tuple[np.ndarray, np.ndarray]:
    n_blocks, n_nodes, _, _ = numbers.sizes(4)
    tags, points = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for _ in range(n_blocks):
        dimension, _, parametric = numbers.ints(3)
        if dimension not in (0, 1, 2, 3):
            raise InputError(f"{path}: section $Nodes: a block of entities of dimension {dimension}")
        n = int(numbers.sizes(1)[0])
        tags.append(numbers.sizes(n))
        width = 3 + int(dimension if parametric else 0)
        points.append(numbers.reals(n * width).reshape(n, width)[:, :3])
    numbers.end()
    result = np.concatenate(tags), np.concatenate(points)
    if len(result[0]) != n_nodes:
        raise InputError(f"{path}: section $Nodes declares {n_nodes} nodes, its blocks hold {len(result[0])}")
    return result


def _elements_2(path: Path, numbers: Numbers, binary: bool) -> Elements:
    elements: Elements = []
    declared = numbers.count()
    done = 0
    run = 1
    while done < declared:
        if binary:
            kind, n, n_tags = (int(i) for i in numbers.ints(3))
        else:
            head = numbers.peek(3)
            _, kind, n_tags = (int(i) for i in head) if len(head) == 3 and np.isfinite(head).all() else (0, 0, 0)
        nodes = _nodes_of(path, kind)
        if not 0 <= n_tags < 1000:
            raise InputError(f"{path}: section $Elements: {n_tags} tags of element {done} of {declared}")
        if binary:
            rows = numbers.ints(n * (1 + n_tags + nodes)).reshape(n, 1 + n_tags + nodes)
        else:
            # Find the run of consecutive elements of the same type, searching ever farther.
            width = 3 + n_tags + nodes
            ahead = numbers.peek(min(run, declared - done) * width)
            ahead = ahead[: len(ahead) // width * width].reshape(-1, width)
            alike = (ahead[:, 1] == kind) & (ahead[:, 2] == n_tags)
            n = len(alike) if alike.all() else int(alike.argmin())
            run = 2 * max(n, 1)
            rows = numbers.ints(max(n, 1) * width).reshape(-1, width)[:, [0, *range(3, width)]]
        if not 0 < len(rows) <= declared - done:
            raise InputError(f"{path}: section $Elements declares {declared} elements, its blocks hold others")
        done += len(rows)
        elements.append((kind, rows[:, 0], rows[:, 1 + n_tags :], rows[:, 1 : 1 + min(n_tags, 1)]))
    numbers.end()
    return elements


def _elements_4(path: Path, numbers: Numbers, groups: dict[tuple[int, int], np.ndarray]) -> Elements:
    elements: Elements = []
    n_blocks, declared, _, _ = numbers.sizes(4)
    for _ in range(n_blocks):
        dimension, entity, kind = (int(i) for i in numbers.ints(3))
        n = int(numbers.sizes(1)[0])
        nodes = _nodes_of(path, kind)
        rows = numbers.sizes(n * (1 + nodes)).reshape(n, 1 + nodes)
        physical = groups.get((dimension, entity), np.empty(0, np.int64))
        elements.append((kind, rows[:, 0], rows[:, 1:], np.broadcast_to(physical, (n, len(physical)))))
    numbers.end()
    held = sum(len(tags) for _, tags, _, _ in elements)
    if held != declared:
        raise InputError(f"{path}: section $Elements declares {declared} elements, its blocks hold {held}")
    return elements


def _nodes_of(path: Path, kind: int) -> int:
    if kind in _CURVED:
        raise InputError(f"{path}: section $Elements: curved lines (type {kind}); make the mesh of order 1")
    if kind not in _NODES:
        raise InputError(f"{path}: section $Elements: {kind} is not a known type of element")
    return _NODES[kind]


def _assemble(
    path: Path, tags: np.ndarray, points: np.ndarray, elements: Elements, names: dict[tuple[int, int], str]
) -> WholeMesh:
    """Replace tags by numbers from 0, and collect bars and groups."""
    order = np.argsort(tags, kind="stable")
    in_order = tags[order]
    twice = np.flatnonzero(in_order[1:] == in_order[:-1])
    if len(twice):
        raise InputError(f"{path}: section $Nodes: node {in_order[twice[0]]} is listed more than once")

    def numbered(wanted: np.ndarray) -> np.ndarray:
        place = np.minimum(np.searchsorted(in_order, wanted), max(len(in_order) - 1, 0))
        missing = wanted[in_order[place] != wanted] if len(in_order) else wanted
        if missing.size:
            raise InputError(f"{path}: section $Elements: node {missing.flat[0]} is not in $Nodes")
        return order[place]

    mesh = WholeMesh(points=points, bars=np.empty((0, 2), np.int64))
    bars = [mesh.bars]
    node_parts: dict[int, list[np.ndarray]] = {}
    bar_parts: dict[int, list[np.ndarray]] = {}
    n_bars = 0
    for kind, _, nodes, physical in elements:
        if kind == _LINE:
            bars.append(numbered(nodes))
            _collect(bar_parts, np.arange(n_bars, n_bars + len(nodes)), physical)
            n_bars += len(nodes)
        elif kind == _POINT:
            _collect(node_parts, numbered(nodes[:, 0]), physical)
    mesh.bars = np.concatenate(bars)
    for dimension, parts, groups in ((0, node_parts, mesh.node_groups), (1, bar_parts, mesh.bar_groups)):
        for tag in sorted(parts):
            name = names.get((dimension, tag), f"group_{tag}")
            groups[name] = np.unique(np.concatenate([*parts[tag], groups.get(name, np.empty(0, np.int64))]))
        for (of, _), name in names.items():
            if of == dimension:
                groups.setdefault(name, np.empty(0, np.int64))
    others = sum(len(nodes) for kind, _, nodes, _ in elements if kind not in (_LINE, _POINT))
    if others:
        mesh.warnings.append(f"{path}: left out {others} elements that are neither lines nor points")
    return mesh


def _collect(parts: dict[int, list[np.ndarray]], members: np.ndarray, physical: np.ndarray) -> None:
    # A negative tag denotes the same group with reversed orientation.
    for column in np.abs(physical).T:
        for tag in np.unique(column[column != 0]):
            parts.setdefault(int(tag), []).append(members[column == tag])
