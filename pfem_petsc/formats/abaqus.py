"""Abaqus and CalculiX input files (.inp): trusses with sets, sections, materials and conditions, flat or in parts.

T3D2 and T2D2 are bars; other trusses and beams are read as bars with a warning, other elements are left out with
one. Node sets and element sets are groups. Sections give the bar field ``area``; sections and materials are tables of
a case, as are supports, forces, gravity, temperatures, initial conditions, and masses, springs and dashpots of nodes,
up to the end of the first step, and its analysis. Included files are read. Keywords that generate nodes and elements
are rejected, and what is not read is told. Written files have T3D2 elements, sets, a section for each area, and known
materials; labels are the numbers from 1.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..mesh.whole import PLANE, WholeMesh
from ._abaqus_model import AtNodes, Block, Deck, blocks, listed
from ._common import alike, free_name, name_of, number_of

SUFFIXES = (".inp",)

_MADE = "_section_"
"""Beginning of the names of element sets that the writer makes for areas."""

_Rows = tuple[tuple[float, float], ...]
"""Times, or load factors, and values."""


class _RemarkError(Exception):
    """What is to be said about a keyword or a line, which is left out in most cases."""


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
    _add_materials(mesh, deck)
    _add_sections(mesh, deck)
    told = [*mesh.warnings]
    _add_initial_stress(mesh, deck)
    _Conditions(mesh, deck).add()
    if fields is None:
        mesh.warnings += deck.left_out()
        _add_analysis(mesh, deck)
    else:  # a run takes mesh and groups alone
        mesh.warnings = told
    lost = deck.labels_left_out
    labels = ", ".join(map(str, lost[:5])) + (", ..." if len(lost) > 5 else "")
    mesh.tell(lost, f"{path}: left out {len(lost)} nodes where no bar ends (labels {labels})")
    return mesh


def _value(words: list[str], at: int) -> float:
    """Return a number, 0 for one that is missing, NaN for another text."""
    return number_of(words[at]) if at < len(words) and words[at] else 0.0


def _short(value: float) -> float:
    """Return a number as people write it."""
    return float(f"{value:.12g}")


# ---- materials

_PROPERTIES = {"ELASTIC": ("young_modulus", 2), "DENSITY": ("density", 1), "EXPANSION": ("thermal_expansion", 1)}
"""Keys of keywords with one value, and the column of the temperature."""


def _add_materials(mesh: WholeMesh, deck: Deck) -> None:
    """Add the table of materials to a mesh."""
    for name, own in deck.materials.values():
        values: dict[str, Any] = {}
        for block in own:
            try:
                _read_property(block, values)
            except _RemarkError as remark:
                mesh.warnings.append(f"{block.where}: {remark}")
        if values.get("cable") and len(values.get("plastic", ((), (0.0,)))[1]) > 1:
            text = "*PLASTIC with hardening is left out: bars without compression have none"
            mesh.warnings.append(f"{own[-1].where}: {text}")
            del values["plastic"]
        mesh.tables.setdefault("material", {})[name] = _material_keys(values)


def _read_property(block: Block, material: dict[str, Any]) -> None:
    """Add what a keyword says of a material to its values; a remark is raised."""
    match block.keyword:
        case "DAMPING":
            for name, key in (("ALPHA", "alpha"), ("BETA", "stiffness_damping")):
                value = number_of(block.get(name)) if name in block.parameters else material.get(key, 0.0)
                material[key] = 0.0 if np.isnan(value) else value
                if np.isnan(value):
                    raise _RemarkError(f"{block.get(name)!r} is not a number: left out")
        case "NO TENSION":
            raise _RemarkError("left out: there is no law of bars that carry compression alone")
        case "NO COMPRESSION":
            material["cable"] = True
        case keyword:
            kind = block.get("TYPE", "ISOTROPIC")
            if kind.upper() not in ("ISOTROPIC", "ISO"):
                raise _RemarkError(f"TYPE={kind}: left out")
            key, column = _PROPERTIES.get(keyword, ("plastic", 2))
            rows = block.rows(8, 1)
            if len(rows) == 0 or not np.isfinite(rows[0, 0]):
                raise _RemarkError("no values: left out")
            negative = keyword in ("ELASTIC", "DENSITY") and rows[0, 0] <= 0.0
            if negative:
                raise _RemarkError(f"{rows[0, 0]:g} is not positive: left out")
            first = rows[:, column]
            cold = np.isnan(first) | (first == first[0]) if key == "plastic" else np.arange(len(rows)) == 0
            material[key] = _hardening(block, rows[cold, :2]) if key == "plastic" else float(rows[0, 0])
            told = f"values at {first[0]:g} degrees are taken for all temperatures"
            if not cold.all():
                raise _RemarkError(told)


def _hardening(block: Block, rows: np.ndarray) -> tuple[str, np.ndarray, np.ndarray]:
    """Return the kind of hardening, and stresses and plastic strains, from rows (n, 2)."""
    kind = block.get("HARDENING", "ISOTROPIC").upper()
    stress, strain = np.nan_to_num(rows).T
    known = kind == "ISOTROPIC" or (kind == "KINEMATIC" and len(stress) <= 2)
    falls = (np.diff(strain) <= 0.0).any() or (np.diff(stress) < 0.0).any()
    if not known:
        raise _RemarkError(f"HARDENING={kind}: left out")
    if "RATE" in block.parameters:
        raise _RemarkError("RATE: left out")
    told = "a curve that does not start at plastic strain 0, or that falls: left out"
    if strain[0] != 0.0 or stress[0] <= 0.0 or falls:
        raise _RemarkError(told)
    return kind, stress, strain


def _material_keys(values: dict[str, Any]) -> dict[str, Any]:
    """A material's keys; rows of stress over plastic strain are a curve over strain, constant after the last row."""
    keys = {key: values[key] for key in ("young_modulus", "density", "thermal_expansion") if key in values}
    keys["damping"] = values.get("alpha", 0.0) * values.get("density", 0.0)
    keys["stiffness_damping"] = values.get("stiffness_damping", 0.0)
    keys = {key: value for key, value in keys.items() if value or "damping" not in key}
    keys |= {"law": "cable"} if values.get("cable") else {}
    hardening, stress, strain = values.get("plastic", ("", [], []))
    if len(stress) == 1 or hardening == "KINEMATIC":
        keys["yield_stress"] = float(stress[0])
    if len(stress) > 1 and hardening == "KINEMATIC":
        keys["kinematic_hardening"] = float((stress[1] - stress[0]) / strain[1])
    elif len(stress) > 1 and "young_modulus" in keys:
        curve = np.stack([stress / keys["young_modulus"] + strain, stress], axis=1)
        keys |= {"law": "multilinear", "curve": curve.tolist()}
    return keys


