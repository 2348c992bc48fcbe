"""Base class of treatments of impact: hooks after each part of a step; restitution by a velocity jump."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from ...integrators.base import Scheme
from ...tolerances import FREE_PART, RANK
from ..explicit import impact_square, rebound_way

if TYPE_CHECKING:
    from ...stepping.model import Model
    from ...stepping.stepper import Stepper


@dataclass
class Jump:
    """Velocities and accelerations of nodes just before a treatment changed them, for the energy ledger.

    Attributes
    ----------
    nodes : (m,) owned local indices
    walls : (m, slots) bool, walls that give the momentum of the jump; none at nodes of pairs
    v, a : (m, 3) before the jump [m/s], [m/s2]
    energy : kinetic energy that this rank's nodes gained [J]
    memory : arrays of the scheme's memory at these nodes (m, 3), by name
    friction : energy that friction during the jump has dissipated [J]
    """

    nodes: np.ndarray
    walls: np.ndarray
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
        time, x = stepper.state.time, stepper.state.position[nodes]
        normals, _ = contact.planes(touching, x, contact.motion.poses(time), nodes=nodes)
        normals = np.where(touching[:, :, None], normals, 0.0)
        # the pseudo-inverse of the normals handles any number of walls at a node, parallel ones too
        free = np.where(stepper.model.supports.fixed[nodes][:, None, :], 0.0, normals)
        free[(free * free).sum(axis=2) <= FREE_PART] = 0.0
        inverse = np.linalg.pinv(free, rcond=RANK) if len(nodes) else np.zeros((0, 3, normals.shape[1]))
        rates = contact.rates(x, time)
        away = np.einsum("mwi,mwi->mw", normals, rates) + self.leaving(nodes, touching, normals, rates)
        speeds = np.einsum("miw,mw->mi", inverse, away)
        normal, held = inverse @ normals, self.sticking(nodes, touching, normals)
        if contact.ties.any:
            tied = np.flatnonzero(contact.ties.held[nodes])
            held[tied, contact.first[contact.ties.walls(nodes[tied])]] = True
        holds = held.any(axis=1)
        if holds.any():  # there may be pairs without any wall
            normal[holds] = np.eye(3)
            speeds[holds] = rates[np.flatnonzero(holds), held[holds].argmax(axis=1)]
        return nodes, normal, speeds

    def leaving(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return velocities (m, w) [m/s] at which nodes (m,) leave walls that they touch (m, w), along the normals."""
        return np.zeros(touching.shape)

    def sticking(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return (m, w) bool: walls to which nodes (m,) that touch them (m, w) stick by friction."""
        return np.zeros(touching.shape, dtype=bool)

    def set(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray, walls: np.ndarray | None = None) -> None:
        """Set velocities and accelerations (m, 3) of nodes, and record the previous ones for the ledger; ``walls``: see
        :class:`Jump`, by default those that the nodes touch."""
        stepper, state = self.stepper, self.stepper.state
        walls = stepper.touching[nodes] if walls is None else walls
        inertia = stepper.model.inertia
        fixed = stepper.model.supports.fixed[nodes]
        old_v, old_a = state.v[nodes], state.a[nodes]
        v, a = np.where(fixed, old_v, v), np.where(fixed, old_a, a)
        energy = 0.5 * float((inertia.mass[nodes, None] * (v * v - old_v * old_v)).sum())
        self.jump = Jump(nodes, walls, old_v, old_a, energy, self.remembered(nodes))
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


def across(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the parts of vectors (m, w, 3) across normals (m, w, 3)."""
    return vectors - np.einsum("mwi,mwi->mw", vectors, normals)[:, :, None] * normals


STILL = 1e-13  # of the model's length: a slip that is rounding
_NONE = 1e-9  # of a force: what of it is rounding, and of the tolerance of the solve


class Restitution(Treatment):
    """Makes nodes that close on walls with restitution leave them, and likewise pairs, which share no nodes.

    ``everywhere`` : whether the treatment applies to walls and pairs without restitution too.
    """

    everywhere = False

    def before(self) -> None:
        """Record contacts and the motion of nodes."""
        self._touched = self.stepper.touching.copy()
        contact, state, links = self.stepper.model.contact, self.stepper.state, self.stepper.model.links
        scheme = self.stepper.scheme
        # nodes in whose first free step the old wall force still does work
        self._frees = scheme.balance_at_endpoints and not scheme.solves_next_position
        rebounds = bool(contact.restitution.any()) or links.rows.rebounds
        if self._frees or contact.has_friction or rebounds:
            self._time, self._place = state.time, state.position.copy()
        if self._frees:
            mine = self._touched if self.everywhere else self._touched & (contact.restitution > 0.0)
            self._held = np.flatnonzero(mine.any(axis=1))
            total = state.contact + state.memory.get("contact_change", 0.0)
            self._force = total[self._held]
            # a node that leaves by restitution has had its force removed up to rounding
            least = _NONE * np.linalg.norm(state.contact[self._held], axis=1)
            self._force[np.linalg.norm(self._force, axis=1) <= least] = 0.0
        self._pressed, self._push = links.force > 0.0, None
        if self._frees and (self.everywhere or links.rows.rebounds) and links.any_pressed():
            ends = links.two.gather(np.concatenate([total, state.position], axis=1))
            force = 0.5 * links.two.apart(ends[:, :, :3])  # half the relative force between the ends
            force[force <= _NONE * links.force] = 0.0
            self._push = self._pressed & self._treated, force, links.two.apart(ends[:, :, 3:])
        if rebounds and not scheme.explicit:
            self._speed, self._free = state.v, self._without_contact(np.arange(len(state.v)))

    @property
    def _treated(self) -> np.ndarray:
        """(p,) bool: pairs to which the treatment applies."""
        return (self.stepper.model.links.rows.restitution > 0.0) | self.everywhere

    def _without_contact(self, nodes: np.ndarray) -> np.ndarray:
        """Return accelerations (m, 3) of nodes without contact forces [m/s2], zero in prescribed components."""
        state, inertia = self.stepper.state, self.stepper.model.inertia
        load = state.external[nodes] - state.f[nodes]
        if inertia.damped:
            load -= inertia.damping[nodes, None] * state.v[nodes]
        load[self.stepper.model.supports.fixed[nodes]] = 0.0
        return load / inertia.mass[nodes, None]

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        self.put(*self.with_pairs(*self.on_walls(self.stepper.model.contact.restitution > 0.0)))

    def with_pairs(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Add the nodes of pairs in contact, and of those just released, to nodes (m,) and their velocities and
        accelerations (m, 3). Collective."""
        stepper, links, mass = self.stepper, self.stepper.model.links, self.stepper.model.inertia.mass
        state, two = stepper.state, links.two
        if not (self.everywhere or links.rows.rebounds):
            return nodes, v, a
        if links.any_pressed():
            closed = (links.force > 0.0) & self._treated
            leaves = self._pairs_leave(closed & ~self._pressed)
            end, row = np.nonzero((two.nodes >= 0) & closed)
            ends, normals = two.nodes[end, row], two.normals[row]
            along = np.einsum("mi,mi->m", normals, self._without_contact(ends) - state.a[ends])
            free = state.a[ends] + along[:, None] * normals
            held = two.together(state.a, mass, closed)[ends]
            nodes, v = np.append(nodes, ends), np.vstack([v, two.together(state.v, mass, closed, leaves)[ends]])
            a = np.vstack([a, np.where((leaves > 0.0)[row][:, None], free, held)])
        if self._push is not None:
            ends, slower = self._pairs_let_go()
            nodes, v, a = np.append(nodes, ends), np.vstack([v, slower]), np.vstack([a, state.a[ends]])
        return nodes, v, a

    def _pairs_leave(self, fresh: np.ndarray) -> np.ndarray:
        """Return velocities (p,) [m/s] at which the nodes of pairs leave each other, ``fresh`` (p,) bool of which have
        just closed; see :meth:`leaving`. Collective."""
        links, state = self.stepper.model.links, self.stepper.state
        if not links.rows.rebounds:
            return np.zeros(len(fresh))
        two, moved = links.two, state.position - self._place
        ends = two.gather(np.hstack([moved, *self._free_motion(np.arange(len(moved)), moved)]))
        closing, *towards = (-two.apart(ends[:, :, k : k + 3]) for k in range(0, ends.shape[2], 3))
        return np.where(fresh, self._rebound(links.rows.restitution, np.maximum(closing, 0.0), *towards), 0.0)

    def _free_motion(self, nodes: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the motion without contact of nodes (m,), which have ``moved`` by (m, 3) with it: in explicit steps
        their displacements (m, 3), and the parts of these by forces before and after the impact [m], from the balance
        of the step; in others velocities before it, and twice their mean accelerations."""
        stepper, state, h = self.stepper, self.stepper.state, self.stepper.part
        if not stepper.scheme.explicit:
            return self._speed[nodes], self._free[nodes] + self._without_contact(nodes)
        balance, mass = stepper.balance, stepper.model.inertia.mass[nodes, None]
        push = np.where(stepper.model.supports.fixed[nodes], 0.0, state.contact[nodes]) / mass
        known = 0.0 if balance.a_hat is None else balance.a_hat[nodes]
        free = balance.alpha * stepper.solution.u[nodes] + known - push
        return moved - push / balance.alpha, h * h * free, h * h * self._without_contact(nodes)

    def _rebound(self, restitution: np.ndarray, distance: np.ndarray, *towards: np.ndarray) -> np.ndarray:
        """Return the velocities at which nodes leave what they have met after a distance [m]; ``towards``: the parts of
        :meth:`_free_motion` towards it."""
        if self.stepper.scheme.explicit:
            approach, before, after = towards
            square = impact_square(approach, distance, before)
            return rebound_way(restitution, square, distance, after) / self.stepper.part
        speed, pull = towards
        return np.where(speed > 0.0, restitution * np.sqrt(np.maximum(speed * speed + pull * distance, 0.0)), 0.0)

    def put(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        """Set velocities and accelerations (m, 3) of nodes (m,) in contact and of those just released."""
        gone, left, slower = self._let_go()
        touching = self.stepper.touching
        walls = np.vstack([touching[nodes], left[:, None] == np.arange(touching.shape[1])])
        nodes, v, a = np.append(nodes, gone), np.vstack([v, slower]), np.vstack([a, self.stepper.state.a[gone]])
        if len(nodes):
            self.set(nodes, v, a, walls)

    def _let_go(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes (m,) of this treatment that walls released in this step, these walls (m,), and the nodes'
        velocities (m, 3).

        With schemes whose forces do work by the trapezoidal rule, the contact force at the start of the step would do
        work on the released node. This work is removed from the velocity away from the wall.
        """
        state, stepper = self.stepper.state, self.stepper
        if not self._frees or not len(self._held):
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 3))
        left = ~stepper.touching[self._held].any(axis=1)
        gone, force = self._held[left], self._force[left]
        walls = self._touched[gone].argmax(axis=1)
        contact, every = stepper.model.contact, np.arange(len(gone))
        way = self._carried(gone, state.time)[every, walls]
        rate = contact.rates(state.position[gone], state.time)[every, walls]
        work = 0.5 * np.einsum("mi,mi->m", force, state.position[gone] - self._place[gone] - way)
        away = force / np.maximum(np.linalg.norm(force, axis=1), 1e-300)[:, None]
        speed = np.einsum("mi,mi->m", away, state.v[gone] - rate)
        left = (work > 0.0) & (speed > 0.0)
        gone, walls, away, speed, work = gone[left], walls[left], away[left], speed[left], work[left]
        slower = np.sqrt(np.maximum(speed * speed - 2.0 * work / stepper.model.inertia.mass[gone], 0.0))
        return gone, walls, state.v[gone] + (slower - speed)[:, None] * away

    def leaving(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        contact = self.stepper.model.contact
        if not contact.restitution.any():
            return np.zeros(touching.shape)
        state = self.stepper.state
        moved = state.position[nodes] - self._place[nodes]
        carried = self._carried(nodes, state.time)
        first, *others = (each[:, None, :] for each in self._free_motion(nodes, moved))
        vectors = moved[:, None, :] - carried, first - (carried if self.stepper.scheme.explicit else rates), *others
        closing, *towards = (-np.einsum("mwi,mwi->mw", normals, each) for each in vectors)
        leaves = self._rebound(contact.restitution, np.maximum(closing, 0.0), *towards)
        return np.where(touching & ~self._touched[nodes], leaves, 0.0)

    def sticking(self, nodes: np.ndarray, touching: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        model = self.stepper.model
        if not model.contact.has_friction:
            return np.zeros(touching.shape, dtype=bool)
        still = np.linalg.norm(across(self._moved(nodes), normals), axis=2) <= STILL * model.size
        return touching & still & (model.contact.static_friction > 0.0)

    def _moved(self, nodes: np.ndarray) -> np.ndarray:
        """Return displacements of nodes (m,) in this step relative to the walls (m, slots, 3) [m]."""
        state = self.stepper.state
        return (state.position[nodes] - self._place[nodes])[:, None, :] - self._carried(nodes, state.time)

    def _carried(self, nodes: np.ndarray, time: float) -> np.ndarray:
        """Return how far walls carry their points at nodes (m,) from the start of the step to a time [s], (m, slots, 3)
        [m]."""
        contact = self.stepper.model.contact
        return contact.ways(self._place[nodes], contact.motion.poses(self._time), contact.motion.poses(time))

    def on_walls(self, applicable: np.ndarray | bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes in contact with walls (m,), and their new velocities and accelerations (m, 3) [m/s], [m/s2]."""
        state, model = self.stepper.state, self.stepper.model
        nodes, normal, speed = self.held(applicable)
        v, a = state.v[nodes], state.a[nodes]
        v = v - np.einsum("mij,mj->mi", normal, v) + speed
        a = a - np.einsum("mij,mj->mi", normal, a)
        if not model.contact.restitution.any():
            return nodes, v, a
        leaves = (self.stepper.touching & ~self._touched & (model.contact.restitution > 0.0))[nodes].any(axis=1)
        a[leaves] += np.einsum("mij,mj->mi", normal[leaves], self._without_contact(nodes[leaves]))
        return nodes, v, a

    def _pairs_let_go(self) -> tuple[np.ndarray, np.ndarray]:
        """Return ends (m,) of pairs that opened in this step, and their velocities (m, 3); see :meth:`_let_go`.

        Collective.
        """
        state, links, mass = self.stepper.state, self.stepper.model.links, self.stepper.model.inertia.mass
        two = links.two
        pressed, force, before = self._push
        gone = pressed & ~(links.force > 0.0)
        if not self.stepper.model.comm.allreduce(bool(gone.any()), op=MPI.LOR):
            return np.empty(0, dtype=np.int64), np.empty((0, 3))
        ends = two.gather(np.concatenate([state.position, state.v], axis=1))
        work = 0.5 * force * (two.apart(ends[:, :, :3]) - before)
        speed = two.apart(ends[:, :, 3:])
        gone &= (work > 0.0) & (speed > 0.0)
        slower = np.sqrt(np.maximum(speed * speed - 2.0 * work / two.reduced_mass(mass), 0.0))
        ends = two.nodes[(two.nodes >= 0) & gone]
        return ends, two.together(state.v, mass, gone, slower)[ends]
