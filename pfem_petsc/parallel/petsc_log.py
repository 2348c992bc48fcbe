"""Stages and events of a run for PETSc's ``-log_view``.

They wrap the methods of a simulation only if PETSc logs; otherwise a run calls its methods directly. Floating-point
operations are those of linear elastic bars and of nodes without damping, as the formulas have them: an addition, a
product, a division or a root is one. Other laws do more.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["EVENTS", "OF_BALANCE", "OF_FORCE", "OF_PRODUCT", "STAGES", "instrument", "staged"]

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
    "pfemSnapshot": ("outputs.snapshots.write",),
    "pfemCheckpoint": ("outputs.checkpointing.write",),
}
"""Event to the methods of a simulation that it measures. Nested events are counted in both."""

OF_FORCE, OF_PRODUCT, OF_BALANCE = 28, 27, 5
"""Operations of the force of a bar with its energy, of its part of a product without matrix, and of the solution of a
node's balance in an explicit step."""


def _of_bars(each: int) -> Callable[[Any], float]:
    return lambda simulation: each * len(simulation.mesh.bars)


def _of_balance(simulation: Any) -> float:
    return OF_BALANCE * simulation.mesh.n_owned if simulation.stepper.scheme.explicit else 0.0


FLOPS: dict[str, Callable[[Any], float]] = {
    "model.bars.forces": _of_bars(OF_FORCE),
    "stepper.hessian.apply": lambda simulation: _of_bars(OF_PRODUCT)(simulation) + 3 * simulation.mesh.n_owned,
    "stepper.solve": _of_balance,
}
"""Method to the operations of a call of it on this rank."""

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
    counters = _Counters()
    for name, paths in EVENTS.items():
        event = PETSc.Log.Event(name)
        for path in paths:
            _cover(simulation, path, event.begin, _counted(simulation, path, event, counters))
    stage = PETSc.Log.Stage(STEPS)
    _cover(simulation, "_advance", stage.push, lambda *_: stage.pop())


def _counted(simulation: Any, path: str, event: Any, counters: _Counters) -> Callable[..., None]:
    """Return the function that ends an event after a call with these arguments, and counts what the call did."""
    from petsc4py import PETSc

    flops = FLOPS.get(path)

    def end(*arguments: Any) -> None:
        if flops is not None:
            PETSc.Log.logFlops(flops(simulation))
        if path == "mesh.update_ghosts":
            counters.add(simulation.mesh.traffic(arguments[0]))
        event.end()

    return end


class _Counters:
    """PETSc's own counters of messages, which its table shows for each event; nothing where this PETSc hides them."""

    _NAMES = ("petsc_isend_ct", "petsc_irecv_ct", "petsc_isend_len", "petsc_irecv_len")

    def __init__(self) -> None:
        from petsc4py import PETSc

        self._places: list[ctypes.c_double] = []
        with contextlib.suppress(OSError, ValueError):
            library = ctypes.CDLL(PETSc.__file__)
            self._places = [ctypes.c_double.in_dll(library, name) for name in self._NAMES]

    def add(self, traffic: tuple[int, int, int, int]) -> None:
        """Add messages sent and received, and their bytes."""
        for place, more in zip(self._places, traffic, strict=False):
            place.value += more


def _cover(root: Any, path: str, begin: Callable[[], None], end: Callable[..., None]) -> None:
    """Wrap a method of one object in ``begin`` and ``end``, which gets the arguments; methods that this run does not
    have are skipped."""
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
            end(*arguments)

    setattr(root, name, covered)
