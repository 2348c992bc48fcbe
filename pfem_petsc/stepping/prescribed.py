"""Prescribed motion of supports in steps: exact positions, velocities and accelerations from their tables."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..integrators.base import Balance, State

if TYPE_CHECKING:
    from .stepper import Stepper

__all__ = ["NoRates", "PrescribedMotion"]


class PrescribedMotion:
    """Sets prescribed components in the balances and the state of a stepper.

    Attributes
    ----------
    change : changes of velocity, acceleration and scheme memory of prescribed components (k,) relative to those of the
        scheme in the last step, by name; empty without moving supports
    """

    def __init__(self, stepper: Stepper) -> None:
        self.stepper, self.supports = stepper, stepper.model.supports
        self.moving = self.supports.moving
        self.change: dict[str, np.ndarray] = {}

    def place(self, end: float) -> None:
        """Set prescribed components of the positions to their values at a time [s]."""
        if self.moving:
            self.supports.place(self.stepper.state.position, self.supports.positions(end))

    def prescribe(self, balance: Balance) -> None:
        """Set exact positions, velocities and accelerations of prescribed components in a balance; their increments are
        zero. The scheme's own formulas would derive velocities and accelerations from positions and oscillate."""
        supports = self.supports
        forces_hold = sum(weight * time for weight, time in balance.loads)
        v, a = supports.rates(forces_hold, self.stepper.part)
        self._ruled = self._by_rule(balance, a)
        balance.predictor = balance.predictor.copy()
        supports.place(balance.predictor, supports.positions(balance.time))
        balance.v_hat = np.zeros_like(self.stepper.state.v) if balance.v_hat is None else balance.v_hat.copy()
        supports.put(balance.v_hat, v)
        balance.a_hat = np.zeros_like(self.stepper.state.v) if balance.a_hat is None else balance.a_hat.copy()
        supports.put(balance.a_hat, a)

    def _by_rule(self, balance: Balance, a: np.ndarray) -> State:
        """Return the state of prescribed components (k, 1) if the scheme advanced them with accelerations (k,).

        This is the rule by which forces become impulses.
        """
        supports, state = self.supports, self.stepper.state

        def pick(array: np.ndarray | None) -> np.ndarray | None:
            return None if array is None else supports.get(array)[:, None]

        memory = {name: pick(state.memory[name]) for name in self.stepper.scheme.remembers if name in state.memory}
        fields = (pick(array) for array in (state.position, state.v, state.a))
        ruled = State(*fields, *(np.zeros((len(a), 1)) for _ in range(4)), memory=memory)
        known = {name: pick(getattr(balance, name)) for name in ("predictor", "v_hat", "a_hat")}
        own = replace(balance, **known)
        u = (a[:, None] if own.a_hat is None else a[:, None] - own.a_hat) / own.alpha
        self.stepper.scheme.finish(ruled, own, u, self.stepper.part)
        return ruled

    def take_rates(self, time: float) -> None:
        """Set velocity, acceleration and scheme memory of prescribed components at a time [s]."""
        supports, state = self.supports, self.stepper.state
        for array, values in zip((state.v, state.a), supports.rates(time, self.stepper.part), strict=True):
            supports.put(array, values)
        self._restart()
        if self.stepper.scheme.solves_next_position:
            way = supports.positions(self.stepper.balance.time) - supports.positions(time)
            supports.put(state.memory["half_velocity"], way / self.stepper.part)
        ruled, given = self._ruled, {"v": state.v, "a": state.a, **state.memory}
        made = {"v": ruled.v, "a": ruled.a, **ruled.memory}
        self.change = {name: supports.get(given[name]) - array[:, 0] for name, array in made.items()}

    def _restart(self) -> None:
        """Make the memory of the scheme consistent with the new velocities and accelerations."""
        supports, state, scheme = self.supports, self.stepper.state, self.stepper.scheme
        if supports.inclined is None:
            scheme.restart(state, supports.at, self.stepper.part)
            return
        names = [name for name in scheme.remembers if name in state.memory]
        fields = (supports.get(array)[:, None] for array in (state.position, state.v, state.a))
        memory = {name: supports.get(state.memory[name])[:, None] for name in names}
        along = State(*fields, *(np.zeros((supports.number, 1)) for _ in range(4)), memory=memory)
        scheme.restart(along, np.arange(supports.number), self.stepper.part)
        for name in names:
            supports.put(state.memory[name], memory[name][:, 0])


class NoRates(PrescribedMotion):
    """For balances without inertia, where supports prescribe positions alone: these are part of the guess."""

    def __init__(self, stepper: Stepper) -> None:
        super().__init__(stepper)
        self.moving = False
