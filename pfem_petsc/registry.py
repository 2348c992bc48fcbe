"""Finds the classes that case files name: one class per module, with the name of the module."""

from __future__ import annotations

import difflib
import importlib
import pkgutil
from types import ModuleType

from .errors import InputError

__all__ = ["choices", "lookup", "nearest"]


def choices(package: str) -> list[str]:
    """Return the names of the modules of a package without importing them, except ``base`` and private ones."""
    path = importlib.import_module(package).__path__
    return sorted(m.name for m in pkgutil.iter_modules(path) if not m.name.startswith("_") and m.name != "base")


def nearest(name: str, known: list[str]) -> str:
    """Return a hint for a misspelt name: ``", did you mean 'x'?"``, or the known names if none is similar."""
    if not known:
        return "; there is none"
    match = difflib.get_close_matches(str(name), known, n=1, cutoff=0.6)
    return f", did you mean '{match[0]}'?" if match else f"; known: {', '.join(known)}"


def lookup(package: str, name: str, where: str) -> ModuleType:
    """Import the module ``name`` of a package.

    Raises
    ------
    InputError
        If there is no such module; the message names the key ``where`` and the nearest known name.
    """
    known = choices(package)
    if name not in known:
        hint = nearest(name, known) if known else "; none is built in, CONTRIBUTING.md says how to add one"
        raise InputError(f"{where}: unknown value {name!r}{hint}")
    return importlib.import_module(f"{package}.{name}")
