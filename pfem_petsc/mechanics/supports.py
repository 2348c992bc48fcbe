"""Supports: prescribed components of node positions, fixed or moving."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .motion import Motion, motion_of

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..mesh.distribution import DistributedMesh

__all__ = ["Supports"]


class Supports:
    """Prescribed components on this rank.

    Attributes
    ----------
    fixed : (owned, 3) bool
    any : whether any component of the whole model is prescribed; moving : whether any of them moves
    at : (nodes, components), an index into arrays (owned, 3)
    nodes, components : (k,) indices of the prescribed components, sorted by node
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], mesh: DistributedMesh) -> None:
        self.fixed = np.zeros((mesh.n_owned, 3), dtype=bool)
        self._named: dict[str, tuple[np.ndarray, list[int]]] = {}
        motions: list[tuple[np.ndarray, list[int], Motion]] = []
        for index, support in enumerate(case.support):
            members = nodes[support.node_set]
            axes = ["xyz".index(letter) for letter in support.fix]
            if support.name is not None:
                self._named[support.name] = members, axes
            # one that stays in force from the stage before holds its nodes where they are
            motion = None if case.holds("support") else motion_of(support)
            for axis in axes:
                if motion is not None and self.fixed[members, axis].any():
                    node = mesh.node_ids[members[self.fixed[members, axis]][0]]
                    raise InputError(
                        f"{case.source}: support[{index}]: the {'xyz'[axis]} component of node {node} is already "
                        "prescribed by an earlier support; give each component one support"
                    )
                self.fixed[members, axis] = True
            if motion is not None:
                motions.append((members, axes, motion))
        self._index()
        self._start = mesh.points[: mesh.n_owned][self.fixed]
        self._moved = np.zeros((3, mesh.n_owned, 3))  # displacements, velocities, accelerations
        self._motions = motions
        self.moving = bool(motions)
        self.any = bool(case.support)

    def hold(self, x: np.ndarray) -> None:
        """Take the positions (owned, 3) [m] at the start of a stage for those that motions start from."""
        self._start = x[self.fixed]

    def of_name(self, name: str) -> np.ndarray:
        """Return which components (owned, 3) bool a support of the case prescribes."""
        mine = np.zeros_like(self.fixed)
        members, axes = self._named[name]
        for axis in axes:
            mine[members, axis] = True
        return mine

    def release(self, mask: np.ndarray) -> None:
        """Prescribe components (owned, 3) bool no longer."""
        keep = ~mask[self.fixed]
        self._start = self._start[keep]
        self.fixed &= ~mask  # in place: contact holds the array
        self._index()

    def hold_nodes(self, nodes: np.ndarray, x: np.ndarray) -> None:
        """Prescribe all components of nodes (k,), where they are at positions ``x`` (owned, 3) [m]."""
        start = x.copy()
        start[self.fixed] = self._start
        self.fixed[nodes] = True
        self._start = start[self.fixed]
        self.any = True
        self._index()

    def _index(self) -> None:
        self.nodes, self.components = np.nonzero(self.fixed)
        self.at = (self.nodes, self.components)

    def positions(self, time: float) -> np.ndarray:
        """Return prescribed positions (k,) [m] at a time [s], in the order of :attr:`nodes` and :attr:`components`."""
        if not self._motions:
            return self._start
        return self._start + self._at(time, 0.0)[0]

    def rates(self, time: float, span: float) -> tuple[np.ndarray, np.ndarray]:
        """Return prescribed velocities (k,) [m/s] and accelerations (k,) [m/s2] at a time [s], the exact derivatives.

        At velocity jumps (linear interpolation) the acceleration is the mean over the preceding ``span`` [s].
        """
        _, v, a = self._at(time, span)
        return v, a

    def _at(self, time: float, span: float) -> np.ndarray:
        for members, axes, motion in self._motions:
            moved = motion.at(time, span)
            for axis in axes:
                self._moved[:, members, axis] = moved[:, axis, None]
        return self._moved[:, self.nodes, self.components]
