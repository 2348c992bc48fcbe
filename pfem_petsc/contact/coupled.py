"""Pairs of nodes that walls stop as well, or that share nodes, in explicit steps with lumped mass.

What is left of contact at such nodes is one small problem for each group of pairs that hang together: the positions
nearest to the free ones, with k |x - x_free|^2 as distance, that keep the group's pairs and its nodes' walls. With the
rows of N the gradients of these constraints, its multipliers solve

    0 <= lambda   complementary to   N K^-1 N^T lambda + (values at the free positions) >= 0,

found by the dual active-set method of Goldfarb and Idnani. All ranks know all nodes of pairs and solve the same
problems. Only the pairs' forces are taken from them: the projection onto walls, which follows, finds the walls' own.
"""

from __future__ import annotations

import numpy as np

from ..errors import SimulationFailure
from .projection import project

__all__ = ["CoupledPairs", "complementary"]

_THIN = 1e-12  # squared length of a constraint's free part below which supports alone decide


class CoupledPairs:
    """The pairs of a case, and who shares nodes with whom.

    Attributes
    ----------
    any : whether pairs share nodes, or walls stop some: else each pair is on its own
    here : (m,) owned nodes that are in pairs, ascending
    """

    def __init__(self, pairs, contact) -> None:
        self.pairs = pairs
        self.contact = contact
        ends = np.stack([pairs.first, pairs.second])
        self.numbers, first, self._of = np.unique(ends, return_index=True, return_inverse=True)
        self._of = self._of.reshape(ends.shape)
        n = len(self.numbers)
        self._free = pairs.free.reshape(-1, 3)[first]
        mine = pairs.mine.ravel()[first]
        self._mine, self.here = np.flatnonzero(mine), pairs.local.ravel()[first][mine]
        group = np.arange(n)
        while True:  # each node takes the lowest label of its pairs, until nothing changes
            lowest = np.minimum(group[self._of[0]], group[self._of[1]])
            before = group.copy()
            for end in self._of:
                np.minimum.at(group, end, lowest)
            if np.array_equal(group, before):
                break
        labels = group[self._of[0]]
        order = np.argsort(labels, kind="stable")
        self.groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(order) else []
        walled = np.zeros(n, dtype=np.int64)
        walled[self._mine] = contact.members[self.here].any(axis=1)
        self.walled = pairs.sum(walled) > 0
        self.shared = np.bincount(self._of.ravel(), minlength=n) > 1
        self.any = bool(self.walled.any() or self.shared.any())

    def planes(self, x: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Planes (m, w, 3), (m, w) of the walls at :attr:`here` for positions (m, 3) at a time [s]."""
        shifts = self.contact.motion.shifts(time)
        return self.contact.planes(self.contact.concerned(self.here, x, shifts), x, shifts)

    def forces(
        self,
        x: np.ndarray,
        stiffness: np.ndarray,
        least: np.ndarray,
        planes: tuple[np.ndarray, np.ndarray],
        tolerance: float,
    ) -> np.ndarray:
        """Forces (p,) of the pairs [N]. Collective.

        Parameters
        ----------
        x : (m, 3) free positions of the nodes :attr:`here` [m]
        stiffness : (m,) force for a displacement of these [N/m]
        least : (p,) bounds on the distances, -inf for pairs that are no concern [m]
        planes : of the walls at :attr:`here`, (m, w, 3) and (m, w), -inf where a wall is no concern
        tolerance : a constraint broken by no more counts as kept [m]

        Raises
        ------
        SimulationFailure
            On all ranks, where no position keeps all constraints.
        """
        walls = planes[1].shape[1]
        data = np.zeros((len(self.numbers), 4 + 4 * walls))
        data[self._mine, :3] = x
        data[self._mine, 3] = stiffness
        data[self._mine, 4 : 4 + 3 * walls] = planes[0].reshape(len(self.here), 3 * walls)
        # a sum cannot take infinities: no concern is written as a bound that no position breaks
        data[self._mine, 4 + 3 * walls :] = np.maximum(planes[1], -1e300)
        self.pairs.sum(data)
        free_x, k = np.ascontiguousarray(data[:, :3]), data[:, 3]
        normals = np.ascontiguousarray(data[:, 4 : 4 + 3 * walls]).reshape(len(data), walls, 3)
        offsets = np.where(data[:, 4 + 3 * walls :] <= -1e300, -np.inf, data[:, 4 + 3 * walls :])
        force = np.zeros(len(least))
        if walls:
            pushed = free_x.copy()
            project(pushed, self._free == 0.0, normals, offsets, tolerance, np.zeros(offsets.shape))
            short = self._short(pushed, least) > tolerance
        else:
            short = self._short(free_x, least) > tolerance
        for group in self.groups:
            if short[group].any():
                force[group] = self._solve(group, free_x, k, normals, offsets, least, tolerance)
        return force

    def _short(self, x: np.ndarray, least: np.ndarray) -> np.ndarray:
        return least - self.pairs.distances(x[self._of])

    def _solve(self, group, x, k, normals, offsets, least, tolerance) -> np.ndarray:
        """Forces of a group's pairs from the problem with its walls."""
        ends = self._of[:, group]
        nodes, at = np.unique(ends, return_inverse=True)
        at = at.reshape(ends.shape)
        kept = least[group] > -np.inf
        rows = np.zeros((len(group), len(nodes), 3))
        every = np.arange(len(group))
        rows[every, at[0]] -= self.pairs.normals[group]
        rows[every, at[1]] += self.pairs.normals[group]
        values = -self._short(x, least)[group]
        wall_node, wall = np.nonzero(offsets[nodes] > -np.inf)
        wall_rows = np.zeros((len(wall), len(nodes), 3))
        wall_rows[np.arange(len(wall)), wall_node] = normals[nodes[wall_node], wall]
        wall_values = np.einsum("ri,ri->r", normals[nodes[wall_node], wall], x[nodes[wall_node]])
        wall_values -= offsets[nodes[wall_node], wall]
        rows = np.concatenate([rows[kept], wall_rows]) * self._free[nodes]
        values = np.append(values[kept], wall_values)
        usable = (rows**2).sum(axis=(1, 2)) > _THIN
        flat = (rows[usable] / np.sqrt(k[nodes])[:, None]).reshape(int(usable.sum()), -1)
        multipliers = np.zeros(len(rows))
        found = complementary(flat @ flat.T, values[usable], tolerance)
        if found is None:
            shown = ", ".join(str(number) for number in self.numbers[nodes][:6])
            raise SimulationFailure(f"no positions of nodes {shown} satisfy their contact pairs, walls and supports")
        multipliers[usable] = found
        force = np.zeros(len(group))
        force[kept] = multipliers[: int(kept.sum())]
        return force


def complementary(matrix: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray | None:
    """0 <= z complementary to (matrix z + values) >= 0 for a symmetric matrix (n, n) without negative eigenvalues.

    By dual active sets, the most broken row first (D. Goldfarb, A. Idnani, Mathematical Programming 27, 1983). Rows
    broken by no more than the tolerance count as kept; None where there is no solution.
    """
    n = len(values)
    z = np.zeros(n)
    active: list[int] = []
    for _ in range(10 * n + 10):
        left = matrix @ z + values
        left[active] = 0.0
        row = int(np.argmin(left)) if n else -1
        if n == 0 or left[row] >= -tolerance:
            return z
        while True:
            # with the active rows kept, a unit of the new multiplier takes `lost` off theirs, and lifts its row
            lost = np.linalg.solve(matrix[np.ix_(active, active)], matrix[active, row]) if active else np.zeros(0)
            gain = matrix[row, row] - matrix[row, active] @ lost
            full = -left[row] / gain if gain > 1e-10 * matrix[row, row] else np.inf
            shares = np.array([z[j] / d if d > 0.0 else np.inf for j, d in zip(active, lost, strict=True)])
            part = float(shares.min(initial=np.inf))
            if min(full, part) == np.inf:
                return None
            step = min(full, part)
            z[active] -= step * lost
            z[row] += step
            if full <= part:
                active.append(row)
                break
            left[row] += step * max(gain, 0.0)
            z[active.pop(int(np.argmin(shares)))] = 0.0
            z[active] = np.maximum(z[active], 0.0)
        z[active] = np.maximum(np.linalg.solve(matrix[np.ix_(active, active)], -values[active]), 0.0)
    return None
