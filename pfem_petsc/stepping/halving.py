"""Steps that are bisected where they do not converge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..errors import NotConverged
from .stepper import Stepper

if TYPE_CHECKING:
    from ..integrators.base import Scheme
    from .model import Model

__all__ = ["HalvedSteps"]

_HALVINGS = 10  # most halvings of a step: to 1/1024


class HalvedSteps(Stepper):
    """Makes a step in halves of halves where its solve fails.

    Attributes
    ----------
    level : the next step is made in 2**level parts
    message : receives what users are told during a step
    failures : number of failed solves of each kind in this run
    """

    kept_numbers = (*Stepper.kept_numbers, "level")

    def __init__(self, model: Model, scheme: Scheme, h: float) -> None:
        super().__init__(model, scheme, h)
        self.level = 0
        self.message: Callable[[str], None] = lambda text: None
        self.failures: Counter[str] = Counter()

    def tell_failure(self, failure: NotConverged, remedy: str) -> None:
        """Tell the first failure of each kind and what is done about it; others are counted."""
        self.failures[failure.kind] += 1
        if self.failures[failure.kind] == 1:
            self.message(f"{failure}; {remedy} (later ones of this kind are counted at the end)")

    def remarks(self) -> list[str]:
        """Return how many solves failed, if some were not told. Collective."""
        if max(self.failures.values(), default=0) < 2:
            return []
        kinds = "; ".join(f"{kind}: {count}" for kind, count in self.failures.items())
        return [f"{self.failures.total()} solves failed and were repeated with smaller steps ({kinds}); {self.remedy}"]

    def step(self) -> None:
        """Advance by one step; a part that does not converge is bisected, and parts grow again from step to step.

        Raises
        ------
        NotConverged
            On all ranks, if the smallest part does not converge.
        """
        state, ticks = self.state, 2**_HALVINGS
        start, done = state.time, 0
        end = (state.step + 1) * self.h
        size = ticks >> self.level
        self.smallest = self.h
        while done < ticks:
            self._set_part(self.h * (size / ticks))
            try:
                self._make_part(end if done + size == ticks else start + self.h * ((done + size) / ticks))
            except NotConverged as failure:
                if size == 1:
                    raise NotConverged(f"{failure} (the step was bisected {_HALVINGS} times)") from failure
                if self.model.bars_vary:
                    # the failed solve has applied the temperatures and rest lengths of its end
                    self.model.change_bars(self.state.time)
                size //= 2
                self.level += 1
                self.tell_failure(failure, f"bisecting the step, to {self.h * size / ticks:.4g} s")
                continue
            done += size
        self.level = max(self.level - 1, 0)
        self.leave()
        state.step += 1

    def _set_part(self, part: float) -> None:
        if part != self.part:
            self.scheme.step_changed(self.state)
            self.model.contact.motion.step_changed(self.scheme)
            self.step_changed = True
            self.part = part
        self.smallest = min(self.smallest, part)
