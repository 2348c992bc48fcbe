"""Contact pairs and constraints of a case as one set of rows: forces, explicit steps, start and checkpoints."""

from __future__ import annotations

from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..errors import InputError, SimulationFailure
from ..integrators.base import Balance, State
from ..mesh.exchange import Router
from ..mesh.slab import slab_of, slab_range
from ..parallel.agreement import agreed, agreed_call
from ..parallel.natural import NaturalOrder
from ..registry import lookup
from ..tolerances import BEYOND, ON_BOUND
from .constraints.base import Constraint, ConstraintKeys, ExpectedNodes, SetPart
from .explicit import Arrivals, impact_square, planes_of, rebound_lift
from .friction import FAST, planes_at_rest, sliding
from .projection import Planes
from .rows import FreeNodes, RowSet, TwoNodeRows, WallsOfNodes, free_positions, push_nodes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import ContactPair
    from ..mesh.distribution import DistributedMesh
    from .contact import Contact

PACKAGE = "pfem_petsc.contact.constraints"

_KEPT = "force", "gradients", "closed", "drag", "rebound", "arrival"  # of rows, by the names of attributes


class PairRows(Constraint):
    """The pairs of a table: n . (x_2 - x_1) >= gap.

    Parameters
    ----------
    pair : ContactPair
    nodes : (r, 2) mesh numbers of the first and second nodes; the second ones are different from each other
    """

    fixed = True

    def __init__(self, pair: ContactPair, nodes: np.ndarray) -> None:
        self.nodes, self.data = nodes, np.empty((len(nodes), 0))
        self.ids = nodes[:, 1]
        self.normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
        self.gap = float(pair.gap)
        self.friction, self.restitution = pair.friction_coefficients, pair.restitution

    def weights(self) -> np.ndarray:
        return np.tile([-1.0, 1.0], (len(self.nodes), 1))

    def values(self, x: np.ndarray) -> np.ndarray:
        n, apart = self.normal, x[:, 1] - x[:, 0]
        return n[0] * apart[:, 0] + n[1] * apart[:, 1] + n[2] * apart[:, 2] - self.gap

    def gradients(self, x: np.ndarray) -> np.ndarray:
        return np.tile(np.stack([-self.normal, self.normal]), (len(x), 1, 1))


class _WallsAtRows:
    """The walls that can stop nodes of rows, in explicit steps.

    Attributes
    ----------
    any : whether there are any on this rank; everywhere : on any rank
    members : (n, w) bool, walls that can stop each node; partial : whether nodes can pass beside any that meets rows
    nodes : (m,) nodes of the rows that walls can stop
    rubs, curved, ties : whether any wall of the model that meets rows has friction, is curved, is tied
    """

    def __init__(self, rows: RowSet, contact: Contact) -> None:
        self._contact, comm = contact, rows.mesh.comm
        self.members = rows.gather(contact.members) > 0.0
        met = self.members.any(axis=1)
        self.nodes, self.any = np.flatnonzero(met), bool(met.any())
        meets = comm.allreduce(self.members.sum(axis=0)) > 0
        self.everywhere, self.meets = bool(meets.any()), meets
        self.partial = self.everywhere and contact.partial
        self.rubs = bool((contact.static_friction > 0.0)[meets].any())
        self.curved, self.ties = not contact.flat[meets].all(), bool(contact.ties.tying[meets].any())
        self._places = np.where(met, np.cumsum(met) - 1, -1)

    @property
    def rebounds(self) -> bool:
        """Whether walls meet rows and restitution is a bound on the next position."""
        return self._contact.rebounds and self.everywhere

    def held(self, at: np.ndarray, time: float) -> np.ndarray:
        """Return whether owned nodes (k,) are tied, as 1.0 or 0.0, and where to (k, 4)."""
        held = np.zeros((len(self._contact.members), 4))
        nodes, _, places = self._contact.ties.targets(time)
        held[nodes] = np.column_stack([np.ones(len(nodes)), places])
        return held[at]

    def memory(self, at: np.ndarray) -> np.ndarray:
        """Return rebound and arrival of owned nodes (k,) at all walls, (k, 2 w)."""
        memory, none = self._contact.state.memory, np.zeros(self._contact.members.shape)
        return np.column_stack([memory.get(name, none)[at] for name in ("rebound", "arrival")])

    def stopping(
        self,
        x: np.ndarray,
        starts: tuple[np.ndarray | None, np.ndarray],
        applies: np.ndarray,
        memory: np.ndarray,
        balance: Balance,
    ) -> WallsOfNodes:
        """Return the walls in a step.

        Parameters
        ----------
        x : (n, 3) positions of the nodes without contact [m]
        starts : those at the start of the step, None if nothing needs them, and displacements without forces (n, 3)
        applies : (n, w) bool, walls that can stop each
        memory : (2, n, w) of walls with restitution, see :class:`~pfem_petsc.contact.explicit.Arrivals`, else (2, n, 0)
        balance : of the step
        """
        contact, at, poses = self._contact, self.nodes, self._contact.motion.poses(balance.time)
        free, (start, drift), none = x[at], starts, np.empty((0, len(contact.wall_of)))
        walls, before = contact.walls_at(poses, balance.acting), free if start is None else start[at]
        ways = np.zeros((len(at), len(contact.wall_of), 3))
        if start is not None:
            ways = contact.ways(before, contact.motion.poses(contact.state.time), poses)
        others = not contact.known.all()
        acting = contact.acting_from(before, free, poses, balance.acting) if others and balance.acting < 1.0 else None
        of_nodes = np.empty(0), none[:, :0] > 0.0, applies[at], none > 0.0
        given = Arrivals(free, before, ways, drift[at], *of_nodes, *memory[:, at], none[:, :, None], none)

        def planes(place: np.ndarray, pushed: np.ndarray) -> Planes:
            there = given
            if others:
                normals, offsets = contact.planes(applies[at], place[at], poses, acting)
                there = given._replace(normals=normals, offsets=offsets)
            return planes_of(place[at], pushed[at], there, walls)[0]

        return WallsOfNodes(self._places, planes, (memory[0] > 0.0).any(axis=1) | self.curved)


