"""A whole mesh on one rank: reading, checks and connectivity."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from ..case.toml import table_text
from ..errors import InputError
from .exchange import Router
from .slab import MeshSlab, check_size, slab_of


@dataclass
class WholeMesh:
    """A mesh that one rank has; numbers from 0."""

    points: np.ndarray
    """(n_nodes, 3) float64 [m]."""
    bars: np.ndarray
    """(n_bars, 2) int64."""
    node_groups: dict[str, np.ndarray] = field(default_factory=dict)
    bar_groups: dict[str, np.ndarray] = field(default_factory=dict)
    bar_fields: dict[str, np.ndarray] = field(default_factory=dict)
    """(n_bars,) float64; the field ``area`` has the areas of cross-sections [m2]."""
    node_fields: dict[str, np.ndarray] = field(default_factory=dict)
    """(n_nodes,) float64."""
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What a file has besides the mesh: ``material``, ``section``, ``support``, ``load``, ``mass``, ``spring``,
    ``dashpot``, ``temperature``, ``initial``, ``gravity`` and ``load_case``, each with the keys of a case by name, and
    ``analysis``: ``static``, ``time`` and ``modes``."""
    title: str = ""
    """Of a case, where the file has one."""
    warnings: list[str] = field(default_factory=list)
    source: str = "mesh"
    """The file, for messages."""

    def tell(self, condition: object, text: str) -> None:
        """Add a warning if a condition holds."""
        self.warnings += [text] if condition else []

    def slab(self, source: str) -> MeshSlab:
        """Return the mesh as the slab of one rank."""
        groups = [
            {name: np.unique(members).astype(np.int64) for name, members in each.items()}
            for each in (self.node_groups, self.bar_groups)
        ]
        found = MeshSlab(len(self.points), len(self.bars), 0, self.points, 0, self.bars, *groups, source=source)
        found.bar_fields, found.node_fields, found.warnings = self.bar_fields, self.node_fields, self.warnings
        return found


_CONDITIONS = ("support", "load", "gravity", "temperature", "initial", "mass", "spring", "dashpot", "load_case")
PLANE = "plane elements"
"""Name of a support that only holds a plane truss in its plane."""


