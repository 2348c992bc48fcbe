"""All outputs of a run: opened at its start, served after steps in a fixed order, closed at its end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..analysis import Step
from ..errors import EarlyStop, SimulationFailure
from ..output.progress import Progress
from ..output.vtkhdf import ResultWriter
from ..recording.checkpointing import Checkpointing
from ..recording.events import Events
from ..recording.fields import Fields
from ..recording.history import History
from ..recording.observer import Callback, Observer
from ..recording.report import ProgressReport
from ..recording.snapshots import Snapshots
from ..restart.checkpoints import Checkpoints
from ..restart.folder import Restart, prepare_folder
from ..stepping.fused_steps import Batches
from ..stepping.time_stepping import TimeStepping
from .compilation import ReportedCompilation
from .modes import record_modes, remove_modes
from .opening import open_progress, open_result_file
from .synchroniser import Synchroniser

__all__ = ["Outputs"]


class Outputs:
    """The observers of a run, in the order in which they are served.

    Parameters
    ----------
    analysis : TimeStepping
    synchroniser : Synchroniser
    folder : of the results
    quiet : whether to print nothing on stdout
    compilation : ReportedCompilation, which uses the progress report once that is open

    Attributes
    ----------
    fields : of the snapshots
    progress, history, events, snapshots, checkpointing : None before :meth:`open`
    """

    def __init__(
        self,
        analysis: TimeStepping,
        synchroniser: Synchroniser,
        folder: Path,
        quiet: bool,
        compilation: ReportedCompilation,
    ) -> None:
        self._analysis, self._synchroniser, self._folder, self._quiet = analysis, synchroniser, folder, quiet
        self._compilation = compilation
        self.fields = Fields(analysis.model)
        self.progress: Progress | None = None
        self.history: History | None = None
        self.snapshots: Snapshots | None = None
        self.checkpointing: Checkpointing | None = None
        self.events: Events | None = None
        self._report: ProgressReport | None = None
        self._callbacks: list[Callback] = []
        self._writer: ResultWriter | None = None
        self._continues = False

    @property
    def is_open(self) -> bool:
        """Whether results are being written."""
        return self._writer is not None

    @property
    def _recording(self) -> tuple[Observer, ...]:
        return self.history, self.events, self.snapshots, self.checkpointing

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
        stepper, model, plan = analysis.stepper, analysis.model, analysis.plan
        checkpoints = Checkpoints(model.case, stepper, plan, folder)
        if restart is not None:
            # before any change to the folder, because the checkpoint may be refused
            checkpoint = checkpoints.restore(restart)
        aside = prepare_folder(model.comm, folder, restart, plan)
        notes = [*notes, *([] if aside is None else [f"{folder}: held results, which are in {aside} now"])]
        start = analysis.state.step, analysis.state.time
        self.progress = open_progress(model, plan, start, folder, self._quiet, notes)
        self._compilation.progress = self.progress
        if restart is None:
            analysis.start()
            self._synchroniser.synchronise()
        warn = self.progress.warning
        self.history = history = History(stepper, plan, self._synchroniser, warn)
        if hasattr(stepper, "message"):
            stepper.message = warn
        self.events = Events(stepper, self.progress.message)
        self.snapshots = Snapshots(analysis, self.fields, warn)
        self.checkpointing = Checkpointing(checkpoints, history, self.snapshots, self._synchroniser)
        self._report = ProgressReport(self.progress, analysis, history)
        if restart is not None:
            self._continues = restart.continues
            sums = history.ledger, history.recorder, history.blow_up
            history.row = checkpoints.state.load_sums(checkpoint, *sums)
            self.snapshots.last = restart.last[0]
            history.contact_watch.start = history.recorder.start_energy
            changes = f"; changed: {'; '.join(restart.changed)}" if restart.changed else ""
            place = f"step {start[0]}, {plan.axis.place(start[1])}"
            self.progress.message(f"restart from {restart.path}: {place}{changes}")
        if restart is not None:
            remove_modes(folder, model.comm)
        self._writer = open_result_file(model, plan, history.recorder, self.fields, folder, restart, start[0])
        history.writer = self.events.writer = self.snapshots.writer = self._writer

    def record_start(self) -> None:
        """Record the first row and snapshot, unless the continued results contain them. Collective."""
        if not self._continues:
            self.history.record()
            self.snapshots.write()

    def after(self, made: Step) -> Step:
        """Serve the observers that are due after a step; return the step with its row. Collective."""
        step, synchroniser = made.step, self._synchroniser
        last = step == self._analysis.last_step
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
        if last:
            self.complete()
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
        left = self.steps_left(self._analysis.state.step)
        if not batches.advance(self._analysis, self.history, left):
            self._synchroniser.synchronise()

    def stop_early(self) -> None:
        """Stop with a checkpoint if the ranks have agreed to stop, unless the run is at its end. Collective.

        Raises
        ------
        EarlyStop
            On all ranks.
        """
        code, state = self._synchroniser.request, self._analysis.state
        if not code or state.step >= self._analysis.last_step:
            return
        self.checkpointing.write()
        place = self._analysis.plan.axis.exact(self._analysis.stepper.clock)
        raise EarlyStop(
            f"{self._synchroniser.stop.reason(code)}; step {state.step} is finished, {place}, and "
            f"a checkpoint written: continue with --restart (results in {self._folder})"
        )

    def complete(self) -> None:
        """Write the last checkpoint, row and snapshot of the run. Collective.

        The checkpoint precedes a row and a snapshot that are off their schedule, so that a run extended to a later end
        continues as if they had not been written.
        """
        for observer in (self.checkpointing, self.history, self.snapshots):
            observer.complete()

    def record_modes(self) -> None:
        """Find and write the modes of the state at the end, where the case asks for them. Collective.

        Raises
        ------
        PfemError
            On all ranks.
        """
        if self._analysis.model.case.modes is not None and self.is_open:
            record_modes(self._analysis.stepper, self._writer, self._folder, self.progress)

    def tell_remarks(self) -> None:
        """Report the observers' remarks, such as walls that were never touched. Collective."""
        for observer in self._observers:
            for text in observer.remarks():
                self.progress.message(text)

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
