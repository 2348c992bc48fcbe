"""A run from case to results: set-up, time loop, output."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from mpi4py import MPI

from .contact.alarm import check_positions
from .contact.piercing import Piercing
from .errors import EarlyStop, InputError, PfemError, SimulationFailure
from .mechanics.compiled import Compilation
from .output.lock import FolderLock
from .output.progress import Progress
from .output.row import Row
from .output.units import engineering
from .output.vtkhdf import ResultWriter
from .parallel.agreement import on_root
from .parallel.petsc_log import lay_over, staged
from .preflight.forecast import forecast
from .preflight.inspection import inspect, warnings_before
from .preflight.summary import summarise
from .restart.checkpoints import Checkpoints
from .restart.folder import Restart, find_restart, finished, prepare_folder
from .run.opening import open_progress, open_result_file
from .run.stop import Meetings, StopRequest
from .stepping.batch import WORTH, Batches
from .stepping.blowup import BlowUp
from .stepping.contact_watch import ContactWatch
from .stepping.fields import Fields
from .stepping.ledger import Ledger
from .stepping.model import Model
from .stepping.prepare import make_plan, make_stepper
from .stepping.recorder import Recorder

__all__ = ["Simulation", "Step"]


class Step(NamedTuple):
    """What a finished step reports."""

    step: int
    time: float
    newton: int
    linear: int
    row: dict[str, Any] | None


class Simulation:
    """A case on a communicator; a context manager, which closes it.

    One run at a time writes into an output folder: from :meth:`start` to the end of the iteration, or to
    :meth:`close`, the folder is locked.

    Parameters
    ----------
    case : Case
    comm : MPI.Comm, optional
        Default: the world.
    output : Path or None
        Folder of the results; default ``results/<case name>``. Results found there are moved aside.
    restart : None, True or Path
        Continue from the newest checkpoint of the output folder, or from a file; bit for bit on as many ranks.
    quiet : bool
        Print nothing on stdout.
    wall_time : float, optional
        Stop with a checkpoint after so many seconds, but not before the first step; SIGTERM, SIGINT, SIGUSR1 and SIGHUP
        do so at any time during the run.
    check_only : bool
        Set the model up and write nothing.

    Raises
    ------
    InputError
        On all ranks.
    """

    @staged
    def __init__(
        self,
        case,
        comm: MPI.Comm | None = None,
        output: Path | str | None = None,
        restart: bool | Path | None = None,
        quiet: bool = False,
        wall_time: float | None = None,
        check_only: bool = False,
    ) -> None:
        self._stop = StopRequest(wall_time)
        self._progress: Progress | None = None
        self._compilation = Compilation(self._tell_compilation, self._leave_out)
        self.case = case
        self.comm = comm if comm is not None else MPI.COMM_WORLD
        self.folder = Path(output) if output is not None else Path("results") / case.name
        self.quiet = quiet
        self.on_steps: list[tuple[Callable[[Step], object], int]] = []
        self._closed = False
        self._lock = FolderLock(self.folder)
        weakref.finalize(self, _let_go, self._stop, self._lock)
        if not check_only:
            # a large model takes minutes to set up
            on_root(self.comm, self._lock.check)
        found = find_restart(case, self.comm, self.folder, None if check_only else restart)
        self.restart = found if isinstance(found, Restart) else None
        self.notes = [found] if isinstance(found, str) else []
        with self._compilation:
            self._prepare()

    def _prepare(self) -> None:
        case = self.case
        self.model = Model(case, self.comm)
        self.plan = make_plan(self.model, self.restart.attributes["plan"] if self.restart is not None else None)
        self._reached: float | None = None
        if self.restart is not None and self.restart.continues or self.notes:
            self._reached = finished(case, self.comm, self.folder, self.plan.step * self.plan.steps)
        self.model.contact.check_start(self.model.mesh.points[: self.model.mesh.n_owned], self.model.length)
        self.stepper = make_stepper(self.model, self.plan)
        self.fields = Fields(self.model)
        self.row: dict[str, Any] | None = None
        self._last_snapshot = -1  # its step
        self._started = False
        self._asked = 0  # code of a request to stop, zero for none
        self._writer: ResultWriter | None = None
        minutes = case.output.checkpoint_minutes
        self.meetings = Meetings(self.comm, self._stop, 60.0 * minutes if minutes else None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        # an unforeseen error may have come on this rank alone: closing together would wait for ever
        if kind is None or self.comm.size == 1 or issubclass(kind, PfemError):
            self.close()
        else:
            self._closed = True
            self._leave("failed")

    def close(self) -> None:
        """Close the results, free PETSc's objects, give signals back and unlock the folder; again: nothing. Collective.

        State, last row and mesh can still be looked at; everything else is refused. A run that was not at its end can
        be continued from its last checkpoint.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._finish("stopped")
        finally:
            destroy = getattr(self.stepper, "destroy", None)
            if destroy is not None:
                destroy()

    def _usable(self) -> None:
        if self._closed:
            raise InputError(
                f"{self.folder}: this simulation was closed; go on with a new Simulation with restart=True"
            )

    @property
    def finished(self) -> bool:
        """Whether a restart was asked for and the output folder holds results up to the end already."""
        return self._reached is not None

    @property
    def state(self):  # noqa: ANN201
        """The state of this rank's nodes: :class:`~pfem_petsc.integrators.base.State`."""
        return self.stepper.state

    @property
    def mesh(self):  # noqa: ANN201
        """The distributed mesh."""
        return self.model.mesh

    def summary(self) -> dict[str, str]:
        """Label and text of what a user checks before a run. Collective."""
        self._usable()
        return summarise(self.case, self.model, self.plan)

    def inspect(self) -> tuple[dict[str, str], list[str]]:
        """Label and text of a closer look at the truss and a forecast of the run; and what looks wrong. Collective."""
        self._usable()
        recorder = Recorder(self.stepper, None)
        entries, warnings = inspect(self.case, self.model)
        entries |= forecast(self.case, self.model, self.plan, self.fields, recorder.columns, recorder.types)
        return entries, self.model.warnings + warnings_before(self.case, self.model, self.plan) + warnings

    def on_step(self, function: Callable[[Step], object], every: int = 1) -> None:
        """Have a function called on all ranks after each step whose number is a multiple of ``every``.

        It gets the finished :class:`Step` and may look at :attr:`state` and call what is collective; what it gives is
        not looked at. With ``every`` large, :meth:`run` still makes the steps between by one compiled call. Functions
        are called in the order in which they were given.

        Raises
        ------
        InputError
            ``every`` is not a positive whole number.
        """
        self._usable()
        if not isinstance(every, int | np.integer) or isinstance(every, bool) or every < 1:
            raise InputError(f"on_step: every = {every!r}: give a positive whole number of steps")
        self.on_steps.append((function, int(every)))

    @staged
    def start(self) -> None:
        """Complete the state at the start and open the output. Collective; called by :meth:`run` and iteration."""
        self._usable()
        if self._started:
            return
        self._started = True
        try:
            on_root(self.comm, self._lock.take)
            self._stop.watch()
            self._begin()
        except PfemError:
            self._finish("failed")
            raise

    def _begin(self) -> None:
        self._checkpoints = Checkpoints(self.case, self.stepper, self.plan, self.folder)
        if self.restart is not None:
            # before anything in the folder changes: it may be refused
            checkpoint = self._checkpoints.take_back(self.restart)
        aside = prepare_folder(self.comm, self.folder, self.restart, self.plan)
        self._progress = open_progress(self, aside)
        if self.restart is None:
            self.stepper.start()
            self.meet()
        self.ledger = Ledger(self.stepper)
        self.stepper.booking = self._book
        if hasattr(self.stepper, "message"):
            self.stepper.message = self._progress.warning
        self.recorder = Recorder(self.stepper, self.ledger)
        self.blow_up = BlowUp(self.model)
        self._piercing = Piercing(self.model)
        self.contact_watch = ContactWatch(self.model, self._progress.warning)
        lay_over(self)
        continues = False
        if self.restart is not None:
            continues = self.restart.continues
            self.row = self._checkpoints.state.put_back_sums(checkpoint, self.ledger, self.recorder, self.blow_up)
            self._last_snapshot = self.restart.last[0]
            self.contact_watch.start = self.recorder.start_energy
            changes = f"; changed: {'; '.join(self.restart.changed)}" if self.restart.changed else ""
            self._progress.message(
                f"restart from {self.restart.path}: step {self.state.step}, t = {engineering(self.state.time, 's')}"
                + changes
            )
        self._writer = open_result_file(self, continues)
        if not continues:
            self._record()
            self._snapshot()

    def __iter__(self) -> Iterator[Step]:
        """Run step by step; the output is closed when the iteration ends."""
        self._usable()
        if self.finished:
            return
        with self._compilation:
            yield from self._steps()

    def batches(self, worth: int = WORTH) -> Iterator[Step]:
        """Run as iteration does, but give only some of the steps: those between may be made by one compiled call.

        ``worth``: steps of a run for which that call is compiled, which takes some seconds when it is first met.
        """
        self._usable()
        if self.finished:
            return
        with self._compilation:
            yield from self._steps(Batches(worth))

    def _steps(self, batches: Batches | None = None) -> Iterator[Step]:
        if self._started and self._writer is None and self.state.step < self.plan.steps:
            raise InputError(
                f"{self.folder}: the results of this simulation were closed at step {self.state.step}, when its "
                "iteration ended; go on with a new Simulation with restart=True, from a checkpoint"
            )
        try:
            self.start()
            self._stop_early(self.meet())
            while self.state.step < self.plan.steps:
                if batches is not None:
                    batches.advance(self)
                yield self._advance()
                self._stop_early(self._asked)
            # where a run that was killed after its last checkpoint had not got to it
            self._complete()
            self._tell_walls()
            self._finish("done")
        except (GeneratorExit, EarlyStop):
            self._finish("stopped")
            raise
        except PfemError:
            self._finish("failed")
            raise
        except BaseException:
            # one rank alone may be here: nothing collective is safe
            if self.comm.size == 1:
                self._finish("failed")
            else:
                self._leave("failed")
            raise

    def run(self) -> int:
        """Run to the end and give the exit status. Collective.

        Raises
        ------
        EarlyStop
            On all ranks, on a signal or when the wall time is over: a checkpoint is written.
        SimulationFailure
            On all ranks; what was recorded before is in the result file.
        """
        if self.finished and self.comm.rank == 0 and not self.quiet:
            end = self.plan.step * self.plan.steps
            beyond = f", beyond time.end = {engineering(end, 's')}" if self._reached > end * (1.0 + 1e-9) else ""
            print(f"{self.folder}: finished already: the results have t = {engineering(self._reached, 's')}{beyond}")
        for _ in self.batches():
            pass
        return 0

    def _advance(self) -> Step:
        self._usable()
        stepper, output = self.stepper, self.case.output
        stepper.step()
        self._stop.stepped = True
        solution = stepper.solution
        step = self.state.step
        last = step == self.plan.steps
        row = None
        snapshot = bool(output.fields_every and step % output.fields_every == 0)
        checkpoint = self._checkpoints.due(step)
        if step % output.history_every == 0:
            row = self._record()
        elif snapshot or checkpoint or last:
            self._asked = self.meet()
        if self.meetings.due(step):
            self._asked = self.meet()
        if snapshot:
            self._snapshot()
        if checkpoint or self.meetings.checkpoint_due:
            self._checkpoint()
        if last:
            row = self._complete()
        scale = self.recorder.energy_scale
        drift = self.row["energy_imbalance"] / scale if scale > 0.0 else None
        self._progress.update(
            step, self.state.time, stepper.h, solution.newton, solution.linear, self.row["active_contacts"], drift
        )
        made = Step(step, self.state.time, solution.newton, solution.linear, row)
        for function, every in self.on_steps:
            if step % every == 0:
                function(made)
        return made

    def _book(self) -> None:
        """Energies and iterations of a step, or of each part of a halved one."""
        self.ledger.update()
        self.recorder.count(self.stepper.solution.newton, self.stepper.solution.linear)

    def _record(self) -> dict[str, Any]:
        """A history row, unless a rank has a fault, which is raised on all."""
        row = self.recorder.row(alarm=self.stepper.fault is not None or self._stop.code != 0)
        if self.recorder.alarmed:
            self._asked = self.meet()
        self.take(row)
        return row

    def take(self, row: Row) -> None:
        """Look at a row, keep it and add it to the history."""
        self.blow_up.check(row, self.state)
        self.contact_watch.check(row)
        self.row = row
        self._writer.append_history(row if self.comm.rank == 0 else None)

    def _complete(self) -> dict[str, Any]:
        """Bring checkpoint and results to the end of the run, and give its last row.

        The checkpoint comes before a row and a snapshot off their schedule: a run that is given a later end goes on as
        if they had not been.
        """
        if self._checkpoints.wanted:
            self._checkpoint()
        if self.row["step"] != self.state.step:
            self._record()
        if self._last_snapshot != self.state.step:
            self._snapshot()
        return self.row

    def meet(self) -> int:
        """All ranks agree on faults, which are raised on all, and on a request to stop: its code, or zero."""
        fault = self.stepper.fault
        try:
            self._lock.renew()
        except SimulationFailure as lost:
            fault = fault or lost
        return self.meetings.meet(self.state.step, fault)

    def _checkpoint(self) -> None:
        """Results first: what the checkpoint goes on from must be in them."""
        self._writer.flush_history()
        self._checkpoints.write(self.ledger, self.recorder, self.blow_up, self.row, self._last_snapshot)
        self.meetings.checkpoint_written()

    def _stop_early(self, code: int) -> None:
        """Leave with a checkpoint where a request says so, unless the run is at its end."""
        if not code or self.state.step >= self.plan.steps:
            return
        self._checkpoint()
        raise EarlyStop(
            f"{self._stop.reason(code)}; step {self.state.step} is finished, t = {self.state.time:.6g} s, and a "
            f"checkpoint written: continue with --restart (results in {self.folder})"
        )

    def _snapshot(self) -> None:
        if not self.case.output.fields_every and 0 < self.state.step < self.plan.steps:
            return
        check_positions(self.stepper)
        state, fields = self.state, self.fields
        self._writer.write_snapshot(
            state.time,
            state.step,
            state.position,
            fields.at_nodes(state, self.stepper.acceleration),
            fields.at_bars(state),
        )
        self._last_snapshot = state.step
        for text in self._piercing.look(state.x, state.time):
            self._progress.warning(text)

    def _tell_walls(self) -> None:
        """What became of the walls, where it may not be what was meant. Collective."""
        contact = self.model.contact
        times = contact.log.times(self.comm)
        touched = np.array(times["sum"]) > 0.0
        for flags in times["flags"]:
            touched |= np.array(flags, dtype=bool)
        for name in np.array(contact.names, dtype=object)[~touched]:
            self._progress.message(f"wall {name!r} was never touched by a node")
        for text in self._piercing.summary():
            self._progress.message(text)

    def _finish(self, outcome: str) -> None:
        """Close the results and let go of the folder. Collective."""
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                writer.close()
        except SimulationFailure:
            # after a failure, that one is told
            if outcome == "done":
                raise
        finally:
            self._leave(outcome)
            self._lock.release()

    def _leave(self, outcome: str) -> None:
        """What this rank can do alone; the folder stays locked until its process ends: others may be writing."""
        if self._progress is not None:
            self._progress.close(outcome)
        if self.restart is not None:
            self.restart.file.close()
        self._stop.release()

    def _tell_compilation(self, name: str) -> None:
        text = f"compiling loops for this machine, once: {name} and what else this kind of case needs, up to a minute"
        if self._progress is not None:
            self._progress.message(text)
        elif self.comm.rank == 0 and not self.quiet:
            print(text, flush=True)

    def _leave_out(self, seconds: float) -> None:
        if self._progress is not None:
            self._progress.compiled(seconds)

    def gather(self, values: np.ndarray) -> np.ndarray | None:
        """An owned array (owned, ...) as a whole in mesh numbering on rank 0, None elsewhere. Collective."""
        self._usable()
        parts = self.comm.gather(self.mesh.node_order.to_slab(values))
        return np.concatenate(parts) if parts is not None else None


def _let_go(stop: StopRequest, lock: FolderLock) -> None:
    """Of a simulation that nobody has closed, and nobody has any more."""
    stop.release()
    lock.release()
