"""Finds what case files and file names name: one module for each name, of the package, installed, or from a plugin.

A module of one of the packages :data:`KINDS` has the name of its file. Other distributions add modules by entry points
(``[project.entry-points."pfem_petsc.laws"]``: ``my_law = "my_package.my_law"``), users by files (:func:`add_plugin`).
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import importlib
import pkgutil
import re
import sys
import traceback
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from .errors import InputError
from .files import readable_whole


class Kind(NamedTuple):
    """What the modules of a package are: their group of entry points, and what each defines at its top level."""

    group: str
    defines: str


KINDS = {
    "pfem_petsc.integrators": Kind("pfem_petsc.integrators", "Scheme"),
    "pfem_petsc.mechanics.materials": Kind("pfem_petsc.laws", "LAW"),
    "pfem_petsc.contact.walls": Kind("pfem_petsc.walls", "Wall"),
    "pfem_petsc.contact.constraints": Kind("pfem_petsc.constraints", "Constraint"),
    "pfem_petsc.contact.treatments": Kind("pfem_petsc.treatments", "Treatment"),
    "pfem_petsc.mesh.generators": Kind("pfem_petsc.generators", "generate"),
    "pfem_petsc.formats": Kind("pfem_petsc.formats", "SUFFIXES"),
    "pfem_petsc.statics.methods": Kind("pfem_petsc.static_methods", "make_stepper"),
}

_plugins: dict[str, dict[str, ModuleType]] = {package: {} for package in KINDS}
_sources: dict[Path, bytes] = {}
"""What the files of plugins had when they were run."""


def _own(package: str) -> tuple[str, ...]:
    """Names of the modules of a package, except ``base`` and private ones."""
    path = importlib.import_module(package).__path__
    return tuple(m.name for m in pkgutil.iter_modules(path) if not m.name.startswith("_") and m.name != "base")


@cache
def _every_entry_point() -> EntryPoints:
    return entry_points()


@cache
def _installed(package: str) -> dict[str, EntryPoint]:
    """Entry points of other distributions by name."""
    points = _every_entry_point().select(group=KINDS[package].group) if package in KINDS else ()
    return {point.name: point for point in points}


def choices(package: str) -> list[str]:
    """Return the names that :func:`lookup` finds, without importing the modules of the package."""
    return sorted({*_own(package), *_installed(package), *_plugins.get(package, ())})


def nearest(name: str, known: list[str]) -> str:
    """Return a hint for a misspelt name: ``", did you mean 'x'?"``, or the known names if none is similar."""
    if not known:
        return "; there is none"
    match = difflib.get_close_matches(str(name), known, n=1, cutoff=0.6)
    return f", did you mean '{match[0]}'?" if match else f"; known: {', '.join(known)}"


def lookup(package: str, name: str, where: str) -> ModuleType:
    """Import the module ``name`` of a package, or of what others add to it.

    Raises
    ------
    InputError
        If there is no such module; the message names the key ``where`` and the nearest known name.
    """
    if not isinstance(name, str):  # of a case that is not checked yet
        raise InputError(f"{where}: unknown value {name!r}{nearest(name, choices(package))}")
    if name in _own(package):
        return importlib.import_module(f"{package}.{name}")
    if name in _plugins.get(package, ()):
        return _plugins[package][name]
    if name in _installed(package):
        try:
            return _installed(package)[name].load()
        except Exception as error:  # noqa: BLE001 - what is installed beside the program may raise anything
            raise InputError(
                f"{where}: {_installed(package)[name].value} cannot be imported: {type(error).__name__}: {error}"
            ) from error
    known = choices(package)
    hint = nearest(name, known) if known else "; none is built in, docs/extending.md says how to add one"
    raise InputError(f"{where}: unknown value {name!r}{hint}")


def modules(package: str) -> dict[str, ModuleType]:
    """Return all modules by name that can be imported; a package of others may be broken."""
    found = {}
    for name in choices(package):
        with contextlib.suppress(InputError):
            found[name] = lookup(package, name, "")
    return found


def description(package: str, name: str) -> str:
    """Return the first line of a module's docstring; one of the program is not imported, as some compile kernels."""
    if name in _own(package):
        text = ast.get_docstring(ast.parse(Path(find_spec(f"{package}.{name}").origin).read_text(encoding="utf-8")))
    else:
        text = getattr(modules(package).get(name), "__doc__", "cannot be imported")
    return (text or "").strip().partition("\n")[0]


def add_plugin(path: Path | str) -> None:
    """Add the module of a file under the name of the file, as one of the first package whose definition it has.

    Its relative imports are those of a module of that package.

    Raises
    ------
    InputError
        If it cannot be read or run, is no such module, or has the name of a module of the program.
    """
    path = Path(path).resolve()
    try:
        source = readable_whole(path).read_bytes()
        if _sources.get(path) == source:
            return
        tree = ast.parse(source, str(path))
    except (OSError, SyntaxError, ValueError) as error:
        if path in _sources and not path.exists():
            return
        raise InputError(f"this plugin cannot be read: {error}") from error
    defined = {name for node in tree.body for name in _names(node)}
    package = next((package for package, kind in KINDS.items() if kind.defines in defined), None)
    name = path.stem
    if package is None or not name.isidentifier():
        known = ", ".join(kind.defines for kind in KINDS.values())
        raise InputError(
            f"this is no plugin: expected a file NAME.py that defines one of {known} (docs/extending.md has examples)"
        )
    if name in _own(package):
        raise InputError(f"{package} has a module {name} of its own: give the plugin another name")
    module_name = f"{package}.{name}"
    spec: Any = spec_from_file_location(module_name, path)
    module = module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # noqa: BLE001 - a plugin may raise anything
        del sys.modules[module_name]
        raise InputError(f"this plugin cannot be imported: {type(error).__name__}: {error}") from error
    _sources[path] = source
    _plugins[package][name] = module


def has_plugin(path: Path | str) -> bool:
    """Return whether the module of a file was added."""
    return Path(path).resolve() in _sources


def added_file(package: str, name: str) -> str:
    """Return the file of a module that a plugin or another distribution adds; empty for one of the program."""
    return "" if name in _own(package) else str(lookup(package, name, "").__file__)


def blame(error: BaseException) -> str:
    """Return the place in a plugin where an error was raised, or which could not be compiled, and why; or nothing."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename) in _sources:
            return f"{frame.filename}, line {frame.lineno}, in {frame.name}: {type(error).__name__}: {error}"
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))  # Numba highlights where colorama is installed
    for found in re.finditer(r'File "(.+)", line (\d+)', text):  # as Numba quotes a function that it cannot compile
        path = Path(found[1]).resolve()
        if path in _sources:
            reason = text[: found.start()].rstrip().rpartition("\n")[2].strip()
            return f"{path}, line {found[2]}: this cannot be compiled: {reason}"
    return ""


def _names(node: ast.stmt) -> list[str]:
    """Names that a statement of a module defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [target.id for target in targets if isinstance(target, ast.Name)]
