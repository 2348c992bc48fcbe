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
# consecutive rows; after a start from rest, or when a wall first strikes, there is no input to compare with
_DIVERGENCE_ROWS = 6
WATCHED = ("active_contacts", *STORED, *LOST, *SUPPLIED)
"""Columns of the history that rows are checked by."""
_BARS = ("elastic_energy", "spring_energy")


class BlowUp:
    """Checks the history rows of a stage, which are the same on all ranks; collective if it reports.

    What the integration has created is the total energy, with all that is dissipated, less its lowest value so far, as
    far as the truss still holds it: in large steps, dissipation exceeds the work of the forces that dissipate. It is
    compared with what could move the truss: the kinetic energy at the start of the stage, the energy that its bars have
    released since, and the largest rise of each work. The energy of prestressed bars moves nothing while they hold it,
    and the works of earlier stages are spent. Rows of static stages are not compared: works over their increments are
    quadratures.

    Attributes
    ----------
    kept : for a checkpoint: the number of consecutive suspicious rows, energy input, the largest numerical dissipation
        [J], the factor of the input up to which rows are not suspicious, energies of the first row, and lowest works
    """

    def __init__(self, model: Model, inertial: bool = True) -> None:
        self.model, self.inertial = model, inertial
        self._created = 0.0  # by the last row [J]
        self.kept: dict[str, Any] = {
            "strange": 0,
            "most": model.rounding * model.length,
            "lost": 0.0,
            "limit": _CREATED,
            "start": {},
            "lowest": {},
        }

    def check(self, row: Mapping[str, Any], values: Mapping[str, float], state: State) -> None:
        """Check one row; ``values``: its columns :data:`WATCHED`.

        Raises
        ------
        SimulationFailure
            On all ranks, see :meth:`failure`.
        """
        finite = math.isfinite(values["kinetic_energy"]) and math.isfinite(values["elastic_energy"])
        if not finite or (self.inertial and self._has_created(values)):
            raise self.failure(row, state)

    def _has_created(self, row: Mapping[str, float]) -> bool:
        """Return whether too many rows have more energy than was supplied."""
        kept = self.kept
        moving, lost = row["kinetic_energy"] + row["wall_kinetic_energy"], row["numerical_dissipation"]
        if not kept["start"]:
            kept["start"], kept["lowest"] = ({name: row[name] for name in names} for names in (_BARS, SUPPLIED))
            # walls with mass as well: a truss at rest has no other energy than that of what hits it
            kept["most"] += moving
            kept["lost"] = lost
        released = sum(start - row[name] for name, start in kept["start"].items())
        # rises only: what a force has taken away, as drag does, it need not give back
        kept["lowest"] = {name: min(low, row[name]) for name, low in kept["lowest"].items()}
        kept["most"] = max(kept["most"], released, *(row[name] - low for name, low in kept["lowest"].items()))
        kept["lost"] = max(kept["lost"], lost)
        self._created = min(kept["lost"] - lost, moving - released)
        if row["active_contacts"] > 0:
            kept["limit"] = _IN_CONTACT
        kept["strange"] = kept["strange"] + 1 if self._created > kept["limit"] * kept["most"] else 0
        return kept["strange"] >= _DIVERGENCE_ROWS

    def failure(self, row: Mapping[str, Any], state: State) -> SimulationFailure:
        """Return what is wrong with a row: the energy is not finite, or the energy created exceeds the input several
        times. Collective."""
        if math.isfinite(row["kinetic_energy"] + row["elastic_energy"]):
            return SimulationFailure(
                f"{self._when(row)}: the integration has created {self._created:.3g} J, but only "
                f"{self.kept['most']:.3g} J were supplied: the motion is unstable and fastest at "
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

    Attributes
    ----------
    start : energy of the first row less what had been supplied [J]; None before it
    """

    def __init__(self, model: Model, tell: Callable[[str], None], plan: Plan) -> None:
        self.tell = tell
        self.told = False
        self.start: float | None = None
        self._explicit, self._last = plan.scheme.explicit, plan.steps
        self._swing = min((0.5 * plan.step * plan.frequency.upper) ** 2, 1.0)  # of the elastic energy
        self._rounding = model.rounding * model.length  # [J]: what is at rest has no other energy
        self._scale, self._touched, self._rows = self._rounding, False, 0
        contact, time = model.case.contact, model.case.time
        self.key = "time.safety" if time.step == "auto" else "time.step"
        self.what = f'{time.integrator} with contact.treatment = "{contact.treatment}" and time.mass = "{time.mass}"'
        self.moves = model.supports.moves

    def check(self, row: Mapping[str, Any], values: Mapping[str, float]) -> None:
        """Check one row, and tell of the energy gained; ``values``: its columns :data:`WATCHED`."""
        if self.told:
            return
        dissipated, supplied = ([values[name] for name in names] for names in (CAUSES, SUPPLIED))
        net = sum(values[name] for name in STORED) + sum(dissipated) - sum(supplied)
        if self.start is None:
            self.start = net
        self._scale = max(self._scale, abs(self.start), *map(abs, supplied))
        self._touched |= values["active_contacts"] > 0
        gain = net - self.start
        if self._explicit and not self._touched:
            # what its own energy may have gained for a while: all of it where nothing dissipates
            swinging = self._swing * (values["elastic_energy"] + values["spring_energy"])
            gain -= swinging if any(value > 0.0 for value in dissipated) else np.inf
        self._rows = self._rows + 1 if gain > _SHARE * self._scale + self._rounding else 0
        if self._rows >= (1 if self._touched else _AT_END if row["step"] >= self._last else _GAIN_ROWS):
            self._tell_gain(row, gain)

    def _tell_gain(self, row: Mapping[str, Any], gain: float) -> None:
        self.told = True
        made = f"{gain:.3g} J, {100.0 * gain / self._scale:.2g} % of the energy that the run had or was given"
        at = f"step {row['step']}, t = {row['time']:.6g} s"
        if self._touched:
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

    Attributes
    ----------
    kept : counts so far, for a checkpoint or the next stage
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
        self.kept: dict[str, dict[str, Any]] = {}

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
        return self.kept.setdefault(kind, none)

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
        for kind, counts in self.kept.items():
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
