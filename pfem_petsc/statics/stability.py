"""Eigenvalues of the tangent stiffness: whether an equilibrium is a minimum of the potential; motions that are free."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import NotConverged
from ..solvers.linear import basis_by_peaks, has_mumps
from ..solvers.matrix import HessianMatrix
from .equilibrium import problem_at_rest

if TYPE_CHECKING:
    from ..contact.node_walls import WallForces
    from ..integrators.base import State
    from ..solvers.lagged import LaggedPreconditioner
    from ..solvers.matrix_free import MatrixFreeHessian
    from ..stepping.model import Model


DENSE = 450
"""Unknowns up to which all eigenvalues are computed: in 0.03 s."""
LARGEST = 30_000
"""Unknowns up to which PETSc's own factorisation is used, and checks that are not asked for are made."""
LARGEST_WITH_MUMPS = 400_000
"""Unknowns up to which MUMPS factorises the stiffness: of an octet block in 20 s, with 4 GB."""
_RIGID_MOTION = 1e-10  # of the largest nodal stiffness: eigenvalues down to minus this are zero, those of free motions
_RIGID = 1e3  # of the largest nodal stiffness: what walls have along the normals of nodes that they push
_ITERATIONS = 500  # of conjugate gradients that look for a negative curvature, about those of a linear solve
_RTOL = 1e-6  # a mode of negative curvature cannot remain hidden while the residual of a random load falls this far
_NOISE = 1e-12  # of the largest nodal stiffness: curvatures down to minus this are rounding
_SWEEPS = 6  # of inverse iteration; where its result matters, the eigenvalue is far nearer to zero than the next
_PREFIX = "pfem_inertia_"


class Spectrum(NamedTuple):
    """Number of negative eigenvalues, and the magnitude of the eigenvalue nearest to zero [N/m]."""

    negatives: int
    nearest: float


def stiffest(model: Model) -> float:
    """Return the largest stiffness of a node [N/m]. Collective."""
    return model.comm.allreduce(float(model.nodal_stiffness.max(initial=0.0)), op=MPI.MAX)


