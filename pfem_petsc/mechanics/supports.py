"""Supports: components of node positions that are prescribed, at rest or moving."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .loads import Table

__all__ = ["Supports"]


class Supports:
    """Prescribed components on this rank.

    Attributes
    ----------
    fixed : (owned, 3) bool
    any : whether any component of the whole model is prescribed; moving : whether any of this rank moves
    nodes, components : (k,) indices of the prescribed components, in order of the nodes
    """

    def __init__(self, case, nodes: dict[str, np.ndarray], mesh) -> None:
        self.fixed = np.zeros((mesh.n_owned, 3), dtype=bool)
        motions: list[tuple[np.ndarray, list[int], object]] = []
        for index, support in enumerate(case.support):
            members = nodes[support.node_set]
            axes = ["xyz".index(letter) for letter in support.fix]
            motion = None
            if getattr(support, "motion", None):
                motion = Table(support.motion)
            elif getattr(support, "velocity", None):
                velocity = np.array(support.velocity)
                motion = lambda time, velocity=velocity: velocity * time  # noqa: E731
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
        self.nodes, self.components = np.nonzero(self.fixed)
        self._start = mesh.points[: mesh.n_owned][self.fixed]
        self._moved = np.zeros((mesh.n_owned, 3))
        self._motions = motions
        self.moving = bool(motions)
        self.any = bool(case.support)

    def positions(self, time: float) -> np.ndarray:
        """Prescribed positions (k,) [m] at a time [s], in the order of :attr:`nodes` and :attr:`components`."""
        if not self._motions:
            return self._start
        for members, axes, motion in self._motions:
            displacement = motion(time)
            for axis in axes:
                self._moved[members, axis] = displacement[axis]
        return self._start + self._moved[self.nodes, self.components]