class ConstraintSet:
    """The rows of contact pairs and constraints, and their forces; False if there are none. Construction is collective.

    Attributes
    ----------
    columns : of the tables in the history, like ``pair/NAME``, pairs first
    dynamic : whether rows of any table come and go, see :meth:`find`
    rows : RowSet, another one whenever the rows change
    force : (r,) of the rows here in the last step [N]; gradients : (r, k, 3) along which these act; the same on all
        ranks that have a row
    closed : (r,) uint8, 1 for rows over two nodes that have closed and not opened since
    drag : (r, 3) friction forces of the rows in the last step, times the weights of their nodes [N]
    rebound, arrival : (r,) memory of rows that have closed, see :class:`~pfem_petsc.contact.explicit.Arrivals`
    friction : energy that friction of the rows that this rank counts dissipates in the step solved for [J]
    rebounds : whether restitution is a bound on the next position, for schemes that solve for the next position
    two : TwoNodeRows
    alone : whether all rows of the model are over two nodes that no other row and no wall stops, with fixed directions
    separate : whether all are over two nodes with fixed directions, stay, are stopped by no walls, and are on one rank
        each, so that compiled loops see whether any is closed
    walled : whether walls can stop any node of the model's rows
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], contact: Contact) -> None:
        self.source, self.contact, self.mesh = case.source, contact, contact.mesh
        tables = [*case.contact_pair, *case.constraint]
        self.names = [table.name for table in tables]
        self.n_pairs = len(case.contact_pair)
        self.columns = [f"{'pair' if k < self.n_pairs else 'constraint'}/{name}" for k, name in enumerate(self.names)]
        self._sources: list[Constraint] = [_find_pairs(case, k, nodes, self.mesh) for k in range(self.n_pairs)]
        self._sources += [_source(case.source, keys, nodes, self.mesh) for keys in case.constraint]
        self.dynamic = any(source.dynamic for source in self._sources)
        self.friction, self.rebounds = 0.0, False
        self._make()

    def _make(self) -> None:
        """Make everything that depends on which rows there are. Collective."""
        for name, source in zip(self.names, self._sources, strict=True):
            source.name = name
        self.rows = rows = RowSet(self._sources, self.mesh, self.contact.fixed)
        self.two = TwoNodeRows(rows)
        self._walls = _WallsAtRows(rows, self.contact)
        self._turning = self.mesh.comm.allreduce(not rows.fixed.all(), op=MPI.LOR)
        self.walled = self._walls.everywhere
        self.alone = not self.walled and self.mesh.comm.allreduce(self.two.every, op=MPI.LAND)
        own = rows.partners.alone and not self.dynamic and not self.walled and len(self.two.at) == len(rows.source)
        self.separate = self.mesh.comm.allreduce(own, op=MPI.LAND)
        self._x, self.closed = np.empty((len(rows.numbers), 3)), np.zeros(len(rows.source), dtype=np.uint8)
        self.release()

    def __bool__(self) -> bool:
        return bool(self.columns)

    @property
    def symmetric(self) -> bool:
        """Whether the Hessian of an implicit step with walls and rows is symmetric; friction makes it unsymmetric."""
        return not (self.contact.has_friction or self.rows.rubs)

    def relative_groups(self) -> np.ndarray:
        """Return (groups,) bool: groups of rows that implicit steps solve in relative coordinates, because a row has
        friction, or a wall other than a plain plane may stop a node. Collective."""
        rows, contact = self.rows, self.contact
        found = np.zeros(len(rows.groups.starts) - 1, dtype=bool)
        found[rows.group_of_row[rows.friction[:, 1] > 0.0]] = True
        found[rows.group_of_node[(rows.gather(contact.members & contact.special) > 0.0).any(axis=1)]] = True
        return found

    def release(self) -> None:
        """Set all forces to zero."""
        self.force, self.gradients = np.zeros(len(self.rows.source)), self.rows.fixed_jacobian
        self.drag, self.rebound, self.arrival = np.zeros((len(self.force), 3)), *np.zeros((2, len(self.force)))

    @property
    def state(self) -> dict[str, Any]:
        """The rows, the forces and the gradients along which they act, for a step that is given up."""
        return dict(vars(self))

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        vars(self).update(state)

    def find(self, x: np.ndarray, reach: np.ndarray, time: float) -> None:
        """Find the rows of a step whose nodes end within ``reach`` (owned,) of positions (owned, 3) [m], as they come
        and go. Rows that stay keep their forces. What a search raises on one rank, all raise. Collective."""
        numbers = self.mesh.node_ids[: self.mesh.n_owned].astype(np.int64)
        nodes = ExpectedNodes(self.mesh.comm, numbers, x, reach, time)
        found = list(self._sources)
        for k, source in enumerate(found):
            if source.dynamic:
                with agreed_call(self.mesh.comm, f"constraint {self.names[k]!r}: find"):
                    found[k] = source.find(nodes)
        if all(one is other for one, other in zip(found, self._sources, strict=True)):
            return
        self._sources, before, counted = found, self.rows, self._of_counted()
        self._make()
        self._take(counted, before)
        before.partners.close()

    def find_explicit(self, balance: Balance, u: np.ndarray) -> None:
        """Find the rows of an explicit step with increments ``u`` (owned, 3) without rows. Collective."""
        if self.dynamic:
            self.find(balance.predictor + u, np.zeros(len(u)), balance.time)

    def expect(self, state: State, balance: Balance) -> None:
        """Find the rows of an implicit step. Collective."""
        if not self.dynamic:
            return
        move = (balance.time - state.time) * state.v
        reach = 0.5 * np.linalg.norm(move, axis=1) + BEYOND * self.contact.size
        self.find(state.position + move, reach, balance.time)

    def _of_counted(self) -> dict[str, np.ndarray]:
        """Return what is kept of the rows that this rank counts."""
        return {f"rows.{name}": getattr(self, name)[self.rows.counted] for name in _KEPT}

    def _take(self, counted: dict[str, np.ndarray], rows: RowSet) -> None:
        """Set the forces of all rows here from those of the rows counted in a set. Collective."""
        for name in _KEPT:
            setattr(self, name, self.rows.of_counted(counted[f"rows.{name}"], rows))
        self.gradients = np.where(self.rows.fixed[:, None, None], self.rows.fixed_jacobian, self.gradients)

    def explicit(self, balance: Balance, state: State, u: np.ndarray, stiffness: np.ndarray) -> np.ndarray | None:
        """Return the forces (n, 3) [N] on the nodes of rows in a step in which each node is solved on its own, with
        increments ``u`` (owned, 3) without rows, for :meth:`push`; None if no row acts on a node of this rank.
        Collective.

        ``stiffness`` (owned,) is the force for a displacement of a node [N/m]. Rows that come and go are those that
        :meth:`find_explicit` has found.

        Raises
        ------
        SimulationFailure
            If no positions satisfy all rows. Raised at least on this rank, after all collective operations.
        """
        if not self:
            return None
        rows, x, walls = self.rows, self._x, self._walls
        far = np.empty((0, 4))
        if not rows.partners.alone:
            at, leaving = rows.partners.rows, rows.partners.leaving(4)
            free_positions(at, balance.predictor, u, far, leaving)
            leaving[:, 3] = stiffness[at]
            far = rows.partners.bring(leaving)
        free_positions(rows.where, balance.predictor, u, far, x)
        start, drift, held, memory, applies = self._starts(balance, state, u)
        free, stopping = rows.free, None
        if walls.any:
            if walls.ties:
                tied = held[:, :1] > 0.0
                free, applies = np.where(tied, 0.0, free), applies & ~tied
                x[:] = np.where(tied & (rows.free > 0.0), held[:, 1:], x)
            stopping = walls.stopping(x, (start, drift), applies, memory, balance)
        nodes = FreeNodes(x, rows.spread(stiffness, far[:, 3]), start, balance.acting < 1.0, free)
        moved = rows.along(rows.fixed_jacobian, x - start) if self.rebounds else np.empty(0)
        pull = rows.along(rows.fixed_jacobian, drift) - moved if self.rebounds else moved
        lift, before = 0.0, self.force > 0.0
        if self.rebounds and self.rebound.any():  # bounds of rows that rebound are above zero
            lift = rebound_lift(rows.restitution, self.rebound, self.arrival, pull)
        force = np.zeros(len(before))
        try:
            pushes, self.gradients = rows.project(nodes, self.contact.tolerance, stopping, lift)
            force = pushes.normal
        finally:
            self.two.agree(force)  # also after a failure, which other ranks may not have
        self.force, self.drag, self.friction = force, pushes.drag, 0.0
        if self.rebounds:
            fresh, arrived = (self.force > 0.0) & ~before & (rows.restitution > 0.0), rows.values(start)
            self.rebound = np.where(fresh, impact_square(-moved, arrived, pull), 0.0)
            self.arrival = np.where(fresh, arrived, 0.0)
        if rows.rubs:
            self.friction = -float((self.drag * rows.slips(x - start + pushes.moves))[rows.counted].sum())
        if not self.force.any():
            return None
        load = rows.forces(self.gradients, self.force, self.drag)
        return load if load[rows.mine].any() else None

    def _starts(self, balance: Balance, state: State, u: np.ndarray) -> tuple[np.ndarray | None, ...]:
        """Return positions at the start of a step and displacements without forces (n, 3) [m], tied nodes and where to
        (n, 4), the memory of walls (2, n, w), and walls that can stop nodes with increments ``u`` (owned, 3) without
        rows, (n, w) bool; nothing of what no row or wall needs. Collective."""
        walls, contact = self._walls, self.contact
        rebounds, at_start = self.rebounds or walls.rebounds, balance.acting < 1.0
        starts = rebounds or self.rows.rubs or walls.rubs or (at_start and (self._turning or walls.curved))
        none, needed = np.empty((2, len(self._x), 0)), (starts, rebounds, walls.ties, walls.rebounds, walls.partial)
        if not any(needed):
            return None, none[0], none[0], none, walls.members
        poses = contact.motion.poses(balance.time)
        parts = (
            lambda at: state.position[at],
            lambda at: balance.predictor[at] - state.position[at],
            lambda at: walls.held(at, balance.time),
            walls.memory,
            lambda at: contact.applicable(at, balance.predictor[at] + u[at], poses),
        )
        table = self.rows.collect(lambda at: np.column_stack([part(at) for part in compress(parts, needed)]))
        widths = np.array([3, 3, 4, 2 * len(contact.wall_of)]) * needed[:4]
        start, drift, held, memory, applies = np.split(table, np.cumsum(widths), axis=1)
        memory = np.stack(np.split(memory, 2, axis=1)) if walls.rebounds else none
        return start if starts else None, drift, held, memory, applies > 0.0 if walls.partial else walls.members

    def push(self, load: np.ndarray, stiffness: np.ndarray, u: np.ndarray, contact: np.ndarray) -> None:
        """Correct increments by the forces of :meth:`explicit`, and add these to ``contact``, (owned, 3) both."""
        push_nodes(self.rows.where, load, self.rows.free, stiffness, u, contact)

    def pressed(self) -> np.ndarray:
        """Return the owned nodes (m,), ascending, on which rows press."""
        nodes = self.rows.ends[self.force > 0.0]
        at = self.rows.where[nodes[nodes >= 0]]
        return np.unique(at[at >= 0])

    def any_pressed(self) -> bool:
        """Return whether any row of the model has a force. Collective."""
        return bool(self) and bool(self.mesh.comm.allreduce(bool(self.force.any()), op=MPI.LOR))

    def count_held(self, nodes: np.ndarray) -> int:
        """Return how many owned nodes are held by walls, which hold ``nodes`` (k,), or by rows."""
        return len(np.union1d(nodes, self.pressed())) if self else len(nodes)

    def totals(self) -> np.ndarray:
        """This rank's share of the forces (tables, 3) of the rows on their last nodes [N]."""
        rows, totals = self.rows, np.zeros((len(self.names), 3))
        if not self:
            return totals
        at = np.flatnonzero(rows.counted & (self.force != 0.0))
        last, force = rows.last[at], self.force[at, None]
        push = force * self.gradients[at, last] + rows.weights[at, last][:, None] * self.drag[at]
        np.add.at(totals, rows.source[at], push)
        return totals

    def tables(self, owned: int) -> np.ndarray:
        """(owned,) the table whose rows press on an owned node as their last one, -1 for none."""
        tables, at = np.full(owned, -1), (self.force > 0.0) & self.rows.counted
        tables[self.rows.last_nodes[at]] = self.rows.source[at]
        return tables

    def add_forces(self, contact: np.ndarray, factor: float = 1.0) -> None:
        """Add the forces, times a factor, to those on the nodes (owned, 3) [N]."""
        contact[self.rows.here] += factor * self.rows.forces(self.gradients, self.force, self.drag)[self.rows.mine]

    def check(self, treatment: str, explicit: bool, length: float) -> None:
        """Check that the model is compatible with the rows and that none is violated at the start. Collective.

        Parameters
        ----------
        treatment : ``contact.treatment`` of the case
        explicit : whether nodes are solved one by one, so that walls of any kind may stop them
        length : that tolerances are relative to [m]

        Raises
        ------
        InputError
            On all ranks.
        """
        if not self:
            return
        points = self.mesh.points[: self.mesh.n_owned]
        self.find(points, np.zeros(len(points)), 0.0)
        rows, walls, comm = self.rows, self.contact, self.mesh.comm
        if len(self.names) > self.n_pairs and treatment != "scheme":
            raise InputError(f'{self.source}: constraint: constraints need contact.treatment = "scheme"')
        if treatment != "scheme" and not self.alone:
            several = np.bincount(rows.ends[rows.ends >= 0], minlength=len(rows.numbers)) > 1
            several[self._walls.nodes] = True
            lowest = int(rows.numbers[several].min(initial=2**62))
            node = comm.allreduce(lowest, op=MPI.MIN)
            raise InputError(
                f"{self.source}: contact_pair: node {node} is in several pairs, or a wall stops it as well, which "
                'needs contact.treatment = "scheme"'
            )
        special, kind = walls.restitution > 0.0, "without restitution"
        if explicit:
            open_ones = [k for k in walls.surfaces_of_triangles if not walls.walls[k].closed]
            special, kind = np.isin(walls.wall_of, open_ones), "closed"
        else:
            self._check_relative()
        special = special & self._walls.meets
        if special.any():
            raise InputError(
                f"{self.source}: contact_pair, constraint: wall {walls.names[walls.wall_of[special.argmax()]]!r} stops "
                f"nodes of pairs or constraints: such a wall must be {kind}; or give it a node_set without them"
            )
        x = rows.gather(points)
        with agreed(comm):
            try:
                values = rows.values(x)
            except SimulationFailure as failure:
                raise InputError(f"{self.source}: {failure}") from failure
        deepest = self._deepest(values, ON_BOUND * length)
        if deepest is not None:
            depth, table, _, numbers = deepest
            if table < self.n_pairs:
                raise InputError(
                    f"{self.source}: contact_pair {self.names[table]!r}: nodes {' and '.join(numbers)} start "
                    f"{-depth:.6g} m beyond each other; reverse the direction, which points from the first to the "
                    "second, reduce 'gap', or move the mesh"
                )
            raise InputError(
                f"{self.source}: constraint {self.names[table]!r}: nodes {', '.join(numbers)} start {-depth:.6g} m "
                "beyond it; correct its keys, or move the mesh"
            )

    def check_carried(self, x: np.ndarray, where: str) -> None:
        """Check that supports, which prescribe all components of the nodes of some rows, have not moved these beyond
        each other, at positions (owned, 3) [m]. Collective.

        ``where``: the step, for the message

        Raises
        ------
        SimulationFailure
            On all ranks, with the table, the nodes, how far they are beyond, the step, and the remedy.
        """
        if not self:
            return
        rows, x = self.rows, self.rows.gather(x)
        values, tolerance = rows.values(x), BEYOND * self.contact.size
        beyond = values < -tolerance
        if beyond.any():
            beyond &= ~rows.usable(rows.gradients(x))
        deepest = self._deepest(np.where(beyond, values, np.inf), tolerance)
        if deepest is not None:
            depth, table, _, numbers = deepest
            name, nodes = self.columns[table].replace("/", " "), ", ".join(numbers)
            raise SimulationFailure(
                f"{where}: nodes {nodes} of {name!r} are {-depth:.3g} m beyond each other, moved there by their "
                "supports; free one of them, change the motion of the supports, or remove these nodes from the table"
            )

    def _deepest(self, values: np.ndarray, tolerance: float) -> tuple[float, int, int, list[str]] | None:
        """Return the value [m], table, number and nodes of the row that is lowest of all ranks, of ``values`` (r,), or
        None if none is below zero by more than a tolerance [m]. Collective."""
        rows, deepest = self.rows, (np.inf,)
        if len(values) and not values.min() >= -tolerance:
            row = int(np.argmin(values))
            numbers = [str(n) for n in rows.numbers[rows.ends[row][rows.ends[row] >= 0]]]
            deepest = float(values[row]), int(rows.source[row]), int(rows.ids[row]), numbers
        deepest = min(self.mesh.comm.allgather(deepest))
        return deepest if len(deepest) > 1 else None

    def _check_relative(self) -> None:
        """Refuse rows that would need relative coordinates and can have none. Collective."""
        rows = self.rows
        other = ~rows.fixed | ~rows.weights.any(axis=1)
        other &= self.relative_groups()[rows.group_of_row]
        tables = np.flatnonzero(self.mesh.comm.allreduce(np.bincount(rows.source[other], minlength=len(self.names))))
        if len(tables):
            raise InputError(
                f"{self.source}: constraint {self.names[tables[0]]!r} is on nodes that rub, or that a wall stops which "
                "is curved, turns, ties or rebounds, or has mass or friction: it then requires an explicit integrator; "
                "use one, or give the wall or the contact_pair other nodes"
            )

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> np.ndarray:
        """Return second time derivatives (r,) [m/s2] at zero acceleration of rows closed within ``slack`` [m] and at
        rest within ``still`` [m/s] at positions and velocities (owned, 3), infinite for others. Collective."""
        if not self:
            return self.force
        x, v = self.rows.gather(x), self.rows.gather(v)
        self.gradients = self.rows.gradients(x)
        closed = np.abs(self.rows.values(x)) <= slack
        closed &= np.abs(self.rows.along(self.gradients, v)) <= still
        return np.where(closed, self.rows.drift(x, v), np.inf)

    def rest(
        self, a: np.ndarray, mass: np.ndarray, closed: np.ndarray, on_walls: np.ndarray, still: float
    ) -> np.ndarray:
        """Set the forces of closed rows at accelerations (owned, 3); return them on free components (owned, 3) [N].

        ``closed`` (r,) from :meth:`resting`; ``on_walls`` (owned, walls) bool: nodes that rest on walls;
        ``still``: velocity that counts as none [m/s]. Collective.
        """
        rows, contact = self.rows, self.contact
        state, change = contact.state, np.zeros_like(a)
        if not self:
            return change
        rests = rows.gather(on_walls) > 0.0
        x, v, every, hard = (rows.gather(values) for values in (state.position, state.v, a, mass))
        values = rows.along(self.gradients, every) + closed
        largest = self.mesh.comm.allreduce(float(np.abs(every).max(initial=0.0)), op=MPI.MAX)
        place = np.where(rests.any(axis=1), np.arange(len(every)), -1)
        nodes = FreeNodes(every, hard, np.zeros_like(every), at_start=False, free=rows.free)
        with agreed(self.mesh.comm):
            planes = planes_at_rest(contact, rests, (x, v, every), still)
            system = rows.system(self.gradients, values, nodes, place, planes)
            if rows.rubs:
                squares = np.maximum((rows.weights**2).sum(axis=1, keepdims=True), 1e-300)
                along = np.einsum("rk,rki->ri", rows.weights, self.gradients) / squares
                fast = FAST * largest / max(np.abs(v).max(initial=0.0), still)
                slips = system.rows.slips
                slips += fast * sliding(rows.slips(v), along, still)
            pushes = rows.solve(system, 1e-13 * largest, largest)
        self.force, self.drag = pushes.normal, pushes.drag
        change[rows.here] = (rows.forces(self.gradients, self.force, self.drag) * rows.free)[rows.mine]
        return change

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """What a checkpoint keeps, name to an order and this rank's part; the same names on all ranks. Collective."""
        order, found = self.rows.order, {}
        for name, source in zip(self.names, self._sources, strict=True):
            for key, values in source.state().items():
                found[f"rows.{name}.{key}"] = self.mesh.node_order, values
        if order.n_global:
            kept = self._of_counted() | ({"rows.table": self.rows.table[self.rows.counted]} if self.dynamic else {})
            found |= {name: (order, values) for name, values in kept.items()}
        return found

    def numbers(self) -> dict[str, int]:
        """What a checkpoint keeps besides the arrays. Collective."""
        return {"rows": self.rows.order.n_global} if self else {}

    def orders(self, n_rows: int | None) -> dict[str, NaturalOrder]:
        """Return the orders in which :meth:`load_state` takes the arrays of a checkpoint with ``n_rows`` rows (None: as
        many as there are): nodes by their owners, rows in slabs. Collective."""
        n_rows = self.rows.order.n_global if n_rows is None else n_rows
        comm = self.mesh.comm
        slab = NaturalOrder(comm, np.arange(*slab_range(n_rows, comm.rank, comm.size)), n_rows)
        orders = {name: order for name, (order, _) in self.arrays().items() if order is self.mesh.node_order}
        names = [*self._of_counted(), *(["rows.table"] if self.dynamic else [])] if n_rows else []
        return orders | dict.fromkeys(names, slab)

    def load_state(self, arrays: dict[str, np.ndarray]) -> None:
        """Take the arrays of :meth:`arrays` back, in the orders of :meth:`orders`. Collective."""
        for name, source in zip(self.names, self._sources, strict=True):
            source.load_state({key: arrays[f"rows.{name}.{key}"] for key in source.state()})
        if self.dynamic:
            width = self.rows.ends.shape[1]
            table = arrays.get("rows.table", np.empty((0, self.rows.table.shape[1]), dtype=np.int64))
            self._sources = [
                source.of_table(table[table[:, 0] == s], width) if source.dynamic else source
                for s, source in enumerate(self._sources)
            ]
            self._make()
        self.release()
        if "rows.force" in arrays:
            order = self.rows.order
            self._take({name: order.from_slab(arrays[name]) for name in self._of_counted()}, self.rows)

    def take_over(self, earlier: ConstraintSet) -> None:
        """Take the state of the set of an earlier stage, with the same tables. Collective."""
        arrays = {name: (order, values.copy()) for name, (order, values) in earlier.arrays().items()}
        nodal = self.mesh.node_order
        own = {name: v if order is nodal else order.to_slab(v) for name, (order, v) in arrays.items()}
        self.load_state(own)


