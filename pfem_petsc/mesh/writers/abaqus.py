"""Abaqus input files (.inp): T3D2 elements, sets, a section for each area, and known materials.

Labels are the numbers from 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..readers.abaqus import MADE
from ..whole import WholeMesh

__all__ = ["SUFFIXES", "write"]

SUFFIXES = (".inp",)

_IN_A_LINE = 16


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, to the last digit."""
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        for line in _lines(mesh):
            file.write(line + "\n")


def _lines(mesh: WholeMesh) -> Iterator[str]:
    yield "*HEADING"
    yield f"{len(mesh.points)} nodes, {len(mesh.bars)} bars, in SI units"
    yield "*NODE"
    yield from (f"{i}, {x!r}, {y!r}, {z!r}" for i, (x, y, z) in enumerate(mesh.points.tolist(), 1))
    yield "*ELEMENT, TYPE=T3D2"
    yield from (f"{i}, {a}, {b}" for i, (a, b) in enumerate((mesh.bars + 1).tolist(), 1))
    node_names, bar_names = _names(mesh.node_groups), _names(mesh.bar_groups)
    for keyword, groups, names in (("NSET", mesh.node_groups, node_names), ("ELSET", mesh.bar_groups, bar_names)):
        for group, members in groups.items():
            yield from _set(f"*{keyword}, {keyword}={names[group]}", members)
    yield from _sections(mesh, bar_names)
    for name, keys in mesh.tables.get("material", {}).items():
        yield from _material(name, keys)


def _set(head: str, members: np.ndarray) -> Iterator[str]:
    labels = (np.asarray(members) + 1).tolist()
    if len(labels) > 1 and labels[-1] - labels[0] == len(labels) - 1:
        yield from (f"{head}, GENERATE", f"{labels[0]}, {labels[-1]}, 1")
        return
    yield head
    for k in range(0, len(labels), _IN_A_LINE):
        yield ", ".join(map(str, labels[k : k + _IN_A_LINE])) + ("," if k + _IN_A_LINE < len(labels) else "")


def _sections(mesh: WholeMesh, names: dict[str, str]) -> Iterator[str]:
    """Return a section for all bars of the same area and material."""
    n = len(mesh.bars)
    areas = mesh.bar_fields.get("area", np.full(n, np.nan)).copy()
    material = np.full(n, -1)
    materials: list[str] = []
    tables = mesh.tables.get("section", {})
    # those without a group are for all bars that no other one names
    for keys in sorted(tables.values(), key=lambda keys: "bars" in keys):
        members = mesh.bar_groups.get(keys["bars"], np.empty(0, np.int64)) if "bars" in keys else np.arange(n)
        if "area" in keys and "area" not in mesh.bar_fields:
            areas[members] = keys["area"]
        name = keys.get("material")
        if name:
            materials += [] if name in materials else [name]
            material[members] = materials.index(name)
    pairs, which = np.unique(np.column_stack([np.nan_to_num(areas, nan=-1.0), material]), axis=0, return_inverse=True)
    which = which.ravel()
    order = np.argsort(which, kind="stable")
    starts = np.searchsorted(which[order], np.arange(len(pairs) + 1))
    taken = {text.strip('"').upper() for text in names.values()}
    free = (text for k in count(1) if (text := f"{MADE}{k}").upper() not in taken)
    exact = {mesh.bar_groups[name].tobytes(): text for name, text in names.items()}
    for number, (area, m) in enumerate(pairs.tolist()):
        if not area > 0.0:
            continue
        members = order[starts[number] : starts[number + 1]]
        text = exact.get(members.tobytes())
        if text is None:
            text = next(free)
            yield from _set(f"*ELSET, ELSET={text}, INTERNAL", members)
        of = f", MATERIAL={_quoted(materials[int(m)])}" if m >= 0 else ""
        yield from (f"*SOLID SECTION, ELSET={text}{of}", f"{area!r},")


def _material(name: str, keys: dict[str, Any]) -> Iterator[str]:
    yield f"*MATERIAL, NAME={_quoted(name)}"
    density, young = keys.get("density"), keys.get("young_modulus")
    if density is not None:
        yield from ("*DENSITY", f"{density!r},")
    if young is not None:
        yield from ("*ELASTIC", f"{young!r}, 0.0")
    if keys.get("thermal_expansion"):
        yield from ("*EXPANSION", f"{keys['thermal_expansion']!r},")
    damping = f", ALPHA={keys['damping'] / density!r}" if density and keys.get("damping") else ""
    damping += f", BETA={keys['stiffness_damping']!r}" if keys.get("stiffness_damping") else ""
    if damping:
        yield f"*DAMPING{damping}"
    first = keys.get("yield_stress")
    isotropic, kinematic = keys.get("isotropic_hardening") or 0.0, keys.get("kinematic_hardening") or 0.0
    if "curve" in keys and young:
        yield "*PLASTIC"
        yield from (f"{stress!r}, {max(strain - stress / young, 0.0)!r}" for strain, stress in keys["curve"])
    elif first is not None and keys.get("law", "elastoplastic") == "elastoplastic" and not (isotropic and kinematic):
        yield "*PLASTIC, HARDENING=KINEMATIC" if kinematic else "*PLASTIC"
        yield f"{first!r}, 0.0"
        if isotropic or kinematic:
            yield f"{first + isotropic + kinematic!r}, 1.0"


def _names(groups: dict[str, np.ndarray]) -> dict[str, str]:
    """Return names that differ in capitals too, quoted where need be."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in groups:
        own = name
        while own.upper() in taken:
            own += "_"
        taken.add(own.upper())
        found[name] = _quoted(own)
    return found


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z_][\w.-]*", name) else '"' + name.replace('"', "'") + '"'
