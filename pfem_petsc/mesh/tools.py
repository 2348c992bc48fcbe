"""Operations on whole meshes, for one rank: clean, merge, refine and scale, which return a new mesh, and a summary."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..errors import InputError
from .whole import WholeMesh, check_numbers

MERGED = 1e-6
"""Default of the distance up to which nodes are merged, over the mean length of the bars."""

_POWERS = {
    "young_modulus": -2,
    "yield_stress": -2,
    "isotropic_hardening": -2,
    "kinematic_hardening": -2,
    "density": -4,
    "damping": -4,
    "curve": -2,
    "area": 2,
    "thickness": 1,
    "prestress": -2,
    "motion": 1,
    "velocity": 1,
    "acceleration": 1,
    "stiffness": -1,
    "coefficient": -1,
}
"""Powers of a unit of length in those of keys, with newtons and seconds: MPa are N/mm2, t/mm3 are N s2/mm4."""
_OF_MASSES = {"value": -1}


def lengths(mesh: WholeMesh) -> np.ndarray:
    """Return the lengths (bars,) of the bars [m]."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.linalg.norm(mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]], axis=1)


def tolerance_of(mesh: WholeMesh) -> float:
    """Return the default distance [m] up to which nodes are merged."""
    own = lengths(mesh)
    own = own[np.isfinite(own)]
    return MERGED * float(own.mean()) if len(own) else 0.0


def components(n: int, pairs: np.ndarray) -> np.ndarray:
    """Return for each of n items the lowest number (n,) of those that pairs (m, 2) connect it with."""
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (n, n))
    _, part = connected_components(graph, directed=False)
    _, first = np.unique(part, return_index=True)
    return first[part]


def coincident(points: np.ndarray, tolerance: float, source: str = "mesh") -> np.ndarray:
    """Return for each node the lowest number (nodes,) of those at its place.

    Parameters
    ----------
    points : (nodes, 3) [m]
    tolerance : distance [m] up to which two nodes coincide, also through a third one; 0: equal coordinates
    source : of the nodes, for messages
    """
    for bad in np.flatnonzero(~np.isfinite(points).all(axis=1))[:1]:
        raise InputError(f"{source}: node {bad} has coordinates that are not finite: correct them first")
    if tolerance <= 0.0:
        _, first, place = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
        return first[place.ravel()]
    return components(len(points), KDTree(points).query_pairs(tolerance, output_type="ndarray"))


def copies(bars: np.ndarray) -> np.ndarray:
    """Return for each bar the lowest number (bars,) of those between the same two nodes."""
    _, first, place = np.unique(np.sort(bars, axis=1), axis=0, return_index=True, return_inverse=True)
    return first[place.ravel()]


def cleaned(mesh: WholeMesh, tolerance: float | None = None, sum_areas: bool = False) -> tuple[WholeMesh, list[str]]:
    """Merge nodes, and remove double bars, bars without length, and nodes without bars.

    Parameters
    ----------
    tolerance : distance [m] up to which nodes are merged; default: 1e-6 of the mean length of the bars
    sum_areas : whether the bar kept of several between the same nodes has the sum of their areas

    Returns
    -------
    The mesh, and what was done, as lines. Groups have the bars and nodes that stay for those that were removed.
    """
    distance, done = tolerance_of(mesh) if tolerance is None else tolerance, []
    node = coincident(mesh.points, distance, mesh.source)
    merged_away = int((node != np.arange(len(node))).sum())
    done += [f"{merged_away} nodes merged with others within {distance:g} m"] * bool(merged_away)
    bars = node[mesh.bars]
    real = bars[:, 0] != bars[:, 1]
    done += [f"{int((~real).sum())} bars without length removed"] * (not real.all())
    first = np.full(len(bars), -1)
    first[real] = np.flatnonzero(real)[copies(bars[real])] if real.any() else -1
    kept = np.flatnonzero(first == np.arange(len(bars)))
    fields, double = {name: values[kept] for name, values in mesh.bar_fields.items()}, int(real.sum()) - len(kept)
    added = ""
    if double and sum_areas and "area" in fields:
        fields["area"] = np.bincount(first[real], mesh.bar_fields["area"][real], len(bars))[kept]
        added = ", their areas added to its area"
    done += [f"{double} bars between the same nodes as another one removed{added}"] * bool(double)
    used = np.zeros(len(node), bool)
    used[bars[kept]] = True
    bare = len(node) - merged_away - int(used.sum())
    done += [f"{bare} nodes without bars removed"] * bool(bare)
    new_node = np.where(used, np.cumsum(used) - 1, -1)[node]
    new_bar = np.full(len(bars), -1)
    new_bar[kept] = np.arange(len(kept))
    new_bar = np.where(first >= 0, new_bar[first], -1)
    return replace(
        mesh,
        points=mesh.points[used],
        bars=new_node[bars[kept]],
        node_groups=_renumbered(mesh.node_groups, new_node),
        bar_groups=_renumbered(mesh.bar_groups, new_bar),
        bar_fields=fields,
        node_fields={name: values[used] for name, values in mesh.node_fields.items()},
    ), done


