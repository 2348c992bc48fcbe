"""Converts the nested tables of a case file to validated models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from ..registry import choices, lookup
from . import settings as s
from . import tables as t
from .base import StrictModel, with_absolute_paths
from .load_reading import read_loads, read_tabled, read_varying
from .materials import read_materials
from .names import nearest_key
from .problems import Path as KeyPath
from .problems import Problems, table_list
from .table_files import TableFiles

__all__ = ["KEYS", "read_tables"]

GENERATORS = "pfem_petsc.mesh.generators"
INTEGRATORS = "pfem_petsc.integrators"
WALLS = "pfem_petsc.contact.walls"
CONSTRAINTS = "pfem_petsc.contact.constraints"
STATIC_METHODS = "pfem_petsc.statics.methods"

M = TypeVar("M", bound=StrictModel)

KEYS = [
    *("title", "mesh", "node_set", "material", "section", "initial", "support"),
    *("mass", "spring", "dashpot", "load", "gravity", "wind", "temperature", "wall", "contact_pair", "constraint"),
    *("remove", "contact"),
    *("time", "static", "stage", "modes", "output", "solver"),
]
"""Top-level keys of a case file."""

VARYING = (("gravity", (t.Gravity, t.VaryingGravity)), ("wind", (t.Wind, t.VaryingWind)))
"""Tables with a vector, constant or over time, and their models."""


def read_tables(data: Mapping[str, Any], folder: Path, problems: Problems) -> dict[str, Any]:
    """Validate all tables of a case; rejected ones are reported in ``problems`` and left out or None.

    Parameters
    ----------
    data : the case as nested tables
    folder : to which the path of the mesh file is relative
    problems : receives the problems

    Returns
    -------
    The attributes of a :class:`~pfem_petsc.case.schema.Case` by name, including ``title`` if there is one.
    """
    for key in data:
        if key not in KEYS:
            problems.add((key,), f"unknown key{nearest_key(key, KEYS)}")
    files = TableFiles(folder)
    title = data.get("title")
    if title is not None and not isinstance(title, str):
        problems.add(("title",), "expected a text in quotes", title)
    return {
        "title": title,
        "mesh": _mesh(data, folder, problems),
        "node_set": _named(t.NodeSet, data, "node_set", problems),
        "material": read_materials(data, problems),
        "section": _named(t.Section, data, "section", problems),
        "initial": _initial(data, problems),
        "support": read_tabled(t.Support, data, "support", files, problems, ("motion", "acceleration"), ("velocity",)),
        "mass": _listed(t.NodalMass, data.get("mass"), ("mass",), problems),
        "spring": _listed(t.Spring, data.get("spring"), ("spring",), problems),
        "dashpot": _listed(t.Dashpot, data.get("dashpot"), ("dashpot",), problems),
        "load": read_loads(data, folder, files, problems),
        **{
            table: read_varying(data[table], table, m, files, problems) if table in data else None
            for table, m in VARYING
        },
        "temperature": read_tabled(t.Temperature, data, "temperature", files, problems, ("table",), ("value",)),
        "wall": _kinds(data.get("wall"), "wall", "type", WALLS, "a wall of type", problems, files),
        "contact_pair": _pairs(data.get("contact_pair"), problems),
        "constraint": _kinds(
            data.get("constraint"), "constraint", "kind", CONSTRAINTS, "a constraint of kind", problems
        ),
        "remove": _listed(t.Remove, data.get("remove"), ("remove",), problems),
        "contact": problems.read(s.ContactSettings, data.get("contact", {}), ("contact",)),
        **_analyses(data, problems),
        "output": _output(data.get("output", {}), problems),
        "solver": problems.read(s.Solver, data.get("solver", {}), ("solver",)),
    }


def _listed(model: type[M], data: Any, path: KeyPath, problems: Problems) -> list[M]:
    read = [problems.read(model, row, (*path, i)) for i, row in enumerate(table_list(data, path, problems))]
    return [row for row in read if row is not None]


def _named(model: type[M], data: Mapping[str, Any], key: str, problems: Problems) -> dict[str, M]:
    """Read tables with user-defined names, such as [material.steel], in file order."""
    table = data.get(key, {})
    if not isinstance(table, Mapping):
        problems.add((key,), f"expected tables, each under a heading [{key}.NAME]", table)
        return {}
    read = {str(name): problems.read(model, row, (key, str(name))) for name, row in table.items()}
    return {name: row for name, row in read.items() if row is not None}


def _required(data: Mapping[str, Any], key: str, problems: Problems) -> Mapping[str, Any] | None:
    if key not in data:
        problems.add((), f"the table [{key}] is missing")
    elif not isinstance(data[key], Mapping):
        problems.add((key,), "expected a table", data[key])
    else:
        return data[key]
    return None


def _split(model: type[StrictModel], table: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split a table into the keys of a model and the others."""
    own = {k: v for k, v in table.items() if k in model.model_fields}
    return own, {k: v for k, v in table.items() if k not in model.model_fields}


