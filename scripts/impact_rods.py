"""Small linear rods that hit a wall at different phases of a step, with all integrators and treatments of impact.

They are written for themselves, with dense matrices; tests compare them with the program.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pfem_petsc.contact.explicit import impact_square, rebound_way
from pfem_petsc.contact.impact_gains import PHASES, RodImpact
from pfem_petsc.integrators.base import Balance, Scheme, State

SWING = 0.05
"""Allowed relative oscillation of the energy of a scheme without impact; it is large near explicit stability limits."""
_START = 3  # steps of free flight before the earliest impact, so that multistep schemes have their history
_CONTACT = 1e-12  # of the force that stops a node within a step; forces below are rounding


@dataclass(frozen=True)
class ImpactScan:
    """Results of the impacts of all rods; arrays are (phases,).

    Attributes
    ----------
    largest, last : largest energy and energy at the end, relative to that before impact
    releases : number of releases
    force : largest force relative to the exact one, rho c A v
    swing : largest energy, relative to the initial one, of a rod permanently attached to the wall: with explicit
        schemes this energy is not constant even without closing and opening. Not followed beyond the limit
        :data:`SWING`, and 1 for implicit schemes, which get no allowance
    """

    largest: np.ndarray
    last: np.ndarray
    releases: np.ndarray
    force: np.ndarray
    swing: float

    @property
    def gain(self) -> float:
        """Largest relative energy gain by contact over all phases, beyond the scheme's own oscillation (up to
        :data:`SWING`); infinite if the motion diverged."""
        worst = float(self.largest.max()) / min(self.swing, 1.0 + SWING)
        return max(worst - 1.0, 0.0) if np.isfinite(worst) else np.inf


class _Rods:
    """Rods of unit spring constant and inner mass, so that the explicit limit of the step (lumped mass) is one.

    The arrays of a state have one row per node, rod after rod, and one column.
    """

    def __init__(self, scheme: Scheme, impact: RodImpact, phases: int, held: bool = False) -> None:
        self.scheme, self.treatment, self.h, self.held = scheme, impact.treatment, impact.step, held
        consistent, step = impact.consistent, impact.step
        self.restitution = 0.0 if held else impact.restitution
        nodes = impact.bars + 1
        self.shape = (phases, nodes)
        k = 2.0 * np.eye(nodes) - np.eye(nodes, k=1) - np.eye(nodes, k=-1)
        k[0, 0] = k[-1, -1] = 1.0
        mass = np.eye(nodes)
        mass[0, 0] = mass[-1, -1] = 0.5
        if consistent:
            mass = mass - k / 6.0
        self.massless = impact.treatment == "mass_redistribution" and not held
        if self.massless:
            mass[-2, -2] += mass[-1, -1]
            mass[-1, -1] = 0.0
        self.k, self.m = k, mass
        self.tip = 0.5  # lumped mass of the contact node, if it has mass
        self.tips = np.arange(1, phases + 1) * nodes - 1
        self.wall = step * (_START + (np.arange(phases) + 0.5) / phases)  # gaps at unit speed
        zeros = np.zeros((phases * nodes, 1))
        self.state = State(zeros.copy(), zeros + 1.0, *(zeros.copy() for _ in range(5)))
        if held:
            self.wall[:] = 0.0
            self.state.v[self.tips] = 0.0
        self.start = self._energy()
        self.touching = np.zeros(phases, dtype=bool)
        self.strength = np.zeros(phases)
        self.change = np.zeros(phases)
        self.debt = np.zeros(phases)
        # for rods that hit the wall in the last step, if restitution bounds the next position; see rebound_way
        self.square, self.arrival = np.zeros(phases), np.zeros(phases)
        self._inverse: tuple[float, np.ndarray] | None = None
        self.h = scheme.substeps[-1][0] * step  # the start is the end of a step
        scheme.start(self.state, self.h)
        if scheme.solves_next_position:
            self._solve()
        self.h = step

    def rods(self, values: np.ndarray) -> np.ndarray:
        """Return a (phases, nodes) view of an array of the state."""
        return values.reshape(self.shape)

    def energy(self) -> np.ndarray:
        """Return (phases,) kinetic plus elastic energy, relative to its initial value."""
        return self._energy() / self.start

    def _energy(self) -> np.ndarray:
        x, v = self.rods(self.state.x), self.rods(self.state.v)
        return 0.5 * (np.einsum("pi,ij,pj->p", v, self.m, v) + np.einsum("pi,ij,pj->p", x, self.k, x))

    def step(self) -> None:
        """Advance all rods by a step."""
        whole = self.h
        for share, _ in self.scheme.substeps:
            self.h = share * whole
            self._balance_step()
        self.h = whole

    def _balance_step(self) -> None:
        """Advance all rods by a balance of the step, with the treatment of impact."""
        state = self.state
        start = state.x[self.tips, 0].copy()
        before, touched = self.strength + self.change, self.touching
        free = self._free()
        speed, approach = state.v[self.tips, 0].copy(), self._approach(start, free)
        if self.scheme.solves_next_position:
            self.scheme.advance(state, self.h)
            state.time += self.h
            self._solve()
        else:
            self._solve()
            state.time += self.h
        self.change[:] = 0.0
        if self.massless:
            if not self.scheme.explicit:
                self._set(np.ones_like(self.touching), (state.x[self.tips, 0] - start) / self.h, 0.0)
        elif self.treatment == "stick" or (self.restitution and not self.scheme.solves_next_position):
            self._set(self.touching, 0.0, 0.0)
            if self.restitution:
                way, after = np.maximum(state.x[self.tips, 0] - start, 0.0), self._free()
                if approach is None:
                    square = np.maximum(speed * speed + (free + after) * way, 0.0)
                    away = np.where(speed > 0.0, self.restitution * np.sqrt(square), 0.0)
                else:
                    square = impact_square(approach, way, self.h * self.h * free)
                    away = rebound_way(self.restitution, square, way, self.h * self.h * after) / self.h
                self._set(self.touching & ~touched, -away, after)
            if self.scheme.balance_at_endpoints and not self.scheme.solves_next_position:
                self._let_go(touched & ~self.touching, start, before)
        elif self.treatment == "conserving":
            self._take_back(start, before)

    def _approach(self, start: np.ndarray, free: np.ndarray) -> np.ndarray | None:
        """Return (phases,) displacements of the last nodes in the next step without a wall.

        For explicit schemes that do not solve for the next position.
        """
        if not self.restitution or not self.scheme.explicit or self.scheme.solves_next_position:
            return None
        balance = self.scheme.balance(self.state, self.h)
        known = 0.0 if balance.a_hat is None else balance.a_hat[self.tips, 0]
        return balance.predictor[self.tips, 0] - start + (free - known) / balance.alpha

    def _solve(self) -> None:
        balance = self.scheme.balance(self.state, self.h)
        x, predictor = self.rods(self.state.x), self.rods(balance.predictor)
        load = np.zeros(self.shape)
        if balance.a_hat is not None:
            load -= self.rods(balance.a_hat) @ self.m
        weight = 0.5 * balance.weight if balance.discrete_gradient else balance.weight
        load -= (weight * predictor + (1.0 - weight) * x) @ self.k
        if self.massless and self.scheme.explicit:
            u, self.strength = self._in_equilibrium(balance, load, predictor, x)
        else:
            u, self.strength = self._bounded(balance.alpha * self.m + weight * self.k, load, predictor)
        self.touching = self.strength > _CONTACT / self.h
        self.scheme.finish(self.state, balance, u.reshape(-1, 1), self.h)

    def _bounded(self, hessian: np.ndarray, load: np.ndarray, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the increments of a step in which the wall bounds the last node, and wall forces (phases,) >= 0."""
        wall = self.wall
        if self._inverse is None or self._inverse[0] != hessian[0, 0]:
            self._inverse = hessian[0, 0], np.linalg.inv(hessian)
        inverse = self._inverse[1]
        u = load @ inverse
        if self.restitution and self.scheme.solves_next_position:
            way = rebound_way(self.restitution, self.square, self.arrival, u[:, -1]) - 0.5 * u[:, -1]
            wall = wall - np.where(self.square > 0.0, np.maximum(way, 0.0), 0.0)
        strength = (predictor[:, -1] + u[:, -1] - wall) / inverse[-1, -1]
        if not self.held:
            strength = np.maximum(strength, 0.0)
        if self.restitution and self.scheme.solves_next_position:
            approach = predictor[:, -1] + u[:, -1] - self.state.x[self.tips, 0]
            fresh = (strength > _CONTACT / self.h) & ~self.touching
            way = self.wall - self.state.x[self.tips, 0]
            self.arrival = np.where(fresh, way, 0.0)
            self.square = np.where(fresh, impact_square(approach, way, u[:, -1]), 0.0)
        return u - strength[:, None] * inverse[-1], strength

    def _in_equilibrium(
        self, balance: Balance, load: np.ndarray, predictor: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`_bounded`, for explicit steps and a massless last node, which follows its neighbour to the wall.

        The force is that at the start of the step.
        """
        strength = np.where(x[:, -1] >= self.wall - 1e-12, np.maximum(load[:, -1], 0.0), 0.0)
        u = np.zeros(self.shape)
        u[:, :-1] = load[:, :-1] / (balance.alpha * np.diag(self.m)[:-1])
        u[:, -1] = np.minimum(predictor[:, -2] + u[:, -2], self.wall) - predictor[:, -1]
        return u, strength

    def _set(self, chosen: np.ndarray, v: np.ndarray | float, a: np.ndarray | float) -> None:
        """Set velocities and accelerations of the last nodes of some rods."""
        state, at = self.state, self.tips[chosen]
        if not len(at):
            return
        state.v, state.a = state.v.copy(), state.a.copy()
        old = state.a[at, 0]
        state.v[at, 0] = np.broadcast_to(v, chosen.shape)[chosen]
        state.a[at, 0] = np.broadcast_to(a, chosen.shape)[chosen]
        if not self.massless:
            self.change[chosen] -= self.tip * (state.a[at, 0] - old)
        self.scheme.restart(state, at, self.h)

    def _let_go(self, chosen: np.ndarray, start: np.ndarray, before: np.ndarray) -> None:
        """Remove from the velocity of released nodes the work done by the contact force at the start of the step."""
        v = self.state.v[self.tips, 0]
        work = -0.5 * before * (self.state.x[self.tips, 0] - start)
        chosen = chosen & (work > 0.0) & (v < 0.0)
        self._set(chosen, -np.sqrt(np.maximum(v * v - 2.0 * work / self.tip, 0.0)), self.state.a[self.tips, 0])

    def _take_back(self, start: np.ndarray, before: np.ndarray) -> None:
        """Apply the velocity update of Laursen and Love, which cancels the work of contact."""
        state = self.state
        force = 0.5 * (self.strength + before) if self.scheme.balance_at_endpoints else self.strength
        work = self.debt - force * (state.x[self.tips, 0] - start)
        square = state.v[self.tips, 0] ** 2 - 2.0 * work / self.tip
        self.debt = np.where(self.touching, np.maximum(-0.5 * self.tip * square, 0.0), self.debt)
        self._set(self.touching, -np.sqrt(np.maximum(square, 0.0)), self._free())

    def _free(self) -> np.ndarray:
        """Return (phases,) accelerations of the last nodes without contact."""
        return -(self.rods(self.state.x) @ self.k)[:, -1] / self.tip


@np.errstate(all="ignore")
def scan_impacts(scheme: Scheme, impact: RodImpact, phases: int = PHASES) -> ImpactScan:
    """Integrate rods that hit a wall at different phases of a step until they have left it in the exact solution.

    ``phases`` : number of rods.
    """
    # omega = 2 is the highest frequency of unit springs and masses, so h = 1 is the limit of central differences
    steps = int(np.ceil(2.5 * impact.bars / impact.step)) + 2 * _START + 2
    swing = _swing(scheme, impact, steps) if scheme.explicit else 1.0
    rods = _Rods(scheme, impact, phases)
    largest, force, releases = np.ones(phases), np.zeros(phases), np.zeros(phases, dtype=int)
    for _ in range(steps):
        touched = rods.touching
        rods.step()
        energy = rods.energy()
        largest, force = np.fmax(largest, energy), np.fmax(force, rods.strength)
        releases += touched & ~rods.touching
        if not np.isfinite(energy).all() or energy.max() > 1e6:
            largest = np.where(np.isfinite(energy), largest, np.inf)
            break
    return ImpactScan(largest, energy, releases, force, swing)


def _swing(scheme: Scheme, impact: RodImpact, steps: int) -> float:
    """See :class:`ImpactScan`."""
    rod = _Rods(scheme, replace(impact, treatment="scheme"), 1, held=True)
    swing = 1.0
    for _ in range(steps):
        rod.step()
        swing = max(swing, float(np.nan_to_num(rod.energy()[0], nan=np.inf)))
        if swing > 1.0 + SWING:
            break
    return swing