def _source(file: str, parameters: ConstraintKeys, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> Constraint:
    """The rows that a table makes of this rank's parts of its node sets. Collective."""
    key = f"{file}: constraint {parameters.name!r}"
    named = [
        getattr(parameters, name)
        for name, field in type(parameters).model_fields.items()
        if (field.json_schema_extra or {}).get("refers_to") == "node_set"
    ]
    parts = {name: _part(mesh, nodes[name]) for name in named if name is not None}
    with agreed(mesh.comm):
        try:
            source = lookup(PACKAGE, parameters.kind, f"{key}: kind").Constraint(parameters, parts.__getitem__)
        except InputError as error:  # a kind knows its keys, but not the file that they are in
            raise InputError(f"{key}: {error}") from error
        source.nodes = np.asarray(source.nodes, dtype=np.int64)
        if not hasattr(source, "data"):
            source.data = np.empty((len(source.nodes), 0))
        same = np.sort(source.nodes, axis=1)
        if (same[:, 1:] == same[:, :-1]).any():
            node = same[:, 1:][same[:, 1:] == same[:, :-1]][0]
            raise InputError(f"{key}: node {node} is constrained with itself; name different nodes")
    return source


def _part(mesh: DistributedMesh, local: np.ndarray) -> SetPart:
    """This rank's part of a node set, of which it owns nodes (k,). Collective."""
    comm = mesh.comm
    to_slab = Router(comm, slab_of(mesh.node_ids[local], mesh.n_nodes, comm.size))
    numbers, places = to_slab.send(mesh.node_ids[local]), to_slab.send(mesh.points[local])
    order = np.argsort(numbers)
    counts = np.array(comm.allgather(len(numbers)))
    count, first = int(counts.sum()), int(counts[: comm.rank].sum())
    evenly = Router(comm, slab_of(first + np.arange(len(numbers)), count, comm.size))
    return SetPart(count, evenly.send(numbers[order]).astype(np.int64), evenly.send(places[order]))


def _find_pairs(case: Case, index: int, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> PairRows:
    """Match the nodes of a table of a case. Collective.

    ``nodes``: owned local indices of each node set.

    Raises
    ------
    InputError
        On all ranks, for sets of unequal size, a node paired with itself, or two nodes paired with the same node.
    """
    pair, comm = case.contact_pair[index], mesh.comm
    key = f"{case.source}: contact_pair {pair.name!r}"
    normal = np.array(pair.direction) / np.linalg.norm(pair.direction)
    first, second = nodes[pair.first], nodes[pair.second]
    counts = comm.allreduce(np.array([len(first), len(second)]))
    if counts[0] != counts[1]:
        raise InputError(f"{key}: first has {counts[0]} nodes and second {counts[1]}: they cannot be paired")
    numbers = mesh.node_ids[second].astype(np.int64)
    if counts[0] == 0:
        return PairRows(pair, np.empty((0, 2), dtype=np.int64))
    # the nodes of a set lie on a surface, few enough for each rank to have those of all
    known = np.concatenate(comm.allgather(mesh.node_ids[first].astype(np.int64)))
    points, order = np.concatenate(comm.allgather(mesh.points[first])), np.argsort(known)
    at = nearest_points(across(points[order], normal), across(mesh.points[second], normal))
    nearest = known[order[at]]
    pairs = np.concatenate(comm.allgather(np.column_stack([nearest, numbers])))
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    twice = np.flatnonzero(pairs[1:, 0] == pairs[:-1, 0])
    if len(twice):
        (met, one), (_, other) = pairs[twice[0]], pairs[twice[0] + 1]
        raise InputError(
            f"{key}: two nodes of second are nearest to the same node of first, seen along the direction: {one} "
            f"and {other} to {met}; correct direction, or give node sets whose nodes lie opposite each other"
        )
    itself = pairs[pairs[:, 0] == pairs[:, 1], 0]
    if len(itself):
        raise InputError(
            f"{key}: node {itself[0]} is paired with itself, as first {pair.first!r} and second {pair.second!r} both "
            "have it; give node sets without common nodes"
        )
    return PairRows(pair, pairs[slab_of(pairs[:, 0], mesh.n_nodes, comm.size) == comm.rank])


def across(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return points (n, 3) minus their part along a unit vector, bitwise independent of their index in the array."""
    along = points[:, 0] * normal[0] + points[:, 1] * normal[1] + points[:, 2] * normal[2]
    return points - along[:, None] * normal


def nearest_points(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return the indices (m,) of the points (n, 3) nearest to queries (m, 3), the first of several at bitwise the same
    distance; n > 0."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    distance, at = tree.query(queries, k=[1, 2])  # a second one that does not exist is at infinity
    radius, nearest = distance[:, 0] * (1.0 + 1e-9), at[:, 0]
    for k in np.flatnonzero(distance[:, 1] <= radius):
        equal = np.sort(tree.query_ball_point(queries[k], radius[k]))
        nearest[k] = equal[np.argmin(((points[equal] - queries[k]) ** 2).sum(axis=1))]
    return nearest
