"""Contact pairs as a link: adapts :mod:`pairs <pfem_petsc.contact.pairs>` and their coordinates to its interface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..parallel.natural import NaturalOrder
from .fixed_rows import FixedRows
from .frames import NodalFrames
from .links import BlocksOf
from .pair_checks import check_scheme, check_start
from .pair_coordinates import PairCoordinates
from .pair_loops import mark_nodes
from .pairs import ContactPairs

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["PairLink", "PairLinkCoordinates"]


class PairLink:
    """The pairs of a case; see :class:`~pfem_petsc.contact.links.Link`."""

    def __init__(self, pairs: ContactPairs) -> None:
        self.pairs = pairs
        self.columns = [f"pair/{name}" for name in pairs.names]
        self._rows: FixedRows | None = None  # for nodes of the stiffness
        self._rows_of = np.empty(0)

    @property
    def numbers(self) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.links.Link`."""
        return np.append(self.pairs.first, self.pairs.second)

    def explicit(
        self,
        balance: Balance,
        state: State,
        u: np.ndarray,
        stiffness: np.ndarray,
        contact: np.ndarray,
        tolerance: float,
    ) -> bool:
        """See :class:`~pfem_petsc.contact.links.Link`, here and below."""
        return self.pairs.explicit(balance.predictor, u, stiffness, contact, balance.time, tolerance)

    @property
    def lender(self) -> PairLink | None:
        pairs = self.pairs
        independent = not pairs.coupled.any and not pairs.coupled.contact.any
        return self if independent and pairs.partners.alone else None

    def lend_rows(self, stiffness: np.ndarray) -> FixedRows:
        pairs = self.pairs
        if self._rows is None or stiffness is not self._rows_of:
            self._rows, self._rows_of = pairs.rows(stiffness), stiffness
        self._rows.force[self._rows.place], self._rows.closed[self._rows.place] = pairs.force, pairs.closed
        return self._rows

    def take_rows(self, rows: FixedRows) -> None:
        self.pairs.force, self.pairs.closed = rows.force[rows.place], rows.closed[rows.place]

    def coordinates(self) -> PairLinkCoordinates:
        return PairLinkCoordinates(self.pairs)

    def mark(self, held: np.ndarray) -> None:
        mark_nodes(self.pairs.where, self.pairs.force, held)

    def totals(self) -> np.ndarray:
        return np.array(list(self.pairs.totals().values()))

    def tables(self, owned: int) -> np.ndarray:
        pairs, tables = self.pairs, np.full(owned, -1)
        second = pairs.mine[1] & (pairs.force > 0.0)
        tables[pairs.local[1, second]] = pairs.table[second]
        return tables

    def check(self, model: Model, on_its_own: bool) -> None:
        treatment = model.case.contact.treatment
        check_scheme(self.pairs, on_its_own, treatment)
        check_start(self.pairs, model.mesh.points[: model.mesh.n_owned], model.size, model.case.source)

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> np.ndarray:
        return self.pairs.resting(x, v, slack, still)

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: Any, on_walls: np.ndarray) -> np.ndarray:
        return self.pairs.rest(a, mass, closed, on_walls)

    def push(self, contact: np.ndarray) -> None:
        self.pairs.push(contact)

    def save(self) -> None:
        return None

    def restore(self, saved: None) -> None:
        """They are found again."""

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        return {name: (self.pairs.mesh.node_order, values) for name, values in self.pairs.kept().items()}

    def load_state(self, name: str, values: np.ndarray) -> None:
        self.pairs.load_state(name, values)


class PairLinkCoordinates:
    """Coordinates of contact pairs; see :class:`~pfem_petsc.contact.links.LinkCoordinates`."""

    def __init__(self, pairs: ContactPairs) -> None:
        self.pairs = pairs
        self.own = PairCoordinates(pairs)

    @property
    def varies(self) -> bool:
        """See :class:`~pfem_petsc.contact.links.LinkCoordinates`, here and below."""
        return self.pairs.coupled.any_walled

    def reached(self, state: State, move: np.ndarray, slack: float) -> bool:
        return self.own.reached(state.position, move, state.contact, slack)

    def place(self, frames: NodalFrames | None, balance: Balance, state: State, x: np.ndarray) -> None:
        self.own.place(frames)

    def feasible(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> None:
        self.pairs.part(predictor, u, stiffness)

    def forward(self, w: np.ndarray) -> None:
        self.own.increment(w)

    def inverse(self, y: np.ndarray) -> None:
        self.own.coordinates(y)

    def adjoint(self, g: np.ndarray) -> None:
        self.own.gradient(g)

    def diagonal(self, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        self.own.diagonal(blocks(self.own.slave_nodes), diagonal)

    def matrix(self) -> PETSc.Mat:
        return self.own.matrix()

    def refresh(self, matrix: PETSc.Mat) -> None:
        self.own.refresh(matrix)

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        self.own.bound(x, w, lower)

    def solve_forces(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        self.own.press(w, g, lower, noise)

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        self.pairs.push(contact, factor)

    def kept(self, x: np.ndarray, slack: float) -> bool:
        """See :class:`~pfem_petsc.contact.links.LinkCoordinates`; pairs without a free coordinate are checked too."""
        blocked = self.own.blocked(x, slack)
        if blocked is not None:
            first, second, name = blocked
            raise NotConverged(
                f"walls bound all directions in which nodes {first} and {second} of contact_pair {name!r} can separate"
                "; use an explicit integrator"
            )
        return True

    def broken(self, x: np.ndarray, slack: float) -> bool:
        return self.own.broken(x, slack)

    def release(self) -> None:
        self.pairs.release()