def _renumbered(groups: dict[str, np.ndarray], new: np.ndarray) -> dict[str, np.ndarray]:
    found = {name: np.unique(new[members]) for name, members in groups.items()}
    return {name: members[members >= 0] for name, members in found.items()}


def merged(meshes: Sequence[WholeMesh], tolerance: float | None = None) -> tuple[WholeMesh, list[str]]:
    """Merge meshes, join coincident nodes, and remove what :func:`cleaned` removes.

    Groups of the same name become one. The bars and nodes of each file are groups with the name of the file, where no
    other group has it. Bar fields that not all meshes have are left out, which the lines tell that are returned.
    """
    nodes = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    bars = np.cumsum([0, *(len(mesh.bars) for mesh in meshes)])
    together = WholeMesh(
        np.concatenate([mesh.points for mesh in meshes]),
        np.concatenate([mesh.bars + first for mesh, first in zip(meshes, nodes)]),
    )
    done = []
    for kind, firsts in (("node_groups", nodes), ("bar_groups", bars)):
        groups: dict[str, np.ndarray] = {}
        named = {name for mesh in meshes for name in getattr(mesh, kind)}
        for mesh, first, end in zip(meshes, firsts, firsts[1:]):
            own = {name: members + first for name, members in getattr(mesh, kind).items()}
            own |= {name: np.arange(first, end) for name in {Path(mesh.source).stem} - named}
            for name, members in own.items():
                groups[name] = np.concatenate([groups.get(name, np.empty(0, np.int64)), members])
        setattr(together, kind, groups)
    for kind in ("bar_fields", "node_fields"):
        fields = [getattr(mesh, kind) for mesh in meshes]
        common = set(fields[0]).intersection(*fields)
        setattr(together, kind, {name: np.concatenate([own[name] for own in fields]) for name in sorted(common)})
        done += [f"field {name} left out: not all files have it" for name in sorted(set().union(*fields) - common)]
    for mesh in meshes:
        together.warnings += mesh.warnings
        for table, rows in mesh.tables.items():
            # the analysis is that of the first file that has one
            rows = together.tables.get(table, rows) if table == "analysis" else rows
            into: dict[str, Any] = together.tables.setdefault(table, {})
            differing = [name for name, keys in rows.items() if into.setdefault(name, keys) != keys]
            told = "differs from that of an earlier file, which is kept"
            done += [f"{table} {name} of {mesh.source} {told}" for name in differing]
    result, removed = cleaned(together, tolerance)
    return result, done + removed


