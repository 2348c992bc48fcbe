"""The model of an Abaqus input file as one mesh: instances placed, labels replaced by numbers from 0."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...errors import InputError
from ._inp_blocks import Block
from ._inp_model import Entry, Model, Scope, SetTable

__all__ = ["Flat"]

_BETWEEN = 0.3
"""Largest distance of the third node of an element from the middle of its ends, over their distance."""


@dataclass
class _Placed:
    """A scope with its nodes and bars in the mesh; ``nodes`` and ``bars`` are its labels, ascending, and ``*_at`` where
    these are."""

    scope: Scope
    nodes: np.ndarray
    nodes_at: np.ndarray
    bars: np.ndarray
    bars_at: np.ndarray


class Flat:
    """Nodes and bars of all instances in their order, without nodes where no bar ends."""

    def __init__(self, path: Path, model: Model) -> None:
        self.path = path
        self.warnings = [f"{path}: {n} elements {note}" for note, n in model.notes.items()]
        if model.left_out:
            self.warnings.append(f"{path}: left out elements of the types {', '.join(sorted(model.left_out))}")
        self._model = model
        self._lost: dict[int, int] = {}
        self._groups: dict[str, dict[str, np.ndarray]] = {}
        self._placed: dict[str, _Placed] = {}
        points, bars = [np.empty((0, 3))], [np.empty((0, 2), np.int64)]
        labels = [np.empty(0, np.int64)]
        n_nodes = n_bars = 0
        for key, scope, place in self._scopes():
            placed, own_points, own_bars = _numbered(path, scope, place, n_nodes, n_bars)
            self._placed[key] = placed
            points.append(own_points)
            bars.append(own_bars)
            labels.append(placed.nodes[np.argsort(placed.nodes_at)])
            n_nodes, n_bars = n_nodes + len(own_points), n_bars + len(own_bars)
        self.points, self.bars = np.concatenate(points), np.concatenate(bars)
        self._drop_bare_nodes(np.concatenate(labels))

    def _scopes(self) -> Iterator[tuple[str, Scope, np.ndarray]]:
        still = np.vstack([np.eye(3), np.zeros(3)])
        model = self._model
        yield "", model.root, still
        for own, part, place, block in model.instances:
            if part.upper() not in model.parts:
                raise InputError(f"{block.where}: there is no part {part}")
            if own.name.upper() in self._placed:
                raise InputError(f"{block.where}: there are two instances of the name {own.name}")
            yield own.name.upper(), _joined(model.parts[part.upper()], own), place
        if model.assembly.labels or model.assembly.elements:
            yield "*ASSEMBLY", model.assembly, still

    def _drop_bare_nodes(self, labels: np.ndarray) -> None:
        used = np.zeros(len(self.points), bool)
        used[self.bars] = True
        self.labels_left_out = labels[~used].tolist()
        self._number = np.where(used, np.cumsum(used) - 1, -1)
        self.points, self.bars = self.points[used], self._number[self.bars]

    def groups(self, kind: str) -> dict[str, np.ndarray]:
        """Return the node sets (``NSET``) or element sets (``ELSET``) as groups.

        A set of a part has its own name where no other set has it, and INSTANCE.NAME otherwise; with several instances
        NAME is the set of all of them.
        """
        if kind in self._groups:
            return self._groups[kind]
        found: dict[str, np.ndarray] = {}
        common: dict[str, tuple[str, list[np.ndarray]]] = {}
        for table in _sets(self._model.assembly, kind).values():
            found[table.name] = self._members(kind, "*ASSEMBLY", table)
        taken = {name.upper() for name in found}
        for key, placed in self._placed.items():
            if key == "*ASSEMBLY":
                continue
            for upper, table in _sets(placed.scope, kind).items():
                members = self._members(kind, key, table)
                common.setdefault(upper, (table.name, []))[1].append(members)
                if key and (upper in taken or len(self._model.instances) > 1):
                    found[f"{placed.scope.name}.{table.name}"] = members
        for upper, (name, parts) in common.items():
            if upper not in taken:
                found[name] = _union(parts)
        lost, self._lost = sum(self._lost.values()), {}
        if lost:
            what = {"NSET": "node", "ELSET": "element"}[kind]
            self.warnings.append(f"{self.path}: {lost} members of {what} sets are not there, and are left out")
        self._groups[kind] = {name.replace("/", "_"): members for name, members in found.items()}
        return self._groups[kind]

    def members_of(self, kind: str, block: Block, target: str) -> np.ndarray:
        """Return the members (n,) of a set, or that of a label, which a keyword outside of parts names."""
        key = "*ASSEMBLY" if self._model.instances else ""
        entry = Entry(block, "", target.strip('"'))
        if target.isdecimal() and len(target) < 16:
            return self._labelled(kind, key, np.array([int(target)]), entry)
        return self._named(kind, key, entry, ())

    def is_internal(self, name: str) -> bool:
        """Whether a set outside of parts is made by a program for itself."""
        table = self._model.root.elsets.get(name.upper())
        return table is not None and all("INTERNAL" in entry.block.parameters for entry in table.entries)

    def sections(self) -> Iterator[tuple[Block, str, np.ndarray]]:
        """Return each section with the name of a bar group, and its bars.

        That of a part is one for all instances if the set of its name has these bars, else one for each instance.
        """
        groups = self.groups("ELSET")
        names = {name.upper(): name for name in groups}
        found: dict[int, tuple[Block, str, list[tuple[str, np.ndarray]]]] = {}
        for key, scope in [*((key, placed.scope) for key, placed in self._placed.items()), *self._bare_assembly()]:
            for block, name in scope.sections:
                table = _sets(scope, "ELSET").get(name.upper())
                if table is None:
                    raise InputError(f"{block.where}: there is no element set {name}")
                full = f"{scope.name}.{name}".upper().replace("/", "_")
                members = self._members("ELSET", key, table)
                found.setdefault(id(block), (block, name, []))[2].append((full, members))
        for block, name, parts in found.values():
            short = names.get(name.upper().replace("/", "_"))
            together = _union([members for _, members in parts])
            if short is not None and np.array_equal(groups[short], together):
                yield block, short, together
            else:
                yield from ((block, names.get(full, short or name), members) for full, members in parts)

    def _bare_assembly(self) -> list[tuple[str, Scope]]:
        """Return the assembly if it has no own nodes and elements: it may have sections of sets of instances."""
        return [] if "*ASSEMBLY" in self._placed else [("*ASSEMBLY", self._model.assembly)]

    def _members(self, kind: str, key: str, table: SetTable, above: tuple[str, ...] = ()) -> np.ndarray:
        """Return the members of a set in the mesh, ascending."""
        parts: list[np.ndarray] = []
        for entry in table.entries:
            here = entry.instance.upper() or key
            if entry.of_elements:
                bars = self._named("ELSET", here, entry, ())
                parts.append(np.unique(self.bars[bars]))
            elif isinstance(entry.what, str):
                parts.append(self._named(kind, here, entry, (*above, f"{key}.{table.name.upper()}")))
            elif entry.what.size:
                parts.append(self._labelled(kind, here, entry.what, entry))
        return _union(parts)

    def _labelled(self, kind: str, key: str, labels: np.ndarray, entry: Entry) -> np.ndarray:
        placed = self._placed.get(key)
        if placed is None and key != "*ASSEMBLY":
            raise InputError(f"{entry.block.where}: there is no instance {key}")
        if placed is None:
            placed = _nothing(self._model.assembly)
        known, at = (placed.nodes, placed.nodes_at) if kind == "NSET" else (placed.bars, placed.bars_at)
        if entry.generated:
            first, last, step = labels.tolist()
            labels = known[(known >= first) & (known <= last) & ((known - first) % step == 0)]
        place = np.minimum(np.searchsorted(known, labels), max(len(known) - 1, 0))
        there = known[place] == labels if len(known) else np.zeros(len(labels), bool)
        if kind == "NSET" or not self._model.left_out:
            self._lost[id(entry)] = int((~there).sum())
        members = at[place[there]] if len(known) else at
        if kind == "NSET":
            members = self._number[members]
            members = members[members >= 0]
        return members

    def _named(self, kind: str, key: str, entry: Entry, above: tuple[str, ...]) -> np.ndarray:
        """Members of a set that is named in another one, as NAME or INSTANCE.NAME, or of INSTANCE.LABEL."""
        name = str(entry.what)
        instance, dot, rest = name.partition(".")
        if dot and instance.upper() in self._placed:
            key, name = instance.upper(), rest
            if name.isdecimal() and len(name) < 16:
                return self._labelled(kind, key, np.array([int(name)]), replace(entry, generated=False))
        scope = self._model.assembly if key == "*ASSEMBLY" else self._placed[key].scope if key in self._placed else None
        table = None if scope is None else _sets(scope, kind).get(name.upper())
        if table is None:
            what = {"NSET": "node", "ELSET": "element"}[kind]
            raise InputError(f"{entry.block.where}: {name!r} is neither a number nor an existing {what} set")
        if f"{key}.{name.upper()}" in above:
            raise InputError(f"{entry.block.where}: set {name} includes itself")
        return self._members(kind, key, table, above)


def _union(parts: list[np.ndarray]) -> np.ndarray:
    """Return the members (n,) of sets, ascending; files with a set for each bar have very many of one member."""
    if len(parts) == 1 and len(parts[0]) == 1:
        return parts[0]
    return np.unique(np.concatenate([np.empty(0, np.int64), *parts]))


def _sets(scope: Scope, kind: str) -> dict[str, SetTable]:
    return scope.nsets if kind == "NSET" else scope.elsets


def _nothing(scope: Scope) -> _Placed:
    none = np.empty(0, np.int64)
    return _Placed(scope, none, none, none, none)


def _joined(part: Scope, own: Scope) -> Scope:
    """The content of a part with that of an instance."""
    return replace(
        own,
        labels=part.labels + own.labels,
        points=part.points + own.points,
        elements=part.elements + own.elements,
        nsets={**part.nsets, **own.nsets},
        elsets={**part.elsets, **own.elsets},
        sections=part.sections + own.sections,
    )


def _numbered(
    path: Path, scope: Scope, place: np.ndarray, first_node: int, first_bar: int
) -> tuple[_Placed, np.ndarray, np.ndarray]:
    """Return a scope in the mesh, its points (n, 3), and its bars (n, 2)."""
    labels = np.concatenate([np.empty(0, np.int64), *scope.labels])
    points = np.concatenate([np.empty((0, 3)), *scope.points])
    nodes, first, at = np.unique(labels, return_index=True, return_inverse=True)
    if len(nodes) < len(labels):
        moved = np.flatnonzero((points != points[first[at.ravel()]]).any(axis=1))
        if len(moved):
            raise InputError(f"{path}: *NODE: node {labels[moved[0]]} is listed more than once, at different positions")
        keep = np.sort(first)
        labels, points = labels[keep], points[keep]
    order = np.argsort(labels, kind="stable")
    own_bars = np.concatenate([np.empty(0, np.int64), *(own for _, own, _ in scope.elements)])
    ends = [np.empty((0, 2), np.int64)]
    for block, own, wanted in scope.elements:
        found = np.minimum(np.searchsorted(nodes, wanted), max(len(nodes) - 1, 0))
        missing = np.argwhere(nodes[found] != wanted) if len(nodes) else np.argwhere(wanted >= 0)
        if len(missing):
            element, side = missing[0]
            raise InputError(f"{block.where}: node {wanted[element, side]} of element {own[element]} is not defined")
        ends.append(_ends(order[found], points, own, block))
    sequence = np.argsort(own_bars, kind="stable")
    twice = np.flatnonzero(np.diff(own_bars[sequence]) == 0)
    if len(twice):
        raise InputError(f"{path}: *ELEMENT: element {own_bars[sequence[twice[0]]]} is listed more than once")
    placed = _Placed(scope, nodes, order + first_node, own_bars[sequence], sequence + first_bar)
    moved_points = points if np.array_equal(place, np.eye(4, 3)) else points @ place[:3] + place[3]
    return placed, moved_points, np.concatenate(ends) + first_node


def _ends(nodes: np.ndarray, points: np.ndarray, labels: np.ndarray, block: Block) -> np.ndarray:
    """Return the nodes at the ends (n, 2) of elements with nodes (n, 2 or 3); the third is that between the others."""
    if nodes.shape[1] == 2:
        return nodes
    pairs = np.array([[1, 2], [0, 2], [0, 1]])  # without each of the three
    a, b = points[nodes[:, pairs[:, 0]]], points[nodes[:, pairs[:, 1]]]
    span = np.linalg.norm(b - a, axis=2)
    off = np.linalg.norm(points[nodes] - 0.5 * (a + b), axis=2) / np.maximum(span, 1e-300)
    middle = off.argmin(axis=1)
    far = np.flatnonzero(~(off.min(axis=1) < _BETWEEN))
    if len(far):
        raise InputError(f"{block.where}: no node of element {labels[far[0]]} is between the other two")
    return np.take_along_axis(nodes, pairs[middle], axis=1)
