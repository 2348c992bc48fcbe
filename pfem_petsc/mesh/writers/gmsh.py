"""Gmsh files (.msh), version 4.1, ASCII: groups are physical groups, bar fields are $ElementData.

Bars of the same groups are a curve, each node of a group is a point. The tags are the numbers from 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from ..readers.gmsh import ORDERED
from ..whole import WholeMesh

__all__ = ["SUFFIXES", "write"]

SUFFIXES = (".msh",)


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, to the last digit."""
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        for line in _lines(mesh):
            file.write(line + "\n")


def _lines(mesh: WholeMesh) -> Iterator[str]:
    curves, curve_of = _combinations(mesh.bar_groups, len(mesh.bars))
    points, point_of = _combinations(mesh.node_groups, len(mesh.points))
    # every node of a group is a point of its own, where Gmsh expects one node
    grouped = np.flatnonzero([len(points[number]) > 0 for number in point_of.tolist()])
    yield from ("$MeshFormat", "4.1 0 8", "$EndMeshFormat", "$Comments", ORDERED.decode(), "$EndComments")
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
    yield from chain.from_iterable(_data(name, values) for name, values in mesh.bar_fields.items())


def _data(name: str, values: np.ndarray) -> Iterator[str]:
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
