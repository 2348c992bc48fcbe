"""Links couple nodes to nodes; the transform of an implicit solve makes each contact row a bound on one unknown: u =
T w.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from petsc4py import PETSc

from ..errors import SimulationFailure
from ..integrators.base import Balance, State
from ..parallel.natural import NaturalOrder
from ..solvers.matrix import turn_blocks
from .fixed_rows import NoRows, RowLender
from .frames import NodalFrames, Sliding

if TYPE_CHECKING:
    from ..solvers.matrix import HessianMatrix
    from ..stepping.model import Model


class Link(Protocol):
    """One source of rows over several nodes.

    Attributes
    ----------
    columns : of its tables in the history, like ``pair/NAME``
    numbers : mesh numbers of the nodes of its rows, at least of those whose nodes this rank owns
    lender : lends its rows to loops over many steps; None if such loops cannot solve them on this rank
    """

    columns: list[str]
    numbers: np.ndarray

    @property
    def lender(self) -> RowLender | None:
        """See above."""

    def explicit(
        self,
        balance: Balance,
        state: State,
        u: np.ndarray,
        stiffness: np.ndarray,
        contact: np.ndarray,
        tolerance: float,
    ) -> bool:
        """Correct the increments ``u`` (owned, 3) of a step in which each node is solved on its own. Collective.

        Gives whether any row presses on a node of this rank.

        ``stiffness`` (owned,) is the force for a displacement of a node [N/m]; as long as its values stay the same, it
        is the same array, on all ranks. ``contact`` (owned, 3) takes the forces [N], ``tolerance`` [m] is the depth up
        to which a row counts as kept.

        Raises
        ------
        SimulationFailure
            If no positions satisfy all rows. Raised at least on this rank, after all collective operations.
        """

    def coordinates(self) -> LinkCoordinates:
        """Return the coordinates for implicit steps. Collective."""

    def mark(self, held: np.ndarray) -> None:
        """Mark owned nodes (owned,) on which rows press."""

    def totals(self) -> np.ndarray:
        """This rank's share of the forces (tables, 3) of the rows on their last nodes [N]."""

    def tables(self, owned: int) -> np.ndarray:
        """(owned,) the table whose rows press on an owned node as their last one, -1 for none."""

    def check(self, model: Model, on_its_own: bool) -> None:
        """Check that the model is compatible with the link and that no row is violated at the start. Collective.

        ``on_its_own``: whether nodes are solved independently, by an explicit scheme with lumped mass.

        Raises
        ------
        InputError
            On all ranks.
        """

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> Any:
        """Return the rows closed at the start within ``slack`` [m] and at rest within ``still`` [m/s]. Collective."""

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: Any, on_walls: np.ndarray) -> np.ndarray:
        """Set the forces of closed rows at accelerations (owned, 3); return them on free components. Collective.

        ``on_walls`` (owned, walls) bool: nodes that rest on walls.
        """

    def push(self, contact: np.ndarray) -> None:
        """Add its forces to those on the nodes (owned, 3) [N]."""

    def save(self) -> Any:
        """Its forces, for :meth:`restore` of a step that is given up."""

    def restore(self, saved: Any) -> None:
        """Restore the forces."""

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """What a checkpoint keeps of it: name to an order of things and the rows that this rank owns; the same names
        on all ranks."""

    def load_state(self, name: str, values: np.ndarray) -> None:
        """Take such rows back. Collective."""


