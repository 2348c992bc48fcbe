"""The built-in cases of the package."""

from __future__ import annotations

from pathlib import Path

__all__ = ["built_in_cases", "built_in_path"]

FOLDER = Path(__file__).parent.parent / "cases"


def built_in_cases() -> list[str]:
    """Return the names of the built-in cases."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def built_in_path(name: str) -> Path | None:
    """Return the file of a built-in case, or None if there is no such case."""
    return FOLDER / f"{name}.toml" if name in built_in_cases() else None
