"""Parts, instances and sets of Abaqus input files."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from ...errors import InputError
from ._inp_blocks import Block

__all__ = ["BARS", "Entry", "Model", "Scope", "SetTable"]

BARS = (
    (re.compile(r"T[23]D2[A-Z]*|TRUSS"), 2, ""),
    (re.compile(r"T[23]D3[A-Z]*"), 3, "trusses with three nodes are read as bars between their ends"),
    (
        re.compile(r"(B[23][13]|PIPE[23]1)[A-Z]*|FRAME[23]D"),
        2,
        "beams are read as bars, without bending stiffness",
    ),
    (
        re.compile(r"(B[23]2|PIPE[23]2)[A-Z]*"),
        3,
        "beams with three nodes are read as bars between their ends, without bending stiffness",
    ),
)
"""Types of elements that are bars, their numbers of nodes, and what is to be said about them."""


@dataclass
class Entry:
    """Members of a set."""

    block: Block
    instance: str
    """Whose labels they are; empty: those of the place of the set."""
    what: np.ndarray | str
    """Labels (n,), or the name of a set."""
    generated: bool = False
    """Whether ``what`` is first, last and step of labels, of which not all need exist."""
    of_elements: bool = False
    """Whether ``what`` is an element set, whose nodes they are."""


@dataclass
class SetTable:
    """A set of nodes or elements: its entries are resolved when all is read."""

    name: str
    entries: list[Entry] = field(default_factory=list)


@dataclass
class Scope:
    """A part, an instance, the assembly, or what stands outside of them, each with labels of its own."""

    name: str
    labels: list[np.ndarray] = field(default_factory=list)
    points: list[np.ndarray] = field(default_factory=list)
    elements: list[tuple[Block, np.ndarray, np.ndarray]] = field(default_factory=list)
    """Where, labels (n,), labels of the nodes (n, 2 or 3)."""
    nsets: dict[str, SetTable] = field(default_factory=dict)
    elsets: dict[str, SetTable] = field(default_factory=dict)
    sections: list[tuple[Block, str]] = field(default_factory=list)
    """Where, and the element set."""

    def add_to(self, sets: dict[str, SetTable], name: str, entry: Entry) -> None:
        """Add members to a set."""
        sets.setdefault(name.upper(), SetTable(name)).entries.append(entry)


@dataclass
class Model:
    """What a file has."""

    root: Scope = field(default_factory=lambda: Scope(""))
    assembly: Scope = field(default_factory=lambda: Scope(""))
    parts: dict[str, Scope] = field(default_factory=dict)
    instances: list[tuple[Scope, str, np.ndarray, Block]] = field(default_factory=list)
    """Own content, name of the part, (4, 3) rotation (by rows, applied to rows from the right) and translation."""
    notes: dict[str, int] = field(default_factory=dict)
    """What is to be said about elements, and how many of them."""
    left_out: dict[str, int] = field(default_factory=dict)
    """Types of elements that are no bars, and how many blocks of them."""

    def add_nodes(self, scope: Scope, block: Block) -> None:
        """Read ``*NODE``."""
        system = block.get("SYSTEM", "R").upper()
        if system != "R":
            raise InputError(f"{block.where}: SYSTEM={system} is not read: write the nodes in Cartesian coordinates")
        rows = block.rows(7)[:, :4]
        labels = _labels(rows[:, 0], block, "node")
        scope.labels.append(labels)
        scope.points.append(np.where(np.isnan(rows[:, 1:]), 0.0, rows[:, 1:]))
        if block.get("NSET"):
            scope.add_to(scope.nsets, block.get("NSET"), Entry(block, "", labels))

    def add_elements(self, scope: Scope, block: Block) -> None:
        """Read ``*ELEMENT``."""
        kind = block.required("TYPE").upper()
        known = next(((count, note) for pattern, count, note in BARS if pattern.fullmatch(kind)), None)
        if known is None:
            self.left_out[kind] = self.left_out.get(kind, 0) + 1
            return
        count, note = known
        least = 1 + count
        rows = block.rows(least + 2, least)[:, :least]
        labels = _labels(rows[:, 0], block, "element")
        nodes = _labels(rows[:, 1:].ravel(), block, "node").reshape(len(rows), count)
        scope.elements.append((block, labels, nodes))
        if note:
            self.notes[f"{kind}: {note}"] = self.notes.get(f"{kind}: {note}", 0) + len(rows)
        if block.get("ELSET"):
            scope.add_to(scope.elsets, block.get("ELSET"), Entry(block, "", labels))

    def add_set(self, scope: Scope, block: Block, kind: str) -> None:
        """Read ``*NSET`` or ``*ELSET``."""
        sets = scope.nsets if kind == "NSET" else scope.elsets
        name, instance = block.required(kind), block.get("INSTANCE")
        scope.add_to(sets, name, Entry(block, instance, np.empty(0, np.int64)))
        if kind == "NSET" and block.get("ELSET"):
            scope.add_to(sets, name, Entry(block, instance, block.get("ELSET"), of_elements=True))
            return
        if "GENERATE" in block.parameters:
            for first, last, step in _labels(_filled(block), block, "member").reshape(-1, 3).tolist():
                if step < 1 or last < first:
                    raise InputError(f"{block.where}: {first}, {last}, {step} are not first, last and step")
                labels = np.array([first, last, step])
                scope.add_to(sets, name, Entry(block, instance, labels, generated=True))
            return
        numbers = block.numbers()
        if numbers is not None:
            scope.add_to(sets, name, Entry(block, instance, _labels(numbers, block, "member")))
            return
        for _, _, words in block.words():
            whole = np.array([float(word) for word in words if word.isdecimal()])
            scope.add_to(sets, name, Entry(block, instance, _labels(whole, block, "member")))
            for word in words:
                if word and not word.isdecimal():
                    scope.add_to(sets, name, Entry(block, instance, word.strip('"')))


def _filled(block: Block) -> np.ndarray:
    rows = block.rows(3, 2)
    return np.where(np.isnan(rows), 1.0, rows).ravel()


def _labels(values: np.ndarray, block: Block, what: str) -> np.ndarray:
    wrong = values[~((values > 0.0) & (values < 2.0**53) & (values == np.rint(values)))]
    if wrong.size:
        shown = "nothing" if np.isnan(wrong[0]) else f"{wrong[0]:g}"
        raise InputError(f"{block.where}: {shown} is not the label of a {what}: a whole number from 1 on")
    return values.astype(np.int64)
