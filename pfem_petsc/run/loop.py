"""The loop of a run over its steps, from the opening of its outputs to their end, however it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from ..analysis import Step
from ..errors import EarlyStop, InputError, PfemError
from ..parallel.agreement import on_root
from ..parallel.heap import returning_freed_memory
from ..restart.checkpoints import Restart
from ..stepping.batches import Batches
from .outputs import Outputs
from .stages import Stages
from .synchroniser import Synchroniser

__all__ = ["RunLoop"]


class RunLoop:
    """Makes the steps of all stages and serves the outputs; takes signals and the lock of the folder and returns them.

    Parameters
    ----------
    stages : Stages
    synchroniser : Synchroniser, with the lock of the folder and the requests to stop
    outputs : Outputs
    folder : of the results
    restart : the checkpoint from which the run continues, None for a new run
    notes : for the user at the start

    Attributes
    ----------
    started : whether the outputs have been opened
    closed : whether the simulation has been closed, which makes no further steps
    """

    def __init__(
        self,
        stages: Stages,
        synchroniser: Synchroniser,
        outputs: Outputs,
        folder: Path,
        restart: Restart | None,
        notes: list[str],
    ) -> None:
        self._stages, self._synchroniser, self._outputs = stages, synchroniser, outputs
        self._folder, self._restart, self._notes = folder, restart, notes
        self.comm, self.stop, self._lock = stages.comm, synchroniser.stop, synchroniser.lock
        self.started = self.closed = False

    def check_open(self) -> None:
        """Raise an error if the simulation was closed.

        Raises
        ------
        InputError
        """
        if self.closed:
            raise InputError(
                f"{self._folder}: this simulation was closed; continue with a new Simulation with restart=True"
            )

    def start(self, instrument: Callable[[], None]) -> None:
        """Initialise the state and open the outputs; a second call does nothing. Collective.

        ``instrument`` is called before the first output.
        """
        self.check_open()
        if self.started:
            return
        self.started = True
        try:
            on_root(self.comm, self._lock.take)
            self.stop.watch()
            with returning_freed_memory():
                self._outputs.open(self._restart, self._notes)
                instrument()
                self._outputs.record_start()
        except PfemError:
            self.finish("failed")
            raise

    def steps(self, start: Callable[[], None], batches: Batches | None = None) -> Iterator[Step]:
        """Make the steps and yield them, or with ``batches`` only some of them. Collective.

        Raises
        ------
        EarlyStop, SimulationFailure
            On all ranks.
        """
        stages, outputs = self._stages, self._outputs
        state = stages.analysis.state
        ended = stages.at_last and state.step >= stages.analysis.last_step
        if self.started and not outputs.is_open:
            if ended:
                return
            raise InputError(
                f"{self._folder}: the results of this simulation were closed at step {stages.analysis.stepper.number}, "
                "when its iteration ended; continue with a new Simulation with restart=True, from a checkpoint"
            )
        try:
            start()
            self._synchroniser.synchronise()
            outputs.stop_early()
            while True:
                while stages.analysis.state.step < stages.analysis.last_step:
                    if batches is not None:
                        outputs.advance_together(batches)
                    yield self.advance()
                    outputs.stop_early()
                if stages.at_last:
                    break
                outputs.begin_stage()
                batches = None if batches is None else batches.anew()
            # a run that was killed after its last checkpoint may not have done this
            outputs.complete()
            outputs.record_modes()
            outputs.tell_remarks()
            self.finish("done")
        except (GeneratorExit, EarlyStop):
            self.finish("stopped")
            raise
        except PfemError:
            self.finish("failed")
            raise
        except BaseException:
            # only one rank may be here, so collective operations are not safe
            if self.comm.size == 1:
                self.finish("failed")
            else:
                self.leave("failed")
            raise

    def advance(self) -> Step:
        """Make one step and serve the outputs that are due after it. Collective."""
        self.check_open()
        made = self._stages.analysis.advance()
        self.stop.stepped = True
        return self._outputs.after(made)

    def finish(self, outcome: str) -> None:
        """Close the results and unlock the folder. Collective."""
        try:
            self._outputs.close(outcome)
        finally:
            self.leave(outcome)
            self._lock.release()

    def leave(self, outcome: str) -> None:
        """Clean up without communication; the folder stays locked until the process ends, as others may be writing."""
        self._outputs.leave(outcome)
        if self._restart is not None:
            self._restart.file.close()
        self.stop.release()
