"""Abaqus input files (.inp): trusses with sets, sections, materials, supports and loads, flat or in parts.

T3D2 and T2D2 are bars; other trusses and beams are read as bars with a warning, other elements are left out with
one. Node sets and element sets are groups. Sections give the bar field ``area``; sections and materials are tables of
a case, as are fixed nodes, nodal forces and gravity up to the end of the first step, and its analysis. Included files
are read. Keywords that generate nodes and elements are rejected.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ..whole import WholeMesh
from ._inp_blocks import Block, blocks
from ._inp_conditions import CONDITION_KEYWORDS, add_conditions
from ._inp_flat import Flat
from ._inp_model import Model, Scope
from ._inp_steps import Steps
from ._inp_tables import MATERIAL_KEYWORDS, Materials, section_of

__all__ = ["MADE", "SUFFIXES", "read"]

SUFFIXES = (".inp",)

_REFUSED = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "PARAMETER", "SUBSTRUCTURE GENERATE")
MADE = "_section_"
"""Beginning of the names of element sets that the writer makes for areas."""
_CONSTRAINTS = ("TIE", "EQUATION", "MPC", "COUPLING", "RIGID BODY", "EMBEDDED ELEMENT", "MULTIPLE POINT CONSTRAINT")
_MODEL = ("NODE", "ELEMENT", "NSET", "ELSET")
"""Keywords of the model that steps may have; those of steps are not read."""
_SECTIONS = ("SOLID SECTION", "BEAM SECTION", "BEAM GENERAL SECTION")


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in an Abaqus input file, with the field ``area`` if all bars have a section.

    Raises
    ------
    InputError
        Naming file and line, for any content that is not a mesh of bars.
    """
    model, materials = Model(), Materials()
    steps = Steps()
    constraints, conditions = _collect(path, model, materials, steps)
    flat = Flat(path, model)
    mesh = WholeMesh(flat.points, flat.bars, flat.groups("NSET"), dict(flat.groups("ELSET")))
    mesh.warnings = flat.warnings + materials.warnings
    if constraints:
        told = "nodes that they connect are joined by `mesh clean` if they are at the same place"
        mesh.warnings.append(f"{path}: left out {', '.join(constraints)}; {told}")
    found = materials.tables()
    mesh.tables = {"material": found} if found else {}
    _add_sections(mesh, flat, materials)
    add_conditions(mesh, flat, conditions)
    if fields is None:  # of no interest to a run, which takes mesh and groups alone
        steps.finish(mesh, path)
    if flat.labels_left_out:
        first = ", ".join(str(label) for label in flat.labels_left_out[:5])
        more = ", ..." if len(flat.labels_left_out) > 5 else ""
        mesh.warnings.append(
            f"{path}: left out {len(flat.labels_left_out)} nodes where no bar ends (labels {first}{more})"
        )
    return mesh


def _collect(path: Path, model: Model, materials: Materials, steps: Steps) -> tuple[list[str], list[Block]]:
    """Read all keywords up to the end of the first step, and of steps only conditions and procedures.

    Returns
    -------
    The keywords of constraints, which are left out, and the conditions.
    """
    constraints: dict[str, None] = {}
    conditions: list[Block] = []
    in_step = ended = False
    scope = model.root
    outer = scope
    for block in blocks(path):
        keyword = block.keyword
        ended = ended or keyword == "END STEP"
        in_step = in_step or keyword == "STEP"
        if keyword in CONDITION_KEYWORDS and not ended:
            conditions.append(block)
        elif in_step and (ended or keyword not in _MODEL):
            steps.add(block, first=not ended)
        if in_step:
            continue
        if keyword in _REFUSED:
            raise InputError(
                f"{block.where} is not read: write the nodes and elements one by one (Abaqus/CAE and most "
                "preprocessors do)"
            )
        if keyword in ("PART", "ASSEMBLY", "INSTANCE"):
            outer, scope = (scope if keyword == "INSTANCE" else model.root), _entered(block, model)
        elif keyword in ("END PART", "END ASSEMBLY", "END INSTANCE"):
            scope = outer if keyword == "END INSTANCE" else model.root
        elif keyword == "NODE":
            model.add_nodes(scope, block)
        elif keyword == "ELEMENT":
            model.add_elements(scope, block)
        elif keyword in ("NSET", "ELSET"):
            model.add_set(scope, block, keyword)
        elif keyword in _SECTIONS:
            scope.sections.append((block, block.required("ELSET")))
        elif keyword in ("MATERIAL", *MATERIAL_KEYWORDS):
            materials.add(block)
        elif keyword in _CONSTRAINTS:
            constraints[f"*{keyword}"] = None
        elif keyword not in CONDITION_KEYWORDS:
            steps.add(block, first=True)
    return list(constraints), conditions


