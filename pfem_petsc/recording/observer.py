"""Observers act after steps: each states when it is due and what it needs."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable

from ..analysis import Step

__all__ = ["NEVER", "Callback", "Observer"]

NEVER = sys.maxsize
"""Number of steps before an event that never occurs."""


class Observer(ABC):
    """Acts after some steps. All methods are collective, and their results are the same on all ranks.

    Attributes
    ----------
    every : due after steps whose number is a multiple of it; 0: never
    needs_agreement : whether the ranks must agree first that none of them has a fault
    """

    every: int = 0
    needs_agreement: bool = False

    def due(self, step: int) -> bool:
        """Return whether the observer acts after this step."""
        return bool(self.every) and step % self.every == 0

    def steps_left(self, step: int) -> int:
        """Return the number of steps until it must act again; these may be fused into one compiled call."""
        return self.every - step % self.every if self.every else NEVER

    @abstractmethod
    def observe(self, made: Step) -> None:
        """Act after a step."""

    def complete(self) -> None:
        """Act after the last step of the run, unless this has been done."""

    def remarks(self) -> list[str]:
        """Return remarks for the user at the end of the run."""
        return []


class Callback(Observer):
    """Calls a function with the finished step."""

    def __init__(self, function: Callable[[Step], object], every: int) -> None:
        self._function, self.every = function, every

    def observe(self, made: Step) -> None:
        """Call the function."""
        self._function(made)
