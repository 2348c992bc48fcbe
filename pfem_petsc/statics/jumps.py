"""Jumps within an increment of a static analysis: told by their energy.

Between two states of a path of equilibria, the trapezoidal rule gives the work on the bars, forces at both ends times
the displacement. It differs from the change of their energy by an amount, here the defect, that falls with the third
power of the increment where the path is smooth, and with the second at corners, as where bars begin to yield. Where the
truss snaps through there is no path: the defect is the energy that would become motion, however small the increment. So
an increment with a noticeable defect is divided by equilibria in between until each part has either a small defect or
one that no longer falls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from ..stepping.model import Model

_NOTICEABLE = 1e-2  # defect of a part over the sum of the magnitudes of its works, below which it is a path
_LEAST = 1e-4  # the same over the works of the whole increment
_ROUNDING = 1e-12  # of the energy of the bars
_KEPT = 0.4  # of the defect after so many divisions: a jump. Straight cables keep 1/16, smooth paths at most 1/23
_DIVISIONS = 3
_DEEP = 10  # divisions after which a defect that stays is a jump, and no steep part of a path
_DEEPEST = 20


class Place(NamedTuple):
    """A state within an increment: the part of the increment up to it, load factor and local positions [m]."""

    part: float
    load_factor: float
    x: np.ndarray


class Jump(NamedTuple):
    """Load factors before and after a jump, and the energy that it releases [J]."""

    first: float
    last: float
    energy: float

    def __str__(self) -> str:
        between = f"between load factors {self.first:.9g} and {self.last:.9g}"
        return f"{between} the truss jumps, which releases {self.energy:.4g} J"


class JumpSearch:
    """Looks for jumps between two states, evaluated with the internal variables of the last complete one.

    Parameters
    ----------
    model : Model
    between : returns the state at a part of the increment from a guess of local positions, None if it finds none;
        collective
    """

    def __init__(self, model: Model, between: Callable[[float, np.ndarray], Place | None]) -> None:
        self._model, self._between = model, between
        self._least = 0.0

    def look(self, first: Place, last: Place) -> list[Jump]:
        """Return the jumps between two states; the bars are left as they are at the last one. Collective."""
        defect, works = self._defect(first, last)
        self._least = _LEAST * works
        found = self._divide(first, last, defect, works, ())
        self._model.change_bars(last.load_factor)
        return found

    def _divide(self, first: Place, last: Place, defect: float, works: float, before: tuple[float, ...]) -> list[Jump]:
        """Return the jumps of a part; ``before``: defects of the parts that it is a part of."""
        depth = len(before)
        if abs(defect) <= max(_NOTICEABLE * works, self._least) or depth == _DEEPEST:
            return []
        stays = depth >= _DIVISIONS and defect > _KEPT * abs(before[-_DIVISIONS])
        middle = None if stays and depth >= _DEEP else self._middle(first, last)
        if middle is None:
            return [Jump(first.load_factor, last.load_factor, defect)] if stays else []
        parts = (first, middle), (middle, last)
        return [jump for part in parts for jump in self._divide(*part, *self._defect(*part), (*before, defect))]

    def _middle(self, first: Place, last: Place) -> Place | None:
        """Return the state halfway, if possible that which continues the first one. Collective."""
        guesses = first.x, 0.5 * (first.x + last.x), last.x
        found = (self._between(0.5 * (first.part + last.part), guess) for guess in guesses)
        return next((middle for middle in found if middle is not None), None)

    def _defect(self, first: Place, last: Place) -> tuple[float, float]:
        """Return work minus change of energy [J], and the sum of the magnitudes of the works. Collective."""
        model, owned = self._model, self._model.mesh.n_owned
        model.change_bars(last.load_factor)
        forces = np.zeros((2, *first.x.shape))
        energies = [model.bars.forces(place.x, f, commit=False).total for place, f in zip((first, last), forces)]
        works = (forces[:, :owned] * (last.x - first.x)[:owned]).sum(axis=2)
        sums = model.comm.allreduce(np.array([works.sum(), np.abs(works).sum(), *energies]))
        defect = 0.5 * float(sums[0]) - float(sums[3] - sums[2])
        if not abs(defect) > _ROUNDING * float(np.abs(sums[2:]).sum()):
            return 0.0, 0.0
        return defect, 0.5 * float(sums[1])
