"""Comparisons of results: copies of a case, explicit and implicit schemes, one rank and several, restarts.

Copies are moved, turned, renumbered or in other units, and their results follow from those of the case. Schemes are
compared at small steps, at which they must converge to the same motion: a case is run with an explicit and an implicit
scheme at steps h and h/2. For each the change between the two steps is the error of the smaller step, to first order
(impacts allow no more), and their distance is at most :data:`MARGIN` times the sum of these errors. Motions that are
chaotic, or that yield within few steps, have large errors and are not judged.
"""

from __future__ import annotations

import copy
import functools
import json
import random
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
from helpers.kills import differences
from mpi4py import MPI

from pfem_petsc import Case, open_result
from pfem_petsc.case.editing import tables_of
from pfem_petsc.errors import InputError
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan

from .checks import Loaded, check_result, distance, energy_scale, stage_end
from .draw import draw_case, generated, members_of
from .draw_contact import draw_touching
from .draw_stages import draw_staged
from .running import case_text, clear, run_case, run_in_two_parts, steps_of

CHAOS_OF_COPIES = 300.0
"""As :data:`CHAOS`; more, because a copy rounds in every step and not only at the start."""

# exponents of length, mass and time of the numbers in a case; keys that are not here have no unit
UNITS: dict[str, tuple[int, int, int]] = {
    **dict.fromkeys(("points", "point", "nearest", "box", "centre", "radius", "size", "gap", "thickness"), (1, 0, 0)),
    **dict.fromkeys(("diameter",), (1, 0, 0)),
    **dict.fromkeys(
        ("young_modulus", "yield_stress", "isotropic_hardening", "kinematic_hardening", "stress", "prestress"),
        (-1, 1, -2),
    ),
    **dict.fromkeys(
        ("tensile_strength", "compaction_modulus", "proof_stress", "strength_coefficient", "saturation_stress"),
        (-1, 1, -2),
    ),
    "density": (-3, 1, 0),
    "damping": (-3, 1, -1),
    "stiffness_damping": (0, 0, 1),
    "fracture_energy": (0, 1, -2),
    "rate_reference": (0, 0, -1),
    "fluidity": (0, 0, -1),
    "specific_heat": (2, 0, -2),
    "area": (2, 0, 0),
    **dict.fromkeys(("width", "height", "web_thickness"), (1, 0, 0)),
    "force_density": (0, 1, -2),
    "frequencies": (0, 0, -1),
    "second_moment": (4, 0, 0),
    "pretension": (1, 1, -2),
    "force": (1, 1, -2),
    "velocity": (1, 0, -1),
    "angular_velocity": (0, 0, -1),
    "acceleration": (1, 0, -2),
    "mass": (0, 1, 0),
    "stiffness": (0, 1, -2),
    "coefficient": (0, 1, -1),
    "step": (0, 0, 1),
    "end": (0, 0, 1),
    "time": (0, 0, 1),
    "duration": (0, 0, 1),
}
ROWS = (
    "pretension",
    "prestress",
    "rest_length",
    "force_density",
    "table",
    "motion",
    "velocity",
    "acceleration",
    "damping_table",
)
"""Keys that may have rows whose first number is a time."""
VECTORS = ("velocity", "angular_velocity", "acceleration", "force", "normal", "axis", "along", "direction")


@dataclass
class Copy:
    """A changed case, and what its results are in terms of those of the case.

    Attributes
    ----------
    back : (nodes, 3) positions of the copy to those of the case
    energy : energies of the copy over those of the case
    rounding : relative rounding of the copy's coordinates over that of the case's
    """

    table: dict[str, Any]
    back: Callable[[np.ndarray], np.ndarray] = lambda x: x
    energy: float = 1.0
    rounding: float = 1.0


