"""The built-in cases of the package, and the text of case files."""

from __future__ import annotations

import difflib
from pathlib import Path

from ..errors import InputError
from ..files import readable_whole

__all__ = ["built_in_cases", "built_in_path", "read_text"]

FOLDER = Path(__file__).parent.parent / "cases"


def built_in_cases() -> list[str]:
    """Return the names of the built-in cases."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def built_in_path(name: str) -> Path | None:
    """Return the file of a built-in case, or None if there is no such case."""
    return FOLDER / f"{name}.toml" if name in built_in_cases() else None


def read_text(path: Path) -> str:
    """Return the text of a case file.

    Raises
    ------
    InputError
        If it cannot be read; the nearest built-in case is named.
    """
    try:
        return readable_whole(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: line {line}: this is not UTF-8 text; a case file is TOML in UTF-8") from error
    except FileNotFoundError as error:
        names = built_in_cases()
        near = difflib.get_close_matches(str(path), names, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"the built-in cases are {', '.join(names)}"
        raise InputError(f"{path}: there is no such case file or built-in case; {hint}") from error
    except IsADirectoryError as error:
        raise InputError(
            f"{path}: this is a folder; name a case file or a built-in case, and the folder of its results by -o"
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: this case file cannot be read: {error}") from error
