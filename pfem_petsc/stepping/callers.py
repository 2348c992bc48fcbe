"""Functions of Python that compiled steps call for what their loops cannot do."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import types

from ..contact.explicit import OutOfReachError
from ..contact.free_walls import TurnsTooFarError
from ..contact.self_contact import CONTACTS, FORCE, OVERLAP
from ..errors import SimulationFailure
from ..mesh.exchange import CFunction
from ..parallel.agreement import is_alone
from .called_walls import AGAIN, FOUND, MOVED, PRESSED, SUSPECTS, CalledWalls, new_called_walls
from .compiled_loop import CHANGING, CLOSED, DRIFT, HELD, MOST, SOLVE, WAY, WAY_LEFT, CalledRows
from .phases import FAILED, LOST

if TYPE_CHECKING:
    from .contact_phase import ContactNodes
    from .phases import Nodes
    from .stepper import Stepper

_CALL = types.int64(types.int64, types.int64)


class Caller:
    """Makes something of a step when a compiled loop asks for it.

    Attributes
    ----------
    function : that the loop calls, with the number of a step of its own, and what to do
    failure : SimulationFailure of the last call of the loop, if that goes on, or None
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self._begin = stepper, 0
        self.failure: SimulationFailure | None = None
        self._error: BaseException | None = None
        self._function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(self._call)
        self.function = CFunction(self._function, _CALL)

    def begin(self, step: int) -> None:
        """Prepare calls in steps from one of a number on."""
        self._begin, self.failure = step, None

    def end(self) -> None:
        """Raise what went wrong in a call, except :attr:`failure`."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _call(self, step: int, what: int) -> int:
        try:
            return self._make(self._begin + step + 1, what) or 0
        except BaseException as error:  # noqa: BLE001  # an exception cannot pass the compiled loop: end raises it
            if isinstance(error, SimulationFailure) and self._goes_on(what):
                self.failure = error
                return FAILED
            self._error = error
            return LOST

    def _make(self, step: int, what: int) -> int | None:
        """Do something at the end of a step of a number; return what the loop is to know, None for nothing."""
        raise NotImplementedError

    def _goes_on(self, what: int) -> bool:
        """Return whether the loop goes on after a failure of the simulation."""
        return False


class RowCaller(Caller):
    """Solves rows when a compiled loop asks for it.

    The loop calls when the nodes have moved without rows, in each step unless it can see that none of them is closed,
    and again if rows have closed or opened, when the velocities at their nodes are known.

    Attributes
    ----------
    record : CalledRows
    """

    def __init__(self, stepper: Stepper, stiffness: np.ndarray, u: np.ndarray, contact: np.ndarray) -> None:
        super().__init__(stepper)
        self.links = stepper.model.links
        self._stiffness, self._u, self._contact = stiffness, u, contact
        links, any_rows = self.links, bool(self.links)
        n = len(u) if any_rows else 0
        nodes, counts, loss = np.empty((2, n), dtype=np.int64), np.zeros(3, dtype=np.int64), np.zeros(2)
        two, watched = links.two, links.separate and any_rows
        rows = two.nodes, two.normals, two.least
        if not watched:
            rows = np.empty((2, 0), dtype=np.int64), np.empty((0, 3)), np.empty(0)
        moving, totals = np.arange(n) if links.dynamic else links.rows.moving, links.totals()
        self.record = CalledRows(
            any_rows, watched, moving, *rows, np.empty((n, 3)), u[:n], *nodes, counts, loss, totals
        )
        self._keep(HELD, links.pressed())
        self._count_closed()
        if any_rows:
            stepper.balance = stepper.scheme.balance(stepper.state, stepper.h)

    def _keep(self, which: int, nodes: np.ndarray) -> None:
        room = self.record.held if which == HELD else self.record.changing
        self.record.counts[which] = len(nodes)
        room[: len(nodes)] = nodes

    def _count_closed(self) -> None:
        """Count the rows without which the loop cannot go on alone: with forces, closed, or about to rebound."""
        links = self.links
        closed = (links.force > 0.0) | (links.rebound > 0.0) | (links.closed > 0)
        self.record.counts[CLOSED] = np.count_nonzero(closed)

    def _make(self, step: int, what: int) -> None:
        if what == SOLVE:
            self._solve(step)
        else:
            self._close()

    def _goes_on(self, what: int) -> bool:
        return what == SOLVE and not is_alone()

    def _solve(self, step: int) -> None:
        """Solve the rows of the balance at the end of a step of a number; if that fails, they have no forces."""
        links, record = self.links, self.record
        record.counts[:] = 0
        record.totals[:] = 0.0
        record.loss[:] = 0.0
        stepper = self.stepper
        stepper.state.time = step * stepper.h
        stepper.balance = replace(stepper.balance, predictor=record.predictor, time=(step + 1) * stepper.h)
        links.find_explicit(stepper.balance, self._u)
        load = links.explicit(stepper.balance, stepper.state, self._u, self._stiffness)
        if load is not None:
            links.push(load, self._stiffness, self._u, self._contact)
        record.totals[:], record.loss[1] = links.totals(), links.friction
        self._keep(HELD, links.pressed())
        self._count_closed()
        two = links.two
        changed = (links.force[two.at] > 0.0) != links.closed[two.at]
        if changed.any():
            nodes = two.nodes[:, changed]
            self._keep(CHANGING, np.unique(nodes[nodes >= 0]))

    def _close(self) -> None:
        """Find the energy that rows lose, from velocities and accelerations of the state at their nodes."""
        state = self.stepper.state
        state.contact = self._contact
        self.record.loss[0] = self.stepper.ledger.impacts.of_rows(state.position, (state.v, state.a), None)
        self._count_closed()


class TouchCaller(Caller):
    """Adds the forces of bars that touch in compiled steps; ``half`` (3, owned): velocities of the loop at half steps.

    Attributes
    ----------
    sums : (5,) energies stored and dissipated in the last call [J], and the columns of a row on one rank
    asleep : (8,) see :class:`~pfem_petsc.stepping.compiled_loop.StepArrays`
    """

    def __init__(self, stepper: Stepper, half: np.ndarray) -> None:
        super().__init__(stepper)
        self.sums, self.asleep, self._half, n = np.zeros(5), np.zeros(8), half, len(stepper.state.x)
        self._x, self._f = (room.T[:n] for room in stepper.model.bars.components)
        self._touch = stepper.model.self_contact

    def begin(self, step: int) -> None:
        super().begin(step)
        self._sleep()

    def end(self) -> None:
        self._pass_over(self._x)
        super().end()

    def _sleep(self) -> None:
        """Find how far the loop may go alone, and what rows have until the next call."""
        if self._touch is not None:
            self.sums[1], self.sums[2:] = self._touch.dissipated, self._touch.sums[[CONTACTS, OVERLAP, FORCE]]
            self.asleep[WAY_LEFT], self.asleep[WAY] = self._touch.way_left(), 0.0
            self.asleep[DRIFT:MOST], self.asleep[MOST:] = self._touch.drift, 0.0

    def _pass_over(self, x: np.ndarray) -> None:
        """Tell of the steps that the loop has made alone, up to positions (local, 3)."""
        if self.asleep[WAY] > 0.0:
            self._touch.pass_over(float(self.asleep[WAY]), x)
            self.asleep[WAY] = 0.0

    def _make(self, step: int, what: int) -> None:
        stepper = self.stepper
        if self.asleep[WAY] > 0.0:  # up to the start of this step
            self._pass_over(self._x[: self._half.shape[1]] - stepper.h * self._half.T)
        try:
            self.sums[0], _ = self._touch.evaluate(self._x, self._f, stepper.h, commit=True)
        except SimulationFailure as failure:
            raise SimulationFailure(f"{stepper.at(step, step * stepper.h)}: {failure}") from failure
        self._sleep()


class WallCaller(Caller):
    """Presses nodes onto surfaces of triangles and walls that turn, and moves walls with mass.

    Parameters
    ----------
    nodes, pressed : of the loop, the latter receives the nodes that walls stop
    contact : (owned, 3) contact forces of the loop [N]
    """

    def __init__(self, stepper: Stepper, nodes: Nodes, pressed: ContactNodes, contact: np.ndarray) -> None:
        super().__init__(stepper)
        self._walls, self._stiffness = stepper.model.contact, nodes.stiffness
        self._pressed, self._contact = pressed, contact
        self._record, self._found_at = new_called_walls(self._walls), -1
        if self._walls.called.any():
            stepper.balance = stepper.scheme.balance(stepper.state, stepper.h)

    def schedule(self, times: np.ndarray) -> CalledWalls:
        """Return the walls in steps between times (t,) [s], and one more."""
        record, walls, state = self._record, self._walls, self.stepper.state
        if not walls.called.any():
            return record
        angles, poses = walls.motion.turns(times)
        sums = self.stepper.solution.walls
        record.torques[:] = walls.motion.torques(sums.force, sums.moment, state.time)
        self._poses, self._force = poses, sums.force
        return record._replace(angles=angles, poses=poses)

    def _make(self, step: int, what: int) -> int | None:
        stepper, record, walls, out = self.stepper, self._record, self._walls, self._pressed
        state, some, bodies = stepper.state, record.nodes[: record.counts[SUSPECTS]], walls.motion.bodies
        state.time, state.contact, h = step * stepper.h, self._contact, stepper.h
        if what == MOVED:
            try:
                self._move(step)
            except TurnsTooFarError as failure:
                raise SimulationFailure(f"{stepper.at(step + 1, (step + 1) * h)}: {failure}") from failure
        elif what == PRESSED:
            found, self._found_at = walls.room[: record.counts[FOUND]].copy(), step
            balance = replace(stepper.balance, time=(step + 1) * h)
            try:
                stopped = walls.press_some((found, some), record.free, self._stiffness, balance)
            except OutOfReachError:
                record.reach[bodies.at] = walls.limits
                return AGAIN
            m, sums = len(stopped.walls.nodes), stopped.walls
            record.counts[FOUND], record.losses[0] = m, sums.friction
            out.nodes[:m], out.places[:m], out.touching[:m] = sums.nodes, sums.places, sums.touching
            record.force[:m] = stopped.force
            out.force[:], out.contacts[:], out.moment[:] = sums.force, sums.contacts, sums.moment
        else:
            if self._found_at != step:
                walls.forget_faces()
            bodies.finish(h, state.time)
            motion, poses = (state.v, state.a), walls.motion.poses(state.time)
            record.losses[1] = stepper.ledger.impacts.on_walls(some, state.position, motion, None, state.time, poses)
            if bodies.any:
                push, self._force = 0.5 * (self._force + out.force), out.force.copy()
                stepper.ledger.follow_bodies(push)
        return None

    def _move(self, step: int) -> None:
        """Begin the step of walls with mass; show where they are, and would be at its end without contact."""
        record, motion, h, k = self._record, self._walls.motion, self.stepper.h, step - self._begin
        bodies = motion.bodies
        bodies.begin(step * h, h)
        for at, poses in ((k, motion.poses(step * h)), (k + 1, motion.poses_without_contact((step + 1) * h))):
            turns = poses.turns[bodies.at] if len(poses.turns) else np.tile(np.eye(3), (len(bodies.at), 1, 1))
            self._poses[at, bodies.at] = np.hstack([turns.reshape(-1, 9), poses.shifts[bodies.at]])
        record.reach[bodies.at] = self._walls.limits
        record.pivots[bodies.at] = bodies.centres + bodies.unpushed()[0]

    def _goes_on(self, what: int) -> bool:
        return what == PRESSED
