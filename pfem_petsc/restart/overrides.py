"""Values of --set that a restart keeps from the continued run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mpi4py import MPI

from ..case.toml import split_key
from ..errors import InputError
from ..output.checkpoint import asked_checkpoint, read_checkpoint_header
from ..output.result import open_result
from .folder import RESULT

__all__ = ["joined_overrides", "kept_overrides"]


def kept_overrides(name: str, folder: Path, restart: bool | Path) -> list[str]:
    """Return the texts ``KEY=VALUE`` of the run that a restart continues. Not collective.

    Parameters
    ----------
    name : of the case; texts of a run of another case are not kept
    folder : of the output
    restart : True for the newest checkpoint of the folder, else its file or folder

    Raises
    ------
    InputError
        If the checkpoint is missing or damaged.
    """
    path = asked_checkpoint(folder, restart)
    if path is not None:
        _, found = read_checkpoint_header(path, MPI.COMM_SELF)
    else:
        # the run may have finished without a checkpoint
        try:
            with open_result(folder / RESULT) as result:
                found = result.attributes
        except InputError:
            return []
    return [str(text) for text in found.get("overrides", [])] if found.get("name") == name else []


def joined_overrides(kept: Iterable[str], given: Iterable[str]) -> list[str]:
    """Return the kept texts, except for keys that are given again, followed by the given texts."""
    given = list(given)
    keys = {_key(text) for text in given}
    return [*(text for text in kept if _key(text) not in keys), *given]


def _key(text: str) -> tuple[str, ...]:
    key = text.partition("=")[0].strip()
    return tuple(split_key(key) or [key])
