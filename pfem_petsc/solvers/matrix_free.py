"""The Hessian as a matrix-free operator: stiffness is applied bar by bar, never assembled; linear solves with it."""

from __future__ import annotations

import atexit
import itertools
import weakref
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.chunk_laws import CHUNK, ROW
from ..mechanics.compiled import inlined, kernel
from ..mechanics.elements import end_difference
from ..mechanics.layout import (
    DIFFERENCES,
    FORCES,
    BarLayout,
    Group,
    aligned,
    new_components,
    split_components,
)
from ..mesh.ordering import NODE_BLOCK

if TYPE_CHECKING:
    from ..contact.transform import RowCoordinates
    from ..mechanics.bars import Bars
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model
    from .matrix import StepProblem


_ALIVE: dict[int, weakref.ref] = {}
"""PETSc objects that exist, by number in the order of their creation."""
_NUMBERS = itertools.count()


def outlive_at_exit(thing: object) -> None:
    """Let a matrix, or a linear or nonlinear solver, :func:`outlive` Python if it still exists when Python exits.

    Unlike ``atexit.register``, it keeps nothing of an object that is gone, of which a program that makes many runs has
    many.
    """
    number = next(_NUMBERS)
    if not number:
        atexit.register(lambda: [outlive(thing) for thing in reversed(list(_ALIVE.values()))])
    _ALIVE[number] = weakref.ref(thing, lambda _: _ALIVE.pop(number, None))


def outlive(reference: weakref.ref) -> None:
    """Prevent PETSc from freeing or calling Python objects; to be called when Python exits.

    Parameters
    ----------
    reference : to a matrix, or to a linear or nonlinear solver, whose operators include the last restriction to
        inactive unknowns, and which may have a preconditioner in Python
    """
    thing = reference()
    if not thing:
        return
    matrices = (thing,)
    if not isinstance(thing, PETSc.Mat):
        solver = thing.getKSP() if isinstance(thing, PETSc.SNES) else thing
        matrices = solver.getOperators()
        if solver.getPC().getType() == "python":
            solver.getPC().setType("none")
        if solver.getType() == "python":
            solver.setType("cg")
    for matrix in matrices:
        if matrix and matrix.getType() == "python":
            matrix.incRef()


def python_matrix(context: object, mesh: DistributedMesh, local: int | None = None) -> PETSc.Mat:
    """Create a symmetric matrix of all unknowns, or of ``local`` ones on this rank, whose products a Python object
    computes. Collective."""
    size = (3 * mesh.n_owned, 3 * mesh.n_nodes) if local is None else (local, None)
    matrix = PETSc.Mat().createPython((size, size), context, comm=mesh.comm)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return matrix


_X, _Y, _Z = (np.uint64(row * ROW) for row in range(3))


class BarProducts:
    """Products with the stiffness of all bars of a rank, and its diagonal.

    Attributes
    ----------
    x : (local, 3) positions [m]
    stored : (2, b) c [N/m3] and g [N/m] of each bar
    """

    def __init__(self, bars: Bars) -> None:
        self.bars = bars
        nodes, self._layout = bars.mesh.n_local, bars.arrays.layout
        self.x = np.zeros((nodes, 3))
        self.stored = np.zeros((2, len(bars.ends)))
        self._columns = self.stored
        columns = int(self._layout.starts[-1])
        if columns > len(bars.ends):
            self._columns = aligned(2 * columns).reshape(2, columns)
        self._places, self._vectors = new_components(nodes), new_components(nodes)
        self._sums = new_components(nodes, FORCES)
        self._work = aligned(3 * ROW, DIFFERENCES)
        self._needed, self._complete = _order(self._layout, nodes)

    @classmethod
    def tangent(cls, bars: Bars, x: np.ndarray) -> BarProducts:
        """Return products with the tangent stiffness at positions ``x`` (local, 3), without springs."""
        made = cls(bars)
        made.x[:] = x
        bars.stiffnesses(x, 1.0, made.stored)
        made.take()
        return made

    def take(self) -> None:
        """Take account of changes of :attr:`x` and :attr:`stored`."""
        split_components(self.x, self._places)
        if self._columns is not self.stored:
            self._columns[:, self._layout.column_of] = self.stored

    def times(self, nodal: np.ndarray, u: np.ndarray, out: np.ndarray) -> None:
        """Write nodal u + K u to ``out``, both (local, 3); ``nodal`` (owned,) [N/m]."""
        task = ProductTask(nodal, u.reshape(-1), out.reshape(-1), self._needed, self._complete)
        multiply(self._layout, self._places, self._vectors, self._columns, self._sums, self._work, task)