# ---- sections


def _add_sections(mesh: WholeMesh, deck: Deck) -> None:
    """Add the table of sections, and the areas of bars as a field."""
    areas = np.full(len(mesh.bars), np.nan)
    sections: dict[str, dict[str, Any]] = {}
    without: list[str] = []
    for block, group, members in deck.section_members():
        if len(members) == 0:
            without.append(block.get("ELSET"))
            continue
        rows = block.rows(16, 1)
        found = _section_keys(block, rows, deck.calculix)
        if not found.get("area", 0.0) > 0.0:
            what = f"SECTION={block.get('SECTION')}" if block.get("SECTION") else "the data line"
            mesh.tell(True, f"{block.where}: no area is known from {what}")
            found.pop("area", None)
        either = deck.ambiguous and found.get("shape") == "round"
        read_as = "CIRC is read with a radius, as in Abaqus: in a file of CalculiX it is a diameter"
        mesh.tell(either, f"{block.where}: {read_as}")
        areas[members] = found.get("area", np.nan)
        material = block.get("MATERIAL")
        if material:
            found["material"] = deck.materials.get(material.upper(), (material, []))[0]
            mesh.tell(
                "DENSITY" in block.parameters, f"{block.where}: DENSITY is left out: that of the material is taken"
            )
        elif block.keyword in ("BEAM GENERAL SECTION", "FRAME SECTION"):
            found |= _own_material(mesh, block, rows, group)
        sections[group] = {"bars": group, **found}
    mesh.tell(without, f"{deck.path}: left out the sections of {listed(without)}: none of their elements is a bar")
    unknown = int(np.isnan(areas).sum())
    whole = len(areas) > 0 and (areas > 0.0).all()
    if sections:
        mesh.tables["section"] = _without_made(mesh, deck, sections) if whole else sections
        mesh.tell(unknown, f"{deck.path}: {unknown} bars have no area: there is no field area")
    mesh.bar_fields |= {"area": areas} if whole else {}


