"""Base of all integrators: the state that they advance and the affine form of their balance.

With positions as unknowns every scheme is an affine map from the position it solves for, x_u = predictor + u, to the
acceleration and velocity of its balance: a_b = alpha u + a_hat, v_b = eta u + v_hat. The balance is

    M a_b + C v_b + w f_int(x_u) + (1 - w) f_int(x_n) = f_ext + r,

with w = 0 for an explicit scheme. The unknown is the increment u from the predictor, never the position itself:
accelerations are second differences of positions over h^2 and would lose significant digits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from ..case.base import StrictModel

__all__ = ["Balance", "ExplicitScheme", "NoParameters", "Scheme", "State", "lagged_limit"]


@dataclass
class State:
    """Everything that determines the future of a rank's nodes.

    Attributes
    ----------
    x : (local, 3) positions, with ghosts [m]
    v, a : (owned, 3) velocity [m/s] and acceleration [m/s2]
    f : (local, 3) internal force at ``x``, valid for owned nodes [N]
    external, contact, support : (owned, 3) forces of the last balance [N]
    time : float [s]
    step : int
    memory : named arrays (owned, 3) that a scheme keeps between steps
    """

    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    f: np.ndarray
    external: np.ndarray
    contact: np.ndarray
    support: np.ndarray
    time: float = 0.0
    step: int = 0
    memory: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def position(self) -> np.ndarray:
        """(owned, 3) view of the positions of owned nodes [m]."""
        return self.x[: len(self.v)]

    @property
    def rates(self) -> dict[str, np.ndarray]:
        """Velocity, acceleration and memory by name."""
        return {"v": self.v, "a": self.a, **self.memory}


@dataclass
class Balance:
    """The affine form of one step; arrays are (owned, 3).

    Attributes
    ----------
    alpha, eta : a_b = alpha u + a_hat [1/s2], v_b = eta u + v_hat [1/s]
    predictor : x_u = predictor + u [m]
    v_hat, a_hat : known parts; None for zero
    time : at which x_u holds; walls and supports are evaluated at this time [s]
    loads : (weight, time) pairs: the external force of the balance
    weight : w of the module's equation
    discrete_gradient : the internal force is that of the step from x_n to x_u (discrete gradient), not that at x_u
    """

    alpha: float
    eta: float
    predictor: np.ndarray
    v_hat: np.ndarray | None
    a_hat: np.ndarray | None
    time: float
    loads: tuple[tuple[float, float], ...]
    weight: float
    discrete_gradient: bool = False

    @property
    def acting(self) -> float:
        """Where the forces of the balance act, those of walls and links as well as internal ones: x_n + acting (x_u -
        x_n). Their directions are those at this place, else they do work of first order along surfaces that turn."""
        return 0.5 if self.discrete_gradient else self.weight


class NoParameters(StrictModel):
    """Parameters of schemes without parameters."""


class Scheme(ABC):
    """An integrator; a subclass named ``Scheme`` in a module of this package is found by the module's name.

    Attributes
    ----------
    explicit : whether the balance needs no force at the unknown position
    solves_next_position : the scheme solves for x_{n+2} at t_{n+1} (central differences), so x_{n+1} is already known
    balance_at_endpoints : the balance holds at the ends of steps, so works follow the trapezoidal rule; else the forces
        of the balance act over the whole step
    solves_end : the position solved for is x_{n+1}
    discrete_gradient : the internal force of its balances is that of the step (``Balance.discrete_gradient``)
    force_acts_once : a contact force affects only its own step if its acceleration is removed
    leapfrog : whether its steps are those of :mod:`~pfem_petsc.stepping.phases`, with velocities at half steps in the
        memory ``half_velocity``, so that they can be made in compiled calls
    symmetric : whether the Hessian is symmetric
    remembers : names of the scheme's nodal arrays in the state's memory, which are linear in the motion
    turns_held : x1 - x0 = h (v0 + v1)/2 and nothing else relates velocity to position, so the velocity of a node that
        is fixed from one step to the next is reversed
    substeps : of a step that solves several balances: of each the share of the step, and where it ends in the step
    jumps_known : whether the velocity jumps of restitution, and of friction in an impact, are known for it
    notice : message to users who choose the scheme; empty for none
    inertial : whether its balance has inertia; without it there are no velocities, impulses and impacts
    """

    explicit = False
    inertial = True
    jumps_known = True
    solves_next_position = False
    balance_at_endpoints = True
    solves_end = True
    discrete_gradient = False
    force_acts_once = False
    leapfrog = False
    symmetric = True
    remembers: tuple[str, ...] = ()
    turns_held = False
    substeps: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    notice = ""

    def __init__(self, parameters: StrictModel) -> None:
        self.parameters = parameters
        self.set_coefficients()

    def set_coefficients(self) -> None:
        """Set what follows from the parameters; nothing by default."""

    @property
    def rates_follow(self) -> bool:
        """Whether the strain rates at the end of a step are those of its velocities; else they are those of the balance
        for it, or extrapolated if the scheme :attr:`solves_next_position`."""
        if self.explicit:
            return not self.solves_next_position
        return self.discrete_gradient or not self.solves_end

    def limit(self, damping_ratio: float = 0.0, viscous_ratio: float = 0.0) -> float:
        """Return the largest stable Omega = omega h at a damping ratio, and at one of viscous bars; infinite if
        unconditionally stable."""
        return np.inf

    def expected_move(self, state: State, h: float) -> np.ndarray:
        """Return the displacement (owned, 3) of a step predicted from the current motion [m]."""
        return h * state.v

    def start(self, state: State, h: float) -> None:
        """Initialise the memory from the complete initial state (x, v, a); nothing by default."""

    def restart(self, state: State, nodes: np.ndarray | tuple[np.ndarray, np.ndarray], h: float) -> None:
        """Make the memory of some owned nodes consistent with v and a after contact or supports changed them.

        ``nodes`` : (m,), or (nodes, components), both (m,). Nothing by default.
        """

    def step_changed(self, state: State) -> None:
        """Discard memory that depends on the previous step size; (x, v, a) remain complete. Nothing by default."""

    @abstractmethod
    def balance(self, state: State, h: float) -> Balance:
        """Return the affine form of the step that starts from ``state``."""

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        """Advance v, a, memory and (unless :attr:`solves_next_position`) the owned x of ``state`` after the solve; by
        default x, v and a are those of a balance without a_hat."""
        state.position[:] = balance.predictor + u
        state.a = balance.alpha * u
        state.v = balance.v_hat + balance.eta * u


class ExplicitScheme(Scheme):
    """Base class of schemes whose Hessian contains no stiffness."""

    explicit = True

    def advance(self, state: State, h: float) -> None:
        """Move to the next position, which the last balance of a scheme that :attr:`solves_next_position` has
        determined by the mean velocity until then, its memory ``half_velocity``."""
        state.position[:] += h * state.memory["half_velocity"]


def lagged_limit(alpha_m: float, beta: float, gamma: float, damping_ratio: float) -> float:
    """Return the stability limit of explicit Newmark schemes, (1-a_m) a1 + a_m a0 + 2 xi w v0 + w^2 x0 = 0.

    The eigenvalue -1 appears at (2 beta - gamma)/2 Omega^2 + xi (2 gamma - 1) Omega - (1 - 2 a_m) = 0.
    """
    quadratic = 0.5 * (2.0 * beta - gamma)
    linear = damping_ratio * (2.0 * gamma - 1.0)
    constant = 1.0 - 2.0 * alpha_m
    if constant == linear == quadratic == 0.0:
        return 2.0  # rho_b = 1 of Hulbert and Chung: Omega^2 = 12 (1 + rho_b)(2 - rho_b)/(10 - 5 rho_b + rho_b^2)
    return 2.0 * constant / (linear + np.sqrt(linear * linear + 4.0 * quadratic * constant))
