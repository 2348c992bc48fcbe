"""Observers act after steps: each states when it is due and what it needs."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable

from ..analysis import Step

__all__ = ["NEVER", "Callback", "Observer"]

NEVER = sys.maxsize
"""Steps left to something that never comes."""


class Observer(ABC):
    """Does something after some steps. All methods are collective, and their answers are the same on all ranks.

    Attributes
    ----------
    every : due after steps whose number is a multiple of it; 0: after none
    needs_agreement : whether the ranks must have agreed before that none of them has a fault
    """

    every: int = 0
    needs_agreement: bool = False

    def due(self, step: int) -> bool:
        """Whether it acts after this step."""
        return bool(self.every) and step % self.every == 0

    def steps_left(self, step: int) -> int:
        """Steps from this one to the next after which it must act: those between may be made by one compiled call."""
        return self.every - step % self.every if self.every else NEVER

    @abstractmethod
    def observe(self, made: Step) -> None:
        """Act after a step that was made."""

    def complete(self) -> None:
        """Act after the last step of the run, where that has not been done."""

    def remarks(self) -> list[str]:
        """What a user should know at the end of the run."""
        return []


class Callback(Observer):
    """A function that is called with the finished step."""

    def __init__(self, function: Callable[[Step], object], every: int) -> None:
        self._function, self.every = function, every

    def observe(self, made: Step) -> None:
        """Call it."""
        self._function(made)
