"""Abaqus and CalculiX input files (.inp): trusses with sets, sections, materials and conditions, flat or in parts.

T3D2 and T2D2 are bars; other trusses and beams are read as bars with a warning, other elements are left out with
one. Node sets and element sets are groups. Sections give the bar field ``area``; sections and materials are tables of
a case, as are supports, forces, gravity, temperatures, initial conditions, and masses, springs and dashpots of nodes,
up to the end of the first step, and its analysis. Included files are read. Keywords that generate nodes and elements
are rejected, and what is not read is told. Written files have T3D2 elements, sets, a section for each area, and known
materials; labels are the numbers from 1.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._abaqus_case import MADE, Conditions, add_initial_stress, add_materials, add_sections, short, value_of
from ._abaqus_model import Block, Deck, blocks

SUFFIXES = (".inp",)


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the mesh in an Abaqus input file, with the field ``area`` if all bars have a section.

    Raises
    ------
    InputError
        Naming file and line, for any content that is not a mesh of bars.
    """
    deck = Deck(path)
    for block in list(blocks(path)):
        if not deck.add(block):
            break
    mesh = deck.mesh()
    if len(mesh.bars) == 0:
        raise InputError(f"{path}: has no trusses or beams, which would be bars")
    add_materials(mesh, deck)
    add_sections(mesh, deck)
    told = add_initial_stress(mesh, deck) + Conditions(mesh, deck).add()
    if fields is None:  # of no interest to a run, which takes mesh and groups alone
        mesh.warnings += [*told, *deck.left_out()]
        _add_analysis(mesh, deck)
    lost = deck.labels_left_out
    if lost:
        text = ", ".join(map(str, lost[:5])) + (", ..." if len(lost) > 5 else "")
        mesh.warnings.append(f"{path}: left out {len(lost)} nodes where no bar ends (labels {text})")
    return mesh


# ---- the analysis of the first step


def _add_analysis(mesh: WholeMesh, deck: Deck) -> None:
    """Add the table ``analysis`` to a mesh, and warnings about what is left out."""
    if deck.procedure is None:
        return
    tables, told = _analysis(deck.procedure)
    if tables:
        mesh.tables["analysis"] = tables
    if told:
        mesh.warnings.append(f"{deck.procedure.where}: {told}")
    step, explicit = deck.step, "EXPLICIT" in deck.procedure.parameters
    small = step is not None and step.get("NLGEOM", "NO").upper() == "NO" and not explicit
    if small and {"static", "time"} & tables.keys() and "modes" not in tables:
        mesh.warnings.append(f"{step.where} has no NLGEOM: the case has large displacements, as all cases do")


def _analysis(block: Block) -> tuple[dict[str, dict[str, Any]], str]:
    """Return the tables of a case for a procedure, and what is to be said; none for one that the program lacks."""
    words = next((words for _, words in block.lines()), [])
    first, period, least, most, end = (value if 0.0 < (value := value_of(words, k)) < np.inf else 0.0 for k in range(5))
    match block.keyword:
        case "STATIC":
            return _static(block, first / (period or 1.0), least / (period or 1.0), most / (period or 1.0), end)
        case "DYNAMIC" if not period:
            return {}, "the period is missing: the first step is left out"
        case "DYNAMIC" if "EXPLICIT" in block.parameters:
            step: float | str = short(first) if first and "DIRECT USER CONTROL" in block.parameters else "auto"
            return {"time": {"integrator": "central_differences", "step": step, "end": period}}, ""
        case "DYNAMIC":
            step = short(first or period / 100)
            told = f"step = {step:g} s is {'the first increment' if first else 'a hundredth of the period'}"
            return {"time": {"integrator": "generalized_alpha", "step": step, "end": period}}, f"{told}, for all steps"
        case "FREQUENCY" | "BUCKLE" as keyword:
            told = "" if first else "a limit of the frequencies is not supported: modes.count = 10"
            # a linear perturbation: buckling factors are those of the loads of the step
            kind = {"kind": "vibration"} if keyword == "FREQUENCY" else {"kind": "buckling", "linear": True}
            return {"modes": {"count": int(first) or 10, **kind}}, told
    return {}, f"the first step is left out: the program has no *{block.keyword}"


def _static(block: Block, first: float, least: float, most: float, end: float) -> tuple[dict[str, dict[str, Any]], str]:
    """Increments over the period are those of the load factor, which goes from 0 to 1."""
    keys: dict[str, Any] = {"step": short(min(first or 1.0, 1.0))}
    if "RIKS" in block.parameters:
        told = "" if end else "end = 1 of the load factor is not in the file: *STATIC, RIKS may end at a displacement"
        return {"static": {"method": "arc_length", **keys, "end": end or 1.0}}, told
    if "DIRECT" not in block.parameters and keys["step"] < 1.0:
        keys["max_step"] = short(min(most or 1.0, 1.0))
        keys |= {"min_step": short(least)} if 0.0 < least < first else {}
    return {
        "static": keys
    }, "STABILIZE is left out; see the key static.stabilise" if "STABILIZE" in block.parameters else ""


# ---- writing

_IN_A_LINE = 16


def write(path: Path, mesh: WholeMesh) -> None:
    """Write the mesh, to the last digit."""
    path.write_text("".join(f"{line}\n" for line in _lines(mesh)), encoding="utf-8", newline="\n")


def _lines(mesh: WholeMesh) -> Iterator[str]:
    yield "*HEADING"
    yield f"{len(mesh.points)} nodes, {len(mesh.bars)} bars, in SI units"
    yield "*NODE"
    yield from (f"{i}, {x!r}, {y!r}, {z!r}" for i, (x, y, z) in enumerate(mesh.points.tolist(), 1))
    yield "*ELEMENT, TYPE=T3D2"
    yield from (f"{i}, {a}, {b}" for i, (a, b) in enumerate((mesh.bars + 1).tolist(), 1))
    node_names, bar_names = _unique_names(mesh.node_groups), _unique_names(mesh.bar_groups)
    for keyword, groups, names in (("NSET", mesh.node_groups, node_names), ("ELSET", mesh.bar_groups, bar_names)):
        for group, members in groups.items():
            yield from _set_lines(f"*{keyword}, {keyword}={names[group]}", members)
    yield from _section_lines(mesh, bar_names)
    for name, keys in mesh.tables.get("material", {}).items():
        yield from _material_lines(name, keys)


def _set_lines(head: str, members: np.ndarray) -> Iterator[str]:
    labels = (np.asarray(members) + 1).tolist()
    if len(labels) > 1 and labels[-1] - labels[0] == len(labels) - 1:
        yield from (f"{head}, GENERATE", f"{labels[0]}, {labels[-1]}, 1")
        return
    yield head
    for k in range(0, len(labels), _IN_A_LINE):
        yield ", ".join(map(str, labels[k : k + _IN_A_LINE])) + ("," if k + _IN_A_LINE < len(labels) else "")


def _section_lines(mesh: WholeMesh, names: dict[str, str]) -> Iterator[str]:
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
            yield from _set_lines(f"*ELSET, ELSET={text}, INTERNAL", members)
        of = f", MATERIAL={_quoted(materials[int(m)])}" if m >= 0 else ""
        yield from (f"*SOLID SECTION, ELSET={text}{of}", f"{area!r},")


def _material_lines(name: str, keys: dict[str, Any]) -> Iterator[str]:
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


def _unique_names(groups: dict[str, np.ndarray]) -> dict[str, str]:
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
