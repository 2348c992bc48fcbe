"""The balance of one step as a function of the position increment, and its Hessian as a PETSc matrix with a fixed
pattern, filled by the loops over bars."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.compiled import kernel
from ..mechanics.elements import BlockPattern, MatrixRows, add_tangents

if TYPE_CHECKING:
    from ..contact.transform import RowCoordinates, Transform
    from ..integrators.base import Balance, State
    from ..mechanics.bars import Bars
    from ..mechanics.mass import Inertia
    from ..mechanics.supports import Supports
    from ..mesh.distribution import DistributedMesh
    from ..stepping.model import Model


@kernel
def turn_blocks(ptr, local_columns, place, left, right, values):
    """Multiply the rows of nodes by matrices ``left`` (m, 3, 3), and their columns by ``right``, from the right.

    ``ptr``, ``local_columns``, ``values``: of a :class:`~pfem_petsc.mechanics.elements.BlockPattern`; ``place``
    (local,): of a node among the m, -1 for others.
    """
    block = np.zeros((3, 3))
    for row in range(len(ptr) - 1):
        width = 3 * (ptr[row + 1] - ptr[row])
        r = place[row]
        for k in range(ptr[row], ptr[row + 1]):
            c = place[local_columns[k]]
            if r < 0 and c < 0:
                continue
            at = 6 * ptr[row] + 3 * k
            for i in range(3):
                for j in range(3):
                    block[i, j] = values[at + i * width + j]
            if r >= 0:
                for j in range(3):
                    x, y, z = block[0, j], block[1, j], block[2, j]
                    for i in range(3):
                        block[i, j] = left[r, i, 0] * x + left[r, i, 1] * y + left[r, i, 2] * z
            if c >= 0:
                for i in range(3):
                    x, y, z = block[i, 0], block[i, 1], block[i, 2]
                    for j in range(3):
                        block[i, j] = x * right[c, 0, j] + y * right[c, 1, j] + z * right[c, 2, j]
            for i in range(3):
                for j in range(3):
                    values[at + i * width + j] = block[i, j]


@kernel
def _add_lumped(ptr, diagonal, inertia, values):
    for row in range(len(diagonal)):
        width = 3 * (ptr[row + 1] - ptr[row])
        at = 6 * ptr[row] + 3 * diagonal[row]
        for i in range(3):
            values[at + i * (width + 1)] += inertia[row]


class HessianMatrix:
    """Assembled Hessian of the owned rows; one interface to the two ways of setting values in a fixed PETSc pattern.

    ``supports`` are those that :meth:`constrain` takes into account; with ``grows`` the pattern can grow, as where bars
    touch. ``fill(callback)`` zeroes the values, lets the callback add to them, and passes them to PETSc.

    Attributes
    ----------
    mat : PETSc matrix
    bounded : the matrix of steps with bounds: ``mat``, or M B^-T mat B^-1 with coordinates of rows
    """

    def __init__(
        self, mesh: DistributedMesh, supports: Supports | None = None, symmetric: bool = True, grows: bool = False
    ) -> None:
        self.mesh, self._grows = mesh, grows
        local, total = 3 * mesh.n_owned, 3 * mesh.n_nodes
        self.mat = PETSc.Mat().create(comm=mesh.comm)
        self.mat.setSizes(((local, total), (local, total)), bsize=3)
        self.mat.setType(PETSc.Mat.Type.AIJ)
        # setPreallocationCOO is available in petsc4py since PETSc 3.19; it sets values without index searches
        self._by_coordinates = hasattr(self.mat, "setPreallocationCOO")
        self._touching: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # owned nodes, keys, blocks
        self._coupled, self._problem = np.empty(0, dtype=np.int64), None
        self._allocate()
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self.bounded = self.mat
        self._rows: RowCoordinates | None = None
        # of these: B^-1, B^-T mat B^-1, then M and the product of both, if rows rub, and a copy, if the pattern grows
        self._made: list[PETSc.Mat] = []
        self._symmetric = symmetric
        self._held = None if supports is None or not supports.any else supports.spans()  # projections of owned nodes
        if self._held is not None:
            self._projection = self._project(self._held)

    def _allocate(self) -> None:
        """Give the matrix the pattern of bars, and of the nodes of bars that touch."""
        self.pattern = BlockPattern(self.mesh, self._coupled)
        self.__dict__.pop("local_columns", None)
        pointers, columns = self.pattern.scalar_rows()
        self.values = np.zeros(len(columns), dtype=np.float64)
        if self._by_coordinates:
            first, local = 3 * self.mesh.first_node, 3 * self.mesh.n_owned
            rows = np.repeat(first + np.arange(local, dtype=PETSc.IntType), np.diff(pointers))
            self.mat.setPreallocationCOO(rows, columns)
        else:
            self._pointers, self._columns = pointers, columns
            self.mat.setPreallocationCSR((pointers, columns))

    def _couple_bars(self, problem: StepProblem) -> None:
        """Take what bars that touch add at the positions of a problem; the pattern grows as long as the problem is the
        same. Collective."""
        touch = problem.model.self_contact
        if touch is None or not problem.balance.weight:
            return
        nodes, columns, blocks = touch.linearise(problem.x, problem.balance, problem.transform.turns())
        keys = self.pattern.keys_of(nodes, columns)
        coupled = np.unique(keys if problem is not self._problem else np.append(self._coupled, keys))
        self._touching, self._problem = (nodes, keys, blocks), problem
        if self.mesh.comm.allreduce(not np.array_equal(coupled, self._coupled), op=MPI.LOR):
            self._coupled = coupled
            self._allocate()
            if self._rows is not None:
                self._multiply()

    @cached_property
    def local_columns(self) -> np.ndarray:
        """Local node index (int32) of each block's column, computed when supports or oblique walls first need it."""
        mesh, columns = self.mesh, self.pattern.columns
        local = (columns - mesh.first_node).astype(np.int64)
        outside = (local < 0) | (local >= mesh.n_owned)
        order = np.argsort(mesh.ghost_numbers, kind="stable")
        found = np.searchsorted(mesh.ghost_numbers[order], columns[outside])
        # blocks of nodes that are not even ghosts are those of bars that touch, which come later: zero until then
        local[outside] = mesh.n_owned + order[np.minimum(found, len(order) - 1)] if len(order) else 0
        return local.astype(np.int32)

    def fill(self, add: Callable[[np.ndarray], None]) -> PETSc.Mat:
        """Assemble the matrix; ``add(values)`` adds the Hessian of the owned rows to the zeroed values."""
        self.values[:] = 0.0
        add(self.values)
        if self._by_coordinates:
            self.mat.setValuesCOO(self.values, PETSc.InsertMode.INSERT_VALUES)
        else:
            self.mat.setValuesCSR(self._pointers, self._columns, self.values)
            self.mat.assemble()
        return self.mat

    def couple(self, rows: RowCoordinates | None) -> None:
        """Set the coordinates of rows for steps with bounds, instead of those set before. Collective."""
        self._free_made()
        self._rows = rows
        if rows is not None:
            self._multiply()
            self.bounded.setOption(PETSc.Mat.Option.SYMMETRIC, self._symmetric and rows.relative is None)

    def _multiply(self) -> None:
        """Make the matrices of the coordinates of rows, with the pattern of ``mat``. Collective."""
        copy = self._made.pop() if self._grows and self._made else None  # solvers keep it
        self._free_made()
        inverse = self._rows.matrix()
        self.fill(lambda values: None)
        self._made = [inverse, self.mat.ptap(inverse)]
        if self._rows.relative is not None:
            maps = block_diagonal(self.mesh)
            self._made += [maps, maps.matMult(self._made[1])]
        if copy is not None:
            copy.setPreallocationCSR(self._made[-1].getValuesCSR())
        elif self._grows:
            copy = self._made[-1].duplicate()
        self._made += [copy] if self._grows else []
        self.bounded = self._made[-1]

    def _turn(self, transform: Transform, values: np.ndarray) -> None:
        """Transform the values to the coordinates of frames of nodes without rows."""
        turns = transform.turns()
        if turns is not None:
            if transform.relative is None:
                self.pattern.add_blocks(transform.sliding.nodes, transform.sliding.stiffness, values)
            turn_blocks(self.pattern.ptr, self.local_columns, *turns, values)

    def assemble(self, problem: StepProblem) -> PETSc.Mat:
        """Assemble the Hessian of a problem at its positions, ghosts included, in coordinates of frames; return it.
        Collective."""
        self._couple_bars(problem)
        return self.fill(lambda values: self.add(problem, values))

    def update(self, problem: StepProblem, w: np.ndarray) -> None:
        """Assemble the Hessian of a problem at ``w``. Collective."""
        problem.place(problem.increment(w))
        self.assemble(problem)
        if problem.transform.bounded:
            self._change_coordinates(problem.transform)

    def put(self, problem: StepProblem, bars: np.ndarray) -> None:
        """Assemble at the predictor of a problem, with the stiffness (2, b) of ``Bars.state_stiffness``. Collective."""
        problem.place(np.zeros_like(problem.u))
        self.fill(lambda values: self.add(problem, values, bars))

    def add(self, problem: StepProblem, values: np.ndarray, stored: np.ndarray | None = None) -> None:
        """Add dg/dw of a problem at its positions, ghosts included, without the coordinates of rows. Collective.

        ``stored`` (2, b) : stiffness of the bars instead of the tangent one, see ``Bars.stiffnesses``
        """
        inertia, bars, balance = problem.model.inertia, problem.model.bars, problem.balance
        if not inertia.consistent:
            self.add_lumped(problem.nodal, values)
            if inertia.redistribution is not None:
                moved = inertia.redistribution
                self.pattern.add_blocks(moved.touched, balance.alpha * moved.tensors, values)
        elif inertia.points.any:
            self.add_lumped(inertia.points.nodal(balance.alpha, balance.eta), values)
        coefficients = inertia.coefficients(balance.alpha, balance.eta)
        if balance.weight or inertia.consistent:
            start = problem.state.x if balance.discrete_gradient else None
            bars.tangents(problem.x, balance.weight, coefficients, self.pattern, values, start, stored)
        self._turn(problem.transform, values)
        self.constrain(problem.scale, values)
        if problem is self._problem and self._touching is not None:
            nodes, keys, blocks = self._touching
            self.pattern.add_blocks(nodes, blocks, values, keys)

    def _change_coordinates(self, transform: Transform) -> None:
        """Compute ``bounded`` from ``mat``. Collective."""
        if self._rows is None:
            return
        inverse, product, *maps = self._made
        result = product
        if transform.rows is None:
            self.mat.copy(self.bounded, PETSc.Mat.Structure.DIFFERENT)
            return
        if self._rows.varies:
            self._rows.refresh(inverse)
        self.mat.ptap(inverse, product)
        if self._rows.relative is not None and transform.slides:
            result = maps[1]
            self._let_slide(transform, product, maps[0], result)
        if result is not self.bounded:
            result.copy(self.bounded, PETSc.Mat.Structure.DIFFERENT)

    def _let_slide(self, transform: Transform, product: PETSc.Mat, maps: PETSc.Mat, result: PETSc.Mat) -> None:
        """Compute the result from B^-T mat B^-1: add the turning of slips, and multiply by M. Collective."""
        nodes = transform.sliding.nodes
        turning, left = transform.slip_blocks(), transform.left()
        if self._held is not None:  # whose rows and columns remain those of the identity
            held = np.einsum("kii->ki", self._held[nodes]) > 0.0
            turning[held[:, :, None] | held[:, None, :]] = 0.0
            left = np.where(held[:, :, None], np.eye(3), left)
        add_diagonal(product, self.mesh, nodes, turning, PETSc.InsertMode.ADD_VALUES)
        every = np.tile(np.eye(3), (self.mesh.n_owned, 1, 1))
        every[nodes] = left
        add_diagonal(maps, self.mesh, np.arange(self.mesh.n_owned), every, PETSc.InsertMode.INSERT_VALUES)
        maps.matMult(product, result)

    def fill_held(self, problem: StepProblem, held: np.ndarray, stored: np.ndarray | None) -> PETSc.Mat:
        """Assemble as :meth:`add`, in the coordinates of the problem; rows and columns of components (owned, 3) with
        nonzero ``held`` are replaced by the scale of the problem on the diagonal. Collective."""
        active = np.eye(3) * (held != 0.0)[:, :, None]
        projection = self._project(active) if problem.transform.rows is None else None

        def add(values: np.ndarray) -> None:
            self.add(problem, values, stored)
            if projection is not None:
                self._hold(projection, problem.scale, values)

        self.fill(add)
        if problem.transform.rows is None:
            return self.mat
        self._change_coordinates(problem.transform)
        rows = np.flatnonzero(held) + 3 * self.mesh.first_node
        self.bounded.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
        self.bounded.zeroRowsColumns(rows.astype(PETSc.IntType), problem.scale)
        return self.bounded

    def add_lumped(self, inertia: np.ndarray, values: np.ndarray) -> None:
        """Add a nodal inertia (owned,) to the diagonal."""
        _add_lumped(self.pattern.ptr, self.pattern.diagonal, inertia, values)

    def add_mass(self, bars: Bars, inertia: Inertia, values: np.ndarray) -> None:
        """Add the consistent mass of bars and the masses of points."""
        bars.tangents(self.mesh.points, 0.0, inertia.coefficients(1.0, 0.0), self.pattern, values)
        if inertia.points.any:
            self.add_lumped(inertia.points.mass, values)

    def add_bars(self, x: np.ndarray, stored: np.ndarray, values: np.ndarray) -> None:
        """Add the stiffness (2, b) of bars between positions (local, 3), see ``Bars.stiffnesses``."""
        rows = MatrixRows(self.pattern.ptr, self.pattern.slots, values, self.mesh.bars)
        add_tangents(x, stored, np.zeros(stored.shape[1]), rows)

    def constrain(self, scale: float, values: np.ndarray) -> None:
        """Replace rows and columns of prescribed components by ``scale`` on the diagonal."""
        if self._held is not None:
            self._hold(self._projection, scale, values)

    def _project(self, held: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the owned nodes (k,) with directions that are held, projections (owned, 3, 3), those (k, 3, 3) on the
        others, and both as :func:`turn_blocks` takes them. Collective."""
        nodes = np.flatnonzero(held.any(axis=(1, 2)))
        free = np.eye(3) - held[nodes]
        return nodes, free, *self.mesh.with_ghosts(nodes, free)

    def _hold(self, projection: tuple[np.ndarray, ...], scale: float, values: np.ndarray) -> None:
        """Replace rows and columns along the directions of :meth:`_project` by ``scale`` on the diagonal."""
        nodes, free, place, every = projection
        if not len(every):
            return
        turn_blocks(self.pattern.ptr, self.local_columns, place, every, every, values)
        self.pattern.add_blocks(nodes, scale * (np.eye(3) - free), values)

    def _free_made(self) -> None:
        for matrix in reversed(self._made):
            matrix.destroy()
        self._made.clear()
        self.bounded = self.mat

    def destroy(self) -> None:
        """Free the PETSc matrices."""
        self._free_made()
        self.mat.destroy()


def block_diagonal(mesh: DistributedMesh) -> PETSc.Mat:
    """Return an identity with entries for the diagonal blocks of all nodes; the caller destroys it. Collective."""
    size, first = (3 * mesh.n_owned, 3 * mesh.n_nodes), 3 * mesh.first_node
    columns = first + np.repeat(np.arange(3 * mesh.n_owned).reshape(-1, 1, 3), 3, axis=1).ravel()
    pointers = 3 * np.arange(3 * mesh.n_owned + 1)
    values = np.tile(np.eye(3), (mesh.n_owned, 1, 1)).ravel()
    rows = pointers.astype(PETSc.IntType), columns.astype(PETSc.IntType), values
    return PETSc.Mat().createAIJ((size, size), bsize=3, csr=rows, comm=mesh.comm)


def add_diagonal(matrix: PETSc.Mat, mesh: DistributedMesh, nodes: np.ndarray, blocks: np.ndarray, how: int) -> None:
    """Set or add the diagonal blocks (m, 3, 3) of owned nodes (m,) in a matrix with entries for them. Collective."""
    for at, block in zip(3 * (mesh.first_node + nodes), np.ascontiguousarray(blocks), strict=True):
        rows = np.arange(at, at + 3, dtype=PETSc.IntType)
        matrix.setValues(rows, rows, block, how)
    matrix.assemble()


# ---- loops over the nodes of implicit steps; NumPy takes several times as long for rows of three


@kernel
def add_up(nodal, u, known, weight, f, g):
    """Write nodal u + known + weight f to ``g``; vectors (owned, 3)."""
    for i in range(len(g)):
        for c in range(3):
            g[i, c] = nodal[i] * u[i, c] + known[i, c] + weight * f[i, c]


@kernel
def largest_distance(one, other):
    """Return the largest distance of nodes between positions (n, 3); NaN if any is not a number."""
    largest = 0.0
    for i in range(len(one)):
        x, y, z = one[i, 0] - other[i, 0], one[i, 1] - other[i, 1], one[i, 2] - other[i, 2]
        square = x * x + y * y + z * z
        if not square <= largest:
            largest = square
            if square != square:
                break
    return np.sqrt(largest)


@kernel
def extend(before, after, differences, orders):
    """Replace first and second backward differences (n, 6) of vectors by those at ``after`` (n, 3), and the orders (n,)
    by those that would have predicted it best."""
    for i in range(len(after)):
        first = second = third = 0.0
        for c in range(3):
            one = after[i, c] - before[i, c]
            two = one - differences[i, c]
            three = two - differences[i, 3 + c]
            differences[i, c] = one
            differences[i, 3 + c] = two
            first += one * one
            second += two * two
            third += three * three
        order = 1 if second < first else 0
        if third < min(first, second):
            order = 2
        orders[i] = order


@kernel
def extrapolate(vectors, differences, orders, factor, out):
    """Write vectors (n, 3) expected next, by polynomials of the ``orders`` (n,), times a factor."""
    for i in range(len(out)):
        for c in range(3):
            value = vectors[i, c]
            if orders[i] > 0:
                value += differences[i, c]
            if orders[i] > 1:
                value += differences[i, 3 + c]
            out[i, c] = factor * value


class StepProblem:
    """Residual g(w) of one step, where w is the increment u from the predictor in transformed coordinates, u = T w.

    Friction is part of g (see :mod:`pfem_petsc.contact.frames`) and makes its derivative unsymmetric. Prescribed
    components have a zero residual and a unit row; the guess contains their values.

    Attributes
    ----------
    x : (local, 3) positions [m]
    u : (owned, 3) increment of the last evaluation [m]
    nodal : (owned,) diagonal of inertia and damping [N/m]
    scale : entry on the diagonal at prescribed components [N/m]
    target : (k,) prescribed components of u where some are along no axis: these are mixed into unknowns that linear
        solvers change, and components of w along them are ignored
    """

    def __init__(
        self,
        model: Model,
        state: State,
        balance: Balance,
        external: np.ndarray,
        transform: Transform,
    ) -> None:
        self.transform = transform
        self.model = model
        self.state = state
        self.balance = balance
        self.external = external
        mesh, inertia = model.mesh, model.inertia
        self.x = np.zeros((mesh.n_local, 3))
        self.f = np.zeros((mesh.n_local, 3))
        self.u = np.zeros((mesh.n_owned, 3))
        self._work = np.zeros((mesh.n_owned, 3))
        self._evaluated = np.full_like(self.x, np.nan)  # positions of the forces f
        self.nodal = balance.alpha * inertia.mass + balance.eta * inertia.damping
        self.scale = float((self.nodal if balance.alpha else model.nodal_stiffness).max(initial=0.0))
        # the part independent of u: M a_hat + C v_hat + (1 - w) f_n - f_ext
        known = -external
        if balance.a_hat is not None:
            known = known + inertia.mass_times(balance.a_hat, np.zeros_like(known))
        if inertia.damped and balance.v_hat is not None:
            known = known + inertia.damping_times(balance.v_hat, np.zeros_like(known))
        if balance.weight < 1.0:
            known = known + (1.0 - balance.weight) * state.f[: mesh.n_owned]
        self.known = known
        supports = model.supports
        self.target = None if supports.inclined is None else supports.lacking(balance.predictor, balance.time)

    def increment(self, w: np.ndarray) -> np.ndarray:
        """Return u (owned, 3) for w. Collective."""
        self.u[:] = w
        self.transform.forward(self.u)
        if self.target is not None:
            self.model.supports.put(self.u, self.target)
        return self.u

    def coordinates(self, u: np.ndarray) -> np.ndarray:
        """Return w (owned, 3) for u. Collective."""
        w = u.copy()
        self.transform.inverse(w)
        return w

    def imbalance(self, u: np.ndarray, g: np.ndarray, evaluated: bool = False) -> None:
        """Write g = M a + C v + f_int - f_ext at u, in x, without supports and walls [N]. Collective.

        If bars were ``evaluated`` since temperatures, rest lengths or their history have changed, forces are not
        evaluated again at the same positions.
        """
        inertia, balance, weight = self.model.inertia, self.balance, self.balance.weight
        internal = self.state.f[: len(u)]
        if weight:
            self.place(u)
            known = evaluated and np.array_equal(self.x, self._evaluated)
            if evaluated and self.model.self_contact is not None:  # whose evaluation is collective
                known = self.model.comm.allreduce(known, op=MPI.LAND)
            if not known:
                self._evaluate()
            internal = self.f[: len(u)]
        if not inertia.consistent:
            add_up(self.nodal, u, self.known, weight, internal, g)
            if inertia.redistribution is not None:
                inertia.redistribution.add_times(balance.alpha, u, g)
            return
        g[:] = inertia.mass_times(balance.alpha * u, self._work)
        if inertia.damped and balance.eta:
            g += inertia.damping_times(balance.eta * u, self._work)
        g += self.known
        if weight:
            g += weight * internal

    def _evaluate(self) -> None:
        """Evaluate the internal forces at the positions."""
        if self.balance.discrete_gradient:
            self.model.bars.step_forces(self.state.x, self.x, self.f)
        else:
            self.model.bars.forces(self.x, self.f, commit=False)
        self._evaluated[:] = self.x

    def free_part(self, w: np.ndarray, end: np.ndarray) -> float:
        """Return the part of the way from w to ``end``, both (owned, 3), on which no bar passes another. Collective."""
        touch = self.model.self_contact
        if touch is None:
            return 1.0
        self.place(self.increment(w))
        start = self.x.copy()
        self.place(self.increment(end))
        return touch.free_part(start, self.x)

    def residual(self, w: np.ndarray, g: np.ndarray) -> None:
        """Write g(w) (owned, 3) [N]. Collective."""
        self.imbalance(self.increment(w), g)
        self.transform.residual(self.balance.predictor, self.u, g)
        self.model.supports.clear(g)

    def place(self, u: np.ndarray) -> None:
        """Set the positions of all local nodes to the predictor plus u. Collective."""
        np.add(self.balance.predictor, u, out=self.x[: self.model.mesh.n_owned])
        self.model.mesh.update_ghosts(self.x)