class LinkCoordinates(Protocol):
    """Coordinates w of implicit steps in which each row of a link is a lower bound on one unknown.

    They replace those of the frames of walls: y = T w, y (owned, 3).

    Attributes
    ----------
    varies : whether T changes from solve to solve
    """

    varies: bool

    def reached(self, state: State, move: np.ndarray, slack: float) -> bool:
        """Return whether rows may close in a step in which nodes move by (owned, 3) [m]. Collective."""

    def place(self, frames: NodalFrames | None, balance: Balance, state: State, x: np.ndarray) -> None:
        """Set the frames of a solve, None if there are none, and the guess of positions (owned, 3). Collective."""

    def feasible(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> None:
        """Change increments (owned, 3), in place, so that the rows are satisfied. Collective."""

    def forward(self, w: np.ndarray) -> None:
        """Transform w to y (owned, 3), in place. Collective."""

    def inverse(self, y: np.ndarray) -> None:
        """Transform y to w (owned, 3), in place. Collective."""

    def adjoint(self, g: np.ndarray) -> None:
        """Transform a gradient with respect to y to that with respect to w (owned, 3), in place. Collective."""

    def diagonal(self, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        """Replace the diagonal (owned, 3) of H by that of T^T H T. Collective.

        ``blocks`` returns the diagonal blocks (k, 3, 3) of H at owned nodes (k,).
        """

    def matrix(self) -> PETSc.Mat:
        """Return T, preallocated for all states of the link; the caller destroys it. Collective."""

    def refresh(self, matrix: PETSc.Mat) -> None:
        """Update T. Collective."""

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        """Write bounds on w into (owned, 3), from positions (owned, 3) and their w. Collective."""

    def solve_forces(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        """Set the forces from w, the residual with respect to y, and the bounds (owned, 3). Collective.

        Forces up to ``noise`` [N] count as zero.
        """

    def push(self, contact: np.ndarray, factor: float = 1.0) -> None:
        """Add its forces, times a factor, to those on the nodes (owned, 3) [N]."""

    def kept(self, x: np.ndarray, slack: float) -> bool:
        """Return whether positions (owned, 3) satisfy the rows that were bounds, to ``slack`` [m]. Collective.

        Raises
        ------
        NotConverged
            On all ranks, if a row without an unknown is violated.
        """

    def broken(self, x: np.ndarray, slack: float) -> bool:
        """Return whether positions (owned, 3) violate any row by more than ``slack`` [m]. Collective."""

    def release(self) -> None:
        """Set all forces to zero."""


class BlocksOf(Protocol):
    """Diagonal blocks of a Hessian."""

    def __call__(self, nodes: np.ndarray) -> np.ndarray:
        """Return blocks (k, 3, 3) at owned nodes (k,)."""


class Links:
    """All links of a model, in the order in which a step treats them; False if there are none."""

    def __init__(self, members: Sequence[Link] = ()) -> None:
        self.members = tuple(members)
        self.columns = [name for link in self.members for name in link.columns]

    def __bool__(self) -> bool:
        return bool(self.members)

    def __iter__(self) -> Iterator[Link]:
        return iter(self.members)

    def explicit(
        self, balance: Balance, state: State, u: np.ndarray, stiffness: np.ndarray, none: np.ndarray, tolerance: float
    ) -> np.ndarray:
        """See :meth:`Link.explicit`; return the forces (owned, 3) [N], ``none`` if there are no links."""
        if not self.members:
            return none
        contact, failure, pressed = np.zeros(u.shape), None, False
        for link in self.members:
            try:
                pressed |= link.explicit(balance, state, u, stiffness, contact, tolerance)
            except SimulationFailure as met:  # the next link may be collective
                failure = failure or met
        if failure is not None:
            raise failure
        return contact if pressed else none

    @property
    def lender(self) -> RowLender | None:
        """See :class:`Link`; the rows of one link at most."""
        if not self.members:
            return NoRows()
        return self.members[0].lender if len(self.members) == 1 else None

    def count_held(self, nodes: np.ndarray, owned: int) -> int:
        """How many of the owned nodes are among those (k,) that walls hold, or held by links."""
        if not self.members:
            return len(nodes)
        held = np.zeros(owned, dtype=bool)
        held[nodes] = True
        for link in self.members:
            link.mark(held)
        return int(np.count_nonzero(held))

    def totals(self) -> np.ndarray:
        """This rank's share of the forces (tables, 3) of all links on the last nodes of their rows [N]."""
        return np.concatenate([np.zeros((0, 3)), *(link.totals() for link in self.members)])

    def tables(self, owned: int) -> np.ndarray:
        """(owned,) the table whose rows press on an owned node as their last one, -1 for none."""
        tables, first = np.full(owned, -1), 0
        for link in self.members:
            own = link.tables(owned)
            tables[own >= 0] = own[own >= 0] + first
            first += len(link.columns)
        return tables

    def check(self, model: Model, on_its_own: bool) -> None:
        """See :meth:`Link.check`."""
        for link in self.members:
            link.check(model, on_its_own)

    def resting(self, x: np.ndarray, v: np.ndarray, slack: float, still: float) -> list[Any]:
        """See :meth:`Link.resting`."""
        return [link.resting(x, v, slack, still) for link in self.members]

    def rest(self, a: np.ndarray, mass: np.ndarray, closed: list[Any], on_walls: np.ndarray) -> np.ndarray:
        """See :meth:`Link.rest`; return the sum over all links."""
        total = np.zeros_like(a)
        for link, own in zip(self.members, closed, strict=True):
            total += link.rest(a, mass, own, on_walls)
        return total

    def push(self, contact: np.ndarray) -> None:
        """See :meth:`Link.push`."""
        for link in self.members:
            link.push(contact)

    def save(self) -> list[Any]:
        """See :meth:`Link.save`."""
        return [link.save() for link in self.members]

    def restore(self, saved: list[Any]) -> None:
        """Take the forces back from what :meth:`save` gave."""
        for link, own in zip(self.members, saved, strict=True):
            link.restore(own)

    def arrays(self) -> dict[str, tuple[NaturalOrder, np.ndarray]]:
        """See :meth:`Link.arrays`; those of all links."""
        return {name: array for link in self.members for name, array in link.arrays().items()}

    def load_state(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take the arrays of all links back. Collective."""
        for link in self.members:
            for name in link.arrays():
                link.load_state(name, arrays[name])


class Transform:
    """Coordinates of a solve. Construction is collective.

    Parameters
    ----------
    model : Model
    frames : of nodes near walls; None if no rank has any
    links : coordinates of the links that may close in the step

    Attributes
    ----------
    links : tuple of these
    sliding : friction forces on slipping nodes; has no nodes without friction
    identity : whether w equals u and the residual is unchanged
    bounded : whether the solve has bounds
    """

    def __init__(self, model: Model, frames: NodalFrames | None = None, links: Sequence[LinkCoordinates] = ()) -> None:
        self.mesh = model.mesh
        self.links = tuple(links)
        walls = model.contact.members.shape[1]
        own = frames is not None and (frames.oblique or (frames.sliding is not None and len(frames.sliding.nodes) > 0))
        self._oblique = frames is not None and model.comm.allreduce(int(own)) > 0
        self.bounded = frames is not None or bool(self.links)
        self.identity = not self._oblique and not self.links
        # frames along the axes change no coordinates
        self._frames = frames if self._oblique else NodalFrames(np.empty(0, dtype=np.int64), walls)
        self.sliding = self._frames.sliding or Sliding.none(walls)
        if self._oblique:
            self._share_frames()

    @property
    def frames(self) -> NodalFrames:
        """Frames of owned nodes whose coordinates are not those of x."""
        return self._frames

    @cached_property
    def nodewise(self) -> bool:
        """Whether w differs from u by frames of nodes only, and the Hessian is symmetric. Collective at first use."""
        return not self.links and not self.mesh.comm.allreduce(int(len(self.sliding.nodes) > 0))

    def _share_frames(self) -> None:
        mesh, frames = self.mesh, self._frames
        inverse = np.zeros((mesh.n_local, 10))
        inverse[frames.nodes, 0] = 1.0
        inverse[frames.nodes, 1:] = frames.inverse.reshape(-1, 9)
        mesh.update_ghosts(inverse)
        turned = np.flatnonzero(inverse[:, 0] > 0.0)
        self._frame_of = np.full(mesh.n_local, -1, dtype=np.int32)
        self._frame_of[turned] = np.arange(len(turned), dtype=np.int32)
        self._inverse = np.ascontiguousarray(inverse[turned, 1:]).reshape(-1, 3, 3)

    def forward(self, w: np.ndarray) -> None:
        """Transform w (owned, 3) to u, in place. Collective."""
        for link in reversed(self.links):
            link.forward(w)
        at = self._frames.nodes
        w[at] = np.einsum("nij,nj->ni", self._frames.inverse, w[at])

    def inverse(self, u: np.ndarray) -> None:
        """Transform u (owned, 3) to w, in place. Collective."""
        at = self._frames.nodes
        u[at] = np.einsum("nij,nj->ni", self._frames.basis, u[at])
        for link in self.links:
            link.inverse(u)

    def residual(self, predictor: np.ndarray, u: np.ndarray, g: np.ndarray) -> None:
        """Transform the residual force (owned, 3) at predictor + u to the residual of w, in place. Collective."""
        at, slipping = self._frames.nodes, self.sliding.nodes
        g[at] = np.einsum("nji,nj->ni", self._frames.inverse, g[at])
        g[slipping] = self.sliding.couple(predictor[slipping] + u[slipping], g[slipping])
        for link in self.links:
            link.adjoint(g)

    def left(self) -> np.ndarray:
        """Matrices (m, 3, 3) that map the residual force at framed nodes to the residual, at the last evaluation."""
        left = self._frames.inverse.transpose(0, 2, 1).copy()
        at = self.sliding.at
        left[at] = self.sliding.maps @ left[at]
        return left

    def linear(self, left: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Transform H u (local, 3), in place, to the derivative of the residual along u (local, 3). Collective.

        ``left`` : value of :meth:`left` where H was evaluated.
        """
        at, slipping = self._frames.nodes, self.sliding.nodes
        out[slipping] += np.einsum("nij,nj->ni", self.sliding.stiffness, u[slipping])
        out[at] = np.einsum("nij,nj->ni", left, out[at])
        for link in self.links:
            link.adjoint(out)

    def diagonal(self, left: np.ndarray, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        """Replace the diagonal (owned, 3) of H by that of the derivative of the residual. Collective."""
        nodes = self._frames.nodes
        full = blocks(nodes)
        full[self.sliding.at] += self.sliding.stiffness
        diagonal[nodes] = np.einsum("nij,njk,nki->ni", left, full, self._frames.inverse)
        for link in self.links:
            link.diagonal(lambda some: self._in_frames(some, blocks(some)), diagonal)

    def _in_frames(self, nodes: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        _, at, place = np.intersect1d(nodes, self._frames.nodes, return_indices=True)
        inverse = self._frames.inverse[place]
        blocks[at] = inverse.transpose(0, 2, 1) @ blocks[at] @ inverse
        return blocks

    def turn(self, matrix: HessianMatrix, values: np.ndarray) -> None:
        """Transform the values of an assembled Hessian to frame coordinates, without those of links. Collective."""
        if not self._oblique:
            return
        matrix.add_blocks(self.sliding.nodes, self.sliding.stiffness, values)
        left = self.left()
        turn_blocks(matrix.pattern.ptr, matrix.local_columns, self._frame_of, left, self._inverse, values)
