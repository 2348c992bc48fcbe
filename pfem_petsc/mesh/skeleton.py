"""A case file for a mesh file: groups, sections and materials filled in, the rest to be replaced."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..case.toml import table_text
from .whole import WholeMesh, case_tables

__all__ = ["skeleton", "tables_of"]

_STEEL = {"young_modulus": 210e9, "density": 7850.0}
_AREA = 1e-4
_PROBED = 100
"""Number of nodes up to which a node set with a load has a probe."""
_CONDITIONS = ("support", "load", "gravity")


def tables_of(mesh: WholeMesh) -> tuple[dict[str, Any], list[str]]:
    """Return the tables of a case, and the keys of sections and materials that the mesh does not have.

    Keys that it does not have get the values of steel and an area of 1 cm2.
    """
    made: list[str] = []
    materials = {name: dict(keys) for name, keys in mesh.tables.get("material", {}).items()}
    sections = {name: dict(keys) for name, keys in mesh.tables.get("section", {}).items()}
    named = [keys["material"] for keys in sections.values() if keys.get("material")]
    for name in named or ([] if materials else ["steel"]):
        materials.setdefault(name, {})
    first = next(iter(materials))
    for name, keys in materials.items():
        for key, value in _STEEL.items():
            if key not in keys:
                keys[key] = value
                made.append(f"material.{name}.{key}")
    covered = np.zeros(len(mesh.bars), bool)
    for keys in sections.values():
        covered[mesh.bar_groups.get(keys["bars"], []) if "bars" in keys else slice(None)] = True
    if not covered.all():
        sections["others" if sections else "bars"] = {}
    for name, keys in sections.items():
        if "area" not in keys and "area_field" not in keys:
            if "area" in mesh.bar_fields:
                keys["area_field"] = "area"
            else:
                keys["area"] = _AREA
                made.append(f"section.{name}.area")
        if "material" not in keys:
            keys["material"] = first
            if len(materials) > 1:
                made.append(f"section.{name}.material")
    node_sets = {name: {"group": name} for name, members in mesh.node_groups.items() if len(members)}
    conditions = {name: table for name, table in case_tables(mesh.tables).items() if name in _CONDITIONS}
    return {"node_set": node_sets, "material": materials, "section": sections, **conditions}, made


def _probes(mesh: WholeMesh) -> list[dict[str, str]]:
    """Return probes for the node sets with loads, but for large ones: each node has columns of the history."""
    loaded = [name for name in mesh.tables.get("load", {}) if len(mesh.node_groups[name]) <= _PROBED]
    return [{"name": name, "node_set": name} for name in loaded]


def skeleton(mesh: WholeMesh, file: Path, case: Path) -> str:
    """Return the text of a case file at ``case`` for a mesh file, which can be checked and run."""
    tables, made = tables_of(mesh)
    relative = os.path.relpath(file.absolute(), case.absolute().parent)
    known = [name for name in _CONDITIONS if name in tables]
    analysis = mesh.tables.get("analysis", {})
    if not known:
        made.append("supports and loads" if analysis else "supports, loads, and the analysis")
    elif not analysis:
        made.append("the analysis, which is an explicit one of a millisecond")
    told = (
        "Replace what is not known from it:"
        if made
        else "Supports, loads and the analysis are those of the first step."
    )
    lines = [f"# A case for {file.name}. {told}\n", *(f"#   {key}\n" for key in made), "\n"]
    data = {
        "title": file.stem,
        "mesh": {"file": relative},
        **{name: table for name, table in tables.items() if table},
        **({} if known else {"gravity": {"acceleration": [0.0, 0.0, -9.81]}}),
        **(analysis or {"time": {"integrator": "central_differences", "step": "auto", "end": 1e-3}}),
    }
    probes = _probes(mesh) if "static" in data or "time" in data else []
    if probes:
        data["output"] = {"probe": probes}
    text = table_text(data)
    if "support" in tables:
        return "".join(lines) + text
    groups = list(tables["node_set"])
    held = groups[0] if groups else "NAME"
    example = f'\n# [[support]]\n# node_set = "{held}"\n# fix = "xyz"\n'
    if not groups:
        example = "\n# [node_set.NAME]                 # or box, nearest, indices\n# all = true\n" + example
    return "".join(lines) + text + example
