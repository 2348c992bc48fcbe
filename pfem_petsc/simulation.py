"""A run from case to results: set-up, time loop, output."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, Self

import numpy as np
from mpi4py import MPI

from .case.schema import Case
from .contact.contact import check_start
from .errors import EarlyStop, InputError, PfemError, SimulationFailure
from .files import FolderLock
from .integrators.base import State
from .mechanics.loads import ForceState
from .parallel.agreement import all_arrive, aside, on_root, outcome, passes_exception, watch
from .parallel.heap import returning_freed_memory
from .parallel.petsc_log import instrument, staged
from .preflight import forecast, inspect, later_gaps, summarise, warnings_before
from .restart import RunState, find_restart, finished, finished_message
from .run.observers import StopRequest, Synchroniser
from .run.outputs import Outputs, ReportedCompilation
from .run.recorder import Recorder
from .run.stages import Stages
from .statics.equilibrium import WithEquations
from .stepping.model import Model
from .stepping.stepper import Step, Stepper

__all__ = ["Simulation", "Step"]

watch()  # from the import on: a script may fail before it makes a simulation


class Simulation(WithEquations):
    """Simulation of a case on a communicator, and context manager that closes it.

    Only one run at a time can write to an output folder: the folder is locked from :meth:`start` to the end of the
    iteration or to :meth:`close`. The ``stepper`` advances the state, and the ``outputs`` write the results.

    Parameters
    ----------
    case : Case
    comm : MPI.Comm, optional
        Default: the world.
    output : Path or None
        Folder of the results; default ``results/<case name>``. Existing results are moved aside.
    restart : None, True or Path
        Continue from the newest checkpoint of the output folder (True), from that of another folder, or from a file.
        Results are bitwise identical on the same number of ranks.
    quiet : bool
        Print nothing on stdout.
    wall_time : float, optional
        Stop with a checkpoint after this time [s], but not before the first step; SIGTERM, SIGINT, SIGUSR1 and SIGHUP
        do so at any time during the run.
    check_only : bool
        Set up the model and write nothing.

    Raises
    ------
    InputError
        On all ranks.
    """

    @staged
    def __init__(
        self,
        case: Case,
        comm: MPI.Comm | None = None,
        output: Path | str | None = None,
        restart: bool | Path | None = None,
        quiet: bool = False,
        wall_time: float | None = None,
        check_only: bool = False,
    ) -> None:
        if not isinstance(case, Case):
            raise InputError(
                f"Simulation: expected a Case, got {case!r:.80}; Case.load reads one from a file, "
                "Case.from_dict from tables"
            )
        stop = StopRequest(wall_time)
        # later changes of the case do not affect this simulation
        self.case = case = case.copy(fixed=True)
        self.comm = comm if comm is not None else MPI.COMM_WORLD
        aside(self.comm)
        self.folder = Path(output) if output is not None else Path("results") / case.name
        self.quiet = quiet
        self._compilation = ReportedCompilation(self.comm, quiet)
        lock = FolderLock(self.folder)
        # also if the simulation is deleted without close()
        for held in (stop, lock):
            weakref.finalize(self, held.release)
        if not check_only:
            # a large model takes minutes to set up
            on_root(self.comm, lock.check)
        asked = None if check_only else restart
        self.restart, self.notes = find_restart(case, self.comm, self.folder, asked)
        # PETSc and what it is linked to are loaded by now
        with self._compilation, returning_freed_memory():
            self._prepare(stop, lock)

    def _prepare(self, stop: StopRequest, lock: FolderLock) -> None:
        case, restart = self.case, self.restart
        recorded, number = (restart.file.attributes["plan"], restart.stage) if restart is not None else (None, 0)
        self._stages = Stages(case, self.comm, recorded, number)
        self.plan = self._stages.plan
        self._reached: float | None = None
        if self.restart is not None and self.restart.continues or self.notes:
            self._reached = on_root(self.comm, finished, case, self.folder, self.plan.end)
        self.mesh = self.model.mesh
        if number == 0:
            check_start(self.model.contact, self.mesh.points[: self.mesh.n_owned], self.model.size)
            if self.model.self_contact is not None:
                self.model.self_contact.check_start(self.mesh.points)
        if self.restart is not None and not self.finished:
            RunState(self.stepper).restore(self.restart.file, case.source)
        minutes = case.output.checkpoint_minutes
        interval = 60.0 * minutes if minutes else None
        self._synchroniser = Synchroniser(self._stages, stop, lock, interval)
        self.outputs = Outputs(self._stages, self._synchroniser, self.folder, self.quiet, self._compilation)
        self._started = self._closed = self._failed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        together = kind is None or self._failed or self.comm.size == 1
        # an error may have occurred on this rank only, and a collective close would wait forever
        if together or (issubclass(kind, PfemError) and all_arrive(aside(self.comm))):
            self.close()
        else:
            self._closed = True
            self._leave("failed", error)

    def close(self) -> None:
        """Close the results, free PETSc objects, restore signal handlers and unlock the folder. Collective.

        A second call does nothing. State, last row and mesh remain accessible; other methods raise an error. A run that
        has not reached its end can be continued from its last checkpoint.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._finish("stopped")
        finally:
            self._free_equations()
            self._stages.destroy()

    def _usable(self) -> None:
        if self._closed:
            raise InputError(
                f"{self.folder}: this simulation was closed; continue with a new Simulation with restart=True"
            )

    @property
    def stepper(self) -> Stepper:
        """What advances the state, in the current stage."""
        return self._stages.stepper

    @property
    def model(self) -> Model:
        """The model of the current stage."""
        return self.stepper.model

    @property
    def finished(self) -> bool:
        """Whether a restart was requested and the output folder already has results up to the end."""
        return self._reached is not None

    @property
    def state(self) -> State:
        """The state of this rank's nodes: :class:`~pfem_petsc.integrators.base.State`.

        Before :meth:`start`, it is that of the mesh at rest, or with ``restart`` that of the checkpoint."""
        return self.stepper.state

    @property
    def row(self) -> dict[str, Any] | None:
        """The last row of the history."""
        return self.outputs.history.row if self.outputs.history is not None else None

    @property
    def columns(self) -> dict[str, np.dtype]:
        """The columns of the history, name to the type of a value with its shape."""
        return self._stages.columns or Recorder(self.stepper).columns

    def summary(self) -> dict[str, str]:
        """Return a summary before a run: text by label. Collective."""
        self._usable()
        return summarise(self.case, self.model, self.plan)

    def inspect(self) -> tuple[dict[str, str], list[str]]:
        """Return further checks and a forecast of the run (text by label), and warnings. Collective."""
        self._usable()
        entries, warnings = inspect(self.model.case, self.model)
        for stage in self.case.stages[self._stages.number + 1 :]:
            if not stage.holds("wall"):
                entries |= later_gaps(Model(stage, self.comm, self.mesh))
        entries |= forecast(self.case, self.model, self.plan, self.outputs.fields, self.columns)
        before = warnings_before(self.model.case, self.model, self.stepper.plan)
        return entries, self.model.warnings + before + warnings

    def obstacle(self) -> str:
        """Return why the run cannot make its first step, as far as it is known before; empty otherwise. Collective."""
        self._usable()
        return self.stepper.obstacle()

    def on_step(self, function: Callable[[Step], object], every: int = 1) -> None:
        """Register a function to be called on all ranks after each step whose number is a multiple of ``every``.

        It receives the finished :class:`Step`, and may read :attr:`state` and call collective functions; its result is
        ignored. With a large ``every``, :meth:`run` still makes the steps in between in one call. Functions are called
        in the order of registration. What one raises ends the run: if only some ranks raise, all of them get a
        :class:`~pfem_petsc.errors.SimulationFailure` that names the exception.

        Raises
        ------
        InputError
            If ``function`` cannot be called, or ``every`` is not a positive integer.
        """
        self._usable()
        if not callable(function):
            raise InputError(f"on_step: {function!r:.80} is not a function of a step")
        if not isinstance(every, int | np.integer) or isinstance(every, bool) or every < 1:
            raise InputError(f"on_step: every = {every!r}: give a positive whole number of steps")
        self.outputs.call(function, int(every))

    def external_force(self, function: Callable[[float, ForceState], Any]) -> None:
        """Register a function that computes external forces. Collective; call it before the run.

        The function is called on each rank as ``function(t, state)`` with a time [s] and a
        :class:`~pfem_petsc.mechanics.loads.ForceState`, and returns forces (owned, 3) [N] on this rank's nodes,
        which are added to the loads. ``state`` contains their mesh numbers, and positions and velocities predicted
        for this time from the last state. The function may be called several times in a step, and again if the step is
        bisected, so it must depend only on its arguments. Its work is part of ``external_work``. It acts in dynamic
        analyses only; in a case with stages, t is counted from the start of the stage. Functions are not stored in
        checkpoints: register them again before a restarted run.

        Raises
        ------
        InputError
            If the run has started, or the case has no dynamic analysis.
        """
        self._usable()
        if not callable(function):
            raise InputError(f"external_force: {function!r:.80} is not a function of time and state")
        if self._started:
            raise InputError("external_force: the run has started; register forces before the first step")
        self._stages.call(function)

    @staged
    def start(self) -> None:
        """Initialise the state and open the output. Collective; called by :meth:`run` and iteration."""
        self._usable()
        if self._started:
            return
        self._started = True
        try:
            on_root(self.comm, self._synchroniser.lock.take)
            self._synchroniser.stop.watch()
            with returning_freed_memory():
                self.outputs.open(self.restart, self.notes)
                instrument(self)
                self.outputs.record_start()
        except PfemError as error:
            self._fail(error)
            raise

    def __iter__(self) -> Iterator[Step]:
        """Run step by step; the output is closed when the iteration ends.

        All ranks leave a loop over the steps after the same step. If only some do, by an exception or otherwise, the
        others get a :class:`~pfem_petsc.errors.SimulationFailure` in place of their next step.
        """
        return self._iterate(batches=False)

    def batches(self) -> Iterator[Step]:
        """Run as by iteration, but yield only some of the steps: those in between are made in one compiled call, if
        possible, when no output is due after them."""
        return self._iterate(batches=True)

    def _iterate(self, batches: bool, shown: bool = True) -> Iterator[Step]:
        """Run; ``shown``: to somebody who may read the snapshots of a step that is yielded."""
        self._usable()
        if self.finished:
            return
        stages, outputs, shared = self._stages, self.outputs, shown and self.comm.size > 1
        if self._started and not outputs.is_open:
            if stages.at_last and self.state.step >= self.stepper.last_step:
                return
            raise InputError(
                f"{self.folder}: the results of this simulation were closed at step {self.stepper.number}, "
                "when its iteration ended; continue with a new Simulation with restart=True, from a checkpoint"
            )
        with self._compilation:
            try:
                self.start()
                self._synchroniser.synchronise()
                outputs.stop_early()
                while True:
                    while self.state.step < self.stepper.last_step:
                        made = self._advance(outputs.steps_left(self.stepper.number) if batches else 1)
                        if shown:
                            outputs.wait()
                        yield made
                        if shared:
                            self._all_stay()
                        outputs.stop_early()
                    if stages.at_last:
                        break
                    outputs.begin_stage()
                # a run that was killed after its last checkpoint may not have done this
                outputs.complete()
                outputs.record_modes()
                outputs.tell_remarks()
                self._finish("done")
            except GeneratorExit:
                if shared and not self._all_leave(sys._getframe().f_back):
                    self._fail()
                else:
                    self._finish("stopped")
                raise
            except EarlyStop:
                self._finish("stopped")
                raise
            except PfemError as error:
                self._fail(error)
                raise
            except BaseException as error:
                # only one rank may be here, so collective operations are not safe
                end = self._finish if self.comm.size == 1 else self._leave
                end("failed", error)
                raise

    def _all_leave(self, frame: FrameType | None) -> bool:
        """Return whether all ranks leave their loops over steps, as this one does in a frame. Collective."""
        found = outcome(self.comm, True, lambda: passes_exception(frame))
        return found is not None and found[1]

    def _all_stay(self) -> None:
        """Go on if no rank has left its loop over steps. Collective."""
        first, _ = outcome(self.comm, False)
        if first < self.comm.size:
            raise SimulationFailure(
                f"step {self.stepper.number}: rank {first} has left the loop over steps, by an exception or by itself, "
                "and the others cannot go on alone; leave it on all ranks after the same step"
            )

    def _advance(self, most: int = 1) -> Step:
        """Make one step, or up to ``most``, and serve the outputs that are due after it. Collective."""
        self._usable()
        made = self.stepper.advance(most)
        self._synchroniser.stop.stepped = True
        return self.outputs.after(made)

    def _finish(self, outcome: str, error: BaseException | None = None) -> None:
        """Close the results and unlock the folder. Collective."""
        try:
            self.outputs.close(outcome)
        finally:
            self._leave(outcome, error)
            self._synchroniser.lock.release()

    def _fail(self, error: BaseException | None = None) -> None:
        """Close the results if all ranks are here, else leave them as they are."""
        self._failed = self.comm.size == 1 or all_arrive(aside(self.comm))
        end = self._finish if self._failed else self._leave
        end("failed", error)

    def _leave(self, outcome: str, error: BaseException | None = None) -> None:
        """Clean up without communication; the folder stays locked until the process ends, as others may be writing."""
        self.outputs.leave(outcome, error)
        if self.restart is not None:
            self.restart.file.close()
        self._synchroniser.stop.release()

    def run(self) -> int:
        """Run to the end and return the exit status. Collective.

        Raises
        ------
        EarlyStop
            On all ranks, after a signal or at the end of the wall time; a checkpoint is written.
        SimulationFailure
            On all ranks; data recorded before are in the result file.
        """
        if self.finished and self.comm.rank == 0 and not self.quiet:
            has_checkpoint = self.restart is not None
            print(finished_message(self.folder, self._reached, self.plan, self.case, has_checkpoint))
        for _ in self._iterate(batches=True, shown=False):
            pass
        return 0

    def gather(self, values: np.ndarray) -> np.ndarray | None:
        """Return an owned array (owned, ...) gathered in mesh numbering on rank 0, None elsewhere. Collective."""
        self._usable()
        parts = self.comm.gather(self.mesh.node_order.to_slab(values))
        return np.concatenate(parts) if parts is not None else None
