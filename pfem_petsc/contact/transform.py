"""The transform of an implicit solve, u = T w, makes each row of contact a bound on one unknown: by frames of nodes at
walls, then within the groups of rows that share nodes, by elimination or, where there is friction, by frames of
relative coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import NotConverged
from ..integrators.base import Balance, State
from ..parallel.agreement import agreed
from ..tolerances import FREE_PART, PROJECTED
from .constraint_set import ConstraintSet
from .frames import NodalFrames
from .relative import RelativeCoordinates
from .rows import FreeNodes

if TYPE_CHECKING:
    from ..mesh.distribution import DistributedMesh

BlocksOf = Callable[[np.ndarray], np.ndarray]
"""Returns the diagonal blocks (k, 3, 3) of a Hessian at owned nodes (k,)."""

_LEAST = 0.05  # of a pivot below which a row is deferred
_TURN = 1e-10  # of a gradient that counts as none


class RowCoordinates:
    """Coordinates w of implicit steps in which each row is a lower bound on one unknown: y = T w, y (owned, 3), with y
    those of the frames of walls.

    Parameters
    ----------
    constraints : ConstraintSet

    Attributes
    ----------
    varies : whether T changes from solve to solve
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
        from scipy.sparse import csr_matrix

        rows = self.rows
        self.jacobian = jacobian
        some = (rows.ends >= 0)[:, :, None]
        turned = np.einsum("rkji,rkj->rki", inverse[rows.ends], jacobian)
        self._turned = np.where(some, turned * rows.free[rows.ends], 0.0)
        n = 3 * len(rows.numbers)
        self._pivot = np.full(len(rows.source), -1)  # unknown of each row among those of all nodes
        self._scale = np.ones(len(rows.source))
        room = (room & (rows.free > 0.0)).ravel()
        self._turns = np.tile(np.eye(3), (len(rows.numbers), 1, 1))  # of the nodes: y = R z
        self._blocks: list[tuple[np.ndarray, np.ndarray]] = []  # of groups alike: unknowns (g, u), T (g, u, u)
        self._solved: list[tuple[np.ndarray, np.ndarray]] = []  # rows (g, p) with pivots, and J_P^-1 (g, p, p)
        for groups in rows.alike_of(self._eliminated):
            unknowns = (3 * groups.nodes[:, :, None] + np.arange(3)).reshape(len(groups.nodes), -1)
            dense = groups.dense(self._turned[groups.rows])
            largest = np.maximum(np.abs(dense).max(axis=2, keepdims=True), np.sqrt(FREE_PART))
            row, column, count, turns = _pivots(np.where(room[unknowns][:, None, :], dense, 0.0) / largest)
            self._turns[groups.nodes] = turns
            dense = _turned(dense, turns)
            for k in np.unique(count):
                part = np.flatnonzero(count == k)
                self._transform(groups.rows[part], unknowns[part], dense[part], row[part, :k], column[part, :k])
        self._placed, placed = np.flatnonzero(self._pivot >= 0), self._pivot >= 0
        self._backward: list[tuple[np.ndarray, np.ndarray]] = []  # of relative groups: unknowns (g, u), T^-1 (g, u, u)
        if self.relative is not None:
            placed |= self.relative.carrier >= 0
            blocks = self.relative.transforms(inverse)
            self._blocks += blocks
            self._backward = [(unknowns, np.linalg.inv(transform)) for unknowns, transform in blocks]
        self._deferred = np.flatnonzero(~placed & rows.usable(jacobian))
        # T has entries for all pairs of unknowns of a group, so that its pattern never changes
        entries = [np.empty((3, 0))]
        for unknowns, transform in self._blocks:
            row, column = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
            entries.append(np.stack([row.ravel(), column.ravel(), transform.ravel()]))
        row, column, values = np.concatenate(entries, axis=1)
        self._matrix = csr_matrix((values, (row.astype(np.int64), column.astype(np.int64))), (n, n))
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
        turns = self._turns[unknowns[:, ::3] // 3]
        parts = transform.reshape(len(rows), -1, 3, unknowns.shape[1])
        transform = np.einsum("gnij,gnjk->gnik", turns, parts).reshape(transform.shape)
        self._blocks.append((unknowns, transform))
        self._solved.append((rows[every, row], solved))
        self._pivot[rows[every, row]] = unknowns[every, column]
        self._scale[rows[every, row]] = scale

    def _unturned(self, y: np.ndarray) -> np.ndarray:
        """Return z = R^T y (3 n,)."""
        return np.einsum("nji,nj->ni", self._turns, y.reshape(-1, 3)).ravel()

    def _all(self, array: np.ndarray) -> np.ndarray:
        """Return the unknowns (3 n,) of all nodes from an array whose first rows are owned nodes. Collective."""
        return self.rows.gather(array[: self.rows.mesh.n_owned]).ravel()

    def feasible(self, predictor: np.ndarray, u: np.ndarray, stiffness: np.ndarray) -> None:
        """Change increments (owned, 3), in place, so that the rows are satisfied. Collective."""
        rows, here = self.rows, self.rows.here
        k, x = rows.gather(stiffness), rows.gather(predictor + u)
        tolerance = PROJECTED * self.constraints.contact.size
        nodes = FreeNodes(x, k, self._start, self._part == 0.0, rows.free, rub=False)
        with agreed(self.comm):
            pushes, jacobian, _ = rows.project(nodes, tolerance)
        u[here] += (rows.forces(jacobian, pushes.force) * rows.free / k[:, None])[rows.mine]

    def forward(self, w: np.ndarray) -> None:
        """Transform w to y (owned, 3), in place. Collective."""
        self._write(w, self._matrix @ self._all(w))

    def _write(self, array: np.ndarray, every: np.ndarray) -> None:
        array[self.rows.here] = every.reshape(-1, 3)[self.rows.mine]

    def inverse(self, y: np.ndarray) -> None:
        """Transform y to w (owned, 3), in place. Collective."""
        rows, every = self.rows, self._all(y)
        along = rows.along(self._turned, every.reshape(-1, 3)) / self._scale
        every = self._unturned(every)
        every[self._pivot[self._placed]] = along[self._placed]
        for unknowns, transform in self._backward:
            every[unknowns] = np.einsum("guv,gv->gu", transform, every[unknowns])
        self._write(y, every)

    def adjoint(self, g: np.ndarray) -> None:
        """Transform a gradient with respect to y to that with respect to w (owned, 3), in place. Collective."""
        self._write(g, self._matrix.T @ self._all(g))

    def blocks(self, blocks: BlocksOf) -> tuple[np.ndarray, np.ndarray]:
        """Return the owned nodes (m,) of rows and the diagonal blocks (m, 3, 3) of T^T H T there, from the diagonal
        ``blocks`` of H. Collective."""
        rows = self.rows
        full = np.zeros((rows.mesh.n_owned, 3, 3))
        full[rows.here] = blocks(rows.here)
        full = rows.gather(full)
        every = full.copy()
        for unknowns, transform in self._blocks:
            nodes = unknowns[:, ::3] // 3
            parts = transform.reshape(*nodes.shape, 3, nodes.shape[1], 3)
            every[nodes] = np.einsum("gniaj,gniak->gajk", parts, np.einsum("gnil,gnlak->gniak", full[nodes], parts))
        return rows.here, every[rows.mine]

    def matrix(self) -> PETSc.Mat:
        """Return T, preallocated for all states; the caller destroys it. Collective."""
        rows, mesh = self.rows, self.rows.mesh
        numbers = rows.gather(np.arange(mesh.first_node, mesh.first_node + mesh.n_owned)).astype(np.int64)
        self._local, self._wide = ((3 * at[:, None] + np.arange(3)).ravel() for at in (rows.here, numbers))
        matrix = PETSc.Mat().create(comm=mesh.comm)
        size = 3 * mesh.n_owned, 3 * mesh.n_nodes
        matrix.setSizes((size, size), bsize=3)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setPreallocationCSR(self._own_rows())
        return matrix

    def _own_rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pointers, columns and values of the rows of T of all owned nodes, the identity for those without."""
        from scipy.sparse import csr_matrix

        mesh = self.rows.mesh
        some = self._matrix[np.repeat(self.rows.mine, 3)].tocoo()
        others = np.setdiff1d(np.arange(3 * mesh.n_owned), self._local)
        row = np.append(self._local[some.row], others)
        column = np.append(self._wide[some.col], 3 * mesh.first_node + others)
        values = np.append(some.data, np.ones(len(others)))
        own = csr_matrix((values, (row, column)), (3 * mesh.n_owned, 3 * mesh.n_nodes))
        return own.indptr.astype(PETSc.IntType), own.indices.astype(PETSc.IntType), own.data

    def refresh(self, matrix: PETSc.Mat) -> None:
        """Update T. Collective."""
        matrix.setValuesCSR(*self._own_rows())
        matrix.assemble()

    def bound(self, x: np.ndarray, w: np.ndarray, lower: np.ndarray) -> None:
        """Write bounds on w into (owned, 3), from positions (owned, 3) and their w. Collective."""
        values = self.rows.values(self.rows.gather(x)) / self._scale
        node, component, row = self._here
        lower[node, component] = w[node, component] - values[row]

    def solve_forces(self, w: np.ndarray, g: np.ndarray, lower: np.ndarray, noise: float) -> None:
        """Set the forces from w, the residual with respect to y, and the bounds (owned, 3). Collective.

        Forces up to ``noise`` [N] count as zero.
        """
        every = self._unturned(self._all(g))
        node, component, row = self._here
        on = np.zeros(w.shape)
        on[node, component] = w[node, component] <= lower[node, component]
        on = self._all(on)
        self.constraints.release()
        self.constraints.jacobian = self.jacobian
        for rows, solved in self._solved:
            force = np.einsum("gji,gj->gi", solved, every[self._pivot[rows]])
            pressed = (on[self._pivot[rows]] > 0.0) & (force > noise)
            self.constraints.force[rows] = np.where(pressed, force, 0.0)

    def set_forces(self, nodes: np.ndarray, normal: np.ndarray, drag: np.ndarray) -> None:
        """Set the forces of rows with relative coordinates from those of nodes (m,) in the slots of tables, (m, t) and
        (m, t, 3) [N]. Collective."""
        constraints, relative = self.constraints, self.relative
        force, drags = relative.of_rows(normal, drag, nodes)
        some = relative.carrier >= 0
        constraints.force[some], constraints.drag[some] = force[some], drags[some]

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
        usable = self.rows.usable(self.jacobian)
        return self._any((self.rows.values(self.rows.gather(x))[usable] < -slack).any())


def _turned(matrices: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return matrices (g, p, 3 q) in the coordinates of the nodes' turns (g, q, 3, 3)."""
    parts = matrices.reshape(*matrices.shape[:2], -1, 3)
    return np.einsum("gpni,gnij->gpnj", parts, turns).reshape(matrices.shape)


def _pivots(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Choose the pivots of matrices (g, p, 3 q) by elimination, largest part of a row at a node first.

    The coordinates of that node are reflected such that the part has one component. Coordinates without entries are not
    changed. Returns rows and columns (g, p) of the pivots, how many (g,) there are, and the reflections (g, q, 3, 3).
    """
    g, p, q = len(matrices), matrices.shape[1], matrices.shape[2] // 3
    left, every = matrices.reshape(g, p, q, 3).copy(), np.arange(g)
    rows, columns = np.zeros((2, g, p), dtype=np.int64)
    count, going, turns = np.zeros(g, dtype=np.int64), np.ones(g, dtype=bool), np.tile(np.eye(3), (g, q, 1, 1))
    for k in range(p):
        size = np.sqrt(np.einsum("gpqi,gpqi->gpq", left, left))
        at, node = np.divmod(size.reshape(g, -1).argmax(axis=1), q)
        going &= size[every, at, node] > _LEAST
        if not going.any():
            break
        some = np.flatnonzero(going)
        at, node, each = at[some], node[some], np.arange(len(some))
        mirror = -left[some, at, node] / size[some, at, node][:, None]
        slot = np.abs(mirror).argmax(axis=1)
        mirror[each, slot] += 1.0
        square = np.einsum("mi,mi->m", mirror, mirror)
        factor = np.divide(2.0, square, out=np.zeros_like(square), where=square > 0.0)
        turn = np.eye(3) - factor[:, None, None] * mirror[:, :, None] * mirror[:, None, :]
        turns[some, node] = turns[some, node] @ turn
        left[some, :, node] = left[some, :, node] @ turn
        rows[some, k], columns[some, k] = at, 3 * node + slot
        count[some] += 1
        factors = left[some, :, node, slot] / left[some, at, node, slot][:, None]
        left[some] -= factors[:, :, None, None] * left[some, at][:, None]
        left[some, at] = 0.0
        left[some, :, node, slot] = 0.0
    return rows, columns, count, turns


class Transform:
    """Coordinates of a solve, u = F^-1 T w: F of the frames of nodes at walls, T of rows, with the frames of relative
    coordinates. Its residual is M T^T F^-T g, with the maps M of friction. Construction is collective.

    Parameters
    ----------
    mesh : DistributedMesh
    frames : of nodes near walls and of carriers of rows; None if no rank has any
    links : coordinates of the rows over several nodes that may close in the step: one or none

    Attributes
    ----------
    links : tuple of these
    frames : of owned nodes whose coordinates are not those of x
    sliding : friction forces on slipping nodes; has no nodes without friction
    relative : relative coordinates of rows; None if there are none
    identity : whether w equals u and the residual is unchanged
    bounded : whether the solve has bounds
    slides : whether any node slips
    """

    def __init__(
        self, mesh: DistributedMesh, frames: NodalFrames | None = None, links: Sequence[RowCoordinates] = ()
    ) -> None:
        self.mesh = mesh
        self.links = tuple(links)
        self.relative = next((link.relative for link in self.links), None)
        walls = 0 if frames is None else frames.rows.shape[1]
        own = frames is not None and (frames.oblique or len(frames.sliding.nodes) > 0)
        self._oblique = frames is not None and mesh.comm.allreduce(int(own)) > 0
        self.bounded = frames is not None or bool(self.links)
        self.identity = not self._oblique and not self.links
        # frames along the axes change no coordinates
        self.frames = frames if self._oblique else NodalFrames(np.empty(0, dtype=np.int64), walls)
        self.sliding = self.frames.sliding
        self.slides = self._oblique and mesh.comm.allreduce(int(len(self.sliding.nodes) > 0)) > 0
        carried = np.zeros(len(self.frames.nodes), dtype=bool)
        if self.relative is not None:
            carried = self.relative.carried(self.frames.nodes)
        self._direct = np.flatnonzero(~carried)  # frames of x
        self._nodes = self.frames.nodes[self._direct]
        self._basis, self._back = self.frames.basis[self._direct], self.frames.inverse[self._direct]
        if self._oblique:
            self._share_frames()

    @property
    def nodewise(self) -> bool:
        """Whether w differs from u by frames of nodes only, and the Hessian is symmetric."""
        return not self.links and not self.slides

    def _share_frames(self) -> None:
        mesh, nodes = self.mesh, self._nodes
        inverse = np.zeros((mesh.n_local, 10))
        inverse[nodes, 0] = 1.0
        inverse[nodes, 1:] = self._back.reshape(-1, 9)
        mesh.update_ghosts(inverse)
        turned = np.flatnonzero(inverse[:, 0] > 0.0)
        self._frame_of = np.full(mesh.n_local, -1, dtype=np.int32)
        self._frame_of[turned] = np.arange(len(turned), dtype=np.int32)
        self._inverse = np.ascontiguousarray(inverse[turned, 1:]).reshape(-1, 3, 3)

    def forward(self, w: np.ndarray) -> None:
        """Transform w (owned, 3) to u, in place. Collective."""
        if self.identity:
            return
        for link in reversed(self.links):
            link.forward(w)
        w[self._nodes] = np.einsum("nij,nj->ni", self._back, w[self._nodes])

    def inverse(self, u: np.ndarray) -> None:
        """Transform u (owned, 3) to w, in place. Collective."""
        if self.identity:
            return
        u[self._nodes] = np.einsum("nij,nj->ni", self._basis, u[self._nodes])
        for link in self.links:
            link.inverse(u)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Return the positions (owned, 3) of nodes, relative ones of carriers, at x (owned, 3) [m]. Collective."""
        return x if self.relative is None else self.relative.positions(x)

    def _adjoint(self, g: np.ndarray) -> None:
        """Compute T^T F^-T g (owned, 3) in place. Collective."""
        g[self._nodes] = np.einsum("nji,nj->ni", self._back, g[self._nodes])
        for link in self.links:
            link.adjoint(g)

    def residual(self, predictor: np.ndarray, u: np.ndarray, g: np.ndarray) -> None:
        """Transform the residual force (owned, 3) at predictor + u to the residual of w, in place. Collective."""
        if self.identity:
            return
        self._adjoint(g)
        if self.slides:
            slipping = self.sliding.nodes
            if self.relative is None:
                x = predictor[slipping] + u[slipping]
            else:
                x = self.relative.positions(predictor + u)[slipping]
            g[slipping] = self.sliding.couple(x, g[slipping])

    def left(self) -> np.ndarray:
        """Maps M (s, 3, 3) of slipping nodes at the last evaluation of the residual."""
        return self.sliding.maps.copy()

    def linear(self, left: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Transform H u (local, 3), in place, to the derivative of the residual along u (local, 3). Collective.

        ``left`` : value of :meth:`left` where H was evaluated.
        """
        if self.identity:
            return
        self._adjoint(out)
        if self.slides:
            sliding, y = self.sliding, self.positions(u[: self.mesh.n_owned])[self.sliding.nodes]
            out[sliding.nodes] += np.einsum("nji,njk,nk->ni", sliding.inverse, sliding.stiffness, y)
            out[sliding.nodes] = np.einsum("nij,nj->ni", left, out[sliding.nodes])

    def diagonal(self, left: np.ndarray, blocks: BlocksOf, diagonal: np.ndarray) -> None:
        """Replace the diagonal (owned, 3) of H by that of the derivative of the residual. Collective."""
        nodes = self.frames.nodes
        full = np.zeros((len(diagonal), 3, 3))
        full[nodes] = self._in_frames(nodes, blocks(nodes))
        for link in self.links:
            others, own = link.blocks(lambda some: self._in_frames(some, blocks(some)))
            full[others], nodes = own, np.union1d(nodes, others)
        at = self.sliding.nodes
        full[at] = left @ (full[at] + self.slip_blocks())
        diagonal[nodes] = np.einsum("nii->ni", full[nodes])

    def slip_blocks(self) -> np.ndarray:
        """Return what the turning of slips adds to the diagonal blocks (s, 3, 3) of slipping nodes, before M."""
        sliding = self.sliding
        return np.einsum("nji,njk,nkl->nil", sliding.inverse, sliding.stiffness, sliding.inverse)

    def _in_frames(self, nodes: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        _, at, place = np.intersect1d(nodes, self._nodes, return_indices=True)
        inverse = self._back[place]
        blocks[at] = inverse.transpose(0, 2, 1) @ blocks[at] @ inverse
        return blocks

    def turns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Matrices that transform the blocks of a Hessian to coordinates of the frames of x: place of each node
        (local,) among these, -1 for none; those on the left (m, 3, 3), with M where no rows follow; and inverses
        (turned, 3, 3) of these and of ghosts. None if no node has a frame."""
        if not self._oblique:
            return None
        left = self.frames.inverse.transpose(0, 2, 1).copy()
        if self.relative is None:
            left[self.sliding.at] = self.sliding.maps @ left[self.sliding.at]
        return self._frame_of, left[self._direct], self._inverse
