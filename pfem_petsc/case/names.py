"""The name of a case, and messages about keys that it does not have."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ..errors import InputError
from ..registry import nearest

__all__ = ["checked_name", "nearest_key"]

_ARGUMENTS = {
    "name": "the name of a case is that of its file, or an argument: Case(..., name=...), case.copy(name=...)",
    "source": "it is an argument of Case(...) and cannot be changed",
    "folder": "it is an argument of Case(...) and cannot be changed",
    "overrides": "it is an argument of Case(...)and cannot be changed; update and copy take changes by key",
    "comment": "comments of TOML begin with #",
}


def nearest_key(key: str, known: Iterable[str]) -> str:
    """Return a hint about a top-level key that no case has."""
    return f"; {_ARGUMENTS[key]}" if key in _ARGUMENTS else nearest(key, known)


def checked_name(name: Any, source: str) -> str:
    """Return the name of a case, which is the default folder of its results below ``results``.

    Raises
    ------
    InputError
        If it is no text, or names a folder elsewhere.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{source}: name = {name!r:.60}: expected a text, the default folder of the results")
    if name.startswith("/") or ".." in name.split("/"):
        raise InputError(f"{source}: name = {name!r:.60}: expected the name of a folder below results")
    return name
