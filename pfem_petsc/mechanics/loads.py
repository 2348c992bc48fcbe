"""External forces: gravity, and nodal loads multiplied by time tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..case.schema import Case
    from .mass import Inertia

__all__ = ["ExternalForce", "Table"]


class Table:
    """Piecewise linear function of time, constant before the first and after the last entry."""

    def __init__(self, rows: Sequence[Sequence[float]]) -> None:
        rows = np.asarray(rows, dtype=np.float64)
        self.times = np.ascontiguousarray(rows[:, 0])
        self.values = np.ascontiguousarray(rows[:, 1:])

    def __call__(self, time: float) -> np.ndarray:
        """Return the values at a time, one per column."""
        return np.array([np.interp(time, self.times, column) for column in self.values.T])


class ExternalForce:
    """Nodal external forces at any time.

    Attributes
    ----------
    ramped : whether gravity and loads without a table are multiplied by the time, which is a load factor then
    active : whether there are any forces (on any rank, at any time)
    steady : whether the forces are constant
    held : (owned, 3) forces of loads at the start of a stage [N], None for none; held constant where the stage gives no
        loads, else taken away, at once over time and in proportion with a load factor
    held_gravity : (3,) the same of gravity [m/s2]
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], inertia: Inertia) -> None:
        self.loads = [
            (nodes[load.node_set], np.array(load.force), Table(load.table) if load.table else None)
            for load in case.load
        ]
        gravity = case.gravity.acceleration if case.gravity is not None else (0.0, 0.0, 0.0)
        self.gravity = np.array(gravity, dtype=np.float64)
        self.inertia = inertia
        self.ramped = case.static is not None
        self.active = bool(case.load) or bool(self.gravity.any())
        self.held: np.ndarray | None = None
        self.held_gravity = np.zeros(3)
        self._keeps = case.holds("load"), case.holds("gravity")
        if self._keeps[0]:
            self.loads = []
        self.steady = not self.ramped and not any(table is not None for _, _, table in self.loads)

    def at(self, time: float, out: np.ndarray) -> np.ndarray:
        """``out`` (owned, 3) [N] at a time [s], or at a load factor."""
        np.multiply(self.inertia.mass[:, None], self.gravity_at(time), out=out)
        return self._add_loads(time, out)

    def gravity_at(self, time: float) -> np.ndarray:
        """Acceleration (3,) [m/s2] at a time [s], or at a load factor."""
        if self._keeps[1]:
            return self.held_gravity
        own = (time if self.ramped else 1.0) * self.gravity
        return own if self.held is None else own + self._left(time) * self.held_gravity

    def loads_at(self, time: float) -> np.ndarray:
        """Forces of loads alone (owned, 3) [N] at a time [s], or at a load factor."""
        return self._add_loads(time, np.zeros((len(self.inertia.mass), 3)))

    def _add_loads(self, time: float, out: np.ndarray) -> np.ndarray:
        full = time if self.ramped else 1.0
        for indices, force, table in self.loads:
            out[indices] += force * (table(time)[0] if table is not None else full)
        if self.held is not None:
            out += self.held if self._keeps[0] else self._left(time) * self.held
        return out

    def _left(self, time: float) -> float:
        """Share that is left of what a stage replaces."""
        return max(1.0 - time, 0.0) if self.ramped else 0.0

    def hold(self, force: np.ndarray, gravity: np.ndarray, active: bool) -> None:
        """Take over what acts at the start of a stage: loads (owned, 3) [N] and gravity (3,) [m/s2]."""
        self.held, self.held_gravity = force, gravity
        self.active = self.active or active
