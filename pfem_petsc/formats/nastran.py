"""Nastran bulk data (.bdf, .nas, .dat): rods, their sections, materials, supports, forces and subcases, by pyNastran.

CROD, CONROD and CTUBE are bars; CBAR and CBEAM are read as bars, with a warning unless both of their ends are hinges.
Properties are sections and groups of bars. Supports, forces, gravity and nodal masses are those of the first subcases
that name them; the subcases of a linear static solution with loads of their own are load cases. Cards that are not read
are told with their numbers.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..mesh.whole import WholeMesh
from ._common import alike, free_name

SUFFIXES = (".bdf", ".nas", ".dat")

Told = Callable[[object, str], None]
"""Adds a warning about the file if a condition holds."""

_BARS = ("CROD", "CONROD", "CTUBE", "CBAR", "CBEAM")
_PROPERTIES = ("PROD", "PTUBE", "PBAR", "PBARL", "PBEAM", "PBEAML")
_COORDINATES = ("CORD1R", "CORD1C", "CORD1S", "CORD2R", "CORD2C", "CORD2S")
_READ = (
    *("GRID", "GRDSET", "MAT1", "SPC", "SPC1", "SPCADD", "FORCE", "FORCE1", "FORCE2", "GRAV", "LOAD", "CONM2", "EIGRL"),
    *("EIGR", "NLPARM", "PARAM", "BAROR", "BEAMOR", "ENDDATA"),
    *(*_BARS, *_PROPERTIES, *_COORDINATES),
)
_PARAMETERS = ("AUTOSPC", "WTMASS", "LGDISP", "POST", "PRTMAXIM", "GRDPNT", "K6ROT")
"""Those that are read, or change nothing for bars with large displacements."""


def read(path: Path, fields: Collection[str] | None = None) -> WholeMesh:
    """Return the bars of a deck as a mesh with tables of a case.

    Raises
    ------
    InputError
        If pyNastran is not installed or cannot read the deck, or it has no bars.
    """
    deck = _deck(path)
    bars = [element for _, element in sorted(deck.elements.items())]
    if not bars:
        raise InputError(f"{path}: has no {', '.join(_BARS)}, which would be bars{_cards(deck, ': it has ')}")
    pairs = [bar.node_ids[:2] for bar in bars]
    if (largest := max(map(max, pairs))) > sys.maxsize:
        raise InputError(f"{path}: GRID {largest}, at which a bar ends: a GRID has at most 8 digits in Nastran")
    ends = np.array(pairs, np.int64)
    labels = np.unique(ends)
    for label in [label for label in labels.tolist() if label not in deck.nodes][:1]:
        raise InputError(f"{path}: there is no GRID {label}, at which a bar ends")
    points = np.array([deck.nodes[label].get_position() for label in labels.tolist()])
    mesh = WholeMesh(points, np.searchsorted(labels, ends))

    def told(condition: object, text: str) -> None:
        mesh.tell(condition, f"{path}: {text}")

    left, cards = len(deck.nodes) - len(labels), _cards(deck, "left out cards that are not read: ")
    told(left, f"left out {left} GRID where no bar ends")
    told(cards, cards)
    _add_sections(path, mesh, deck, bars, told)
    # a run takes mesh and groups alone
    _Conditions(mesh, deck, labels, told if fields is None else lambda *_: None).add()
    return mesh


def _deck(path: Path) -> Any:
    """Return the cards of a file and of those that it includes; coordinates are those of the basic system."""
    try:
        from cpylog import SimpleLogger
        from pyNastran.bdf.bdf import BDF
    except ImportError as error:
        raise InputError(
            f"{path}: Nastran bulk data is read by pyNastran, which is not installed: pip install pyNastran ({error})"
        ) from None
    deck = BDF(log=SimpleLogger("error", log_func=lambda *_: None))
    deck.enable_cards(_READ)
    content = path.read_bytes()
    bulk_only = not re.search(rb"^\s*(CEND|BEGIN\s+BULK)", content, re.MULTILINE | re.IGNORECASE)
    source = _source(path, content)
    apart = ("elements", "properties", "masses", "materials", "loads", "constraints", "aero", "sets", "optimization")
    try:
        # it prints, and writes a file into the current folder, when an included file is missing
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            deck.read_bdf(**source, xref=False, punch=bulk_only)
            deck.cross_reference(**{f"xref_{what}": False for what in apart})
    except RecursionError:
        raise InputError(
            f"{path}: coordinate systems ({', '.join(_COORDINATES)}) define each other in a circle"
        ) from None
    except Exception as error:  # noqa: BLE001 - damaged cards raise anything
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise InputError(f"{path}: pyNastran cannot read it: {reason}") from None
    return deck


def _source(path: Path, content: bytes) -> dict[str, Any]:
    """Return what pyNastran reads, and the encoding: Latin-1, common in comments, of a deck that is not UTF-8."""
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # it opens no file in another encoding than that of the system, and a text has no folder
        prefix = rf"\1{path.absolute().parent.as_posix()}/"
        text = re.sub(r"(?im)^(INCLUDE\s+['\"]?)(?![/\\%$'\"\s]|\w+:)", prefix, content.decode("latin1"))
        return {"bdf_filename": io.StringIO(text), "encoding": "latin1"}
    return {"bdf_filename": str(path.absolute()), "encoding": "utf-8-sig"}


def _cards(deck: Any, text: str) -> str:
    """Return the cards that are not read, with their numbers, after a text; nothing without any."""
    counts = {**deck.card_count, **deck.reject_count}
    other = [f"{n} {name}" for name, n in sorted(counts.items()) if name not in _READ]
    other += [f"PARAM {name}" for name in sorted(deck.params) if name not in _PARAMETERS]
    return text + ", ".join(other) if other else ""


# ---- sections and materials


def _add_sections(path: Path, mesh: WholeMesh, deck: Any, bars: list[Any], told: Told) -> None:
    """Add sections and materials, groups of bars by property, and the field ``area``."""
    members: dict[tuple[Any, ...], list[int]] = {}
    counts: Counter[str] = Counter()
    for i, bar in enumerate(bars):
        key = (bar.A, bar.mid) if bar.type == "CONROD" else (bar.pid,)
        members.setdefault((bar.type == "CONROD", *key), []).append(i)
        if bar.type in ("CBAR", "CBEAM"):
            pins = [set(str(pin)) for pin in (bar.pa, bar.pb)]
            counts[f"{bar.type}, without bending stiffness"] += any(not {"5", "6"} <= pin for pin in pins)
            counts[f"{bar.type} between their GRID, without offsets"] += any(map(np.any, (bar.wa, bar.wb)))
    for what, n in counts.items():
        told(n, f"{n} {what}, are read as bars".replace(",,", ","))
    area, without, mass, massless, damped, bare = np.full(len(bars), np.nan), 0, 0, set(), set(), set()
    sections, materials = (mesh.tables.setdefault(name, {}) for name in ("section", "material"))
    weight = _mass_scale(deck)
    for (of_rod, *_), numbers in members.items():
        bar = bars[numbers[0]]
        source = bar if of_rod else deck.properties.get(bar.pid)
        if source is None:
            without += len(numbers)
            continue
        group = free_name(sections, "conrod" if of_rod else f"{source.type.lower()}_{source.pid}")
        mesh.bar_groups[group] = np.array(numbers)
        if not (size := float(source.Area())) >= 0.0:
            card = f"CONROD {bar.eid}" if of_rod else f"{source.type} {source.pid}"
            raise InputError(f"{path}: {card} has the area {size:g}: expected a positive one")
        bare |= set() if size else {group}
        area[numbers] = size or np.nan
        tube = source.type == "PTUBE"
        told(
            tube and source.OD2 not in (None, source.OD1),
            f"PTUBE {source.pid} has two diameters: its area is their mean",
        )
        shape = {"shape": "tube", "thickness": source.t} if tube and 0.0 < source.t < 0.5 * source.OD1 else {}
        own = {"area": size} if size else {}
        sections[group] = {"bars": group, **own, **shape, "material": f"mat1_{source.mid}"}
        mass += len(numbers) * bool(np.any(source.nsm))
        material = deck.materials.get(source.mid)
        values = {"young_modulus": "e", "density": "rho", "thermal_expansion": "a"}
        found = {key: float(getattr(material, name, None) or 0.0) for key, name in values.items()}
        found["density"] *= weight
        damped |= {source.mid} if getattr(material, "ge", None) else set()
        massless |= {source.mid} if material is not None and not found["density"] else set()
        materials[f"mat1_{source.mid}"] = {key: value for key, value in found.items() if value}
    told(damped, f"left out the damping GE of MAT1 {sorted(damped)}")
    told(massless, f"MAT1 {sorted(massless)} have no density, which is 0 in Nastran: a case needs a positive one")
    told(bare, f"{', '.join(sorted(bare))} have the area 0: a case needs a positive one")
    told(without, f"{without} bars have a property that is not read or not there: they have no section")
    told(mass, f"left out the nonstructural mass of {mass} bars")
    mesh.bar_fields |= {"area": area} if (area > 0.0).all() else {}


def _mass_scale(deck: Any) -> float:
    """Return PARAM WTMASS, by which densities and masses are multiplied."""
    return float(deck.params["WTMASS"].values[0]) if "WTMASS" in deck.params else 1.0


# ---- supports, loads, masses, analysis


class _Conditions:
    """Supports, loads, masses and the analysis of a deck as tables; ``labels`` (n,) are the GRID of the nodes."""

    def __init__(self, mesh: WholeMesh, deck: Any, labels: np.ndarray, told: Told) -> None:
        self._mesh, self._deck, self._told = mesh, deck, told
        self._labels = labels.tolist()
        self._at = {label: i for i, label in enumerate(self._labels)}
        control = deck.case_control_deck
        self._subcases = {} if deck.punch or control is None else dict(control.subcases)
        above = self._subcases[0].params if 0 in self._subcases else {}
        mesh.title = ": ".join(str(above[word][0]) for word in ("TITLE", "SUBTITLE") if word in above)

    def add(self) -> None:
        """Add the tables to the mesh."""
        if self._deck.sol in (153, 159) or self._deck.app == "HEAT":
            self._told(True, "left out supports, loads and the analysis: they are those of heat transfer")
            return
        tables = {"support": self._supports(), "mass": self._masses(), **self._loads(), "analysis": self._analysis()}
        self._mesh.tables |= {name: table for name, table in tables.items() if table}

    def _chosen(self, key: str, sets: Collection[int]) -> dict[int, str]:
        """Return the different sets that subcases choose by a key, with the name of the first subcase of each.

        Of bulk data alone, it is the first set, or the one that combines others.
        """
        found: dict[int, str] = {}
        for number, subcase in sorted(self._subcases.items()):
            value = subcase.params.get(key, [None])[0]
            # what stands before all subcases is taken by each of them
            if value in sets and value not in found and (number or len(self._subcases) == 1):
                words = [subcase.params[word][0] for word in ("LABEL", "SUBTITLE") if word in subcase.params]
                name = re.sub(r"[^\w.-]+", "_", str(*words[:1])).strip("_.")[:40]
                found[value] = name if name and name not in found.values() else f"subcase_{number}"
        return found if self._subcases else {value: "" for value in list(sets)[:1]}

    def _vector(self, system: int, values: np.ndarray, what: str) -> np.ndarray:
        """Return a vector of a rectangular coordinate system in the basic one; NaN for others."""
        found = self._deck.coords[system]
        if system and not found.type.endswith("R"):
            self._told(True, f"{what} in the coordinate system {system}, which is not rectangular, is left out")
            return np.full(3, np.nan)
        return found.transform_vector_to_global(np.asarray(values, float)) if system else np.asarray(values, float)

    def _tables(self, values: np.ndarray, wanted: Callable[[list[float]], str]) -> Iterator[tuple[list[float], str]]:
        """Yield the different rows of values with the group of their nodes; one node has its GRID as name."""
        labels = self._labels
        return alike(
            self._mesh.node_groups, values, lambda row, own: wanted(row) if len(own) > 1 else f"node_{labels[own[0]]}"
        )

    def _supports(self) -> dict[str, dict[str, Any]]:
        deck, n = self._deck, len(self._labels)
        held, moved = np.zeros((n, 3), bool), np.zeros((n, 3))
        chosen = self._chosen("SPC", [*deck.spcadds, *deck.spcs])
        sets = [number for card in deck.spcadds.get(next(iter(chosen), 0), []) for number in card.sets] or [*chosen][:1]
        unused = sorted(set(deck.spcs) - set(sets))
        self._told(unused, f"left out the SPC sets {unused}: the case has {', '.join(map(str, sets)) or 'none'}")
        lines = [(label, str(node.ps or ""), 0.0) for label, node in deck.nodes.items() if label in self._at]
        for card in (card for number in sets for card in deck.spcs.get(number, [])):
            one = card.type == "SPC1"
            lines += zip(
                card.node_ids, *((repeat(card.components), repeat(0.0)) if one else (card.components, card.enforced))
            )
        absent = sorted({label for label, *_ in lines} - self._deck.nodes.keys())
        some = ", ".join(map(str, absent[:5])) + (", ..." if len(absent) > 5 else "")
        self._told(absent, f"left out the supports of {len(absent)} GRID that do not exist: {some}")
        for label, components, value in lines:
            i, axes = self._at.get(label, -1), ["123".index(c) for c in str(components) if c in "123"]
            every = len(axes) == 3
            for axis in axes if i >= 0 else ():  # of other nodes, and rotations, which bars do not have
                system, across = int(deck.nodes[label].cd), np.eye(3)[axis]
                if system and (value or not every):
                    across = self._vector(system, across, f"the support of GRID {label}")
                own = axis if every else int(abs(across).argmax())
                if every or abs(across[own]) > 1.0 - 1e-9:
                    held[i, own] = True
                    moved[i] += value * np.nan_to_num(across)
                else:
                    what = f"the support of GRID {label} along {axis + 1} of {system}"
                    self._told(np.isfinite(across).all(), f"{what} is left out: not an axis")
        switch = deck.params["AUTOSPC"].values[0] if "AUTOSPC" in deck.params else "YES"
        for axis in np.flatnonzero(np.ptp(self._mesh.points, axis=0) == 0.0) if switch == "YES" else ():
            free = int((~held[:, axis]).sum())
            self._told(free, f"the case holds {free} nodes of a flat truss along {'xyz'[axis]}, as AUTOSPC does")
            held[:, axis] = True
        return {
            name: {"node_set": name, "fix": _axes(row)}
            | ({"motion": [[0.0] * 4, [1.0, *row[3:]]], "interpolation": "linear"} if any(row[3:]) else {})
            for row, name in self._tables(np.hstack([held, moved]), lambda row: f"fixed_{_axes(row)}")
        }

    def _masses(self) -> dict[str, dict[str, Any]]:
        values, cards = np.zeros((len(self._labels), 1)), self._deck.masses.values()
        for card in [card for card in cards if card.nid in self._at]:
            values[self._at[card.nid]] += card.mass * _mass_scale(self._deck)
        others = sum(card.nid not in self._at for card in cards)
        self._told(others, f"left out {others} CONM2 where no bar ends")
        return {name: {"node_set": name, "value": value} for (value,), name in self._tables(values, lambda _: "mass")}

    def _loads(self) -> dict[str, dict[str, Any]]:
        """Return loads and gravity, or load cases if subcases of a linear static solution have different loads."""
        deck = self._deck
        chosen = self._chosen("LOAD", [*deck.load_combinations, *deck.loads]) if deck.sol != 103 else {}
        found, used = {}, set()
        for number, name in chosen.items() if deck.sol in (101, 1) else list(chosen.items())[:1]:
            parts = [
                (one, card.scale * scale)
                for card in deck.load_combinations.get(number, [])
                for scale, one in zip(card.scale_factors, card.load_ids)
            ] or [(number, 1.0)]
            used |= {one for one, _ in parts}
            found[name] = self._load_tables(parts)
        unused, taken = sorted(set(deck.loads) - used), ", ".join(map(str, sorted(used))) or "none"
        self._told(unused, f"left out the load sets {unused}: the case has {taken}")
        if len(found) == 1:
            return next(iter(found.values()))
        cases = {name: {"load": list(own["load"].values()), **own["gravity"]} for name, own in found.items()}
        cases = {name: {key: value for key, value in keys.items() if value} for name, keys in cases.items()}
        return {"load_case": {name: keys for name, keys in cases.items() if keys}}

    def _load_tables(self, parts: list[tuple[int, float]]) -> dict[str, dict[str, Any]]:
        forces, gravity, others = np.zeros((len(self._labels), 3)), np.zeros(3), 0
        for card, factor in [(card, factor) for number, factor in parts for card in self._deck.loads.get(number, [])]:
            if card.type == "GRAV":
                gravity += factor * card.scale * np.nan_to_num(self._vector(card.cid, card.N, "GRAV"))
                continue
            i = self._at.get(card.node, -1)
            others += i < 0
            if card.type == "FORCE":
                vector = card.mag * self._vector(card.cid, card.xyz, f"FORCE at GRID {card.node}")
            else:  # along the line of two nodes, or across the plane of two lines
                first = ("g1", "g2") if card.type == "FORCE1" else ("g1", "g2", "g3", "g4")
                place = [self._deck.nodes[getattr(card, key)].get_position() for key in first]
                across = [b - a for a, b in zip(place[::2], place[1::2])]
                vector = across[0] if len(across) == 1 else np.cross(*across)
                vector = card.mag * vector / np.linalg.norm(vector)
            if i >= 0:
                forces[i] += np.nan_to_num(factor * vector)
        self._told(others, f"left out {others} forces where no bar ends")
        loads = {name: {"node_set": name, "force": force} for force, name in self._tables(forces, lambda _: "loaded")}
        return {"load": loads, "gravity": {"gravity": {"acceleration": gravity.tolist()}} if gravity.any() else {}}

    def _analysis(self) -> dict[str, dict[str, Any]]:
        deck, small = self._deck, "is linear: the case has large displacements, as all cases do"
        match deck.sol:
            case None:
                return {}
            case 1 | 101 | 106 as sol:
                self._told(sol != 106, f"SOL {sol} {small}")
                increments = [deck.nlparms[number].ninc for number in self._chosen("NLPARM", deck.nlparms)][:1]
                return {"static": {"step": 1.0 / ((increments or [10])[0] or 10) if sol == 106 else 1.0}}
            case 103 | 105 as sol:
                method = next(iter(self._chosen("METHOD", deck.methods)), 0)
                count = getattr(deck.methods.get(method), "nd", None)
                self._told(not count, "a limit of the eigenvalues is not supported: modes.count = 10")
                kind = {"kind": "vibration"} if sol == 103 else {"kind": "buckling", "linear": True}
                return {"modes": {"count": int(count or 10), **kind}}
            case sol:
                self._told(True, f"SOL {sol} is left out: the case has no analysis; known are 101, 103, 105 and 106")
                return {}


def _axes(row: list[float]) -> str:
    return "".join(axis for axis, held in zip("xyz", row) if held)
