"""Check before the first step whether contact gains energy with the settings of a case, by impacts of an elastic
rod.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from ..contact.explicit import impact_square, rebound_way
from ..integrators.base import Balance, Scheme, State
from ..registry import lookup

if TYPE_CHECKING:
    from ..case.model import Time
    from ..case.schema import Case


KNOWN = ("scheme", "stick", "conserving", "mass_redistribution")
"""Treatments that the rods implement; there is no prediction for others."""

PHASES = 14
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


@dataclass(frozen=True)
class Asked:
    """Parameters of the scan, as a case specifies them.

    Attributes
    ----------
    treatment : ``contact.treatment``
    consistent : whether the mass matrix is consistent; else lumped
    step : relative to the explicit limit of the lumped rod, l/c
    restitution : of the wall
    elements : bars along a rod
    """

    treatment: str
    consistent: bool
    step: float
    restitution: float = 0.0
    elements: int = 20


class _Rods:
    """Rods of unit spring constant and inner mass, so that the explicit limit of the step (lumped mass) is one.

    The arrays of a state have one row per node, rod after rod, and one column.
    """

    def __init__(self, scheme: Scheme, asked: Asked, phases: int, held: bool = False) -> None:
        self.scheme, self.treatment, self.h, self.held = scheme, asked.treatment, asked.step, held
        consistent, step = asked.consistent, asked.step
        self.restitution = 0.0 if held else asked.restitution
        nodes = asked.elements + 1
        self.shape = (phases, nodes)
        k = 2.0 * np.eye(nodes) - np.eye(nodes, k=1) - np.eye(nodes, k=-1)
        k[0, 0] = k[-1, -1] = 1.0
        mass = np.eye(nodes)
        mass[0, 0] = mass[-1, -1] = 0.5
        if consistent:
            mass = mass - k / 6.0
        self.massless = asked.treatment == "mass_redistribution" and not held
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
        scheme.start(self.state, step)
        if scheme.solves_next_position:
            self._solve()

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
        """Advance all rods by a step, with the treatment of impact."""
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
def scan_impacts(scheme: Scheme, asked: Asked, phases: int = PHASES) -> ImpactScan:
    """Integrate rods that hit a wall at different phases of a step until they have left it in the exact solution.

    ``phases`` : number of rods.
    """
    # omega = 2 is the highest frequency of unit springs and masses, so h = 1 is the limit of central differences
    steps = int(np.ceil(2.5 * asked.elements / asked.step)) + 2 * _START + 2
    swing = _swing(scheme, asked, steps) if scheme.explicit else 1.0
    rods = _Rods(scheme, asked, phases)
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


def _swing(scheme: Scheme, asked: Asked, steps: int) -> float:
    """See :class:`ImpactScan`."""
    rod = _Rods(scheme, replace(asked, treatment="scheme"), 1, held=True)
    swing = 1.0
    for _ in range(steps):
        rod.step()
        swing = max(swing, float(np.nan_to_num(rod.energy()[0], nan=np.inf)))
        if swing > 1.0 + SWING:
            break
    return swing


BOUND = 0.005
"""Relative energy gain in impacts of the small rod above which a warning is given."""

_RODS = 1, 20
"""Smallest and largest number of bars of the rods: in some trusses a wave passes within a step, as in short rods."""
_STEPS = 0.1, 50.0  # relative to the explicit limit; smaller and larger steps behave like these


@cache
def contact_gain(integrator: str, parameters: str, asked: Asked) -> float:
    """Return the largest relative energy gain of impacts over all phases, at this step and at a quarter of it.

    The smaller step represents nodes that are slower than the fastest one, because chatter depends on the step.
    ``parameters`` are those of the integrator as JSON.
    """
    module = lookup("pfem_petsc.integrators", integrator, "time.integrator")
    scheme = module.Scheme(module.Parameters.model_validate_json(parameters))
    low, high = _STEPS
    sizes = sorted({min(max(size, low), high) for size in (asked.step, 0.25 * asked.step)})
    return max(scan_impacts(scheme, replace(asked, step=size)).gain for size in sizes)


def overshoots(integrator: str, step: float) -> bool:
    """Return whether impacts may gain energy by an overshoot that the small rod does not show.

    ``wilson`` treats the force that stops a node at t + theta h as an acceleration that grows linearly up to that time.
    Beyond the explicit limit the first steps after such a jump overshoot for any theta, and more so for larger steps;
    whether a truss gains energy depends on the motion of its nodes in these steps.
    """
    return integrator == "wilson" and step > 1.0


def warn_of_gain(case: Case, step: float, across: float = np.inf) -> str:
    """Return the warning about a case whose contact gains energy beyond :data:`BOUND`; empty if it does not, and for
    treatments that the small rods do not implement.

    ``step`` : relative to the limit of central differences with lumped mass; ``across`` : time in which a wave crosses
    the truss, in units of that limit.
    """
    if case.contact.treatment not in KNOWN:
        return ""
    time = case.time
    step = float(f"{step:.2g}")  # rounded, so that similar cases share one scan
    elements = int(np.clip(np.round(across), *_RODS))
    gains = {}
    for restitution in sorted({0.0, *(float(f"{wall.restitution:.2g}") for wall in case.wall)}):
        asked = Asked(case.contact.treatment, time.mass == "consistent", step, restitution, elements)
        gains[contact_gain(time.integrator, time.scheme.model_dump_json(), asked)] = asked
    gain = max(gains)
    asked = gains[gain]
    if gain <= BOUND and not overshoots(time.integrator, step):
        return ""
    named = ", ".join(f"{name} = {value:.4g}" for name, value in time.scheme.model_dump().items())
    size = f"by {100.0 * gain:.2g} % of the energy" if gain < 10.0 else "by more than ten times the energy"
    restitution = f"restitution {asked.restitution:g}, " if asked.restitution else ""
    if gain <= BOUND:
        return (
            f"contact: wilson{f' ({named})' if named else ''} with contact and steps of {step:.2g} times the explicit "
            "limit gains energy in impacts: its first steps after a node is stopped overshoot, by more the larger the "
            f"step, at any theta; use {_remedies(time, asked)}"
        )
    return (
        f'contact: {time.integrator}{f" ({named})" if named else ""} with contact.treatment = "{asked.treatment}", '
        f'{restitution}time.mass = "{time.mass}" and steps of {step:.2g} times the explicit limit gains energy in '
        f"impacts: {size} in the worst of {PHASES} phases of a step at which a rod meets a wall; use "
        f"{_remedies(time, asked)}"
    )


def _remedies(time: Time, asked: Asked) -> str:
    """Return at most two settings that do not gain energy, closest to the case first."""
    parameters = time.scheme.model_dump_json()
    tries = []
    for other in ("stick", "scheme"):
        if other != asked.treatment and not asked.restitution:
            lumped = other == "stick" and asked.consistent
            text = f'contact.treatment = "{other}"' + (' and time.mass = "lumped"' if lumped else "")
            changed = replace(asked, treatment=other, consistent=asked.consistent and not lumped)
            tries.append((text, time.integrator, parameters, changed))
    if time.integrator == "wilson":
        tries.append(("time.theta = 2", "wilson", '{"theta": 2.0}', asked))
    for size in (1.0, 0.2):
        if asked.step > size:
            text = f"a time.step of at most {size:g} times the explicit limit"
            tries.append((text, time.integrator, parameters, replace(asked, step=size)))
    newmark = 'time.integrator = "newmark" with its default parameters'
    tries.append((newmark, "newmark", "{}", asked))
    if asked.restitution:
        tries.append(('time.integrator = "energy_momentum"', "energy_momentum", "{}", asked))
        for less in (0.9, 0.5):
            if asked.restitution > less:
                text = f"a restitution of at most {less:g}"
                tries.append((text, time.integrator, parameters, replace(asked, restitution=less)))
    found = [text for text, *what in tries if contact_gain(*what) <= BOUND and not overshoots(what[0], what[2].step)]
    smaller = [text for text in found if text.startswith("a time.step")]
    found = [text for text in found if text not in smaller[1:]]  # of several step sizes keep the largest
    return ", or ".join(found[:2]) if found else newmark
