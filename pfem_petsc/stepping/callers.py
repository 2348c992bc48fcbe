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
from .called_walls import (
    AGAIN,
    CLOSE,
    FOUND,
    MOVE,
    PRESS,
    SOLVE,
    STOP,
    SUSPECTS,
    TOUCH,
    CalledWalls,
    new_called_walls,
)
from .compiled_loop import CHANGING, CLOSED, DRIFT, HELD, MOST, WAY, WAY_LEFT, CalledRows
from .phases import FAILED, LOST

if TYPE_CHECKING:
    from .contact_phase import ContactNodes
    from .phases import Nodes
    from .stepper import Stepper


class Caller:
    """Makes something of a step when a compiled loop asks for it.

    Attributes
    ----------
    function : that the loop calls, with the number of a step of its own, and what to do
    failure : SimulationFailure of the last call of the loop, if that goes on, or None
    """

    def __init__(self, rows: RowCaller, bars: TouchCaller, walls: WallCaller) -> None:
        self._makes = {
            SOLVE: rows.solve,
            CLOSE: rows.close,
            TOUCH: bars.touch,
            MOVE: walls.move,
            PRESS: walls.press,
            STOP: walls.stop,
        }
        self._begin, self._error = 0, None
        self.failure: SimulationFailure | None = None
        self._function = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(self._call)
        self.function = CFunction(self._function, types.int64(types.int64, types.int64))

    def begin(self, step: int) -> None:
        """Prepare calls in steps from one of a number on."""
        self._begin, self.failure = step, None

    def end(self) -> None:
        """Raise what went wrong in a call, except :attr:`failure`."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _call(self, step: int, what: int) -> int:
        if self._error is not None:
            return LOST
        try:
            return self._makes[what](self._begin + step + 1) or 0
        except BaseException as error:  # noqa: BLE001  # an exception cannot pass the compiled loop: end raises it
            # after a failure of rows or walls the loop goes on, as other ranks need messages
            if isinstance(error, SimulationFailure) and (what == PRESS or (what == SOLVE and not is_alone())):
                self.failure = error
                return FAILED
            self._error = error
            return LOST


class RowCaller:
    """Solves rows when a compiled loop asks for it.

    The loop calls when the nodes have moved without rows, in each step unless it can see that none of them is closed,
    and again if rows have closed or opened, when the velocities at their nodes are known.

    Attributes
    ----------
    record : CalledRows, whose ``totals`` are given
    """

    def __init__(
        self, stepper: Stepper, stiffness: np.ndarray, u: np.ndarray, contact: np.ndarray, totals: np.ndarray
    ) -> None:
        self.stepper, self.links = stepper, stepper.model.links
        self._stiffness, self._u, self._contact = stiffness, u, contact
        links, any_rows = self.links, bool(self.links)
        n = len(u) if any_rows else 0
        nodes, counts, loss = np.empty((2, n), dtype=np.int64), np.zeros(3, dtype=np.int64), np.zeros(2)
        two, watched = links.two, links.separate and any_rows
        rows = two.nodes, two.normals, two.least
        if not watched:
            rows = np.empty((2, 0), dtype=np.int64), np.empty((0, 3)), np.empty(0)
        moving = np.arange(n) if links.dynamic else links.rows.moving
        totals[:] = links.totals()
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

    def solve(self, step: int) -> None:
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

    def close(self, step: int) -> None:
        """Find the energy that rows lose, from velocities and accelerations of the state at their nodes."""
        state = self.stepper.state
        state.contact = self._contact
        self.record.loss[0] = self.stepper.ledger.impacts.of_rows(state.position, (state.v, state.a), None)
        self._count_closed()


class TouchCaller:
    """Adds the forces of bars that touch in compiled steps; ``half`` (3, owned): velocities of the loop at half steps.

    Attributes
    ----------
    sums : (5,) energies stored and dissipated in the last call [J], and the columns of a row on one rank
    asleep : (8,) see :class:`~pfem_petsc.stepping.compiled_loop.StepArrays`
    """

    def __init__(self, stepper: Stepper, half: np.ndarray) -> None:
        self.stepper = stepper
        self.sums, self.asleep, self._half, n = np.zeros(5), np.zeros(8), half, len(stepper.state.x)
        self._x, self._f = (room.T[:n] for room in stepper.model.bars.components)
        self._touch = stepper.model.self_contact

    def sleep(self) -> None:
        """Find how far the loop may go alone, and what rows have until the next call."""
        if self._touch is not None:
            self.sums[1], self.sums[2:] = self._touch.dissipated, self._touch.sums[[CONTACTS, OVERLAP, FORCE]]
            self.asleep[WAY_LEFT], self.asleep[WAY] = self._touch.way_left(), 0.0
            self.asleep[DRIFT:MOST], self.asleep[MOST:] = self._touch.drift, 0.0

    def wake(self, x: np.ndarray) -> None:
        """Tell of the steps that the loop has made alone, up to positions (local or owned, 3)."""
        if self.asleep[WAY] > 0.0:
            self._touch.pass_over(float(self.asleep[WAY]), x)
            self.asleep[WAY] = 0.0

    def touch(self, step: int) -> None:
        """Add the forces at the positions of the loop, at the end of a step of a number."""
        stepper = self.stepper
        if self.asleep[WAY] > 0.0:  # up to the start of this step
            self.wake(self._x[: self._half.shape[1]] - stepper.h * self._half.T)
        try:
            self.sums[0], _ = self._touch.evaluate(self._x, self._f, stepper.h, commit=True)
        except SimulationFailure as failure:
            raise SimulationFailure(f"{stepper.at(step, step * stepper.h)}: {failure}") from failure
        self.sleep()


class WallCaller:
    """Presses nodes onto surfaces of triangles and walls that turn, and moves walls with mass.

    Parameters
    ----------
    nodes, pressed : of the loop, the latter receives the nodes that walls stop
    contact : (owned, 3) contact forces of the loop [N]
    torques : (walls, 3) those of the impulses, or (0, 3) if no wall turns
    """

    def __init__(
        self, stepper: Stepper, nodes: Nodes, pressed: ContactNodes, contact: np.ndarray, torques: np.ndarray
    ) -> None:
        self.stepper, self._walls, self._stiffness = stepper, stepper.model.contact, nodes.stiffness
        self._pressed, self._contact = pressed, contact
        self._record, self._found_at = new_called_walls(self._walls, torques), -1
        if self._walls.called.any():
            stepper.balance = stepper.scheme.balance(stepper.state, stepper.h)

    def schedule(self, times: np.ndarray) -> CalledWalls:
        """Return the walls in steps between times (t,) [s], and one more."""
        record, walls, state = self._record, self._walls, self.stepper.state
        if not walls.called.any():
            return record
        angles, poses = walls.motion.turns(times)
        sums = self.stepper.solution.walls
        if len(record.torques):
            record.torques[:, 0] = walls.motion.torques(sums.force, sums.moment, state.time)
        self._poses, self._force, self._begin = poses, sums.force, state.step
        return record._replace(angles=angles, poses=poses)

    def move(self, step: int) -> None:
        """Begin the step of walls with mass; show where they are, and would be at its end without contact."""
        stepper, record, motion, k = self.stepper, self._record, self._walls.motion, step - self._begin
        bodies, start, end = motion.bodies, step * stepper.h, (step + 1) * stepper.h
        stepper.state.time, stepper.state.contact = start, self._contact
        try:
            bodies.begin(start, stepper.h)
            for at, poses in ((k, motion.poses(start)), (k + 1, motion.poses_without_contact(end))):
                turns = poses.turns[bodies.at] if len(poses.turns) else np.tile(np.eye(3), (len(bodies.at), 1, 1))
                self._poses[at, bodies.at] = np.hstack([turns.reshape(-1, 9), poses.shifts[bodies.at]])
        except TurnsTooFarError as failure:
            raise SimulationFailure(f"{stepper.at(step + 1, end)}: {failure}") from failure
        record.reach[bodies.at] = self._walls.limits
        record.pivots[bodies.at] = bodies.centres + bodies.unpushed()[0]

    def press(self, step: int) -> int:
        """Press the nodes that have been found onto walls; return whether more are to be found."""
        stepper, record, walls, out = self.stepper, self._record, self._walls, self._pressed
        stepper.state.time, stepper.state.contact, h = step * stepper.h, self._contact, stepper.h
        found, some = walls.room[: record.counts[FOUND]].copy(), record.nodes[: record.counts[SUSPECTS]]
        self._found_at = step
        try:
            balance = replace(stepper.balance, time=(step + 1) * h)
            stopped = walls.press_some((found, some), record.free, self._stiffness, balance)
        except OutOfReachError:
            record.reach[walls.motion.bodies.at] = walls.limits
            return AGAIN
        m, sums = len(stopped.walls.nodes), stopped.walls
        record.counts[FOUND], record.losses[0], record.force[:m] = m, sums.friction, stopped.force
        out.nodes[:m], out.places[:m], out.touching[:m] = sums.nodes, sums.places, sums.touching
        out.force[:], out.contacts[:], out.moment[:] = sums.force, sums.contacts, sums.moment
        return 0

    def stop(self, step: int) -> None:
        """Find the energy that nodes lose that begin or cease to touch walls; end the step of walls with mass."""
        stepper, record, walls, state = self.stepper, self._record, self._walls, self.stepper.state
        state.time, state.contact, bodies = step * stepper.h, self._contact, walls.motion.bodies
        if self._found_at != step:
            walls.forget_faces()
        bodies.finish(stepper.h, state.time)
        some, motion, poses = (
            record.nodes[: record.counts[SUSPECTS]],
            (state.v, state.a),
            walls.motion.poses(state.time),
        )
        record.losses[1] = stepper.ledger.impacts.on_walls(some, state.position, motion, None, state.time, poses)
        if bodies.any:
            push, self._force = 0.5 * (self._force + self._pressed.force), self._pressed.force.copy()
            stepper.ledger.follow_bodies(push)
