"""Comparison of explicit and implicit schemes at small steps, which must converge to the same motion.

A case is run with an explicit and an implicit scheme at steps h and h/2. For each scheme the change between the two
steps is the error of the smaller step, to first order (impacts allow no more). If both converge to the same motion,
their distance is at most the sum of these errors. The bound is :data:`MARGIN` times that, so it decreases with h and is
calibrated by each case itself: motions that are chaotic, or that yield within few steps, have large errors and are not
judged.
"""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.errors import InputError
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan

from .checks import Loaded
from .running import case_text, clear, run_case

MARGIN = 4.0
EXACT = 1e-6
"""Differences below this fraction of the size, or of the largest energy, count as equal."""
VAGUE = 0.05
"""Errors above this fraction of the motion, or of the energy, are inconclusive."""
FIRST = 0.25
"""The larger step relative to the limit of central differences."""
STEPS = 160
"""Maximum number of steps."""
EXPLICIT = ("central_differences", {}), ("hulbert_chung", {"rho_b": 0.8}), ("chung_lee", {})
IMPLICIT = (
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("generalized_alpha", {"rho_inf": 0.8}),
    ("energy_momentum", {}),
)
ENERGIES = ("kinetic_energy", "elastic_energy", "plastic_dissipation", "damping_dissipation")


def pair_of(seed: int) -> tuple[dict, dict]:
    """The schemes of a case, as tables ``time`` without step and end."""
    (explicit, first), (implicit, second) = EXPLICIT[seed // 3 % 3], IMPLICIT[seed % 3]
    return {"integrator": explicit, **first}, {"integrator": implicit, **second}


def judge_schemes(table: dict, seed: int, folder: Path, source: str) -> tuple[str, list[tuple[str, str]]]:
    """Run a case with both schemes, at both steps, on one rank.

    Returns
    -------
    (what it says: "agree", "differ", "vague", or "refused" where a run does not come to its end, faults)
    """
    if any("mass" in wall for wall in table.get("wall", ())):
        return "refused", []  # implicit schemes have only their own formulas there, which gain energy in impacts
    explicit, implicit = pair_of(seed)
    limit = _limit(table, explicit, source)
    if limit is None:
        return "refused", []
    step = FIRST * limit
    count = max(min(STEPS, int(table["time"]["end"] / step)), 1)
    found = {}
    for name, scheme in (("explicit", explicit), ("implicit", implicit)):
        for parts in (1, 2):
            time = scheme | {"step": step / parts, "end": count * step}
            place = folder / f"{name}-{parts}"
            outcome = run_case(case_text(_changed(table, time)), MPI.COMM_SELF, place, source=source)
            if outcome.status == 0:
                found[name, parts] = _measures(Loaded(place))
            clear(MPI.COMM_SELF, place)
            if outcome.status != 0:
                return "refused", []
    return _compare(found, f"{explicit['integrator']} and {implicit['integrator']}")


def _limit(table: dict, time: dict, source: str) -> float | None:
    """Limit of the step of central differences [s]; None where the case is not one for both schemes."""
    try:
        text = case_text(_changed(table, time | {"step": 1e-9, "end": 1e-9}))
        case = Case.from_toml(text, source=source, name=Path(source).stem)
        return 2.0 / make_plan(Model(case, MPI.COMM_SELF)).frequency.upper
    except InputError:
        return None


def _changed(table: dict, time: dict) -> dict:
    """The same bodies, walls and loads with another scheme, and the treatment that means the same with both."""
    changed = copy.deepcopy(table)
    changed["time"] = {"mass": "lumped"} | time
    changed["solver"] = {"rtol": 1e-12}
    changed["output"] = {"fields_every": 1_000_000}
    # explicit schemes stop nodes for good by themselves; of the others the treatment "stick" does
    changed["contact"] = {"treatment": "scheme" if time["integrator"] == "central_differences" else "stick"}
    return changed


def _measures(result: Loaded) -> dict[str, np.ndarray]:
    """Positions at the end over the size, their way since the start, and energies over the largest of them.

    Works of walls that strike nodes may be larger by far, and are no measure of the motion.
    """
    scale = max(*(float(result.history[name].max()) for name in ENERGIES), 1e-300)
    size = max(result.size, 1e-300)
    energies = np.array([result.history[name][-1] for name in ENERGIES]) / scale
    start, end = result.positions[0] / size, result.positions[-1] / size
    return {"positions": end, "energies": energies, "way": end - start}


def _compare(found: dict, names: str) -> tuple[str, list[tuple[str, str]]]:
    verdict, faults = "agree", []
    scales = {"positions": _size(found["explicit", 2]["way"]), "energies": 1.0}
    for what, scale in scales.items():
        errors = sum(_size(found[name, 1][what] - found[name, 2][what]) for name in ("explicit", "implicit"))
        apart = _size(found["explicit", 2][what] - found["implicit", 2][what])
        if errors > VAGUE * scale:
            verdict = "vague" if verdict == "agree" else verdict
        elif apart > MARGIN * errors + EXACT:
            verdict = "differ"
            text = f"{names}: {what} {apart:.3g} apart, where halving the step changes them by {errors:.3g}"
            faults.append(("schemes do not agree", text))
    return verdict, faults


def _size(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt((values * values).mean()))
