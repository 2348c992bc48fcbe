"""Contact pairs as a link: their coordinates in implicit steps, their share in batches, and checks before the first
step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError, NotConverged
from ..integrators.base import Balance, State
from ..parallel.natural import NaturalOrder
from ..tolerances import ON_BOUND
from .fixed_rows import FixedRows, mark_nodes
from .frames import NodalFrames
from .links import BlocksOf
from .pairs import ContactPairs

if TYPE_CHECKING:
    from ..stepping.model import Model


_THIN = 1e-6  # length of a direction's free part below which supports alone determine the motion
_LEAST = 0.1  # |alpha_s| at a node with a frame below which the pair is deferred


class _Ends:
    """One end of each pair in a list.

    Attributes
    ----------
    mine : (k,) bool, ends that this rank owns; ``nodes`` (m,) their owned local indices
    """

    def __init__(self, pairs: ContactPairs, ends: np.ndarray, at: np.ndarray) -> None:
        where = pairs.where[ends, at]
        self.mine = where >= 0
        self.nodes = where[self.mine]
        self._far = -1 - where[~self.mine]
        self._partners = partners = pairs.partners
        # this rank's ends that partners need; a node is in one pair only
        order = np.argsort(self.nodes)
        place = np.minimum(np.searchsorted(self.nodes, partners.rows, sorter=order), max(len(order) - 1, 0))
        self._leaving = order[place] if len(order) else np.zeros(len(partners.rows), dtype=np.int64)
        self._wanted = self.nodes[self._leaving] == partners.rows if len(order) else np.zeros(len(place), dtype=bool)

    def known(self, values: np.ndarray) -> np.ndarray:
        """Return values (k,) at all ends from those (m,) at owned ends. Collective."""
        data = np.empty(len(self.mine))
        data[self.mine] = values
        if not self._partners.alone:
            leaving = np.zeros((len(self._wanted), 1))
            leaving[self._wanted, 0] = values[self._leaving[self._wanted]]
            data[~self.mine] = self._partners.bring(leaving)[self._far, 0]
        return data


class PairCoordinates:
    """The change of coordinates for this rank's pairs.

    Attributes
    ----------
    carriers : (k,) owned nodes whose coordinates carry the bounds of pairs
    """

    def __init__(self, pairs: ContactPairs) -> None:
        self.pairs = pairs
        lengths = np.sqrt(np.einsum("epi,pi->ep", pairs.free, pairs.normals**2))
        self._usable = lengths.max(axis=0, initial=0.0) > _THIN
        self._place(
            np.tile(np.eye(3), (*pairs.mine.shape, 1, 1)), np.zeros(pairs.mine.shape, dtype=bool), pairs.free > 0.0
        )

    def place(self, frames: NodalFrames | None) -> None:
        """Set the frames of a solve; None if no wall is near. Collective."""
        pairs = self.pairs
        if not pairs.coupled.any_walled:
            return
        owned = pairs.mesh.n_owned
        data = np.zeros((owned, 13))
        data[:, [0, 4, 8]] = 1.0
        if frames is not None:
            at = frames.nodes
            data[at, :9] = frames.inverse.reshape(-1, 9)
            data[at, 9] = 1.0
            data[at, 10:] = np.isfinite(frames.lower) | np.isfinite(frames.upper)
        ends = pairs.gather(data)
        room = (pairs.free > 0.0) & (ends[:, :, 10:] == 0.0)
        self._place(ends[:, :, :9].reshape(*pairs.mine.shape, 3, 3), ends[:, :, 9] > 0.0, room)

    def _place(self, inverse: np.ndarray, framed: np.ndarray, room: np.ndarray) -> None:
        """Choose the nodes and coordinates that carry the bounds.

        ``inverse`` (2, p, 3, 3), ``framed`` (2, p) bool: of the ends' frames; ``room`` (2, p, 3) bool: available
        coordinates.
        """
        pairs = self.pairs
        direction = np.array([-1.0, 1.0])[:, None, None] * pairs.normals
        free = pairs.free > 0.0
        part = np.where(free, np.einsum("epji,pj->epi", inverse, pairs.normals), 0.0)
        plain = np.linalg.norm(part, axis=2)
        best = np.where(framed, np.abs(np.where(room, part, 0.0)).max(axis=2), plain)
        fits = best > np.where(framed, _LEAST, _THIN)
        best = np.where(fits, best, 0.0)
        self._at = at = np.flatnonzero(fits.any(axis=0))
        self.deferred = np.setdiff1d(np.flatnonzero(self._usable), at)
        self._waits = self._anywhere(self.deferred >= 0)
        carrier = np.where(best[1] >= (1.0 - 1e-12) * best[0], 1, 0)[at]
        other, every = 1 - carrier, np.arange(len(at))
        alpha, beta = (
            np.where(free, np.einsum("epji,epj->epi", inverse, direction), 0.0)[e, at] for e in (carrier, other)
        )
        beta = -beta  # of the other end: d is the same for both
        slot = (
            np.abs(np.where(room[carrier, at], alpha, 0.0)).argmax(axis=1) if len(at) else np.zeros(0, dtype=np.int64)
        )
        along = alpha / np.maximum(np.linalg.norm(alpha, axis=1), 1e-300)[:, None]
        mirror = np.where(framed[carrier, at][:, None], 0.0, -along)
        mirror[every, slot] += ~framed[carrier, at]
        square = np.einsum("pi,pi->p", mirror, mirror)
        scale = np.divide(2.0, square, out=np.zeros_like(square), where=square > 0.0)
        turn = np.eye(3) - scale[:, None, None] * mirror[:, :, None] * mirror[:, None, :]
        # without a frame, the reflection makes the distance depend on one coordinate of the carrier only
        unframed = ~framed[carrier, at]
        lengths = np.linalg.norm(alpha, axis=1)
        alpha[unframed] = 0.0
        alpha[every[unframed], slot[unframed]] = lengths[unframed]
        self._length = np.abs(alpha[every, slot])
        sign = np.where(alpha[every, slot] < 0.0, -1.0, 1.0)
        own = -(sign / self._length)[:, None] * alpha
        own[every, slot] = sign
        share = (sign / self._length)[:, None] * beta
        self._carrying, self._sharing = _Ends(pairs, carrier, at), _Ends(pairs, other, at)
        here, there = self._carrying.mine, self._sharing.mine
        self.slave_nodes, self._other = self._carrying.nodes, self._sharing.nodes
        self._slots, self._turns, self._own = slot[here], turn[here], own[here]
        self._share, self._shared = share[here], share[there]

    def _of_others(self, w: np.ndarray) -> np.ndarray:
        """Return r_o . w_o of the pairs that this rank carries. Collective."""
        shares = self._sharing.known(np.einsum("pi,pi->p", self._shared, w[self._other]))
        return shares[self._carrying.mine]

    def increment(self, w: np.ndarray) -> None:
        """Transform w (owned, 3) to frame coordinates, or to u where there are no frames, in place. Collective."""
        y = w[self.slave_nodes]
        y[np.arange(len(y)), self._slots] = np.einsum("pi,pi->p", self._own, y) + self._of_others(w)
        w[self.slave_nodes] = np.einsum("pij,pj->pi", self._turns, y)

    def coordinates(self, y: np.ndarray) -> None:
        """Transform the result of :meth:`increment` (owned, 3) back to w, in place. Collective."""
        w, every = np.einsum("pij,pj->pi", self._turns, y[self.slave_nodes]), np.arange(len(self.slave_nodes))
        sign = self._own[every, self._slots]
        rest = np.einsum("pi,pi->p", self._own, w) - sign * w[every, self._slots] + self._of_others(y)
        w[every, self._slots] = sign * (w[every, self._slots] - rest)
        y[self.slave_nodes] = w

    def gradient(self, g: np.ndarray) -> None:
        """Transform a gradient (owned, 3) with respect to y to that with respect to w, in place. Collective."""
        y, every = np.einsum("pij,pj->pi", self._turns, g[self.slave_nodes]), np.arange(len(self.slave_nodes))
        pull = y[every, self._slots].copy()
        y[every, self._slots] = 0.0
        g[self.slave_nodes] = y + pull[:, None] * self._own
        g[self._other] += self._carrying.known(pull)[self._sharing.mine, None] * self._shared

    def diagonal(self, blocks: np.ndarray, diagonal: np.ndarray) -> None:
        """Replace the diagonal (owned, 3) of H at pairs by that of T^T H T; bars between the ends are neglected.

        ``blocks`` (carriers, 3, 3): the diagonal blocks of H there. Collective.
        """
        every = np.arange(len(self.slave_nodes))
        turned = np.einsum("pji,pjk,pkl->pil", self._turns, blocks, self._turns)
        stiff = turned[every, self._slots, self._slots].copy()
        own = np.tile(np.eye(3), (len(every), 1, 1))
        own[every, self._slots] = self._own
        diagonal[self.slave_nodes] = np.einsum("pji,pjk,pki->pi", own, turned, own)
        diagonal[self._other] += self._carrying.known(stiff)[self._sharing.mine, None] * self._shared**2

    def matrix(self) -> PETSc.Mat:
        """Return T of :meth:`increment`, preallocated for any carriers; the caller destroys it. Collective."""
        mesh, pairs = self.pairs.mesh, self.pairs
        first, total = 3 * mesh.first_node, 3 * mesh.n_nodes
        numbers = pairs.gather(np.arange(mesh.first_node, mesh.first_node + mesh.n_owned)[:, None].astype(float))
        numbers = numbers[:, :, 0].astype(np.int64)
        ends = pairs.local[pairs.mine]
        partners = numbers[::-1][pairs.mine]
        both = np.sort(np.stack([mesh.first_node + ends, partners], axis=1), axis=1)
        count = np.ones(3 * mesh.n_owned, dtype=np.int64)
        rows = (3 * ends[:, None] + np.arange(3)).ravel()
        count[rows] = 6
        pointers = np.append(0, np.cumsum(count)).astype(PETSc.IntType)
        columns = np.zeros(pointers[-1], dtype=PETSc.IntType)
        plain = np.setdiff1d(np.arange(3 * mesh.n_owned), rows)
        columns[pointers[plain]] = first + plain
        wide = (3 * both[:, :, None] + np.arange(3)).reshape(-1, 6)
        columns[pointers[rows][:, None] + np.arange(6)] = np.repeat(wide, 3, axis=0)
        self._pattern = pointers, columns
        matrix = PETSc.Mat().create(comm=mesh.comm)
        matrix.setSizes(((3 * mesh.n_owned, total), (3 * mesh.n_owned, total)), bsize=3)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setPreallocationCSR((pointers, columns))
        self._numbers = numbers
        self.refresh(matrix)
        return matrix

    def refresh(self, matrix: PETSc.Mat) -> None:
        """Update T for the current frames. Collective."""
        pairs, mesh = self.pairs, self.pairs.mesh
        pointers, columns = self._pattern
        local = columns - 3 * mesh.first_node
        values = np.zeros(len(columns))
        # rows of nodes that carry no bound are those of the identity
        values[local == np.repeat(np.arange(3 * mesh.n_owned), np.diff(pointers))] = 1.0
        place = pointers[3 * self.slave_nodes[:, None] + np.arange(3)][:, :, None] + np.arange(6)
        every = np.arange(len(self.slave_nodes))
        own = np.tile(np.eye(3), (len(every), 1, 1))
        own[every, self._slots] = self._own
        own = self._turns @ own
        share = self._turns[every, :, self._slots][:, :, None] * self._share[:, None, :]
        partner = np.zeros(mesh.n_owned, dtype=np.int64)
        partner[pairs.local[pairs.mine]] = self._numbers[::-1][pairs.mine]
        low = (mesh.first_node + self.slave_nodes < partner[self.slave_nodes])[:, None, None]
        values[place] = np.where(low, np.concatenate([own, share], axis=2), np.concatenate([share, own], axis=2))
        matrix.setValuesCSR(pointers, columns, values)
        matrix.assemble()

    def reached(self, x: np.ndarray, move: np.ndarray, contact: np.ndarray, slack: float) -> bool:
        """Return whether pairs can close in a step in which nodes at ``x`` (owned, 3) move by ``move``. Collective.

        Pairs that were in contact before count as well.
        """
        data = self.pairs.gather(np.concatenate([x + move, move, contact], axis=1))
        reach = 0.5 * np.linalg.norm(data[:, :, 3:6], axis=2).sum(axis=0) + slack
        near = self.pairs.distances(data[:, :, :3]) - self.pairs.gaps < reach
        return self._anywhere((near | data[0, :, 6:].any(axis=1))[self._usable])

    def broken(self, x: np.ndarray, tolerance: float) -> bool:
        """Return whether positions (owned, 3) violate a pair by more than a tolerance [m]. Collective."""
        short = self.pairs.gaps - self.pairs.distances(self.pairs.gather(x))
        return self._anywhere(short[self._usable] > tolerance)

    def _anywhere(self, which: np.ndarray) -> bool:
        return bool(self.pairs.mesh.comm.allreduce(bool(which.any()), op=MPI.LOR))

    def blocked(self, x: np.ndarray, tolerance: float) -> tuple[int, int, str] | None:
        """Return the first pair without a coordinate that positions (owned, 3) violate by more than a tolerance, as its
        nodes and table, or None; the same on all ranks. Collective."""
        if not self._waits:
            return None
        pairs = self.pairs
        short = pairs.gaps - pairs.distances(pairs.gather(x))
        found = self.deferred[short[self.deferred] > tolerance][:1]
        mine = [(int(pairs.table[pair]), *pairs.numbers(pair)) for pair in found]
        every = [pair for some in pairs.mesh.comm.allgather(mine) for pair in some]
        if not every:
            return None
        table, second, first = min(every)
        return first, second, pairs.names[table]

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        """Write the bounds on w into (owned, 3), from positions (owned, 3) and their w. Collective."""
        room = (self.pairs.gaps - self.pairs.distances(self.pairs.gather(x)))[self._at] / self._length
        lower[self.slave_nodes, self._slots] = w[self.slave_nodes, self._slots] + room[self._carrying.mine]

    def press(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        """Set the pairs' forces. Collective.

        Parameters
        ----------
        w, g : (owned, 3) solution in these coordinates [m], and the residual in the coordinates of the increment [N]
        lower : (owned, 3) bounds on w [m]
        noise : residual that counts as zero [N]
        """
        at, slot = self.slave_nodes, self._slots
        every = np.arange(len(at))
        turned = np.einsum("pij,pj->pi", self._turns, g[at])
        pull = self._own[every, slot] * turned[every, slot]
        pressed = (w[at, slot] <= lower[at, slot]) & (pull > noise)
        strength = self._carrying.known(np.where(pressed, pull, 0.0)) / self._length
        self.pairs.release()
        self.pairs.force[self._at] = strength


def check_scheme(pairs: ContactPairs, on_its_own: bool, treatment: str) -> None:
    """Refuse schemes, treatments of impact and walls that are not compatible with the pairs of a case. Collective.

    Parameters
    ----------
    pairs : ContactPairs
    on_its_own : bool
        Whether nodes are solved independently, by an explicit scheme with lumped mass.
    treatment : str
        Treatment of impact, ``contact.treatment`` of the case.

    Raises
    ------
    InputError
        On all ranks.
    """
    key, coupled = f"{pairs.source}: contact_pair", pairs.coupled
    if coupled.shared_node is not None and not on_its_own:
        raise InputError(
            f"{key}: node {coupled.shared_node} is in several pairs, which needs an explicit "
            "integrator with lumped mass"
        )
    if coupled.any and treatment != "scheme":
        raise InputError(
            f"{key}: node {coupled.coupled_node} is in several pairs, or a wall stops it as well, which needs "
            'contact.treatment = "scheme"'
        )
    walls = coupled.contact
    met = walls.members[pairs.local[pairs.mine]].any(axis=0).astype(np.int64)
    pairs.mesh.comm.Allreduce(MPI.IN_PLACE, met)
    refused = walls.special & (met > 0)
    if refused.any():
        name = walls.names[int(np.argmax(refused))]
        raise InputError(
            f"{key}: wall {name!r} stops nodes of pairs: such a wall must be flat, without mass, friction and "
            "restitution, and not tied; or give it a node_set without them"
        )


def check_start(pairs: ContactPairs, x: np.ndarray, length: float, source: str) -> None:
    """Refuse pairs whose nodes start beyond each other by more than rounding of the model's size. Collective.

    Parameters
    ----------
    pairs : ContactPairs
    x : (owned, 3) positions at the start [m]
    length : size of the model [m]
    source : name of the case file, for messages

    Raises
    ------
    InputError
        On all ranks; names the two nodes and their overlap.
    """
    distance = pairs.distances(pairs.gather(x)) - pairs.gaps
    pair = int(np.argmin(distance)) if len(distance) else -1
    deepest = (np.inf,) if pair < 0 else (float(distance[pair]), int(pairs.table[pair]), *pairs.numbers(pair))
    deepest = min(pairs.mesh.comm.allgather(deepest))
    if deepest[0] < -ON_BOUND * length:
        distance, table, second, first = deepest
        raise InputError(
            f"{source}: contact_pair {pairs.names[table]!r}: nodes {first} and "
            f"{second} start {-distance:.6g} m beyond each other; reverse the direction, which "
            "points from the first to the second, or move the mesh"
        )


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