def _as_arrays(table: dict[str, Any]) -> dict[str, Any]:
    """Return the case with its mesh as lists, and node sets as lists of nodes."""
    plain = copy.deepcopy(table)
    slab = generated(plain["mesh"])
    points = slab.points
    for name, chosen in plain["node_set"].items():
        if "all" not in chosen:
            plain["node_set"][name] = {"indices": members_of(slab, chosen).tolist()}
    for kind in ("spring", "dashpot"):
        plain[kind] = [part for connector in plain.get(kind, ()) for part in _one_by_one(plain, connector, points)]
        if not plain[kind]:
            del plain[kind]
    groups = {name: np.asarray(members).tolist() for name, members in slab.bar_groups.items() if len(members)}
    plain["mesh"] = {
        "generator": "arrays",
        "points": points.tolist(),
        "bars": np.asarray(slab.bars).tolist(),
        "bar_groups": groups,
    }
    if "bar_fields" in table["mesh"]:
        plain["mesh"]["bar_fields"] = copy.deepcopy(table["mesh"]["bar_fields"])
    if any({"catalogue", "velocity_file"} & set(each) for each in (*_supports(plain), *plain["section"].values())):
        plain = tables_of(Case.from_dict(plain), given=True)  # which has the numbers of the files
    if plain.get("solver", {}).get("linear") == "multigrid":  # of generated lattices only
        plain["solver"]["linear"] = "auto"
    return plain


def _one_by_one(case: dict[str, Any], connector: dict[str, Any], points: np.ndarray) -> list[dict[str, Any]]:
    """Return a connector between sets as connectors between nodes: which of several nearest nodes it takes depends on
    their numbers."""
    if "between" not in connector:
        return [connector]
    first, second = (
        np.array(case["node_set"][name].get("indices", range(len(points)))) for name in connector["between"]
    )
    parts = []
    for node in second:
        away = np.where(first == node, np.inf, np.linalg.norm(points[first] - points[node], axis=1))
        nearest = first[away.argmin()]
        names = f"node {nearest}", f"node {node}"
        case["node_set"] |= {name: {"indices": [int(i)]} for name, i in zip(names, (nearest, node), strict=True)}
        parts.append(connector | {"between": list(names)})
    return parts


def _each(table: Any, change: Callable[[str, Any], Any], key: str = "") -> Any:
    """Return the table with every value that is no table replaced."""
    if isinstance(table, dict):
        return {name: _each(value, change, name) for name, value in table.items()}
    if isinstance(table, list) and table and isinstance(table[0], dict):
        return [_each(value, change, key) for value in table]
    return change(key, table)


def _moved(chance: random.Random, table: dict[str, Any], distance: float) -> Copy:
    shift = np.array([chance.choice((-1.0, 1.0)) * distance * chance.uniform(0.5, 1.0) for _ in range(3)])
    points = np.array(table["mesh"]["points"])
    table["mesh"]["points"] = (points + shift).tolist()
    for wall in table.get("wall", ()):
        wall["point"] = (np.array(wall["point"]) + shift).tolist()
    for initial in (table.get("initial", {}), *table.get("initial", {}).get("on", ())):
        if "centre" in initial:
            initial["centre"] = (np.array(initial["centre"]) + shift).tolist()
    size = max(float(np.ptp(points, axis=0).max()), 1e-300)
    return Copy(table, lambda x: x - shift, rounding=max(1.0, distance / size))


