"""Batches of steps: consecutive steps that need only rows of the history are made in one compiled call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..columns import ENERGIES, HEAD, WALL
from ..contact.node_walls import WallForces
from ..errors import SimulationFailure
from ..mechanics.bars import StrainEnergy
from ..mechanics.elements import batch_parts
from ..mechanics.runs import Columns, make_columns, new_planes, no_columns
from ..mesh.ordering import NODE_BLOCK
from ..parallel.heap import return_freed_memory
from ..tolerances import PROJECTED
from .batch_loop import (
    BarArrays,
    BatchData,
    ImpulseArrays,
    NodeArrays,
    ProbeArrays,
    StateArrays,
    WallArrays,
    make_fused_loop,
)
from .ledger import LeapfrogLedger
from .stepper import Solution

if TYPE_CHECKING:
    from .ledger import Ledger
    from .stepper import Stepper
    from .time_stepping import TimeStepping


MOST = 512
"""Maximum number of steps per call, whose sums are buffered."""

WORTH = 1000
"""Minimum number of steps of a run for which the fused loop is compiled, which takes some seconds once."""

_BROKEN, _ALARM = HEAD.first("broken_bars"), HEAD.first("alarm")
_WINDOW = 4  # times the nodes of the blocks that bars of one block belong to
_FEWEST = 8  # minimum number of steps for one call


class Batch:
    """Makes several steps at once.

    Attributes
    ----------
    sums : (:data:`MOST`, width) for each step, the sums that :meth:`~pfem_petsc.run.recorder.Recorder.row` uses
    """

    def __init__(self, stepper: Stepper, ledger: LeapfrogLedger, recorder: Any) -> None:
        self.stepper, self.ledger = stepper, ledger
        model = stepper.model
        self.model = model
        block = model.bars.blocks[0]
        self._loop = make_fused_loop(*batch_parts(block.loops))
        bars = model.bars
        counted = block.counted - block.start
        reach, columns = self._reach(), self._columns()
        self._bars = BarArrays(
            bars.data(block)._replace(step=stepper.h),
            bars.watched,
            block.law.slack_row,
            counted,
            reach,
            self._meeting(),
            bars.can_break,
            columns,
            *self._planes(reach, columns),
        )
        supports, inertia, contact = model.supports, model.inertia, model.contact
        nothing = np.empty((0, 3))
        external = stepper.state.external if model.external.active else nothing
        damping = inertia.damping if inertia.damped else np.empty(0)
        order = np.argsort(supports.nodes, kind="stable")
        held = supports.positions(0.0)[order]
        nodes = supports.nodes[order]
        limits = np.arange(0, len(inertia.mass) + NODE_BLOCK, NODE_BLOCK)
        starts = np.searchsorted(nodes, limits).astype(np.int64)
        self._nodes = NodeArrays(inertia.mass, damping, external, nodes, supports.components[order], held, starts)
        log = contact.log
        walls = (contact.fixed, contact.normals, contact.plane_offsets(0.0), contact.all_nodes, contact.members)
        room = np.empty(len(inertia.mass), dtype=np.int64)
        work = (room, log.touching, log.present, log.releases)
        impact = (stepper.closed, contact.restitution, ledger.impacts.slack)
        self._walls = WallArrays(*walls, PROJECTED * model.size, *work, *impact)
        self._probes = ProbeArrays(*recorder.probed())
        self._messages = model.mesh.messages()
        alpha, eta = 1.0 / (stepper.h * stepper.h), 0.5 / stepper.h
        stiffness = alpha * inertia.mass + (eta * inertia.damping if inertia.damped else 0.0)
        self._stiffness = stiffness if model.links else np.empty(0)
        self.sums = np.zeros((MOST, recorder.width))
        self._first = True

    def _columns(self) -> Columns:
        """Return the columns of the bars, or none if bars are heated, can break or are not in diagonal runs."""
        bars = self.model.bars
        block = bars.blocks[0]
        if bars.can_break or bars.heat.size or not len(bars.rest) or not block.sweep.diagonal.all():
            return no_columns(block.area, len(block.history))
        return make_columns(block.sweep, bars.rest, block.area, len(block.history))

    def _planes(self, reach: int, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
        """Return planes for all nodes; on one rank for a window of them, which stays in the cache."""
        nodes = len(self.model.mesh.points) if len(columns.parts) else 0
        if self.model.comm.size == 1:
            nodes = min(nodes, _WINDOW * (reach + 1) * NODE_BLOCK)
        return new_planes(nodes)

    def _reach(self) -> int:
        """Return how many blocks of nodes beyond its own the bars of a block reach."""
        ends = self.model.bars.ends
        blocks = ends.max(axis=1) // NODE_BLOCK - ends.min(axis=1) // NODE_BLOCK
        return int(blocks.max(initial=0))

    def _meeting(self) -> int:
        """Return the first block of nodes that needs ghosts, or whose nodes have bars that other ranks count.

        Forces of these bars come first at each node: a block before must neither have nor reach such a node.
        """
        ends, n_owned = self.model.bars.ends, len(self.model.inertia.mass)
        block = self.model.bars.blocks[0]
        late = np.zeros(len(self.model.mesh.points), dtype=bool)
        late[n_owned:] = True
        late[ends[block.counted - block.start :].reshape(-1)] = True
        reached = ends[late[ends].any(axis=1)]
        return int(reached.min(initial=n_owned)) // NODE_BLOCK

    @staticmethod
    def serves(stepper: Stepper, ledger: Ledger) -> bool:
        """Return whether the fused loop applies to this rank's part of the steps of a run or stage."""
        from petsc4py import PETSc

        model = stepper.model
        alone = model.comm.size == 1
        return (
            # -log_view measures the methods of single steps
            not PETSc.Log.isActive()
            # all ranks would have to stop where a bar of one breaks
            and (alone or not model.bars.can_break)
            and model.mesh.messages() is not None
            and isinstance(ledger, LeapfrogLedger)
            and model.steady
            and all(energy.value is None for energy in ENERGIES)
        )

    def make(self, due: np.ndarray) -> tuple[int, np.ndarray]:
        """Make up to ``len(due)`` steps; return their number and the walls touched in each (steps, walls) bool.

        ``due`` (count,) bool: whether a row of the history is due after each step. On one rank fewer steps are made if
        a bar breaks. The same holds if a bar fails, a node is infeasible or the energy is not finite; the stepper then
        has a fault. With several ranks all make all steps, but this rank's state remains that of a failure.
        """
        stepper, ledger, state = self.stepper, self.ledger, self.stepper.state
        log, scheme = self.model.contact.log, stepper.scheme
        begin, known = state.step, stepper.fault
        walls = len(self.model.contact.walls)
        support, contact = (
            np.zeros_like(state.v) if array is stepper.zero else array for array in (state.support, state.contact)
        )
        energies = np.array(stepper.energy.energies)
        arrays = StateArrays(state.f, state.a, state.v, support, contact, energies)
        half = state.memory["half_velocity"]
        pushed = ledger.impulses.state
        impulses = ImpulseArrays(pushed.memory["half_velocity"], pushed.a, pushed.v)
        ledger.sums[_BROKEN] = stepper.ruptures.count
        stepper.other_force, stepper.solution.u = None, stepper.zero  # room for what the loop needs
        if self._first:
            return_freed_memory()
            self._first = False
        rows = self.model.links.export_rows(self._stiffness)
        motion = stepper.h, state.x, stepper.before, half
        constant = self._bars, self._nodes, self._walls, rows, self._probes, self._messages
        data = BatchData(*motion, *constant, arrays, ledger.sums, ledger.powers, impulses)
        done, lost, changed, failed, turned, infeasible, offsets, kinetic, u, touched, log.last, met, held = self._loop(
            data, log.last, ledger.impacts.met, due, self.sums
        )
        self.model.links.import_rows(rows)
        if lost:
            raise MPI.Exception(lost)
        state.support = support if self.model.supports.any else stepper.zero
        state.contact = contact if held else stepper.zero
        stepper.energy = StrainEnergy(tuple(energies.tolist()), failed)
        nothing = self.model.contact.nothing
        stepper.solution = Solution(u, state.f, WallForces(*touched) if walls else nothing, contacts=held)
        state.step, state.time = begin + done - 1, (begin + done) * stepper.h
        stepper.balance = scheme.balance(state, stepper.h)
        if changed:
            stepper.ruptures.note(state.x, stepper.number + 1, stepper.arrived())
            self.sums[done - 1, _BROKEN] = stepper.ruptures.count
        if known is not None:  # of earlier steps; the ranks have not synchronised since
            self.sums[: len(due), _ALARM] = 1.0
        elif failed >= 0 or turned >= 0:
            stepper.fault = SimulationFailure(stepper.collapse(max(failed, turned)))
        elif infeasible >= 0:
            text = self.model.contact.infeasible_message(touched[3][infeasible], offsets)
            stepper.fault = SimulationFailure(f"{stepper.when(stepper.balance)}: {text}")
        done = done if self.model.comm.size == 1 else len(due)
        state.step, state.time = begin + done, (begin + done) * stepper.h
        ledger.impacts.met = met
        ledger.resume(kinetic)
        share = self.sums[:done, HEAD.width + 1 : HEAD.width + 1 + WALL.width * walls]
        flags = share.reshape(done, walls, WALL.width)[:, :, WALL.first("contacts")] > 0.0
        return done, flags


