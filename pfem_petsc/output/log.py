"""The log file of a run: one line a text, with date and level, never worth losing the run for."""

from __future__ import annotations

import datetime
import sys
from pathlib import Path

from ..errors import InputError

__all__ = ["LogFile"]


class LogFile:
    """Append lines to a log; an existing one is continued.

    A file that cannot be opened at the start is refused. One that is lost on the way (its folder removed, disk full)
    is said once on stderr, and later lines are dropped: the run is worth more than its log.

    Raises
    ------
    InputError
        When the file cannot be created; its folder is made where missing.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a", buffering=1, encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"{self.path}: the log cannot be written ({error.strerror}); choose another output folder with -o"
            ) from error

    def write(self, text: str, level: str = "INFO") -> None:
        """Append a line."""
        if self._file is None:
            return
        stamp = datetime.datetime.now().strftime("%Y-%m-%d %H:%M:%S")
        try:
            if not self.path.exists():  # an unlinked file would take the line and lose it
                self._file.close()
                self._file = self.path.open("a", buffering=1, encoding="utf-8")
            self._file.write(f"{stamp} {level:<7} {text}\n")
        except OSError as error:
            self._file = None
            print(
                f"warning: {self.path}: the log cannot be written any more ({error.strerror}); "
                "the run continues without it",
                file=sys.stderr,
                flush=True,
            )

    def close(self) -> None:
        """Close the file; later lines are dropped."""
        if self._file is not None:
            self._file.close()
            self._file = None