def _turned(chance: random.Random, table: dict[str, Any]) -> Copy:
    """By any angle, or, with supports or springs along axes, by one that maps axes to axes."""
    along_axes = any("fix" in s and "frame" not in s and s["fix"] != "xyz" for s in _supports(table))
    if along_axes:
        turns = [
            np.eye(3)[list(p)] * np.array(s)[:, None]
            for p in permutations(range(3))
            for s in product((1, -1), repeat=3)
        ]
        turn = chance.choice([t for t in turns if np.linalg.det(t) > 0.5])
    else:
        turn = np.linalg.qr(np.array([[chance.gauss(0, 1) for _ in range(3)] for _ in range(3)]))[0]
        turn *= np.sign(np.linalg.det(turn))

    def vectors(value: Any, rows: bool) -> Any:
        values = np.array(value, dtype=float)
        if rows:
            return np.column_stack([values[:, 0], values[:, 1:] @ turn.T]).tolist()
        return (values @ turn.T).tolist()

    def change(key: str, value: Any) -> Any:
        if key in ("points", "point", "centre", "frame"):
            return vectors(value, False)
        if key == "motion" or key in VECTORS:
            return vectors(value, bool(value) and isinstance(value[0], list))
        return value

    turned = _each(table, change)
    for spring in turned.get("spring", ()):
        if "node_set" in spring and "frame" not in spring:
            spring["frame"] = turn.T[:2].tolist()
    if along_axes:
        for support in _supports(turned):
            if "fix" in support and "frame" not in support:
                axes = [int(np.abs(turn[:, "xyz".index(c)]).argmax()) for c in support["fix"]]
                support["fix"] = "".join("xyz"[a] for a in sorted(axes))
    return Copy(turned, lambda x: x @ turn)


def _supports(table: dict[str, Any]) -> list[dict[str, Any]]:
    """Those of the case and of its stages."""
    parts = (table, *table.get("stage", ()), *table.get("load_case", ()))
    return [support for part in parts for support in part.get("support", ())]


def _renumbered(chance: random.Random, table: dict[str, Any]) -> Copy:
    mesh = table["mesh"]
    order, bars = list(range(len(mesh["points"]))), list(range(len(mesh["bars"])))
    chance.shuffle(order)
    chance.shuffle(bars)
    new = np.empty(len(order), dtype=int)
    new[order] = np.arange(len(order))
    new_bar = np.empty(len(bars), dtype=int)
    new_bar[bars] = np.arange(len(bars))
    mesh["points"] = [mesh["points"][i] for i in order]
    flipped = [mesh["bars"][i][:: chance.choice((1, -1))] for i in bars]
    mesh["bars"] = [[int(new[a]), int(new[b])] for a, b in flipped]
    mesh["bar_groups"] = {name: sorted(new_bar[members].tolist()) for name, members in mesh["bar_groups"].items()}
    for chosen in table["node_set"].values():
        if "indices" in chosen:
            chosen["indices"] = sorted(new[chosen["indices"]].tolist())
    return Copy(table, lambda x: x[new])


def _scaled(chance: random.Random, table: dict[str, Any]) -> Copy:
    """In units of other size, as if metre, kilogram and second were others."""
    length, mass, time = (10.0 ** chance.uniform(-2.0, 2.0) for _ in range(3))

    def factor(key: str) -> float:
        a, b, c = UNITS.get(key, (0, 0, 0))
        return length**a * mass**b * time**c

    def change(key: str, value: Any) -> Any:
        if isinstance(value, str | bool) or key in (
            "indices",
            "bars",
            "bar_groups",
            "normal",
            "axis",
            "along",
            "frame",
        ):
            return value
        if key in ROWS and isinstance(value, list) and value and isinstance(value[0], list):
            rows = np.array(value, dtype=float)
            rows[:, 0] *= time
            rows[:, 1:] *= length if key == "motion" else factor(key)
            return rows.tolist()
        if key == "curve":  # strains and stresses
            return [[a, b * factor("stress")] for a, b in value]
        if key == "direction":  # of pairs: any length
            return value
        if key in UNITS:
            return (np.array(value, dtype=float) * factor(key)).tolist()
        return value

    scaled: dict[str, Any] = {}
    for name, entry in table.items():
        if name == "mass":  # of nodes
            entry = [node | {"value": node["value"] * mass} for node in entry]
        elif name == "wind":
            entry = _each(entry, change, name) | ({"density": entry["density"] * factor("density")})
        elif name not in ("title", "output", "solver", "temperature", "contact"):
            entry = _each(entry, change, name)
        elif name == "temperature":
            entry = [_each(heat, lambda key, value: change(key, value) if key == "table" else value) for heat in entry]
        scaled[name] = entry
    for _, a, b in _matches(scaled, table):  # time tables of temperatures: only times have been scaled
        a["value"] = b["value"]
    return Copy(scaled, lambda x: x / length, energy=mass * length**2 / time**2)


