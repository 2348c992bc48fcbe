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
        self.steady = not self.ramped and not any(table is not None for _, _, table in self.loads)

    def at(self, time: float, out: np.ndarray) -> np.ndarray:
        """``out`` (owned, 3) [N] at a time [s], or at a load factor."""
        full = time if self.ramped else 1.0
        np.multiply(self.inertia.mass[:, None], full * self.gravity, out=out)
        for indices, force, table in self.loads:
            out[indices] += force * (table(time)[0] if table is not None else full)
        return out
