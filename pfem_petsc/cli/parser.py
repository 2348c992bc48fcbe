"""The parser of the command line, and options that several verbs share."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import NoReturn

from ..errors import InputError

__all__ = ["Parser", "add_case", "add_debug", "add_result", "seconds", "surviving"]

PROGRAM = "python -m pfem_petsc"


class Parser(argparse.ArgumentParser):
    """Parser that raises errors instead of printing them, so that one rank can print them."""

    def __init__(self, **settings: object) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **settings)  # type: ignore[arg-type]
        # argparse treats -1 as a number and -1e8 as an option.
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        """Raise the error as invalid input."""
        hint = " (give it before --set and --restart)" if "required: CASE" in message else ""
        raise InputError(f"{message}{hint}; see {self.prog} --help")


def add_case(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    """Add CASE and --set."""
    parser.add_argument(
        "case", metavar="CASE", nargs="?" if optional else None, help="TOML file, or name of a built-in case (see list)"
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        metavar="KEY=VALUE",
        nargs="+",
        action="extend",
        default=[],
        help="values that replace those of the case: time.step=1e-5 wall.0.point=[1,0,0]; KEY= removes a key",
    )


def add_plugins(parser: argparse.ArgumentParser) -> None:
    """Add --plugin."""
    parser.add_argument(
        "--plugin",
        dest="plugins",
        metavar="FILE",
        nargs="+",
        action="extend",
        default=[],
        help="files with laws, integrators, walls and so on of your own, as the key plugins of a case",
    )


def add_result(parser: argparse.ArgumentParser) -> None:
    """Add RESULT."""
    parser.add_argument("result", metavar="RESULT", help="result file, or its folder")


def surviving(result: str, deep: bool | None = None, refuse: bool = False) -> Path:
    """Return the result file of RESULT after a separate process has read it, because HDF5 may crash on a damaged file.

    Values that do not match their checksums are a warning on stderr, or refused.

    Raises
    ------
    InputError
        If there is no such file, or it cannot be read; with ``refuse`` also if values do not match.
    """
    from ..output.result import result_file
    from ..output.verify import SHOWN, examine

    path = result_file(result)
    wrong = examine(path, deep) if path.is_file() else []
    if wrong:
        lines = wrong if len(wrong) <= SHOWN else [*wrong[:SHOWN], f"... and {len(wrong) - SHOWN} more"]
        text = f"{path}: damaged: " + "\n  ".join(lines)
        if refuse:
            raise InputError(f"{text}\nrestore it from a copy; everything that is not named is undamaged")
        print(f"warning: {text}", file=sys.stderr, flush=True)
    return path


def add_debug(parser: argparse.ArgumentParser) -> None:
    """Add --debug, which every verb has."""
    parser.add_argument("--debug", action="store_true", help="print the traceback of a failure")


def seconds(text: str) -> float:
    """Convert a duration, ``90``, ``1:30`` or ``0:01:30``, to seconds.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is not a duration, or not positive.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = []
    total = sum(part * 60.0**k for k, part in enumerate(reversed(parts)))
    if not 1 <= len(parts) <= 3 or min(parts) < 0.0 or not 0.0 < total < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration: give seconds, or hours:minutes:seconds")
    return total
