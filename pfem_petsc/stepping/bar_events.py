"""Bars that collapse, break or are removed, and supports that are removed: found, applied, reported."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError
from ..mechanics.bars import state_before_rupture
from ..mechanics.rupture import variable_of
from ..mesh.distribution import bars_of_group
from ..output.units import engineering
from ..tolerances import TIME

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..case.schema import Case
    from ..case.tables import Remove
    from ..mechanics.bars import Bars
    from ..mesh.distribution import DistributedMesh
    from .model import Model


_STRONG = 1.0
"""Ratio of impact speed to the wave speed of bars beyond which it crushes them; the strain behind the wave is v/c."""


class Collapse(NamedTuple):
    """A bar that failed in a step of size ``h`` [s]: its local index, positions (local, 3) after and before [m], and
    whether it was shortened until its strain had no meaning, or has gone through zero length."""

    bar: int
    x: np.ndarray
    before: np.ndarray
    h: float
    shortened: bool


def collapse_message(model: Model, found: Collapse, where: str, remedies: tuple[str, bool]) -> str:
    """Return the message about a bar that failed, at the step that ``where`` names. Not collective.

    ``remedies``: against steps that are too large, and whether the formulas of an implicit integrator make impacts.
    """
    mesh, bar = model.mesh, found.bar
    a, b = mesh.bars[bar]
    name = f"bar {mesh.bar_ids[bar]} between nodes {mesh.node_ids[a]} and {mesh.node_ids[b]}"
    way = found.x[b] - found.x[a]
    length, rest = float(np.linalg.norm(way)), float(model.bars.rest[bar])
    if not np.isfinite(length):
        return f"{where}: the positions of {name} are not finite: the motion diverged; {remedies[0]}"
    how = f"collapsed to {length:.3g} m" if found.shortened else "gone through zero length"
    past = found.before[b] - found.before[a]
    if not found.h or not rest:  # of equilibria, at one load factor
        return f"{where}: {name} has {how}, from {rest:.3g} m: the load crushes it, or bars pass through each other"
    speed = float(np.linalg.norm(way - past)) / found.h
    block = next(block for block in model.bars.blocks if block.start <= bar < block.stop)
    wave = float(np.sqrt(block.modulus / block.density)) if block.density else model.wave_speed
    return (
        f"{where}: {name} has {how}, from {rest:.3g} m; it had {float(np.linalg.norm(past)) / rest:.3g} of its length "
        f"a step before, and its ends moved at {engineering(speed, 'm/s')} towards each other, waves in it at "
        f"{engineering(wave, 'm/s')}: {_cause(model, wave, *remedies)}"
    )


def _cause(model: Model, wave: float, remedy: str, implicit_impact: bool) -> str:
    """Return the likely cause (impact, load or time integration) and the remedy."""
    case = model.case
    fastest = _speed_of_case(case, model.length)
    if fastest >= _STRONG * wave:
        return (
            f"at {engineering(fastest, 'm/s')} the impact is too strong for a truss model: use a lower speed, a "
            "stronger material, or a smaller time.step"
        )
    others = [remedy]
    if model.can_touch and case.contact.treatment == "scheme" and implicit_impact:
        grows = ", which gains energy in impacts" * any("gains energy in impacts" in text for text in model.warnings)
        others.append(
            f'use contact.treatment = "stick" instead of the formulas of {case.time.integrator} at impact{grows}'
        )
    if model.can_touch and case.contact.treatment != "scheme":
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
    found += [float(np.linalg.norm(wall.angular_velocity)) * length for wall in case.wall if wall.angular_velocity]
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

    def __init__(self, bars: Bars, mesh: DistributedMesh) -> None:
        self._bars, self._mesh = bars, mesh
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

    def note(self, x: np.ndarray, number: int, where: str) -> None:
        """Find the bars that broke in the last step, of this number, which has led to positions (local, 3); ``where``
        names the step in messages."""
        broken = self._bars.rupture() > 0.0
        fresh = np.flatnonzero(broken & ~self._known & self._counted)
        self._known = broken
        self.count += len(fresh)
        self._bars.watched  # noqa: B018 - compiled steps read the array
        for bar in fresh[: MOST_TOLD - len(self._pending)]:
            text = f"bar {self._mesh.bar_ids[bar]} broke at {where}: {self._reason(x, int(bar))}"
            self._pending.append(Break(number, int(self._mesh.bar_ids[bar]), text))

    def take(self) -> list[Break]:
        """Return descriptions of the bars that broke since the last call, at most :data:`MOST_TOLD`."""
        pending, self._pending = self._pending, []
        self.told = self.count
        return pending

    def _reason(self, x: np.ndarray, bar: int) -> str:
        """Return the limit that a bar has reached, with the value that it has."""
        block, column, stress, strain = state_before_rupture(self._bars, x, bar)
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
    """Bars and supports that a case removes at the ends of steps: the step that reaches the time is made with them.

    A bar loses its share over the duration, with the stored energy. A support is replaced by its reaction, which
    decreases linearly over the duration as an external force. Times are [s], or load factors.

    Parameters
    ----------
    model : Model

    Attributes
    ----------
    members : local bars of each group that is removed
    released : (owned, 3 k) reactions of the k removed supports at the beginning of their removal [N]
    times : at which the removal of each entry has begun; -1 before
    gone : names of the supports that are removed, of stages before too
    """

    def __init__(self, model: Model) -> None:
        self._model, self._entries = model, list(model.case.remove)
        mesh = model.mesh
        self._complete = [False] * len(self._entries)
        self.times = [_NEVER] * len(self._entries)
        self.gone: list[str] = []
        supports = [entry for entry in self._entries if entry.supports is not None]
        self.released = np.zeros((mesh.n_owned, 3 * len(supports)))
        self._columns = {entry.supports: 3 * k for k, entry in enumerate(supports)}
        self.members: dict[str, np.ndarray] = {}
        for index, entry in enumerate(self._entries):
            if entry.bars is not None:
                name = str(entry.bars)
                self.members[name] = bars_of_group(model.case, mesh, f"remove[{index}].bars", name)
            elif model.links or model.inertia.redistribution is not None:
                what = "contact pairs and constraints" if model.links else "massless contact nodes"
                raise InputError(
                    f"{model.case.source}: remove[{index}].supports = {entry.supports!r}: {what} require supports that "
                    "remain; remove bars instead, or leave them out"
                )

    def _done(self, k: int, now: float) -> bool:
        entry = self._entries[k]
        # the reaction of a support decreases from the end of the step that has reached the time
        begin = entry.time if entry.bars is not None else self.times[k]
        return self.times[k] >= 0.0 and now >= (begin + entry.duration) * (1.0 - TIME)

    def _left(self, now: float) -> list[Remove]:
        """Return what is not removed yet."""
        return [entry for k, entry in enumerate(self._entries) if not self._done(k, now)]

    def ends(self, now: float) -> float:
        """Return the next time that a step must not pass: a removal begins or ends there."""
        marks = [mark for entry in self._left(now) for mark in (entry.time, entry.time + entry.duration)]
        return min((mark for mark in marks if mark > now * (1.0 + TIME) and mark > 0.0), default=math.inf)

    def steps_left(self, now: float, h: float) -> int:
        """Return the number of steps of a size after which something is removed; a large number for never."""
        left = min((max(entry.time, now) for entry in self._left(now)), default=math.inf) - now
        return 2**62 if left == math.inf else max(math.ceil(left / h - TIME), 1)

    def due(self, now: float, h: float) -> Iterator[tuple[Remove, float, bool]]:
        """Give what is due after a step: the entry, the share of its bars that is gone, and whether it begins."""
        for k, entry in enumerate(self._entries):
            if self._complete[k] or now < entry.time - TIME * max(entry.time, h):
                continue
            begins = self.times[k] < 0.0
            self.times[k] = now if begins else self.times[k]
            self._complete[k] = self._done(k, now)
            yield entry, 1.0 if self._complete[k] else (now - entry.time) / entry.duration, begins

    def release(self, entry: Remove, forces: np.ndarray, now: float) -> None:
        """Release a support, of those with forces (owned, 3) [N]; its reaction acts on as a load that decreases."""
        column, supports = self._columns[entry.supports], self._model.supports
        before = supports.part(forces)
        supports.release([entry.supports])
        # components that another support prescribes too keep their reactions
        self.released[:, column : column + 3] = before - supports.part(forces)
        self._replace(entry, now)
        self.gone.append(entry.supports)

    def resume(self, now: float) -> None:
        """Continue after times and reactions were restored."""
        for k, entry in enumerate(self._entries):
            self._complete[k] = self._done(k, now)
            if entry.supports in self.gone and self.times[k] >= 0.0 and not self._complete[k]:
                self._replace(entry, self.times[k])
        if self.gone:
            self._model.supports.release(self.gone)

    def begun_bars(self) -> Iterator[np.ndarray]:
        """Give the local bars of the removals that have begun."""
        for entry, time in zip(self._entries, self.times, strict=True):
            if entry.bars is not None and time >= 0.0:
                yield self.members[str(entry.bars)]

    def _replace(self, entry: Remove, begin: float) -> None:
        """Let the reaction of a support act as a load that decreases."""
        external, column = self._model.external, self._columns[entry.supports]
        if entry.duration:
            external.reactions[entry.supports] = self.released[:, column : column + 3], begin, entry.duration
            external.active = True
