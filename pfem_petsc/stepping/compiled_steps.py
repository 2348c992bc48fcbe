"""Steps of central differences that nothing outside interrupts, made in compiled calls: what the loop needs of a
stepper, and what the stepper takes from it."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from mpi4py import MPI
from numba import types

from ..columns import BAR_ENERGIES, HEAD, Share, at_state, fill_at_state
from ..contact.explicit import kind_of
from ..contact.node_walls import NOTED, WallForces
from ..contact.surfaces import OTHER
from ..errors import SimulationFailure
from ..mechanics.bars import StrainEnergy
from ..mechanics.chunk_laws import first_class
from ..mechanics.compiled import COMPILED, References, by_reference
from ..mesh.exchange import SIGNATURES, CFunction, mpi_functions
from ..mesh.ordering import NODE_BLOCK
from ..parallel.heap import return_freed_memory
from .called_walls import close_on_called, press_called, work_of_turns
from .callers import Caller, RowCaller, TouchCaller, WallCaller
from .compiled_loop import (
    AGREE,
    BEGIN,
    BOOK,
    END,
    FORCES,
    HELD,
    IMPACTS,
    PRESS,
    RECORD,
    SEND,
    TAKE,
    Calls,
    Contacts,
    ImpulseArrays,
    StateArrays,
    StepArrays,
    StepBars,
    agree,
    book_springs,
    close_called,
    evaluate_forces,
    join_pressing,
    push_particles,
    put_state,
    record_row,
    run_compiled,
    send_positions,
    set_loads,
    solve_called,
    sum_ends,
    take_positions,
    touch_bars,
)
from .contact_phase import (
    WallArrays,
    close_on_walls,
    new_contact_nodes,
    place_walls,
    press_walls,
    work_of_walls,
)
from .impulses import WALLS
from .phases import (
    CHANGED,
    COLLAPSED,
    DONE,
    INFEASIBLE,
    MPI_ERROR,
    NEAR,
    PASSED,
    PRESSING,
    RECORDED,
    TURNED,
    UNSOLVED,
    WHY,
    GroundSprings,
    Motion,
    MovingSupports,
    Nodes,
    Prescribed,
    accumulate_loads,
    add_springs,
    apply_supports,
    balancing,
    correct_moving,
    correct_moving_ends,
    new_sums,
    place_supports,
    react,
)
from .stepper import Instants, Solution

if TYPE_CHECKING:
    from .stepper import Stepper


_BARS, _BROKEN = HEAD.indices(BAR_ENERGIES), HEAD.first("broken_bars")


class CompiledSteps:
    """Makes steps of a stepper in compiled calls, as long as its supports remain.

    Parameters
    ----------
    stepper : Stepper that :meth:`serves`
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model, self.ledger = stepper, stepper.model, stepper.ledger
        model, state, n = self.model, stepper.state, len(stepper.state.v)
        self._u, zero = np.zeros_like(state.v), stepper.zero  # which nothing writes to
        self._reaction = np.zeros_like(state.v) if model.supports.any else zero
        self._contact = np.zeros_like(state.v) if model.can_touch else zero
        if state.contact is not stepper.zero:
            self._contact[:] = state.contact
        stepper.balance = None  # its predictor is not needed any more
        places, forces = model.bars.components
        self._motion = Motion(stepper.h, places, np.empty((3, n)), np.zeros((3, n)), forces, self._contact)
        self._nodes, self._held, self._walls = self._make_nodes(), self._make_held(), self._make_walls()
        self._at_rest, ground = self._moving_supports(0, 0), model.bars.springs
        self._springs = GroundSprings(np.empty(0, dtype=np.int64), np.empty((0, 3, 3)), np.empty((0, 3)))
        if ground is not None:
            self._springs = GroundSprings(ground.nodes, ground.stiffness, ground.anchors)
        # the forces on the particles of the impulses are the sums of steps, walls and rows
        impulses = self.ledger.impulses
        self._loads, rows = np.zeros_like(impulses.state.v), WALLS + impulses.n_walls
        self._sums = new_sums()._replace(forces=self._loads[:WALLS])
        self._pressed = new_contact_nodes(n, len(model.contact.wall_of), self._loads[WALLS:rows])
        totals, torques = self._loads[rows : impulses.jumps], self._loads[impulses.turns :][: impulses.n_walls]
        self._rows = RowCaller(stepper, self._nodes.stiffness, self._u, self._contact, totals)
        self._touch = TouchCaller(stepper, self._motion.half)
        self._wall_caller = WallCaller(stepper, self._nodes, self._pressed, self._contact, torques)
        self._caller = Caller(self._rows, self._touch, self._wall_caller)
        self._messages, self._calls = model.mesh.messages(), Calls(*_mpi(), self._caller.function)
        self._references, self._phases = References(), None
        self._energies, self._course = np.zeros(len(BAR_ENERGIES)), np.zeros(PRESSING + 1, dtype=np.int64)
        bars, nodes = model.probed_bars.width, stepper.probed
        share = Share(len(model.contact.names), len(model.links.columns), bars, len(nodes))
        self._width, self._at_state = len(share.numbers), at_state(model)
        at = self._width - share.probes.size
        self._bar_probes = slice(at - bars, at)
        self._ends_at_rows = bars > 0 or not all(column.looped for column in self._at_state)
        self._ends_at_rows |= model.contact.motion.bodies.any  # rows have where they are
        self._ends_at_rows |= model.self_contact is not None and model.comm.size > 1  # and what is largest on all ranks
        return_freed_memory()

    def _make_nodes(self) -> Nodes:
        model, h = self.model, self.stepper.h
        inertia = model.inertia
        external = self.stepper.state.external.T.copy() if model.external.active else np.empty((3, 0))
        damping = inertia.damping if inertia.damped else np.empty(0)
        stiffness = 1.0 / (h * h) * inertia.mass + (0.5 / h * inertia.damping if inertia.damped else 0.0)
        return Nodes(inertia.mass, damping, stiffness, 1.0 / stiffness, external)

    def _make_held(self) -> Prescribed:
        supports = self.model.supports
        half, u, load = np.zeros((3, len(supports.nodes)))
        return Prescribed(supports.nodes, supports.components, supports.origins.copy(), half, u, load, self._reaction)

    def _make_walls(self) -> WallArrays:
        contact, log, n = self.model.contact, self.model.contact.log, len(self._u)
        called = contact.called[contact.wall_of]
        surfaces = contact.surfaces._replace(radii=np.where(called, OTHER, contact.surfaces.radii))
        acting = self.stepper.scheme.balance(self.stepper.state, self.stepper.h).acting
        level = surfaces.copy()
        walls = contact.pressed_walls(surfaces.copy(), acting, np.zeros_like(level.centres))
        room = np.empty((3, n if len(contact.walls) else 0)), np.zeros(n // NODE_BLOCK + 1, dtype=bool)
        motions, touched = self._wall_motions(0, 0), self.ledger.impacts.touched
        return WallArrays(walls, surfaces, level, motions, touched, log.present, log.releases, *room)

    def _moving_supports(self, begin: int, count: int) -> MovingSupports:
        """Return the supports that move in ``count`` steps from one of a number on."""
        supports, at = self.model.supports, np.flatnonzero(self.model.supports.columns >= 0)
        motions = supports.schedule(self._times(begin, count if supports.moves else -2), self.stepper.h)
        return MovingSupports(at, supports.columns[at], supports.origins[at], motions)

    def _contacts(self) -> Contacts:
        """Return the contacts before the first step."""
        log, friction = self.model.contact.log, float(self.ledger.friction_ahead)
        met = np.flatnonzero(log.closed.any(axis=1))
        called = self._rows.record
        others = called.held[: called.counts[HELD]].copy()
        nodes = log.last, others, np.concatenate([log.last, others])
        return Contacts(log.last, met, log.changes, friction, *nodes, 0.0)

    def _make_phases(self, signature: Any) -> tuple[Any, np.ndarray]:
        """Return the phases of a step that this case needs, and where those of each time begin."""
        model = self.model
        damped, loaded, held = model.inertia.damped, model.external.active, len(self._held.nodes) > 0
        called, walls = self._rows.record.any, len(model.contact.walls) > 0
        several, springs, moves = model.comm.size > 1, len(self._springs.nodes) > 0, model.supports.moves
        touch, walls_move = walls or called, model.contact.moving.any()
        pressed, close = self._walls.pressed, close_on_walls
        press = press_walls(*kind_of(pressed.surfaces.radii, pressed.friction)) if walls else None
        if model.contact.called.any():
            press, close = press_called, close_on_called
        chosen = {
            BEGIN: (
                (place_supports, moves),
                (place_walls, walls_move),
                (set_loads, loaded and not model.external.steady),
            ),
            SEND: ((send_positions, several),),
            TAKE: ((take_positions, several),),
            FORCES: (
                (evaluate_forces, True),
                (add_springs, springs),
                (touch_bars, model.self_contact is not None),
                (balancing(loaded, damped), True),
                (apply_supports, held),
            ),
            PRESS: (
                (solve_called, called),
                (press, walls),
                (react, held),
                (join_pressing, touch),
            ),
            IMPACTS: ((close, walls), (close_called, called)),
            BOOK: (
                (book_springs, springs),
                (correct_moving, moves),
                (work_of_turns, model.contact.motion.turning.any()),
                (push_particles, True),
                (work_of_walls, walls_move),
            ),
            AGREE: ((agree, several and (model.bars.can_break or called or model.contact.motion.bodies.any)),),
            END: ((put_state, True),),
            RECORD: (
                (sum_ends, True),
                (accumulate_loads, loaded or damped),
                (correct_moving_ends, moves),
                (record_row, True),
            ),
        }
        phases = [[phase for phase, needed in chosen[when] if needed] for when in sorted(chosen)]
        starts = np.cumsum([0, *map(len, phases)])
        return first_class([phase for some in phases for phase in some], signature), starts

    def _times(self, begin: int, count: int) -> np.ndarray:
        """Return the times of the start of ``count`` steps from one of a number on, of their ends, and of one more."""
        return np.arange(begin, begin + count + 2) * self.stepper.h

    def _wall_motions(self, begin: int, count: int) -> np.ndarray:
        contact = self.model.contact
        return contact.motion.schedule(self._times(begin, count if contact.moving.any() else -2))

    @staticmethod
    def serves(stepper: Stepper) -> bool:
        """Return whether steps of this stepper can be made in compiled calls. Collective."""
        from petsc4py import PETSc

        model = stepper.model
        serves = (
            stepper.scheme.leapfrog
            and stepper.treatment is None
            # -log_view measures the methods of single steps
            and not PETSc.Log.isActive()
            and COMPILED
            and (model.comm.size == 1 or mpi_functions() is not None)
            and model.steady
        )
        return model.comm.allreduce(serves, op=MPI.LAND)

    def make(self, most: int, left: int) -> None:
        """Make up to ``most`` steps, and up to the one after which bars or supports are removed, of which there are
        ``left``; the last one remains to be counted. What rows of the history need of those that are due is collected,
        see :attr:`~pfem_petsc.stepping.stepper.Stepper.instants`, except for a step with a removal, which changes it.

        Fewer steps are made if a bar of any rank breaks, and if something fails; but several ranks whose bars cannot
        break, and whose rows are on one rank each, make all steps, though the state remains that of the failure. The
        stepper then has a fault.
        """
        stepper, ledger, state, model = self.stepper, self.ledger, self.stepper.state, self.model
        log, comm, due = model.contact.log, model.comm, self._due(min(most, left))
        count = len(due)
        due[-1] = due[-1] and count < left
        steps = np.flatnonzero(due)
        shares = np.zeros((len(steps) + (0 if due[-1] else 1), self._width))
        begin, impulses = state.step, ledger.impulses.state
        flags = np.zeros((count, len(log.releases)), dtype=bool)
        self._caller.begin(begin)
        self._touch.sleep()
        contacts = self._contacts()
        ledger.sums[_BROKEN] = stepper.ruptures.count
        half, walls = state.memory["half_velocity"], self._walls
        if model.contact.moving.any():
            walls = walls._replace(motions=self._wall_motions(begin, count))
        self._course[:] = 0
        impulses.a = self._loads
        bars = model.bars
        laws = bars.loops("brief"), bars.loops("full")
        arrays = StepArrays(
            by_reference(contacts),
            self._course,
            self._nodes,
            self._motion,
            self._held,
            self._moving_supports(begin, count) if model.supports.moves else self._at_rest,
            self._springs,
            StepBars(bars.reference, *laws, bars.ends, bars.watched, bars.can_break),
            model.external.schedule(range(begin + 1, begin + 1 + count), stepper.h),
            walls,
            self._wall_caller.schedule(self._times(begin, count)),
            self._rows.record,
            self._sums,
            self._pressed,
            self._messages,
            self._calls,
            StateArrays(state.x, stepper.before, state.f, half, self._u, state.v, state.a),
            ledger.sums,
            ledger.powers,
            self._energies,
            ImpulseArrays(impulses.memory["half_velocity"], impulses.a, impulses.v),
            stepper.probed,
            stepper.solution.walls.force.copy(),
            self._touch.sums,
            self._touch.asleep,
            shares,
        )
        reference = self._references.of(arrays)
        if self._phases is None:
            self._phases = self._make_phases(types.void(numba.typeof(reference), types.int64))
        contacts = Contacts(*run_compiled(reference, *self._phases, due, flags), *contacts[4:])
        self._touch.wake(bars.components[0].T[: len(state.x)])
        self._caller.end()
        made = self._course.tolist()
        if made[MPI_ERROR]:
            raise MPI.Exception(made[MPI_ERROR])
        end, row = made[PASSED], shares[made[RECORDED] - 1]
        sound = self._take(made, contacts, row[_BARS])
        fill_at_state(self._at_state, stepper, row)
        model.probed_bars.fill(model.bars, state.x, row[self._bar_probes])
        ledger.follow_compiled(row[: HEAD.width], contacts.friction)
        log.changes, noted = contacts.changes, np.zeros(end, dtype=np.int64)
        if len(log.releases):
            noted += log.note(flags[:end], stepper.h, comm) + 1 + np.arange(end)
        steps = steps[steps < end]
        if len(steps):
            shares, unsound = shares[: len(steps)], steps >= sound
            shares[unsound] = 0.0
            shares[unsound, HEAD.first("alarm")] = 1.0
            number = begin + steps + 1
            time = number * stepper.h
            stepper.instants = Instants(model.first_step + number, model.origin + time, time, shares, noted[steps])

    def _take(self, made: list[int], contacts: Contacts, energies: np.ndarray) -> int:
        """Take the state after the last step, with ``energies`` of the bars [J]; return how many steps are sound."""
        stepper, state, model = self.stepper, self.stepper.state, self.model
        model.contact.log.last = contacts.touched
        state.support = self._reaction if model.supports.any else stepper.zero
        state.contact = self._contact if made[PRESSING] else stepper.zero
        if not model.external.steady:
            state.external = self._nodes.external.T.copy()
        stepper.energy = StrainEnergy(tuple(energies.tolist()), made[COLLAPSED])
        walls, pressed = model.contact.nothing, self._pressed
        if len(model.contact.walls):
            sums = pressed.force.copy(), pressed.contacts.copy(), pressed.moment.copy()
            nodes = (of[: made[NEAR]].copy() for of in (pressed.nodes, pressed.touching, pressed.places))
            walls = WallForces(*sums, *nodes, contacts.friction)
        stepper.solution = Solution(self._u, state.f, walls, contacts=made[PRESSING])
        begin = state.step
        state.step, state.time = begin + made[DONE] - 1, (begin + made[DONE]) * stepper.h
        if made[CHANGED]:
            stepper.ruptures.note(state.x, stepper.number + 1, stepper.arrived())
            stepper.bars_left()
        sound = made[DONE]
        if stepper.fault is not None:  # that of an earlier call, of which not all ranks know
            sound = 0
        elif (failure := self._failure(made)) is not None:
            stepper.fault, sound = failure, made[DONE] - 1
        state.step, state.time = begin + made[PASSED] - 1, (begin + made[PASSED]) * stepper.h
        return sound

    def _due(self, count: int) -> np.ndarray:
        """Return which of up to ``count`` steps to come have a row of the history; a row with values that the loop does
        not have, such as the number of slack bars, ends the call, as they are those of the state."""
        every = self.stepper.row_every
        numbers = self.stepper.number + 1 + np.arange(min(count, NOTED))
        due = numbers % every == 0 if every else np.zeros(len(numbers), dtype=bool)
        if self._ends_at_rows and due.any():
            due = due[: int(np.argmax(due)) + 1]
        return due

    def _failure(self, made: list[int]) -> SimulationFailure | None:
        """Return the failure in the last step, None for none."""
        stepper, pressed = self.stepper, self._pressed
        if made[COLLAPSED] >= 0 or made[TURNED] >= 0:
            return SimulationFailure(stepper.collapse(max(made[COLLAPSED], made[TURNED])))
        balance, at = stepper.scheme.balance(stepper.state, stepper.h), made[INFEASIBLE]
        text: object = self._caller.failure if made[UNSOLVED] else None
        if at >= 0:
            text = self.model.contact.placeless(pressed.nodes[at], made[WHY], pressed.places[at], balance.time)
        return None if text is None else SimulationFailure(f"{stepper.when(balance)}: {text}")


def _mpi() -> tuple[CFunction, ...]:
    """Return the functions of MPI that a loop calls on several ranks; one rank calls none."""
    found = mpi_functions()
    if found is None:
        return tuple(CFunction(ctypes.pythonapi.Py_IsInitialized, signature) for signature in SIGNATURES.values())
    return found
