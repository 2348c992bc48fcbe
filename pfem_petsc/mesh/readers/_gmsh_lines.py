"""Lines of Gmsh files: their order, copies of lines in several groups, and data of elements."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh
from ._gmsh_sections import Format, Numbers

__all__ = ["element_data", "in_order", "once"]


def in_order(mesh: WholeMesh, tags: np.ndarray) -> np.ndarray:
    """Sort the bars by their tags, and return these."""
    order = np.argsort(tags, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    mesh.bars = mesh.bars[order]
    mesh.bar_groups = {name: np.sort(place[members]) for name, members in mesh.bar_groups.items()}
    return tags[order]


def once(mesh: WholeMesh, tags: np.ndarray) -> np.ndarray:
    """Join the copies of a bar in version 2.2, where it is listed once for each of its groups; return the tags."""
    _, first, place = np.unique(mesh.bars, axis=0, return_index=True, return_inverse=True)
    first = first[place.ravel()]
    grouped = np.zeros(len(mesh.bars), bool)
    for members in mesh.bar_groups.values():
        grouped[members] = True
    # two lines of the same group are no copies
    own = {name: np.unique(first[members], return_counts=True) for name, members in mesh.bar_groups.items()}
    twice = np.unique(np.concatenate([np.empty(0, np.int64), *(bars[count > 1] for bars, count in own.values())]))
    copy = (first != np.arange(len(first))) & grouped & grouped[first] & ~np.isin(first, twice)
    if not copy.any():
        return tags
    number = np.cumsum(~copy) - 1
    number = np.where(copy, number[first], number)
    mesh.bars = mesh.bars[~copy]
    mesh.bar_groups = {name: np.unique(number[members]) for name, members in mesh.bar_groups.items()}
    return tags[~copy]


def element_data(path: Path, payload: bytes, layout: Format, bar_tags: np.ndarray, mesh: WholeMesh) -> None:
    """Add a section $ElementData to the bar fields, or a warning; its head is text in binary files too."""
    where = f"{path}: section $ElementData"
    head: list[list[bytes]] = []
    for _ in range(3):  # texts, real numbers, whole numbers
        count, _, payload = payload.partition(b"\n")
        if not count.strip().isdigit() or int(count) > 100:
            raise InputError(f"{where}: {count[:60].decode('utf-8', 'replace')!r} is not the number of its tags")
        lines = []
        for _ in range(int(count)):
            line, _, payload = payload.partition(b"\n")
            lines.append(line.strip())
        head.append(lines)
    name = head[0][0].decode("utf-8", "replace").strip('"') if head[0] else ""
    if len(head[2]) < 3 or not all(word.lstrip(b"-").isdigit() for word in head[2][:3]):
        raise InputError(f"{where} {name!r}: expected three whole numbers: time step, components, number of elements")
    components, n = int(head[2][1]), int(head[2][2])
    if components != 1 or not name or "/" in name:
        mesh.warnings.append(f"{where} {name!r} is left out: a bar field has a name without slash and one component")
        return
    numbers = Numbers(f"{where} {name!r}", payload, layout, False)
    tags, values = numbers.rows(n, 1, 1)
    numbers.end()
    tags = tags[:, 0]
    order = np.argsort(tags, kind="stable")
    at = np.minimum(np.searchsorted(tags[order], bar_tags), max(n - 1, 0))
    if n == 0 or not np.array_equal(tags[order][at], bar_tags):
        mesh.warnings.append(f"{where} {name!r} is left out: it does not have a value for each line")
        return
    mesh.bar_fields[name] = values[order[at], 0]
