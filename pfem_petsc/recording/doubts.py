"""What the model cannot represent, found at snapshots: bars beyond Euler's load or the range of the law, or that pass
through each other. The first occurrence is a warning; the end of the run says how often and from when on."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact.crossing import CrossingBars

if TYPE_CHECKING:
    from ..stepping.model import Model

__all__ = ["Doubts"]

# Number of bars up to which those that cross are searched at each snapshot, and of searches times bars beyond it after
# which the interval between searches is longer by one snapshot.
_FEW, _WORK = 2_500, 20_000

_BUCKLED = "they would buckle, which their law does not describe"
_BEYOND = "forces are extrapolated there"
_CROSSED = "bars do not touch bars, and results from then on are doubtful"


class Doubts:
    """Counts of what the model cannot represent. Construction is collective.

    Parameters
    ----------
    model : Model
    warn : receives a warning
    """

    def __init__(self, model: Model, warn: Callable[[str], None]) -> None:
        self._model, self._warn = model, warn
        counted, bars = model.mesh.counted, model.bars
        euler, shortening = bars.euler_loads(), np.full(len(bars.ends), np.inf)
        for block in bars.blocks:
            material = bars.case.material[bars.case.section[block.section].material]
            shortening[block.start : block.stop] = material.largest_shortening
            if material.describes_buckling:
                euler[block.start : block.stop] = np.inf
        self._ids = model.mesh.bar_ids[counted]
        self._limits = {"buckling": euler[counted], "shortening": shortening[counted]}
        self._limits = {
            kind: limit for kind, limit in self._limits.items() if model.comm.allreduce(bool(np.isfinite(limit).any()))
        }
        self._crossing = CrossingBars(model)
        self._kept: dict[str, dict[str, Any]] = {}

    def kept(self) -> dict[str, Any]:
        """Return the counts so far, for a checkpoint or the next stage."""
        return self._kept

    def load_state(self, kept: dict[str, Any]) -> None:
        """Go on with the counts of :meth:`kept`."""
        self._kept = {kind: dict(counts) for kind, counts in kept.items()}

    def look(self, x: np.ndarray, place: str, last: bool) -> None:
        """Examine the state at positions (local, 3) [m], ghosts included, at a place of the run. Collective.

        ``last``: whether it is the last state of a stage.
        """
        bars, counted = self._model.bars, self._model.mesh.counted
        for kind, limit in self._limits.items():
            if kind == "buckling":
                values = -bars.fields(x)["axial_force"][counted]
            else:
                values = 1.0 - bars.lengths(x)[counted] / bars.rest[counted]
                if bars.can_break:
                    values[bars.watched[counted] == 0.0] = 0.0
            self._exceeded(kind, values / limit, place)
        if self._crossing.applicable and (self._is_due() or last):
            self._crossed(x, place)

    def _counts(self, kind: str) -> dict[str, Any]:
        none = {"looks": 0, "seen": 0, "first": "", "most": 0, "worst": [0.0, -1, ""]}
        return self._kept.setdefault(kind, none)

    def _seen(self, counts: dict[str, Any], number: int, place: str) -> bool:
        """Count a snapshot with a number of bars or pairs; return whether it is the first."""
        counts["seen"] += 1
        first = not counts["first"]
        if first:
            counts["first"] = place
        counts["most"] = max(counts["most"], number)
        return first

    def _exceeded(self, kind: str, ratios: np.ndarray, place: str) -> None:
        """Count bars whose ratio to a limit exceeds one. Collective."""
        over = np.flatnonzero(ratios > 1.0)
        worst = min(zip((-ratios[over]).tolist(), self._ids[over].tolist(), strict=True), default=(0.0, -1))
        parts = self._model.comm.allgather((len(over), worst))
        number, (ratio, bar) = sum(part[0] for part in parts), min(part[1] for part in parts)
        counts = self._counts(kind)
        counts["looks"] += 1
        if not number:
            return
        if -ratio > counts["worst"][0]:
            counts["worst"] = [-ratio, bar, place]
        if self._seen(counts, number, place):
            many = f"{number:,} bars are" if number > 1 else "1 bar is"
            self._warn(
                f"{place}: {many} {self._beyond(kind)}, most of all {self._worst(kind, bar, -ratio)}: {_remedy(kind)}"
            )

    def _beyond(self, kind: str) -> str:
        return "compressed beyond Euler's load" if kind == "buckling" else "shortened beyond the range of the law"

    def _worst(self, kind: str, bar: int, ratio: float) -> str:
        if kind == "buckling":
            return f"bar {bar} with {100.0 * ratio:.0f} % of it"
        limits = {m.largest_shortening: m.law for m in self._model.case.material.values()}
        limit, law = min((limit, law) for limit, law in limits.items() if np.isfinite(limit))
        return f"bar {bar} by {100.0 * (ratio * limit):.0f} %, where law {law!r} describes {100.0 * limit:.0f} %"

    def _is_due(self) -> bool:
        """Count a snapshot; return whether crossing bars are searched at it.

        A search costs more than a snapshot: the intervals grow with the number of bars and of searches. They do not
        depend on the motion or on ranks, so that restarts continue them.
        """
        counts = self._counts("crossing")
        counts["wait"] = counts.get("wait", 0) - 1
        if counts["wait"] >= 0:
            return False
        counts["wait"] = max(0, self._model.mesh.n_bars - _FEW) * (counts["looks"] + 1) // _WORK
        return True

    def _crossed(self, x: np.ndarray, place: str) -> None:
        """Count bars that pass through each other. Collective."""
        found, counts = self._crossing.find(x), self._counts("crossing")
        counts["looks"] += 1
        if found is None:
            if not counts.get("unknown"):
                counts["unknown"] = True
                self._warn(f"{place}: bars are not searched for passing through each other: they are too crowded")
            return
        if not found.pairs:
            return
        share = found.bars / (self._model.mesh.n_bars - self._model.mesh.n_connectors)
        if found.pairs > counts["most"]:
            counts["worst"] = [share, found.bars, place]
        if self._seen(counts, found.pairs, place):
            pairs = f"{found.pairs:,} pairs of bars pass" if found.pairs > 1 else "1 pair of bars passes"
            some = f"{100.0 * share:.1f} % of all bars, bars {found.lowest[0]} and {found.lowest[1]} among them"
            self._warn(f"{place}: {pairs} through each other ({some}): {_CROSSED}")

    def summary(self) -> list[str]:
        """Return sentences for the end of the run."""
        texts = []
        for kind, counts in self._kept.items():
            if not counts["seen"]:
                continue
            often = f"in {counts['seen']:,} of {counts['looks']:,} snapshots, first at {counts['first']}"
            value, bar, place = counts["worst"]
            if kind == "crossing":
                texts.append(
                    f"bars passed through each other {often}: up to {counts['most']:,} pairs ({bar:,} bars, "
                    f"{100.0 * value:.1f} % of all) at {place}: {_CROSSED}"
                )
            else:
                texts.append(
                    f"bars were {self._beyond(kind)} {often}: up to {counts['most']:,} at once, most of all "
                    f"{self._worst(kind, bar, value)}, at {place}: {_remedy(kind)}"
                )
        return texts


def _remedy(kind: str) -> str:
    return f'{_BUCKLED}; use law = "strut", or stockier bars' if kind == "buckling" else _BEYOND
