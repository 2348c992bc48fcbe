"""Rows over several nodes, r(x) >= 0, from any source, and the explicit solution of small problems with them.

With J the rows' gradients and K the nodes' stiffnesses, the positions nearest to free ones x_f with rows linearised at
x are x_f + K^-1 J^T f, where

    0 <= f   complementary to   r(x) + J (x_f + K^-1 J^T f - x) >= 0.

Repeated until x is the solution, this keeps the rows themselves. Gradients are those of the solution, or those of the
places where the forces of the balance act, which may be other ones. Rows that share nodes make one problem, a *group*;
planes of walls that stop the same nodes are rows of it. Each group is repeated on its own account, so that it does not
matter which other groups a rank has. All ranks that own a node of a group have it, and solve the same problem.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..errors import SimulationFailure
from ..tolerances import FREE_PART
from .row_layout import RowLayout
from .row_loops import add_forces, advance_groups, broken_groups, gather_rows, linearise
from .row_solution import solve_row_groups

__all__ = ["Planes", "Rows"]

_ITERATIONS = 100  # linearisations of a problem

Planes = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Walls at nodes: place of each node among the planes (n,), -1 for none; normals (m, w, 3), and distances (m, w) [m] at
the free positions, infinite for no concern."""


class Rows(RowLayout):
    """The rows of all sources that this rank has, and what they are at positions of their nodes."""

    def _each(self, rows: np.ndarray | None, method: str, *arrays: np.ndarray) -> list[np.ndarray]:
        """Return the results of a method of each source for arrays (n, 3), for some rows, ascending, or all."""
        found = []
        for source, at, first in zip(self.sources, self._at, self._first, strict=False):
            if rows is not None:
                begin, end = np.searchsorted(rows, (first, first + len(at)))
                some = rows[begin:end] - first
                if end - begin < len(at):
                    source, at = source.of(source.nodes[some], source.data[some]), at[some]
            found.append(getattr(source, method)(*(_of_rows(at, array) for array in arrays)))
        return found

    def values(self, x: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Rows (r,) [m] at positions (n, 3); of some rows, ascending, if they are given, as below."""
        return _joined(self._each(rows, "values", x))

    def gradients(self, x: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Gradients (r, k, 3) at positions (n, 3), zero behind the last node of a row."""
        width, parts = self.ends.shape[1], self._each(rows, "gradients", x)
        for s, part in enumerate(parts):
            if part.shape[1] < width:
                parts[s] = np.concatenate([part, np.zeros((len(part), width - part.shape[1], 3))], axis=1)
        return _joined(parts)

    def drift(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Second derivatives (r,) by time of rows whose nodes at (n, 3) move straight on with v (n, 3) [m/s2]."""
        return np.concatenate(self._each(None, "drift", x, v))

    def along(self, jacobian: np.ndarray, y: np.ndarray) -> np.ndarray:
        """J y (r,) of gradients (r, k, 3) and vectors (n, 3)."""
        vectors = np.where(self.ends[:, :, None] < 0, 0.0, y[self.ends])
        total = np.zeros(len(vectors))
        for products in np.einsum("rki,rki->kr", jacobian, vectors):
            total += products
        return total

    def forces(self, jacobian: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return J^T f (n, 3) [N] for the forces (r,) of the rows [N]."""
        total = np.zeros((len(self.numbers), 3))
        add_forces(self.ends, jacobian, force, total)
        return total

    def usable(self, jacobian: np.ndarray) -> np.ndarray:
        """Return (r,) bool: rows with free components, which can be satisfied."""
        return self.along(jacobian**2, self.free) > FREE_PART

    def solve(
        self, jacobian: np.ndarray, values: np.ndarray, stiffness: np.ndarray, planes: Planes, tolerance: float
    ) -> np.ndarray:
        """Forces (r,) [N] of the rows.

        Parameters
        ----------
        jacobian, values : (r, k, 3) gradients, (r,) rows at the free positions; infinite for rows that do not apply
        stiffness : (n,) force for a displacement of a node [N/m]
        planes : see :data:`Planes`
        tolerance : rows broken by no more count as kept [m]

        Raises
        ------
        SimulationFailure
            On ranks that have such rows: nothing keeps all of them.
        """
        place, _, gaps = planes
        near = place >= 0
        near[near] = (gaps[place[near]] < -tolerance).any(axis=1)
        nowhere, force = np.zeros((len(self.numbers), 3)), np.zeros(len(values))
        groups, tolerances = self._broken(values, nowhere, near, tolerance)
        self._solve(groups, jacobian, values, stiffness, planes, tolerances, force, np.empty_like(nowhere))
        return force

    def _broken(
        self, values: np.ndarray, x: np.ndarray, near: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        groups = len(self.starts) - 1
        chosen, tolerances = np.empty(groups, dtype=bool), np.empty(groups)
        arrays = self.starts, self.members, self.node_starts, self.nodes
        if not broken_groups(*arrays, values, x, near, tolerance, chosen, tolerances):
            return np.empty(0, dtype=np.int64), tolerances
        return np.flatnonzero(chosen), tolerances

    def _solve(
        self,
        groups: np.ndarray,
        jacobian: np.ndarray,
        values: np.ndarray,
        stiffness: np.ndarray,
        planes: Planes,
        tolerances: np.ndarray,
        force: np.ndarray,
        moves: np.ndarray,
    ) -> None:
        arrays = self.starts, self.members, self.node_starts, self.nodes, self.ends
        given = jacobian, values, stiffness, self.free, planes, tolerances
        infeasible = solve_row_groups(groups, *arrays, *given, force, moves)
        if infeasible >= 0:
            raise SimulationFailure(
                f"no positions of nodes {self._shown(infeasible)} satisfy their constraints, walls and supports"
            )

    def _shown(self, group: int) -> str:
        nodes = self.nodes[self.node_starts[group] : self.node_starts[group + 1]]
        return ", ".join(str(number) for number in self.numbers[nodes][:6])

    def project(
        self,
        x: np.ndarray,
        tolerance: float,
        near: np.ndarray,
        given: Callable[[], tuple[np.ndarray, np.ndarray | None, Planes]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return forces (r,) [N] that satisfy the rows, and the gradients (r, k, 3) along which they act.

        Parameters
        ----------
        x : (n, 3) positions without rows [m]
        tolerance : [m]
        near : (n,) bool, nodes that may be beyond walls; (0,) for none
        given : asked where groups are to be solved; gives the stiffness (n,) of the nodes [N/m], places (n, 3) where
            the forces act, None: at the solution, and planes

        Raises
        ------
        SimulationFailure
            On ranks that have such rows.
        """
        values = self.values(x)
        force, jacobian = np.zeros(len(values)), np.zeros((*self.ends.shape, 3))
        groups, tolerances = self._broken(values, x, near, tolerance)
        if len(groups) == 0:
            return force, jacobian
        stiffness, start, planes = given()
        at, moves = x.copy(), np.empty_like(x)
        chosen = np.zeros(len(self.starts) - 1, dtype=bool)
        rows = None
        for _ in range(_ITERATIONS):
            chosen[:] = False
            chosen[groups] = True
            fewer = np.flatnonzero(chosen[self.group_of_row])
            if rows is None or start is None:
                jacobian[fewer] = self.gradients(at if start is None else start, fewer)
            if rows is not None:
                linearise(fewer, self.ends, jacobian, self.free, x, at, self.values(at, fewer), values)
            rows = fewer
            self._solve(groups, jacobian, values, stiffness, planes, tolerances, force, moves)
            settled = np.empty(len(groups), dtype=bool)
            advance_groups(groups, self.node_starts, self.nodes, x, moves, at, tolerances, settled)
            groups = groups[~settled]
            if len(groups) == 0:
                return force, jacobian
        raise SimulationFailure(
            f"the positions of nodes {self._shown(int(groups[0]))} on their constraints did not converge in "
            f"{_ITERATIONS} iterations; reduce time.step"
        )


def _of_rows(at: np.ndarray, array: np.ndarray) -> np.ndarray:
    """Vectors (r, k, 3) of rows with nodes ``at`` (r, k), from those of nodes (n, 3); rows are next to each other in
    memory, so that sums and differences over their nodes and components are as fast as they can be."""
    vectors = np.empty((at.shape[1], 3, len(at)))
    gather_rows(at, array, vectors)
    return vectors.transpose(2, 0, 1)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.ascontiguousarray(parts[0]) if len(parts) == 1 else np.concatenate(parts)
