"""Everything that determines the future of a run, as arrays and numbers of a checkpoint.

Nodal arrays are those of the state, of the scheme's memory and of the stepper. Bar arrays are the data that material
laws keep, each variable under its name, thermal strains and prescribed rest lengths. Internal forces and energies are
saved rather than recomputed, because for a yielding bar a second evaluation may differ in the last digit. Sums of each
rank (works, energies, wall forces) are saved rank by rank and restored on the same number of ranks; on another number,
rank 0 gets the totals.

Where the data are stored:

- Arrays of the state: positions, velocities, accelerations, forces, and the scheme's memory (including tied nodes and
  changes by a treatment of impact).
- Arrays of the stepper: contacts with walls, nodes in contact in the last step, positions of the lagged preconditioner.
- Numbers of the stepper: level of bisection, part and smallest part of the step, counts of the lagged preconditioner.
- Arrays of the bars: data of the laws, thermal strains, rest lengths, history of the lagged preconditioner.
- ``free_walls``: walls with mass, including their last increment. Forces of pairs and
  constraints, and which of them are closed: arrays of their rows; with rows that come and go, the rows themselves.
- ``self_contact``: pairs of bars that touch, with their stiffness and memory. Which others are near each other is found
  again; results do not depend on when.
- ``ranks``: works and energies. Recorder: energy at the start, largest energy, iterations since the last row.
  ``blow_up``: suspicious rows, energy input, energies of the first row. Contact log: contact times and impulses.
- Attributes (plan): time step and linear solver.

Newton's method, Krylov methods, candidates for contact and friction start from scratch in each step. Data that depend
on wall-clock time (synchronisation, progress, wall time) start from scratch in each run and do not affect the results.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from .case.toml import short_text, split_key
from .errors import InputError
from .files import move_aside
from .mechanics.bars import StrainEnergy
from .mesh.exchange import Router
from .mesh.slab import slab_of
from .output.checkpoint import NAME, PREVIOUS, Checkpoint, asked_checkpoint
from .output.integrity import checksum, examine
from .output.result import RESULT_NAME as RESULT
from .output.result import open_result
from .output.units import engineering
from .parallel.agreement import on_root
from .parallel.natural import NaturalOrder
from .stepping.model import StageStart
from .tolerances import TIME

if TYPE_CHECKING:
    from .case.schema import Case
    from .stepping.plan import Plan
    from .stepping.stepper import Stepper

STATE_VERSION = 10
"""Changed with the meaning of what is saved."""

_MEMORY = "memory."
_KEPT = "stepper."
_LAW = "law."
_STAGE = "stage."


class RunState:
    """Collects and restores the state of a run. Construction is collective.

    Parameters
    ----------
    stepper : Stepper
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.comm, self.mesh = self.model.comm, self.model.mesh

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """Return name to (order, rows owned by this rank) of all arrays; the same names on all ranks."""
        own = self._node_arrays()
        # arrays of a scheme or a treatment may exist only on some ranks
        kinds: dict[str, tuple[tuple[int, ...], str]] = {}
        for other in self.comm.allgather({name: (array.shape[1:], array.dtype.str) for name, array in own.items()}):
            kinds |= other
        for name in kinds.keys() - own.keys():
            shape, kind = kinds[name]
            own[name] = np.zeros((self.mesh.n_owned, *shape), dtype=kind)
        nodes = {name: (self.mesh.node_order, own[name]) for name in sorted(kinds)}
        bars = {name: (self.mesh.bar_order, array[self.mesh.counted]) for name, array in self._bar_arrays().items()}
        touch = self.model.self_contact
        return {**nodes, **bars, **self.model.links.arrays(), **({} if touch is None else touch.arrays())}

    def scalars(
        self, ledger: Mapping[str, Any], history: Mapping[str, Any], snapshots: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the numbers, with what this rank's ledger, the history and the snapshots keep. Collective."""
        stepper, energy, walls = self.stepper, self.stepper.energy, self.stepper.solution.walls
        mine = {
            "ledger": ledger,
            "energy": list(energy.energies),
            "walls": {name: getattr(walls, name).tolist() for name in walls.sums},
            "contact_log": self.model.contact.log.share(),
            "contacts": int(stepper.solution.contacts),
        }
        memories = self.comm.allgather(sorted(stepper.state.memory))
        return {
            "step": stepper.number,
            "time": stepper.state.time,
            "stepper": {name: getattr(stepper, name) for name in stepper.kept_numbers},
            **{name: kept for name, kept in history.items() if name != "row"},
            **self.model.links.numbers(),
            **({} if (touch := self.model.self_contact) is None else {"self_contact": touch.numbers()}),
            "free_walls": self.model.contact.motion.bodies.kept(),
            "contact_times": self.model.contact.log.times(self.comm),
            "row": history["row"],
            **snapshots,
            "node_arrays": sorted(set().union(*self.comm.allgather(set(self._node_arrays())))),
            "memories": memories,
            "bar_arrays": sorted(self._bar_arrays()),
            "ranks": self.comm.allgather(mine),
        }

    @cached_property
    def mesh_mark(self) -> int:
        """Checksum of coordinates and bar ends, the same on any number of ranks. Collective at first use."""
        mesh, nodes, bars = self.mesh, self.mesh.node_order, self.mesh.bar_order
        points = nodes.to_slab(mesh.points[: mesh.n_owned])
        ends = mesh.node_ids[mesh.bars[mesh.counted]].astype(np.int64, copy=False).reshape(-1, 2)
        return checksum(self.comm, points, nodes.first) ^ checksum(self.comm, bars.to_slab(ends), bars.first)

    def restore(self, file: Checkpoint, source: str) -> None:
        """Restore the stepper from a checkpoint, instead of its ``start``, and close the file. Collective.

        ``source``: the case's file, for the message

        Raises
        ------
        InputError
            On all ranks, if the checkpoint is damaged or belongs to another mesh: the content of a mesh file may have
            changed.
        """
        if file.attributes.get("mesh_mark") != self.mesh_mark:
            raise InputError(
                f"{file.path}: the mesh of {source} is not the one that it was written with (other nodes or bars): "
                "restore the mesh, or start without --restart"
            )
        arrays = file.read(self.orders(file.scalars))
        file.close()
        self._load_state(file.scalars, arrays)

    def orders(self, scalars: dict[str, Any]) -> dict[str, NaturalOrder]:
        """Return the orders of the arrays of a checkpoint with these numbers: nodal rows by owner, bars in slabs."""
        mine = self.mesh.bar_order
        bars = NaturalOrder(self.comm, np.arange(mine.first, mine.first + mine.count), self.mesh.n_bars)
        orders = dict.fromkeys(scalars["node_arrays"], self.mesh.node_order)
        orders |= dict.fromkeys(scalars["bar_arrays"], bars)
        orders |= self.model.links.orders(scalars.get("rows"))
        touch = self.model.self_contact
        return orders | ({} if touch is None else touch.orders(scalars["self_contact"]))

    def _load_state(self, scalars: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        stepper, state, owned = self.stepper, self.stepper.state, self.mesh.n_owned
        if scalars.get("stage") is not None and scalars["stage"]["start"] is not None:
            held = {name.removeprefix(_STAGE): a for name, a in arrays.items() if name.startswith(_STAGE)}
            self.model.begin_stage(StageStart.restored(scalars["stage"]["start"], held))
        for name in scalars["node_arrays"]:
            values = arrays[name]
            if name.startswith(_STAGE):
                continue
            if name.startswith(_MEMORY):
                state.memory[name.removeprefix(_MEMORY)] = values.copy()
            elif name.startswith(_KEPT):
                name = name.removeprefix(_KEPT)
                setattr(stepper, name, values.astype(getattr(stepper, name).dtype))
            elif name in ("x", "f"):
                getattr(state, name)[:owned] = values
            else:
                # not in place: an absent force may be a shared array
                setattr(state, name, values.copy())
        if len(scalars["memories"]) == self.comm.size:
            mine = scalars["memories"][self.comm.rank]
            state.memory = {name: array for name, array in state.memory.items() if name in mine}
        self.mesh.update_ghosts(state.x)
        self._load_bars({name: arrays[name] for name in scalars["bar_arrays"]})
        state.step, state.time = int(scalars["step"]) - self.model.first_step, float(scalars["time"])
        for name, value in scalars["stepper"].items():
            setattr(stepper, name, value)
        mine = self.share(scalars["ranks"])
        stepper.energy = StrainEnergy(tuple(float(value) for value in mine["energy"]))
        walls = stepper.solution.walls
        like = {name: getattr(walls, name) for name in mine["walls"]}
        sums = {n: np.array(mine["walls"][n], dtype=a.dtype).reshape(a.shape) for n, a in like.items()}
        stepper.solution.walls = dataclasses.replace(walls, **sums)
        stepper.solution.contacts = int(mine["contacts"])
        self.model.contact.motion.bodies.load_state(scalars["free_walls"])
        self.model.links.load_state(arrays)
        if self.model.self_contact is not None:
            dissipated = stepper.energy.of("self_contact_dissipation")
            self.model.self_contact.load_state(scalars["self_contact"], arrays, state.position, dissipated)
        self.model.contact.log.load_state(mine["contact_log"], scalars["contact_times"], stepper.touching)
        stepper.resume()

    def share(self, ranks: list[dict[str, Any]]) -> dict[str, Any]:
        """Return this rank's share of the sums: its own on the same number of ranks, else all on rank 0."""
        if len(ranks) == self.comm.size:
            return ranks[self.comm.rank]
        return _summed(ranks) if self.comm.rank == 0 else _summed(ranks[:1], 0.0)

    def _node_arrays(self) -> dict[str, np.ndarray]:
        """Return the rows of owned nodes, by name, of every array of the state, including any added later."""
        state, owned = self.stepper.state, self.mesh.n_owned
        fields = {item.name: getattr(state, item.name) for item in dataclasses.fields(state)}
        found = {name: value[:owned] for name, value in fields.items() if isinstance(value, np.ndarray)}
        found |= {_MEMORY + name: array for name, array in state.memory.items()}
        kept = {name: getattr(self.stepper, name) for name in self.stepper.kept_arrays}
        found |= {_KEPT + name: a.astype(np.uint8) if a.dtype == bool else a for name, a in kept.items()}
        if self.model.start is not None:
            found |= {_STAGE + name: array for name, array in self.model.start.arrays().items()}
        # a case without walls has no columns for them
        return {name: array for name, array in found.items() if 0 not in array.shape[1:]}

    def _bar_arrays(self) -> dict[str, np.ndarray]:
        """Return the rows of all local bars, by name."""
        bars = self.model.bars
        found = {}
        if bars.kept_names:
            found |= {_LAW + name: values for name, values in zip(bars.kept_names, bars.history().T, strict=True)}
        if self.model.temperatures.any:
            found |= {"thermal_strain": bars.heat[0], "temperature": self.model.temperatures.values}
        if self.model.rest_lengths.any:
            found["rest_length"] = bars.rest
        kept = {_KEPT + name: getattr(self.stepper, name) for name in self.stepper.kept_bars}
        return found | {name: array for name, array in kept.items() if array.shape[1]}

    def _load_bars(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore the bar arrays; bars evaluated on two ranks get the same values on both."""
        mesh, bars = self.mesh, self.model.bars
        asking = Router(self.comm, slab_of(mesh.bar_ids, mesh.n_bars, self.comm.size))
        asked = asking.send(mesh.bar_ids) - self.mesh.bar_order.first
        history = bars.history()
        for name, array in arrays.items():
            values = asking.reply(array[asked])
            if name.startswith(_LAW):
                history[:, bars.kept_names.index(name.removeprefix(_LAW))] = values
            elif name == "rest_length":
                bars.rest = np.array(values).reshape(len(bars.ends))
            elif name.startswith(_KEPT):
                setattr(self.stepper, name.removeprefix(_KEPT), values)
            else:
                {"thermal_strain": bars.heat[:1], "temperature": bars.heat[1:]}[name][:] = values
        bars.put_history(history)
        self.model.temperatures.hold(bars.heat)


def _summed(shares: list[Any], factor: float = 1.0) -> Any:
    """Return sums over ranks, times a factor, in the same nested dictionaries."""
    if isinstance(shares[0], dict):
        return {name: _summed([share[name] for share in shares], factor) for name in shares[0]}
    return factor * sum(np.array(share) for share in shares)


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


def _refuse_loss(path: Path, restart: Restart, plan: Plan) -> None:
    """Refuse a restart whose results end before the checkpoint, or would be truncated beyond the end of the run."""
    examine(path, deep=False)
    with open_result(path) as result:
        steps, times = result.history["step"], result.history["time"]
    last = int(steps[-1]) if len(steps) else -1
    if last < restart.last[1]:
        raise InputError(
            f"{path}: the history ends at step {last}, before {restart.path}, written after step {restart.step}: they "
            "belong to different runs; restart into another folder (-o), where new results begin at the checkpoint"
        )
    rows, snapshots = (int(plan.beyond(numbers).sum()) for numbers in (times, result.times))
    if rows or snapshots:
        reached = max([*times[-1:], *result.times[-1:]])
        raise InputError(
            f"{path}: the results reach {_place(reached, plan)}, {_beyond(plan)}: continuing from the checkpoint up to "
            f"there would remove {rows} rows of the history and {snapshots} snapshots; set a later end (--set "
            f"{plan.axis.key}={reached - plan.axis.start:.6g} or more), choose another folder (-o), or start without "
            "--restart, which moves the results aside"
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
            with Checkpoint(restart.path, MPI.COMM_SELF) as present:
                replaced = present.digest != restart.file.digest
            if replaced:  # before this one got the lock
                raise InputError(
                    f"{restart.path}: another run has overwritten this checkpoint while this one was set up: nothing "
                    "is changed; start again with --restart"
                )
            _refuse_loss(folder / RESULT, restart, plan)
            if restart.path.name == PREVIOUS and (folder / NAME).exists():
                # A checkpoint later than the truncated results must not be used as the newest.
                os.replace(folder / NAME, folder / ASIDE)
        elif any((folder / name).exists() for name in (RESULT, NAME, PREVIOUS)):
            if folder.resolve() in (here := Path.cwd().resolve(), *here.parents):
                raise InputError(
                    f"{folder}: holds results, which cannot be moved aside because the current folder is inside; "
                    "give another with -o, or continue them with --restart"
                )
            aside = move_aside(folder)
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
