"""What a restart passes to the observers of a run, and reports to the user."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..output.checkpoint import Checkpoint
    from ..output.progress import Progress
    from ..recording.history import History
    from ..recording.snapshots import Snapshots
    from ..restart.checkpoints import Checkpoints
    from ..restart.folder import Restart

__all__ = ["resume_observers", "tell_restart"]


def resume_observers(
    restart: Restart, checkpoint: Checkpoint, checkpoints: Checkpoints, history: History, snapshots: Snapshots
) -> None:
    """Give history and snapshots what a checkpoint holds of them. Collective."""
    sums = history.ledger, history.recorder, history.blow_up
    history.row = checkpoints.state.load_sums(checkpoint, *sums)
    snapshots.load_state(restart.scalars)
    history.contact_watch.start = history.recorder.start_energy
    if restart.scalars.get("stage") is not None:
        history.load_stage(restart.scalars["stage"]["history"])


def tell_restart(restart: Restart, progress: Progress, place: str, functions: int) -> None:
    """Report from where a run continues, what has changed, and missing functions. Collective.

    Parameters
    ----------
    place : step and time of the checkpoint
    functions : number of functions that give forces
    """
    changes = f"; changed: {'; '.join(restart.changed)}" if restart.changed else ""
    progress.message(f"restart from {restart.path}: {place}{changes}")
    before = int(restart.attributes.get("external_functions", 0))
    if before != functions:
        progress.warning(
            f"{restart.path}: the run had {before} function{'s' * (before != 1)} for forces, and this one has "
            f"{functions}: functions are not in checkpoints; register them by Simulation.external_force before the run"
        )