def _matches(scaled: dict[str, Any], table: dict[str, Any]) -> list[tuple[str, dict, dict]]:
    pairs = zip(scaled.get("temperature", ()), table.get("temperature", ()), strict=True)
    return [("temperature", a, b) for a, b in pairs if "value" in b]


KINDS: dict[str, Callable[[random.Random, dict[str, Any]], Copy]] = {
    "moved by 1 km": lambda chance, table: _moved(chance, table, 1e3),
    "moved by 1000 km": lambda chance, table: _moved(chance, table, 1e6),
    "turned": _turned,
    "renumbered": _renumbered,
    "scaled": _scaled,
}
OF_STAGES = ("turned", "renumbered")
"""Those for cases of stages."""


def judge_copies(
    table: dict[str, Any], seed: int, whole: Path, folder: Path, amplified: Callable[[], float]
) -> list[tuple[str, str]]:
    """Run the copies of a case on one rank and compare them with its result.

    ``amplified`` gives the effect of a change of the positions by 1e-13 of the size, which tells chaotic runs.
    """
    faults: list[tuple[str, str]] = []
    explicit = "solver" not in table and table["time"].get("mass") != "consistent"
    kinds = {kind: make for kind, make in KINDS.items() if "time" in table or kind in OF_STAGES}
    tight = explicit or table.get("solver", {}).get("rtol", 1.0) < 1e-10
    moved: float | None = None
    for kind, make in kinds.items():
        changed = make(random.Random(f"{kind} {seed}"), _as_arrays(table))
        source = f"random-{seed}-{kind.replace(' ', '-')}.toml"
        place = folder / "copy"
        clear(MPI.COMM_SELF, place)
        outcome = run_case(case_text(changed.table), MPI.COMM_SELF, place, source=source)
        faults += [(f"{kind}: {cause}", detail) for cause, detail in outcome.faults]
        if outcome.status != 0:
            faults.append((f"{kind}: fails", f"status {outcome.status}: {outcome.message[:300]}"))
            continue
        apart, where = _distance(Loaded(whole), Loaded(place), changed)
        if apart <= (AGREE if tight else LOOSE) * changed.rounding:
            continue
        moved = amplified() if moved is None else moved
        detail = f"{apart:.3g} in {where}; a change of the start by 1e-13 makes {moved:.3g}"
        chaotic = apart <= CHAOS_OF_COPIES * moved * changed.rounding
        faults.append((f"chaotic: {kind}" if chaotic else f"{kind}: another result", detail))
    clear(MPI.COMM_SELF, folder / "copy")
    return faults


def _distance(case: Loaded, other: Loaded, changed: Copy) -> tuple[float, str]:
    if len(case.steps) != len(other.steps) or case.positions.shape != other.positions.shape:
        return np.inf, f"{len(case.steps)} and {len(other.steps)} snapshots"
    worst = 0.0, "nothing"
    for i, (a, b) in enumerate(zip(case.positions, other.positions, strict=True)):
        apart = float(np.abs(changed.back(b.astype(float)) - a).max()) / max(case.size, 1e-300)
        if not apart <= worst[0]:
            worst = apart, f"positions in snapshot {i} of {len(case.steps)}"
    scale = max(energy_scale(case.history), 1e-300)
    for name, values in case.history.items():
        if name.endswith(("_energy", "_work", "_dissipation")) and name in other.history:
            its = other.history[name] / changed.energy
            apart = float(np.abs(its - values).max()) / scale if its.shape == values.shape else np.inf
            if not apart <= worst[0]:
                worst = apart, name
    return worst


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
    limit = _largest_step(table, explicit, source)
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


