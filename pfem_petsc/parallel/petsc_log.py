"""Stages and events of a run for PETSc's ``-log_view``.

They wrap the methods of a simulation only if PETSc logs; otherwise a run calls its methods directly.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["EVENTS", "STAGES", "instrument", "staged"]

SET_UP, STEPS = "pfem set-up", "pfem steps"

STAGES = (SET_UP, STEPS)

EVENTS: dict[str, tuple[str, ...]] = {
    "pfemForces": ("model.bars.forces", "model.bars.step_forces"),
    "pfemGhosts": ("mesh.update_ghosts",),
    "pfemSolve": ("stepper.solve",),
    "pfemProduct": ("stepper.hessian.apply",),
    "pfemResidual": ("stepper.newton._residual",),
    "pfemHessian": ("stepper.newton._hessian",),
    "pfemPreconditioner": ("stepper.lagged.renew",),
    "pfemContact": ("model.contact.explicit", "model.contact.near", "model.contact.frames"),
    "pfemLedger": ("stepper.ledger.update",),
    "pfemHistory": ("outputs.history.record",),
    "pfemSnapshot": ("outputs.snapshots.observe",),
    "pfemCheckpoint": ("outputs.checkpointing.observe",),
}
"""Event to the methods of a simulation that it measures. Nested events are counted in both."""

Method = TypeVar("Method", bound=Callable[..., Any])


def staged(method: Method) -> Method:
    """Decorate a method of the set-up stage."""

    @functools.wraps(method)
    def in_stage(*arguments: Any, **keywords: Any) -> Any:
        from petsc4py import PETSc

        if not PETSc.Log.isActive():
            return method(*arguments, **keywords)
        stage = PETSc.Log.Stage(SET_UP)
        stage.push()
        try:
            return method(*arguments, **keywords)
        finally:
            stage.pop()

    return in_stage  # type: ignore[return-value]


def instrument(simulation: Any) -> None:
    """Wrap the stage of the steps and all events around the methods of a simulation, if PETSc logs."""
    from petsc4py import PETSc

    if not PETSc.Log.isActive():
        return
    for name, paths in EVENTS.items():
        event = PETSc.Log.Event(name)
        for path in paths:
            _cover(simulation, path, event.begin, event.end)
    stage = PETSc.Log.Stage(STEPS)
    _cover(simulation, "_advance", stage.push, stage.pop)


def _cover(root: Any, path: str, begin: Callable[[], None], end: Callable[[], None]) -> None:
    """Wrap a method of one object in ``begin`` and ``end``; methods that this run does not have are skipped."""
    *way, name = path.split(".")
    for step in way:
        root = getattr(root, step, None)
    method = getattr(root, name, None)
    if method is None:
        return

    @functools.wraps(method)
    def covered(*arguments: Any, **keywords: Any) -> Any:
        begin()
        try:
            return method(*arguments, **keywords)
        finally:
            end()

    setattr(root, name, covered)
