"""What a run watches: divergence, energy produced by contact, and states that the model cannot represent."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..columns import LOST, STORED, SUPPLIED
from ..contact.neighbours import CrossingBars
from ..errors import SimulationFailure
from ..output.units import LOAD_FACTOR, TIME

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model
    from ..stepping.plan import Plan


# energy created by the integration relative to the input; heavily damped explicit runs begin with up to 8
_CREATED = 20.0
# the same once nodes have been in contact: some schemes gain energy in each impact, which has a warning
_IN_CONTACT = 1e3
_DIVERGENCE_ROWS = (
    6  # consecutive rows; after a start from rest, or when a wall first strikes, there is no input to compare with
)
WATCHED = ("active_contacts", *STORED, *LOST, *SUPPLIED)
"""Columns of the history that rows are checked by."""
_AT = {name: k for k, name in enumerate(WATCHED)}
_KINETIC, _WALLS, _LOST, _ACTIVE = map(
    _AT.get, ("kinetic_energy", "wall_kinetic_energy", "numerical_dissipation", "active_contacts")
)
_BARS = ("elastic_energy", "spring_energy")
_ELASTIC, _SPRINGS = map(_AT.get, _BARS)
_SUPPLIED, _STORED = ([_AT[name] for name in names] for names in (SUPPLIED, STORED))


def watched(row: Mapping[str, Any]) -> np.ndarray:
    """Return the columns :data:`WATCHED` of one row, (1, k)."""
    return np.array([[float(row[name]) for name in WATCHED]])


# numbers of a check between rows; after them follow the lowest works
_STRANGE, _MOST, _MOST_LOST, _LIMIT, _STARTED, _START_ELASTIC, _START_SPRINGS = range(7)
_LOWEST = _START_SPRINGS + 1


def _first_created(rows: list[list[float]], kept: list[float]) -> tuple[int, float]:
    """Return the first of ``rows`` (m, k) of :data:`WATCHED` with which too many have more energy than was supplied,
    or m, and the energy created [J]; update the numbers ``kept`` between rows."""
    created = 0.0
    for k, row in enumerate(rows):
        moving, lost = row[_KINETIC] + row[_WALLS], row[_LOST]
        if kept[_STARTED] == 0.0:
            kept[_STARTED], kept[_START_ELASTIC], kept[_START_SPRINGS] = 1.0, row[_ELASTIC], row[_SPRINGS]
            # walls with mass as well: a truss at rest has no other energy than that of what hits it
            kept[_MOST] += moving
            kept[_MOST_LOST] = lost
        released = kept[_START_ELASTIC] - row[_ELASTIC] + kept[_START_SPRINGS] - row[_SPRINGS]
        kept[_MOST] = max(kept[_MOST], released)
        for j, supplied in enumerate(_SUPPLIED, start=_LOWEST):
            # rises only: what a force has taken away, as drag does, it need not give back
            kept[j] = min(kept[j], row[supplied])
            kept[_MOST] = max(kept[_MOST], row[supplied] - kept[j])
        kept[_MOST_LOST] = max(kept[_MOST_LOST], lost)
        created = min(kept[_MOST_LOST] - lost, moving - released)
        if row[_ACTIVE] > 0:
            kept[_LIMIT] = _IN_CONTACT
        kept[_STRANGE] = kept[_STRANGE] + 1 if created > kept[_LIMIT] * kept[_MOST] else 0
        if kept[_STRANGE] >= _DIVERGENCE_ROWS:
            return k, created
    return len(rows), created


class BlowUp:
    """Checks the history rows of a stage, which are the same on all ranks; collective if it reports.

    What the integration has created is the total energy, with all that is dissipated, less its lowest value so far, as
    far as the truss still holds it: in large steps, dissipation exceeds the work of the forces that dissipate. It is
    compared with what could move the truss: the kinetic energy at the start of the stage, the energy that its bars have
    released since, and the largest rise of each work. The energy of prestressed bars moves nothing while they hold it,
    and the works of earlier stages are spent. Rows of static stages are not compared: works over their increments are
    quadratures.
    """

    def __init__(self, model: Model, inertial: bool = True) -> None:
        self.model, self.inertial = model, inertial
        self._kept = [0.0, model.rounding * model.length, 0.0, _CREATED, 0.0, 0.0, 0.0] + len(SUPPLIED) * [np.inf]
        self._created = 0.0  # by the last row [J]

    def kept(self) -> dict[str, Any]:
        """Return the state for a checkpoint: the number of consecutive suspicious rows, energy input, the largest
        numerical dissipation [J], the factor of the input up to which rows are not suspicious, energies of the first
        row, and lowest works."""
        kept = self._kept
        started = kept[_STARTED] > 0.0
        return {
            "strange": int(kept[_STRANGE]),
            "most": kept[_MOST],
            "lost": kept[_MOST_LOST],
            "limit": kept[_LIMIT],
            "start": dict(zip(_BARS, kept[_START_ELASTIC:_LOWEST], strict=True)) if started else {},
            "lowest": dict(zip(SUPPLIED, kept[_LOWEST:], strict=True)) if started else {},
        }

    def load_state(self, kept: dict[str, Any]) -> None:
        """Restore the state from a checkpoint."""
        start, lowest = (kept[what] for what in ("start", "lowest"))
        numbers = [kept[what] for what in ("strange", "most", "lost", "limit")]
        numbers += [bool(start), *(start.get(name, 0.0) for name in _BARS)]
        self._kept[:] = numbers + [lowest.get(name, np.inf) for name in SUPPLIED]

    def first_wrong(self, rows: np.ndarray) -> int:
        """Return the first of ``rows`` (m, k) of :data:`WATCHED` that :meth:`failure` tells of, or m."""
        bad = np.flatnonzero(~np.isfinite(rows[:, [_KINETIC, _ELASTIC]]).all(axis=1))
        finite = int(bad[0]) if len(bad) else len(rows)
        if not self.inertial:
            return finite
        at, self._created = _first_created(rows[:finite].tolist(), self._kept)
        return at

    def check(self, row: Mapping[str, Any], state: State) -> None:
        """Check one row.

        Raises
        ------
        SimulationFailure
            On all ranks, see :meth:`failure`.
        """
        if self.first_wrong(watched(row)) == 0:
            raise self.failure(row, state)

    def failure(self, row: Mapping[str, Any], state: State) -> SimulationFailure:
        """Return what is wrong with a row: the energy is not finite, or the energy created exceeds the input several
        times. Collective."""
        if math.isfinite(row["kinetic_energy"] + row["elastic_energy"]):
            return SimulationFailure(
                f"{self._when(row)}: the integration has created {self._created:.3g} J, but only "
                f"{self._kept[_MOST]:.3g} J were supplied: the motion is unstable and fastest at "
                f"{self._fastest(state)}; reduce time.step"
            )
        if row["step"] == 0:
            return SimulationFailure(
                f"{self._when(row)}: the energy is not finite at the start{self._where(state)}: correct loads, "
                "velocities and material (SI units)"
            )
        return SimulationFailure(
            f"{self._when(row)}: the energy is not finite: the motion diverged{self._where(state)}; reduce time.step"
        )

    def _when(self, row: Mapping[str, Any]) -> str:
        """Return the step of a row and its time or load factor."""
        static = not self.inertial and "load_factor" in row
        place = LOAD_FACTOR.exact(row["load_factor"]) if static else TIME.exact(row["time"])
        return f"step {row['step']}, {place}"

    def _where(self, state: State) -> str:
        """Return the first node and bar, by mesh number, with positions or velocities that are not finite."""
        mesh = self.model.mesh
        bad = ~(np.isfinite(state.position).all(axis=1) & np.isfinite(state.v).all(axis=1))
        node = min(mesh.node_ids[: mesh.n_owned][bad], default=mesh.n_nodes)
        lost = ~np.isfinite(state.x).all(axis=1)
        bar = min(mesh.bar_ids[lost[mesh.bars].any(axis=1)], default=mesh.n_bars)
        comm = self.model.comm
        node, bar = min(comm.allgather(int(node))), min(comm.allgather(int(bar)))
        text = f", first seen at node {node}" if node < mesh.n_nodes else ""
        return text + (f" and bar {bar}" if bar < mesh.n_bars else "")

    def _fastest(self, state: State) -> str:
        """Return the fastest node and one of its bars."""
        mesh = self.model.mesh
        speed = np.linalg.norm(state.v, axis=1)
        mine = (-1.0, -1, -1)
        if len(speed):
            at = int(np.argmax(speed))
            bar = int(mesh.bar_ids[(mesh.bars == at).any(axis=1)].min())
            mine = (float(speed[at]), int(mesh.node_ids[at]), bar)
        fastest, node, bar = max(self.model.comm.allgather(mine))
        return f"node {node} (bar {bar}), {fastest:.3g} m/s"


_SHARE = 0.02  # of the initial and supplied energy; more than the oscillation of the schemes' own energies
_GAIN_ROWS = 4  # consecutive rows with a gain without contact; a short peak is not reported
_AT_END = 2  # the same, where the run ends with them

CAUSES = {
    "plastic_dissipation": "bars yield",
    "damage_dissipation": "bars are damaged",
    "rupture_dissipation": "bars break",
    "viscous_dissipation": "bars or dashpots are damped",
    "damping_dissipation": "damping stops nodes",
    "self_contact_dissipation": "bars touch bars",
}
"""What dissipates besides friction and impact, and how messages tell it."""
_CAUSES = [_AT[name] for name in CAUSES]

# numbers of a check between rows
_BEGUN, _START, _SCALE, _TOUCHED, _ROWS = range(5)


def _first_gain(
    rows: list[list[float]], numbers: np.ndarray, limits: tuple[bool, float, float, float], kept: list[float]
) -> tuple[int, float]:
    """Return the first of ``rows`` (m, k) of :data:`WATCHED`, with the ``numbers`` (m,) of their steps, that is to be
    told, or m, and the energy gained [J]; update the numbers ``kept`` between rows.

    ``limits``: whether the scheme is explicit, what its own energy may gain of the elastic energy, the energy [J] of
    what is at rest, and the number of the last step.
    """
    explicit, swing, rounding, last = limits
    gain = 0.0
    for k, row in enumerate(rows):
        stored, dissipated, supplied = ([row[j] for j in columns] for columns in (_STORED, _CAUSES, _SUPPLIED))
        net = sum(stored) + sum(dissipated) - sum(supplied)
        if kept[_BEGUN] == 0.0:
            kept[_BEGUN], kept[_START] = 1.0, net
        kept[_SCALE] = scale = max(kept[_SCALE], rounding, abs(kept[_START]), *map(abs, supplied))
        if row[_ACTIVE] > 0:
            kept[_TOUCHED] = 1.0
        touched = kept[_TOUCHED] > 0.0
        gain = net - kept[_START]
        if explicit and not touched:
            # what its own energy may have gained for a while: all of it where nothing dissipates
            gain -= swing * (row[_ELASTIC] + row[_SPRINGS]) if any(value > 0.0 for value in dissipated) else np.inf
        kept[_ROWS] = kept[_ROWS] + 1 if gain > _SHARE * scale + rounding else 0
        patience = 1 if touched else _AT_END if numbers[k] >= last else _GAIN_ROWS
        if kept[_ROWS] >= patience:
            return k, gain
    return len(rows), gain


class ContactWatch:
    """Compares the energy with the energy input, after contact of nodes and for implicit steps.

    The stored energy plus the energy dissipated by bars and damping, minus the energy supplied, cannot exceed its
    initial value: friction, impact and integration only reduce it. In large steps, within which bars yield or damping
    stops nodes, the work of the forces of the balance is less than the dissipation, and where supports move, their work
    within a step is not that of the reactions at its ends. The energy of an explicit scheme
    oscillates near its stability limit even without dissipation: by h^2/8 a.Ma with central differences, which is at
    most (h w/2)^2 of the elastic energy with the highest frequency w (h times the acceleration by a load is small). A
    gain up to this amount is accepted, and any gain if nothing dissipates. The rows are the same on all ranks, so all
    ranks report, or none.

    Parameters
    ----------
    model : Model
    tell : takes the warning
    plan : Plan
    """

    def __init__(self, model: Model, tell: Callable[[str], None], plan: Plan) -> None:
        self.tell = tell
        self.told = False
        swing = min((0.5 * plan.step * plan.frequency.upper) ** 2, 1.0)  # of the elastic energy
        # of energies [J]: what is at rest has no other
        self._limits = (plan.scheme.explicit, float(swing), float(model.rounding * model.length), float(plan.steps))
        self._kept = [0.0] * 5
        contact, time = model.case.contact, model.case.time
        self.key = "time.safety" if time.step == "auto" else "time.step"
        self.what = f'{time.integrator} with contact.treatment = "{contact.treatment}" and time.mass = "{time.mass}"'
        self.moves = model.supports.moves

    @property
    def start(self) -> float | None:
        """Energy of the first row less what had been supplied [J]; None before it."""
        return float(self._kept[_START]) if self._kept[_BEGUN] else None

    @start.setter
    def start(self, energy: float | None) -> None:
        self._kept[_BEGUN], self._kept[_START] = energy is not None, energy or 0.0

    def first_gain(self, rows: np.ndarray, numbers: np.ndarray) -> int:
        """Return the first of ``rows`` (m, k) of :data:`WATCHED`, with the ``numbers`` (m,) of their steps, that
        :meth:`tell_gain` is to tell of, or m."""
        if self.told:
            return len(rows)
        at, self._gain = _first_gain(rows.tolist(), numbers, self._limits, self._kept)
        return at

    def check(self, row: Mapping[str, Any]) -> None:
        """Check one row."""
        if self.first_gain(watched(row), np.array([float(row["step"])])) == 0:
            self.tell_gain(row)

    def tell_gain(self, row: Mapping[str, Any]) -> None:
        """Tell of the energy gained in a row."""
        self.told = True
        scale = self._kept[_SCALE]
        made = f"{self._gain:.3g} J, {100.0 * self._gain / scale:.2g} % of the energy that the run had or was given"
        at = f"step {row['step']}, t = {row['time']:.6g} s"
        if self._kept[_TOUCHED]:
            self.tell(
                f"{at}: contact has produced {made}: {self.what} gains "
                "energy in impacts; use another contact.treatment or time.integrator, or a smaller time.step "
                "(docs/contact_tables.md, phases of an impact)"
            )
        else:
            self.tell(
                f"{at}: the total energy, including dissipated energy, has grown by {made}, without contact: the "
                f"steps are too large for the motion{self._causes(row)}; reduce {self.key}"
            )

    def _causes(self, row: Mapping[str, Any]) -> str:
        """Return what large steps get wrong as part of a sentence."""
        found = [text for name, text in CAUSES.items() if row[name] > 0.0]
        found += ["supports move"] if self.moves else []
        *most, last = found or [""]
        return f" ({', '.join(most)}{' and ' if most else ''}{last})" if found else ""


# Number of bars up to which those that cross are searched at each snapshot, and of searches times bars beyond it after
# which the interval between searches is longer by one snapshot.
_FEW, _WORK = 2_500, 20_000

_REMEDIES = {
    "buckling": 'they would buckle, which their law does not describe; use law = "strut", or stockier bars',
    "shortening": "forces are extrapolated there",
    "crossing": "bars do not touch bars, and results from then on are doubtful",
}
_BEYOND = {
    "buckling": "compressed beyond Euler's load",
    "shortening": "shortened beyond the range of the law",
}


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

    def _count(self, kind: str, number: int, worst: tuple[float, int], place: str, text: str) -> None:
        """Count a snapshot with a number of bars or pairs, and warn of the first one.

        ``worst``: the measure by which snapshots are compared, and what is told with it
        """
        counts = self._counts(kind)
        counts["looks"] += 1
        if not number:
            return
        counts["seen"] += 1
        counts["most"] = max(counts["most"], number)
        if worst[0] > counts["worst"][0]:
            counts["worst"] = [*worst, place]
        if not counts["first"]:
            counts["first"] = place
            self._warn(f"{place}: {text}: {_REMEDIES[kind]}")

    def _exceeded(self, kind: str, ratios: np.ndarray, place: str) -> None:
        """Count bars whose ratio to a limit exceeds one. Collective."""
        over = np.flatnonzero(ratios > 1.0)
        worst = min(zip((-ratios[over]).tolist(), self._ids[over].tolist(), strict=True), default=(0.0, -1))
        parts = self._model.comm.allgather((len(over), worst))
        number, (ratio, bar) = sum(part[0] for part in parts), min(part[1] for part in parts)
        many = f"{number:,} bars are" if number > 1 else "1 bar is"
        text = f"{many} {_BEYOND[kind]}, most of all {self._worst(kind, -ratio, bar)}" if number else ""
        self._count(kind, number, (-ratio, bar), place, text)

    def _worst(self, kind: str, ratio: float, bar: int) -> str:
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
        if found is None:
            counts["looks"] += 1
            if not counts.get("unknown"):
                counts["unknown"] = True
                self._warn(f"{place}: bars are not searched for passing through each other: they are too crowded")
            return
        share = found.bars / (self._model.mesh.n_bars - self._model.mesh.n_connectors)
        pairs = f"{found.pairs:,} pairs of bars pass" if found.pairs > 1 else "1 pair of bars passes"
        some = f"{100.0 * share:.1f} % of all bars, bars {found.lowest[0]} and {found.lowest[1]} among them"
        self._count("crossing", found.pairs, (share, found.bars), place, f"{pairs} through each other ({some})")

    def summary(self) -> list[str]:
        """Return sentences for the end of the run, about what was seen again after its warning."""
        texts = []
        for kind, counts in self._kept.items():
            if counts["seen"] < 2:
                continue
            often = f"in {counts['seen']:,} of {counts['looks']:,} snapshots, first at {counts['first']}"
            often += f": up to {counts['most']:,}"
            value, bar, place = counts["worst"]
            if kind == "crossing":
                share = f"{bar:,} bars, {100.0 * value:.1f} % of all"
                text = f"bars passed through each other {often} pairs ({share}) at {place}"
            else:
                worst = self._worst(kind, value, bar)
                text = f"bars were {_BEYOND[kind]} {often} at once, most of all {worst}, at {place}"
            texts.append(text)
        return texts
