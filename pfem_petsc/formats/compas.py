"""Networks, graphs and meshes of COMPAS (.json), versions 1 and 2: edges are bars, attributes are fields and groups.

Attributes that are numbers are fields, those that are true or false are groups of the nodes or bars where they are
true. The file is that of ``compas.json_dump`` or of the method ``to_json``.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._common import edges

SUFFIXES = (".json",)

_DEFAULTS = {"node": ("default_node_attributes", "dna"), "vertex": ("default_vertex_attributes", "dva")}
_OF_EDGES = ("default_edge_attributes", "dea")


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the edges of the first network, graph or mesh in a file.

    Raises
    ------
    InputError
        If it is not JSON, or has none.
    """
    try:
        # whole numbers of any length, of which the longest are infinite
        content = json.loads(path.read_bytes(), parse_int=lambda text: int(text) if len(text) < 19 else float(text))
        found = list(_structures(content))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON: {error}") from None
    if not found:
        raise InputError(f"{path}: has no network, graph or mesh of COMPAS (nodes and edges, or vertices and faces)")
    data, kind = found[0]
    number = {key: i for i, key in enumerate(data[kind])}
    try:
        nodes = _with_defaults(data, _DEFAULTS[kind], data[kind].values())
        points = np.array([_place(kind, key, node) for key, node in zip(number, nodes)])
        ends, given = _edges_of(data, number)
        bars = _with_defaults(data, _OF_EDGES, given)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    except (TypeError, AttributeError) as error:
        raise InputError(f"{path}: its {kind} or edges are not what COMPAS writes: {error}") from None
    mesh = WholeMesh(points.reshape(-1, 3), np.array(ends, np.int64).reshape(-1, 2))
    left = [*_attributes(nodes, mesh.node_fields, mesh.node_groups)]
    left += _attributes(bars, mesh.bar_fields, mesh.bar_groups)
    for name, values in (mesh.node_fields | mesh.bar_fields).items():
        n = int((~np.isfinite(values)).sum())
        mesh.tell(n, f"{path}: the attribute {name} is not a finite number {n} times")
    mesh.tell(left, f"{path}: left out the attributes {', '.join(left)}: not one number for each node or edge")
    mesh.tell(len(found) > 1, f"{path}: has {len(found)} networks, graphs and meshes: the first one is read")
    return mesh


def _structures(value: Any) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the data of all structures in a file, and whether they have the key ``node`` or ``vertex``."""
    if isinstance(value, dict):
        for kind, other in (("node", "edge"), ("vertex", "face"), ("vertex", "edge")):
            if isinstance(value.get(kind), dict) and isinstance(value.get(other), dict):
                yield value, kind
                return
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _structures(inner)


def _edges_of(data: dict[str, Any], number: dict[str, int]) -> tuple[Sequence[Any], list[dict[str, Any]]]:
    """Return the ends of edges, and their attributes."""
    of = data.get("edge")
    if of:
        pairs = [(u, v) for u in of for v in of[u]]
        ends = [[_number(number, key, f"edge {u}-{v}") for key in (u, v)] for u, v in pairs]
        return ends, [dict(of[u][v] or {}) for u, v in pairs]
    faces = data.get("face") or {}
    loops = [[_number(number, key, f"face {name}") for key in face] for name, face in faces.items() if face]
    around = [pair for loop in loops for pair in pairwise([*loop, loop[0]])]
    ends, _ = edges(np.array(around, np.int64).reshape(-1, 2))
    given = {frozenset(key.strip("()").replace(",", "-").replace(" ", "").split("-")): own
             for key, own in (data.get("edgedata") or {}).items()}  # fmt: skip
    keys = list(number)
    return ends, [dict(given.get(frozenset((keys[a], keys[b])), {})) for a, b in ends.tolist()]


def _number(number: dict[str, int], key: Any, of: str) -> int:
    if str(key) not in number:
        raise ValueError(f"{of} ends at {str(key)!r}, and there is no such node or vertex")
    return number[str(key)]


def _place(kind: str, key: str, node: dict[str, Any]) -> list[float]:
    """Take the coordinates out of the attributes of a node."""
    found = [(axis, node.pop(axis, None)) for axis in "xyz"]
    for axis, value in found:
        if isinstance(value, bool) or not isinstance(value, int | float):
            has = "no" if value is None else f"{value!r} as"
            raise ValueError(f"{kind} {key!r} has {has} {axis}: expected a number, there or in the default attributes")
    return [float(value) for _, value in found]


def _with_defaults(
    data: dict[str, Any], names: Sequence[str], rows: Collection[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    default = next((data[name] for name in names if data.get(name)), {})
    return [{**default, **row} for row in rows]


def _attributes(rows: list[dict[str, Any]], fields: dict[str, Any], groups: dict[str, Any]) -> Iterator[str]:
    """Add attributes that all rows have to fields and groups; yield the names of others."""
    for key in dict.fromkeys(key for row in rows for key in row):
        values, name = [row.get(key) for row in rows], key.replace("/", "_")
        kinds = {type(value) for value in values} - {type(None)}
        if kinds == {bool}:
            groups[name] = np.flatnonzero([bool(value) for value in values])
        elif all(isinstance(value, int | float) for value in values):
            fields[name] = np.array(values, np.float64)
        elif kinds:
            yield key
