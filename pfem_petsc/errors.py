"""The errors that end a run, each with its exit status on the command line."""

from __future__ import annotations

import shlex
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = [
    "NUMPY_REMEDY",
    "EarlyStop",
    "InputError",
    "NotConverged",
    "PfemError",
    "SimulationFailure",
    "lacking_module",
    "numpy_is_too_new",
    "printable",
    "raised",
    "written",
]


def printable(text: str) -> str:
    """Return a text without control characters, except line breaks and tabs; a terminal would interpret them."""
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


NUMPY_REMEDY = 'the installed NumPy is incompatible with petsc4py, mpi4py or h5py: python -m pip install "numpy<2"'


def numpy_is_too_new(error: BaseException) -> bool:
    """Return whether an import failed because a package was compiled against another version of NumPy."""
    text = str(error)
    return isinstance(error, ValueError | ImportError) and (
        "numpy.dtype size changed" in text or "compiled using NumPy 1" in text
    )


def lacking_module(error: ImportError) -> str:
    """Return what an import that failed lacks, with the remedy, which depends on whether ``setup.sh`` has finished."""
    prefix = Path(sys.prefix)
    if not (prefix / "made-from").is_file():
        return f"{error}; scripts/setup.sh makes an environment that has it: source .venv/bin/activate"
    words = {".venv": "bash scripts/setup.sh", ".venv-petsc": "bash scripts/setup.sh --build-petsc"}
    command = words.get(prefix.name, f"PFEM_VENV={shlex.quote(str(prefix))} bash scripts/setup.sh")
    if not (prefix / "setup-done").is_file():
        return f"the environment {prefix} is not finished: run {command} ({error})"
    place = prefix.name if prefix.name in words else shlex.quote(str(prefix))
    return f"the environment {prefix} lacks what it had: run {command}, then source {place}/bin/activate ({error})"


def raised(error: BaseException, file: str | None = None) -> str:
    """Return what a function of a user raised, and where: ``raised ValueError: no such node (my.py, line 7)``.

    With a ``file``, the place is the last one in it, and left out if there is none.
    """
    frames = [each for each in traceback.extract_tb(error.__traceback__) if file in (None, each.filename)]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"raised {type(error).__name__}: {error}{place}"


class PfemError(Exception):
    """Base class of errors that are reported to the user.

    The message states what is wrong, where (file and key, or step, node and bar), the value, and the remedy.
    """

    exit_status = 1


class InputError(PfemError):
    """Invalid input, found before the first step: case, mesh, restart file, option, unwritable output."""

    exit_status = 2


class SimulationFailure(PfemError):
    """Failure during the simulation: no convergence, collapsed bar, instability, disk full."""

    exit_status = 3


class NotConverged(SimulationFailure):
    """A solve failed before the state was changed, so a smaller step may succeed. Raised on all ranks.

    ``kind``: what failures of the same kind have in common, for messages that count them.
    """

    def __init__(self, message: str, kind: str = "no convergence") -> None:
        super().__init__(message)
        self.kind = kind


class EarlyStop(PfemError):
    """The run stopped early on request (signal or time limit), with a checkpoint written."""

    exit_status = 4


@contextmanager
def written(path: Path, what: str) -> Iterator[None]:
    """Context that writes a file, whose folder it makes; ``what`` is written, for messages.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        text = f"{path}: {what} cannot be written ({error.strerror or error}); give another file or folder"
        raise InputError(text) from error