def case_tables(tables: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return tables of a mesh in the form that a case takes: lists, and the node sets that they name."""
    found: dict[str, Any] = {name: table for name, table in tables.items() if name in ("material", "section")}
    for name in _CONDITIONS:
        rows = list(tables.get(name, {}).values())
        if rows:
            cases = [{"name": own, **keys} for own, keys in tables[name].items()]
            found[name] = {"gravity": rows[0], "initial": {"on": rows}, "load_case": cases}.get(name, rows)
        for keys in chain.from_iterable(row.get("load", [row]) for row in rows):
            for own in keys.get("between", [keys[key] for key in ("node_set",) if key in keys]):
                found.setdefault("node_set", {})[own] = {"group": own}
    return found


def without_slashes(named: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return groups or fields with names that HDF5 and trusses can have: an underscore for each slash."""
    found: dict[str, np.ndarray] = {}
    for name, values in named.items():
        own = name.replace("/", "_")
        while own in found or (own != name and own in named):
            own += "_"
        found[own] = values
    return found


def check_fields(path: Path | str, fields: Mapping[str, str] | None, known: Iterable[str]) -> None:
    """Refuse ``fields``, by the keys that ask for them, that are not among the ``known`` fields of a file.

    Raises
    ------
    InputError
    """
    known = sorted(known)
    for name, key in (fields or {}).items():
        if name not in known:
            there = f"; it has {', '.join(known)}" if known else ""
            raise InputError(
                f"{key} = {name!r}: {path} has no field of this name with one number for each bar or node{there}"
            )


def scattered(whole: WholeMesh | None, source: str, comm: MPI.Comm) -> MeshSlab:
    """Send every rank its slab of the mesh that rank 0 has; None on the others. Collective."""
    if whole is None:
        slab = comm.recv(source=0)
    else:
        every = whole.slab(source)
        for rank in range(1, comm.size):
            comm.send(every.share(rank, comm.size), rank)
        slab = every.share(0, comm.size)
    check_size(slab.n_nodes, source)
    return slab


_STEEL = {"young_modulus": 210e9, "density": 7850.0}
_AREA = 1e-4
_AREAS = re.compile(r"(a|area|(cross[ _-]?section(al)?)[ _-]?(area)?)([ _-]?m\^?[2²])?", re.IGNORECASE)
"""Names of fields with areas [m2]."""
_NODE_SET = "\n# [node_set.NAME]                 # or box, nearest, indices\n# all = true\n"
_PROBED = 100
"""Number of nodes up to which a node set with a load has a probe."""


def tables_of(mesh: WholeMesh) -> tuple[dict[str, Any], list[str]]:
    """Return the tables of a case, and the keys of sections and materials that the mesh does not have.

    Keys that it does not have get the values of steel and an area of 1 cm2.
    """
    materials = {name: dict(keys) for name, keys in mesh.tables.get("material", {}).items()}
    sections = {name: dict(keys) for name, keys in mesh.tables.get("section", {}).items()}
    named = [keys["material"] for keys in sections.values() if keys.get("material")]
    for name in named or ([] if materials else ["steel"]):
        materials.setdefault(name, {})
    first = next(iter(materials))
    made = [f"material.{name}.{key}" for name, keys in materials.items() for key in _STEEL if key not in keys]
    materials = {
        name: keys | {key: _STEEL[key] for key in _STEEL if key not in keys} for name, keys in materials.items()
    }
    covered = np.zeros(len(mesh.bars), bool)
    for keys in sections.values():
        covered[mesh.bar_groups.get(keys["bars"], []) if "bars" in keys else slice(None)] = True
    if not covered.all():
        sections["others" if sections else "bars"] = {}
    field = next((name for name in sorted(mesh.bar_fields, key="area".__ne__) if _AREAS.fullmatch(name)), None)
    area = {"area": _AREA} if field is None else {"area_field": field}
    for name, keys in sections.items():
        if not keys.keys() & {"area", "area_field"}:
            keys |= area
            told = f"section.{name}.area" if field is None else f"section.{name}.area_field, by the name of the field"
            made += [told] * (field != "area")
        if "material" not in keys:
            keys["material"] = first
            made += [f"section.{name}.material"] * (len(materials) > 1)
    node_sets = {name: {"group": name} for name, members in mesh.node_groups.items() if len(members)}
    conditions = {name: table for name, table in case_tables(mesh.tables).items() if name in _CONDITIONS}
    return {"node_set": node_sets, "material": materials, "section": sections, **conditions}, made


def skeleton(mesh: WholeMesh, file: Path, case: Path) -> str:
    """Return the text of a case file at ``case`` for a mesh file, which can be checked and run."""
    tables, made = tables_of(mesh)
    known = [name for name in _CONDITIONS if mesh.tables.get(name, {}).keys() - {PLANE}]
    analysis = mesh.tables.get("analysis", {})
    missing = "supports and loads" if analysis else "supports, loads, and the analysis"
    missing = missing if not known else "" if analysis else "the analysis, which is an explicit one of a millisecond"
    made += [missing] * bool(missing)
    told = "Replace what is not known from it:" if made else "Supports, loads and the analysis are those of the file."
    lines = [f"# A case for {file.name}. {told}\n", *(f"#   {key}\n" for key in made), "\n"]
    data = {
        "title": mesh.title or file.stem,
        "mesh": {"file": os.path.relpath(file.absolute(), case.absolute().parent)},
        **{name: table for name, table in tables.items() if table},
        **({} if known else {"gravity": {"acceleration": [0.0, 0.0, -9.81]}}),
        **(analysis or {"time": {"integrator": "central_differences", "step": "auto", "end": 1e-3}}),
    }
    # each node of a probe has columns of the history
    moved = [keys for keys in mesh.tables.get("support", {}).values() if len(keys) > 2]
    names = dict.fromkeys(keys["node_set"] for keys in (*mesh.tables.get("load", {}).values(), *moved))
    probes = [{"name": name, "node_set": name} for name in names if len(mesh.node_groups[name]) <= _PROBED]
    data |= {"output": {"probe": probes}} if probes and data.keys() & {"static", "time"} else {}
    held = next(iter(tables["node_set"]), "NAME")
    example = "" if tables["node_set"] else _NODE_SET
    example += f'\n# [[support]]\n# node_set = "{held}"\n# fix = "xyz"\n'
    return "".join(lines) + table_text(data) + (example if "support" not in tables else "")


SHORT = 1e-6
"""Bars shorter than this fraction of the mean length are reported as suspicious."""

LARGE = 1e150
"""Coordinates [m] of at least this size are refused, because their squares overflow."""

_SHOWN = 5

_PIECE = 1 << 18  # number of bars that are checked at a time, to keep temporary arrays small

_NO_LINES = (
    "; if there are physical groups, Gmsh saves nothing else: put the lines into one "
    '(Physical Curve("bars") = {:}), or save all (Mesh.SaveAll = 1)'
)
_BARE_NODES = (
    " (Gmsh saves each point of a physical group: these are points that no line in a group ends at; points at the same "
    "place are merged by `Coherence;`)"
)


def check_mesh(slab: MeshSlab, comm: MPI.Comm) -> list[str]:
    """Refuse a mesh that cannot be simulated. Collective.

    Nodes and bars are named by their numbers in the mesh, from 0. A structured mesh is valid by construction and is not
    checked.

    Returns
    -------
    warnings : list of str
        Those of the slab, and about suspicious bars (far shorter than the others); equal on all ranks.

    Raises
    ------
    InputError
        On all ranks, for a mesh without nodes or bars, coordinates that are not finite, bar ends that do not exist,
        bars of zero length, several bars between the same two nodes, or nodes without bars.
    """
    warnings = comm.bcast(slab.warnings if comm.rank == 0 else None)
    if slab.structured:
        return warnings
    if slab.n_nodes == 0 or slab.n_bars == 0:
        hint = _NO_LINES if slab.source.endswith(".msh") and slab.n_nodes else ""
        raise InputError(f"{slab.source}: {slab.n_nodes} nodes and {slab.n_bars} bars: nothing to simulate{hint}")
    refuse, bar = partial(_refuse, slab, comm), partial(_bar, slab)
    check_numbers(slab, comm)
    refuse(slab.bars[:, 0] == slab.bars[:, 1], bar, "bars start and end at the same node", "remove them")
    used, length = _lengths(slab, comm)
    remedy = "remove them: a node without bars has neither mass nor stiffness"
    remedy += _BARE_NODES if slab.source.endswith(".msh") else ""
    refuse(~used, lambda i: f"node {slab.first_node + i}", "nodes belong to no bar", remedy)

    def with_length(i: int) -> str:
        return f"{bar(i)}, length {length[i]:g} m"

    refuse(
        ~((length > 0.0) & (length < np.inf)),
        with_length,
        "bars have a length that is zero or overflows double precision",
        "merge the nodes at its ends, or correct their positions",
    )
    mean = comm.allreduce(float(length.sum())) / slab.n_bars
    text = _sentence(comm, length < SHORT * mean, with_length, f"bars are far shorter than the mean length {mean:g} m")
    _check_duplicates(slab, comm)
    return warnings + [f"{slab.source}: {text}; the explicit time step decreases with the shortest bar"] * bool(text)


def check_numbers(slab: MeshSlab, comm: MPI.Comm) -> None:
    """Refuse coordinates that are not finite or too large, and bars whose ends do not exist: what no operation on
    meshes can mend. Collective.

    Raises
    ------
    InputError
        On all ranks.
    """
    _refuse(
        slab,
        comm,
        ~(np.abs(slab.points) < LARGE).all(axis=1),
        lambda i: f"node {slab.first_node + i} at ({', '.join(f'{x:g}' for x in slab.points[i])})",
        f"nodes have coordinates that are not numbers below {LARGE:g}",
        "correct them",
        mended=False,
    )
    missing = ((slab.bars < 0) | (slab.bars >= slab.n_nodes)).any(axis=1)
    remedy = f"nodes are numbered from 0 to {slab.n_nodes - 1}"
    _refuse(slab, comm, missing, partial(_bar, slab), "bars have an end that does not exist", remedy, mended=False)


def _lengths(slab: MeshSlab, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Return which nodes of the slab bars end at, (nodes here,) bool, and the lengths [m] of its bars, in pieces.
    Collective."""
    used, length = np.zeros(len(slab.points), bool), np.empty(len(slab.bars))
    # all ranks take as many pieces as the one with most bars
    for start in range(0, -(-slab.n_bars // comm.size), _PIECE):
        bars = slab.bars[start : start + _PIECE]
        # Each end of a bar is sent to the rank whose slab contains it, which then knows all nodes in use.
        ends, place = np.unique(bars, return_inverse=True)
        asking = Router(comm, slab_of(ends, slab.n_nodes, comm.size))
        asked = asking.send(ends) - slab.first_node
        used[asked] = True
        points = asking.reply(slab.points[asked])
        place = place.reshape(-1, 2)
        with np.errstate(over="ignore"):
            across = points[place[:, 1]]
            across -= points[place[:, 0]]
            length[start : start + _PIECE] = np.sqrt(np.einsum("ij,ij->i", across, across))
    return used, length


def _check_duplicates(slab: MeshSlab, comm: MPI.Comm) -> None:
    """Refuse bars between the same two nodes: the rank whose slab has the lower end sorts them next to each other."""
    lower, upper = slab.bars.min(axis=1).astype(np.int64), slab.bars.max(axis=1)
    router = Router(comm, slab_of(lower, slab.n_nodes, comm.size))
    ends = router.send(lower * slab.n_nodes + upper)
    numbers = router.send(np.arange(slab.first_bar, slab.first_bar + len(slab.bars)))
    order = np.lexsort((numbers, ends))
    again = np.flatnonzero(np.diff(ends[order]) == 0)
    first, second = numbers[order[again]], numbers[order[again + 1]]
    by_number = np.argsort(first, kind="stable")
    first, second, ends = first[by_number], second[by_number], ends[order[again[by_number]]]
    _refuse(
        slab,
        comm,
        np.ones(len(again), bool),
        lambda k: f"bars {first[k]} and {second[k]} (nodes {ends[k] // slab.n_nodes} and {ends[k] % slab.n_nodes})",
        "bars join the same two nodes as another bar",
        "keep one of each, with the sum of the areas",
    )


def _bar(slab: MeshSlab, i: int) -> str:
    return f"bar {slab.first_bar + i} (nodes {slab.bars[i, 0]} and {slab.bars[i, 1]})"


def _sentence(comm: MPI.Comm, bad: np.ndarray, named: Callable[[int], str], what: str) -> str:
    """Return what all ranks found, ``bad`` (n,): the count, ``what``, and the first few; empty if none. Collective."""
    total = comm.allreduce(int(np.count_nonzero(bad)))
    if total == 0:
        return ""
    found = [name for names in comm.allgather([named(i) for i in np.flatnonzero(bad)[:_SHOWN]]) for name in names]
    return f"{total} {what}: {', '.join(found[:_SHOWN])}{', ...' if total > _SHOWN else ''}"


def _refuse(
    slab: MeshSlab,
    comm: MPI.Comm,
    bad: np.ndarray,
    named: Callable[[int], str],
    what: str,
    remedy: str,
    mended: bool = True,
) -> None:
    """Raise the same InputError on all ranks if any rank found something; ``mended``: `mesh clean` is a way out.
    Collective."""
    text = _sentence(comm, bad, named, what)
    if text:
        file = Path(slab.source)
        if mended and file.is_file():
            remedy += f"; python -m pfem_petsc mesh clean {file} {file.stem}_clean.h5"
        raise InputError(f"{slab.source}: {text}; {remedy}")
