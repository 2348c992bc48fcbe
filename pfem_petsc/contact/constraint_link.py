"""The constraints of a case as a link: rows of any kind, and their coordinates in implicit steps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError, NotConverged
from ..integrators.base import Balance, State
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..parallel.agreement import agreed
from ..parallel.natural import NaturalOrder
from ..registry import lookup
from ..tolerances import ON_BOUND, PROJECTED
from .constraints.base import Constraint, ConstraintKeys, SetPart
from .contact import near_planes
from .frames import NodalFrames
from .links import BlocksOf
from .rows import Planes, Rows, free_positions, free_stiffness, last_forces, leaving_nodes, mark_pressed, push_nodes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model
    from .contact import Contact


_LEAST = 0.05  # of a pivot below which a row is deferred
_TURN = 1e-10  # of a gradient that counts as none
_NOWHERE = np.empty(0, dtype=bool)


class RowCoordinates:
    """See :class:`~pfem_petsc.contact.links.LinkCoordinates`.

    Parameters
    ----------
    link : ConstraintLink
    """

    varies = True

    def __init__(self, link: ConstraintLink) -> None:
        self.link, self.rows, self.comm = link, link.rows, link.rows.mesh.comm
        n = len(self.rows.numbers)
        self._start, self._part = np.empty((n, 3)), 1.0
        points = self.rows.gather(self.rows.mesh.points[: self.rows.mesh.n_owned])
        self._place(self.rows.gradients(points), np.tile(np.eye(3), (n, 1, 1)), np.ones((n, 3), dtype=bool))

    def _any(self, flag: bool) -> bool:
        """Whether a flag is set on any rank. Collective."""
        return bool(self.comm.allreduce(bool(flag), op=MPI.LOR))

    def reached(self, state: State, move: np.ndarray, slack: float) -> bool:
        rows = self.rows
        data = rows.gather(np.concatenate([state.position + move, move], axis=1))
        way = np.append(np.linalg.norm(data[:, 3:], axis=1), 0.0)  # the last one: of no node
        reach = 0.5 * way[rows.ends].sum(axis=1) + slack
        return self._any(((rows.values(data[:, :3]) < reach) | (self.link.force > 0.0)).any())

    def place(self, frames: NodalFrames | None, balance: Balance, state: State, x: np.ndarray) -> None:
        rows, owned = self.rows, self.rows.mesh.n_owned
        data = np.zeros((owned, 12))
        data[:, [0, 4, 8]] = 1.0
        if frames is not None:
            data[frames.nodes, :9] = frames.inverse.reshape(-1, 9)
            data[frames.nodes, 9:] = np.isfinite(frames.lower) | np.isfinite(frames.upper)
        data = rows.gather(data)
        self._part = balance.acting
        self._start = rows.gather(state.position) if self._part < 1.0 else self._start
        jacobian = rows.gradients(self._acting(rows.gather(x)))
        self._place(jacobian, data[:, :9].reshape(-1, 3, 3), data[:, 9:] == 0.0)

    def _acting(self, x: np.ndarray) -> np.ndarray:
        """Places (n, 3) where the forces of the balance act, for nodes that move to (n, 3)."""
        return x if self._part == 1.0 else self._start + self._part * (x - self._start)

    def _place(self, jacobian: np.ndarray, inverse: np.ndarray, room: np.ndarray) -> None:
        """Choose the pivots. ``jacobian`` (r, k, 3) by x; of the nodes: ``inverse`` (n, 3, 3) of their frames' bases,
        and ``room`` (n, 3) bool: coordinates that no wall bounds."""
        rows = self.rows
        self.jacobian = jacobian
        some = (rows.ends >= 0)[:, :, None]
        turned = np.einsum("rkji,rkj->rki", inverse[rows.ends], jacobian)
        self._turned = np.where(some, turned * rows.free[rows.ends], 0.0)
        n = 3 * len(rows.numbers)
        self._pivot = np.full(len(rows.source), -1)  # unknown of each row among those of all nodes
        self._scale = np.ones(len(rows.source))
        room = (room & (rows.free > 0.0)).ravel()
        self._blocks: list[tuple[np.ndarray, np.ndarray]] = []  # of groups alike: unknowns (g, u), T (g, u, u)
        self._solved: list[tuple[np.ndarray, np.ndarray]] = []  # rows (g, p) with pivots, and J_P^-1 (g, p, p)
        for groups in rows.alike:
            unknowns = (3 * groups.nodes[:, :, None] + np.arange(3)).reshape(len(groups.nodes), -1)
            dense = groups.dense(self._turned[groups.rows])
            row, column, count = _pivots(np.where(room[unknowns][:, None, :], dense, 0.0))
            for k in np.unique(count):
                part = np.flatnonzero(count == k)
                self._transform(groups.rows[part], unknowns[part], dense[part], row[part, :k], column[part, :k])
        self._placed = np.flatnonzero(self._pivot >= 0)
        self._deferred = np.flatnonzero((self._pivot < 0) & rows.usable(jacobian))
        self._owner = np.zeros(n, dtype=bool)
        self._owner[self._pivot[self._placed]] = True
        # T on the pivots' rows, as entries
        parts = []
        for unknowns, transform in self._blocks:
            group, at, column = np.nonzero((transform != 0.0) & self._owner[unknowns][:, :, None])
            parts.append((unknowns[group, at], unknowns[group, column], transform[group, at, column]))
        self._to, self._from, self._values = (
            np.concatenate([np.empty(0, dtype=kind), *(part[k] for part in parts)])
            for k, kind in ((0, np.int64), (1, np.int64), (2, np.float64))
        )
        # pivots of this rank's nodes: local node, component, row
        local = rows.where[self._pivot[self._placed] // 3]
        here = local >= 0
        self._here = local[here], self._pivot[self._placed][here] % 3, self._placed[here]

    def _transform(
        self, rows: np.ndarray, unknowns: np.ndarray, dense: np.ndarray, row: np.ndarray, column: np.ndarray
    ) -> None:
        """T of groups (g,) alike: rows (g, p), unknowns (g, u), gradients (g, p, u), and pivots (g, k), (g, k)."""
        every = np.arange(len(rows))[:, None]
        own = dense[every, row]
        pivots = np.take_along_axis(own, np.repeat(column[:, None, :], own.shape[1], axis=1), axis=2)
        scale = np.linalg.norm(own, axis=2)
        solved = np.linalg.inv(pivots)
        np.put_along_axis(own, np.repeat(column[:, None, :], own.shape[1], axis=1), 0.0, axis=2)
        transform = np.tile(np.eye(unknowns.shape[1]), (len(rows), 1, 1))
        transform[every, column] = -solved @ own
        transform[every[:, :, None], column[:, :, None], column[:, None, :]] = solved * scale[:, None, :]
        self._blocks.append((unknowns, transform))
        self._solved.append((rows[every, row], solved))
        self._pivot[rows[every, row]] = unknowns[every, column]
        self._scale[rows[every, row]] = scale

    def _all(self, array: np.ndarray) -> np.ndarray:
        """Return the unknowns (3 n,) of all nodes from an array whose first rows are owned nodes. Collective."""
        return self.rows.gather(array[: self.rows.mesh.n_owned]).ravel()

    def feasible(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> None:
        rows, here = self.rows, self.rows.here
        nowhere = np.full(len(rows.numbers), -1), np.empty((0, 0, 3)), np.empty((0, 0))
        k, x = rows.gather(stiffness), rows.gather(predictor + u)
        tolerance = PROJECTED * self.link.contact.size
        start = self._start if self._part == 0.0 else None
        with agreed(self.comm):
            force, jacobian = rows.project(x, tolerance, _NOWHERE, lambda: (k, start, nowhere))
        u[here] += (rows.forces(jacobian, force) * rows.free / k[:, None])[rows.mine]

    def forward(self, w: np.ndarray) -> None:
        every = self._all(w)
        pivots = np.bincount(self._to, self._values * every[self._from], minlength=len(every))
        self._write(w, np.where(self._owner, pivots, every))

    def _write(self, array: np.ndarray, every: np.ndarray) -> None:
        array[self.rows.here] = every.reshape(-1, 3)[self.rows.mine]

    def inverse(self, y: np.ndarray) -> None:
        rows, every = self.rows, self._all(y)
        along = rows.along(self._turned, every.reshape(-1, 3)) / self._scale
        every[self._pivot[self._placed]] = along[self._placed]
        self._write(y, every)

    def adjoint(self, g: np.ndarray) -> None:
        every = self._all(g)
        kept = np.where(self._owner, 0.0, every)
        self._write(g, kept + np.bincount(self._from, self._values * every[self._to], minlength=len(every)))

    def diagonal(self, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        rows = self.rows
        full = np.zeros((rows.mesh.n_owned, 3, 3))
        full[rows.here] = blocks(rows.here)
        full, every = rows.gather(full), np.zeros(3 * len(rows.numbers))
        for unknowns, transform in self._blocks:
            parts = transform.reshape(len(unknowns), -1, 3, unknowns.shape[1])
            at = full[unknowns[:, ::3] // 3]
            every[unknowns] = np.einsum("gnij,gnij->gj", parts, np.einsum("gnik,gnkj->gnij", at, parts))
        self._write(diagonal, every)

    def matrix(self) -> PETSc.Mat:
        rows, mesh = self.rows, self.rows.mesh
        own = np.arange(mesh.first_node, mesh.first_node + mesh.n_owned)
        numbers = rows.gather(own).astype(np.int64)
        local = np.repeat(np.where(rows.mine, 3 * rows.where, -1), 3) + np.tile([0, 1, 2], len(rows.numbers))
        local[np.repeat(~rows.mine, 3)] = -1
        counts = np.ones(3 * mesh.n_owned, dtype=np.int64)
        size = np.zeros(len(local), dtype=np.int64)
        for unknowns, _ in self._blocks:
            size[unknowns] = unknowns.shape[1]
        counts[local[local >= 0]] = size[local >= 0]
        pointers = np.append(0, np.cumsum(counts))
        indices = 3 * mesh.first_node + np.repeat(np.arange(3 * mesh.n_owned), counts)
        self._local, self._wide = local, 3 * np.repeat(numbers, 3) + np.tile([0, 1, 2], len(numbers))
        for at, columns, _ in self._entries(pointers):
            indices[at] = columns
        self._pattern = pointers.astype(PETSc.IntType), indices.astype(PETSc.IntType)
        matrix = PETSc.Mat().create(comm=mesh.comm)
        size = 3 * mesh.n_owned, 3 * mesh.n_nodes
        matrix.setSizes((size, size), bsize=3)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setPreallocationCSR(self._pattern)
        self.refresh(matrix)
        return matrix

    def _entries(self, pointers: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of groups alike, and of T's rows (m,) here: places (m, u) of entries, columns, and values."""
        for unknowns, transform in self._blocks:
            wide = self._wide[unknowns]
            order = np.argsort(wide, axis=1)
            group, row = np.nonzero(self._local[unknowns] >= 0)
            at = pointers[self._local[unknowns[group, row]]][:, None] + np.arange(unknowns.shape[1])
            columns = np.take_along_axis(wide, order, axis=1)[group]
            yield at, columns, np.take_along_axis(transform[group, row], order[group], axis=1)

    def refresh(self, matrix: PETSc.Mat) -> None:
        pointers, indices = self._pattern
        values = np.ones(len(indices))
        for at, _, entries in self._entries(pointers):
            values[at] = entries
        matrix.setValuesCSR(pointers, indices, values)
        matrix.assemble()

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        values = self.rows.values(self.rows.gather(x)) / self._scale
        node, component, row = self._here
        lower[node, component] = w[node, component] - values[row]

    def solve_forces(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        every = self._all(g)
        node, component, row = self._here
        on = np.zeros(w.shape)
        on[node, component] = w[node, component] <= lower[node, component]
        on = self._all(on)
        self.link.release()
        self.link.jacobian = self.jacobian
        for rows, solved in self._solved:
            force = np.einsum("gji,gj->gi", solved, every[self._pivot[rows]])
            pressed = (on[self._pivot[rows]] > 0.0) & (force > noise)
            self.link.force[rows] = np.where(pressed, force, 0.0)

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        self.link.push(contact, factor)

    def kept(self, x: np.ndarray, slack: float) -> bool:
        rows, every = self.rows, self.rows.gather(x)
        values, pressed = rows.values(every), self.link.force > 0.0
        blocked = self._deferred[values[self._deferred] < -slack]
        with agreed(self.comm):
            if len(blocked):
                ends = rows.ends[blocked[0]]
                nodes = ", ".join(map(str, rows.numbers[ends[ends >= 0]]))
                raise NotConverged(
                    f"walls and other constraints bound all directions in which nodes {nodes} can satisfy constraint "
                    f"{self.link.names[rows.source[blocked[0]]]!r}; use an explicit integrator"
                )
        lost = (values[self._placed] < -slack).any() or (np.abs(values[pressed]) > slack).any()
        if self._part > 0.0:
            turn = np.abs(rows.gradients(self._acting(every)) - self.jacobian).max(axis=(1, 2), initial=0.0)
            lost = lost or (turn[pressed] > _TURN).any()
        return not self._any(lost)

    def broken(self, x: np.ndarray, slack: float) -> bool:
        usable = self.rows.usable(self.jacobian)
        return self._any((self.rows.values(self.rows.gather(x))[usable] < -slack).any())

    def release(self) -> None:
        self.link.release()


def _pivots(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns (g, p) of matrices (g, p, q) that elimination with complete pivoting takes, largest first, and
    how many (g,) are."""
    left, every = matrices.copy(), np.arange(len(matrices))
    rows, columns = np.zeros((2, *matrices.shape[:2]), dtype=np.int64)
    count, going = np.zeros(len(matrices), dtype=np.int64), np.ones(len(matrices), dtype=bool)
    for k in range(matrices.shape[1]):
        at, column = np.divmod(np.abs(left).reshape(len(left), -1).argmax(axis=1), matrices.shape[2])
        largest = left[every, at, column]
        going &= np.abs(largest) > _LEAST
        if not going.any():
            break
        some = np.flatnonzero(going)
        at, column, largest = at[some], column[some], largest[some]
        rows[some, k], columns[some, k] = at, column
        count[some] += 1
        factors = left[some, :, column] / largest[:, None]
        left[some] -= factors[:, :, None] * left[some, at][:, None, :]
        left[some, at] = 0.0
        left[some, :, column] = 0.0
    return rows, columns, count


PACKAGE = "pfem_petsc.contact.constraints"
_ZERO = np.zeros(1)
_NO_NODES = np.empty(0, dtype=bool)


class ConstraintLink:
    """See :class:`~pfem_petsc.contact.links.Link`. Construction is collective.

    Attributes
    ----------
    rows : Rows
    force : (r,) of the rows here in the last step [N]; jacobian : (r, k, 3) gradients along which these act; the same
        on all ranks that have a row
    """

    lender = None  # the gradients of rows turn

    def __init__(
        self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh, fixed: np.ndarray, contact: Contact
    ) -> None:
        self.source, self.contact = case.source, contact
        self.names = [parameters.name for parameters in case.constraint]
        self.columns = [f"constraint/{name}" for name in self.names]
        self.rows = Rows([_source(case.source, keys, nodes, mesh) for keys in case.constraint], mesh, fixed)
        self._members = self.rows.gather(contact.members) > 0.0
        self._walled = bool(self._members.any())
        # walls whose flags travel with the positions
        self._flags = len(contact.walls) if mesh.comm.allreduce(self._walled, op=MPI.LOR) else 0
        self._x, self._hard = np.empty((len(self.rows.numbers), 3)), np.empty(len(self.rows.numbers))
        self.release()

    @property
    def numbers(self) -> np.ndarray:
        return self.rows.numbers

    def release(self) -> None:
        """Set all forces to zero."""
        self.force = np.zeros(len(self.rows.source))
        self.jacobian = np.zeros((*self.rows.ends.shape, 3))

    def explicit(
        self,
        balance: Balance,
        state: State,
        u: np.ndarray,
        stiffness: np.ndarray,
        contact: np.ndarray,
        tolerance: float,
    ) -> bool:
        rows, x = self.rows, self._x
        displacements = self.contact.motion.displacements(balance.time)
        far = np.empty((0, 7 + self._flags))
        if not rows.partners.alone:
            at, leaving = rows.partners.rows, rows.partners.leaving(far.shape[1])
            leaving_nodes(at, balance.predictor, u, stiffness, state.position, leaving)
            if self._flags:
                leaving[:, 7:] = self.contact.applicable(at, leaving[:, :3], displacements)
            far = rows.partners.bring(leaving)
        free_positions(rows.where, balance.predictor, u, far, x)
        near = self._near(x, balance.time)

        def given() -> tuple[np.ndarray, np.ndarray | None, Planes]:
            start = rows.spread(state.position, far[:, 4:7]) if balance.acting < 1.0 else None
            free_stiffness(rows.where, stiffness, far, self._hard)
            return self._hard, start, self._planes(near, x, far[:, 7:] > 0.0, displacements)

        self.force, self.jacobian = rows.project(x, tolerance, near, given)
        if not self.force.any():
            return False
        load = rows.forces(self.jacobian, self.force)
        push_nodes(rows.where, load, rows.free, stiffness, u, contact)
        return bool(load[rows.mine].any())

    def _near(self, x: np.ndarray, time: float) -> np.ndarray:
        """(n,) bool: nodes at positions (n, 3) beyond a wall."""
        if not self._walled:
            return _NO_NODES
        near, flat = np.zeros(len(x), dtype=bool), self.contact.flat
        members = np.ascontiguousarray(self._members[:, flat])
        offsets = self.contact.plane_offsets(time)[flat]
        near_planes(x, self.contact.normals[flat], offsets, np.zeros(len(offsets), bool), members, _ZERO, near)
        return near

    def _planes(self, near: np.ndarray, x: np.ndarray, away: np.ndarray, displacements: np.ndarray) -> Planes:
        """Planes of the groups that have a node near a wall or any row, at positions x (n, 3); ``away`` (m, w): walls
        that concern nodes that others own."""
        rows, contact = self.rows, self.contact
        place = np.full(len(x), -1)
        if not self._walled:
            return place, np.empty((0, 0, 3)), np.empty((0, 0))
        nodes = np.flatnonzero(self._members.any(axis=1))
        place[nodes] = np.arange(len(nodes))
        where = rows.where[nodes]
        own = where >= 0
        applicable = np.empty((len(nodes), len(contact.walls)), dtype=bool)
        applicable[own] = contact.applicable(where[own], x[nodes[own]], displacements)
        applicable[~own] = away[-1 - where[~own]]
        normals, offsets = contact.planes(applicable, x[nodes], displacements)
        return place, normals, np.einsum("nwi,ni->nw", normals, x[nodes]) - offsets

    def coordinates(self) -> RowCoordinates:
        return RowCoordinates(self)

    def mark(self, held: np.ndarray) -> None:
        mark_pressed(self.rows.ends, self.rows.where, self.force, held)

    def totals(self) -> np.ndarray:
        rows, totals = self.rows, np.zeros((len(self.names), 3))
        last_forces(rows.counted, rows.source, rows.last, self.jacobian, self.force, totals)
        return totals

    def tables(self, owned: int) -> np.ndarray:
        rows, tables = self.rows, np.full(owned, -1)
        at = np.flatnonzero((self.force > 0.0) & rows.counted)
        tables[rows.where[rows.ends[at, rows.last[at]]]] = rows.source[at]
        return tables

    def check(self, model: Model, on_its_own: bool) -> None:
        key, rows, walls, comm = f"{self.source}: constraint", self.rows, self.contact, model.mesh.comm
        if model.case.contact.treatment != "scheme":
            raise InputError(f'{key}: constraints need contact.treatment = "scheme"')
        others = [link.numbers for link in model.links if link is not self]
        both = sum(np.isin(rows.numbers, numbers).sum() for numbers in others)
        if comm.allreduce(int(both)):
            raise InputError(f"{key}: a node is in a contact_pair as well as in a constraint; use one of them")
        met = comm.allreduce(walls.members[rows.here].sum(axis=0)) > 0
        special = walls.special & met
        if special.any():
            raise InputError(
                f"{key}: wall {walls.names[int(special.argmax())]!r} stops constrained nodes: such a wall must be "
                "flat, without mass, friction and restitution, and not tied; or give it a node_set without them"
            )
        values = rows.values(rows.gather(model.mesh.points[: model.mesh.n_owned]))
        deepest = (np.inf,)
        if len(values) and not values.min() >= -ON_BOUND * model.size:
            row = int(np.argmin(values))
            at = ", ".join(str(n) for n in rows.numbers[rows.ends[row][rows.ends[row] >= 0]])
            deepest = (float(values[row]), int(rows.source[row]), int(rows.ids[row]), at)
        deepest = min(comm.allgather(deepest))
        if len(deepest) > 1:
            raise InputError(
                f"{key} {self.names[deepest[1]]!r}: nodes {deepest[3]} start {-deepest[0]:.6g} m beyond it; correct "
                "its keys, or move the mesh"
            )

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> np.ndarray:
        """Return second time derivatives (r,) [m/s2] of closed rows at zero acceleration, infinite for open rows."""
        x, v = self.rows.gather(x), self.rows.gather(v)
        self.jacobian = self.rows.gradients(x)
        closed = np.abs(self.rows.values(x)) <= slack
        closed &= np.abs(self.rows.along(self.jacobian, v)) <= still
        return np.where(closed, self.rows.drift(x, v), np.inf)

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: Any, on_walls: np.ndarray) -> np.ndarray:
        rows, contact = self.rows, self.contact
        state, change = contact.state, np.zeros_like(a)
        rests = rows.gather(on_walls) > 0.0
        every, hard = rows.gather(a), rows.gather(mass)
        normals, _ = contact.planes(rests, rows.gather(state.position), contact.motion.displacements(state.time))
        gaps = np.where(rests, np.einsum("nwi,ni->nw", normals, every), np.inf)
        values = rows.along(self.jacobian, every) + closed
        largest = rows.mesh.comm.allreduce(float(np.abs(every).max(initial=0.0)), op=MPI.MAX)
        place = np.where(rests.any(axis=1), np.arange(len(every)), -1)
        with agreed(rows.mesh.comm):
            self.force = rows.solve(self.jacobian, values, hard, (place, normals, gaps), 1e-13 * largest)
        change[rows.here] = (rows.forces(self.jacobian, self.force) * rows.free)[rows.mine]
        return change

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        contact[self.rows.here] += factor * self.rows.forces(self.jacobian, self.force)[self.rows.mine]

    def save(self) -> tuple[np.ndarray, np.ndarray]:
        return self.force, self.jacobian

    def restore(self, saved: tuple[np.ndarray, np.ndarray]) -> None:
        self.force, self.jacobian = saved

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        rows = self.rows
        kept = {"constraints.force": self.force, "constraints.gradients": self.jacobian}
        return {name: (rows.order, values[rows.counted]) for name, values in kept.items() if rows.order.n_global}

    def load_state(self, name: str, values: np.ndarray) -> None:
        every = self.rows.of_counted(values)
        if name == "constraints.force":
            self.force = every
        else:
            self.jacobian = every


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