def _order(layout: BarLayout, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each group how many leading nodes must be begun before it, and how many no later one adds to."""
    lowest, highest = layout.heads // NODE_BLOCK * NODE_BLOCK, layout.fars + np.diff(layout.starts)
    for group in np.flatnonzero(layout.stars):
        first, last = layout.runs[group : group + 2]
        lowest[group] = layout.nodes[first:last].min()
        highest[group] = layout.far[layout.bars[first] : layout.bars[last]].max() + 1
    complete = np.append(np.minimum.accumulate(lowest[::-1])[::-1], nodes)[1:]
    return np.minimum(np.maximum(np.maximum.accumulate(highest), complete), nodes), complete


class ProductTask(NamedTuple):
    """What a product reads and writes: ``nodal`` (owned,), vectors ``u`` and ``out`` (3 local,), and for each group how
    many leading nodes are ``needed``, and which are ``complete`` after it."""

    nodal: np.ndarray
    u: np.ndarray
    out: np.ndarray
    needed: np.ndarray
    complete: np.ndarray


@inlined
def _begin(first, end, u, vectors, sums):
    """Write the vectors of nodes to components, and clear their sums."""
    for k in range(first, end):
        i, at = np.uint64(k), np.uint64(3 * k)
        vectors[0, i], vectors[1, i], vectors[2, i] = u[at], u[np.uint64(3 * k + 1)], u[np.uint64(3 * k + 2)]
        sums[0, i] = 0.0
        sums[1, i] = 0.0
        sums[2, i] = 0.0


@inlined
def _end(first, end, nodal, u, sums, out):
    """Write the products of nodes; those of ghosts are not complete, and zero."""
    for k in range(first, min(end, len(nodal))):
        i, at, after, last = np.uint64(k), np.uint64(3 * k), np.uint64(3 * k + 1), np.uint64(3 * k + 2)
        out[at] = nodal[i] * u[at] + sums[0, i]
        out[after] = nodal[i] * u[after] + sums[1, i]
        out[last] = nodal[i] * u[last] + sums[2, i]
    for k in range(3 * max(first, len(nodal)), 3 * end):
        out[k] = 0.0


@inlined
def _add_products_of_runs(g, x, u, stored, sums, work):
    """Add the products of a group of runs to the upper ends, and subtract them from the lower ones in a workspace for
    the nodes of a block, at the place of the group in it."""
    for k in range(g.n):
        a, b, i, at = np.uint64(g.head + k), np.uint64(g.far + k), np.uint64(g.first + k), np.uint64(g.at + k)
        dx, dy, dz = x[0, b] - x[0, a], x[1, b] - x[1, a], x[2, b] - x[2, a]
        ux, uy, uz = u[0, b] - u[0, a], u[1, b] - u[1, a], u[2, b] - u[2, a]
        c, across = stored[0, i] * (dx * ux + dy * uy + dz * uz), stored[1, i]
        px, py, pz = c * dx + across * ux, c * dy + across * uy, c * dz + across * uz
        work[_X + at] -= px
        work[_Y + at] -= py
        work[_Z + at] -= pz
        sums[0, b] += px
        sums[1, b] += py
        sums[2, b] += pz


@inlined
def _flush(origin, count, sums, work):
    """Add what is due to the first nodes of a block, and clear it."""
    for k in range(count):
        i, at = np.uint64(origin + k), np.uint64(k)
        sums[0, i] += work[_X + at]
        sums[1, i] += work[_Y + at]
        sums[2, i] += work[_Z + at]
        work[_X + at] = 0.0
        work[_Y + at] = 0.0
        work[_Z + at] = 0.0


@inlined
def _add_products_of_stars(g, runs, x, u, stored, sums):
    """Add the products of a group of stars; ``runs``: nodes, bars and far ends of the layout."""
    nodes, bars, far = runs
    ahead = g.first - np.int64(bars[g.run])
    for run in range(g.run, g.end):
        a = np.uint64(nodes[run])
        ax, ay, az = x[0, a], x[1, a], x[2, a]
        px, py, pz = u[0, a], u[1, a], u[2, a]
        sx = sy = sz = 0.0
        for k in range(np.int64(bars[run]), np.int64(bars[run + 1])):
            b, i = np.uint64(far[k]), np.uint64(ahead + k)
            dx, dy, dz = x[0, b] - ax, x[1, b] - ay, x[2, b] - az
            ux, uy, uz = u[0, b] - px, u[1, b] - py, u[2, b] - pz
            c, across = stored[0, i] * (dx * ux + dy * uy + dz * uz), stored[1, i]
            fx, fy, fz = c * dx + across * ux, c * dy + across * uy, c * dz + across * uz
            sx += fx
            sy += fy
            sz += fz
            sums[0, b] += fx
            sums[1, b] += fy
            sums[2, b] += fz
        sums[0, a] -= sx
        sums[1, a] -= sy
        sums[2, a] -= sz


@kernel
def multiply(layout, x, vectors, stored, sums, work, task):
    """Write nodal u + K u; positions, vectors and sums by components, ``stored`` (2, columns) of a
    :class:`~pfem_petsc.mechanics.layout.BarLayout`, ``work`` (3 ROW,) zeros.

    Vectors are split shortly before they are needed, and products written as soon as they are complete.
    """
    nodal, u, out, runs = task.nodal, task.u, task.out, (layout.nodes, layout.bars, layout.far)
    begun, ended, origin, wide = np.int64(0), np.int64(0), np.int64(-1), np.int64(0)
    for group in range(len(layout.heads)):
        first, head, star = layout.starts[group], layout.heads[group], layout.stars[group]
        n = layout.starts[group + 1] - first
        block = np.int64(-1) if star else head // NODE_BLOCK * NODE_BLOCK
        g = Group(first, n, head, layout.fars[group], layout.runs[group], layout.runs[group + 1], star, head - block, n)
        if block != origin and origin >= 0:
            _flush(origin, wide, sums, work)
            wide = np.int64(0)
        if (block != origin or star) and group > 0 and task.complete[group - 1] > ended:
            _end(ended, task.complete[group - 1], nodal, u, sums, out)
            ended = task.complete[group - 1]
        origin = block
        if task.needed[group] > begun:
            _begin(begun, task.needed[group], u, vectors, sums)
            begun = task.needed[group]
        if star:
            _add_products_of_stars(g, runs, x, vectors, stored, sums)
        else:
            wide = max(wide, g.at + n)
            _add_products_of_runs(g, x, vectors, stored, sums, work)
    if origin >= 0:
        _flush(origin, wide, sums, work)
    nodes = len(u) // 3
    _begin(begun, nodes, u, vectors, sums)
    _end(ended, nodes, nodal, u, sums, out)


class Restriction:
    """H restricted to some of the unknowns of each rank, the inactive set of a contact problem.

    It holds no reference to its PETSc matrix, which refers to it: Python's garbage collector cannot see a cycle through
    PETSc, so it would never be freed.
    """

    def __init__(self, whole: MatrixFreeHessian, kept: np.ndarray) -> None:
        self.whole = whole
        self.kept = kept.astype(np.int64)

    def matrix(self) -> PETSc.Mat:
        """Create a PETSc matrix for it. Collective."""
        matrix = python_matrix(self, self.whole.mesh, len(self.kept))
        matrix.setUp()
        return matrix

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = H x with zeros for the other unknowns; called by PETSc."""
        whole = self.whole
        u = whole._u[: whole.mesh.n_owned].reshape(-1)
        u[:] = 0.0
        u[self.kept] = x.getArray(readonly=True)
        whole.apply()
        y.setArray(whole._out[: whole.mesh.n_owned].reshape(-1)[self.kept])

    def getDiagonal(self, mat: PETSc.Mat, d: PETSc.Vec) -> None:  # noqa: N802 - PETSc's name
        """Write the diagonal of the restriction; called by PETSc."""
        d.setArray(self.whole.diagonal().reshape(-1)[self.kept])


class Context:
    """Python context of an operator that owns its PETSc matrix; does not keep the operator alive."""

    kept = None  # all unknowns

    def __init__(self, operator: Extension | MatrixFreeHessian) -> None:
        self.operator = weakref.ref(operator)

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = H x; called by PETSc."""
        with y as out:
            self.operator().times(x.getArray(readonly=True).reshape(-1, 3), out.reshape(-1, 3))

    def getDiagonal(self, mat: PETSc.Mat, d: PETSc.Vec) -> None:  # noqa: N802 - PETSc's name
        """Write the diagonal of H; called by PETSc."""
        d.setArray(self.operator().diagonal().ravel())

    def createSubMatrix(  # noqa: N802 - PETSc's name
        self, mat: PETSc.Mat, rows: PETSc.IS, columns: PETSc.IS, out: PETSc.Mat | None = None
    ) -> PETSc.Mat:
        """Return the restriction of H to some unknowns; called by PETSc."""
        whole = self.operator()
        return Restriction(whole, rows.getIndices() - 3 * whole.mesh.first_node).matrix()


class Extension:
    """H of all unknowns, with rows and columns of active unknowns replaced by those of a scaled identity."""

    def __init__(self, whole: MatrixFreeHessian) -> None:
        self.whole = whole
        self.kept: np.ndarray | None = None
        self.mat = python_matrix(Context(self), whole.mesh)
        self.mat.setBlockSize(3)
        self.mat.setUp()
        outlive_at_exit(self.mat)

    def times(self, given: np.ndarray, out: np.ndarray) -> None:
        """Compute ``out`` = H ``given``, both (owned, 3) and contiguous. Collective."""
        whole, kept = self.whole, self.kept
        owned = whole.mesh.n_owned
        if kept is None:
            whole.times(given, out)
            return
        u = whole._u[:owned].reshape(-1)
        u[:] = 0.0
        u[kept] = given.reshape(-1)[kept]
        whole.apply()
        np.multiply(whole.problem.scale, given, out=out)
        out.reshape(-1)[kept] = whole._out[:owned].reshape(-1)[kept]


@kernel
def add_blocks(bars, x, stored, blocks):
    """Add the diagonal blocks (local nodes, 6): xx, xy, xz, yy, yz, zz."""
    for k in range(len(bars)):
        dx, dy, dz = end_difference(x, bars, k)
        c, g = stored[0, k], stored[1, k]
        for end in range(2):
            i = bars[k, end]
            blocks[i, 0] += c * dx * dx + g
            blocks[i, 1] += c * dx * dy
            blocks[i, 2] += c * dx * dz
            blocks[i, 3] += c * dy * dy + g
            blocks[i, 4] += c * dy * dz
            blocks[i, 5] += c * dz * dz + g


class MatrixFreeHessian:
    """Matrix-free replacement of :class:`~pfem_petsc.solvers.matrix.HessianMatrix` for symmetric schemes.

    Attributes
    ----------
    mat : PETSc matrix of type python
    bounded : the matrix of steps with bounds, equal to ``mat``
    problem : of the last :meth:`linearise`
    bars : BarProducts
    x, stored : positions there [m], and data of each bar, of these
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        mesh = model.mesh
        self.mesh = mesh
        self.mat = python_matrix(Context(self), mesh)
        self.mat.setUp()
        outlive_at_exit(self.mat)
        self.bounded = self.mat
        self.bars = BarProducts(model.bars)
        self.x, self.stored = self.bars.x, self.bars.stored
        self._u = np.zeros((mesh.n_local, 3))
        self._out = np.zeros((mesh.n_local, 3))
        self._none = np.zeros(mesh.n_owned)
        self._diagonal: np.ndarray | None = None
        self.problem = None

    def update(self, problem: StepProblem, w: np.ndarray) -> None:
        """Linearise at ``w``. Collective."""
        problem.place(problem.increment(w))
        self.linearise(problem)
        self.mat.stateIncrease()

    def linearise(self, problem: StepProblem) -> None:
        """As :meth:`update`, at the current positions of the problem."""
        self.problem = problem
        self._left = problem.transform.left()
        self.x[:] = problem.x
        self.model.bars.stiffnesses(self.x, problem.balance.weight, self.stored)
        self._take()

    def _take(self) -> None:
        """Take account of changes of positions and stiffness."""
        self.bars.take()
        self._diagonal = None

    def put(self, problem: StepProblem, bars: np.ndarray) -> None:
        """Linearise at the predictor, with the stiffness (2, b) of bars by ``Bars.state_stiffness``. Collective."""
        self.update(problem, np.zeros_like(problem.u))
        self.stored[:] = bars
        self._take()

    def make_definite(self) -> None:
        """Drop negative eigenvalues of the bars' stiffness, due to compression or softening laws."""
        square, (c, g) = self.model.bars.lengths(self.x) ** 2, self.stored
        axial = np.maximum(c * square + g, 0.0)
        np.maximum(g, 0.0, out=g)
        np.divide(axial - g, square, out=c, where=square > 0.0)
        self._take()

    @cached_property
    def extension(self) -> Extension:
        """The operator with rows and columns of the identity for active unknowns."""
        return Extension(self)

    @property
    def vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """The vector (3 owned,) that :meth:`apply` reads and may change, and the one that it writes."""
        owned = self.mesh.n_owned
        return self._u[:owned].reshape(-1), self._out[:owned].reshape(-1)

    def times(self, given: np.ndarray, out: np.ndarray) -> None:
        """Compute ``out`` = H ``given``, both (owned, 3) and contiguous. Collective."""
        self._u[: len(given)] = given
        self.apply()
        out[:] = self._out[: len(given)]

    def apply(self, free: bool = False) -> None:
        """Apply H to the owned rows of :attr:`_u`, and write those of :attr:`_out`. Collective.

        Parameters
        ----------
        free : prescribed components of the vector are zero, and those of the product are not needed
        """
        problem, owned = self.problem, self.mesh.n_owned
        u, out = self._u, self._out
        supports = self.model.supports
        held = None
        if supports.any and not free:
            held = problem.scale * supports.get(u)
            supports.clear(u[:owned])
        problem.transform.forward(u)
        self.mesh.update_ghosts(u)
        inertia, bars = self.model.inertia, self.model.bars
        alpha, eta = problem.balance.alpha, problem.balance.eta
        self.bars.times(self._none if inertia.consistent else problem.nodal, u, out)
        if inertia.consistent:
            inertia.add_consistent(alpha, eta, u, out)
        elif inertia.redistribution is not None:
            inertia.redistribution.add_times(alpha, u, out)
        for family in bars.families:
            family.add_product(problem.balance.weight, u, out)
        problem.transform.linear(self._left, u, out)
        if held is not None:
            supports.put(out, held)

    @property
    def masks(self) -> bool:
        """Whether prescribed components are unknowns of their own, so that :meth:`apply` may leave them out."""
        return self.problem.transform.identity and self.model.supports.inclined is None

    def diagonal(self) -> np.ndarray:
        """Return the diagonal of H (owned, 3), which stays the same until the next linearisation; read-only."""
        if self._diagonal is not None:
            return self._diagonal
        problem, supports = self.problem, self.model.supports
        blocks = self.blocks()
        diagonal = blocks[:, [0, 3, 5]]
        if not problem.transform.identity:
            problem.transform.diagonal(self._left, lambda nodes: full_blocks(blocks[nodes]), diagonal)
        diagonal[supports.fixed] = problem.scale
        if supports.inclined is not None:
            at, free = supports.inclined.nodes, supports.inclined.free
            full = free @ full_blocks(blocks[at]) @ free + problem.scale * (np.eye(3) - free)
            diagonal[at] = np.einsum("mii->mi", full)
        self._diagonal = diagonal
        return diagonal

    def blocks(self) -> np.ndarray:
        """Return the blocks on the diagonal of H (owned, 6): xx, xy, xz, yy, yz, zz; without supports and transform."""
        blocks = np.zeros((self.mesh.n_local, 6))
        add_blocks(self.mesh.bars, self.x, self.stored, blocks)
        blocks = blocks[: self.mesh.n_owned]
        for nodes, extra in self._additions():
            blocks[nodes] += extra.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        nodal = self._nodal()
        for axis in (0, 3, 5):
            blocks[:, axis] += nodal
        return blocks

    def _nodal(self) -> np.ndarray:
        """Return what inertia adds to the diagonal (owned,)."""
        problem, inertia = self.problem, self.model.inertia
        if not inertia.consistent:
            return problem.nodal
        nodal = 2.0 / 3.0 * problem.nodal  # the diagonal of the bars' consistent mass is two thirds of the lumped one
        if inertia.points.any:
            nodal += inertia.points.nodal(problem.balance.alpha, problem.balance.eta) / 3.0
        return nodal

    def _additions(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return owned nodes (k,) and what they add to their blocks on the diagonal (k, 3, 3), besides bars and
        inertia: springs, and masses that contact has moved."""
        balance, springs, moved = self.problem.balance, self.model.bars.springs, self.model.inertia.redistribution
        found = [] if springs is None else [(springs.nodes, balance.weight * springs.stiffness)]
        return found if moved is None else [*found, (moved.touched, balance.alpha * moved.tensors)]

    def extra_blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Return owned nodes (k,), ascending, and the sum of what springs and moved masses add to their blocks on the
        diagonal (k, 3, 3)."""
        parts = self._additions()
        nodes = np.unique(np.concatenate([np.empty(0, np.int64), *(nodes for nodes, _ in parts)]))
        total = np.zeros((len(nodes), 3, 3))
        for some, extra in parts:
            total[np.searchsorted(nodes, some)] += extra
        return nodes, total

    def couple(self, rows: RowCoordinates | None) -> None:
        """Do nothing: coordinates of rows are applied with the bars."""

    def destroy(self) -> None:
        """Free the PETSc matrices."""
        if "extension" in vars(self):
            self.extension.mat.destroy()
        self.mat.destroy()


def full_blocks(upper: np.ndarray) -> np.ndarray:
    """Return symmetric matrices (n, 3, 3) from xx, xy, xz, yy, yz, zz (n, 6)."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


# ---- conjugate gradients with the diagonal as preconditioner: a linear solver for PETSc with few passes over vectors


@inlined
def _advance_part(length, vectors, first, count, work):
    """Advance solution and residual; add the squares of the residual, and its products with that over the diagonal, to
    rows of a workspace."""
    p, q, inverse, x, r = vectors
    for i in range(count):
        k = np.uint64(first + i)
        x[k] += length * p[k]
        left = r[k] - length * q[k] if inverse[k] != 0.0 else 0.0
        r[k] = left
        work[i] += left * left
        work[CHUNK + i] += left * (inverse[k] * left)


@kernel
def advance(length, vectors):
    """Make a step of a length along p, with ``vectors`` (n,) p, q = A p, the inverse diagonal, solution and residual;
    return the square of the residual and its product with that over the diagonal. The residual is zero where the
    inverse is, which stands for unknowns that are held."""
    work = np.zeros(2 * CHUNK)
    for first in range(0, len(vectors[0]), CHUNK):
        _advance_part(length, vectors, first, min(CHUNK, len(vectors[0]) - first), work)
    return work[:CHUNK].sum(), work[CHUNK:].sum()


@kernel
def turn(share, inverse, r, p, u):
    """Write the next direction to p and u, from ``share`` of the last one and the residual r; all (n,)."""
    for i in range(len(p)):
        p[i] = inverse[i] * r[i] + share * p[i]
        u[i] = p[i]


@kernel
def product(p, q):
    """Return the scalar product of vectors (n,)."""
    work = np.zeros(CHUNK)
    for first in range(0, len(p), CHUNK):
        one, other = p[first : first + CHUNK], q[first : first + CHUNK]
        for i in range(len(one)):
            work[i] += one[i] * other[i]
    return work.sum()


class ConjugateGradients:
    """The method for a matrix-free Hessian or its restriction to inactive unknowns, as PETSc calls it.

    Results are those of PETSc's ``cg`` with ``jacobi`` up to rounding.
    """

    def __init__(self, hessian: MatrixFreeHessian) -> None:
        self.hessian = hessian
        self._p, self._inverse, self._x, self._r = np.zeros((4, 3 * hessian.mesh.n_owned))

    def solve(self, ksp: PETSc.KSP, b: PETSc.Vec, x: PETSc.Vec) -> None:
        """Solve A x = b from x = 0; called by PETSc. Collective."""
        hessian, kept = self.hessian, ksp.getOperators()[0].getPythonContext().kept
        u, q = hessian.vectors
        vectors = p, _, inverse, found, r = self._p, q, self._inverse, self._x, self._r
        chosen = slice(None) if kept is None else kept
        for vector in (inverse, r, found, p):
            vector.fill(0.0)
        r[chosen] = b.getArray(readonly=True)
        ones = x.duplicate()
        ones.set(1.0)
        ksp.getPC().apply(ones, x)
        ones.destroy()
        inverse[chosen] = x.getArray(readonly=True)
        supports, free = hessian.model.supports, hessian.masks
        if free and supports.any:
            found[:] = inverse * r
            inverse.reshape(-1, 3)[supports.fixed] = 0.0
            found[inverse != 0.0] = 0.0
        count, length, last, most = 0, 0.0, 1.0, ksp.getTolerances()[3]
        q.fill(0.0)
        while True:
            sums = np.array(advance(length, vectors))
            hessian.mesh.comm.Allreduce(MPI.IN_PLACE, sums)
            square, size = sums.tolist()
            norm = square**0.5
            ksp.setIterationNumber(count)
            ksp.setResidualNorm(norm)
            ksp.logConvergenceHistory(norm)
            ksp.monitor(count, norm)
            reason = ksp.callConvergenceTest(count, norm)
            if not reason and size < 0.0:
                reason = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC
            if not reason and count == most:
                reason = PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT
            if reason:
                break
            turn(size / last if count else 0.0, inverse, r, p, u)
            hessian.apply(free)
            along = hessian.mesh.comm.allreduce(product(p, q))
            if along <= 0.0:
                reason = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
                break
            length, last = size / along, size
            count += 1
        ksp.setConvergedReason(reason)
        x.setArray(found[chosen])


def pass_less_often(ksp: PETSc.KSP, hessian: object) -> None:
    """Replace PETSc's method by :class:`ConjugateGradients` where that does the same; other Hessians have a matrix."""
    usual = ksp.getNormType() == PETSc.KSP.NormType.UNPRECONDITIONED
    if isinstance(hessian, MatrixFreeHessian) and usual and ksp.getType() == "cg" and ksp.getPC().getType() == "jacobi":
        ksp.setType("python")
        ksp.setPythonContext(ConjugateGradients(hessian))