def refined(mesh: WholeMesh, n: int) -> WholeMesh:
    """Divide each bar into n of the same length.

    Bar k becomes the bars from n k to n k + n - 1, with its groups and fields; new nodes are numbered after the others,
    and have NaN in fields of nodes.
    """
    if n < 1:
        raise InputError(f"refine: {n} parts of a bar; expected a whole number from 1 on")
    old, count = len(mesh.points), len(mesh.bars)
    (start, end), share = mesh.points[mesh.bars.T][..., None, :], (np.arange(1, n) / n)[:, None]
    inner = (start * (1.0 - share) + end * share).reshape(-1, 3)
    between = old + np.arange(count * (n - 1)).reshape(count, n - 1)
    chain = np.concatenate([mesh.bars[:, :1], between, mesh.bars[:, 1:]], axis=1)
    bars = np.stack([chain[:, :-1], chain[:, 1:]], axis=2).reshape(-1, 2)
    groups = {name: (np.asarray(own)[:, None] * n + np.arange(n)).ravel() for name, own in mesh.bar_groups.items()}
    unknown = np.full(len(inner), np.nan)
    return replace(
        mesh,
        points=np.concatenate([mesh.points, inner]),
        bars=bars,
        node_groups=dict(mesh.node_groups),
        bar_groups=groups,
        bar_fields={name: np.repeat(values, n) for name, values in mesh.bar_fields.items()},
        node_fields={name: np.concatenate([values, unknown]) for name, values in mesh.node_fields.items()},
    )


def scaled(mesh: WholeMesh, scale: float) -> WholeMesh:
    """Convert a mesh from another unit of length, with newtons and seconds.

    Coordinates are multiplied by ``scale`` [m per unit], the field ``area`` and areas of sections by its square,
    stresses of materials by its power -2, densities by its power -4 (tonnes per cubic millimetre with 0.001), and what
    else the tables have likewise.
    """
    if not 0.0 < scale < np.inf:
        raise InputError(f"scale: {scale!r} is not a positive number of metres in a unit of the file")
    if scale == 1.0:
        return mesh
    fields = {name: values * scale**2 if name == "area" else values for name, values in mesh.bar_fields.items()}
    tables = {
        table: {
            name: _scaled_keys(keys, scale, _OF_MASSES if table == "mass" else _POWERS) for name, keys in rows.items()
        }
        for table, rows in mesh.tables.items()
    }
    found = replace(mesh, points=mesh.points * scale, bar_fields=fields, tables=tables)
    check_numbers(WholeMesh(found.points, found.bars).slab(mesh.source), MPI.COMM_SELF)
    return found


def _scaled_keys(keys: dict[str, Any], scale: float, powers: dict[str, int]) -> dict[str, Any]:
    """Return the keys of a table; those of tables in it have their own powers."""
    found: dict[str, Any] = {}
    for key, value in keys.items():
        match value:
            case dict():
                found[key] = _scaled_keys(value, scale, powers)
            case [{}, *_]:
                found[key] = [_scaled_keys(row, scale, powers) for row in value]
            case _:
                found[key] = _scaled_value(value, scale ** powers.get(key, 0))
    return found


def _scaled_value(value: Any, factor: float) -> Any:
    """Return a number, a list of numbers, or the values of rows, whose first column is another quantity, times a
    factor."""
    if factor == 1.0 or isinstance(value, str):
        return value
    if not isinstance(value, list):
        return _converted(value * factor)
    return [[v[0], *_scaled_value(v[1:], factor)] if isinstance(v, list) else _converted(v * factor) for v in value]


def _converted(value: float) -> float:
    """Return a product with a unit as people write it, to 15 digits: 2e-4 and not 1.9999999999999998e-4."""
    return float(f"{value:.15g}")


_SHOWN = 12
"""Number of groups, and of numbers of bars at a node, that are listed."""


def summary(mesh: WholeMesh, tolerance: float | None = None) -> list[tuple[str, str]]:
    """Return labels and texts about a mesh, which need not be one that can be simulated.

    Parameters
    ----------
    tolerance : distance [m] up to which nodes coincide; default: 1e-6 of the mean length of the bars
    """
    return [*_sizes(mesh), *_named(mesh), *_topology(mesh), *_problems(mesh, tolerance)]


