"""Equilibrium in the form of an integrator's balance: no inertia, no damping; with the load factor known or unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..integrators.base import Balance, NoParameters, Scheme, State


class Equilibrium(Scheme):
    """The balance f_int(x1) = f_ext(t1) + r, where t is the load factor; the unknown is the displacement increment.

    With viscosity C the balance is f_int(x1) + C u/h = f_ext(t1) + r for the displacement u over the increment h.

    The state's memory has ``rate``: displacement per load factor in the last increment, which predicts the next one.

    Parameters
    ----------
    lack : (owned,) viscosity over mass, None without viscosity

    Attributes
    ----------
    releases : whether the balance is that of the state's own load factor, without viscosity
    creeps : whether it is so with viscosity
    """

    inertial = False
    remembers = ("rate",)
    dissipates = True

    def __init__(self, lack: np.ndarray | None = None) -> None:
        super().__init__(NoParameters())
        self.lack, self.releases, self.creeps = lack, False, False

    def start(self, state: State, h: float) -> None:
        state.memory["rate"] = np.zeros_like(state.v)

    def expected_move(self, state: State, h: float) -> np.ndarray:
        return h * state.memory["rate"]

    def balance(self, state: State, h: float) -> Balance:
        end = state.time if self.releases or self.creeps else state.time + h
        return Balance(
            alpha=0.0,
            eta=0.0 if self.lack is None or self.releases or not h else 1.0 / h,
            predictor=state.position.copy(),
            v_hat=None,
            a_hat=None,
            time=end,
            loads=((1.0, end),),
            weight=1.0,
        )

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        if not self.releases and not self.creeps:
            state.memory["rate"] = u / h
        # the viscous force is what equilibrium lacks: the ledger books it as inertia
        state.a = self.lack[:, None] * (u * balance.eta) if balance.eta else np.zeros_like(u)


class PathEquilibrium(Equilibrium):
    """The balance of :class:`~.scheme.Equilibrium` for steps whose displacement and load factor are known in advance.

    ``reached`` is the load factor of the next point.
    The state's memory has ``tangent``: the displacement part of the unit tangent of the path at the state.
    """

    remembers = ("tangent",)

    def __init__(self) -> None:
        super().__init__()
        self.reached = 0.0

    def balance(self, state: State, h: float) -> Balance:
        """Return the balance at the load factor reached; ``h`` is a length, not an increment of the load factor."""
        return replace(super().balance(state, 0.0), time=self.reached, loads=((1.0, self.reached),))

    def start(self, state: State, h: float) -> None:
        state.memory["tangent"] = np.zeros_like(state.v)

    def expected_move(self, state: State, h: float) -> np.ndarray:
        return h * state.memory["tangent"]

    def finish(self, state: State, balance: Balance, u: np.ndarray, h: float) -> None:
        state.position[:] = balance.predictor + u
        state.a = np.zeros_like(u)
