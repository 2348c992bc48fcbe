"""Natural frequencies, or linear buckling factors, of the state of a model, with unique vectors on any number of
ranks; and the state of a case without an analysis, whose modes are wanted.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from ..errors import InputError, SimulationFailure
from ..integrators.base import Balance, NoParameters, Scheme, State
from ..output.units import TIME
from ..solvers.linear import basis_by_peaks, first_largest, without
from ..stepping.plan import Plan, refuse_motion
from ..stepping.stepper import Solution, Stepper
from .pencil import (
    SOLVERS,
    BarStiffness,
    Dense,
    Holds,
    Lanczos,
    Pencil,
    Slepc,
    StateMatrices,
    buckling_bars,
    join,
    linear_forces,
)

if TYPE_CHECKING:
    from ..case.tables import Modes
    from ..stepping.model import Model


class _Nothing(Scheme):
    """A scheme that makes no steps."""

    inertial = False

    def balance(self, state: State, h: float) -> Balance:
        raise NotImplementedError


class InitialState(Stepper):
    """The initial state, which is also the last one: forces, loads and supports at time zero, without steps.
    Construction is collective.

    Raises
    ------
    InputError
        On all ranks, if the case has initial velocities.
    """

    def __init__(self, model: Model) -> None:
        refuse_motion(model.case, "a case with [modes] alone")
        super().__init__(model, _Nothing(NoParameters()), 0.0)
        self.plan = Plan(self.scheme, TIME, {"analysis": "none: modes of the initial state"}, steps=0)

    def start(self) -> None:
        """Evaluate the state. Collective."""
        self.start_without_motion()
        self.totals_at_start = self.totals()

    def solve(self, balance: Balance) -> Solution:
        """There is no balance."""
        raise NotImplementedError


_EQUAL = 1e-9  # relative difference below which eigenvalues count as equal
_SEEN = 1e-3  # smallest projection of a unit rigid motion on a space that is used


class Basis:
    """Makes vectors unique, given each rank's components.

    Parameters
    ----------
    comm : MPI.Comm
    numbers : (owned,) mesh numbers of the nodes
    points : (owned, 3) [m]
    mass : (owned,) lumped mass [kg], the weight of the projections
    """

    def __init__(self, comm: MPI.Comm, numbers: np.ndarray, points: np.ndarray, mass: np.ndarray) -> None:
        self._comm, self._mass = comm, mass
        self._numbers = numbers
        sums = comm.allreduce(np.append(mass @ points, mass.sum()))
        arms = points - sums[:3] / sums[3]
        translations = np.broadcast_to(np.eye(3)[:, None], (3, len(numbers), 3))
        rotations = np.stack([np.cross(axis, arms) for axis in np.eye(3)])
        self._motions = np.concatenate([translations, rotations])

    def unique(self, values: np.ndarray, shapes: np.ndarray, zero: float) -> np.ndarray:
        """Make B-orthonormal shapes (k, owned, 3) of ascending eigenvalues (k,) unique. Collective.

        ``zero`` : difference of eigenvalues within rounding.
        """
        shapes, first = shapes.copy(), 0
        while first < len(values):
            last = first + 1
            while last < len(values) and same(values[last - 1], values[last], zero):
                last += 1
            if last > first + 1:
                turn = self._basis(shapes[first:last])
                shapes[first:last] = np.einsum("ij,jnc->inc", turn, shapes[first:last])
            first = last
        return shapes * self._signs(shapes)[:, None, None]

    def _basis(self, space: np.ndarray) -> np.ndarray:
        """Return the orthogonal matrix whose rows are the new basis in terms of the given one. Collective."""
        weighted = space * self._mass[:, None]
        mine = np.concatenate(
            [np.einsum("knc,mnc->mk", weighted, self._motions), [np.einsum("knc,knc->k", weighted, space)]]
        )
        lengths = np.einsum("mnc,n,mnc->m", self._motions, self._mass, self._motions)
        total = self._comm.allreduce(np.append(mine.ravel(), lengths))
        mine, lengths = total[: mine.size].reshape(mine.shape), total[mine.size :]
        largest = np.sqrt(mine[-1].max())
        rows: list[np.ndarray] = []
        for motion, length in zip(mine[:-1], lengths, strict=True):
            rest = without(motion, rows)
            if len(rows) < len(space) and np.linalg.norm(rest) > _SEEN * np.sqrt(length) * largest:
                rows.append(rest / np.linalg.norm(rest))
        return np.array(basis_by_peaks(self._comm, self._numbers, space, rows))

    def _signs(self, shapes: np.ndarray) -> np.ndarray:
        signs = np.zeros(len(shapes))
        for k in range(len(shapes)):
            shape = shapes[k].ravel()
            at = first_largest(self._comm, self._numbers, np.abs(shape))
            signs[k] = np.sign(shape[at]) if at >= 0 else 0.0
        self._comm.Allreduce(MPI.IN_PLACE, signs)
        return np.where(signs < 0.0, -1.0, 1.0)


def same(one: float, other: float, zero: float) -> bool:
    """Return whether two eigenvalues are equal up to rounding."""
    if not np.isfinite(one) or not np.isfinite(other):
        return one == other
    return abs(other - one) <= max(zero, _EQUAL * max(abs(one), abs(other)))


DENSE_UP_TO = 600
"""Maximum number of components for which LAPACK computes all eigenvalues, faster than an iteration."""
DENSE_AT_MOST = 6_000
"""Maximum number of components of dense matrices: about 2 minutes and 1 GB."""
_PART = 0.2  # of all modes, from which on computing all of them takes less time than iterations
GATHERED_AT_MOST = 300_000
"""Maximum number of components for which matrices are gathered on one rank for SciPy."""


@cache
def has_slepc() -> bool:
    """Return whether slepc4py is installed and can be loaded; PETSc must be initialised before."""
    try:
        importlib.import_module("slepc4py.SLEPc")
    except ImportError:
        return False
    return True


def describe_modes(model: Model) -> dict[str, str]:
    """Return label and text of the modes that a case requests, empty if none. Collective.

    Raises
    ------
    InputError
        On all ranks, if no suitable library is installed.
    """
    case = model.case
    if case.modes is None:
        return {}
    free = 3 * model.mesh.n_nodes - model.comm.allreduce(model.supports.number)
    name = choose(case.modes, free, case.source)
    what = "natural vibrations" if case.modes.kind == "vibration" else "buckling modes"
    state = "linear forces about the start" if case.modes.linear else "the state at the end"
    if case.modes.linear and case.time is not None:
        raise InputError(
            f"{case.source}: modes.linear = true: the forces of a motion ([time]) are not those of a linear solve; "
            "use [static], or no analysis"
        )
    mass = f", {case.modes.mass or case.mass} mass" if case.modes.kind == "vibration" else ""
    return {"modes": f"{min(case.modes.count, free)} {what} of {state}{mass}, solver {name}"}


def choose(settings: Modes, free: int, source: str) -> str:
    """Return the name of the solver for a number of free components.

    Parameters
    ----------
    settings : table ``[modes]``
    free : number of free components
    source : file of the case, for the message

    Raises
    ------
    InputError
        If no installed library can solve a problem of this size.
    """
    asked, most = settings.solver, min(settings.count, free)
    if asked == "auto":
        if free <= DENSE_UP_TO or (free <= DENSE_AT_MOST and most > _PART * free):
            return "dense"
        if has_slepc() or free <= GATHERED_AT_MOST:
            return "slepc" if has_slepc() else "scipy"
        raise InputError(
            f"{source}: modes: {free:,} free components need slepc4py, which is not installed (Debian, Ubuntu: "
            "python3-slepc4py-real and the version of PETSc; scripts/setup.sh installs it); SciPy serves up to "
            f"{GATHERED_AT_MOST:,} of them"
        )
    limit = {"dense": DENSE_AT_MOST, "scipy": GATHERED_AT_MOST}.get(asked, free)
    if free > limit:
        raise InputError(
            f'{source}: modes.solver = "{asked}": {free:,} free components exceed its limit of {limit:,}; use "slepc" '
            'or "auto"'
        )
    if asked == "slepc" and not has_slepc():
        raise InputError(f'{source}: modes.solver = "slepc": slepc4py is not installed; install it, or use "auto"')
    return asked


_SHIFT = 1e-3  # distance of the shift below zero, relative to the squared frequency wave speed / length
_ROUNDING = 1e-13  # relative to the largest eigenvalue: smaller ones are zero
_MORE = 4  # additional modes, so that repeated ones are complete
_AGAIN = 3  # modes requested in a search for missed ones
_SEARCHES = 40
_NOTHING = 1e-10  # relative to the largest theta: smaller ones belong to directions in which A is zero
_DEPENDENT = 1e-10  # eigenvalue of a Gram matrix of unit vectors below which they are dependent
_NONLINEAR = 0.01  # relative difference of axial forces from those of a linear solve, beyond which users are told
_NO_LOAD = 1e-12  # relative to the axial stiffness: smaller axial forces over the length count as zero


@dataclass(frozen=True)
class Found:
    """Modes of a state.

    Attributes
    ----------
    kind : "vibration" or "buckling"
    eigenvalues : (k,) squares of the circular frequencies [1/s2], or load factors; ascending
    shapes : (k, owned, 3): of vibrations [kg^-1/2], with x^T M x = 1; of buckling with a largest component of 1
    negative : number of negative eigenvalues of vibrations
    solver : description
    at_walls : number of nodes in contact with walls
    forces : (2, local bars) axial forces of which the second are multiplied by the factors of buckling [N]
    linear : whether these are of a linear solve
    doubts : what makes the modes doubtful
    """

    kind: str
    eigenvalues: np.ndarray
    shapes: np.ndarray
    negative: int
    solver: str
    at_walls: int
    forces: np.ndarray | None = None
    linear: bool = False
    doubts: tuple[str, ...] = ()

    @property
    def values(self) -> np.ndarray:
        """(k,) frequencies [Hz], for negative eigenvalues minus the growth rate over 2 pi; or load factors."""
        if self.kind == "buckling":
            return self.eigenvalues
        return np.sign(self.eigenvalues) * np.sqrt(np.abs(self.eigenvalues)) / (2.0 * np.pi)


def find_modes(model: Model, state: State, settings: Modes, consistent: bool) -> Found:
    """Compute the lowest modes of a state. Collective.

    Parameters
    ----------
    model : Model
    state : State, complete
    settings : table ``[modes]``
    consistent : whether the mass matrix is consistent

    Raises
    ------
    InputError, SimulationFailure
        On all ranks, if there is no solver, no free component, unsupported contact, or no axial force for buckling.
    """
    search = _Search(model, state, settings)
    matrices = StateMatrices(model, search.holds, consistent)
    return search.buckling(matrices) if settings.kind == "buckling" else search.vibration(matrices)


class _Search:
    """The search for the modes of a state. Methods are collective."""

    def __init__(self, model: Model, state: State, settings: Modes) -> None:
        self.model, self.state, self.holds, self.linear = model, state, Holds(model, state), settings.linear
        self.source = model.case.source
        self.free = 3 * model.mesh.n_nodes - self.holds.number
        if self.free == 0:
            raise SimulationFailure(f"{self.source}: modes: supports and walls hold all nodes: nothing can move")
        self.count = min(settings.count, self.free)
        self._make = SOLVERS[choose(settings, self.free, self.source)]

    def vibration(self, matrices: StateMatrices) -> Found:
        """Return the natural vibrations: theta = 1/(lambda - shift) of M x = theta (K - shift M) x."""
        model, holds = self.model, self.holds
        bars = BarStiffness.of(model, self.state.x, model.bars.state_stiffness(self.state.x))
        low, high = matrices.bounds(bars, holds.curvature)
        top = 2.0 * high + abs(low)
        stiffness = matrices.stiffness(bars, top * matrices.inertia.mass, holds.curvature)
        mass = matrices.mass()
        zero = _ROUNDING * top
        small = max(_SHIFT * (model.wave_speed / model.length) ** 2, 10.0 * zero)
        # a shift near zero if that is below all eigenvalues, else a rigorous lower bound
        shifts = [-small] if low == 0.0 else [-small, low - small]
        for shift in shifts:
            pencil = Pencil(mass, join(stiffness, -shift, mass), self.state.position, holds.held)
            solver = self._make(pencil)
            if solver.definite or shift == shifts[-1]:
                break
            solver.destroy()
            pencil.b.destroy()
        try:
            theta, shapes = self._lowest(pencil, solver, lambda theta: shift + 1.0 / theta, zero)
        finally:
            solver.destroy()
            pencil.destroy()
            stiffness.destroy()
        values = shift + 1.0 / theta
        values[np.abs(values) <= zero] = 0.0
        shapes /= np.sqrt(theta)[:, None, None]
        return Found("vibration", values, shapes, int((values < 0.0).sum()), solver.name, holds.at_walls)

    def buckling(self, matrices: StateMatrices) -> Found:
        """Return the buckling modes: theta = 1/lambda of -Kg x = theta K0 x."""
        comm, holds, doubts = self.model.comm, self.holds, []
        if self.linear:
            static = self.model.case.static
            end = 1.0 if static is None else getattr(static.parameters, "end", None) or 1.0
            found = linear_forces(self.model, matrices, 0.0, float(end), loaded=static is not None)
            material, forces = found.stiffness, np.stack([found.start, found.change])
            geometric = material._replace(along=np.zeros_like(found.change), across=found.change / material.lengths)
        else:
            material, geometric = buckling_bars(self.model, self.state.x)
            forces = np.stack([geometric.along, geometric.across * self.model.bars.mesh_lengths])
            doubts = self._nonlinear(matrices, forces[1])
        largest = material.largest(comm)
        if geometric.largest(comm) <= _NO_LOAD * largest:
            remedy = "give the case loads, or temperatures, rest lengths or motions that change up to load factor 1"
            if not self.linear:
                remedy = "give the case loads, and modes.linear = true or an analysis that loads the truss ([static])"
            raise SimulationFailure(
                f'{self.source}: modes: kind = "buckling" multiplies axial forces by the factors, and there are none: '
                f"{remedy}"
            )
        a = matrices.stiffness(geometric._replace(across=-geometric.across), 0.0, springs=False)
        pencil = Pencil(a, matrices.stiffness(material, largest), self.state.position, holds.held)
        solver = self._make(pencil)
        try:
            if solver.definite is False:
                raise SimulationFailure(
                    f'{self.source}: modes: kind = "buckling": the unstressed truss is a mechanism or is not held: its '
                    "stiffness is singular, and no factor of the load is defined; brace and support it, or use "
                    'kind = "vibration", whose eigenvalues include the stresses of the state'
                )
            theta, shapes = self._lowest(pencil, solver, np.reciprocal, 0.0, _NOTHING)
        finally:
            solver.destroy()
            pencil.destroy()
        if not len(theta):
            raise SimulationFailure(
                f"{self.source}: modes: no positive factor of the axial forces makes the truss buckle: they put it in "
                "tension, or relieve it"
            )
        peaks = np.abs(shapes).max(axis=(1, 2), initial=0.0)
        comm.Allreduce(MPI.IN_PLACE, peaks, op=MPI.MAX)
        shapes /= peaks[:, None, None]
        return Found(
            "buckling", 1.0 / theta, shapes, 0, solver.name, holds.at_walls, forces, self.linear, tuple(doubts)
        )

    def _nonlinear(self, matrices: StateMatrices, force: np.ndarray) -> list[str]:
        """Return a text if the axial forces (b,) of a static state differ noticeably from those of a linear solve."""
        if self.model.case.static is None:
            return []
        try:
            found = linear_forces(self.model, matrices, 0.0, self.state.time, loaded=True)
        except SimulationFailure:
            return []
        linear = found.start + found.change
        sizes = np.array([np.abs(force - linear).max(initial=0.0), np.abs(linear).max(initial=0.0)])
        self.model.comm.Allreduce(MPI.IN_PLACE, sizes, op=MPI.MAX)
        if not sizes[0] > _NONLINEAR * sizes[1]:
            return []
        return [
            f"the axial forces of the state differ from those of a linear solve by up to {sizes[0]:.3g} N, "
            f"{100.0 * sizes[0] / sizes[1]:.2g} % of the largest of these: the buckling factors depend on the load of "
            "the state. Set modes.linear = true for the factors of linear forces, or load the truss less"
        ]

    def _lowest(
        self,
        pencil: Pencil,
        solver: Dense | Lanczos | Slepc,
        values_of: Callable[[np.ndarray], np.ndarray],
        zero: float,
        nothing: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the ``count`` largest theta (k,), and unique vectors (k, owned, 3), x^T B x = 1.

        An iteration may miss copies of a repeated eigenvalue, so searches are repeated in the complement of the vectors
        found, until one finds nothing new. ``values_of`` theta are eigenvalues, which up to ``zero`` count as zero, as
        does theta up to ``nothing`` of the largest.
        """
        model, holds, count = self.model, self.holds, self.count
        wanted = min(count + _MORE, self.free)
        theta, known = np.empty(0), np.empty((0, 3 * model.mesh.n_owned))
        for search in range(_SEARCHES):
            before = theta[:wanted]
            ask = min(max(wanted - len(known), _AGAIN), self.free - len(known))
            if ask > 0:
                found = solver.largest(ask, self._start(search), known)
                found = np.where(holds.held.ravel(), 0.0, found[:ask])
                theta, known = _ritz(model.comm, pencil, np.concatenate([known, found]))
                positive = theta > nothing * np.abs(theta).max(initial=0.0)
                theta, known = theta[positive], known[positive]
            now = theta[:wanted]
            if not (solver.finds_all or (len(now) == len(before) and np.allclose(now, before, rtol=1e-9, atol=0.0))):
                continue
            values = values_of(now)
            cut = len(now) == wanted < self.free and same(values[-1], values[min(count, wanted) - 1], zero)
            if not cut or wanted > count + 8 * _MORE:
                break
            wanted = min(wanted + 2 * _MORE, self.free)
        else:
            raise SimulationFailure(
                f"modes: after {_SEARCHES} searches more repeated eigenvalues are still found ({solver.name}); ask for "
                "fewer modes (modes.count)"
            )
        owned = model.mesh.n_owned
        shapes = holds.to_axes(known[: len(now)].reshape(len(now), owned, 3))
        basis = Basis(model.comm, model.mesh.node_ids[:owned], self.state.position, model.inertia.mass)
        return now[:count].copy(), basis.unique(values, shapes, zero)[:count]

    def _start(self, search: int) -> np.ndarray:
        """Return a start vector (3 owned,) that depends only on the mesh and the number of the search."""
        mesh = self.model.mesh
        numbers = mesh.node_ids[: mesh.n_owned].astype(np.float64)[:, None] * 3.0 + np.arange(3)
        start = np.sin(12.9898 * (numbers + 1.0) + 78.233 * (search + 1.0) + 0.37 * np.sqrt(numbers * (search + 2.0)))
        return self.holds.to_own(start[None])[0].ravel()


