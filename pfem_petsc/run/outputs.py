"""All outputs of a run: opened at its start, served after steps in a fixed order, closed at its end."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..case.schema import Case
from ..columns import Fields, Row, declared
from ..errors import EarlyStop, SimulationFailure, printable
from ..mechanics.compiled import Compilation
from ..mechanics.springs import with_connectors
from ..mesh.whole import without_slashes
from ..output.checkpoint import NAME as CHECKPOINT
from ..output.checkpoint import ORIGIN, Checkpoint
from ..output.layout import MODE_VALUES, Constant, Contents, Kept
from ..output.progress import Progress, Span
from ..output.result import RESULT_NAME
from ..output.units import MODE, TIME, duration
from ..output.vtkhdf import ResultWriter
from ..parallel.agreement import agreed_call, on_root
from ..preflight import summarise, warnings_before
from ..restart import Restart, RunState, changed_keys, prepare_folder
from ..signals import early
from ..stepping.model import Model
from ..stepping.stepper import Step, Stepper
from .observers import Checkpointing, Events, History, Observer, RuptureReport, Snapshots, Synchroniser
from .stages import Stages

if TYPE_CHECKING:
    from ..modes.find import Found


_PATIENCE = 2.0
"""Time [s] of compilations up to which nothing is said."""


class ReportedCompilation(Compilation):
    """Reports which loops are compiled, and for how long, while that lasts; excludes the time from the rate of steps.

    Attributes
    ----------
    progress : the progress report of the run; None before it is open, when rank 0 prints unless it is quiet
    """

    def __init__(self, comm: MPI.Comm, quiet: bool) -> None:
        super().__init__(self._report, self._leave_out, _PATIENCE)
        self.progress: Progress | None = None
        self._speaks = comm.rank == 0 and not quiet

    def _report(self, name: str, seconds: float) -> None:
        text = f"compiling loops for this machine, which later runs load: {name}, {duration(seconds)} so far"
        if self.progress is not None:
            self.progress.message(text)
        elif self._speaks:
            print(text, flush=True)

    def _leave_out(self, seconds: float) -> None:
        if self.progress is not None:
            self.progress.compiled(seconds)


MODES_FILE = "modes.vtkhdf"
_PER_LINE = 5


def record_modes(stepper: Stepper, writer: ResultWriter, folder: Path, progress: Progress) -> None:
    """Find the modes of the stepper's state, write and report them. Collective.

    Raises
    ------
    PfemError
        On all ranks.
    """
    from ..modes.find import find_modes

    model, settings = stepper.model, stepper.model.case.modes
    consistent = (settings.mass or model.case.mass) == "consistent"
    found = find_modes(model, stepper.state, settings, consistent)
    writer.write_modes(found.eigenvalues, found.values, found.shapes)
    _write_file(stepper, found, folder)
    for text in _told(found, settings.count):
        progress.message(text)
    if found.kind == "buckling":
        _tell_members(stepper, found, progress)
    for text in found.doubts:
        progress.warning(text)
    if found.negative:
        are = "eigenvalues are" if found.negative > 1 else "eigenvalue is"
        progress.warning(
            f"unstable equilibrium: {found.negative} {are} negative: such a motion grows as exp(2 pi |f| t); its "
            "frequency is given as -|f|"
        )


def _tell_members(stepper: Stepper, found: Found, progress: Progress) -> None:
    """Report the first bar that buckles as a column, which the factors of the truss do not contain. Collective."""
    from ..modes.find import weakest_member

    weakest = weakest_member(stepper.model, found.forces)
    if weakest is None:
        return
    factor, bar = weakest
    text = (
        f"bar {bar} is the first that buckles as a column, at the factor {factor:.6g} (pi^2 E I/(K L)^2 over its force)"
    )
    if not len(found.values) or factor < found.values[0]:
        progress.warning(f"{text}, before the truss does: its factors are for bars that stay straight")
    else:
        progress.message(text)


def _told(found: Found, asked: int) -> list[str]:
    name, unit = MODE_VALUES[found.kind]
    of = "changes of the axial forces by a linear solve" if found.linear else "axial forces"
    head = "natural frequencies" if found.kind == "vibration" else f"buckling: factors of the {of}"
    lines = [f"modes by {found.solver}"]
    if found.at_walls:
        lines.append(
            f"{found.at_walls} nodes are held by walls that press on them: along the normals, by friction and ties in "
            "all directions"
        )
    zeros = int((found.eigenvalues == 0.0).sum())
    if zeros:
        lines.append(f"{zeros} frequencies are zero: rigid-body motions or mechanisms, which no stiffness resists")
    if len(found.values) < asked:
        lines.append(f"{asked} modes are requested, but the state has {len(found.values)}")
    for first in range(0, len(found.values), _PER_LINE):
        numbers = "  ".join(f"{value:.6g}" for value in found.values[first : first + _PER_LINE])
        last = min(first + _PER_LINE, len(found.values))
        which = f"modes {first + 1}-{last}" if last > first + 1 else f"mode {last}"
        lines.append(f"{head}, {which}: {numbers} {unit}".rstrip())
    return lines


def _write_file(stepper: Stepper, found: Found, folder: Path) -> None:
    """Write a separate file for ParaView, with one step per mode, whose time is the number of the mode. Collective."""
    model, state = stepper.model, stepper.state
    name, _ = MODE_VALUES[found.kind]
    case = model.case
    columns = {one: declared(one).dtype for one in ("time", "step", name, "eigenvalue")}
    attributes = {"name": case.name, "folder": str(case.folder.resolve()), "kind": found.kind, "axis": MODE.symbol}
    contents = Contents(["displacement", name], [], columns, case.to_toml(), attributes)
    with ResultWriter(folder / MODES_FILE, model.comm, model.mesh, contents) as writer:
        for k, (value, eigenvalue) in enumerate(zip(found.values, found.eigenvalues, strict=True)):
            row = {"time": float(k + 1), "step": k + 1, name: value, "eigenvalue": eigenvalue}
            writer.append_history(row if model.comm.rank == 0 else None)
            fields = {"displacement": found.shapes[k], name: np.full(len(state.position), value)}
            writer.write_snapshot(float(k + 1), k + 1, state.position, fields, {})


def _wave_times(case: Case, model: Model) -> dict[str, float]:
    """Return the time [s] of a wave through the shortest bar at each wall, and at the supports, of all stages.

    Collective.
    """
    sets: dict[str, list[str | None]] = {}
    for stage in case.stages:
        for wall in stage.wall:
            sets.setdefault(f"wall/{wall.name}/force", []).append(wall.node_set)
        for support in stage.support:
            sets.setdefault("support_force", []).append(support.node_set)
    mesh, bars, found = model.mesh, model.bars, {}
    for column, names in sets.items():
        members = np.zeros((mesh.n_local, 1))
        for name in names:
            members[: mesh.n_owned][slice(None) if name is None else model.nodes[name]] = 1.0
        mesh.update_ghosts(members)
        times = [np.inf]
        for block in bars.blocks:
            own = slice(block.start, block.stop)
            near = (members[bars.ends[own], 0] > 0.0).any(axis=1)
            if block.density > 0.0 and near.any():
                shortest = float(bars.mesh_lengths[own][near].min())
                times.append(shortest * float(np.sqrt(block.density / block.modulus)))
        found[f"wave_time/{column}"] = model.comm.allreduce(min(times), op=MPI.MIN)
    return found


def _constants(model: Model) -> dict[str, Constant]:
    """Return what bars have in all snapshots: section, material, area, and which groups they are in."""
    bars, case = model.bars, with_connectors(model.case)
    sections, materials = list(case.section), list(case.material)
    section = bars.of_blocks(lambda block: sections.index(block.section)).astype(np.int32)
    material = bars.of_blocks(lambda block: materials.index(case.section[block.section].material)).astype(np.int32)
    found = {
        "section": Constant(section, names=sections),
        "material": Constant(material, names=materials),
        "area": Constant(bars.of_blocks(lambda block: block.area), "m²"),
    }
    for name, members in without_slashes(model.mesh.bar_groups).items():
        mask = np.zeros(len(section), dtype=np.uint8)
        mask[members] = 1
        found[f"group:{name}"] = Constant(mask)
    return found


class Outputs:
    """The observers of a run, in the order in which they are served.

    Parameters
    ----------
    stages : Stages
    synchroniser : Synchroniser
    folder : of the results
    quiet : whether to print nothing on stdout
    compilation : ReportedCompilation, which uses the progress report once that is open

    Attributes
    ----------
    fields : of the snapshots
    progress, history, events, ruptures, snapshots, checkpointing : None before :meth:`open`
    """

    def __init__(
        self, stages: Stages, synchroniser: Synchroniser, folder: Path, quiet: bool, compilation: ReportedCompilation
    ) -> None:
        self._stages, self._synchroniser, self._folder, self._quiet = stages, synchroniser, folder, quiet
        self._compilation = compilation
        self.fields = Fields(self._stepper.model, stages.fields)
        self.progress: Progress | None = None
        self.history: History | None = None
        self.snapshots: Snapshots | None = None
        self.checkpointing: Checkpointing | None = None
        self.events: Events | None = None
        self.ruptures: RuptureReport | None = None
        self._observers: tuple[Observer, ...] = ()
        self._callbacks: list[tuple[Callable[[Step], object], int]] = []
        self._writer: ResultWriter | None = None
        self._continues = self._recorded = False
        # of the stage that load cases start from: its history, and the row of its end
        self._origin: tuple[History, Row] | None = None

    @property
    def _stepper(self) -> Stepper:
        return self._stages.stepper

    @property
    def is_open(self) -> bool:
        """Whether results are being written."""
        return self._writer is not None

    def call(self, function: Callable[[Step], object], every: int) -> None:
        """Call a function after each step whose number is a multiple of ``every``."""
        self._callbacks.append((function, every))

    def open(self, restart: Restart | None, notes: list[str]) -> None:
        """Initialise the state, unless it was restored from a checkpoint, and open all outputs. Collective.

        Raises
        ------
        PfemError
            On all ranks.
        """
        stages, folder, plan = self._stages, self._folder, self._stages.plan
        stepper, model = stages.stepper, stages.model
        state = RunState(stepper)
        self._continues = restart is not None and restart.continues
        aside = on_root(model.comm, prepare_folder, folder, restart, plan)
        notes = [*notes, *([] if aside is None else [f"{folder}: earlier results were moved to {aside}"])]
        self.progress = self._compilation.progress = self._open_progress(notes)
        if restart is None:
            stepper.start()
            stepper.leave()
            self._synchroniser.synchronise()
        self._observe(state)
        if restart is not None:
            self.history.ledger.load_state(state.share(restart.file.scalars["ranks"])["ledger"])
            self.history.load_state(restart.file.scalars)
            self.snapshots.load_state(restart.file.scalars)
            self._restore_origin(restart)
            self._tell_restart(restart)
            # the file of modes does not belong to the new end
            on_root(model.comm, (folder / MODES_FILE).unlink, True)
        kept = None
        if self._continues:
            self.checkpointing.last_step = restart.step
            kept = Kept(stepper.number, *restart.last)
        self._write_to(ResultWriter(folder / RESULT_NAME, model.comm, model.mesh, self._contents(), kept))

    def _restore_origin(self, restart: Restart) -> None:
        """Restore the stage that further load cases start from, from its own checkpoint. Collective."""
        stages, path = self._stages, restart.path.with_name(ORIGIN)
        if stages.next_starts_from is None or stages.model.case.starts_from is None:
            return
        file = Checkpoint(path, stages.comm)
        changed_keys(path, file.attributes["case"], stages.case.to_dict(), stages.case.source)
        scalars, stepper = file.scalars, stages.make_origin()
        state = RunState(stepper)
        state.restore(file, stages.case.source)
        history = History(stages, self._synchroniser, self.progress.warning, stepper)
        history.ledger.load_state(state.share(scalars["ranks"])["ledger"])
        history.load_state(scalars)
        self._origin = history, history.recorder.row()
        stepper.settle()
        if not self._continues:
            on_root(stages.comm, shutil.copyfile, path, self._folder / ORIGIN)

    def _open_progress(self, notes: Iterable[str]) -> Progress:
        """Open the progress report and write summary, warnings and notes. Collective."""
        stages, plan = self._stages, self._stages.plan
        case, model, stepper = stages.case, stages.model, stages.stepper
        progress = Progress(
            model.comm,
            printable(case.title),
            Span(plan.steps, plan.end or 0.0, stepper.axis, stepper.number, stepper.place),
            self._quiet,
            self._folder / "log.txt",
        )
        progress.summary(summarise(case, model, plan))
        warnings = warnings_before(model.case, model, stages.stepper.plan)
        for warning in model.warnings + warnings:
            progress.warning(warning)
        for text in (*([plan.scheme.notice] if plan.scheme.notice else []), *notes):
            progress.message(text)
        return progress

    def _tell_restart(self, restart: Restart) -> None:
        """Report from where the run continues, what has changed, and missing functions. Collective."""
        stepper, functions = self._stepper, self._stages.model.external.functions
        place = f"step {stepper.number}, {stepper.axis.place(stepper.place)}"
        changes = f"; changed: {'; '.join(restart.changed)}" if restart.changed else ""
        self.progress.message(f"restart from {restart.path}: {place}{changes}")
        before = int(restart.file.attributes.get("external_functions", 0))
        if before != functions:
            self.progress.warning(
                f"{restart.path}: the run had {before} function{'s' * (before != 1)} for forces, and this one has "
                f"{functions}: functions are not in checkpoints; register them by Simulation.external_force before the "
                "run"
            )

    def _contents(self) -> Contents:
        """Return what the result file is made for. Collective."""
        stages, plan, recorder = self._stages, self._stages.plan, self.history.recorder
        case, model = stages.case, stages.model
        attributes: dict[str, Any] = {
            "name": case.name,
            "folder": str(case.folder.resolve()),
            "overrides": list(case.overrides),
            "plugins": list(case.added),
            "axis": TIME.symbol if case.stage else plan.axis.symbol,
            "time_step": plan.step,
            "linear_solver": plan.linear.why if plan.linear is not None else "none",
            "partitioner": model.mesh.partitioner,
        }
        if case.stage:
            attributes["stages"] = [stage.name for stage in case.stage]
        if plan.steps is not None:
            attributes["steps"] = plan.steps
        attributes |= {f"probe_nodes/{name}": nodes.tolist() for name, nodes in recorder.probe_nodes.items()}
        attributes |= {f"probe_bars/{name}": bars.tolist() for name, bars in recorder.probe_bars.items()}
        return Contents(
            self.fields.points,
            self.fields.cells,
            recorder.columns,
            case.to_toml(),
            attributes | _wave_times(case, model),
            {name: np.dtype(kind) for name, kind in stages.events.items()},
            case.modes.kind if case.modes is not None else None,
            case.output.precision,
            case.output.compression == "gzip",
            _constants(model),
        )

    def _write_to(self, writer: ResultWriter) -> None:
        self._writer = self.history.writer = self.events.writer = self.snapshots.writer = writer
        self._recorded = True

    def _observe(self, state: RunState) -> None:
        """Make the observers of the present stage. Collective."""
        stages, stepper, warn, tell = self._stages, self._stepper, self.progress.warning, self.progress.message
        self.history = History(stages, self._synchroniser, warn)
        if hasattr(stepper, "message"):
            stepper.message = warn
        self.events = Events(stepper, tell)
        self.ruptures = RuptureReport(stepper, self.history, tell)
        self.snapshots = Snapshots(stepper, self.fields, warn)
        saved = self.history, self.snapshots, self._synchroniser
        self.checkpointing = Checkpointing(stages, self._folder / CHECKPOINT, state, *saved)
        self._observers = self.history, self.events, self.ruptures, self.snapshots, self.checkpointing

    def begin_stage(self) -> None:
        """End the current stage with a row and a snapshot, and begin the next. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, where the next stage cannot begin in the present state.
        """
        stages, history, snapshots, last_step = self._stages, self.history, self.snapshots, self.checkpointing.last_step
        self._complete_stage()
        self.tell_remarks()
        source, row = self._origin or (history, history.recorder.row())
        if self._origin is None and stages.next_starts_from is not None:
            self._origin = source, row
            self.checkpointing.write_state(self._folder / ORIGIN)
        ended = f"step {self._stepper.number}, {self._stepper.axis.place(self._stepper.place)}"
        handed = stages.advance()
        stepper = stages.stepper
        self.progress.message(
            f"stage {stages.model.case.name!r} ({stages.number + 1} of {len(stages.case.stage)}) begins after {ended}"
        )
        self.progress.axis = stepper.axis
        self.fields = Fields(stages.model, stages.fields)
        self._observe(RunState(stepper))
        self.checkpointing.last_step = last_step
        self.history.begin_stage(history, source, row, handed)
        self._write_to(self._writer)
        self.snapshots.load_state(snapshots.kept())
        stepper.leave()  # with the ledger, as equilibria after bars have gone take work

    def _complete_stage(self) -> None:
        """The row and the snapshot of the last step of a stage."""
        self.history.complete()
        self.ruptures.complete()
        self.snapshots.complete()

    def record_start(self) -> None:
        """Record the first row and snapshot, unless the continued results contain them. Collective."""
        if not self._continues:
            self.history.record()
            self.snapshots.observe()

    def after(self, made: Step) -> Step:
        """Serve the observers that are due after a step; return the step with its row. Collective."""
        step, synchroniser = made.step, self._synchroniser
        last = self._stepper.state.step == self._stepper.last_step
        history, *others = self._observers
        recorded = history.due(step)
        if recorded:
            history.observe()
        elif last or any(observer.needs_agreement and observer.due(step) for observer in others):
            synchroniser.synchronise()
        if synchroniser.due(step):
            synchroniser.synchronise()
        for observer in others:
            if observer.due(step):
                observer.observe()
        if last and self._stages.at_last:
            self.complete()
        elif last:
            self._complete_stage()
        if history.row["step"] == step:
            made = made._replace(row=history.row)
        size, contacts = self._stepper.h, history.row["active_contacts"]
        self.progress.update(step, made.time, size, made.newton, made.linear, contacts, history.drift)
        for function, every in self._callbacks:
            if step % every == 0:
                self.wait()
                with agreed_call(self._stages.comm, f"step {step}: on_step"):
                    function(made)
        return made

    def wait(self) -> None:
        """Wait until the last snapshot is in the file, for those who may read it. Collective."""
        if self._writer is not None:
            self._writer.wait()

    def steps_left(self, step: int) -> int:
        """Return the number of steps until an observer must act or the ranks synchronise."""
        left = [observer.steps_left(step) for observer in self._observers]
        left += [every - step % every for _, every in self._callbacks]
        return min(self._synchroniser.steps_left(step), *left)

    def stop_early(self) -> None:
        """Stop with a checkpoint if the ranks have agreed to stop, unless the run is at its end. Collective.

        Raises
        ------
        EarlyStop
            On all ranks.
        """
        code, stepper = self._synchroniser.request, self._stepper
        if not code or (self._stages.at_last and stepper.state.step >= stepper.last_step):
            return
        self.checkpointing.observe()
        place = stepper.axis.exact(stepper.place)
        raise EarlyStop(
            f"{self._synchroniser.stop.reason(code)}; step {stepper.number} is finished, {place}, and "
            f"a checkpoint written: continue with --restart (results in {self._folder})"
        )

    def complete(self) -> None:
        """Write the last checkpoint, row and snapshot of the run. Collective.

        The checkpoint precedes a row and a snapshot that are off their schedule, so that a run extended to a later end
        continues as if they had not been written.
        """
        for observer in (self.checkpointing, self.history, self.ruptures, self.snapshots):
            observer.complete()

    def record_modes(self) -> None:
        """Find and write the modes of the state at the end, where the case asks for them. Collective.

        Raises
        ------
        EarlyStop
            On all ranks, if a request to stop has come before.
        PfemError
            On all ranks.
        """
        if self._stepper.model.case.modes is None or not self.is_open:
            return
        code, stop = self._synchroniser.synchronise(), self._synchroniser.stop
        if code and self._stepper.state.step:
            if not self.checkpointing.at_end:
                self.checkpointing.observe()
            raise EarlyStop(
                f"{stop.reason(code)}; the last step is finished, a checkpoint is written, and the modes are not "
                f"computed: continue with --restart (results in {self._folder})"
            )
        self._writer.flush_history()
        # the libraries for eigenvalues do not return to look at requests: from here on a signal ends the program
        stop.release()
        early().release()
        record_modes(self._stepper, self._writer, self._folder, self.progress)

    def tell_remarks(self) -> None:
        """Report the observers' remarks, such as walls that were never touched, and doubtful results. Collective."""
        for observer in self._observers:
            for text in observer.remarks():
                self.progress.message(text)
        for text in self.snapshots.doubts() if self._stages.at_last else ():
            self.progress.message(text)
        for text in self._stepper.doubts():
            self.progress.warning(text)

    def close(self, outcome: str) -> None:
        """Close the result file; the progress report stays open. Collective."""
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.close()
        except SimulationFailure:
            # after a failure, the first failure is reported
            if outcome == "done":
                raise

    def leave(self, outcome: str, error: BaseException | None = None) -> None:
        """Close the progress report, with the ``error`` that ended the run. Not collective."""
        if self.progress is not None:
            reached = (self._stepper.number, self._stepper.place) if outcome == "failed" else None
            self.progress.close(outcome, reached, error, self._folder if self._recorded else None)
