"""The linear problem of force densities, and its stepper: see :mod:`~pfem_petsc.statics.methods.force_density`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array

from ..columns import HEAD
from ..errors import InputError, SimulationFailure
from ..mechanics.elements import bar_lengths
from ..mechanics.motion import Table
from ..mechanics.rest_lengths import bar_of, prescribed, stretches
from ..parallel.agreement import agreed
from ..stepping.stepper import Solution
from .stepper import StaticStepper

if TYPE_CHECKING:
    from ..integrators.base import Balance
    from ..solvers.linear import LinearChoice
    from ..stepping.model import Model

_DIRECT_UP_TO = 200_000
"""Nodes up to which a factorisation is used; beyond, conjugate gradients with multigrid, if no density is negative."""


_DISSIPATED, _STRESSING = HEAD.first("numerical_dissipation"), HEAD.first("prestress_work")


class Prescribed:
    """What the bars of this rank are given.

    Attributes
    ----------
    density : (b,) force over length [N/m]; of other bars that of the last solve, from the mean of the given ones on
    force, length : (b,) force [N] and length [m], NaN of the others
    """

    def __init__(self, model: Model, time: float) -> None:
        case, bars = model.case, model.bars
        self.density, self.force, self.length = np.full((3, len(bars.ends)), np.nan)
        self.comm = model.comm
        outs = {"force_density": self.density, "target_length": self.length}
        for block in bars.blocks:
            section, part = case.section[block.section], slice(block.start, block.stop)
            key, where = section.prestressed, f"{case.source}: section.{block.section}"
            if key is None or key.startswith("rest_length"):
                raise InputError(
                    f'{where}: static.method = "force_density" needs a force_density [N/m], pretension [N], '
                    "prestress [Pa] or target_length [m] of each section, or a field of them"
                )
            kind, rows, factor = prescribed(bars, block, section, key, f"{where}.{key}")
            value = factor * float(Table(rows)(time)[0])
            outs.get(kind, self.force)[part] = value * block.area if kind == "prestress" else value

    def begin(self, lengths: np.ndarray) -> None:
        """Set the densities of bars with given forces or lengths (b,) [m]. Collective."""
        forced = ~np.isnan(self.force)
        self.density[forced] = self.force[forced] / np.maximum(lengths[forced], np.finfo(float).tiny)
        free, given = np.isnan(self.density), ~np.isnan(self.density)
        count, total = self.comm.allreduce(np.array([given.sum(), np.abs(self.density[given]).sum()]))
        self.density[free] = total / count if total else 1.0

    def follow(self, lengths: np.ndarray) -> float:
        """Change the densities for the lengths (b,) [m] of a form; return what lacks in it, relative to the largest
        given force, or to a given length. Collective."""
        forced, sized = ~np.isnan(self.force), ~np.isnan(self.length)
        force, ratio = self.force[forced], lengths[sized] / self.length[sized]
        lack = np.abs(self.density[forced] * lengths[forced] - force).max(initial=0.0)
        numbers = np.array([lack, np.abs(force).max(initial=0.0), np.abs(ratio - 1.0).max(initial=0.0)])
        self.comm.Allreduce(MPI.IN_PLACE, numbers, op=MPI.MAX)
        self.density[forced] = force / np.maximum(lengths[forced], np.finfo(float).tiny)
        self.density[sized] *= ratio
        return float(max(numbers[0] / numbers[1] if numbers[1] else 0.0, numbers[2]))


class ForceDensityStepper(StaticStepper):
    """Finds the form in one increment, and gives the bars the rest lengths with which they have their forces there.

    Attributes
    ----------
    solves : linear solves of the form
    """

    kept_numbers = (*StaticStepper.kept_numbers, "solves")
    finds_jumps = False

    def __init__(self, model: Model, choice: LinearChoice, parameters: Any) -> None:
        _check(model)
        super().__init__(model, choice, parameters)
        with agreed(model.comm):
            Prescribed(model, 0.0)  # refuses what is missing before the run
        self.parameters, self.guard, self.solves, self._found = parameters, None, 0, ""
        model.rest_lengths.varying = True  # the form changes them, which does work

    def obstacle(self) -> str:
        """See :class:`StaticStepper`: what moves freely is found by the solve. Collective."""
        return ""

    def settle(self) -> None:
        """See :class:`StaticStepper`; the form is in equilibrium to rounding."""

    def resume(self) -> None:
        """See :class:`~pfem_petsc.stepping.stepper.Stepper`. Collective."""
        super().resume()
        if self.state.step:
            self._keep_rest(self.model.bars.rest)

    def solve(self, balance: Balance) -> Solution:
        """Return the form as the solution of a balance. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks, if there is no form, or given forces are not reached.
        """
        model, state, owned = self.model, self.state, self.model.mesh.n_owned
        given = Prescribed(model, balance.time)
        x = state.x.copy()
        model.supports.place(x[:owned], model.supports.positions(balance.time))
        form = Form(model, state.external, x)
        self.solves = form.find(given, self.parameters.tolerance, self.parameters.max_iterations)
        self._stress(form.x, given)
        f = np.empty_like(form.x)
        model.bars.forces(form.x, f, commit=False)
        state.support = model.supports.part(f[:owned] - state.external)
        self._found = self._lengths()
        return Solution(form.x[:owned] - balance.predictor, f, model.contact.nothing, linear=self.solves)

    def _stress(self, x: np.ndarray, given: Prescribed) -> None:
        """Give the bars the rest lengths with which they have their forces at positions."""
        model, case = self.model, self.model.case
        length = np.empty(len(model.bars.ends))
        bar_lengths(x, model.bars.ends, length)
        force = np.where(np.isnan(given.force), given.density * length, given.force)
        rest = length.copy()
        with agreed(model.comm):
            try:
                for block in model.bars.blocks:
                    part, section = slice(block.start, block.stop), case.section[block.section]
                    most, least = force[part].max(), force[part].min()
                    where = f"{case.source}: section.{block.section}: forces of {least:g} to {most:g} N"
                    rest[part] /= stretches(block, bar_of(case, section), "pretension", force[part], where)
            except InputError as error:
                raise SimulationFailure(str(error)) from error
        self._keep_rest(rest)

    def _keep_rest(self, rest: np.ndarray) -> None:
        for block in self.model.bars.blocks:
            part = slice(block.start, block.stop)
            self.model.rest_lengths.take(part, rest[part].copy())

    def _account(self) -> None:
        """Update the ledger: what the bars have gained is the work of their prestress, whatever the way there."""
        ledger = self.ledger
        before = None if ledger is None else ledger.sums[_DISSIPATED]
        super()._account()
        if ledger is not None:
            ledger.sums[_STRESSING] -= ledger.sums[_DISSIPATED] - before
            ledger.sums[_DISSIPATED] = before

    def remarks(self) -> list[str]:
        """See :class:`StaticStepper`. Collective."""
        return [*([self._found] if self._found else []), *super().remarks()]

    def _lengths(self) -> str:
        """Return what to tell of unstressed lengths, and of the mass of the mesh if it is not theirs. Collective."""
        model = self.model
        counted = model.mesh.counted
        rest, made = model.bars.rest[counted], model.bars.mass_lengths[counted]
        total, mass = model.comm.allreduce(np.array([rest.sum(), made.sum()]))
        lows, highs = model.comm.allgather(rest.min(initial=np.inf)), model.comm.allgather(rest.max(initial=0.0))
        solves = f"{self.solves} linear solve{'s' * (self.solves > 1)}"
        return (
            f"form found by {solves}: unstressed lengths (field rest_length) "
            f"from {min(lows):.6g} to {max(highs):.6g} m, {total:.6g} m in all"
            + (f"; bars keep the mass of {mass:.6g} m in the mesh" if abs(mass - total) > 0.01 * total else "")
        )


class Form:
    """Positions of equilibrium for force densities. Construction is collective.

    Attributes
    ----------
    x : (local, 3) positions with ghosts [m]
    """

    def __init__(self, model: Model, external: np.ndarray, x: np.ndarray) -> None:
        self.model, self.external, self.x = model, external, x
        mesh = model.mesh
        numbers = np.concatenate([mesh.first_node + np.arange(mesh.n_owned), mesh.ghost_numbers])
        self._numbers = numbers
        self._near, self._far = np.concatenate([mesh.bars, mesh.bars[:, ::-1]]).T  # from either end of each bar

    def find(self, given: Prescribed, tolerance: float, most: int) -> int:
        """Find the form, and return the number of solves. Collective.

        Raises
        ------
        SimulationFailure
            On all ranks.
        """
        mesh, lengths = self.model.mesh, np.empty(len(self.model.mesh.bars))
        mesh.update_ghosts(self.x)
        bar_lengths(self.x, mesh.bars, lengths)
        given.begin(lengths)
        for count in range(1, most + 1):
            self._solve(given.density)
            bar_lengths(self.x, mesh.bars, lengths)
            used = given.density.copy()
            lack = given.follow(lengths)
            if lack <= tolerance:
                given.density = used
                return count
        raise SimulationFailure(
            f"form finding: given forces or lengths are missed by {lack:.3g} of them after {most} solves, "
            f"{tolerance:g} is allowed: increase static.max_iterations or static.tolerance if it is small; else no form"
            " may have them (a bar shrinks to a point; a chain is too short for its supports): give force densities"
        )

    def _solve(self, density: np.ndarray) -> None:
        """Move to the form of force densities (b,) [N/m]. Collective."""
        mesh, comm, fixed = self.model.mesh, self.model.comm, self.model.supports.fixed
        owned, held = mesh.n_owned, np.zeros((mesh.n_local, 3))
        held[:owned] = fixed
        mesh.update_ghosts(held)
        # bars to prescribed nodes pull with their positions
        right = np.where(fixed, self.x[:owned], self.external + self._pull(density, held * self.x))
        alike = comm.allreduce(bool((fixed == fixed[:, :1]).all()), op=MPI.LAND)
        # prescribed nodes at one hold all nodes at one, unless some hang on none
        ones = np.where(fixed, 1.0, self._pull(density, held))
        hung = True
        for axes in ((0, 1, 2),) if alike else ((0,), (1,), (2,)):
            solver = self._factorised(density, held[:, axes[0]])
            try:
                hung &= bool(np.all(np.abs(self._solved(solver, ones[:, axes[0]]) - 1.0) < _SOLVED))
                for axis in axes:
                    self.x[:owned, axis] = self._solved(solver, right[:, axis])
            finally:
                solver.destroy()
        if not comm.allreduce(hung, op=MPI.LAND):
            raise SimulationFailure(_SINGULAR)
        mesh.update_ghosts(self.x)

    def _pull(self, density: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the sums (owned, 3) over the bars of a node of their densities (b,) times values (local, 3) at their
        other ends."""
        mesh = self.model.mesh
        out = np.zeros((mesh.n_local, 3))
        np.add.at(out, self._near, np.tile(density, 2)[:, None] * values[self._far])
        return out[: mesh.n_owned]

    def _solved(self, solver: PETSc.KSP, right: np.ndarray) -> np.ndarray:
        """Return the solution (owned,) for a right side. Collective."""
        b = PETSc.Vec().createWithArray(right.copy(), comm=self.model.comm)
        x = b.duplicate()
        try:
            solver.solve(b, x)
            if solver.getConvergedReason() < 0 or not np.isfinite(x.norm()):
                raise SimulationFailure(_SINGULAR)
            return x.getArray().copy()
        except PETSc.Error as error:
            raise SimulationFailure(_SINGULAR) from error
        finally:
            b.destroy()
            x.destroy()

    def _factorised(self, density: np.ndarray, held: np.ndarray) -> PETSc.KSP:
        """Return the solver of a component that is prescribed at some nodes, 1 in ``held`` (local,). Collective."""
        mesh, comm = self.model.mesh, self.model.comm
        owned, first, free = mesh.n_owned, mesh.first_node, held == 0.0
        near, far, q = self._near, self._far, np.tile(density, 2)
        own = (near < owned) & free[near]
        both = own & free[far]
        diagonal = held[:owned] + np.bincount(near[own], weights=q[own], minlength=owned)
        rows = np.append(np.arange(owned), near[both])
        columns = np.append(first + np.arange(owned), self._numbers[far[both]])
        local = coo_array((np.append(diagonal, -q[both]), (rows, columns)), shape=(owned, mesh.n_nodes)).tocsr()
        matrix = PETSc.Mat().createAIJ(
            ((owned, mesh.n_nodes), (owned, mesh.n_nodes)),
            csr=(local.indptr.astype(PETSc.IntType), local.indices.astype(PETSc.IntType), local.data),
            comm=comm,
        )
        solver = PETSc.KSP().create(comm)
        solver.setOperators(matrix)
        positive = comm.allreduce(float(density.min(initial=np.inf)), op=MPI.MIN) > 0.0
        if mesh.n_nodes > _DIRECT_UP_TO and positive:
            solver.setType("cg")
            solver.getPC().setType("gamg")
            solver.setTolerances(rtol=1e-12, max_it=1000)
        else:
            # on every rank the whole, as MUMPS repeats to rounding only
            solver.setType("preonly")
            solver.getPC().setType("lu" if comm.size == 1 else "redundant")
        matrix.destroy()
        return solver


_SOLVED = 1e-4
"""Error of a known solution beyond which the matrix of force densities is taken for singular."""

_SINGULAR = (
    "form finding: these force densities have no form: bars connect some nodes with no support along an axis, tension "
    "and compression cancel, or bars with given forces shrink to points; add supports, or correct forces and densities"
)


def _check(model: Model) -> None:
    """Refuse what form finding does not have.

    Raises
    ------
    InputError
        On all ranks.
    """
    case = model.case
    given = {
        "wall": bool(case.wall),
        "contact_pair": bool(case.contact_pair),
        "constraint": bool(case.constraint),
        "spring": bool(case.spring),
        "dashpot": bool(case.dashpot),
        "temperature": bool(case.temperature),
        "remove": bool(case.remove),
    }
    there = [key for key, has in given.items() if has]
    if there:
        raise InputError(
            f'{case.source}: static.method = "force_density" finds forms of bars with supports and loads, and takes no '
            f"[[{there[0]}]]: give it in a later stage"
        )
    if model.supports.inclined is not None:
        raise InputError(
            f'{case.source}: support: static.method = "force_density" takes supports along the axes of the model alone'
        )
