"""The constraints of a case as a link: what steps ask of rows, whatever kind they are of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from ..errors import InputError
from ..integrators.base import Balance, State
from ..mesh.exchange import Router
from ..mesh.slab import slab_of
from ..parallel.agreement import agreed
from ..parallel.natural import NaturalOrder
from ..registry import lookup
from ..tolerances import ON_BOUND
from .constraints.base import Constraint, ConstraintKeys, SetPart
from .row_coordinates import RowCoordinates
from .row_loops import free_positions, free_stiffness, last_forces, leaving_nodes, mark_pressed, push_nodes
from .rows import Planes, Rows
from .search import near_planes

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model
    from .contact import Contact

__all__ = ["ConstraintLink"]

PACKAGE = "pfem_petsc.contact.constraints"
_ZERO = np.zeros(1)
_NOWHERE = np.empty(0, dtype=bool)


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
            return _NOWHERE
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
