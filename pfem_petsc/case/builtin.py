"""The cases that come with the package."""

from __future__ import annotations

from pathlib import Path

__all__ = ["built_in_cases", "built_in_path"]

FOLDER = Path(__file__).parent.parent / "cases"


def built_in_cases() -> list[str]:
    """Names of the built-in cases."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def built_in_path(name: str) -> Path | None:
    """File of a built-in case, or None where no such case is built in."""
    return FOLDER / f"{name}.toml" if name in built_in_cases() else None
