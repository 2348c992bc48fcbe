"""Methods that find equilibria, one per module; ``static.method`` names the module."""

from __future__ import annotations

from typing import ClassVar

from pydantic import model_validator

from ...case.base import StrictModel
from ...errors import InputError

_SMALLEST = 2.0**-10  # of the first increment


class Increments(StrictModel):
    """Increments of a method with keys ``step`` and, where increments adapt, ``min_step`` and ``max_step``."""

    growth: ClassVar[float] = 1.0
    """Largest increment unless given, over the first."""

    @property
    def smallest(self) -> float:
        """The smallest increment."""
        return _SMALLEST * self.step if self.min_step is None else self.min_step

    @property
    def largest(self) -> float:
        """The largest increment."""
        return self.growth * self.step if self.max_step is None else self.max_step

    @model_validator(mode="after")
    def _ordered(self) -> Increments:
        if self.smallest > self.step:
            raise InputError(f"min_step = {self.min_step!r} is larger than step = {self.step!r}")
        if self.largest < self.step:
            raise InputError(f"max_step = {self.max_step!r} is smaller than step = {self.step!r}")
        return self
