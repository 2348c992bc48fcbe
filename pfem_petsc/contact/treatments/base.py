"""Base class of treatments of impact: a hook after each part of a step, and the record of velocity jumps.

The treatment ``scheme`` changes nothing: velocity and acceleration of nodes in contact follow from the integrator.
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
    memory : arrays of the scheme's memory at these nodes (m, 3), by name
    friction : energy that friction during the jump has dissipated [J]
    """

    nodes: np.ndarray
    v: np.ndarray
    a: np.ndarray
    energy: float
    memory: dict[str, np.ndarray] = field(default_factory=dict)
    friction: float = 0.0


class Treatment(ABC):
    """Changes velocities and accelerations of nodes in contact after the integrator has set them.

    Attributes
    ----------
    jump : of the part of a step just completed, None if no velocity jumped
    elastic : whether impact conserves energy
    serves : compatible keys of walls among ``tied``, ``friction`` and ``restitution``
    """

    elastic = False
    serves: tuple[str, ...] = ()

    @classmethod
    def refuses(cls, scheme: Scheme) -> str | None:
        """Return why the treatment is not compatible with a scheme, None if it is."""
        return None

    @classmethod
    def prepare(cls, model: Model) -> None:
        """Change the model before the stepper is made; nothing by default. Collective.

        Raises
        ------
        InputError
            On all ranks, for models that are not compatible with the treatment.
        """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper = stepper
        self.jump: Jump | None = None

    def before(self) -> None:
        """Called before each part of a step; nothing by default."""

    @abstractmethod
    def after(self) -> None:
        """Called after each part of a step, before the ledger: changes v, a and memory of the state."""

    def held(self, applicable: np.ndarray | bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes in contact with walls (m,), projections (m, 3, 3) on their normals, and velocities (m, 3) [m/s].

        The velocities are those required along the projections: the walls' own, plus :meth:`leaving` away from them.
        For nodes that are tied or stick by friction the projection is the identity. ``applicable`` (walls,) bool: walls
        to include; default: all.

        Prescribed components are not changed: projections P act on the others, P v = F^+ N v with the normals N and
        their free parts F, so that v - P v has no component along the normals.
        """
        stepper = self.stepper
        contact, walls = stepper.model.contact, stepper.solution.walls
        touching = walls.touching & applicable
        touched = touching.any(axis=1)
        nodes, touching = walls.nodes[touched], touching[touched]
        displacements = contact.motion.displacements(stepper.state.time)
        normals, _ = contact.planes(touching, stepper.state.position[nodes], displacements)
        normals = np.where(touching[:, :, None], normals, 0.0)
        # the pseudo-inverse of the normals handles any number of walls at a node, parallel ones too
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
        if holds.any():  # there may be pairs without any wall
            normal[holds] = np.eye(3)
            speeds[holds] = rates[infeasible[holds].argmax(axis=1)]
        return nodes, normal, speeds

    def leaving(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return velocities (m, w) [m/s] at which nodes (m,) leave walls that they touch (m, w), along the normals."""
        return np.zeros(touching.shape)

    def sticking(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return (m, w) bool: walls to which nodes (m,) that touch them (m, w) stick by friction."""
        return np.zeros(touching.shape, dtype=bool)

    def set(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        """Set velocities and accelerations (m, 3) of nodes, and record the previous ones for the ledger."""
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
        """Return the scheme's arrays at nodes (m,): name to (m, 3)."""
        memory = self.stepper.state.memory
        return {name: memory[name][nodes] for name in self.stepper.scheme.remembers if name in memory}

    def clear(self) -> None:
        """Discard the last jump."""
        self.jump = None
        change = self.stepper.state.memory.get("contact_change")
        if change is not None:
            change[:] = 0.0