def _largest_step(table: dict, time: dict, source: str) -> float | None:
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


CHAOS = 100.0
"""Allowed difference between ranks, relative to the effect of a change of the positions by 1e-13."""
AGREE = 1e-9
LOOSE = 1e-6
"""The same for implicit runs whose solver stops at its default tolerance of 1e-9."""


def check_case(text: str, comm: MPI.Comm, folder: Path, source: str, restart: bool) -> dict:
    """Run a case, check its results and, if requested, that stopping and continuing changes nothing. Collective.

    The result is kept in ``folder``/whole.
    """
    outcome = run_case(text, comm, folder / "whole", source=source)
    told = asdict(outcome) | {"touched": False, "parts": False}
    if outcome.status == 0 and comm.rank == 0:
        told["faults"] += check_result(folder / "whole", outcome.warnings)
        told["touched"] = _touched(folder / "whole")
        if comm.size == 1:
            told["faults"] += judge_load_case(_table(text), folder, source)
    steps = comm.bcast(steps_of(folder / "whole") if outcome.status == 0 and comm.rank == 0 else 0)
    if restart and outcome.status == 0 and steps > 4:
        files = (folder / "whole" / "result.vtkhdf", folder / "parts" / "result.vtkhdf")
        second = run_in_two_parts(text, comm, folder / "parts", steps // 2, source)
        told["faults"] += [(f"in two parts: {cause}", detail) for cause, detail in second.faults]
        told["parts"] = second.stopped > 0
        if second.status != 0 and not second.faults:
            told["faults"].append(("continued run fails", f"stopped at {second.stopped}: {second.message[:300]}"))
        elif second.status == 0 and comm.rank == 0 and (apart := _apart(differences(*files), comm.size)):
            first = ", ".join(f"{name} by {size:.3g}" for name, size in list(apart.items())[:3])
            cause = "continued run differs" if second.stopped > 0 else "a second run differs"
            told["faults"].append((cause, f"stopped at step {second.stopped}: {len(apart)} datasets: {first}"))
    clear(comm, folder / "parts")
    return told


def _apart(found: dict[str, float], size: int) -> dict[str, float]:
    """Return differences that are faults: on one rank all. On several, PT-Scotch goes on with its random numbers, so
    that the second run of a process may have other nodes on a rank, and sums over ranks other parts."""
    if size == 1:
        return found
    rounding = "checks/", "history/energy_imbalance", "history/linear_iterations", "history/newton_iterations"
    return {name: apart for name, apart in found.items() if apart > 1e-10 and not name.startswith(rounding)}


def judge_load_case(table: dict[str, Any], folder: Path, source: str) -> list[tuple[str, str]]:
    """Check the damping of the case, and one of its load cases or combinations against stages by hand, on one rank."""
    whole = open_result(folder / "whole")
    faults = _damping(whole.case, table.get("damping"))
    names = [row["name"] for key in ("load_case", "combination") for row in table.get(key, ())]
    if not names:
        return faults
    name, place = random.Random(table["title"]).choice(names), folder / "hand"
    outcome = run_case(case_text(by_hand(table, name)), MPI.COMM_SELF, place, source=source)
    if outcome.status:
        return [*faults, (f"{name} by hand fails", f"status {outcome.status}: {outcome.message[:300]}")]
    one, other = Loaded(folder / "whole"), Loaded(place)
    ends = stage_end(whole, name), -1
    for what, a, b in [("positions", one.positions, other.positions), *_both(one.fields, other.fields)]:
        least = 1e-3 if what == "plastic_strain" else 1e-300
        scale = one.size if what == "positions" else max(float(np.abs(b).max()), least)
        apart = float(np.abs(a[ends[0]] - b[ends[1]]).max()) / scale
        if not apart <= 1e-7:
            faults.append((f"load case is not that by hand: {what}", f"{name}: {apart:.3g}"))
    clear(MPI.COMM_SELF, place)
    return faults


def _both(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> list[tuple[str, np.ndarray, np.ndarray]]:
    return [(name, one[name], other[name]) for name in ("axial_force", "plastic_strain") if name in one]


def _damping(case: Case, given: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Check that materials have the damping of a ratio at its frequencies, none of it negative."""
    for material in case.material.values() if given else ():
        a, b = material.damping / material.density, material.stiffness_damping
        rates = 2.0 * np.pi * np.array(given["frequencies"])
        if min(a, b) < 0.0 or not np.allclose(0.5 * (a / rates + b * rates), given["ratio"], rtol=1e-12):
            return [("damping is not that of the ratio", f"{a}, {b} of {given}")]
    return []


def by_hand(table: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a case with a load case or combination as its last stage, whose tables are written out."""
    made = copy.deepcopy({key: value for key, value in table.items() if key not in ("load_case", "combination")})
    stages = made.setdefault("stage", [])
    if not stages:
        stages.append({"name": "permanent", "static": made.pop("static")})
    keys = ("load", "gravity", "temperature", "support")
    common = {key: next((part[key] for part in (*stages[::-1], made) if key in part), []) for key in keys}
    factors = {row["name"]: row["factors"] for row in table.get("combination", ())}.get(name, {name: 1.0})
    cases = {row["name"]: row for row in table["load_case"]}
    static = stages[-1]["static"]
    stage = {"name": name, "static": {"method": "newton"} if static["method"] == "force_density" else static}
    own: dict[str, list] = {key: [] for key in (*keys, "wind")}
    for case, factor in factors.items():
        for key in own if factor else ():
            rows = cases[case].get(key, [])
            own[key] += [_times(row, factor) for row in (rows if isinstance(rows, list) else [rows])]
    for key, last in (("load", "force"), ("temperature", "value")):
        if own[key]:
            stage[key] = [_at_end(row, last) for row in common[key]] + own[key]
    if own["gravity"]:
        rows = [*([common["gravity"]] if common["gravity"] else []), *own["gravity"]]
        stage["gravity"] = {"acceleration": np.sum([row["acceleration"] for row in rows], axis=0).tolist()}
    if own["support"]:
        moved = own["support"][0]
        same = "name" if "name" in moved else "node_set"
        motions = ("motion", "velocity", "velocity_file", "interpolation")
        still = [{key: value for key, value in row.items() if key not in motions} for row in common["support"]]
        stage["support"] = [moved if row.get(same) == moved[same] else row for row in still]
    if own["wind"]:  # of load cases alone
        single = {"wind": own["wind"][0]}
        if own["gravity"]:
            single["gravity"] = {
                "acceleration": np.sum([row["acceleration"] for row in own["gravity"]], axis=0).tolist()
            }
        lists = {key: own[key] for key in ("load", "temperature", "support") if own[key]}
        made["load_case"] = [{"name": name, **lists, **single}]
    else:
        stages.append(stage)
    return made


def _at_end(row: dict[str, Any], key: str) -> dict[str, Any]:
    """Return a row over time as it is after the last of its rows."""
    last = row["table"][-1][1] if "table" in row else None
    kept = {name: value for name, value in row.items() if name not in ("table", "interpolation")}
    if last is None:
        return kept
    return kept | {key: last if key == "value" else [last * each for each in row[key]]}


def _times(row: dict[str, Any], factor: float) -> dict[str, Any]:
    """Return a table of a load case times a factor."""
    scaled = copy.deepcopy(row)
    for key in {"force", "acceleration", "value", "density"} & set(row):
        scaled[key] = (factor * np.array(row[key])).tolist()
    if "table" in row and "force" not in row:
        scaled["table"] = [[t, factor * value] for t, value in row["table"]]
    if "motion" in row:
        scaled["motion"] = [[t, *(factor * value for value in values)] for t, *values in row["motion"]]
    return scaled


def judge_ranks(text: str, table: dict, one: Path, other: Path, folder: Path, source: str) -> list[tuple[str, str]]:
    """Check that results of one rank and of several agree; a run is chaotic if a change of the positions by 1e-13 of
    the size has the same effect."""
    apart, where = distance(one, other)
    explicit = "solver" not in table and table["time"].get("mass") != "consistent"
    tight = explicit or table.get("solver", {}).get("rtol", 1.0) < 1e-10
    if apart <= (AGREE if tight else LOOSE):
        return []
    moved = amplification(text, one, folder, source)
    if apart <= CHAOS * moved:
        return [("chaotic: ranks part as runs do that start 1e-13 apart", f"{apart:.3g} ({where}), {moved:.3g}")]
    return [("ranks differ", f"{apart:.3g} in {where}; a change of the start by 1e-13 makes {moved:.3g}")]


def amplification(text: str, whole: Path, folder: Path, source: str) -> float:
    """Return the largest distance of three runs with changed positions from the run itself, on one rank."""
    worst = 0.0
    for number in (1, 2, 3):
        outcome = run_case(text, MPI.COMM_SELF, folder / f"jiggle{number}", source=source, jiggle=number)
        if outcome.status != 0:
            worst = np.inf
        else:
            worst = max(worst, distance(whole, folder / f"jiggle{number}")[0])
        clear(MPI.COMM_SELF, folder / f"jiggle{number}")
    return worst


DRAWN = {"single": draw_case, "staged": draw_staged, "touching": draw_touching}
"""What draws the cases: of one analysis, of stages, and with contact of surfaces, turning walls, pairs and bars."""


def work(mode: str, seeds: Iterable[int], folder: Path, every_restart: int, sources: dict[int, str], kind: str) -> None:
    """Process the cases of a worker, of a ``kind`` in :data:`DRAWN`. Collective.

    ``mode``: "check" runs and checks, "run" only runs, "judge" compares the results of both and removes them, "schemes"
    compares explicit and implicit schemes, "copies" the copies of a case.
    """
    comm, draw = MPI.COMM_WORLD, DRAWN[kind]
    for seed in seeds:
        _tell(comm, "begin", seed, {})
        source = sources.get(seed, f"random-{seed}.toml")
        if seed in sources:
            text, table = Path(source).read_text(), {}
        else:
            table = draw(seed)
            text = case_text(table)
        place = folder / str(seed)
        if mode == "check":
            restart = every_restart > 0 and seed % every_restart == 0
            told = check_case(text, comm, place / "1", source, restart)
        elif mode == "schemes":
            verdict, faults = judge_schemes(table or _table(text), seed, place, source)
            told = {"verdict": verdict, "faults": faults}
        elif mode == "copies":
            table = table or _table(text)
            whole = place / "1/whole"
            amplified = functools.partial(amplification, text, whole, place, source)
            told = {"faults": judge_copies(table, seed, whole, place, amplified)}
        elif mode == "run":
            told = check_case(text, comm, place / "n", source, False)
        else:
            table = table or _table(text)
            told = {"faults": judge_ranks(text, table, place / "1/whole", place / "n/whole", place, source)}
        clear(comm)
        _tell(comm, "done", seed, told)


def _table(text: str) -> dict:
    from pfem_petsc.case.toml import parse_toml

    return parse_toml(text, "case")


def _tell(comm: MPI.Comm, what: str, seed: int, told: dict) -> None:
    if comm.rank == 0:
        print(f"{what} {seed} {json.dumps(told, default=str)}", flush=True)


def _touched(folder: Path) -> bool:
    history = open_result(folder).history
    return bool(np.asarray(history["active_contacts"]).any())