def _entered(block: Block, model: Model) -> Scope:
    if block.keyword == "ASSEMBLY":
        return model.assembly
    name = block.required("NAME")
    scope = Scope(name)
    if block.keyword == "PART":
        if name.upper() in model.parts:
            raise InputError(f"{block.where}: there are two parts of the name {name}")
        model.parts[name.upper()] = scope
    else:
        model.instances.append((scope, block.required("PART"), _placed(block), block))
    return scope


def _placed(block: Block) -> np.ndarray:
    """The place of an instance: (4, 3), a rotation applied to rows from the right, then a translation.

    The first data line has the translation, the second two points of an axis and an angle [degrees] about it, which
    turns the instance after the translation.
    """
    rows = np.nan_to_num(block.rows(7, 3))
    move = rows[0, :3] if len(rows) else np.zeros(3)
    if len(rows) < 2:
        return np.vstack([np.eye(3), move])
    start, end, angle = rows[1, :3], rows[1, 3:6], np.radians(rows[1, 6])
    axis = end - start
    length = np.linalg.norm(axis)
    if not length > 0.0:
        raise InputError(f"{block.where}: the axis of the rotation has no length")
    x, y, z = axis / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)  # Rodrigues
    return np.vstack([turn.T, (move - start) @ turn.T + start])


def _add_sections(mesh: WholeMesh, flat: Flat, materials: Materials) -> None:
    """Add the tables of the sections, and the areas of bars as a field."""
    areas = np.full(len(mesh.bars), np.nan)
    sections: dict[str, dict[str, Any]] = {}
    for block, group, members in flat.sections():
        if len(members) == 0:
            continue
        found = section_of(block)
        if not found.get("area", 0.0) > 0.0:
            what = f"SECTION={block.get('SECTION')}" if block.get("SECTION") else "the data line"
            mesh.warnings.append(f"{block.where}: no area is known from {what}")
        areas[members] = found.get("area", np.nan)
        material = block.get("MATERIAL")
        sections[group] = {"bars": group, **found, **({"material": materials.name_of(material)} if material else {})}
    if sections:
        mesh.tables["section"] = _without_made(mesh, flat, sections, (areas > 0.0).all())
    if len(areas) and (areas > 0.0).all():
        mesh.bar_fields["area"] = areas
    elif sections and np.isnan(areas).any():
        mesh.warnings.append(f"{flat.path}: {int(np.isnan(areas).sum())} bars have no area: there is no field area")


def _without_made(
    mesh: WholeMesh, flat: Flat, sections: dict[str, dict[str, Any]], whole: bool
) -> dict[str, dict[str, Any]]:
    """Return one section with the areas of the field in the place of those whose sets the writer has made for areas.

    The sets are no groups then.
    """
    made = {name for name in sections if name.startswith(MADE) and flat.is_internal(name)}
    materials = {sections[name].get("material") for name in made}
    if not made or not whole or len(materials) > 1:
        return sections
    for name in made:
        mesh.bar_groups.pop(name, None)
    material = materials.pop()
    kept = {name: keys for name, keys in sections.items() if name not in made}
    return kept | {"bars": {"area_field": "area", **({"material": material} if material else {})}}
