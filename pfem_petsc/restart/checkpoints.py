"""Writes and restores the checkpoints of a run."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..output.checkpoint import NAME
from ..output.checkpoint_writer import write_checkpoint
from ..version import __version__
from .compare import check_mesh_is_the_same, mesh_mark
from .folder import Restart
from .state import STATE_VERSION, RunState

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..output.checkpoint import Checkpoint
    from ..recording.blowup import BlowUp
    from ..recording.recorder import Recorder
    from ..stepping.ledger import Ledger
    from ..stepping.plan import Plan
    from ..stepping.stepper import Stepper

__all__ = ["Checkpoints"]


class Checkpoints:
    """Checkpoints of one run, in its output folder. Construction is collective.

    Parameters
    ----------
    case : Case
    stepper : Stepper
    plan : Plan
    folder : Path
    """

    def __init__(self, case: Case, stepper: Stepper, plan: Plan, folder: Path) -> None:
        self.case, self.plan, self.path = case, plan, folder / NAME
        self.stage = stepper.model.case.number
        self.comm = stepper.model.comm
        self.state = RunState(stepper)
        self.last_step = -1
        self._model = stepper.model

    @cached_property
    def _mark(self) -> int:
        """Checksum of the mesh, which runs without checkpoints do not need. Collective at first use."""
        state = self.state
        return mesh_mark(self._model, state.node_order, state.bar_order, state.counted)

    @property
    def wanted(self) -> bool:
        """Whether the case requests checkpoints."""
        return bool(self.case.output.checkpoint_every or self.case.output.checkpoint_minutes)

    def due(self, step: int) -> bool:
        """Return whether the case requests a checkpoint after this step."""
        every = self.case.output.checkpoint_every
        return bool(every) and step % every == 0

    def write(
        self,
        ledger: Ledger,
        recorder: Recorder,
        blow_up: BlowUp,
        row: dict[str, Any],
        snapshots: dict[str, Any],
        stage: dict[str, Any] | None = None,
    ) -> None:
        """Write a checkpoint with the last history row and what is kept of the snapshots. Collective.

        ``stage``: what the history keeps of the stages before, None for a case without stages.

        Raises
        ------
        SimulationFailure
            On all ranks; earlier checkpoints are kept.
        """
        scalars = self.state.scalars(ledger, recorder, blow_up, row, snapshots)
        if stage is not None:
            scalars["stage"] = {"number": self.stage, "history": stage, "start": self.state.stage_start()}
        if scalars["step"] == self.last_step:
            return
        attributes = {
            "state_version": STATE_VERSION,
            "pfem_petsc": __version__,
            "name": self.case.name,
            "overrides": list(self.case.overrides),
            "case": self.case.to_dict(),
            "plan": self.plan.record(),
            "mesh_mark": self._mark,
            "external_functions": self.state.model.external.functions,
        }
        write_checkpoint(self.path, self.comm, self.state.arrays(), scalars, attributes)
        self.last_step = scalars["step"]

    def restore(self, restart: Restart) -> Checkpoint:
        """Restore the stepper from a checkpoint, instead of starting it; return the checkpoint. Collective.

        Raises
        ------
        InputError
            On all ranks, if the checkpoint is damaged or belongs to another mesh.
        """
        check_mesh_is_the_same(restart.path, self._mark, restart.attributes, self.case.source)
        checkpoint = restart.file.read(self.state.orders(restart.scalars))
        restart.file.close()
        self.state.load_state(checkpoint)
        if restart.continues:
            self.last_step = restart.step
        return checkpoint
