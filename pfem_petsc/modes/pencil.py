"""The matrices of the eigenvalue problems, with the components that supports and contact hold; by one linear solve the
axial forces that the changes from the start of an analysis to its end cause; and solvers of A x = theta B x."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import SimulationFailure
from ..mechanics.mass import Inertia
from ..parallel.agreement import agreed, on_root
from ..solvers.linear import has_mumps, set_preconditioner
from ..solvers.matrix import HessianMatrix, add_diagonal, block_diagonal
from ..tolerances import BEYOND, RANK, SINGULAR_PIVOT

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

    from ..integrators.base import State
    from ..mechanics.supports import Directions
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model

_LINKED = (
    "modes: {} (contact_pair, constraint): modes of states in which nodes hold each other are not available; let the "
    "analysis end in a state without that contact"
)
_PRESSES = 1e-12  # of the sum of axial stiffnesses at a node times the model's length: the smallest force that counts
_DIFFERENCE = 1e-6  # relative to the model's length: step of the central difference of normals of curved walls


class Holds:
    """The directions held at this rank's nodes. Construction is collective.

    Parameters
    ----------
    model : Model
    state : State

    Attributes
    ----------
    held : (owned, 3) bool, components in the local axes of each node, which are x, y, z except for nodes at walls and
        with supports along other directions
    number : of held components in the whole model
    at_walls : number of nodes of the whole model in contact with walls
    curvature : owned nodes (m,) and blocks (m, 3, 3) [N/m] that forces of curved walls add to the stiffness; None if
        there are none

    Raises
    ------
    SimulationFailure
        On all ranks, for contact between nodes or with a wall with mass, which modes do not support.
    """

    def __init__(self, model: Model, state: State) -> None:
        self._mesh = model.mesh
        self.held = model.supports.fixed.copy()
        self.curvature: tuple[np.ndarray, np.ndarray] | None = None
        self._nodes, self._turns = np.empty(0, dtype=np.int64), np.empty((0, 3, 3))
        if model.links:
            totals = model.comm.allreduce(np.abs(model.links.totals()).sum())
            stiffest = model.comm.allreduce(float(model.nodal_stiffness.max(initial=0.0)), op=MPI.MAX)
            if totals > _PRESSES * stiffest * model.length:
                raise SimulationFailure(_LINKED.format("nodes of the truss press on each other"))
        if model.can_touch:
            with agreed(model.comm):
                curved = self._take_walls(model, state)
            if model.comm.allreduce(len(curved[0])):
                self.curvature = curved
        self.at_walls = model.comm.allreduce(len(self._nodes))
        if model.supports.inclined is not None:
            self._take_directions(model.supports.inclined)
        self.number = model.comm.allreduce(int(self.held.sum()))
        turned = self.at_walls or model.supports.inclined is not None
        self._turn: PETSc.Mat | None = self._turning() if turned else None

    def _take_walls(self, model: Model, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Hold this rank's nodes in contact with walls; return nodes and blocks of :attr:`curvature`."""
        contact, owned = model.contact, model.mesh.n_owned
        weight = np.abs(state.contact).max(axis=1, initial=0.0)
        presses = weight > _PRESSES * model.nodal_stiffness * model.length
        tied = contact.ties.held if contact.ties.any else np.zeros(owned, dtype=bool)
        self._nodes = nodes = np.flatnonzero(presses | tied)
        x, poses = state.position[nodes], contact.motion.poses(state.time)
        contact.forget_faces()
        contact.find_faces(nodes, x, poses, -10.0 * BEYOND * contact.size)
        applicable = contact.applicable(nodes, x, poses)
        normals, offsets = contact.planes(applicable, x, poses, nodes=nodes)
        gaps = np.einsum("mwi,mi->mw", normals, x) - offsets
        touched = np.abs(gaps) <= 10.0 * BEYOND * contact.size
        unknown = nodes[~touched.any(axis=1) & ~tied[nodes]]
        if len(unknown):
            what = f"node {model.mesh.node_ids[unknown[0]]} has a contact force, but there is no wall"
            raise SimulationFailure(_LINKED.format(what))
        massive = [k for k in contact.motion.bodies.at if touched[:, contact.wall_of == k].any()]
        if massive:
            raise SimulationFailure(
                f"modes: wall {contact.names[massive[0]]!r} has mass and is in contact: modes of a truss with such a "
                "wall are not available; let the analysis end without that contact, or give the wall no mass"
            )
        rough = (touched & (contact.static_friction > 0.0)).any(axis=1) | tied[nodes]
        everywhere = np.broadcast_to(np.eye(3), (len(nodes), 3, 3))
        held = [
            np.where(touched[:, :, None], normals, 0.0),
            rough[:, None, None] * everywhere,
            self.held[nodes][:, :, None] * everywhere,
        ]
        # right singular vectors: orthonormal, held ones first
        _, values, self._turns = np.linalg.svd(np.concatenate(held, axis=1))
        self.held[nodes] = values > RANK * values[:, :1]
        curved = touched & ~rough[:, None] & ~contact.flat
        at = np.flatnonzero(curved.any(axis=1))
        if not len(at):
            return nodes[:0], np.empty((0, 3, 3))
        return nodes[at], self._curvature(model, state, touched & ~rough[:, None], normals)[at]

    def _curvature(self, model: Model, state: State, touched: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return minus the force times the derivative of the normal (m, 3, 3) [N/m], of nodes at walls."""
        contact, nodes = model.contact, self._nodes
        poses = contact.motion.poses(state.time)
        blocks, forces = np.zeros((len(nodes), 3, 3)), np.zeros(touched.shape)
        for m, node in enumerate(nodes):
            at = np.flatnonzero(touched[m])
            # prescribed components go to the supports; the walls' forces are the rest of the contact force
            forces[m, at] = np.linalg.lstsq(normals[m, at].T, state.contact[node], rcond=None)[0]
        h = _DIFFERENCE * model.length
        for k in np.flatnonzero(~contact.flat):
            wall = contact.wall_of[k]
            if contact.walls[wall].faces > 1:  # flat faces
                continue
            for axis in range(3):
                shift = h * np.eye(3)[axis]
                ahead, behind = (
                    poses.turned(wall, contact.walls[wall].planes(poses.rest(wall, state.position[nodes] + side))[0])
                    for side in (shift, -shift)
                )
                blocks[:, :, axis] -= forces[:, k, None] * (ahead - behind) / (2.0 * h)
        return 0.5 * (blocks + blocks.transpose(0, 2, 1))

    def _take_directions(self, directions: Directions) -> None:
        """Add the nodes with supports along directions that are no axes; walls do not touch them."""
        values, turns = np.linalg.eigh(directions.free)  # held directions first
        self._nodes = np.append(self._nodes, directions.nodes)
        self._turns = np.concatenate([self._turns, turns.transpose(0, 2, 1)])
        self.held[directions.nodes] = values < 0.5

    def _turning(self) -> PETSc.Mat:
        """Return the block-diagonal matrix from the local axes of nodes to x, y, z."""
        turn = block_diagonal(self._mesh)
        add_diagonal(turn, self._mesh, self._nodes, self._turns.transpose(0, 2, 1), PETSc.InsertMode.INSERT_VALUES)
        return turn

    def taken_out(self, matrix: PETSc.Mat, diagonal: float | np.ndarray) -> PETSc.Mat:
        """Return a matrix in the local axes, with ``diagonal`` (owned,) at held components and without their coupling
        to others; the given matrix may be changed. Collective."""
        if self._turn is not None:
            matrix = matrix.ptap(self._turn)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        if self.number:
            matrix.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
            rows = np.flatnonzero(self.held) + 3 * self._mesh.first_node
            matrix.zeroRowsColumns(rows.astype(PETSc.IntType), 0.0)
            values = matrix.getDiagonal()
            at = np.broadcast_to(np.reshape(diagonal, (-1, 1)), self.held.shape)
            values.array[self.held.ravel()] = at[self.held]
            matrix.setDiagonal(values)
        return matrix

    def to_axes(self, shapes: np.ndarray) -> np.ndarray:
        """Transform shapes (k, owned, 3) from the local axes to x, y, z; held components are zero."""
        shapes = np.where(self.held, 0.0, shapes)
        shapes[:, self._nodes] = np.einsum("mij,kmi->kmj", self._turns, shapes[:, self._nodes])
        return shapes

    def to_own(self, shapes: np.ndarray) -> np.ndarray:
        """Transform shapes to the local axes, with held components set to zero."""
        shapes = shapes.copy()
        shapes[:, self._nodes] = np.einsum("mij,kmj->kmi", self._turns, shapes[:, self._nodes])
        return np.where(self.held, 0.0, shapes)


@dataclass
class Pencil:
    """The problem A x = theta B x in PETSc matrices, with data for an iteration.

    Attributes
    ----------
    a, b : PETSc matrices; b is positive definite if the shift lies below all eigenvalues
    points : (owned, 3) positions of the nodes [m], for multigrid
    held : (owned, 3) bool, components that are held
    """

    a: PETSc.Mat
    b: PETSc.Mat
    points: np.ndarray
    held: np.ndarray

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for matrix in (self.a, self.b):
            matrix.destroy()


class BarStiffness(NamedTuple):
    """Stiffness of bars between positions ``x`` (local, 3) [m]: along and across them (b,) [N/m], and their lengths
    (b,) [m]."""

    x: np.ndarray
    along: np.ndarray
    across: np.ndarray
    lengths: np.ndarray

    @classmethod
    def of(cls, model: Model, x: np.ndarray, stored: np.ndarray) -> BarStiffness:
        """Return that of the numbers ``stored`` (2, b) of ``Bars.stiffnesses`` at positions."""
        lengths = model.bars.lengths(x)
        return cls(x, stored[0] * lengths**2 + stored[1], stored[1], lengths)

    @property
    def stored(self) -> np.ndarray:
        """These numbers (2, b)."""
        square = self.lengths**2
        c = np.divide(self.along - self.across, square, out=np.zeros_like(square), where=square > 0.0)
        return np.stack([c, self.across])

    def largest(self, comm: MPI.Comm) -> float:
        """Return the largest magnitude along or across a bar [N/m]. Collective."""
        mine = np.maximum(np.abs(self.along), np.abs(self.across)).max(initial=0.0)
        return comm.allreduce(float(mine), op=MPI.MAX)


def buckling_bars(model: Model, x: np.ndarray) -> tuple[BarStiffness, BarStiffness]:
    """Return the bars of K0 and Kg, both on the geometry of the mesh.

    K0: dN/dl of the unstressed bars with their virgin material, along the bar. Kg: N/l0 across it, where N is the
    axial force at the local positions ``x``.
    """
    bars, points = model.bars, model.mesh.points
    force = bars.state_stiffness(x)[1] * bars.lengths(x)
    history, heat, rest = bars.history(), bars.heat, bars.rest
    step, bars.step = bars.step, 0.0
    try:
        bars.put_history(np.zeros_like(history))
        bars.heat, bars.rest = np.zeros_like(heat), bars.mesh_lengths
        stored = np.zeros((2, len(model.mesh.bars)))
        bars.stiffnesses(points, 1.0, stored)
    finally:
        bars.put_history(history)
        bars.heat, bars.rest, bars.step = heat, rest, step
    # dN/dl of bars that are stress-free at their rest lengths
    unloaded = BarStiffness.of(model, points, stored * (bars.mesh_lengths / rest))
    none = np.zeros_like(force)
    return unloaded._replace(across=none), unloaded._replace(along=none, across=force / bars.mesh_lengths)


class StateMatrices:
    """Assembled matrices of a model in which components held by supports and walls are decoupled.

    Parameters
    ----------
    model : Model
    holds : Holds
    consistent : whether the mass matrix is consistent
    """

    def __init__(self, model: Model, holds: Holds, consistent: bool) -> None:
        self.model, self.holds = model, holds
        # a treatment of impact may have moved the masses of nodes
        same = consistent == model.inertia.consistent and model.inertia.redistribution is None
        self.inertia = model.inertia if same else Inertia(model.mesh, model.bars, consistent, model.inertia.points)
        self._ends = model.mesh.bars.astype(np.int64)

    def stiffness(
        self, bars: BarStiffness, diagonal: float | np.ndarray, added: tuple | None = None, springs: bool = True
    ) -> PETSc.Mat:
        """Return the matrix of bars, with ``diagonal`` (owned,) at held components. Collective.

        ``springs``: whether those to the ground are part of it
        ``added``: owned nodes (m,) and blocks (m, 3, 3) [N/m] to add
        """
        return self.holds.taken_out(self.whole(bars, added, springs), diagonal)

    def whole(self, bars: BarStiffness, added: tuple | None = None, springs: bool = True) -> PETSc.Mat:
        """Return the matrix of bars with all components. Collective."""
        matrix = HessianMatrix(self.model.mesh)

        def fill(values: np.ndarray) -> None:
            matrix.add_bars(bars.x, bars.stored, values)
            if springs and self.model.bars.springs is not None:
                self.model.bars.springs.add_tangents(1.0, matrix.pattern, values)
            if added is not None:
                matrix.pattern.add_blocks(*added, values)

        return matrix.fill(fill)

    def mass(self) -> PETSc.Mat:
        """Return the mass matrix [kg]; held components keep their lumped mass. Collective."""
        model, inertia = self.model, self.inertia
        if not inertia.consistent:
            return _diagonal(model.mesh, np.repeat(inertia.mass, 3))
        matrix = HessianMatrix(model.mesh)
        filled = matrix.fill(lambda values: matrix.add_mass(model.bars, inertia, values))
        return self.holds.taken_out(filled, inertia.mass)

    def bounds(self, bars: BarStiffness, blocks: tuple | None = None) -> tuple[float, float]:
        """Return bounds below and above all eigenvalues of the bars' stiffness and the mass [1/s2]. Collective.

        A bar's matrix is (a n n^T + c (I - n n^T)) times [[1, -1], [-1, 1]], which lies between 2 min(a, c, 0) and
        2 max(a, c, 0) times the identity; a consistent mass is at least a third of the lumped one.
        """
        low = self._at_nodes(2.0 * np.minimum(np.minimum(bars.along, bars.across), 0.0))
        high = self._at_nodes(2.0 * np.maximum(np.maximum(bars.along, bars.across), 0.0))
        if self.model.bars.springs is not None:
            high[self.model.bars.springs.nodes] += self.model.bars.springs.largest()
        if blocks is not None:
            nodes, added = blocks
            values = np.linalg.eigvalsh(added)
            low[nodes] += np.minimum(values[:, 0], 0.0)
            high[nodes] += np.maximum(values[:, -1], 0.0)
        factor = 3.0 if self.inertia.consistent else 1.0
        mine = np.array([-(low / self.inertia.mass).min(initial=0.0), (high / self.inertia.mass).max(initial=0.0)])
        self.model.comm.Allreduce(MPI.IN_PLACE, mine, op=MPI.MAX)
        return -factor * float(mine[0]), factor * float(mine[1])

    def _at_nodes(self, values: np.ndarray) -> np.ndarray:
        """Return sums over the bars of each owned node."""
        mesh = self.model.mesh
        sums = np.zeros(mesh.n_local)
        for end in (0, 1):
            sums += np.bincount(self._ends[:, end], weights=values, minlength=mesh.n_local)
        return sums[: mesh.n_owned]


def join(first: PETSc.Mat, factor: float, second: PETSc.Mat) -> PETSc.Mat:
    """Return first + factor second as a new symmetric matrix with the pattern of the first. Collective."""
    total = first.duplicate(copy=True)
    total.axpy(factor, second, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
    total.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return total


def _diagonal(mesh: DistributedMesh, values: np.ndarray) -> PETSc.Mat:
    size, numbers = (len(values), 3 * mesh.n_nodes), np.arange(len(values) + 1, dtype=PETSc.IntType)
    rows = numbers, numbers[:-1] + PETSc.IntType(3 * mesh.first_node), values
    matrix = PETSc.Mat().createAIJ((size, size), bsize=3, csr=rows, comm=mesh.comm)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return matrix


_PREFIX = "pfem_linear_"
_DIRECT_UP_TO = 400_000  # unknowns; beyond, multigrid
_SMALL = 500  # unknowns up to which PETSc's own factorisation takes less time
_RTOL = 1e-12  # of iterative solves
_SOLVED = 1e-6  # residual relative to the load, above which the stiffness is singular


@dataclass(frozen=True)
class LinearForces:
    """Forces of a linear solve about the state at the start of an analysis.

    Attributes
    ----------
    stiffness : of the bars at the start with its stresses
    start, change : (b,) axial forces at the start, and what is added up to the end [N]
    """

    stiffness: BarStiffness
    start: np.ndarray
    change: np.ndarray


class _Linear:
    """The state at the start. Methods are collective."""

    def __init__(self, model: Model, matrices: StateMatrices) -> None:
        self.model, self.matrices = model, matrices
        x = model.mesh.points.copy()
        if model.start is not None:
            x[: model.mesh.n_owned] = model.start.position
            model.mesh.update_ghosts(x)
        self.x = x

    def at(self, time: float) -> tuple[BarStiffness, np.ndarray, np.ndarray]:
        """Stiffness, axial forces (b,) and internal forces (owned, 3) at the start's positions and the temperatures
        and rest lengths of a time."""
        model, forces = self.model, np.zeros_like(self.x)
        model.change_bars(time)
        with model.bars.without_rates():
            model.bars.forces(self.x, forces, commit=False)
        bars = BarStiffness.of(model, self.x, model.bars.state_stiffness(self.x))
        return bars, bars.across * bars.lengths, forces[: model.mesh.n_owned]

    def solve(self, bars: BarStiffness, load: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Displacements (local, 3) by loads (owned, 3) and prescribed components (k,)."""
        model, holds = self.model, self.matrices.holds
        u = np.zeros_like(self.x)
        owned = u[: len(load)]
        model.supports.put(owned, moved)
        whole = self.matrices.whole(bars)
        moves, resisting = whole.createVecs()
        moves.array[:] = owned.ravel()
        whole.mult(moves, resisting)
        rest = holds.to_own((load - resisting.array.reshape(load.shape))[None])[0]
        matrix = holds.taken_out(whole, max(float(np.abs(bars.along).max(initial=0.0)), 1.0))
        owned += holds.to_axes(self._free(matrix, rest)[None])[0]
        model.mesh.update_ghosts(u)
        return u

    def _free(self, matrix: PETSc.Mat, load: np.ndarray) -> np.ndarray:
        """Solve for the components that are not held."""
        ksp, unknowns = PETSc.KSP().create(matrix.comm), 3 * self.model.mesh.n_nodes
        ksp.setOptionsPrefix(_PREFIX)
        direct = unknowns <= _DIRECT_UP_TO
        ksp.setType("preonly" if direct else "cg")
        ksp.setTolerances(rtol=_RTOL, max_it=4000)
        set_preconditioner(ksp.getPC(), "lu" if unknowns <= _SMALL else "mumps" if direct else "gamg")
        ksp.setOperators(matrix)
        ksp.setFromOptions()
        b, x = matrix.createVecs()
        b.array[:] = load.ravel()
        try:
            ksp.solve(b, x)
            found = x.array.reshape(load.shape).copy()
            residual = b.duplicate()
            matrix.mult(x, residual)
            residual.axpy(-1.0, b)
            sound = residual.norm() <= _SOLVED * b.norm()
        except PETSc.Error:
            sound = False
        if not sound:
            raise SimulationFailure(
                f"{self.model.case.source}: modes: the stiffness at the start is singular, so that no linear solve "
                "gives the forces of the loads: the truss is a mechanism or is not held; brace and support it"
            )
        return found


def linear_forces(model: Model, matrices: StateMatrices, begin: float, end: float, loaded: bool) -> LinearForces:
    """Return the axial forces of a linear solve for what changes from a load factor to another. Collective.

    What acts at the start, such as prestress, is brought to equilibrium by a linear solve as well. The bars are left as
    they are at ``end``.

    Parameters
    ----------
    model : Model
    matrices : StateMatrices
    begin, end : load factors or times
    loaded : whether loads act at the start; if not, all of those at the end are changes

    Raises
    ------
    SimulationFailure
        On all ranks, if the stiffness is singular.
    """
    bars, linear, supports = model.bars, _Linear(model, matrices), model.supports
    history, x = bars.history(), linear.x[: model.mesh.n_owned]

    def loads(time: float) -> np.ndarray:
        out = np.zeros_like(x)
        return model.external.at(time, out).copy() if model.external.active else out

    try:
        if model.start is None:
            bars.put_history(np.zeros_like(history))
        stiffness, force, internal = linear.at(begin)
        acting = loads(begin) if loaded else np.zeros_like(x)
        ends, lengths = model.mesh.bars, stiffness.lengths

        def stretching(u: np.ndarray) -> np.ndarray:
            d, du = (values[ends[:, 1]] - values[ends[:, 0]] for values in (linear.x, u))
            return stiffness.along * (du * d).sum(axis=1) / lengths

        u = linear.solve(stiffness, acting - internal, supports.lacking(x, begin))
        start = force + stretching(u)
        stiffness = stiffness._replace(across=start / lengths)
        _, forced, resisting = linear.at(end)
        added = loads(end) - acting - (resisting - internal)
        u = linear.solve(stiffness, added, supports.positions(end) - supports.positions(begin))
        return LinearForces(stiffness, start, forced - force + stretching(u))
    finally:
        bars.put_history(history)
        model.change_bars(end)


_TOLERANCE = 1e-11  # relative, of theta; its square is the error of the eigenvalue


class OnOneRank:
    """Solves A x = theta B x with B positive definite for the largest theta, on rank 0, without the held components.

    All solvers are constructed from a :class:`Pencil`, collectively, and have ``name``; ``finds_all``, whether repeated
    eigenvalues are found with their multiplicity; ``definite``, whether B is positive definite, None if that is
    unknown; ``largest(count, start, known)``, which returns vectors (k, owned components) of at least the ``count``
    largest theta in the complement of the vectors ``known``; and ``destroy()``.
    """

    def __init__(self, pencil: Pencil) -> None:
        self._comm, self._owned = pencil.a.comm.tompi4py(), pencil.held.size
        self._free = np.flatnonzero(~pencil.held.ravel())
        parts = self._comm.allgather(self._free + pencil.a.getOwnershipRange()[0])
        before = sum(map(len, parts[: self._comm.rank]))
        self._mine = slice(before, before + len(self._free))
        rows = np.concatenate(parts) if self._comm.rank == 0 else self._free[:0]
        self.definite: bool | None = on_root(
            self._comm, self._prepare, self._whole(pencil.a, rows), self._whole(pencil.b, rows)
        )

    def _whole(self, matrix: PETSc.Mat, rows: np.ndarray) -> csc_matrix:
        """Return the given rows and columns of a matrix. Collective."""
        from scipy.sparse import csr_matrix

        chosen = PETSc.IS().createGeneral(rows.astype(PETSc.IntType), comm=matrix.comm)
        part = matrix.createSubMatrix(chosen, chosen)
        pointers, columns, values = part.getValuesCSR()
        whole = csr_matrix((values, columns, pointers), shape=(len(rows), len(rows))).tocsc()
        part.destroy()
        chosen.destroy()
        return whole

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :class:`OnOneRank`. Collective."""
        parts = self._comm.gather(np.concatenate([start[None], known])[:, self._free])
        given = np.concatenate(parts, axis=1) if parts is not None else start[None]
        vectors = on_root(self._comm, self._find, count, given[0], given[1:])
        mine = np.zeros((len(vectors), self._owned))
        mine[:, self._free] = vectors[:, self._mine]
        return mine

    def destroy(self) -> None:
        """Free nothing: matrices and factors are Python's."""


class Dense(OnOneRank):
    """All eigenvalues by LAPACK: for small models."""

    name = "dense matrices (LAPACK)"
    finds_all = True

    def _prepare(self, a: csc_matrix, b: csc_matrix) -> bool:
        from scipy.linalg import eigh

        right = b.toarray()
        try:
            pivots = np.diag(np.linalg.cholesky(right)) ** 2
        except np.linalg.LinAlgError:
            return False
        if pivots.min() <= SINGULAR_PIVOT * right.diagonal().max():
            return False
        self._vectors = eigh(a.toarray(), right)[1].T[::-1]
        return True

    def _find(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        return self._vectors[len(known) : len(known) + count]


class Lanczos(OnOneRank):
    """Some eigenvalues by SciPy (ARPACK) with a factorisation."""

    name = "Lanczos iterations with a factorisation on one rank (SciPy)"
    finds_all = False

    def _prepare(self, a: csc_matrix, b: csc_matrix) -> bool | None:
        from scipy.sparse.linalg import splu

        self._a, self._b = a, b
        options = {"SymmetricMode": True}
        try:
            self._factor = splu(b, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError:
            return False
        if not np.array_equal(self._factor.perm_r, self._factor.perm_c):
            return None
        # L D L^T without row exchanges: by Sylvester's law the signs of D are those of the eigenvalues
        return bool((self._factor.U.diagonal() > SINGULAR_PIVOT * b.diagonal().max()).all())

    def _find(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

        n = len(start)
        products = self._b @ known.T
        gram = known @ products

        def complement(x: np.ndarray) -> np.ndarray:
            """Remove the component in the span of the known vectors, which are B-orthogonal to all others."""
            return x - known.T @ np.linalg.solve(gram, products.T @ x)

        def applied(x: np.ndarray) -> np.ndarray:
            y = self._a @ complement(x)
            return y - products @ np.linalg.solve(gram, known @ y)

        def operator(function: Any) -> LinearOperator:
            return LinearOperator((n, n), matvec=function, dtype=float)

        options = {
            "M": self._b,
            "which": "LA",
            "v0": complement(start),
            "tol": _TOLERANCE,
            "ncv": min(n, 2 * count + 20),
        }
        try:
            _, vectors = eigsh(operator(applied), min(count, n - 1), Minv=operator(self._factor.solve), **options)
        except ArpackNoConvergence as failure:
            raise SimulationFailure(f"modes: the Lanczos iterations of SciPy did not converge: {failure}") from failure
        return np.ascontiguousarray(complement(vectors).T)


FACTORISED_UP_TO = 400_000
"""Maximum number of components for which SLEPc uses a factorisation of B."""
_OPTIONS = "pfem_modes_"
_LINEAR = 1e-12  # tolerance of solves with multigrid, which the iterations treat as exact


class Slepc:
    """Krylov-Schur iterations by SLEPc on all ranks: with a factorisation by MUMPS, for large models with multigrid.

    Options: prefix ``pfem_modes_``, of the eigensolver (``eps_...``) and of its linear solver (``st_ksp_...``).
    """

    finds_all = False

    def __init__(self, pencil: Pencil) -> None:
        from slepc4py import SLEPc

        self.pencil = pencil
        self._eps = eps = SLEPc.EPS().create(pencil.b.comm)
        eps.setOptionsPrefix(_OPTIONS)
        eps.setOperators(pencil.a, pencil.b)
        eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        eps.setType(SLEPc.EPS.Type.KRYLOVSCHUR)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
        eps.setTolerances(_TOLERANCE, 500)
        ksp, mumps = eps.getST().getKSP(), has_mumps()
        pc = ksp.getPC()
        self.name = "Krylov-Schur iterations (SLEPc), "
        if (mumps or pencil.b.comm.size == 1) and pencil.b.getSize()[0] <= FACTORISED_UP_TO:
            self.name += "factorisation by MUMPS" if mumps else "factorisation"
            ksp.setType("preonly")
            pc.setType("cholesky")
            if mumps:
                pc.setFactorSolverType("mumps")
        else:
            self.name += "conjugate gradients with multigrid"
            ksp.setType("cg")
            ksp.setTolerances(rtol=_LINEAR, max_it=2000)
            pc.setType("gamg")
            pc.setOperators(pencil.b)
            points = pencil.points
            total = pencil.b.comm.tompi4py().allreduce(np.append(points.sum(axis=0), float(len(points))))
            pc.setCoordinates(points - total[:3] / total[3])
        eps.setFromOptions()
        self.definite = self._definite(ksp)

    def _definite(self, ksp: PETSc.KSP) -> bool | None:
        """Return whether B is positive definite, by the signs of its factors (Sylvester's law)."""
        pc = ksp.getPC()
        if pc.getType() != "cholesky":
            return None
        ksp.setOperators(self.pencil.b)
        mumps = pc.getFactorSolverType() == "mumps"
        if mumps:
            pc.setFactorSetUpSolverType()
            factor = pc.getFactorMatrix()
            factor.setMumpsIcntl(24, 1)  # count zero pivots
            factor.setMumpsIcntl(13, 1)  # and signs of pivots of the last front, which several ranks may share
        ksp.setUp()
        factor = pc.getFactorMatrix()
        if mumps and factor.getMumpsInfog(1) < 0:
            return False
        negative, zero, _ = factor.getInertia()
        return negative == 0 and zero == 0

    def largest(self, count: int, start: np.ndarray, known: np.ndarray) -> np.ndarray:
        """See :class:`OnOneRank`. Collective."""
        eps, b = self._eps, self.pencil.b
        size = b.getSize()[0]
        spaces = [b.createVecRight() for _ in range(len(known) + 1)]
        for vector, values in zip(spaces, (*known, start), strict=True):
            vector.setArray(values)
        eps.setDeflationSpace(spaces[:-1])
        eps.setInitialSpace(spaces[-1:])
        eps.setDimensions(min(count, size), min(size, 2 * count + 20))
        try:
            eps.solve()
        except PETSc.Error as failure:
            reason = str(failure).strip().splitlines()[-1]
            raise SimulationFailure(
                f"modes: {self.name}: PETSc or SLEPc failed ({reason}); use another modes.solver, or other options "
                f"-{_OPTIONS}..."
            ) from failure
        finally:
            for vector in spaces:
                vector.destroy()
        found = eps.getConverged()
        if found < min(count, size - len(known)):
            raise SimulationFailure(
                f"modes: {found} of {count} eigenvalues converged after {eps.getIterationNumber()} restarts of SLEPc's "
                f"iterations ({self.name}); ask for fewer modes, or give other options -{_OPTIONS}eps_..."
            )
        vectors = np.empty((found, len(start)))
        x = b.createVecRight()
        for k in range(found):
            eps.getEigenvector(k, x)
            vectors[k] = x.getArray(readonly=True)
        x.destroy()
        return vectors

    def destroy(self) -> None:
        """Free the SLEPc objects."""
        self._eps.destroy()


SOLVERS = {"dense": Dense, "scipy": Lanczos, "slepc": Slepc}
"""By the name in ``modes.solver``."""