def _ritz(comm: MPI.Comm, pencil: Pencil, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return theta (k,), descending, and B-orthonormal vectors in the span of vectors (m, components). Collective."""
    a, b = _products(pencil.a, vectors), _products(pencil.b, vectors)
    grams = comm.allreduce(np.stack([vectors @ a.T, vectors @ b.T]))
    first, second = 0.5 * (grams + grams.transpose(0, 2, 1))
    norms = np.sqrt(np.diag(second))
    scale = np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > 0.0)
    first, second = first * np.outer(scale, scale), second * np.outer(scale, scale)
    sizes, axes = np.linalg.eigh(second)
    kept = sizes > _DEPENDENT
    whitened = axes[:, kept] / np.sqrt(sizes[kept])
    reduced = whitened.T @ first @ whitened
    theta, turn = np.linalg.eigh(0.5 * (reduced + reduced.T))
    return theta[::-1].copy(), (whitened @ turn[:, ::-1]).T * scale @ vectors


def _products(matrix: PETSc.Mat, vectors: np.ndarray) -> np.ndarray:
    x, y = matrix.createVecs()
    products = np.empty_like(vectors)
    for k, vector in enumerate(vectors):
        x.setArray(vector)
        matrix.mult(x, y)
        products[k] = y.getArray(readonly=True)
    x.destroy()
    y.destroy()
    return products


def weakest_member(model: Model, forces: np.ndarray) -> tuple[float, int] | None:
    """Return the smallest factor of the second of two axial forces (2, local bars) [N] at which their sum is Euler's
    load -pi^2 E I/(K L)^2 of a bar, and the number of that bar. Collective.

    L is the length in the mesh, and I, K are those of the section; bars whose section has no shape are left out. None
    if there are no such bars.

    """
    values = model.mesh.bar_ids, *forces, model.bars.euler_loads()
    ids, start, force, euler = (each[model.mesh.counted] for each in values)
    pressed = np.flatnonzero((force < 0.0) & (euler < np.inf))
    factors = (euler + start)[pressed] / -force[pressed]
    best = min(zip(factors.tolist(), ids[pressed].tolist(), strict=True), default=(np.inf, -1))
    factor, bar = min(model.comm.allgather(best))
    return (factor, bar) if bar >= 0 else None