def _parameters_model(package: str, name: Any, path: KeyPath, problems: Problems) -> type[StrictModel] | None:
    """Return the ``Parameters`` of a module found by name."""
    try:
        return lookup(package, name, "").Parameters
    except InputError as error:
        problems.add(path, str(error).partition(": ")[2].replace(f"unknown value {name!r}", "unknown value"), name)
    except AttributeError:
        problems.add(path, f"{package}.{name} has no Parameters: it is not meant for case files", name)
    return None


def _siblings(package: str) -> dict[str, list[str]]:
    """Return all modules of a package with their keys."""
    models = {name: getattr(lookup(package, name, ""), "Parameters", None) for name in choices(package)}
    return {name: list(model.model_fields) for name, model in models.items() if model is not None}


def _mesh(data: Mapping[str, Any], folder: Path, problems: Problems) -> t.Mesh | None:
    if hasattr(data.get("mesh"), "mesh_table"):  # a truss from arrays
        data = {"mesh": data["mesh"].mesh_table}
    table = _required(data, "mesh", problems)
    if table is None:
        return None
    own, others = _split(t.MeshKeys, table)
    keys = problems.read(t.MeshKeys, own, ("mesh",))
    if keys is None:
        return None
    if keys.file is not None:
        for key in others:
            problems.add(("mesh", key), "unknown key; a mesh from a file takes no other keys")
        return t.Mesh(file=Path(folder, keys.file).resolve())
    model = _parameters_model(GENERATORS, keys.generator, ("mesh", "generator"), problems)
    if model is None:
        return None
    taker = f"generator {keys.generator}"
    parameters = problems.read(
        model, others, ("mesh",), known=["generator", "file"], taker=taker, siblings=lambda: _siblings(GENERATORS)
    )
    if parameters is None:
        return None
    return t.Mesh(generator=keys.generator, parameters=with_absolute_paths(parameters, folder))


def _initial(data: Mapping[str, Any], problems: Problems) -> list[t.Initial]:
    table = data.get("initial", {})
    if not isinstance(table, Mapping):
        problems.add(("initial",), "expected a table", table)
        return []
    everywhere = {k: v for k, v in table.items() if k != "on"}
    entries = []
    if "node_set" in everywhere:
        problems.add(("initial", "node_set"), "the velocity of a node set belongs under a heading [[initial.on]]")
    elif everywhere:
        entries.append(problems.read(t.Initial, everywhere, ("initial",), known=["on"]))
    for i, row in enumerate(table_list(table.get("on"), ("initial", "on"), problems)):
        entry = problems.read(t.Initial, row, ("initial", "on", i))
        if entry is not None and entry.node_set is None:
            problems.add(("initial", "on", i, "node_set"), "this key is missing: name of a node set")
        entries.append(entry)
    return [entry for entry in entries if entry is not None]


