"""Bars and supports that a case removes at a time, or at a load factor."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..mechanics.broken_bars import release
from ..mesh.node_sets import group_hint
from ..tolerances import TIME

if TYPE_CHECKING:
    from ..case.tables import Remove
    from .stepper import Stepper

__all__ = ["Removals"]

_NEVER = -1.0


class Removals:
    """Removes bars and supports at the ends of steps: the step that reaches the time is made with them.

    A bar loses its share over the duration, with the stored energy. A support is replaced by its reaction, which
    decreases linearly over the duration as an external force.

    Parameters
    ----------
    stepper : Stepper

    Attributes
    ----------
    released : (owned, 3 k) reactions of the k removed supports at the beginning of their removal [N]
    times : time [s], or load factor, at which the removal of each entry has begun; -1 before
    gone : names of the supports that are removed, of stages before too
    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper, self._model = stepper, stepper.model
        case, mesh = self._model.case, self._model.mesh
        self._entries = list(case.remove)
        self._complete = [False] * len(self._entries)
        self.times = [_NEVER] * len(self._entries)
        self.gone: list[str] = []
        supports = [entry for entry in self._entries if entry.supports is not None]
        self.released = np.zeros((mesh.n_owned, 3 * len(supports)))
        self._columns = {entry.supports: 3 * k for k, entry in enumerate(supports)}
        self._members: dict[str, np.ndarray] = {}
        for index, entry in enumerate(self._entries):
            key = f"{case.source}: remove[{index}]"
            if entry.bars is not None:
                if entry.bars not in mesh.bar_groups:
                    hint = group_hint(case, entry.bars, sorted(mesh.bar_groups), "Curve")
                    raise InputError(f"{key}.bars = {entry.bars!r}: no such group of bars{hint}")
                self._members[entry.bars] = mesh.bar_groups[entry.bars]
            elif self._model.links or self._model.inertia.redistribution is not None:
                what = "contact pairs and constraints" if self._model.links else "massless contact nodes"
                raise InputError(
                    f"{key}.supports = {entry.supports!r}: {what} require supports that remain; remove bars "
                    "instead, or leave them out"
                )

    def _done(self, k: int) -> bool:
        entry, now = self._entries[k], self._stepper.state.time
        return self.times[k] >= 0.0 and now >= (entry.time + entry.duration) * (1.0 - TIME)

    def _left(self) -> list[Remove]:
        """Return what is not removed yet."""
        return [entry for k, entry in enumerate(self._entries) if not self._done(k)]

    def next(self) -> float:
        """Return the time [s], or load factor, up to which nothing is removed; infinite if nothing is left."""
        now = self._stepper.state.time
        return min((max(entry.time, now) for entry in self._left()), default=math.inf)

    def ends(self) -> float:
        """Return the next time [s], or load factor, that a step must not pass: a removal begins or ends there."""
        now = self._stepper.state.time
        marks = [
            mark
            for entry in self._left()
            for mark in (entry.time, entry.time + entry.duration)
            if mark > now * (1.0 + TIME) and mark > 0.0
        ]
        return min(marks, default=math.inf)

    def steps_left(self) -> int:
        """Return the number of steps after which something is removed; a large number for never."""
        left = self.next() - self._stepper.state.time
        return 2**62 if left == math.inf else max(math.ceil(left / self._stepper.h - TIME), 1)

    def apply(self) -> bool:
        """Remove what is due at the state's time; return whether any bar or support of this rank's part changed.

        Supports change on all ranks or on none.
        """
        now, changed = self._stepper.state.time, False
        for k, entry in enumerate(self._entries):
            if self._complete[k] or now < entry.time - TIME * max(entry.time, self._stepper.h):
                continue
            changed, begins = True, self.times[k] < 0.0
            self.times[k] = now if begins else self.times[k]
            self._complete[k] = self._done(k)
            share = 1.0 if self._complete[k] else (now - entry.time) / entry.duration
            if entry.bars is not None:
                self._remove_bars(self._members[entry.bars], share)
            elif begins:
                self._remove_support(entry, now)
        return changed

    def resume(self) -> None:
        """Continue after state, times and reactions were restored."""
        for k, entry in enumerate(self._entries):
            self._complete[k] = self._done(k)
            if entry.supports in self.gone and self.times[k] >= 0.0:
                self._replace(entry, self.times[k])
        self._release(self.gone)

    def follow(self, before: Removals) -> None:
        """Begin a stage after that of other removals: removals remain, and bars are removed entirely."""
        for k, entry in enumerate(before._entries):
            if entry.bars is not None and before.times[k] >= 0.0:
                self._remove_bars(before._members[entry.bars], 1.0)
        if self._model.case.holds("support"):
            self.gone = list(before.gone)
            self._release(self.gone)

    def _remove_bars(self, members: np.ndarray, share: float) -> None:
        stepper = self._stepper
        change = release(self._model.bars, stepper.state.x, members, share)
        energies = np.array(stepper.energy.energies) + change
        stepper.energy = stepper.energy._replace(energies=tuple(energies.tolist()))
        stepper.bars_removed()

    def _remove_support(self, entry: Remove, now: float) -> None:
        column = self._columns[entry.supports]
        supports, forces = self._model.supports, self._stepper.recorded()[1]
        before = supports.part(forces)
        supports.release([entry.supports])
        # components that another support prescribes too keep their reactions
        self.released[:, column : column + 3] = before - supports.part(forces)
        self._replace(entry, now)
        self.gone.append(entry.supports)
        self._stepper.supports_changed()

    def _replace(self, entry: Remove, begin: float) -> None:
        """Let the reaction of a support act as a load that decreases."""
        external, column = self._model.external, self._columns[entry.supports]
        if entry.duration:
            external.reactions.append((self.released[:, column : column + 3], begin, entry.duration))
            external.active = True

    def _release(self, names: list[str]) -> None:
        if names:
            self._model.supports.release(names)
            self._stepper.supports_changed()
