"""Bars that collapse, break or are removed, and supports that are removed: found, applied, reported."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError
from ..mechanics.bars import release, state_before_rupture
from ..mechanics.rupture import variable_of
from ..mesh.node_sets import group_hint
from ..output.units import engineering
from ..tolerances import TIME

if TYPE_CHECKING:
    from ..case.schema import Case
    from ..case.tables import Remove
    from .stepper import Stepper


_STRONG = 1.0
"""Ratio of impact speed to the wave speed of bars beyond which it crushes them; the strain behind the wave is v/c."""


def tell_collapse(stepper: Stepper, bar: int) -> str:
    """Return the message about a bar (local index) that failed in the current step. Not collective."""
    model, state = stepper.model, stepper.state
    mesh = model.mesh
    a, b = mesh.bars[bar]
    when = stepper.arrived()
    name = f"bar {mesh.bar_ids[bar]} between nodes {mesh.node_ids[a]} and {mesh.node_ids[b]}"
    way = state.x[b] - state.x[a]
    length, rest = float(np.linalg.norm(way)), float(model.bars.rest[bar])
    if not np.isfinite(length):
        return f"{when}: the positions of {name} are not finite: the motion diverged; {stepper.remedy}"
    how = f"collapsed to {length:.3g} m" if bar == stepper.energy.failed else "gone through zero length"
    past = stepper.before[b] - stepper.before[a]
    speed = float(np.linalg.norm(way - past)) / stepper.part
    block = next(block for block in model.bars.blocks if block.start <= bar < block.stop)
    wave = float(np.sqrt(block.modulus / block.density)) if block.density else model.wave_speed
    return (
        f"{when}: {name} has {how}, from {rest:.3g} m; it had {float(np.linalg.norm(past)) / rest:.3g} of its length a "
        f"step before, and its ends moved at {engineering(speed, 'm/s')} towards each other, waves in it at "
        f"{engineering(wave, 'm/s')}: {_cause(stepper, wave)}"
    )


def _cause(stepper: Stepper, wave: float) -> str:
    """Return the likely cause (impact, load or time integration) and the remedy."""
    model = stepper.model
    case = model.case
    fastest = _speed_of_case(case, model.length)
    if fastest >= _STRONG * wave:
        return (
            f"at {engineering(fastest, 'm/s')} the impact is too strong for a truss model: use a lower speed, a "
            "stronger material, or a smaller time.step"
        )
    others = [stepper.remedy]
    touch = model.can_touch
    if touch and case.contact.treatment == "scheme" and not stepper.scheme.explicit and stepper.scheme.inertial:
        grows = ", which gains energy in impacts" * any("gains energy in impacts" in text for text in model.warnings)
        others.append(
            f'use contact.treatment = "stick" instead of the formulas of {case.time.integrator} at impact{grows}'
        )
    if touch and case.contact.treatment != "scheme":
        others.append(f'use another contact.treatment than "{case.contact.treatment}"')
    ways = ", or ".join(others)
    if model.external.active or any(s.motion is not None or s.velocity is not None for s in case.support):
        return f"loads and supports crush it, or the time integration does not follow the motion: {ways}"
    return (
        f"nothing in the case is faster than {engineering(fastest, 'm/s')}, which does not crush bars, so the time "
        f"integration is the likelier cause: {ways}"
    )


def _speed_of_case(case: Case, length: float) -> float:
    """Return an upper bound on the initial relative speed [m/s] of bodies and walls of a case; ``length`` of the truss
    [m]."""
    found = [float(np.linalg.norm(wall.velocity)) for wall in case.wall if wall.velocity is not None]
    for start in case.initial:
        turning = float(np.linalg.norm(start.angular_velocity)) * length
        found.append(float(np.linalg.norm(start.velocity)) + turning)
    for wall in case.wall:
        if wall.motion is not None:
            rows = np.diff(np.array(wall.motion, dtype=float), axis=0)
            found.append(float((np.linalg.norm(rows[:, 1:], axis=1) / rows[:, 0]).max(initial=0.0)))
    return sum(sorted(found)[-2:])


MOST_TOLD = 100
"""Number of broken bars that are described; the others are only counted."""


class Break(NamedTuple):
    """A bar that broke: number of the step, mesh number of the bar, and a description."""

    step: int
    bar: int
    text: str


class Ruptures:
    """Counts the bars of this rank that have broken; the loops over bars themselves decide which do.

    Attributes
    ----------
    count : number of broken bars that are counted on this rank
    told : number of them that have been taken by :meth:`take`
    """

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper
        self._bars, self._mesh = stepper.model.bars, stepper.model.mesh
        self._pending: list[Break] = []
        self.begin()

    def begin(self) -> None:
        """Take the bars that are broken now as known, after their state was restored."""
        self.count = self.told = 0
        if not self._bars.can_break:
            return
        self._known = self._bars.rupture() > 0.0
        self._counted = np.zeros(len(self._known), dtype=bool)
        self._counted[self._mesh.counted] = True
        self.count = self.told = int((self._known & self._counted).sum())

    def note(self) -> None:
        """Find the bars that broke in the last step, whose positions are those of the state."""
        broken = self._bars.rupture() > 0.0
        fresh = np.flatnonzero(broken & ~self._known & self._counted)
        self._known = broken
        self.count += len(fresh)
        self._bars.watched  # noqa: B018 - the fused loop reads the array
        number = self._stepper.number + 1
        for bar in fresh[: MOST_TOLD - len(self._pending)]:
            self._pending.append(Break(number, int(self._mesh.bar_ids[bar]), self._text(int(bar))))

    def take(self) -> list[Break]:
        """Return descriptions of the bars that broke since the last call, at most :data:`MOST_TOLD`."""
        pending, self._pending = self._pending, []
        self.told = self.count
        return pending

    def _text(self, bar: int) -> str:
        return f"bar {self._mesh.bar_ids[bar]} broke at {self._stepper.arrived()}: {self._reason(bar)}"

    def _reason(self, bar: int) -> str:
        """Return the limit that a bar has reached, with the value that it has."""
        block, column, stress, strain = state_before_rupture(self._bars, self._stepper.state.x, bar)
        plastic, damage = variable_of(block.law, "plastic_strain"), variable_of(block.law, "damage")
        values = {
            "sigma": stress,
            "strain": strain,
            "-sigma": -stress,
            "-strain": -strain,
            "plastic strain": abs(column[plastic]) if plastic >= 0 else 0.0,
            "damage": column[damage] if damage >= 0 else 0.0,
        }
        limits = dict(zip(values, block.parameters, strict=False))
        # the stress evaluated again may differ in the last digit from that in the loop
        key = max(values, key=lambda name: values[name] / limits[name])
        if key.endswith("sigma"):
            return f"{key} = {engineering(values[key], 'Pa')} >= {engineering(limits[key], 'Pa')}"
        return f"{key} = {values[key]:.4g} >= {limits[key]:.4g}"


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
