"""Nodes in contact move with the wall: their normal velocity is the wall's, and their normal acceleration is zero.

For nodes that stick by friction, and for tied nodes, this holds in all directions. The nodes of a contact pair in
contact move together, with the normal velocity that conserves their momentum.

On closure a node loses the kinetic energy of its approach, m v_n^2/2, an O(element length) part of the total. On
release it starts from rest, and the wall does no work on it. At a wall with restitution e a node that closes leaves
with e times the velocity of its approach and loses (1 - e^2) of that energy; see
:mod:`~pfem_petsc.contact.treatments.base`.

The momentum that stops a node is m v_n in all. What the force of the step falls short of it, or exceeds it by, depends
on where in the step the impact falls; the jump makes up for it. Friction follows the momentum: a node that slips is
dragged by mu times the jump as well. An impact takes mu m v_n along the wall whatever the step, but no more than what
stops the slip: the momentum that the force has taken beyond is given back.
"""

from __future__ import annotations

import numpy as np

from ...integrators.base import State
from ...tolerances import FREE_PART, RANK
from .base import STILL, Restitution, across

_TINY = 1e-200  # divides what is nothing


class Treatment(Restitution):
    """Sets velocity and acceleration of nodes in contact to those of the wall."""

    everywhere = True
    serves = ("tied", "friction", "restitution")

    def before(self) -> None:
        """Also find what a force does in a step."""
        super().before()
        if self.stepper.model.contact.has_friction:
            self._response = self._response_of()

    def after(self) -> None:
        """See :class:`~pfem_petsc.contact.treatments.base.Treatment`."""
        self.clear()
        nodes, v, a = self.on_walls()
        v, a, friction = self._dragged(nodes, v, a)
        self.put(*self.with_pairs(nodes, v, a))
        if self.jump is not None:
            self.jump.friction = friction

    def _dragged(self, nodes: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Velocities and accelerations (m, 3) of held nodes with friction of jumps, and its dissipation [J].

        The momentum T that friction takes in a step along the direction s of the slip is that of its force plus that of
        the jump: mu times that of the normal force and jump, but no more than what stops the slip. If other forces
        reverse the slip, T is zero, for friction takes nothing beyond rest. Momenta are per mass of the node; jumps
        along the normals N are given, with their free parts F, so friction acts beside the span of F.
        """
        stepper, state = self.stepper, self.stepper.state
        contact = stepper.model.contact
        if not contact.has_friction or stepper.scheme.solves_next_position or len(nodes) == 0:
            return v, a, 0.0
        touching = stepper.touching[nodes]
        normals, _ = contact.planes(touching, state.position[nodes], contact.motion.poses(state.time), nodes=nodes)
        slip = across(self._moved(nodes), normals)
        if not stepper.scheme.solves_end:  # friction acts along the slip to the position solved for, if any
            solved = across(self._moved_to_solution(nodes), normals)
            slip = np.where(np.linalg.norm(solved, axis=2)[:, :, None] > STILL * stepper.model.size, solved, slip)
        size = np.linalg.norm(slip, axis=2)
        slips = touching & (size > STILL * stepper.model.size) & (contact.friction > 0.0)
        slips[self.sticking(nodes, touching, normals).any(axis=1)] = False
        at = np.flatnonzero(slips.any(axis=1))
        if len(at) == 0:
            return v, a, 0.0
        owned, size, slips = nodes[at], size[at], slips[at]
        mass = stepper.model.inertia.mass[owned]
        held = ~stepper.model.supports.fixed[owned][:, None, :] & touching[at][:, :, None]
        free = np.where(held, normals[at], 0.0)
        free[(free * free).sum(axis=2) <= FREE_PART] = 0.0
        inverse = np.linalg.pinv(free, rcond=RANK)
        slip = np.where(slips[:, :, None], slip[at] / np.maximum(size, _TINY)[:, :, None], 0.0)
        way = np.where(held, slip, 0.0)
        beside = way - way @ inverse @ free
        moves = (beside * beside).sum(axis=2) > FREE_PART
        way[~moves], beside[~moves] = 0.0, 0.0
        # the forces of the balance on walls; nodes may stick at t + theta h and slip at the end of the step
        coefficient = np.where(moves, contact.friction, 0.0)
        force = state.contact[owned] / mass[:, None]
        apart = np.linalg.pinv(beside @ beside.swapaxes(1, 2), rcond=RANK)
        drag = np.maximum(-np.einsum("kwu,kui,ki->kw", apart, beside, force), 0.0)
        pressed = np.einsum("kiw,ki->kw", inverse, force + np.einsum("kw,kwi->ki", drag, way))
        pressed = np.maximum(pressed, 0.0)
        change_v, change_a = v[at] - state.v[owned], a[at] - state.a[owned]
        relative = state.v[owned][:, None, :] - contact.rates(state.position[owned], state.time)
        speed = np.einsum("kwi,kwi->kw", slip, relative + change_v[:, None, :])
        stopping, coupling = slip @ beside.swapaxes(1, 2), (way @ inverse).swapaxes(1, 2)

        def jumps(change: np.ndarray, rate: np.ndarray, ratio: np.ndarray, effect: float) -> np.ndarray:
            """Jumps (k, walls) by friction: what ``ratio`` times the normal forces and jumps exceed the drag by, or
            what ends the rate of slip. ``effect``: of a force, see :meth:`_response_of`."""
            matrix = np.where(stops[:, :, None], stopping, np.eye(len(contact.friction)) - ratio[:, :, None] * coupling)
            normal = np.einsum("kiw,ki->kw", inverse, change)
            known = np.where(stops, rate, ratio * normal + effect * (ratio * pressed - drag))
            return np.einsum("kwu,ku->kw", np.linalg.pinv(matrix, rcond=RANK), known)

        of_v, of_a = self._response
        stops, returns = np.zeros(size.shape, dtype=bool), np.zeros(size.shape, dtype=bool)
        while True:
            jump = jumps(change_v, speed, np.where(returns, 0.0, coefficient), of_v)
            negative = moves & ~returns & (jump < -of_v * drag)
            reversed_ = moves & ~returns & ~stops & (speed - np.einsum("kwu,ku->kw", stopping, jump) < 0.0)
            if not (negative | reversed_).any():
                break
            returns |= negative
            stops = (stops | reversed_) & ~returns
        ratio = np.where(returns, 0.0, drag / np.maximum(pressed, _TINY))
        jump_a = jumps(change_a, np.einsum("kwi,ki->kw", slip, a[at]), ratio, of_a)
        v, a = v.copy(), a.copy()
        v[at] -= np.einsum("kw,kwi->ki", jump, beside)
        a[at] -= np.einsum("kw,kwi->ki", jump_a, beside)
        mean = np.einsum("kwi,kwi->kw", way, relative + 0.5 * (v[at] - state.v[owned])[:, None, :])
        # what the force dragged too much was booked with the slip of the step
        booked = stepper.part * drag * self._booked_rate(owned, way, size)
        return v, a, float((mass[:, None] * np.maximum(jump * mean, -booked)).sum())

    def _response_of(self) -> tuple[float, float]:
        """Return velocity [s] and acceleration at the end of this part for a unit force on a unit mass, at rest."""
        scheme, part = self.stepper.scheme, self.stepper.part
        memory = {name: np.zeros((1, 3)) for name in self.stepper.state.memory}
        particle = State(*(np.zeros((1, 3)) for _ in range(7)), memory=memory)
        balance = scheme.balance(particle, part)
        scheme.finish(particle, balance, np.full((1, 3), 1.0 / balance.alpha), part)
        return float(particle.v[0, 0]), float(particle.a[0, 0])

    def _booked_rate(self, nodes: np.ndarray, way: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Return the rates of slip (k, walls) [m/s] with which the solve has booked the friction of nodes (k,).

        A scheme that solves for a position beyond the end of the step has the slip to there: none of nodes that stick
        there and slip at the end. ``way`` (k, walls, 3), ``size`` (k, walls): direction and length of the slip of the
        step.
        """
        stepper = self.stepper
        if stepper.scheme.solves_end:
            return size / stepper.part
        slip = self._moved_to_solution(nodes)
        return np.maximum(np.einsum("kwi,kwi->kw", way, slip), 0.0) / (stepper.balance.time - self._time)

    def _moved_to_solution(self, nodes: np.ndarray) -> np.ndarray:
        """Return displacements of nodes (m,) to the position solved for, relative to the walls (m, w, 3) [m]."""
        balance = self.stepper.balance
        moved = (balance.predictor + self.stepper.solution.u)[nodes] - self._place[nodes]
        return moved[:, None, :] - self._carried(nodes, balance.time)
