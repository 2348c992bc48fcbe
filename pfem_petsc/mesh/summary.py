"""What a mesh has, as lines: counts, sizes, groups, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .tools import coincident, components, copies, lengths, tolerance_of
from .whole import WholeMesh

__all__ = ["problems_of", "summary"]

_SHOWN = 12
"""Number of groups, and of numbers of bars at a node, that are listed."""


def summary(mesh: WholeMesh, tolerance: float | None = None) -> list[tuple[str, str]]:
    """Return labels and texts about a mesh, which need not be one that can be simulated.

    Parameters
    ----------
    tolerance : distance [m] up to which nodes coincide; default: 1e-6 of the mean length of the bars
    """
    return [*_sizes(mesh), *_named(mesh), *_topology(mesh), *problems_of(mesh, tolerance)]


def _sizes(mesh: WholeMesh) -> Iterator[tuple[str, str]]:
    yield "nodes", f"{len(mesh.points):,}"
    yield "bars", f"{len(mesh.bars):,}"
    if len(mesh.points):
        low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
        yield "from", ", ".join(f"{x:.6g}" for x in low) + " m"
        yield "to", ", ".join(f"{x:.6g}" for x in high) + " m"
        yield "size", " x ".join(f"{x:.6g}" for x in high - low) + " m"
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
    for name, values in mesh.bar_fields.items():
        unit = " m2" if name == "area" else ""
        yield f"field {name}", f"{values.min(initial=np.inf):.6g} to {values.max(initial=-np.inf):.6g}{unit}"
    for table, rows in mesh.tables.items():
        for name, keys in rows.items():
            yield f"{table} {name}", ", ".join(f"{key} {_short(value)}" for key, value in keys.items()) or "no keys"


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"of {len(value)} rows" if isinstance(value, list) else str(value)


def _listed(texts: list[str]) -> str:
    return ", ".join(texts[:_SHOWN]) + (f" and {len(texts) - _SHOWN} more" if len(texts) > _SHOWN else "")


def _topology(mesh: WholeMesh) -> Iterator[tuple[str, str]]:
    degree = np.bincount(mesh.bars.ravel(), minlength=len(mesh.points))
    counts = np.bincount(degree)
    texts = [f"{k} ({counts[k]:,} nodes)" for k in np.flatnonzero(counts).tolist()]
    if texts:
        yield "bars at a node", _listed(texts)
    root = components(len(mesh.points), mesh.bars)
    sizes = np.sort(np.bincount(root[mesh.bars[:, 0]])) if len(mesh.bars) else np.empty(0, np.int64)
    sizes = sizes[sizes > 0][::-1]
    if len(sizes) > 1:
        yield "parts", f"{len(sizes):,} that no bar connects, of {_listed([f'{n:,}' for n in sizes.tolist()])} bars"
    elif len(sizes):
        yield "parts", "1"


def problems_of(mesh: WholeMesh, tolerance: float | None = None) -> Iterator[tuple[str, str]]:
    """Return what ``mesh clean`` removes."""
    distance = tolerance_of(mesh) if tolerance is None else tolerance
    place = coincident(mesh.points, distance)
    double = np.flatnonzero(place != np.arange(len(place)))
    if len(double):
        some = [f"{place[i]} and {i}" for i in double[:3].tolist()]
        yield "nodes at the place of another", f"{len(double):,} (within {distance:.3g} m): {_few(some, len(double))}"
    same = copies(mesh.bars)
    twice = np.flatnonzero(same != np.arange(len(same)))
    if len(twice):
        some = [f"{same[i]} and {i}" for i in twice[:3].tolist()]
        yield "bars between the nodes of another", f"{len(twice):,}: {_few(some, len(twice))}"
    short = np.flatnonzero(place[mesh.bars[:, 0]] == place[mesh.bars[:, 1]])
    if len(short):
        yield "bars without length", f"{len(short):,}: {_few(short[:3].tolist(), len(short))}"
    free = np.setdiff1d(np.arange(len(mesh.points)), mesh.bars)
    if len(free):
        yield "nodes without bars", f"{len(free):,}: {_few(free[:3].tolist(), len(free))}"


def _few(some: list, count: int) -> str:
    return ", ".join(map(str, some)) + (", ..." if count > len(some) else "")