def _sizes(mesh: WholeMesh) -> Iterator[tuple[str, str]]:
    yield "nodes", f"{len(mesh.points):,}"
    yield "bars", f"{len(mesh.bars):,}"
    if len(mesh.points):
        low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
        for label, corner, between in (("from", low, ", "), ("to", high, ", "), ("size", high - low, " x ")):
            yield label, between.join(f"{x:.6g}" for x in corner) + " m"
    own = lengths(mesh)
    if len(own):
        yield "lengths", f"{own.min():.6g} to {own.max():.6g} m, mean {own.mean():.6g} m, total {own.sum():.6g} m"
    area = mesh.bar_fields.get("area")
    if area is not None and len(own):
        yield "volume", f"{float(area @ own):.6g} m3"


def _named(mesh: WholeMesh) -> Iterator[tuple[str, str]]:
    for label, groups in (("node groups", mesh.node_groups), ("bar groups", mesh.bar_groups)):
        texts = [f"{name} ({len(members):,})" for name, members in groups.items()]
        if texts:
            yield label, _listed(texts)
    for kind, fields in (("field", mesh.bar_fields), ("node field", mesh.node_fields)):
        for name, values in fields.items():
            unit = " m2" if name == "area" and kind == "field" else ""
            low, high = np.fmin.reduce(values, initial=np.inf), np.fmax.reduce(values, initial=-np.inf)
            yield f"{kind} {name}", f"{low:.6g} to {high:.6g}{unit}"
    for table, rows in mesh.tables.items():
        for name, keys in rows.items():
            yield f"{table} {name}", ", ".join(f"{key} {_short(value)}" for key, value in keys.items()) or "no keys"


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and value and isinstance(value[0], list | dict):
        return f"of {len(value)} rows"
    return f"[{', '.join(map(_short, value))}]" if isinstance(value, list) else str(value)


def _listed(texts: list[str]) -> str:
    return ", ".join(texts[:_SHOWN]) + (f" and {len(texts) - _SHOWN} more" if len(texts) > _SHOWN else "")


def _topology(mesh: WholeMesh) -> Iterator[tuple[str, str]]:
    degree = np.bincount(mesh.bars.ravel(), minlength=len(mesh.points))
    counts = np.bincount(degree)
    texts = [f"{k} ({counts[k]:,} nodes)" for k in np.flatnonzero(counts).tolist()]
    if texts:
        yield "bars at a node", _listed(texts)
    _, sizes = np.unique(components(len(mesh.points), mesh.bars)[mesh.bars[:, 0]], return_counts=True)
    if len(sizes):
        texts = [f"{n:,}" for n in np.sort(sizes)[::-1].tolist()]
        yield "parts", f"{len(sizes):,} that no bar connects, of {_listed(texts)} bars" if len(sizes) > 1 else "1"


def _problems(mesh: WholeMesh, tolerance: float | None) -> Iterator[tuple[str, str]]:
    """Return what ``mesh clean`` removes."""
    distance = tolerance_of(mesh) if tolerance is None else tolerance
    place, same = coincident(mesh.points, distance, mesh.source), copies(mesh.bars)
    for label, found, of in (
        ("nodes at the place of another", np.flatnonzero(place != np.arange(len(place))), place),
        ("bars between the nodes of another", np.flatnonzero(same != np.arange(len(same))), same),
        ("bars without length", np.flatnonzero(place[mesh.bars[:, 0]] == place[mesh.bars[:, 1]]), None),
        ("nodes without bars", np.setdiff1d(np.arange(len(mesh.points)), mesh.bars), None),
    ):
        if len(found):
            some = [str(i) if of is None else f"{of[i]} and {i}" for i in found[:3].tolist()]
            within = f" (within {distance:.3g} m)" if of is place else ""
            yield label, f"{len(found):,}{within}: {', '.join(some)}" + (", ..." if len(found) > 3 else "")