class Stability:
    """Looks at the stiffness that a matrix holds. Methods are collective.

    Parameters
    ----------
    model : Model
    matrix : HessianMatrix that is filled before each look; None for one of its own
    largest : number of unknowns up to which it looks; default: what can be factorised

    Attributes
    ----------
    matrix : None if it cannot look and has none of its own
    refusal : why it cannot look, None where it can
    """

    def __init__(self, model: Model, matrix: HessianMatrix | None = None, largest: int | None = None) -> None:
        self.model, self.mesh, self.comm, self._supports = model, model.mesh, model.comm, model.supports
        unknowns = 3 * self.mesh.n_nodes
        self.dense = unknowns <= DENSE
        self._mumps = not self.dense and has_mumps()
        self._factor: PETSc.PC | None = None
        most = LARGEST_WITH_MUMPS if self._mumps or self.dense else LARGEST
        most = most if largest is None else min(most, largest)
        self.refusal: str | None = None
        if unknowns > most:
            why = ", and this PETSc does not have MUMPS" if most == LARGEST and largest is None else ""
            self.refusal = f"the model has {unknowns:,} unknowns, more than {most:,}{why}"
        elif self.comm.size > 1 and not self._mumps and not self.dense:
            self.refusal = "on several ranks it requires MUMPS, which this PETSc does not have"
        self._owns = matrix is None and self.refusal is None
        self.matrix = HessianMatrix(self.mesh, self._supports) if self._owns else matrix

    def look(self) -> Spectrum:
        """Count at the stiffness that the matrix holds now."""
        if self.dense:
            values, _ = self._eigen()
            return Spectrum(int((values < 0.0).sum()), float(np.abs(values).min(initial=np.inf)))
        self._factorise()
        negatives = int(self._factor.getFactorMatrix().getInertia()[0])
        return Spectrum(negatives, abs(float(self._near(1)[0][0])))

    def modes(self, count: int) -> list[np.ndarray]:
        """Modes (owned, 3) of the ``count`` eigenvalues nearest to zero, of unit 2-norm.

        Of eigenvalues that are the same any combination is a mode. These are the projections of single components on
        them: first of the component that has the largest, of these the first in the mesh; then of the next within what
        is left. So they do not depend on the ranks.
        """
        return self.combined(self.nearest(count)[1])

    def nearest(self, count: int, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues (n,) nearest to zero [N/m], and modes (n, owned, 3), ``count`` of them or all that there are.

        ``shift`` [N/m] is what a factorisation needs where the stiffness is singular.
        """
        if self.dense:
            return self._eigen_near(count)
        if shift:
            self.matrix.mat.shift(shift)
        self._factorise()
        unknowns = 3 * self.mesh.n_nodes - self.comm.allreduce(self._supports.number)
        values, vectors = self._near(min(count, unknowns))
        return values - shift, vectors

    def combined(self, vectors: np.ndarray) -> list[np.ndarray]:
        """Combinations of modes (n, owned, 3) that do not depend on which modes they are made of, see :meth:`modes`."""
        rows = basis_by_peaks(self.comm, self.mesh.node_ids[: self.mesh.n_owned], vectors)
        return [np.einsum("k,knc->nc", row, vectors) for row in rows]

    def falling(self, x: np.ndarray, walls: WallForces, time: float, bars: np.ndarray | None = None) -> int:
        """Number of directions in which the potential falls at positions (local, 3), without those that walls prevent.

        It is -1 where the stiffness cannot be factorised.

        ``walls`` says which nodes walls push, ``time`` where the walls are; ``bars`` (2, b) is their stiffness if not
        the tangent, see ``Bars.stiffnesses``. Collective.
        """
        nodes, blocks = self._held(walls, time)
        model, matrix, scale = self.model, self.matrix, stiffest(self.model)

        def add(values: np.ndarray) -> None:
            matrix.add_lumped(np.full(model.mesh.n_owned, _RIGID_MOTION * scale), values)
            none = model.inertia.coefficients(0.0, 0.0)
            model.bars.tangents(x, 1.0, none, matrix.pattern, values, stored=bars)
            matrix.pattern.add_blocks(nodes, _RIGID * scale * blocks, values)
            matrix.constrain(scale, values)

        matrix.fill(add)
        try:
            return self.look().negatives
        except PETSc.Error:
            return -1

    def _held(self, walls: WallForces, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (k,) that walls hold, and the projections (k, 3, 3) on their directions, summed."""
        contact = self.model.contact
        blocks = np.zeros((self.model.mesh.n_owned, 3, 3))
        if len(walls.nodes):
            poses = contact.motion.poses(time)
            normals, _ = contact.planes(walls.touching, walls.places, poses, nodes=walls.nodes)
            blocks[walls.nodes] += np.einsum("mw,mwi,mwj->mij", walls.touching.astype(float), normals, normals)
        blocks[held_nodes(self.model, walls)] += np.eye(3)
        nodes = np.flatnonzero(blocks.any(axis=(1, 2)))
        return nodes, blocks[nodes]

    def destroy(self) -> None:
        """Free the PETSc objects."""
        if self._factor is not None:
            self._factor.destroy()
        if self._owns:
            self.matrix.destroy()

    def _eigen(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and vectors (components, eigenvalues) of the free components, in mesh order."""
        owned, n_nodes = self.mesh.n_owned, self.mesh.n_nodes
        pointers, columns, values = self.matrix.mat.getValuesCSR()
        rows = np.zeros((3 * owned, 3 * n_nodes))
        rows[np.repeat(np.arange(3 * owned), np.diff(pointers)), columns] = values
        parts = self.comm.allgather((self.mesh.node_ids[:owned], self._supports.fixed, rows))
        ids, fixed, whole = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.argsort(ids)
        self._free = np.flatnonzero(~fixed[order].ravel())
        at = (3 * order[:, None] + np.arange(3)).ravel()[self._free]
        return np.linalg.eigh(whole[np.ix_(at, at)])

    def _eigen_near(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        values, vectors = self._eigen()
        near = np.argsort(np.abs(values), kind="stable")[:count]
        whole = np.zeros((3 * self.mesh.n_nodes, len(near)))
        whole[self._free] = vectors[:, near]
        return values[near], whole.T.reshape(len(near), -1, 3)[:, self.mesh.node_ids[: self.mesh.n_owned]]

    def _factorise(self) -> None:
        if self._factor is not None:
            self._factor.destroy()
        self._factor = PETSc.PC().create(self.comm)
        self._factor.setOptionsPrefix(_PREFIX)
        self._factor.setOperators(self.matrix.mat)
        self._factor.setType("cholesky")
        if self._mumps:
            self._factor.setFactorSolverType("mumps")
            options = PETSc.Options(_PREFIX)
            if not options.hasName("mat_mumps_icntl_24"):
                options["mat_mumps_icntl_24"] = 1  # detection of null pivots, without which there is no inertia
        self._factor.setFromOptions()
        self._factor.setUp()

    def _near(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues nearest to zero, and vectors (count, owned, 3), by inverse iteration with the factorisation."""
        ids = 3 * self.mesh.node_ids[: self.mesh.n_owned, None] + np.arange(3)
        block = np.stack([np.cos((k + 1.0) * (ids + 0.5) ** 1.5) for k in range(count)])
        for vectors in block:
            self._supports.clear(vectors)
        b, x = self.matrix.mat.createVecs()
        values = np.zeros(count)
        for _ in range(_SWEEPS):
            block = self._orthonormal(block)
            after = np.empty_like(block)
            for k in range(count):
                b.array[:] = block[k].ravel()
                self._factor.apply(b, x)
                after[k] = x.array.reshape(block[k].shape)
            small = self.comm.allreduce(np.einsum("inc,jnc->ij", block, after))
            inverse, turn = np.linalg.eigh(0.5 * (small + small.T))
            values = 1.0 / inverse
            block = np.einsum("ji,jnc->inc", turn, after)
        b.destroy()
        x.destroy()
        order = np.argsort(np.abs(values))
        return values[order], self._orthonormal(block[order])

    def _orthonormal(self, block: np.ndarray) -> np.ndarray:
        gram = self.comm.allreduce(np.einsum("inc,jnc->ij", block, block))
        scale = 1.0 / np.sqrt(np.diag(gram))
        lower = np.linalg.cholesky(gram * np.outer(scale, scale))
        return np.einsum("ij,jnc->inc", np.linalg.inv(lower), block * scale[:, None, None])


def held_nodes(model: Model, walls: WallForces) -> np.ndarray:
    """Return which owned nodes are taken as held in all directions.

    These are tied nodes, those that walls with friction or curved walls push, and those that links push: their forces
    resist a motion along the wall, or turn with the nodes. What is unstable with them held is unstable without.
    """
    contact, held = model.contact, np.zeros(model.mesh.n_owned, dtype=bool)
    special = ~contact.flat | (np.array(contact.static_friction) > 0.0)
    held[walls.nodes[walls.touching[:, special].any(axis=1)]] = True
    if contact.ties.any:
        held[contact.ties.nodes()[0]] = True
    held[model.links.pressed()] = True
    return held


def is_indefinite(
    model: Model,
    hessian: HessianMatrix | MatrixFreeHessian,
    lagged: LaggedPreconditioner | None,
    held: np.ndarray,
) -> bool:
    """Return whether conjugate gradients meet a negative curvature of an operator; without a factorisation.

    A curvature that is found is a proof. The load is random: that of the truss may be orthogonal to the mode.
    ``held`` (owned,) : nodes that do not move. Collective.
    """
    noise = _NOISE * stiffest(model)
    b, diagonal = hessian.mat.createVecs()
    z, p, w = b.duplicate(), b.duplicate(), b.duplicate()

    def clear(vector: PETSc.Vec) -> None:
        with vector as values:
            model.supports.clear(values.reshape(-1, 3))
            values.reshape(-1, 3)[held] = 0.0

    def precondition() -> float:
        if lagged is not None and lagged.is_set_up:
            lagged.inner.apply(b, z)
        else:
            z.pointwiseDivide(b, diagonal)
        clear(z)
        return b.dot(z)

    diagonal = hessian.mat.getDiagonal(diagonal)
    diagonal.array[:] = np.maximum(np.abs(diagonal.array), noise or 1.0)
    ids = 3 * model.mesh.node_ids[: model.mesh.n_owned, None] + np.arange(3)
    b.array[:] = np.cos((ids.ravel() + 0.5) ** 1.5)
    clear(b)
    start, before, found = b.norm(), 0.0, False
    for _ in range(_ITERATIONS):
        product = precondition()
        if not (product > 0.0 and b.norm() > _RTOL * start):
            break
        p.aypx(product / before if before else 0.0, z)
        hessian.mat.mult(p, w)
        clear(w)
        curvature, before = p.dot(w), product
        if curvature <= 0.0:
            found = curvature < -noise * p.dot(p)
            break
        b.axpy(-product / curvature, w)
    for vector in (b, diagonal, z, p, w):
        vector.destroy()
    return found


ZERO = 1e-11
"""Of the largest stiffness of a node: eigenvalues below are zero. Near limit points they are 1e-6 and more."""
_MOTIONS = 8  # motions that are looked at
_TOLD = 3
_NAMED = 4  # nodes besides the one that moves most
SUPPORTS = "Add supports or bars that prevent them"
YIELDING = (
    ". Bars yield there, and without hardening nothing resists more load: it is at its limit or beyond. Reduce the "
    "load, or give the material hardening"
)
"""What is said of free motions, and where unloading bars would resist them."""
_MOVES = 0.3  # of the largest displacement of a motion, above which a node is named


def names_motions(model: Model) -> bool:
    """Whether motions are looked at: in models without walls and links, of at most 30,000 unknowns."""
    return not model.touches and 3 * model.mesh.n_nodes <= LARGEST


def free_motions(model: Model, state: State) -> str:
    """What to add to a message about a stiffness that may be singular; empty where no motion is free. Collective.

    Models for which :func:`names_motions` is False get no answer.
    """
    if not names_motions(model):
        return ""
    stability, zero, free = Stability(model), ZERO * stiffest(model), []

    def found() -> list[np.ndarray]:
        values, motions = stability.nearest(_MOTIONS, 0.1 * zero)
        return stability.combined(motions[: int((np.abs(values) < zero).sum())])

    try:
        if stability.refusal is None:
            problem = problem_at_rest(model, state, state.external)
            stability.matrix.update(problem, np.zeros_like(state.position))
            free = found()
            if free and model.bars.kept_names:
                stability.matrix.put(problem, model.bars.state_stiffness(state.x))
                if not found():
                    return YIELDING
    except (NotConverged, np.linalg.LinAlgError):
        free = []
    finally:
        stability.destroy()
    return _text(model, state, free)


def _text(model: Model, state: State, free: list[np.ndarray]) -> str:
    """Rigid-body motions first, then mechanisms."""
    if not free:
        return ""
    rigid = _rigid(model, state, free)
    many = f"{len(free)}{' or more' * (len(free) == _MOTIONS)}"
    text = f". The stiffness leaves {many} motion{'s' * (len(free) > 1)} free"
    if rigid == len(free):
        text += ", of the truss as a rigid body"
    elif rigid:
        text += f", {rigid} of them of the truss as a rigid body"
    told = "; ".join(_nodes(model, motion) for motion in free[:_TOLD])
    return f"{text}: {told}. {SUPPORTS}"


def _rigid(model: Model, state: State, free: list[np.ndarray]) -> int:
    """How many rigid-body motions are combinations of free ones. Collective."""
    x = state.position
    centre = model.comm.allreduce(x.sum(axis=0)) / model.mesh.n_nodes
    arms = (x - centre) / model.length
    motions = [np.broadcast_to(axis, x.shape) for axis in np.eye(3)] + [np.cross(axis, arms) for axis in np.eye(3)]
    rigid = np.stack(motions)
    gram = model.comm.allreduce(np.einsum("inc,jnc->ij", rigid, rigid))
    values, vectors = np.linalg.eigh(gram)
    # a straight rod has five
    keep = values > 1e-12 * values[-1]
    basis = np.einsum("ij,inc->jnc", vectors[:, keep] / np.sqrt(values[keep]), rigid)
    shares = model.comm.allreduce(np.einsum("inc,jnc->ij", basis, np.stack(free)))
    return int((np.linalg.svd(shares, compute_uv=False) > 1.0 - 1e-6).sum())


def _nodes(model: Model, motion: np.ndarray) -> str:
    """The nodes that a motion moves most, and where to. Collective."""
    size = np.linalg.norm(motion, axis=1)
    largest = max(model.comm.allgather(float(size.max(initial=0.0))))
    at = np.flatnonzero(size > _MOVES * largest)
    ids = model.mesh.node_ids[at]
    # the node that moves most, and the lowest ones of those that are named; a motion may move all nodes
    most = at[np.lexsort((ids, -size[at].round(9)))][:1]
    mine = [(-float(size[k].round(9)), int(model.mesh.node_ids[k]), motion[k] / size[k]) for k in most]
    moved = sorted((entry[:2], entry[2]) for part in model.comm.allgather(mine) for entry in part)
    (_, first), direction = moved[0]
    lowest = sorted(node for part in model.comm.allgather(np.sort(ids)[: _NAMED + 1].tolist()) for node in part)
    others = [node for node in lowest if node != first][:_NAMED]
    more = model.comm.allreduce(len(at)) - 1 - len(others)
    way = "(" + ", ".join(f"{part:.2g}" for part in direction.round(3) + 0.0) + ")"
    text = f"node {first} along {way}"
    if others:
        text += f", with node{'s' * (len(others) > 1)} " + ", ".join(map(str, others))
    return text + (f" and {more} more" if more else "")
