"""The log file of a run: one line per message, with date and level. Its loss does not end the run."""

from __future__ import annotations

import datetime
import sys
from pathlib import Path

from ..errors import InputError

__all__ = ["LogFile"]


class LogFile:
    """Appends lines to a log; an existing one is continued.

    A file that cannot be opened at the start is an error. If it is lost during the run (folder removed, disk full), a
    warning is printed once on stderr, later lines are dropped, and the run continues.

    Raises
    ------
    InputError
        If the file cannot be created; a missing folder is created.
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
            if not self.path.exists():  # lines written to an unlinked file would be lost
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
