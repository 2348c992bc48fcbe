"""The constraints of a case as a link: the interface of rows of any kind to the steps.

All ranks know all rows and solve the same small problems; each rank applies the result to its own nodes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..integrators.base import Balance, State
from ..registry import lookup
from ..tolerances import ON_BOUND
from .row_coordinates import RowCoordinates
from .rows import Rows

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model
    from .contact import Contact

__all__ = ["ConstraintLink"]

PACKAGE = "pfem_petsc.contact.constraints"


class ConstraintLink:
    """See :class:`~pfem_petsc.contact.links.Link`. Construction is collective.

    Attributes
    ----------
    rows : Rows
    force : (r,) of the last step [N]; jacobian : (e, 3) gradients along which they act; the same on all ranks
    """

    key = "constraints"

    def __init__(
        self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh, fixed: np.ndarray, contact: Contact
    ) -> None:
        self.source, self.contact = case.source, contact
        self.names = [parameters.name for parameters in case.constraint]
        self.columns = [f"constraint/{name}" for name in self.names]

        def nodes_of(name: str) -> tuple[np.ndarray, np.ndarray]:
            local = nodes[name]
            parts = mesh.comm.allgather((mesh.node_ids[local], mesh.points[local]))
            numbers, points = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
            order = np.argsort(numbers)
            return numbers[order].astype(np.int64), points[order]

        sources = []
        for parameters in case.constraint:
            key = f"{case.source}: constraint {parameters.name!r}"
            try:
                source = lookup(PACKAGE, parameters.kind, f"{key}: kind").Constraint(parameters, nodes_of)
            except InputError as error:  # a kind knows its keys, but not the file that contains them
                raise InputError(f"{key}: {error}") from error
            same = np.sort(source.nodes, axis=1)
            if (same[:, 1:] == same[:, :-1]).any():
                node = same[:, 1:][same[:, 1:] == same[:, :-1]][0]
                raise InputError(f"{key}: node {node} is constrained with itself; name different nodes")
            sources.append(source)
        self.rows = Rows(sources, mesh, fixed)
        self.release()

    @property
    def numbers(self) -> np.ndarray:
        return self.rows.numbers

    def release(self) -> None:
        """Set all forces to zero."""
        self.force = np.zeros(len(self.rows.source))
        self.jacobian = np.zeros((len(self.rows.entry_row), 3))

    def explicit(
        self,
        balance: Balance,
        state: State,
        u: np.ndarray,
        stiffness: np.ndarray,
        contact: np.ndarray,
        tolerance: float,
    ) -> None:
        rows, here = self.rows, self.rows.here
        x = balance.predictor + u
        start = rows.gather(state.position) if acts_at_start(balance, state) else None
        planes = self._planes(x[here], balance.time)
        self.force, self.jacobian = rows.project(rows.gather(x), rows.gather(stiffness), start, planes, tolerance)
        forces = rows.forces(self.jacobian, self.force)[rows.mine]
        u[here] += forces * rows.free[rows.mine] / stiffness[here, None]
        contact[here] += forces

    def _planes(self, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return planes (n, w, 3), (n, w) of walls at all nodes, from positions (m, 3) of owned nodes. Collective."""
        contact, here = self.contact, self.rows.here
        walls = len(contact.walls)
        displacements = contact.motion.displacements(time)
        normals, offsets = contact.planes(contact.applicable(here, x, displacements), x, displacements)
        # a sum over ranks must not contain infinities
        data = np.zeros((len(contact.members), 4 * walls))
        data[here] = np.hstack([normals.reshape(len(here), 3 * walls), np.maximum(offsets, -1e300)])
        data = self.rows.gather(data) if walls else np.zeros((len(self.rows.numbers), 0))
        offsets = data[:, 3 * walls :]
        return data[:, : 3 * walls].reshape(len(data), walls, 3), np.where(offsets <= -1e300, -np.inf, offsets)

    def coordinates(self) -> RowCoordinates:
        return RowCoordinates(self)

    def held(self) -> np.ndarray:
        pressed = np.zeros(len(self.rows.numbers), dtype=bool)
        pressed[self.rows.entry_node[self.force[self.rows.entry_row] > 0.0]] = True
        return np.sort(self.rows.here[pressed[self.rows.mine]])

    def totals(self) -> np.ndarray:
        totals = np.zeros((len(self.names), 3))
        if self.rows.mesh.comm.rank == 0:  # all ranks know the forces
            np.add.at(totals, self.rows.source, self.force[:, None] * self.jacobian[self.rows.last])
        return totals

    def tables(self, owned: int) -> np.ndarray:
        rows, tables = self.rows, np.full(owned, -1)
        of_nodes = np.full(len(rows.numbers), -1)
        pressed = self.force > 0.0
        of_nodes[rows.entry_node[rows.last[pressed]]] = rows.source[pressed]
        tables[rows.here] = of_nodes[rows.mine]
        return tables

    def check(self, model: Model, on_its_own: bool) -> None:
        key, rows, walls = f"{self.source}: constraint", self.rows, self.contact
        if model.case.contact.treatment != "scheme":
            raise InputError(f'{key}: constraints need contact.treatment = "scheme"')
        others = [link.numbers for link in model.links if link is not self]
        both = sum(np.isin(rows.numbers, numbers).sum() for numbers in others)
        if model.mesh.comm.allreduce(int(both)):
            raise InputError(f"{key}: a node is in a contact_pair as well as in a constraint; use one of them")
        met = rows.mesh.comm.allreduce(walls.members[rows.here].sum(axis=0)) > 0
        special = walls.special & met
        if special.any():
            raise InputError(
                f"{key}: wall {walls.names[int(special.argmax())]!r} stops constrained nodes: such a wall must be "
                "flat, without mass, friction and restitution, and not tied; or give it a node_set without them"
            )
        points = rows.gather(model.mesh.points[: model.mesh.n_owned])
        values = rows.values(points)
        if len(values) and not values.min() >= -ON_BOUND * model.length:
            row = int(np.argmin(values))
            at = ", ".join(str(n) for n in rows.numbers[rows.entry_node[rows.entry_row == row]])
            raise InputError(
                f"{key} {self.names[rows.source[row]]!r}: nodes {at} start {-values[row]:.6g} m beyond it; correct its "
                "keys, or move the mesh"
            )

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> np.ndarray:
        """Return second time derivatives (r,) [m/s2] of closed rows at zero acceleration, infinite for open rows."""
        x, v = self.rows.gather(x), self.rows.gather(v)
        self.jacobian = self.rows.gradients(x)
        closed = np.abs(self.rows.values(x)) <= slack
        closed &= np.abs(self.rows.along(self.jacobian, v)) <= still
        return np.where(closed, self.rows.drift(x, v), np.inf)

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: Any, on_walls: np.ndarray) -> np.ndarray:
        rows, here = self.rows, self.rows.here
        state, change = self.contact.state, np.zeros_like(a)
        normals, offsets = self._planes(state.position[here], state.time)
        rests = rows.gather(on_walls.astype(float)) > 0.0
        every = rows.gather(a)
        gaps = np.where(rests, np.einsum("nwi,ni->nw", normals, every), np.inf)
        values = rows.along(self.jacobian, every) + closed
        tolerance = 1e-13 * float(np.abs(every).max(initial=0.0))
        self.force, _ = rows.solve(self.jacobian, values, rows.gather(mass), (normals, gaps), tolerance)
        change[here] = (rows.forces(self.jacobian, self.force) * rows.free)[rows.mine]
        return change

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        contact[self.rows.here] += factor * self.rows.forces(self.jacobian, self.force)[self.rows.mine]

    def save(self) -> dict[str, list]:
        return {"force": self.force.tolist(), "jacobian": self.jacobian.tolist()}

    def arrays(self) -> dict[str, np.ndarray]:
        return {}

    def load_state(self, name: str, values: np.ndarray) -> None:
        """Do nothing: constraints keep no arrays."""

    def restore(self, saved: dict[str, list]) -> None:
        self.force = np.array(saved["force"], dtype=float)
        self.jacobian = np.array(saved["jacobian"], dtype=float).reshape(-1, 3)


def acts_at_start(balance: Balance, state: State) -> bool:
    """Return whether the forces of a balance act at the state's positions, not at the positions solved for."""
    return all(time == state.time for _, time in balance.loads)
