"""Batches of steps: consecutive steps of central differences in one compiled call; a single step is a batch of one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ..columns import BAR_ENERGIES, HEAD, Share, at_state, fill_at_state
from ..contact.node_walls import NOTED, WallForces
from ..errors import SimulationFailure
from ..mechanics.bars import StrainEnergy
from ..mechanics.compiled import COMPILED, packed
from ..mechanics.elements import PulledBars, pull_addresses
from ..mechanics.runs import Columns, make_columns, new_planes, no_columns
from ..mesh.ordering import NODE_BLOCK
from ..parallel.heap import return_freed_memory
from ..tolerances import PROJECTED
from .batch_blocks import BarArrays, NodeArrays, StateArrays
from .batch_contact import WallArrays
from .batch_history import ImpulseArrays, ProbeArrays
from .batch_loop import BatchData, Made, batch_loop
from .batch_rows import RowCaller
from .batch_supports import MovingSupports, SpringArrays
from .impact import Touched
from .stepper import Instants, Solution

if TYPE_CHECKING:
    from .stepper import Stepper


_BARS, _BROKEN = HEAD.indices(BAR_ENERGIES), HEAD.first("broken_bars")
_WINDOW = 4  # times the nodes of the blocks that bars of one block belong to


def _starts(nodes: np.ndarray, owned: int) -> np.ndarray:
    """Return the first of some nodes, ascending, in each block of the ``owned`` ones, and the end, (blocks + 1,)."""
    return np.searchsorted(nodes, np.arange(0, owned + NODE_BLOCK, NODE_BLOCK)).astype(np.int64)


class Batch:
    """Makes steps of a stepper in compiled calls, as long as its supports remain.

    Parameters
    ----------
    stepper : Stepper that :meth:`serves`
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.model, self.ledger = stepper, stepper.model, stepper.ledger
        self._bars, self._nodes, self._walls = self._bar_arrays(), self._node_arrays(), self._wall_arrays()
        self._messages = self.model.mesh.messages()
        self._stiffness = self._nodes.stiffness if self.model.links else np.empty(0)
        order = np.argsort(stepper.probed, kind="stable")
        probed = stepper.probed[order]
        self._probes = ProbeArrays(probed, _starts(probed, len(self._nodes.mass)), order)
        state = stepper.state
        self._springs = self._spring_arrays()
        self._support, self._contact = np.zeros_like(state.v), np.zeros_like(state.v)
        if state.contact is not stepper.zero:
            self._contact[:] = state.contact
        self._u = np.zeros_like(state.v)
        stepper.balance = None  # its predictor is not needed any more
        self._caller = RowCaller(stepper, self._stiffness, self._u, self._contact)
        share = Share(len(self.model.contact.names), len(self.model.links.columns), len(probed))
        self._width, self._at_state = len(share.numbers), at_state(self.model)
        self._ends_at_rows = not all(column.looped for column in self._at_state)
        return_freed_memory()

    def _bar_arrays(self) -> BarArrays:
        bars, blocks = self.model.bars, self.model.bars.blocks
        reach, columns = self._reach(), self._columns()
        planes = self._planes(reach, bool(columns))
        self._packed, self._columns_of, sections = [], [], []
        for k, block in enumerate(blocks):
            data = bars.data(block)._replace(step=self.stepper.h)
            of = columns[k] if columns else no_columns(block.area, len(block.history))
            room, pointer = packed(PulledBars(data, of, *planes))
            sections.append((room.ctypes.data, *pull_addresses(block.law, block.measure, pointer)))
            self._packed.append((room, data))  # what the addresses point to
            self._columns_of.append(of)
        loops = [block.loops for block in blocks]
        places = np.zeros((len(blocks), len(BAR_ENERGIES)), dtype=np.int64)
        for k, of in enumerate(loops):
            places[k, : len(of.places)] = of.places
        sweeps = [block.sweep for block in blocks]
        chunks = [(sweep.parts, len(sweep.diagonal)) for sweep in sweeps]
        groups = [(of.parts, len(of.heads)) for of in columns]
        return BarArrays(
            np.array(sections, dtype=np.int64).reshape(-1, 3),
            self._parts(chunks),
            self._parts(groups) if columns else np.empty((len(blocks), 0), dtype=np.int64),
            places,
            np.array([len(of.places) for of in loops], dtype=np.int64),
            max((of.work_rows for of in loops), default=0),
            any(len(block.history) for block in blocks),
            bars.can_break,
            BAR_ENERGIES.index("spring_energy"),
            reach,
            self._meeting(),
            bars.ends,
            bars.watched,
            *planes,
        )

    def _parts(self, of_sections: list[tuple[np.ndarray, int]]) -> np.ndarray:
        """Return ``parts`` of BarArrays from the parts of sweeps or columns, which end with the last block that has
        bars, and their ends."""
        blocks = -(-len(self.model.inertia.mass) // NODE_BLOCK)
        parts = np.empty((len(of_sections), blocks + 2), dtype=np.int64)
        for row, (own, end) in zip(parts, of_sections, strict=True):
            row[: len(own)], row[len(own) :], row[-1] = own, own[-1], end
        return parts

    def _node_arrays(self) -> NodeArrays:
        model, h = self.model, self.stepper.h
        supports, inertia = model.supports, model.inertia
        external = np.empty((0, 3))
        if model.external.active:
            external = self.stepper.state.external
            external = external if model.external.steady else external.copy()  # steps of a batch write it
        damping = inertia.damping if inertia.damped else np.empty(0)
        nodes = supports.nodes
        starts = _starts(nodes, len(inertia.mass))
        stiffness = 1.0 / (h * h) * inertia.mass + (0.5 / h * inertia.damping if inertia.damped else 0.0)
        fixed = nodes, supports.components, supports.origins.copy(), starts
        return NodeArrays(inertia.mass, damping, stiffness, 1.0 / stiffness, external, *fixed)

    def _spring_arrays(self) -> SpringArrays:
        springs, owned = self.model.bars.springs, len(self.model.inertia.mass)
        if springs is None:
            nobody = np.empty(0, dtype=np.int64)
            return SpringArrays(nobody, _starts(nobody, owned), np.empty((0, 3, 3)), np.empty((0, 3)))
        return SpringArrays(springs.nodes, _starts(springs.nodes, owned), springs.stiffness, springs.anchors)

    def _moving_supports(self, begin: int, count: int) -> MovingSupports:
        """Return the supports that move in ``count`` steps from one of a number on."""
        supports = self.model.supports
        motions, columns = supports.schedule(self._times(begin, count if supports.moves else -2), self.stepper.h)
        at = np.flatnonzero(columns >= 0)
        moved, probes = np.nonzero(self._nodes.support_nodes[at][:, None] == self.stepper.probed)
        return MovingSupports(at, columns[at], supports.origins[at], motions, np.column_stack([moved, probes]))

    def _wall_arrays(self) -> WallArrays:
        contact, log = self.model.contact, self.model.contact.log
        touched = Touched(
            log.touching, self.stepper.closed, contact.fixed, contact.restitution, self.ledger.impacts.slack
        )
        surfaces = contact.surfaces
        at_end, level = surfaces.copy(), surfaces.copy()
        acting = self.stepper.scheme.balance(self.stepper.state, self.stepper.h).acting
        way = np.zeros(level.centres.shape)
        walls = contact.pressed_walls(at_end, acting, PROJECTED * self.model.size, way)
        motions = self._wall_motions(0, 0)
        return WallArrays(walls, surfaces, level, motions, touched, log.present, log.releases)

    def _times(self, begin: int, count: int) -> np.ndarray:
        """Return the times of the start of ``count`` steps from one of a number on, of their ends, and of one more."""
        return np.arange(begin, begin + count + 2) * self.stepper.h

    def _wall_motions(self, begin: int, count: int) -> np.ndarray:
        contact = self.model.contact
        return contact.motion.schedule(self._times(begin, count if contact.moving.any() else -2))

    def _columns(self) -> list[Columns]:
        """Return the columns of the bars of each section; empty if bars are heated or not all in diagonal runs."""
        bars = self.model.bars
        if bars.heat.size or not all(block.sweep.diagonal.all() for block in bars.blocks):
            return []
        return [
            make_columns(block.sweep, bars.rest[block.start : block.stop], block.area, len(block.history))
            for block in bars.blocks
        ]

    def _planes(self, reach: int, padded: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return planes for all nodes; on one rank for a window of them, which stays in the cache."""
        nodes = len(self.model.mesh.points) if padded else 0
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
        late = np.zeros(len(self.model.mesh.points), dtype=bool)
        late[n_owned:] = True
        for block in self.model.bars.blocks:
            late[ends[block.counted : block.stop].reshape(-1)] = True
        reached = ends[late[ends].any(axis=1)]
        return int(reached.min(initial=n_owned)) // NODE_BLOCK

    @staticmethod
    def serves(stepper: Stepper) -> bool:
        """Return whether steps of this stepper can be made in batches. Collective."""
        from petsc4py import PETSc

        model = stepper.model
        serves = (
            stepper.scheme.leapfrog
            and stepper.treatment is None
            # -log_view measures the methods of single steps
            and not PETSc.Log.isActive()
            and COMPILED
            and model.mesh.messages() is not None
            and model.steady
        )
        return model.comm.allreduce(serves, op=MPI.LAND)

    def make(self, most: int, left: int) -> None:
        """Make up to ``most`` steps, and up to the one after which bars or supports are removed, of which there are
        ``left``; the last one remains to be counted. What rows of the history need of those that are due is collected,
        see :attr:`~pfem_petsc.stepping.stepper.Stepper.instants`, except for a step with a removal, which changes it.

        Fewer steps are made if a bar of any rank breaks, and if something fails; but several ranks whose bars cannot
        break, and whose rows need no calls, make all steps, though the state remains that of the failure. The stepper
        then has a fault.
        """
        stepper, ledger, state, model = self.stepper, self.ledger, self.stepper.state, self.model
        log, comm, due = model.contact.log, model.comm, self._due(min(most, left))
        count = len(due)
        due[-1] = due[-1] and count < left
        steps = np.flatnonzero(due)
        shares = np.zeros((len(steps) + (0 if due[-1] else 1), self._width))
        begin, impulses = state.step, ledger.impulses.state
        loads = model.external.schedule(range(begin + 1, begin + 1 + count), stepper.h)
        flags = np.zeros((count, len(log.releases)), dtype=bool)
        rows = model.links.export_rows(self._stiffness)
        for block, columns in zip(model.bars.blocks, self._columns_of, strict=True):
            block.lend(columns)
        ledger.sums[_BROKEN] = stepper.ruptures.count
        data = BatchData(
            stepper.h,
            state.x,
            stepper.before,
            state.memory["half_velocity"],
            self._bars,
            self._springs,
            self._nodes,
            self._moving_supports(begin, count),
            loads,
            self._walls._replace(motions=self._wall_motions(begin, count)),
            rows,
            self._caller.begin(begin, rows.totals),
            self._messages,
            StateArrays(state.f, state.a, state.v, self._support, self._contact, self._u),
            ledger.sums,
            ledger.powers,
            ImpulseArrays(impulses.memory["half_velocity"], impulses.a, impulses.v),
            self._probes,
            log.changes,
            ledger.friction_ahead,
            stepper.solution.walls.force.copy(),
            shares,
        )
        made = batch_loop(data, log.last, ledger.impacts.met, due, flags)
        self._caller.end()
        if made.lost:
            raise MPI.Exception(made.lost)
        model.links.import_rows(rows)
        end, row = made.passed, shares[made.recorded - 1]
        sound = self._take(made, row[_BARS], end)
        fill_at_state(self._at_state, stepper, row)
        ledger.follow_batch(row[: HEAD.width], made.friction)
        log.changes, noted = made.changes, np.zeros(end, dtype=np.int64)
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

    def _take(self, made: Made, energies: np.ndarray, end: int) -> int:
        """Take the state after the last of ``end`` steps, with ``energies`` of the bars [J]; return how many of these
        steps are sound."""
        stepper, state, model = self.stepper, self.stepper.state, self.model
        model.contact.log.last, self.ledger.impacts.met = made.touched, made.met
        state.support = self._support if model.supports.any else stepper.zero
        state.contact = self._contact if made.pressing else stepper.zero
        if model.external.active:
            state.external = self._nodes.external
        stepper.energy = StrainEnergy(tuple(energies.tolist()), made.failed)
        walls = model.contact.nothing
        if len(model.contact.walls):
            nodes = made.near, made.touching, made.places
            walls = WallForces(made.force, made.contacts, made.moment, *nodes, made.friction)
        stepper.solution = Solution(self._u, state.f, walls, contacts=made.pressing)
        begin = state.step
        state.step, state.time = begin + made.done - 1, (begin + made.done) * stepper.h
        if made.changed:
            stepper.ruptures.note(state.x, stepper.number + 1, stepper.arrived())
        sound = made.done
        if stepper.fault is not None:  # that of an earlier batch, of which not all ranks know
            sound = 0
        elif (failure := self._failure(made)) is not None:
            stepper.fault, sound = failure, made.done - 1
        state.step, state.time = begin + end - 1, (begin + end) * stepper.h
        return sound

    def _due(self, count: int) -> np.ndarray:
        """Return which of up to ``count`` steps to come have a row of the history; a row with values that the loop does
        not have, such as the number of slack bars, ends a batch, as they are those of the state."""
        every = self.stepper.row_every
        numbers = self.stepper.number + 1 + np.arange(min(count, NOTED))
        due = numbers % every == 0 if every else np.zeros(len(numbers), dtype=bool)
        if self._ends_at_rows and due.any():
            due = due[: int(np.argmax(due)) + 1]
        return due

    def _failure(self, made: Made) -> SimulationFailure | None:
        """Return the failure in the last step, None for none."""
        stepper = self.stepper
        if made.failed >= 0 or made.turned >= 0:
            return SimulationFailure(stepper.collapse(max(made.failed, made.turned)))
        if made.placeless >= 0:
            node = made.near[made.placeless]
            return self._at_balance(self.model.contact.placeless(node, made.why, made.normals, made.offsets))
        return self._at_balance(self._caller.failure) if made.unsolved else None

    def _at_balance(self, text: object) -> SimulationFailure:
        """Return a failure of the balance for the next positions."""
        stepper = self.stepper
        return SimulationFailure(f"{stepper.when(stepper.scheme.balance(stepper.state, stepper.h))}: {text}")