def _without_made(mesh: WholeMesh, deck: Deck, sections: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return one section with the areas of the field in the place of those whose sets the writer has made for
    areas, which are no groups then."""
    own = deck.scopes[""].sets["ELSET"]
    internal = {name for name in sections if name.upper() not in own or own[name.upper()].internal}
    made = [name for name in sections if name.startswith(_MADE) and name in internal]
    materials = {sections[name].get("material") for name in made}
    if len(materials) != 1:
        return sections
    mesh.bar_groups = {name: members for name, members in mesh.bar_groups.items() if name not in made}
    others = {name: keys for name, keys in sections.items() if name not in made}
    material = materials.pop()
    return others | {"bars": {"area_field": "area", **({"material": material} if material else {})}}


def _section_keys(block: Block, rows: np.ndarray, calculix: bool) -> dict[str, Any]:
    """Return ``area``, and ``shape`` and ``thickness`` of round bars and tubes, as far as a section tells them.

    Parameters
    ----------
    rows : (n, 16) its data
    calculix : circles have diameters, as those of two values, and not a radius
    """
    a, b, c, d, e, f, g = (rows[0] if len(rows) else np.full(16, np.nan))[:7].tolist()
    if block.keyword == "SOLID SECTION":
        return {"area": a if np.isfinite(a) else 1.0}
    kind = block.get("SECTION", "" if block.keyword == "BEAM SECTION" else "GENERAL").upper()
    kind = next((name for name in ("RECT", "CIRC", "PIPE") if name in kind), kind)  # RECTANGULAR, THICK PIPE
    second = b if np.isfinite(b) else a
    area = {
        "GENERAL": a,
        "RECT": a * second,
        "CIRC": math.pi * (a * second / 4.0 if calculix or np.isfinite(b) else a * a),
        "PIPE": math.pi * (2.0 * a - b) * b,
        "BOX": a * b - (a - c - e) * (b - d - f),
        "HEX": 6.0 * a * b - 2.0 * math.sqrt(3.0) * b * b,
        "TRAPEZOID": (a + c) / 2.0 * b,
        "L": a * c + (b - c) * d,
        "I": b * g + float(np.nansum([c * e - e * g, d * f - f * g])),  # a T has one flange
    }.get(kind, np.nan)
    if kind == "ARBITRARY" and np.isfinite(a):
        corners = np.vstack([rows[0, 1:3], rows[0, 3:5], rows[1 : int(a), :2]])
        area = float(np.linalg.norm(np.diff(corners, axis=0), axis=1) @ np.append(f, rows[1 : int(a), 2]))
    if not np.isfinite(area):
        return {}
    shapes = {"CIRC": {"shape": "round"} if a == second else {}, "PIPE": {"shape": "tube", "thickness": b}}
    return {"area": float(f"{area:.15g}"), **shapes.get(kind, {})}


def _own_material(mesh: WholeMesh, block: Block, rows: np.ndarray, group: str) -> dict[str, Any]:
    """Add the material that a section has itself, and return the key that names it.

    After the shape come, if it is given, a direction across the bar, and E, G, and the thermal expansion.
    """
    rows = rows[int(np.nan_to_num(rows[0, 0])) if len(rows) and block.get("SECTION").upper() == "ARBITRARY" else 1 :]
    several = np.isfinite(rows[:1, 3:]).any()
    if len(rows) and not several and (len(rows) > 1 or np.linalg.norm(rows[0, :3]) <= 1.0 + 1e-6):
        rows = rows[1:]
    values = {
        "young_modulus": float(rows[0, 0]) if len(rows) else np.nan,
        "density": number_of(block.get("DENSITY")),
        "thermal_expansion": float(rows[0, 2]) if len(rows) else np.nan,
    }
    keys = {key: value for key, value in values.items() if 0.0 < value < np.inf}
    mesh.tell(len(rows) > 1, f"{block.where}: values at the first temperature are taken for all temperatures")
    if not keys:
        return {}
    materials = mesh.tables.setdefault("material", {})
    name = next((name for name, own in materials.items() if own == keys), free_name(materials, group))
    materials[name] = keys
    return {"material": name}


def _add_initial_stress(mesh: WholeMesh, deck: Deck) -> None:
    """Give sections the initial stresses of their bars, as parts of their own where these differ."""
    stress, points = np.zeros((2, len(mesh.bars)))
    across = mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]]
    for members, values in _initial_values(mesh, deck, "STRESS", "expected elements and their stress"):
        if len(values) == 7:  # of CalculiX: an integration point, and components along the axes of the model
            _, xx, yy, zz, xy, xz, yz = values
            tensor, along = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), across[members]
            with np.errstate(invalid="ignore"):  # of bars without length, which a case refuses
                share = np.einsum("ij,jk,ik->i", along, tensor, along) / (along**2).sum(axis=1)
            stress[members] += np.nan_to_num(share)
            points[members] += 1.0
        else:
            stress[members], points[members] = values[0], 1.0
    if not stress.any():
        return
    stress = np.array([_short(value) for value in stress / np.maximum(points, 1.0)])
    sections = mesh.tables.setdefault("section", {})
    rest = np.ones(len(mesh.bars), bool)
    for keys in sections.values():
        rest[mesh.bar_groups.get(keys.get("bars", ""), [])] = False
    if rest.any() and all("bars" in keys for keys in sections.values()):
        sections["others"] = {}
    for name, keys in list(sections.items()):
        members = mesh.bar_groups.get(keys["bars"], np.empty(0, int)) if "bars" in keys else np.flatnonzero(rest)
        values = np.unique(stress[members]).tolist()
        if len(values) == 1 and values[0] != 0.0:
            keys["prestress"] = values[0]
        for k, value in enumerate(values if len(values) > 1 else [], 1):
            group = name_of(mesh.bar_groups, members[stress[members] == value], f"{name}_{k}")
            sections.pop(name, None)
            sections[group] = {**keys, "bars": group, **({"prestress": value} if value else {})}


_AXES = (1.0, 2.0, 3.0)


def _initial_values(
    mesh: WholeMesh, deck: Deck, kind: str, expected: str, axes: tuple[float, ...] | None = None
) -> Iterator[tuple[np.ndarray, list[float]]]:
    """Yield the members and the values of each line of the initial conditions of a type; others are told.

    ``axes`` are those that the first value may be, where it is one.
    """
    for block in deck.initial:
        for where, words in block.lines() if block.get("TYPE").upper() == kind else ():
            count_of = {"STRESS": max(len(words) - 1, 1), "TEMPERATURE": 1, "VELOCITY": 2}
            values = [_value(words, at) for at in range(1, 1 + count_of[kind])]
            if np.isfinite(values).all() and (axes is None or values[0] in axes):
                yield deck.members_of("ELSET" if kind == "STRESS" else "NSET", block, words[0]), values
            else:
                mesh.tell(True, f"{where}: {', '.join(words)[:60]!r} is left out: {expected}")


# ---- supports, loads, temperatures, and what belongs to nodes

_FIXED = {"PINNED": "xyz", "ENCASTRE": "xyz", "XSYMM": "x", "YSYMM": "y", "ZSYMM": "z"}
_FIXED |= {"XASYMM": "yz", "YASYMM": "xz", "ZASYMM": "xy"}
_AT_REST: tuple[str, _Rows] = ("", ())


_TABULAR = {"DEFINITION": "TABULAR", "VALUE": "RELATIVE"}


class _Conditions:
    """Supports, forces, gravity, temperatures, initial velocities, masses, springs and dashpots as tables of a case;
    those of single nodes make groups.

    What varies over time has rows over the load factor if the step is static.
    """

    def __init__(self, mesh: WholeMesh, deck: Deck) -> None:
        self._mesh, self._deck = mesh, deck
        self._in_step, self._over = False, ()
        self._names = {name.upper(): name for name in mesh.node_groups}
        step = deck.procedure
        self._static = step is not None and step.keyword in ("STATIC", "BUCKLE")
        self._dynamic = step is not None and step.keyword == "DYNAMIC"
        words = next((words for _, words in step.lines()), []) if step is not None else []
        period = _value(words, 1)
        self._period = period if 0.0 < period < np.inf else 1.0
        self._supports: dict[tuple[str, int, tuple[str, _Rows]], np.ndarray] = {}
        self._motions: dict[tuple[str, _Rows], int] = {}
        self._held = np.zeros((len(mesh.points), 3), np.int64)
        """Number of the motion of each component from 1 on; 0: free."""
        self._forces: dict[tuple[str, _Rows], np.ndarray] = {}
        self._gravity: dict[tuple[tuple[float, ...], _Rows], tuple[str, np.ndarray]] = {}
        """By vectors and their factors: the first line, and how often each bar has it."""
        self._temperatures: list[tuple[np.ndarray, float, _Rows]] = []

    def add(self) -> None:
        """Add the tables to the mesh, and warnings."""
        kinds = {"DLOAD": self._weigh, "CLOAD": self._push, "BOUNDARY": self._hold, "TEMPERATURE": self._heat}
        of_step = [block for block, in_step in self._deck.conditions if in_step and block.keyword == "BOUNDARY"]
        new = next((block for block in of_step if block.get("OP").upper() == "NEW"), None)
        for block, in_step in self._deck.conditions:
            if block is new:
                self._supports.clear()
                self._held[:] = 0
            self._in_step, self._over = in_step, self._rows(block)
            told: defaultdict[str, list[str]] = defaultdict(list)
            for where, words in block.lines():
                self._line = f"{where}: {', '.join(words)[:60]!r}"
                try:
                    kinds[block.keyword](block, words)
                except _RemarkError as remark:
                    told[str(remark)].append(self._line)
            for reason, lines in told.items():
                more = f" (and {len(lines) - 1} more lines)" if len(lines) > 1 else ""
                self._mesh.tell(True, f"{lines[0]}{more} is {reason}")
        tables = {
            "support": self._support_tables() | self._plane_tables(),
            "load": self._load_tables(),
            "gravity": self._gravity_tables(),
            "temperature": self._temperature_tables(),
            "initial": self._velocity_tables(),
            **self._tables_of_nodes(),
        }
        self._mesh.tables |= {name: table for name, table in tables.items() if table}
        for each in self._deck.initial:
            other = each.get("TYPE").upper() not in ("STRESS", "TEMPERATURE", "VELOCITY")
            self._mesh.tell(other, f"{each.where}, TYPE={each.get('TYPE')} is left out: it is not read")

    # ---- over time

    def _rows(self, block: Block) -> _Rows:
        """Return factors over the time of a dynamic step, or over the load factor; none: as without a table."""
        if block.get("AMPLITUDE"):
            return self._amplitude(block)
        usual, step = "RAMP" if self._static else "STEP", self._deck.step
        if step is None or step.get("AMPLITUDE", usual).upper() == usual:
            return ()
        return ((0.0, 1.0), (1.0, 1.0)) if self._static else ((0.0, 0.0), (self._period, 1.0))

    def _amplitude(self, block: Block) -> _Rows:
        name = block.get("AMPLITUDE")
        found = self._deck.amplitudes.get(name.upper())
        pairs = found.numbers() if found is not None else None
        if found is None:
            told = "there is none of this name"
        elif any(found.get(key, usual).upper() != usual for key, usual in _TABULAR.items()):
            told = "only tables of factors are read"
        elif pairs is None or len(pairs) % 2 or not np.isfinite(pairs).all() or not (np.diff(pairs[::2]) > 0.0).all():
            told = "expected pairs of times, which increase, and factors"
        else:
            scale = self._period if self._static else 1.0
            rows = [(_short(time / scale), factor) for time, factor in pairs.reshape(-1, 2).tolist()]
            return tuple(rows if len(rows) != 1 else [rows[0], (rows[0][0] + 1.0, rows[0][1])])
        text = f"{block.where}: AMPLITUDE={name} is left out: {told}"
        self._mesh.tell(text not in self._mesh.warnings, text)
        return ()

    def _factors(self, rows: _Rows, times: np.ndarray) -> np.ndarray:
        """Return factors at times."""
        rows = rows or ((0.0, 0.0 if self._static else 1.0), (1.0, 1.0))
        return np.interp(times, *np.array(rows).T)

    def _times(self, every: list[_Rows]) -> np.ndarray:
        """Return all times of rows, ascending."""
        return np.unique([time for rows in every for time, _ in rows or ((0.0, 0.0), (1.0, 1.0))])

    # ---- lines

    def _weigh(self, block: Block, words: list[str]) -> None:
        told = "left out: only GRAV is read of distributed loads"
        if len(words) < 2 or words[1].upper() != "GRAV":
            raise _RemarkError(told)
        values = np.array([_value(words, at) for at in range(2, 6)])
        if not np.isfinite(values).all():
            raise _RemarkError("left out: expected numbers")
        key = tuple((values[0] * values[1:]).tolist()), self._over
        _, times = self._gravity.setdefault(key, (self._line, np.zeros(len(self._mesh.bars), np.int64)))
        times[self._deck.members_of("ELSET", block, words[0]) if words[0] else slice(None)] += 1

    def _push(self, block: Block, words: list[str]) -> None:
        axis, value = _value(words, 1), _value(words, 2)
        along = axis in _AXES and np.isfinite(value)
        if not along:
            raise _RemarkError("left out: only forces along x, y and z are read")
        name, _ = self._group(block, words[0])
        self._forces.setdefault((name, self._over), np.zeros(3))[int(axis) - 1] += value

    def _hold(self, block: Block, words: list[str]) -> None:
        axes, value = _FIXED.get(words[1].upper() if len(words) > 1 else "", ""), 0.0
        if not axes:
            first, last, value = (_value(words, at) for at in (1, 2, 3))
            last = last or first
            known = 1.0 <= first <= last <= 6.0 and np.isfinite(value)
            if not known:
                raise _RemarkError("left out: expected degrees of freedom from 1 to 6, and a number")
            axes = "xyz"[int(first) - 1 : int(last)]  # bars have no rotations
        name, members = self._group(block, words[0])
        motion, told = self._motion(block, value) if axes and value else (_AT_REST, "")
        number = self._motions.setdefault(motion, len(self._motions) + 1)
        for axis in map("xyz".index, axes):
            self._supports[name, axis, motion] = members
            self._held[members, axis] = number
        if told:
            raise _RemarkError(told)

    def _motion(self, block: Block, value: float) -> tuple[tuple[str, _Rows], str]:
        """Return a motion, as the key of a support and its rows, and what is to be said about one that is not there."""
        kind, rows = block.get("TYPE", "DISPLACEMENT").upper(), self._over
        if not self._in_step or not (self._static or self._dynamic):
            told = "no *STATIC or *DYNAMIC step moves it"
        elif "FIXED" in block.parameters:
            return _AT_REST, ""
        elif kind == "DISPLACEMENT" and (rows or self._static):
            return ("motion", _times_value(rows or ((0.0, 0.0), (1.0, 1.0)), value)), ""
        elif kind == "DISPLACEMENT":
            told = "at once in a dynamic step, without AMPLITUDE"
        elif kind == "VELOCITY" and not rows and self._dynamic:
            return ("velocity", ((0.0, value),)), ""
        elif kind == "ACCELERATION" and self._dynamic:
            return ("acceleration", _times_value(rows or ((0.0, 1.0), (self._period, 1.0)), value)), ""
        else:
            told = f"TYPE={kind} is not read {'in a static step' if self._static else 'with AMPLITUDE'}"
        return _AT_REST, f"held where it is: {told}"

    def _heat(self, block: Block, words: list[str]) -> None:
        value, told = _value(words, 1), "left out: expected nodes and a temperature"
        if not np.isfinite(value) or len(words) < 2:
            raise _RemarkError(told)
        told = "left out: temperatures act in *STATIC and *DYNAMIC steps"
        if not (self._static or self._dynamic):
            raise _RemarkError(told)
        self._temperatures.append((self._deck.members_of("NSET", block, words[0]), value, self._over))

    def _group(self, block: Block, target: str) -> tuple[str, np.ndarray]:
        """Return the name of the node group with the nodes of a set, or of the node of a label, and its members."""
        members, groups = self._deck.members_of("NSET", block, target), self._mesh.node_groups
        if len(members) == 0:
            raise _RemarkError("left out: it names no node where a bar ends")
        wanted = target.replace('"', "").replace("/", "_")
        last = wanted.rpartition(".")[2]
        new = f"node_{wanted}" if last.isdecimal() else wanted
        known = [*(self._names.get(upper, "") for upper in (wanted.upper(), last.upper())), new]
        return name_of(groups, members, new, known), members

    # ---- tables

    def _support_tables(self) -> dict[str, dict[str, Any]]:
        found: dict[tuple[str, str, tuple[float, ...]], dict[int, list[float]]] = {}
        for (name, axis, motion), members in self._supports.items():
            left = members[self._held[members, axis] == self._motions[motion]]
            if len(left):  # of which later lines have given no other motion
                name = name if len(left) == len(members) else name_of(self._mesh.node_groups, left, name)
                times = tuple(time for time, _ in motion[1])
                found.setdefault((name, motion[0], times), {})[axis] = [value for _, value in motion[1]]
        tables: dict[str, dict[str, Any]] = {}
        for (name, kind, times), axes in found.items():
            keys: dict[str, Any] = {"node_set": name, "fix": "".join("xyz"[axis] for axis in sorted(axes))}
            columns = [axes.get(axis, [0.0] * len(times)) for axis in range(3)]
            rows = [list(row) for row in zip(times, *columns)]
            keys |= {kind: rows[0][1:] if kind == "velocity" else rows} if kind else {}
            keys |= {"interpolation": "linear"} if kind == "motion" else {}
            tables[free_name(tables, name)] = keys
        return tables

    def _plane_tables(self) -> dict[str, dict[str, Any]]:
        """Return a support of the nodes at which only plane elements end, along z, the direction that these do not
        have."""
        plane, bars = self._deck.plane, self._mesh.bars
        members = np.setdiff1d(bars[plane], bars[~plane])
        free = members[self._held[members, 2] == 0]
        self._held[free, 2] = 1
        if len(free) == 0:
            return {}
        bent = ", which is not the same for all" if np.ptp(self._mesh.points[members, 2]) else ""
        self._mesh.tell(True, f"{self._deck.path}: the case holds {len(free)} nodes of plane elements along z{bent}")
        return {PLANE: {"node_set": name_of(self._mesh.node_groups, free, "plane"), "fix": "z"}}

    def _load_tables(self) -> dict[str, dict[str, Any]]:
        tables: dict[str, dict[str, Any]] = {}
        for (name, rows), force in self._forces.items():
            table = {"table": [list(row) for row in rows]} if rows else {}
            tables[free_name(tables, name)] = {"node_set": name, "force": force.tolist(), **table}
        return tables

    def _gravity_tables(self) -> dict[str, dict[str, Any]]:
        every: list[tuple[np.ndarray, _Rows]] = []
        for (vector, rows), (line, times) in self._gravity.items():
            every.append((times.min() * np.array(vector), rows))
            self._mesh.tell(times.max() > times.min(), f"{line} is left out: the gravity of a case acts on all bars")
        total = sum((vector for vector, _ in every), np.zeros(3))
        if not any(rows for _, rows in every):
            return {"gravity": {"acceleration": total.tolist()}} if total.any() else {}
        times = self._times([rows for _, rows in every])
        over = sum(np.outer(self._factors(rows, times), vector) for vector, rows in every)
        return {"gravity": {"acceleration": np.column_stack([times, over]).tolist()}}

    def _temperature_tables(self) -> dict[str, dict[str, Any]]:
        """Return the temperatures of bars, the means of those of their nodes, above the initial ones."""
        mesh = self._mesh
        initial = np.zeros(len(mesh.points))
        for members, (value,) in _initial_values(mesh, self._deck, "TEMPERATURE", "expected nodes and a temperature"):
            initial[members] = value
        times = self._times([rows for _, _, rows in self._temperatures])
        above = np.zeros((len(initial), len(times)))
        for members, value, rows in self._temperatures:
            factors, start = self._factors(rows, times), initial[members][:, None]
            above[members] = factors * value - start if rows else factors * (value - start)
        tables: dict[str, dict[str, Any]] = {}
        if len(times):
            for values, group in alike(mesh.bar_groups, above[mesh.bars].mean(axis=1), "temperature"):
                same = len(set(values)) == 1 and not self._static
                rows = [list(row) for row in zip(times.tolist(), map(_short, values))]
                own = {"value": _short(values[0])} if same else {"table": rows}
                tables[free_name(tables, group)] = {"bars": group, **own}
        return tables

    def _velocity_tables(self) -> dict[str, dict[str, Any]]:
        velocity = np.zeros((len(self._mesh.points), 3))
        axes, expected = _AXES, "expected nodes, 1, 2 or 3, and a number"
        if not self._dynamic:
            axes, expected = (), "it has no effect without *DYNAMIC"
        for members, (axis, value) in _initial_values(self._mesh, self._deck, "VELOCITY", expected, axes):
            velocity[members, int(axis) - 1] = value
        groups = self._mesh.node_groups
        return {name: {"node_set": name, "velocity": row} for row, name in alike(groups, velocity, "velocity")}

    # ---- masses, springs, dashpots

    def _tables_of_nodes(self) -> dict[str, dict[str, dict[str, Any]]]:
        groups, n = self._mesh.node_groups, len(self._mesh.points)
        values = {"MASS": np.zeros((n, 1)), "SPRING": np.zeros((n, 3)), "DASHPOT": np.zeros((n, 3))}
        tables: dict[str, dict[str, dict[str, Any]]] = {"mass": {}, "spring": {}, "dashpot": {}}
        known: set[int] = set()
        for block, elements in self._deck.of_nodes():
            known |= {id(element) for element, _ in elements}
            told: Counter[str] = Counter()
            for element in elements:
                try:
                    self._add_of_nodes(block, *element, values, tables)
                except _RemarkError as remark:
                    told[str(remark)] += 1
            for why, number in told.items():
                self._mesh.tell(why, f"{block.where}: left out {number} elements: {why}")
        every = {id(element) for scope in self._deck.scopes.values() for element in scope.at_nodes}
        bare, path = len(every - known), self._deck.path
        what = "masses, springs or dashpots without *MASS, *SPRING or *DASHPOT"
        self._mesh.tell(bare, f"{path}: left out {bare} {what}")
        # a dashpot of a case acts in all directions: those in which a node is held do not matter
        damped = values["DASHPOT"]
        most = damped.max(axis=1, keepdims=True)
        uneven = ((damped != most) & (self._held == 0)).any(axis=1)
        nodes = f"the dashpots of {int(uneven.sum())} nodes: those of a case act equally in all directions"
        self._mesh.tell(uneven.any(), f"{path}: left out {nodes}")
        values["DASHPOT"] = np.where(uneven[:, None], 0.0, most)
        for (kind, own), key in zip(tables.items(), ("value", "stiffness", "coefficient")):
            for row, name in alike(groups, values[kind.upper()], kind):
                own[free_name(own, name)] = {"node_set": name, key: row if kind == "spring" else row[0]}
        return tables

    def _add_of_nodes(
        self,
        block: Block,
        element: AtNodes,
        nodes: list[int],
        values: dict[str, np.ndarray],
        tables: dict[str, dict[str, dict[str, Any]]],
    ) -> None:
        """Add an element that belongs to nodes to the values of nodes or to the tables; a remark says why not."""
        odd = [name for name in ("NONLINEAR", "ORIENTATION") if name in block.parameters]
        odd += [f"TYPE={kind}" for kind in [block.get("TYPE", "ISO")] if kind.upper() not in ("ISOTROPIC", "ISO")]
        lines = [words for _, words in block.lines()]
        directed = element.kind[-1] in "12"
        axes = [_value(lines[0], at) for at in range(len(nodes))] if directed and lines else []
        # degrees of freedom do not matter along a line
        free = not directed and len(lines) > 1 and lines[0][0] in ("1", "2", "3", "0")
        data = lines[int(directed or free) :]
        value = _value(data[0], 0) if data else np.nan
        if odd:
            raise _RemarkError(f"{', '.join(odd[:1])} is not read")
        if not 0.0 < value < np.inf:
            raise _RemarkError("expected a positive number")
        if min(nodes) < 0:
            raise _RemarkError("no bar ends at their nodes")
        beyond = any(axis not in _AXES for axis in axes)
        if beyond:
            raise _RemarkError("bars have the degrees of freedom 1, 2 and 3 alone")
        if len(nodes) == 1:
            values[block.keyword][nodes[0], int(axes[0]) - 1 if axes else 0] += value
            return
        line = self._mesh.points[nodes[1]] - self._mesh.points[nodes[0]]
        along = not axes or (axes[0] == axes[1] and np.count_nonzero(line) == 1 and line[int(axes[0]) - 1])
        if not along:
            raise _RemarkError("those of a case act along the line between their nodes")
        labels = [f"node_{instance}.{label}" if instance else f"node_{label}" for instance, label in element.nodes]
        groups, own = self._mesh.node_groups, tables[block.keyword.lower()]
        names = [name_of(groups, np.array([node]), label) for node, label in zip(nodes, labels)]
        key = {"SPRING": "stiffness", "DASHPOT": "coefficient"}[block.keyword]
        own[free_name(own, " to ".join(names))] = {"between": names, key: value}


def _times_value(rows: _Rows, value: float) -> _Rows:
    return tuple((time, factor * value) for time, factor in rows)


# ---- the analysis of the first step


def _add_analysis(mesh: WholeMesh, deck: Deck) -> None:
    """Add the table ``analysis`` to a mesh, and warnings about what is left out."""
    if deck.procedure is None:
        return
    tables, told = _analysis(deck.procedure)
    mesh.tables |= {"analysis": tables} if tables else {}
    mesh.tell(told, f"{deck.procedure.where}: {told}")
    small = deck.step is not None and deck.step.get("NLGEOM", "NO").upper() == "NO"
    large = "EXPLICIT" in deck.procedure.parameters or "modes" in tables
    if small and not large and tables.keys() & {"static", "time"}:
        mesh.tell(True, f"{deck.step.where} has no NLGEOM: the case has large displacements, as all cases do")


def _analysis(block: Block) -> tuple[dict[str, dict[str, Any]], str]:
    """Return the tables of a case for a procedure, and what is to be said; none for one that the program lacks."""
    words = next((words for _, words in block.lines()), [])
    first, period, least, most, end = (value if 0.0 < (value := _value(words, k)) < np.inf else 0.0 for k in range(5))
    match block.keyword:
        case "STATIC":
            return _static(block, first / (period or 1.0), least / (period or 1.0), most / (period or 1.0), end)
        case "DYNAMIC" if not period:
            return {}, "the period is missing: the first step is left out"
        case "DYNAMIC" if "EXPLICIT" in block.parameters:
            step: float | str = _short(first) if first and "DIRECT USER CONTROL" in block.parameters else "auto"
            return {"time": {"integrator": "central_differences", "step": step, "end": period}}, ""
        case "DYNAMIC":
            step = _short(first or period / 100)
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
    keys: dict[str, Any] = {"step": _short(min(first or 1.0, 1.0))}
    if "RIKS" in block.parameters:
        told = "" if end else "end = 1 of the load factor is not in the file: *STATIC, RIKS may end at a displacement"
        return {"static": {"method": "arc_length", **keys, "end": end or 1.0}}, told
    if "DIRECT" not in block.parameters and keys["step"] < 1.0:
        keys["max_step"] = _short(min(most or 1.0, 1.0))
        keys |= {"min_step": _short(least)} if 0.0 < least < first else {}
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
    areas, material = mesh.bar_fields.get("area", np.full(n, np.nan)).copy(), np.full(n, -1)
    # those without a group are for all bars that no other one names
    tables = sorted(mesh.tables.get("section", {}).values(), key=lambda keys: "bars" in keys)
    materials = list(dict.fromkeys(keys["material"] for keys in tables if keys.get("material")))
    for keys in tables:
        members = mesh.bar_groups.get(keys["bars"], np.empty(0, np.int64)) if "bars" in keys else np.arange(n)
        if "area" in keys and "area" not in mesh.bar_fields:
            areas[members] = keys["area"]
        if keys.get("material"):
            material[members] = materials.index(keys["material"])
    pairs, which = np.unique(np.column_stack([np.nan_to_num(areas, nan=-1.0), material]), axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    parts = np.split(order, np.searchsorted(which.ravel()[order], np.arange(1, len(pairs))))
    taken = {text.strip('"').upper() for text in names.values()}
    free = (text for k in count(1) if (text := f"{_MADE}{k}").upper() not in taken)
    exact = {mesh.bar_groups[name].tobytes(): text for name, text in names.items()}
    for (area, m), members in zip(pairs.tolist(), parts):
        text = exact.get(members.tobytes())
        if text is None and area > 0.0:
            text = next(free)
            yield from _set_lines(f"*ELSET, ELSET={text}, INTERNAL", members)
        of = f", MATERIAL={_quoted(materials[int(m)])}" if m >= 0 else ""
        yield from (f"*SOLID SECTION, ELSET={text}{of}", f"{area!r},") if area > 0.0 else ()


def _material_lines(name: str, keys: dict[str, Any]) -> Iterator[str]:
    yield f"*MATERIAL, NAME={_quoted(name)}"
    density, young = keys.get("density"), keys.get("young_modulus")
    for keyword, value, more in (
        ("DENSITY", density, ","),
        ("ELASTIC", young, ", 0.0"),
        ("EXPANSION", keys.get("thermal_expansion") or None, ","),
    ):
        if value is not None:
            yield from (f"*{keyword}", f"{value!r}{more}")
    damping = f", ALPHA={keys['damping'] / density!r}" if density and keys.get("damping") else ""
    damping += f", BETA={keys['stiffness_damping']!r}" if keys.get("stiffness_damping") else ""
    yield from [f"*DAMPING{damping}"] * bool(damping)
    first = keys.get("yield_stress")
    isotropic, kinematic = keys.get("isotropic_hardening") or 0.0, keys.get("kinematic_hardening") or 0.0
    if "curve" in keys and young:
        yield "*PLASTIC"
        yield from (f"{stress!r}, {max(strain - stress / young, 0.0)!r}" for strain, stress in keys["curve"])
    elif first is not None and keys.get("law", "elastoplastic") == "elastoplastic" and not (isotropic and kinematic):
        yield from ("*PLASTIC, HARDENING=KINEMATIC" if kinematic else "*PLASTIC", f"{first!r}, 0.0")
        yield from [f"{first + isotropic + kinematic!r}, 1.0"] * bool(isotropic or kinematic)


def _unique_names(groups: dict[str, np.ndarray]) -> dict[str, str]:
    """Return names that differ in capitals too, quoted where need be."""
    found: dict[str, str] = {}  # by names in capitals
    for name in groups:
        own = name
        while own.upper() in found:
            own += "_"
        found[own.upper()] = _quoted(own)
    return dict(zip(groups, found.values()))


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z_][\w.-]*", name) else '"' + name.replace('"', "'") + '"'
