"""External forces: gravity, nodal loads multiplied by time tables, and forces that depend on the motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..case.tables import VaryingGravity
from .nodal_loads import NodalLoads
from .state_forces import ForceState, FunctionForce, StateForce
from .time_tables import Table
from .wind import Wind

if TYPE_CHECKING:
    from ..case.schema import Case
    from .mass import Inertia

__all__ = ["ExternalForce"]


class ExternalForce:
    """Nodal external forces at any time. Construction is collective.

    Attributes
    ----------
    ramped : whether gravity and loads without a table are multiplied by the time, which is a load factor then
    active : whether there are any forces (on any rank, at any time)
    gravity : (3,) constant gravity [m/s2], zero if it varies
    held : (owned, 3) forces of loads at the start of a stage [N], None for none; held constant where the stage gives no
        loads, else taken away, at once over time and in proportion with a load factor
    held_gravity : (3,) the same of gravity [m/s2]
    state_forces : that depend on the motion, which :meth:`follow` gives
    reactions : forces (owned, 3) of supports that are removed gradually [N], with begin and duration of the removal
    """

    def __init__(self, case: Case, nodes: dict[str, np.ndarray], inertia: Inertia) -> None:
        self.inertia = inertia
        self._nodes = nodes
        self.state_forces: list[StateForce] = []
        self._state: ForceState | None = None
        self.wind = Wind(case, inertia.bars) if case.wind is not None else None
        if self.wind is not None and case.time is not None:
            self.state_forces.append(self.wind)
        self._keeps = case.holds("load"), case.holds("gravity")
        self._loads = None if self._keeps[0] else NodalLoads(case, nodes, inertia.mesh)
        varies = isinstance(case.gravity, VaryingGravity)
        gravity = case.gravity.acceleration if case.gravity is not None and not varies else (0.0, 0.0, 0.0)
        self.gravity = np.array(gravity, dtype=np.float64)
        self._gravity_table: Table | None = None
        if varies:
            self._gravity_table = Table(case.gravity.acceleration, case.gravity.interpolation == "smooth")
        self.ramped = case.static is not None
        self.active = bool(case.load) or bool(self.gravity.any()) or varies or bool(self.state_forces)
        self.held: np.ndarray | None = None
        self.held_gravity = np.zeros(3)
        self.reactions: list[tuple[np.ndarray, float, float]] = []
        changes = (self._loads is not None and not self._loads.steady) or (varies and not self._keeps[1])
        self._steady = not self.ramped and not changes
        self._constant: np.ndarray | None = None

    @property
    def steady(self) -> bool:
        """Whether the forces are constant."""
        return self._steady and not self.state_forces

    def call(self, function: Callable[[float, ForceState], Any]) -> None:
        """Add the forces that a function returns."""
        self.state_forces.append(FunctionForce(function, self.inertia.mesh))
        self.active = True

    @property
    def functions(self) -> int:
        """Number of functions that return forces."""
        return sum(isinstance(force, FunctionForce) for force in self.state_forces)

    def follow(self, position: np.ndarray, v: np.ndarray) -> None:
        """Take positions [m] and velocities [m/s] (owned, 3), at which forces depend on the motion from here on."""
        mesh = self.inertia.mesh
        self._state = ForceState(position, v, mesh.node_ids[: mesh.n_owned], self._nodes)

    @property
    def failure(self) -> str | None:
        """Why a force could not be evaluated on this rank, None if all could."""
        return next((force.failure for force in self.state_forces if force.failure is not None), None)

    @property
    def gravity_varies(self) -> bool:
        """Whether gravity is a function of time."""
        return self._gravity_table is not None

    def at(self, time: float, out: np.ndarray) -> np.ndarray:
        """``out`` (owned, 3) [N] at a time [s], or at a load factor."""
        for component, gravity in enumerate(self.gravity_at(time)):  # much faster than a product with three columns
            np.multiply(self.inertia.mass, gravity, out=out[:, component])
        self._add_loads(time, out)
        for force in self.state_forces:
            force.add(time, self._state, out)
        return out

    def constant(self) -> np.ndarray | None:
        """(owned, 3) [N], which must not be changed, if the forces are the same at all times, else None."""
        if not self.steady or self.reactions:
            return None
        if self._constant is None:
            self._constant = self.at(0.0, np.empty((len(self.inertia.mass), 3)))
        return self._constant

    def gravity_at(self, time: float) -> np.ndarray:
        """Acceleration (3,) [m/s2] at a time [s], or at a load factor."""
        if self._keeps[1]:
            return self.held_gravity
        if self._gravity_table is not None:
            own = self._gravity_table(time)
        else:
            own = (time if self.ramped else 1.0) * self.gravity
        return own if self.held is None else own + self._left(time) * self.held_gravity

    def loads_at(self, time: float) -> np.ndarray:
        """Forces of loads alone (owned, 3) [N] at a time [s], or at a load factor."""
        return self._add_loads(time, np.zeros((len(self.inertia.mass), 3)))

    def _add_loads(self, time: float, out: np.ndarray) -> np.ndarray:
        if self._loads is not None and self._loads.any:
            self._loads.add(time, time if self.ramped else 1.0, out)
        for force, begin, duration in self.reactions:
            if time < begin + duration:
                out += (1.0 - (time - begin) / duration) * force
        if self.held is not None:
            out += self.held if self._keeps[0] else self._left(time) * self.held
        return out

    def _left(self, time: float) -> float:
        """Share that is left of what a stage replaces."""
        return max(1.0 - time, 0.0) if self.ramped else 0.0

    def wind_at(self, time: float) -> np.ndarray:
        """Velocity of the wind (3,) [m/s] at a time [s]."""
        return np.zeros(3) if self.wind is None else self.wind.velocity(time)

    def hold(self, force: np.ndarray, gravity: np.ndarray, wind: np.ndarray, active: bool) -> None:
        """Take over what acts at the start of a stage: loads (owned, 3) [N], gravity [m/s2] and wind [m/s], (3,)."""
        self.held, self.held_gravity, self._constant = force, gravity, None
        if self.wind is not None:
            self.wind.held = wind
        self.active = self.active or active
