"""Checkpoints of a run, the output folder at its start, and the changes of a case that are allowed since."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from ..case.toml import short_text, split_key
from ..errors import InputError
from ..output.checkpoint import (
    NAME,
    PREVIOUS,
    Checkpoint,
    asked_checkpoint,
    check_seal,
)
from ..output.integrity import examine
from ..output.result import RESULT_NAME as RESULT
from ..output.result import open_result
from ..output.units import engineering
from ..parallel.agreement import on_root
from ..tolerances import TIME
from .state import STATE_VERSION

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..stepping.plan import Plan


FREE = ("title", "plugins", "time.end", "static.end", "modes", "output", "solver")
"""Keys and tables that a restart may change: they do not change what is simulated."""

_OF_STAGES = re.compile(r"stage\[(\d+)\]\.(.*)")


def changed_keys(path: Path, before: Mapping[str, Any], now: Mapping[str, Any], source: str) -> list[str]:
    """Return the changes of a restart, ``time.end: 1.0 -> 2.0`` for every key that differs.

    Parameters
    ----------
    path : the checkpoint
    before, now : the case of the checkpoint and this one, as nested tables
    source : this case's file, for the message

    Raises
    ------
    InputError
        If a key differs that a restart cannot change.
    """
    # tuples become lists, as in the checkpoint
    old, new = (_flat(json.loads(json.dumps(case))) for case in (before, now))
    keys = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    lines = {key: f"{key}: {_text(old, key)} -> {_text(new, key)}" for key in keys}
    last = len(now.get("stage", ())) - 1
    refused = [key for key in keys if not _is_free(key, last)]
    if refused:
        more = f" (and {len(refused) - 5} more)" if len(refused) > 5 else ""
        free = ", ".join(FREE)
        if last >= 0:
            analysis = "time" if "time" in now["stage"][last] else "static"
            free = free.replace("time.end, static.end", f"stage[{last}].{analysis}.end")
        raise InputError(
            f"{path}: belongs to a different case than {source}: {'; '.join(lines[key] for key in refused[:5])}{more}. "
            f"A restart continues with the same model and time step, and may change {free} only: restore "
            "the case, or start without --restart"
        )
    return list(lines.values())


def _is_free(key: str, last: int) -> bool:
    """Whether a restart may change a key; of stages, the end of the ``last`` alone."""
    found = _OF_STAGES.match(key)
    if found is not None:
        key = found[2]
        if key.endswith(".end") and int(found[1]) != last:
            return False
    return any(key == free or key.startswith(free + ".") for free in FREE)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables and lists of tables: {"wall[0].point": ...}."""
    found: dict[str, Any] = {}
    if isinstance(value, Mapping):
        for key, item in value.items():
            found |= _flat(item, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(value, list | tuple) and value and all(isinstance(item, Mapping) for item in value):
        for index, item in enumerate(value):
            found |= _flat(item, f"{prefix}[{index}]")
    else:
        found[prefix] = list(value) if isinstance(value, tuple) else value
    return found


def _text(values: Mapping[str, Any], key: str) -> str:
    return short_text(values[key]) if key in values else "absent"


ASIDE = "checkpoint-later.h5"


@dataclass(frozen=True)
class Restart:
    """The checkpoint from which a run continues.

    Attributes
    ----------
    path : the checkpoint
    file : the open checkpoint
    changed : keys of the case that differ, as lines
    continues : whether the results in the output folder are continued; else they are moved aside and new ones begin
    """

    path: Path
    file: Checkpoint
    changed: list[str]
    continues: bool

    @property
    def step(self) -> int:
        """The step after which the checkpoint was written."""
        return int(self.file.scalars["step"])

    @property
    def stage(self) -> int:
        """Number of the stage in which it was written; 0 for a case without stages."""
        stage = self.file.scalars.get("stage")
        return 0 if stage is None else int(stage["number"])

    @property
    def last(self) -> tuple[int, int]:
        """Steps of the last snapshot and of the last history row before the checkpoint."""
        return int(self.file.scalars["snapshot"]), int(self.file.scalars["row"]["step"])


def find_restart(
    case: Case, comm: MPI.Comm, folder: Path, asked: bool | Path | None
) -> tuple[Restart | None, list[str]]:
    """Find the checkpoint for ``--restart`` in an output folder. Collective.

    Returns
    -------
    Restart or None, and messages: why a run that should go on starts from zero

    Raises
    ------
    InputError
        If a named file is missing, or a checkpoint is damaged, or belongs to another case or version.
    """
    if asked is None or asked is False:
        return None, []
    path = on_root(comm, asked_checkpoint, folder, asked)
    if path is None:
        return None, [f"{folder}: no checkpoint to restart from: starting from zero"]
    file = Checkpoint(path, comm)
    version = file.attributes.get("state_version")
    if version != STATE_VERSION:
        raise InputError(
            f"{path}: holds version {version} of a run's state, this program reads {STATE_VERSION}: restart with the "
            f"version of pfem_petsc that wrote it ({file.attributes.get('pfem_petsc', 'unknown')}), or start without "
            "--restart"
        )
    changed = changed_keys(path, file.attributes["case"], case.to_dict(), case.source)
    continues = on_root(comm, _continues, folder, path)
    return Restart(path, file, changed, continues), []


def finished(case: Case, folder: Path, end: float | None) -> float | None:
    """Return the last time [s] of results of this case in the folder, None if they are incomplete. On one rank."""
    path = folder / RESULT
    if end is None or not path.is_file():
        return None
    try:
        examine(path)
        with open_result(path) as result:
            reached = [float(times[-1]) for times in (result.history["time"], result.times) if len(times)]
            before, now = result.case.to_dict(), case.to_dict()
            changed_keys(path, before, now, case.source)
            if case.modes is not None and (not result.n_modes or before.get("modes") != now["modes"]):
                return None
    except InputError:
        # results of another case, or unreadable ones, are moved aside
        return None
    return max(reached) if reached and min(reached) >= end * (1.0 - TIME) else None


def finished_message(folder: Path, reached: float, plan: Plan, case: Case, has_checkpoint: bool) -> str:
    """Return the message about a run whose results have ``reached`` its end [s]: what ended it, and how to go on."""
    if not plan.end:
        return f"{folder}: finished already: the results have the modes of the initial state"
    beyond = f", {_beyond(plan)}" if reached > plan.end * (1.0 + TIME) else ""
    key = split_key(plan.axis.key)
    ends = [text for text in case.overrides if _numbered(_key(text), case) == key and text.partition("=")[2].strip()]
    by = f" (--set {ends[-1]} is in force)" if ends else ""
    way = ""
    if key[-1] == "end":
        way = f"; a later end, --set {plan.axis.key}=..., " + (
            "continues them" if has_checkpoint else "begins anew, as there is no checkpoint (output.checkpoint_every)"
        )
    return f"{folder}: finished already: the results have {_place(reached, plan)}{beyond}{by}{way}"


def _numbered(parts: Sequence[str], case: Case) -> list[str]:
    """Return the parts of a key with the number of a stage instead of its name."""
    names = [stage.name for stage in case.stage]
    if len(parts) > 1 and parts[0] == "stage" and parts[1] in names:
        return ["stage", str(names.index(parts[1])), *parts[2:]]
    return list(parts)


def _place(reached: float, plan: Plan) -> str:
    """Text of a time of the results, of cases with stages counted as the key that ends the last one."""
    return plan.axis.place(reached) + (" of the last stage" if plan.axis.start else "")


def _beyond(plan: Plan) -> str:
    return f"beyond {plan.axis.key} = {engineering(plan.end - plan.axis.start, plan.axis.unit)}"


def _continues(folder: Path, path: Path) -> bool:
    return (folder / RESULT).is_file() and path.resolve().parent == folder.resolve()


def _refuse_other(restart: Restart) -> None:
    """Refuse a checkpoint that another run has overwritten before this one got the lock."""
    if check_seal(restart.path) != restart.file.digest:
        raise InputError(
            f"{restart.path}: another run has overwritten this checkpoint while this one was set up: nothing is "
            "changed; start again with --restart"
        )


def _refuse_loss(path: Path, plan: Plan) -> None:
    """Refuse a restart that would truncate results beyond the end of the run."""
    with open_result(path) as result:
        times = result.history["time"]
        snapshots = int(plan.beyond(result.times).sum())
    rows = int(plan.beyond(times).sum())
    if rows or snapshots:
        reached = max([*times[-1:], *result.times[-1:]])
        raise InputError(
            f"{path}: the results reach {_place(reached, plan)}, {_beyond(plan)}: continuing from the checkpoint up to "
            f"there would remove {rows} rows of the history and {snapshots} snapshots; set a later end (--set "
            f"{plan.axis.key}={reached - plan.axis.start:.6g} or more), choose another folder (-o), or start without "
            "--restart, which moves the results aside"
        )


def _refuse_gap(path: Path, restart: Restart) -> None:
    """Refuse a restart whose results end before the checkpoint."""
    examine(path, deep=False)
    with open_result(path) as result:
        steps = result.history["step"]
        last = int(steps[-1]) if len(steps) else -1
    if last < restart.last[1]:
        raise InputError(
            f"{path}: the history ends at step {last}, before {restart.path}, written after step {restart.step}: they "
            "belong to different runs; restart into another folder (-o), where new results begin at the checkpoint"
        )


def prepare_folder(folder: Path, restart: Restart | None, plan: Plan) -> Path | None:
    """Create the output folder; existing results are moved aside to a numbered name unless a restart continues them.

    On one rank, which holds the lock of the folder. ``plan`` defines the end of the run: results beyond it are not
    truncated.

    Returns
    -------
    The new name of results that were moved aside, or None

    Raises
    ------
    InputError
        If the folder cannot be written, or a restart would lose results.
    """
    aside = None
    try:
        if restart is not None and restart.continues:
            _refuse_other(restart)
            _refuse_gap(folder / RESULT, restart)
            _refuse_loss(folder / RESULT, plan)
            if restart.path.name == PREVIOUS and (folder / NAME).exists():
                # A checkpoint later than the truncated results must not be used as the newest.
                os.replace(folder / NAME, folder / ASIDE)
        elif any((folder / name).exists() for name in (RESULT, NAME, PREVIOUS)):
            if folder.resolve() in (here := Path.cwd().resolve(), *here.parents):
                raise InputError(
                    f"{folder}: holds results, which cannot be moved aside because the current folder is inside; "
                    "give another with -o, or continue them with --restart"
                )
            number = 1
            while (free := folder.with_name(f"{folder.name}.{number}")).exists():
                number += 1
            folder.rename(free)
            aside = free
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot write the results there: {error.strerror}; choose another with -o"
        ) from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot write the results there: permission denied; choose another with -o")
    return aside


