"""The coordinates of an implicit solve, w = B u, make each row of contact a bound on one unknown: B is block diagonal,
with the frames of nodes at walls and the groups of rows that share nodes. A group eliminates one unknown for each row,
or, where there is friction, three: its relative coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..parallel.agreement import agreed
from ..tolerances import FREE_PART, PROJECTED
from .constraint_set import ConstraintSet
from .frames import NodalFrames, RelativeCoordinates, pivots
from .rows import Alike, FreeNodes

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

BlocksOf = Callable[[np.ndarray], np.ndarray]
"""Returns the diagonal blocks (k, 3, 3) of a Hessian at owned nodes (k,)."""

_TURN = 1e-10  # of a gradient that counts as none


class Blocks(NamedTuple):
    """Groups alike: coordinates w = B x of their nodes.

    Attributes
    ----------
    unknowns : (g, u) among those of all nodes of the rows
    basis, inverse : (g, u, u) B and its inverse
    """

    unknowns: np.ndarray
    basis: np.ndarray
    inverse: np.ndarray


class RowCoordinates:
    """Coordinates w of implicit steps in which each row is a lower bound on one unknown: w = B x in each group.

    The rows of B are those of the frames of nodes at walls, at carriers times the weights of the rows that rub, and
    others those of contact, by elimination. Prescribed components move no others: bounds account for their motion.

    Parameters
    ----------
    constraints : ConstraintSet

    Attributes
    ----------
    varies : whether B changes from solve to solve
    relative : coordinates of rows in groups with friction, whose bounds are those of frames; None without any
    """

    def __init__(self, constraints: ConstraintSet) -> None:
        self.constraints, self.rows = constraints, constraints.rows
        self.comm = self.rows.mesh.comm
        n = len(self.rows.numbers)
        relative = RelativeCoordinates(self.rows, constraints.relative_groups(), len(constraints.names))
        self.relative = relative if relative.anywhere else None
        self._eliminated = ~relative.groups
        self.varies = constraints.walled or relative.anywhere or self._any(not self.rows.fixed.all())
        self._start, self._part = np.empty((n, 3)), 1.0
        points = self.rows.gather(self.rows.mesh.points[: self.rows.mesh.n_owned])
        self._place(self.rows.gradients(points), np.tile(np.eye(3), (n, 1, 1)), np.ones((n, 3), dtype=bool))

    def _any(self, flag: bool) -> bool:
        """Whether a flag is set on any rank. Collective."""
        return bool(self.comm.allreduce(bool(flag), op=MPI.LOR))

    def reached(self, state: State, move: np.ndarray, slack: float) -> bool:
        """Return whether rows may close in a step in which nodes move by (owned, 3) [m]. Collective."""
        rows = self.rows
        data = rows.gather(np.concatenate([state.position + move, move], axis=1))
        way = np.append(np.linalg.norm(data[:, 3:], axis=1), 0.0)  # the last one: of no node
        reach = 0.5 * way[rows.ends].sum(axis=1) + slack
        return self._any(((rows.values(data[:, :3]) < reach) | (self.constraints.force > 0.0)).any())

    def place(self, frames: NodalFrames | None, balance: Balance, state: State, x: np.ndarray) -> None:
        """Set the frames of a solve, None if there are none, and the guess of positions (owned, 3). Collective."""
        if not self.varies:
            return
        rows, owned = self.rows, self.rows.mesh.n_owned
        data = np.zeros((owned, 12))
        data[:, [0, 4, 8]] = 1.0
        if frames is not None:
            data[frames.nodes, :9] = frames.basis.reshape(-1, 9)
            data[frames.nodes, 9:] = np.isfinite(frames.lower) | np.isfinite(frames.upper)
        data = rows.gather(data)
        self._part = balance.acting
        self._start = rows.gather(state.position) if self._part < 1.0 else self._start
        self._place(rows.gradients(self._acting(rows.gather(x))), data[:, :9].reshape(-1, 3, 3), data[:, 9:] == 0.0)

    def _acting(self, x: np.ndarray) -> np.ndarray:
        """Places (n, 3) where the forces of the balance act, for nodes that move to (n, 3)."""
        return x if self._part == 1.0 else self._start + self._part * (x - self._start)

    def _place(self, jacobian: np.ndarray, basis: np.ndarray, room: np.ndarray) -> None:
        """Compute B. ``jacobian`` (r, k, 3) by x; of the nodes: ``basis`` (n, 3, 3) of their frames, and ``room``
        (n, 3) bool: coordinates that no wall bounds."""
        rows, self.jacobian = self.rows, jacobian
        self._pivot = np.full(len(rows.source), -1)  # unknown of each row among those of all nodes
        self._scale = np.ones(len(rows.source))  # J = scale B
        self._blocks = [self._block(groups, basis, room) for groups in rows.alike]
        placed = self._pivot >= 0
        self._placed = np.flatnonzero(placed)
        if self.relative is not None:
            placed |= self.relative.carrier >= 0
        self._deferred = np.flatnonzero(~placed & rows.usable(jacobian))
        # pivots of this rank's nodes: local node, component, row
        local = rows.where[self._pivot[self._placed] // 3]
        here = local >= 0
        self._here = local[here], self._pivot[self._placed][here] % 3, self._placed[here]

    def _block(self, groups: Alike, basis: np.ndarray, room: np.ndarray) -> Blocks:
        """Compute B of groups alike, and choose the pivots of those that are eliminated."""
        rows, (g, q) = self.rows, groups.nodes.shape
        unknowns = (3 * groups.nodes[:, :, None] + np.arange(3)).reshape(g, -1)
        free, own = rows.free[groups.nodes] > 0.0, basis[groups.nodes]
        gradients = groups.dense(self.jacobian[groups.rows])
        turned = np.einsum("gpni,gnij->gpnj", gradients, np.linalg.inv(own)) * free[:, None]
        largest = np.maximum(np.abs(turned).max(axis=(2, 3), keepdims=True), np.sqrt(FREE_PART))
        may = room[groups.nodes] & free & self._eliminated[rows.group_of_row[groups.rows[:, :1]]][:, :, None]
        row, column, count, turns = pivots(np.where(may[:, None], turned, 0.0) / largest)
        weights = np.eye(q)[None] if self.relative is None else self.relative.weights(groups)
        matrix = np.einsum("gab,gaij->gaibj", weights, turns.swapaxes(2, 3) @ own).reshape(g, 3 * q, 3 * q)
        at, k = np.nonzero(np.arange(row.shape[1]) < count[:, None])
        row, column = row[at, k], column[at, k]
        matrix[at, column] = gradients.reshape(*gradients.shape[:2], -1)[at, row]
        group, held = np.nonzero(~free.reshape(g, -1))
        matrix[group, held] = matrix[group, :, held] = 0.0
        matrix[group, held, held] = 1.0
        scale, chosen = np.linalg.norm(matrix[at, column], axis=1), groups.rows[at, row]
        matrix[at, column] /= scale[:, None]
        self._scale[chosen], self._pivot[chosen] = scale, unknowns[at, column]
        return Blocks(unknowns, matrix, np.linalg.inv(matrix))

    def feasible(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> None:
        """Change increments (owned, 3), in place, so that the rows are satisfied. Collective."""
        rows, here = self.rows, self.rows.here
        k, x = rows.gather(stiffness), rows.gather(predictor + u)
        tolerance = PROJECTED * self.constraints.contact.size
        nodes = FreeNodes(x, k, self._start, self._part == 0.0, rows.free, rub=False)
        with agreed(self.comm):
            pushes, jacobian = rows.project(nodes, tolerance)
        u[here] += (rows.forces(jacobian, pushes.normal) * rows.free / k[:, None])[rows.mine]

    def _all(self, array: np.ndarray) -> np.ndarray:
        """Return the unknowns (3 n,) of all nodes from an array whose first rows are owned nodes. Collective."""
        return self.rows.gather(array[: self.rows.mesh.n_owned]).ravel()

    def _multiply(self, array: np.ndarray, of: Callable[[Blocks], np.ndarray]) -> None:
        """Multiply an array (owned, 3), in place, by the matrices ``of`` blocks (g, u, u). Collective."""
        every = self._all(array)
        for block in self._blocks:
            every[block.unknowns] = np.einsum("guv,gv->gu", of(block), every[block.unknowns])
        array[self.rows.here] = every.reshape(-1, 3)[self.rows.mine]

    def forward(self, w: np.ndarray) -> None:
        """Transform w to x (owned, 3), in place. Collective."""
        self._multiply(w, lambda block: block.inverse)

    def inverse(self, x: np.ndarray) -> None:
        """Transform x to w (owned, 3), in place. Collective."""
        self._multiply(x, lambda block: block.basis)

    def adjoint(self, g: np.ndarray) -> None:
        """Transform a gradient with respect to x to that with respect to w (owned, 3), in place. Collective."""
        self._multiply(g, lambda block: block.inverse.swapaxes(1, 2))

    def blocks(self, blocks: BlocksOf) -> np.ndarray:
        """Return the diagonal blocks (m, 3, 3) of B^-T H B^-1 at the owned nodes of rows, from the diagonal ``blocks``
        of H. Collective."""
        rows = self.rows
        full = np.zeros((rows.mesh.n_owned, 3, 3))
        full[rows.here] = blocks(rows.here)
        full = rows.gather(full)
        every = full.copy()
        for unknowns, _, inverse in self._blocks:
            nodes = unknowns[:, ::3] // 3
            parts = inverse.reshape(*nodes.shape, 3, nodes.shape[1], 3)
            every[nodes] = np.einsum("gniaj,gniak->gajk", parts, np.einsum("gnil,gnlak->gniak", full[nodes], parts))
        return every[rows.mine]

    def matrix(self) -> PETSc.Mat:
        """Return B^-1, preallocated for all states; the caller destroys it. Collective."""
        rows, mesh = self.rows, self.rows.mesh
        numbers = rows.gather(np.arange(mesh.first_node, mesh.first_node + mesh.n_owned)).astype(np.int64)
        # of the unknowns: rows of this rank, negative elsewhere, and columns
        self._local, self._wide = ((3 * at[:, None] + np.arange(3)).ravel() for at in (rows.where, numbers))
        matrix = PETSc.Mat().create(comm=mesh.comm)
        size = 3 * mesh.n_owned, 3 * mesh.n_nodes
        matrix.setSizes((size, size), bsize=3)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setPreallocationCSR(self._own_rows())
        return matrix

    def _own_rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pointers, columns and values of the rows of B^-1 of all owned nodes, the identity for those without.
        There are entries for all pairs of unknowns of a group, so that the pattern never changes."""
        from scipy.sparse import csr_matrix

        mesh = self.rows.mesh
        others = np.setdiff1d(np.arange(3 * mesh.n_owned), self._local)
        entries = [np.stack([others, 3 * mesh.first_node + others, np.ones(len(others))])]
        for unknowns, _, inverse in self._blocks:
            group, own = np.nonzero(self._local[unknowns] >= 0)
            row, column = self._local[unknowns][group, own, None], self._wide[unknowns][group]
            values = inverse[group, own]
            entries.append(np.stack([np.broadcast_to(row, values.shape).ravel(), column.ravel(), values.ravel()]))
        row, column, values = np.concatenate(entries, axis=1)
        shape = 3 * mesh.n_owned, 3 * mesh.n_nodes
        own = csr_matrix((values, (row.astype(np.int64), column.astype(np.int64))), shape)
        return own.indptr.astype(PETSc.IntType), own.indices.astype(PETSc.IntType), own.data

    def refresh(self, matrix: PETSc.Mat) -> None:
        """Update B^-1. Collective."""
        matrix.setValuesCSR(*self._own_rows())
        matrix.assemble()

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        """Write bounds on w into (owned, 3), from positions (owned, 3) and their w. Collective."""
        values = self.rows.values(self.rows.gather(x)) / self._scale
        node, component, row = self._here
        lower[node, component] = w[node, component] - values[row]

    def solve_forces(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        """Set the forces of eliminated rows from w, the residual with respect to it, and the bounds (owned, 3).
        Collective.

        Forces up to ``noise`` [N] count as zero.
        """
        node, component, row = self._here
        force, own = g[node, component] / self._scale[row], np.zeros(w.shape)
        own[node, component] = np.where((w[node, component] <= lower[node, component]) & (force > noise), force, 0.0)
        self.constraints.release()
        self.constraints.gradients = self.jacobian
        self.constraints.force[self._placed] = self._all(own)[self._pivot[self._placed]]

    def set_forces(self, nodes: np.ndarray, normal: np.ndarray, drag: np.ndarray) -> None:
        """Set the forces of rows with relative coordinates from those of nodes (m,) in the slots of tables, (m, t) and
        (m, t, 3) [N]. Collective."""
        own, some = np.zeros((self.rows.mesh.n_owned, normal.shape[1], 4)), np.flatnonzero(self.relative.carrier >= 0)
        own[nodes, :, 0], own[nodes, :, 1:] = normal, drag
        found = self.rows.gather(own)[self.relative.carrier[some], self.rows.source[some]]
        self.constraints.force[some], self.constraints.drag[some] = found[:, 0], found[:, 1:]

    def satisfied(self, x: np.ndarray, slack: float) -> bool:
        """Return whether positions (owned, 3) satisfy the rows that were bounds, to ``slack`` [m]. Collective.

        Raises
        ------
        NotConverged
            On all ranks, if a row without an unknown is violated.
        """
        rows, every = self.rows, self.rows.gather(x)
        values, pressed = rows.values(every), self.constraints.force > 0.0
        blocked = self._deferred[values[self._deferred] < -slack]
        with agreed(self.comm):
            if len(blocked):
                ends = rows.ends[blocked[0]]
                nodes = ", ".join(map(str, rows.numbers[ends[ends >= 0]]))
                table, _, name = self.constraints.columns[rows.source[blocked[0]]].partition("/")
                if not self._eliminated[rows.group_of_row[blocked[0]]]:
                    raise NotConverged(
                        f"none of the nodes {nodes} of {table} {name!r} can move freely relative to the others, as "
                        "implicit steps need it beside friction and beside walls that are curved, turn, tie or have "
                        "mass: walls stop each of them, supports prescribe different components of them, or pairs "
                        "connect them in a ring; name the nodes that walls stop with 'node_set', or use an explicit "
                        "integrator"
                    )
                raise NotConverged(
                    f"walls and other constraints bound all directions in which nodes {nodes} can satisfy {table} "
                    f"{name!r}; use an explicit integrator"
                )
        lost = (values[self._placed] < -slack).any() or (np.abs(values[pressed]) > slack).any()
        if self._part > 0.0:
            turn = np.abs(rows.gradients(self._acting(every)) - self.jacobian).max(axis=(1, 2), initial=0.0)
            lost = lost or (turn[pressed] > _TURN).any()
        return not self._any(lost)

    def broken(self, x: np.ndarray, slack: float) -> bool:
        """Return whether positions (owned, 3) violate any row by more than ``slack`` [m]. Collective."""
        return self._any((self.rows.values(self.rows.gather(x))[self.rows.usable(self.jacobian)] < -slack).any())


class Transform:
    """Coordinates w = B u of a solve: B of the frames of nodes at walls, and of groups of rows. Its residual is
    M B^-T g, with the maps M of friction. Construction is collective.

    Parameters
    ----------
    mesh : DistributedMesh
    frames : of nodes near walls and of carriers of rows; None if no rank has any
    rows : coordinates of the rows over several nodes that may close in the step

    Attributes
    ----------
    rows : these
    frames : of owned nodes whose coordinates are not those of x
    sliding : friction forces on slipping nodes; has no nodes without friction
    relative : relative coordinates of rows; None if there are none
    identity : whether w equals u and the residual is unchanged
    bounded : whether the solve has bounds
    slides : whether any node slips
    """

    def __init__(
        self, mesh: DistributedMesh, frames: NodalFrames | None = None, rows: RowCoordinates | None = None
    ) -> None:
        self.mesh, self.rows = mesh, rows
        self.relative = None if rows is None else rows.relative
        walls = 0 if frames is None else frames.rows.shape[1]
        own = frames is not None and (frames.oblique or len(frames.sliding.nodes) > 0)
        self._oblique = frames is not None and mesh.comm.allreduce(int(own)) > 0
        self.bounded = frames is not None or rows is not None
        self.identity = not self._oblique and rows is None
        # frames along the axes change no coordinates
        self.frames = frames if self._oblique else NodalFrames(np.empty(0, dtype=np.int64), walls)
        self.sliding = self.frames.sliding
        self.slides = self._oblique and mesh.comm.allreduce(int(len(self.sliding.nodes) > 0)) > 0
        # frames of nodes without rows; those of others are part of the blocks of rows
        self._alone = np.flatnonzero(~np.isin(self.frames.nodes, [] if rows is None else rows.rows.here))
        self._nodes = self.frames.nodes[self._alone]
        self._basis, self._back = self.frames.basis[self._alone], self.frames.inverse[self._alone]

    @property
    def nodewise(self) -> bool:
        """Whether w differs from u by frames of nodes only, and the Hessian is symmetric."""
        return self.rows is None and not self.slides

    def forward(self, w: np.ndarray) -> None:
        """Transform w (owned, 3) to u, in place. Collective."""
        if self.rows is not None:
            self.rows.forward(w)
        w[self._nodes] = np.einsum("nij,nj->ni", self._back, w[self._nodes])

    def inverse(self, u: np.ndarray) -> None:
        """Transform u (owned, 3) to w, in place. Collective."""
        if self.rows is not None:
            self.rows.inverse(u)
        u[self._nodes] = np.einsum("nij,nj->ni", self._basis, u[self._nodes])

    def adjoint(self, g: np.ndarray) -> None:
        """Transform a gradient (owned, 3) with respect to u to that with respect to w, in place. Collective."""
        if self.rows is not None:
            self.rows.adjoint(g)
        g[self._nodes] = np.einsum("nji,nj->ni", self._back, g[self._nodes])

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Return the positions (owned, 3) of nodes, relative ones of carriers, at x (owned, 3) [m]. Collective."""
        return x if self.relative is None else self.relative.positions(x)

    def residual(self, predictor: np.ndarray, u: np.ndarray, g: np.ndarray) -> None:
        """Transform the residual force (owned, 3) at predictor + u to the residual of w, in place. Collective."""
        self.adjoint(g)
        if self.slides:
            slipping = self.sliding.nodes
            g[slipping] = self.sliding.couple(self.positions(predictor + u)[slipping], g[slipping])

    def left(self) -> np.ndarray:
        """Maps M (s, 3, 3) of slipping nodes at the last evaluation of the residual."""
        return self.sliding.maps.copy()

    def linear(self, left: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Transform H u (local, 3), in place, to the derivative of the residual along u (local, 3). Collective.

        ``left`` : value of :meth:`left` where H was evaluated.
        """
        self.adjoint(out)
        if self.slides:
            sliding, y = self.sliding, self.positions(u[: self.mesh.n_owned])[self.sliding.nodes]
            out[sliding.nodes] += np.einsum("nji,njk,nk->ni", sliding.inverse, sliding.stiffness, y)
            out[sliding.nodes] = np.einsum("nij,nj->ni", left, out[sliding.nodes])

    def diagonal(self, left: np.ndarray, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        """Replace the diagonal (owned, 3) of H by that of the derivative of the residual. Collective."""
        nodes, full = self._nodes, np.zeros((len(diagonal), 3, 3))
        full[nodes] = self._back.transpose(0, 2, 1) @ blocks(nodes) @ self._back
        if self.rows is not None:
            full[self.rows.rows.here] = self.rows.blocks(blocks)
            nodes = np.union1d(nodes, self.rows.rows.here)
        at = self.sliding.nodes
        full[at] = left @ (full[at] + self.slip_blocks())
        diagonal[nodes] = np.einsum("nii->ni", full[nodes])

    def slip_blocks(self) -> np.ndarray:
        """Return what the turning of slips adds to the diagonal blocks (s, 3, 3) of slipping nodes, before M."""
        sliding = self.sliding
        return np.einsum("nji,njk,nkl->nil", sliding.inverse, sliding.stiffness, sliding.inverse)

    def turns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Matrices that transform the blocks of a Hessian to coordinates of the frames of nodes without rows: place of
        each node (local,) among these, -1 for none; those on the left (m, 3, 3), with M where no rows rub; and inverses
        (turned, 3, 3) of these and of ghosts. None if no node has a frame. Collective at first use."""
        if not self._oblique:
            return None
        left = self.frames.inverse.transpose(0, 2, 1).copy()
        if self.relative is None:
            left[self.sliding.at] = self.sliding.maps @ left[self.sliding.at]
        place, inverse = self._shared
        return place, left[self._alone], inverse

    @cached_property
    def _shared(self) -> tuple[np.ndarray, np.ndarray]:
        return self.mesh.with_ghosts(self._nodes, self._back)