def _kinds(
    data: Any, table: str, key: str, package: str, what: str, problems: Problems, files: TableFiles | None = None
) -> list[StrictModel]:
    """Read a list of tables in which one key names the module that defines the other keys.

    With ``files`` their ``motion`` may be given by a file.
    """
    found = []
    for i, row in enumerate(table_list(data, (table,), problems)):
        path: KeyPath = (table, i)
        if files is not None:
            row = files.resolved(row, path, problems, ("motion",), ("velocity", "mass"))
            if row is None:
                continue
        if not isinstance(row, Mapping):
            problems.add(path, "expected a table", row)
            continue
        if key not in row:
            problems.add((*path, key), f"this key is missing: the kind of {table}")
            continue
        model = _parameters_model(package, row[key], (*path, key), problems)
        if model is not None:
            named = {"name": f"{table}{i + 1}", **row}
            taker = f"{what} {row[key]}"
            found.append(problems.read(model, named, path, taker=taker, siblings=lambda: _siblings(package)))
    return [each for each in found if each is not None]


def _pairs(data: Any, problems: Problems) -> list[t.ContactPair]:
    rows = table_list(data, ("contact_pair",), problems)
    named = [{"name": f"pair{i + 1}", **row} if isinstance(row, Mapping) else row for i, row in enumerate(rows)]
    return _listed(t.ContactPair, named, ("contact_pair",), problems)


def _analyses(data: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """The tables that say what is computed, of which a case has at least one."""
    if "time" in data and "static" in data:
        problems.add((), "[time] and [static] exclude each other: give one of them")
    if not any(key in data for key in ("time", "static", "stage", "modes")):
        problems.add((), "the table [time] is missing, or one of [static], [[stage]], [modes], which give the analysis")
    return {
        "time": _time(data, problems) if "time" in data else None,
        "static": _static(data, problems) if "static" in data else None,
        "modes": problems.read(s.Modes, data["modes"], ("modes",)) if "modes" in data else None,
    }


def _static(data: Mapping[str, Any], problems: Problems) -> s.Static | None:
    table = _required(data, "static", problems)
    if table is None:
        return None
    own, others = _split(s.StaticKeys, table)
    keys = problems.read(s.StaticKeys, own, ("static",))
    if keys is None:
        return None
    model = _parameters_model(STATIC_METHODS, keys.method, ("static", "method"), problems)
    if model is None:
        return None
    parameters = problems.read(
        model, others, ("static",), known=["method"], taker=keys.method, siblings=lambda: _siblings(STATIC_METHODS)
    )
    return None if parameters is None else s.Static(method=keys.method, parameters=parameters)


def _time(data: Mapping[str, Any], problems: Problems) -> s.Time | None:
    table = _required(data, "time", problems)
    if table is None:
        return None
    own, others = _split(s.TimeKeys, table)
    keys = problems.read(s.TimeKeys, own, ("time",))
    name = own.get("integrator")
    if not isinstance(name, str):
        return None
    model = _parameters_model(INTEGRATORS, name, ("time", "integrator"), problems)
    if model is None:
        return None
    known = list(s.TimeKeys.model_fields)
    scheme = problems.read(model, others, ("time",), known=known, taker=name, siblings=lambda: _siblings(INTEGRATORS))
    automatic = keys is not None and keys.step == "auto"
    if automatic and not lookup(INTEGRATORS, name, "time.integrator").Scheme.explicit:
        message = f'"auto" is for explicit schemes, and {name} is implicit: give the step in seconds'
        problems.add(("time", "step"), message, "auto")
    if keys is None or scheme is None:
        return None
    return s.Time(**keys.model_dump(exclude_unset=True), scheme=scheme)


def _output(data: Any, problems: Problems) -> s.Output | None:
    if not isinstance(data, Mapping):
        problems.add(("output",), "expected a table", data)
        return None
    probes = _listed(s.Probe, data.get("probe"), ("output", "probe"), problems)
    given = {"probe": tuple(probes)} if probes else {}
    keys = problems.read(s.OutputKeys, {k: v for k, v in data.items() if k != "probe"}, ("output",))
    return None if keys is None else s.Output(**keys.model_dump(exclude_unset=True), **given)