def kept_arguments(name: str, folder: Path, restart: bool | Path) -> tuple[list[str], list[str]]:
    """Return the texts ``KEY=VALUE`` and the added plugins of the run that a restart continues. Not collective.

    Parameters
    ----------
    name : of the case; of a run of another case, nothing is kept
    folder : of the output
    restart : True for the newest checkpoint of the folder, else its file or folder

    Raises
    ------
    InputError
        If the checkpoint is missing or damaged.
    """
    path = asked_checkpoint(folder, restart)
    if path is not None:
        with Checkpoint(path, MPI.COMM_SELF) as checkpoint:
            found = checkpoint.attributes
    else:
        # the run may have finished without a checkpoint
        try:
            with open_result(folder / RESULT) as result:
                found = result.attributes
        except InputError:
            return [], []
    if found.get("name") != name:
        return [], []
    overrides, plugins = ([str(text) for text in found.get(key, [])] for key in ("overrides", "plugins"))
    return overrides, plugins


def joined_overrides(kept: Iterable[str], given: Iterable[str]) -> list[str]:
    """Return the kept texts, except for keys that are given again, followed by the given texts."""
    given = list(given)
    keys = {_key(text) for text in given}
    return [*(text for text in kept if _key(text) not in keys), *given]


def joined_plugins(kept: Iterable[str], given: Iterable[str]) -> list[str]:
    """Return the kept files, except those with the name of one that is given again, followed by the given files.

    Raises
    ------
    InputError
        If a kept file is missing.
    """
    given = list(given)
    names = {Path(file).name for file in given}
    left = [file for file in kept if Path(file).name not in names]
    for file in left:
        if not Path(file).is_file():
            raise InputError(
                f"--restart: the run that is continued was given the plugin {file}, which is not there: give the file "
                f"with --plugin .../{Path(file).name}"
            )
    return [*left, *given]


def _key(text: str) -> tuple[str, ...]:
    key = text.partition("=")[0].strip()
    return tuple(split_key(key) or [key])