class Batches:
    """Finds steps of a run that can be fused, and makes them.

    Parameters
    ----------
    min_steps : minimum number of steps of a run for which the fused loop is compiled
    """

    def __init__(self, min_steps: int = WORTH) -> None:
        self._min_steps = min_steps
        self._batch: Batch | None = None
        self._refused = False
        self._changes = 0

    def anew(self) -> Batches:
        """The same for the next stage."""
        return Batches(self._min_steps)

    def advance(self, analysis: TimeStepping, history: Any, left: int) -> bool:
        """Make fused steps that need only rows of the history.

        Parameters
        ----------
        analysis : TimeStepping
        history : History
            Receives the rows.
        left : number of steps before other outputs are due

        Returns
        -------
        bool
            False if a step failed; the stepper then has a fault.
        """
        stepper, state, end = analysis.stepper, analysis.state, analysis.last_step
        begin = state.step
        count = min(left, end - begin, MOST + 1, stepper.removals.steps_left(state.time, stepper.h)) - 1
        if self._refused or count < _FEWEST or end < self._min_steps or not history.ledger.begun:
            return True
        if self._changes != stepper.support_changes:
            # the forces of the last step act at supports that are gone; the arrays of the loop alternate
            self._changes, self._batch = stepper.support_changes, None
            return True
        if self._batch is None:
            serves = Batch.serves(stepper, history.ledger)
            self._refused = not analysis.model.comm.allreduce(serves, op=MPI.LAND)
            if self._refused:
                return True
            self._batch = Batch(stepper, history.ledger, history.recorder)
        numbers = range(stepper.number + 1, stepper.number + count + 1)
        due = np.array([history.due(number) for number in numbers])
        made, touched = self._batch.make(due)
        contact, comm = analysis.model.contact, analysis.model.comm
        failed = stepper.fault is not None and comm.size == 1
        for k in range(made - failed):
            sums = self._batch.sums[k]
            state.step, state.time = begin + k + 1, (begin + k + 1) * stepper.h
            if contact.any:
                contact.log.note(touched[k], stepper.h, comm)
                contact.log.changes += int(sums[HEAD.width])
                sums[HEAD.width] = contact.log.changes
            if due[k] and not history.take_sums(sums):
                return False
        if failed:
            state.step, state.time = begin + made, (begin + made) * stepper.h
        return not failed
