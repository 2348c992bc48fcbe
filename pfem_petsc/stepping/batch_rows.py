"""Rows of pairs and constraints that a batch of steps solves by Python: those that turn, come and go, share nodes, are
on several ranks, or whose nodes walls stop too.

The compiled loop calls back once in each step, when the nodes have moved without rows, and again if rows have closed or
opened, when the velocities at their nodes are known.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from ..errors import SimulationFailure
from ..mechanics.compiled import generate_call
from ..parallel.ending import is_alone
from ..tolerances import PROJECTED

if TYPE_CHECKING:
    from .stepper import Stepper

SOLVE, CLOSE = range(2)
"""What a call does."""

FAILED, _LOST = -1, -2
"""Results of calls: a failure of the simulation, any other error."""


class CalledRows(NamedTuple):
    """Rows that are solved by calls (owned nodes n).

    Attributes
    ----------
    address : of the function that :func:`call_rows` calls; 0 for none
    predictor : (n, 3) positions to which nodes move without forces, written before a call; (0, 3) without calls
    held, changing : (n,) nodes on which rows press, ascending; nodes of rows whose force begins or ends
    counts : (2,) their numbers
    loss : (1,) energy that closing rows lose [J]
    """

    address: int
    predictor: np.ndarray
    held: np.ndarray
    changing: np.ndarray
    counts: np.ndarray
    loss: np.ndarray


@intrinsic
def call_rows(typingctx, address, step, what):  # noqa: ANN001, ANN201
    """Call back from a step of a batch; return whether that has failed: 0, or a negative number."""
    return types.int64(types.int64, types.int64, types.int64), generate_call


class RowCaller:
    """Solves the rows of a model when the loop of a batch asks for it.

    Attributes
    ----------
    record : CalledRows
    failure : SimulationFailure of the last batch, or None
    """

    def __init__(self, stepper: Stepper, stiffness: np.ndarray, u: np.ndarray, contact: np.ndarray) -> None:
        self.stepper, self.links = stepper, stepper.model.links
        self._stiffness, self._u, self._contact = stiffness, u, contact
        self._tolerance = PROJECTED * stepper.model.size
        self._begin, self._totals, self._error = 0, np.empty((0, 3)), None
        self.failure: SimulationFailure | None = None
        n = 0 if self.links.separate else len(u)
        self._function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(self._call)
        address = 0 if self.links.separate else ctypes.cast(self._function, ctypes.c_void_p).value
        nodes = np.empty((2, n), dtype=np.int64)
        counts, loss = np.zeros(2, dtype=np.int64), np.zeros(1)
        self.record = CalledRows(address, np.empty((n, 3)), *nodes, counts, loss)
        self._keep(0, self.links.pressed())
        if self.record.address:
            stepper.balance = stepper.scheme.balance(stepper.state, stepper.h)

    def _keep(self, which: int, nodes: np.ndarray) -> None:
        if self.record.address:
            room = self.record.changing if which else self.record.held
            self.record.counts[which] = len(nodes)
            room[: len(nodes)] = nodes

    def begin(self, step: int, totals: np.ndarray) -> CalledRows:
        """Prepare calls in steps from one of a number on; forces on the last nodes of rows are written to ``totals``
        (tables, 3) [N]."""
        self._begin, self._totals, self.failure = step, totals, None
        return self.record

    def end(self) -> None:
        """Raise what went wrong in a call, except a failure of the simulation."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _call(self, step: int, what: int) -> int:
        """Solve the rows of a step, or find the energy that they lose."""
        try:
            if what == SOLVE:
                self._solve((self._begin + step + 2) * self.stepper.h)
            else:
                self._close()
        except BaseException as error:  # noqa: BLE001  # an exception cannot pass the compiled loop: end raises it
            if isinstance(error, SimulationFailure) and not is_alone():
                self.failure = error
                return FAILED
            self._error = error
            return _LOST
        return 0

    def _solve(self, time: float) -> None:
        """Solve the rows of the balance for the positions at a time [s]; if that fails, they have no forces."""
        links, record = self.links, self.record
        self._keep(0, np.empty(0, dtype=np.int64))
        self._keep(1, np.empty(0, dtype=np.int64))
        self._totals[:] = 0.0
        stepper = self.stepper
        stepper.balance = replace(stepper.balance, predictor=record.predictor, time=time)
        load = links.explicit(stepper.balance, stepper.state, self._u, self._stiffness, self._tolerance)
        if load is not None:
            links.push(load, self._stiffness, self._u, self._contact)
        self._totals[:] = links.totals()
        self._keep(0, links.pressed())
        two = links.two
        changed = (links.force[two.at] > 0.0) != two.record.closed
        if changed.any():
            nodes = two.nodes[:, changed]
            self._keep(1, np.unique(nodes[nodes >= 0]))

    def _close(self) -> None:
        """Find the energy that rows lose, from velocities and accelerations of the state at their nodes."""
        state = self.stepper.state
        state.contact = self._contact
        self.record.loss[0] = self.stepper.ledger.impacts.of_rows(state.position, (state.v, state.a), None)
