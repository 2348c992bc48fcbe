"""All outputs of a run: opened at its start, served after steps in a fixed order, closed at its end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..analysis import Analysis, Step
from ..errors import EarlyStop, SimulationFailure
from ..output.progress import Progress
from ..output.vtkhdf import ResultWriter
from ..recording.checkpointing import Checkpointing
from ..recording.events import Events
from ..recording.fields import Fields
from ..recording.history import History
from ..recording.observer import Callback, Observer
from ..recording.report import ProgressReport
from ..recording.ruptures import RuptureReport
from ..recording.snapshots import Snapshots
from ..restart.checkpoints import Checkpoints
from ..restart.folder import Restart, prepare_folder
from ..signals import early
from ..stepping.fused_steps import Batches
from .compilation import ReportedCompilation
from .modes import record_modes, remove_modes
from .opening import open_progress, open_result_file
from .resuming import resume_observers, tell_restart
from .stages import Stages
from .synchroniser import Synchroniser

__all__ = ["Outputs"]


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
        self.fields = self._fields()
        self.progress: Progress | None = None
        self.history: History | None = None
        self.snapshots: Snapshots | None = None
        self.checkpointing: Checkpointing | None = None
        self.events: Events | None = None
        self.ruptures: RuptureReport | None = None
        self._report: ProgressReport | None = None
        self._callbacks: list[Callback] = []
        self._writer: ResultWriter | None = None
        self._continues = False

    @property
    def _analysis(self) -> Analysis:
        return self._stages.analysis

    def _fields(self) -> Fields:
        names = self._stages.fields
        return Fields(self._analysis.model, None if names is None else [*names[0], *names[1]])

    @property
    def is_open(self) -> bool:
        """Whether results are being written."""
        return self._writer is not None

    @property
    def _recording(self) -> tuple[Observer, ...]:
        return self.history, self.events, self.ruptures, self.snapshots, self.checkpointing

    @property
    def _observers(self) -> tuple[Observer, ...]:
        return *self._recording, self._report, *self._callbacks

    def call(self, function: Callable[[Step], object], every: int) -> None:
        """Call a function after each step whose number is a multiple of ``every``."""
        self._callbacks.append(Callback(function, every))

    def open(self, restart: Restart | None, notes: list[str]) -> None:
        """Initialise the state, or restore it from a checkpoint, and open all outputs. Collective.

        Raises
        ------
        PfemError
            On all ranks.
        """
        analysis, folder = self._analysis, self._folder
        case, stepper, model, plan = self._stages.case, analysis.stepper, analysis.model, self._stages.plan
        checkpoints = Checkpoints(case, stepper, plan, folder)
        if restart is not None:
            # before any change to the folder, because the checkpoint may be refused
            checkpoint = checkpoints.restore(restart)
        aside = prepare_folder(model.comm, folder, restart, plan)
        notes = [*notes, *([] if aside is None else [f"{folder}: earlier results were moved to {aside}"])]
        start = stepper.number, stepper.place
        self.progress = open_progress(case, model, plan, start, folder, self._quiet, notes)
        self._compilation.progress = self.progress
        if restart is None:
            analysis.start()
            self._synchroniser.synchronise()
        self._observe(checkpoints)
        history = self.history
        if restart is not None:
            self._continues = restart.continues
            resume_observers(restart, checkpoint, checkpoints, history, self.snapshots)
            place = f"step {start[0]}, {plan.axis.place(start[1])}"
            tell_restart(restart, self.progress, place, model.external.functions)
            remove_modes(folder, model.comm)
        events = self._stages.events
        self._writer = open_result_file(case, model, plan, history, self.fields, events, folder, restart, start[0])
        history.writer = self.events.writer = self.snapshots.writer = self._writer

    def _observe(self, checkpoints: Checkpoints) -> None:
        """Make the observers of the present stage. Collective."""
        analysis, warn = self._analysis, self.progress.warning
        stepper = analysis.stepper
        self.history = History(stepper, analysis.plan, self._synchroniser, warn, self._stages.columns)
        if hasattr(stepper, "message"):
            stepper.message = warn
        self.events = Events(stepper, self.progress.message)
        self.ruptures = RuptureReport(stepper, self.history, self.progress.message)
        self.snapshots = Snapshots(analysis, self.fields, warn)
        self.checkpointing = Checkpointing(checkpoints, self.history, self.snapshots, self._synchroniser)
        self._report = ProgressReport(self.progress, analysis, self.history)

    def begin_stage(self) -> None:
        """End the current stage with a row and a snapshot, and begin the next. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, where the next stage cannot begin in the present state.
        """
        stages, history, snapshots, last = self._stages, self.history, self.snapshots, self.checkpointing.last_step
        writer = self._writer
        self._complete_stage()
        self.tell_remarks()
        row = history.end_of_stage()
        kick = stages.advance()
        stepper = stages.analysis.stepper
        name, number = stepper.model.case.name, stages.number
        self.progress.message(
            f"stage {name!r} ({number + 1} of {len(stages.case.stage)}) begins after step {stepper.number}, "
            f"{stages.plan.axis.place(stepper.place)}"
        )
        self._synchroniser.follow(stages.analysis)
        self.fields = self._fields()
        checkpoints = Checkpoints(stages.case, stepper, stages.plan, self._folder)
        checkpoints.last_step = last
        self._observe(checkpoints)
        self.history.go_on(history, row, kick)
        self.events.writer = self.snapshots.writer = writer
        self.snapshots.load_state(snapshots.kept())

    def _complete_stage(self) -> None:
        """The row and the snapshot of the last step of a stage."""
        self.history.complete()
        self.ruptures.complete()
        self.snapshots.complete()

    def record_start(self) -> None:
        """Record the first row and snapshot, unless the continued results contain them. Collective."""
        if not self._continues:
            self.history.record()
            self.snapshots.write()

    def after(self, made: Step) -> Step:
        """Serve the observers that are due after a step; return the step with its row. Collective."""
        step, synchroniser = made.step, self._synchroniser
        last = self._analysis.state.step == self._analysis.last_step
        history, *others = self._recording
        recorded = history.due(step)
        if recorded:
            history.observe(made)
        elif last or any(observer.needs_agreement and observer.due(step) for observer in others):
            synchroniser.synchronise()
        if synchroniser.due(step):
            synchroniser.synchronise()
        for observer in others:
            if observer.due(step):
                observer.observe(made)
        if last and self._stages.at_last:
            self.complete()
        elif last:
            self._complete_stage()
        if recorded or last:
            made = made._replace(row=history.row)
        for observer in (self._report, *self._callbacks):
            if observer.due(step):
                observer.observe(made)
        return made

    def steps_left(self, step: int) -> int:
        """Return the number of steps until an observer must act or the ranks synchronise."""
        return min(self._synchroniser.steps_left(step), *(each.steps_left(step) for each in self._observers))

    def advance_together(self, batches: Batches) -> None:
        """Fuse the steps that need only rows of the history, if possible. Collective.

        Raises
        ------
        SimulationFailure
            As for a single step.
        """
        left = self.steps_left(self._analysis.stepper.number)
        if not batches.advance(self._analysis, self.history, left):
            self._synchroniser.synchronise()

    def stop_early(self) -> None:
        """Stop with a checkpoint if the ranks have agreed to stop, unless the run is at its end. Collective.

        Raises
        ------
        EarlyStop
            On all ranks.
        """
        code, analysis = self._synchroniser.request, self._analysis
        if not code or (self._stages.at_last and analysis.state.step >= analysis.last_step):
            return
        self.checkpointing.write()
        place = self._stages.plan.axis.exact(analysis.stepper.place)
        raise EarlyStop(
            f"{self._synchroniser.stop.reason(code)}; step {analysis.stepper.number} is finished, {place}, and "
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
        if self._analysis.model.case.modes is None or not self.is_open:
            return
        code, stop = self._synchroniser.synchronise(), self._synchroniser.stop
        if code and self._analysis.state.step:
            if not self.checkpointing.at_end:
                self.checkpointing.write()
            raise EarlyStop(
                f"{stop.reason(code)}; the last step is finished, a checkpoint is written, and the modes are not "
                f"computed: continue with --restart (results in {self._folder})"
            )
        self._writer.flush_history()
        # the libraries for eigenvalues do not return to look at requests: from here on a signal ends the program
        stop.release()
        early().release()
        record_modes(self._analysis.stepper, self._writer, self._folder, self.progress)

    def tell_remarks(self) -> None:
        """Report the observers' remarks, such as walls that were never touched, and doubtful results. Collective."""
        for observer in self._observers:
            for text in observer.remarks():
                self.progress.message(text)
        for text in (self.snapshots.doubts() if self._stages.at_last else []) + self._analysis.stepper.doubts():
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

    def leave(self, outcome: str) -> None:
        """Close the progress report. Not collective."""
        if self.progress is not None:
            self.progress.close(outcome)
