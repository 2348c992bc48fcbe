"""What treatments of impact share: a hook after each part of a step, and how a jump of velocities is booked.

The treatment ``scheme`` is none at all: velocity and acceleration of held nodes follow the integrator's own formulas.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ...integrators.base import Scheme
from ...tolerances import FREE_PART, RANK

if TYPE_CHECKING:
    from ...stepping.model import Model
    from ...stepping.stepper import Stepper

__all__ = ["Jump", "Treatment"]


@dataclass
class Jump:
    """Velocities and accelerations of nodes just before a treatment changed them, for the energy ledger.

    Attributes
    ----------
    nodes : (m,) owned local indices
    v, a : (m, 3) before the jump [m/s], [m/s2]
    energy : kinetic energy that this rank's nodes gained [J]
    memory : what the scheme remembered of them (m, 3), by name
    friction : what the drag that goes with the jump took of it [J]
    """

    nodes: np.ndarray
    v: np.ndarray
    a: np.ndarray
    energy: float
    memory: dict[str, np.ndarray] = field(default_factory=dict)
    friction: float = 0.0


class Treatment(ABC):
    """Changes what the integrator makes of nodes that walls hold.

    Attributes
    ----------
    jump : of the part of a step just made, None where nothing jumped
    elastic : whether impact loses nothing
    serves : keys of walls that it goes with, of ``tied``, ``friction`` and ``restitution``
    """

    elastic = False
    serves: tuple[str, ...] = ()

    @classmethod
    def refuses(cls, scheme: Scheme) -> str | None:
        """Why a scheme cannot have the treatment, None where it can."""
        return None

    @classmethod
    def prepare(cls, model: Model) -> None:
        """Change the model before the stepper is made; nothing by default. Collective.

        Raises
        ------
        InputError
            On all ranks, for models that cannot have the treatment.
        """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.jump: Jump | None = None

    def before(self) -> None:
        """Called before each part of a step; nothing by default."""

    @abstractmethod
    def after(self) -> None:
        """Called after each part of a step, before it is booked: changes v, a and memory of the state."""

    def held(self, applicable: np.ndarray | bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes that walls hold (m,), projections (m, 3, 3) on their normals, velocities (m, 3) to have there [m/s].

        These are the walls' own, and :meth:`leaving` away from them. Of nodes that walls hold for good or by friction
        the projection is on all directions. ``applicable`` (walls,) bool: of which walls; default: all.

        Components that supports prescribe are not changed: projections P are along the others, P v = F^+ N v with the
        normals N and their free parts F, so that v - P v has no part along the normals.
        """
        stepper = self.stepper
        contact, walls = stepper.model.contact, stepper.solution.walls
        touching = walls.touching & applicable
        touched = touching.any(axis=1)
        nodes, touching = walls.nodes[touched], touching[touched]
        displacements = contact.motion.displacements(stepper.state.time)
        normals, _ = contact.planes(touching, stepper.state.position[nodes], displacements)
        normals = np.where(touching[:, :, None], normals, 0.0)
        # the normals' pseudo-inverse serves any number of walls at a node, parallel ones too
        free = np.where(stepper.model.supports.fixed[nodes][:, None, :], 0.0, normals)
        free[(free * free).sum(axis=2) <= FREE_PART] = 0.0
        inverse = np.linalg.pinv(free, rcond=RANK) if len(nodes) else np.zeros((0, 3, normals.shape[1]))
        rates = contact.motion.rates(stepper.state.time)
        away = np.einsum("mwi,wi->mw", normals, rates) + self.leaving(nodes, touching, normals, rates)
        speeds = np.einsum("miw,mw->mi", inverse, away)
        normal = inverse @ normals
        if contact.ties.any:
            tied = contact.ties.held[nodes]
            normal[tied] = np.eye(3)
            speeds[tied] = rates[contact.ties.walls(nodes[tied])]
        infeasible = self.sticking(nodes, touching, normals)
        holds = infeasible.any(axis=1)
        if holds.any():  # there may be no walls at all, but pairs
            normal[holds] = np.eye(3)
            speeds[holds] = rates[infeasible[holds].argmax(axis=1)]
        return nodes, normal, speeds

    def leaving(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Velocities (m, w) at which nodes (m,) leave walls that they touch (m, w), along normals (m, w, 3) [m/s]."""
        return np.zeros(touching.shape)

    def sticking(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(m, w) bool: walls whose friction keeps nodes (m,) that touch them (m, w) from slipping."""
        return np.zeros(touching.shape, dtype=bool)

    def set(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        """Give nodes new velocities and accelerations (m, 3), and keep what they were for the ledger."""
        stepper, state = self.stepper, self.stepper.state
        inertia = stepper.model.inertia
        fixed = stepper.model.supports.fixed[nodes]
        old_v, old_a = state.v[nodes], state.a[nodes]
        v, a = np.where(fixed, old_v, v), np.where(fixed, old_a, a)
        energy = 0.5 * float((inertia.mass[nodes, None] * (v * v - old_v * old_v)).sum())
        self.jump = Jump(nodes, old_v, old_a, energy, self.remembered(nodes))
        memory = state.memory.setdefault("contact_change", np.zeros_like(state.v))
        memory[nodes] = inertia.mass[nodes, None] * (a - old_a)
        if inertia.damped:
            memory[nodes] += inertia.damping[nodes, None] * (v - old_v)
        memory[nodes] = np.where(fixed, 0.0, memory[nodes])
        state.v, state.a = state.v.copy(), state.a.copy()
        state.v[nodes], state.a[nodes] = v, a
        stepper.scheme.restart(state, nodes, stepper.part)

    def remembered(self, nodes: np.ndarray) -> dict[str, np.ndarray]:
        """What the scheme remembers of nodes (m,): name to (m, 3)."""
        memory = self.stepper.state.memory
        return {name: memory[name][nodes] for name in self.stepper.scheme.remembers if name in memory}

    def clear(self) -> None:
        """Forget the last jump."""
        self.jump = None
        change = self.stepper.state.memory.get("contact_change")
        if change is not None:
            change[:] = 0.0
