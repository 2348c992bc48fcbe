"""Supports, nodal forces and gravity of Abaqus input files as tables of a case."""

from __future__ import annotations

import numpy as np

from ..whole import WholeMesh
from ._inp_blocks import Block
from ._inp_flat import Flat

__all__ = ["CONDITION_KEYWORDS", "add_conditions"]

CONDITION_KEYWORDS = ("BOUNDARY", "CLOAD", "DLOAD")

_FIXED = {"PINNED": "xyz", "ENCASTRE": "xyz", "XSYMM": "x", "YSYMM": "y", "ZSYMM": "z"}
_FIXED |= {"XASYMM": "yz", "YASYMM": "xz", "ZASYMM": "xy"}


def add_conditions(mesh: WholeMesh, flat: Flat, found: list[Block]) -> None:
    """Add ``support``, ``load`` and ``gravity`` to the tables of a mesh; those of single nodes make groups.

    What is not zero displacement of nodes, a nodal force, or gravity is left out, with a warning.
    """
    fixed: dict[str, str] = {}
    forces: dict[str, list[float]] = {}
    gravity = np.zeros(3)
    for block in found:
        if block.get("AMPLITUDE"):
            told = f"AMPLITUDE={block.get('AMPLITUDE')} is left out: give the table over time in the case"
            mesh.warnings.append(f"{block.where}: {told}")
        for _, line, words in block.words():
            where = f"{block.path}: line {line}: *{block.keyword}"
            if block.keyword == "DLOAD":
                told = _weight(mesh, flat, block, words, gravity)
            elif block.keyword == "CLOAD":
                told = _force(mesh, flat, block, words, forces)
            else:
                told = _support(mesh, flat, block, words, fixed)
            if told:
                mesh.warnings.append(f"{where}: {', '.join(words)[:60]!r} is left out: {told}")
    if fixed:
        mesh.tables["support"] = {
            name: {"node_set": name, "fix": "".join(axis for axis in "xyz" if axis in axes)}
            for name, axes in fixed.items()
        }
    if forces:
        mesh.tables["load"] = {name: {"node_set": name, "force": force} for name, force in forces.items()}
    if gravity.any():
        mesh.tables["gravity"] = {"gravity": {"acceleration": gravity.tolist()}}


def _value(words: list[str], at: int) -> float:
    """Return a number, 0 for one that is missing, NaN for another text."""
    if at >= len(words) or not words[at]:
        return 0.0
    try:
        return float(words[at].upper().replace("D", "E"))
    except ValueError:
        return float("nan")


def _weight(mesh: WholeMesh, flat: Flat, block: Block, words: list[str], gravity: np.ndarray) -> str:
    if len(words) < 2 or words[1].upper() != "GRAV":
        return "only GRAV is read of distributed loads"
    values = np.array([_value(words, at) for at in range(2, 6)])
    if not np.isfinite(values).all():
        return "expected numbers"
    if words[0] and len(flat.members_of("ELSET", block, words[0])) < len(mesh.bars):
        return "the gravity of a case acts on all bars"
    gravity += values[0] * values[1:]
    return ""


def _force(mesh: WholeMesh, flat: Flat, block: Block, words: list[str], forces: dict[str, list[float]]) -> str:
    axis, value = _value(words, 1), _value(words, 2)
    if axis not in (1.0, 2.0, 3.0) or not np.isfinite(value):
        return "only forces along x, y and z are read"
    name = _group(mesh, flat, block, words[0])
    if name:
        forces.setdefault(name, [0.0, 0.0, 0.0])[int(axis) - 1] += value
    return "" if name else "it names no node"


def _support(mesh: WholeMesh, flat: Flat, block: Block, words: list[str], fixed: dict[str, str]) -> str:
    kind = words[1].upper() if len(words) > 1 else ""
    axes = _FIXED.get(kind, "")
    if not axes:
        first = _value(words, 1)
        last = _value(words, 2) or first
        if not (1.0 <= first <= last < 100.0):
            return "expected degrees of freedom"
        if _value(words, 3) != 0.0:
            return "prescribed displacements are those of the case"
        axes = "xyz"[int(first) - 1 : int(last)]
        if not axes:
            return "" if first <= 6.0 else "expected degrees of freedom"  # bars have no rotations
    name = _group(mesh, flat, block, words[0])
    if name:
        fixed[name] = fixed.get(name, "") + axes
    return "" if name else "it names no node"


def _group(mesh: WholeMesh, flat: Flat, block: Block, target: str) -> str:
    """Return the name of the node group with the nodes of a set, or of the node of a label; empty without nodes."""
    members = flat.members_of("NSET", block, target)
    if len(members) == 0:
        return ""
    wanted = target.strip('"').upper().replace("/", "_")
    for name, own in mesh.node_groups.items():
        if name.upper() in (wanted, wanted.rpartition(".")[2]) and np.array_equal(own, members):
            return name
    name = f"node_{target}".replace("/", "_") if len(members) == 1 else target.replace("/", "_")
    while name in mesh.node_groups and not np.array_equal(mesh.node_groups[name], members):
        name += "_"
    mesh.node_groups[name] = members
    return name
