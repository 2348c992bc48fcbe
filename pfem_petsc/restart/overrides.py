"""Values of --set that a restart keeps from the run that it continues."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mpi4py import MPI

from ..case.overrides import split_key
from ..errors import InputError
from ..output.checkpoint import asked_checkpoint, read_checkpoint_header
from ..output.result import open_result
from .folder import RESULT

__all__ = ["joined_overrides", "kept_overrides"]


def kept_overrides(name: str, folder: Path, restart: bool | Path) -> list[str]:
    """Texts ``KEY=VALUE`` that the run which a restart continues was given. One process.

    Parameters
    ----------
    name : of the case; a run of another one has nothing to keep
    folder : of the output
    restart : True for the newest checkpoint of the folder, else its file or folder

    Raises
    ------
    InputError
        The checkpoint is missing or damaged.
    """
    path = asked_checkpoint(folder, restart)
    if path is not None:
        _, found = read_checkpoint_header(path, MPI.COMM_SELF)
    else:
        # finished without a checkpoint, perhaps
        try:
            with open_result(folder / RESULT) as result:
                found = result.attributes
        except InputError:
            return []
    return [str(text) for text in found.get("overrides", [])] if found.get("name") == name else []


def joined_overrides(kept: Iterable[str], given: Iterable[str]) -> list[str]:
    """Those kept, but for keys that are given anew, and then those given."""
    given = list(given)
    keys = {_key(text) for text in given}
    return [*(text for text in kept if _key(text) not in keys), *given]


def _key(text: str) -> tuple[str, ...]:
    key = text.partition("=")[0].strip()
    return tuple(split_key(key) or [key])
