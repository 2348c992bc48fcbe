"""The tables of impact phases: energy gain by contact for each phase of the impact within a step.

    python scripts/impact_phases.py            # rewrites those of docs/contact_tables.md, in four minutes
    python scripts/impact_phases.py --gains    # writes pfem_petsc/contact/impact_gains.npz, in twenty minutes
    python scripts/impact_phases.py --gains bathe    # the part of an integrator

Every integrator, treatment and mass matrix runs the rod of `rod_impact` against the wall in 14 phases: equal rods, each
a fourteenth of v h further from the wall than the previous one; a second table has walls with restitution. Both tables
are computed with small linear rods (impact_rods.py), and so are the gains that the program warns of before a run. Tests
compare them with runs of the program, in which all rods are one mesh. The exact energy ratios and releases are 1.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
from impact_rods import scan_impacts
from mpi4py import MPI
from pages import insert, markdown

from pfem_petsc import Case
from pfem_petsc.contact.impact_gains import (
    BARS,
    BOUND,
    CASES,
    PHASES,
    RESTITUTIONS,
    TABLE,
    RodImpact,
    impact_gain,
    overshoots,
)
from pfem_petsc.contact.impact_gains import (
    STEPS as GAIN_STEPS,
)
from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.integrators.base import Scheme
from pfem_petsc.registry import lookup
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan, make_stepper
from pfem_petsc.stepping.stepper import Stepper

START, END = "<!-- table: scripts/impact_phases.py -->\n", "<!-- end of phases -->"
START_REBOUNDS, END_REBOUNDS = "<!-- table: scripts/impact_phases.py, restitution -->\n", "<!-- end of rebounds -->"
ELEMENTS = 20
SPEED = 1e-4  # relative to the wave speed, small enough for linear rods even with large steps
LIMIT = 1.0 / ELEMENTS  # explicit limit of the step with lumped mass, l/c [s]
COLUMNS = {
    f"{treatment}, {mass}": (treatment, mass, 0.0)
    for treatment, mass in (
        *(("scheme", "lumped"), ("scheme", "consistent"), ("stick", "lumped")),
        *(("conserving", "lumped"), ("mass_redistribution", "lumped")),
    )
}
REBOUNDS = {f"e = {e:g}": ("scheme", "lumped", e) for e in (0.2, 0.5, 0.8, 0.9, 1.0)}
EXPLICIT = "central_differences", "chung_lee", "hulbert_chung", "souza_moura", "noh_bathe"
STEPS = 0.2, 1.0, 5.0, 20.0
"""Steps relative to the explicit limit of the lumped rod; explicit schemes use 0.2 and 0.9 of their own limit."""
SCHEMES = (
    ("central_differences", {}),
    ("chung_lee", {"beta": 1.0}),
    ("chung_lee", {"beta": 28.0 / 27.0}),
    ("hulbert_chung", {"rho_b": 0.0}),
    ("hulbert_chung", {"rho_b": 0.8}),
    ("hulbert_chung", {"rho_b": 1.0}),
    ("souza_moura", {}),
    ("noh_bathe", {"p": 0.54}),
    ("newmark", {"beta": 1.0, "gamma": 1.5}),
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("newmark", {"beta": 0.3025, "gamma": 0.6}),
    ("houbolt", {}),
    *(("wilson", {"theta": theta}) for theta in (1.4, 1.5, 1.6, 1.8, 2.0)),
    *(("generalized_alpha", {"rho_inf": rho}) for rho in (0.0, 0.5, 0.8, 1.0)),
    *(("hht_alpha", {"alpha": alpha}) for alpha in (-0.05, -1.0 / 3.0)),
    *(("bathe", {"rho_inf": rho}) for rho in (0.0, 0.8)),
    ("energy_momentum", {}),
)


@dataclass(frozen=True)
class Impacts:
    """Results of the impacts; arrays (phases,) as in :class:`impact_rods.ImpactScan`.

    ``warned``: whether the program warned about gains before it started.
    """

    largest: np.ndarray
    last: np.ndarray
    releases: np.ndarray
    force: np.ndarray
    warned: bool


AGAINST = "plane", "triangles", "turning", "pair"
"""What rods meet at x = 0: a plane, triangles, a plane that turns about its normal, and their mirror images."""


def write_rods(file: Path, step: float, speed: float = SPEED, against: str = "plane") -> None:
    """Write a mesh of all rods side by side, with tips three steps of flight and (k + 1/2)/14 of one before x = 0, and
    of their mirror images for pairs."""
    x = np.linspace(-1.0, 0.0, ELEMENTS + 1)
    points = np.zeros((PHASES, ELEMENTS + 1, 3))
    points[:, :, 0] = x - speed * step * (3.0 + (np.arange(PHASES)[:, None] + 0.5) / PHASES)
    points[:, :, 1] = 0.2 * np.arange(PHASES)[:, None]
    if against == "pair":
        points = np.concatenate([points, points * [-1.0, 1.0, 1.0]])
    start = np.arange(ELEMENTS) + (ELEMENTS + 1) * np.arange(len(points))[:, None]
    tips = (ELEMENTS + 1) * np.arange(1, len(points) + 1) - 1
    with h5py.File(file, "w") as mesh:
        mesh["points"] = points.reshape(-1, 3)
        mesh["bars"] = np.stack([start, start + 1], axis=2).reshape(-1, 2)
        mesh["node_groups/tips"], mesh["node_groups/others"] = tips[:PHASES], tips[PHASES:]
        mesh["node_groups/images"] = np.arange(PHASES * (ELEMENTS + 1), len(points) * (ELEMENTS + 1))


def source_of(file: Path, against: str) -> dict:
    """Return the tables of what the rods meet, whose mesh is in a file."""
    if against == "pair":
        pair = {"name": "pair", "first": "tips", "second": "others", "direction": [1.0, 0.0, 0.0]}
        groups = {"others": {"group": "others"}, "images": {"group": "images"}}
        return {"contact_pair": [pair], "node_set": groups}
    wall = {"name": "wall", "type": "plane", "point": [0.0] * 3, "normal": [-1.0, 0.0, 0.0]}
    if against == "triangles":
        corners = [[0.0, y, z] for y, z in ((-9.0, -9.0), (-9.0, 9.0), (9.0, 9.0), (9.0, -9.0))]
        face = file.with_name("face.obj")
        face.write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners) + "f 1 2 3\nf 1 3 4\n")
        wall = {"name": "wall", "type": "surface", "file": str(face)}
    if against == "turning":
        wall["rotation"] = {"centre": [0.0, 1.0, 0.5], "axis": [1.0, 0.0, 0.0], "angular_velocity": 0.7}
    return {"wall": [wall | {"node_set": "tips"}]}


def case_of(
    file: Path,
    scheme: tuple[str, dict],
    treatment: str,
    mass: str,
    step: float,
    restitution: float = 0.0,
    against: str = "plane",
) -> Case:
    """Return the case of the rods."""
    integrator, parameters = scheme
    source = source_of(file, against)
    met = next(iter(source))
    source[met][0]["restitution"] = restitution
    images = [{"node_set": "images", "velocity": [-SPEED, 0.0, 0.0]}]
    # motion along the axis only: a compressed rod would buckle within a few large steps due to rounding
    supports = [] if integrator in EXPLICIT else [{"node_set": "all", "fix": "yz"}]
    return Case.from_dict(
        {
            "mesh": {"file": str(file)},
            "node_set": {"tips": {"group": "tips"}, "all": {"all": True}} | source.pop("node_set", {}),
            "support": supports,
            "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
            "section": {"s": {"area": 1.0, "material": "m"}},
            "initial": {"velocity": [SPEED, 0.0, 0.0], "on": images if against == "pair" else []},
            "contact": {"treatment": treatment},
            "time": {"integrator": integrator, "step": step, "end": 100.0, "mass": mass, **parameters},
            "solver": {"linear": "mumps", "rtol": 1e-10},
            **source,
        }
    )


def impacts(
    scheme: tuple[str, dict], treatment: str, mass: str, step: float, restitution: float = 0.0, against: str = "plane"
) -> Impacts | None:
    """Run all phases; ``step`` is relative to the explicit limit. None if the program refuses the combination."""
    h = step * LIMIT
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rods.h5"
        write_rods(file, h, against=against)
        model = Model(case_of(file, scheme, treatment, mass, h, restitution, against), MPI.COMM_SELF)
        try:
            stepper = make_stepper(model, make_plan(model))
        except InputError:
            return None
    return _run(model, stepper, int(np.ceil(2.5 / h)) + 8)


def _run(model: Model, stepper: Stepper, steps: int) -> Impacts:
    ids = model.mesh.node_ids[: model.mesh.n_owned]
    rod, order = ids // (ELEMENTS + 1), np.argsort(ids)
    tips, n = order.reshape(-1, ELEMENTS + 1)[:PHASES, -1], len(ids) // (ELEMENTS + 1)
    bars = model.mesh.bars
    momentum = np.empty((len(ids), 3))

    def energy() -> np.ndarray:
        state = stepper.state
        model.inertia.mass_times(state.v, momentum)
        total = np.bincount(rod, 0.5 * (momentum * state.v).sum(axis=1), n)
        length = np.linalg.norm(state.x[bars[:, 1]] - state.x[bars[:, 0]], axis=1)
        strain = length / model.bars.rest - 1.0  # the default measure
        return (total + np.bincount(rod[bars[:, 0]], 0.5 * model.bars.rest * strain**2, n))[:PHASES]

    stepper.start()
    first = energy()
    largest, force, releases = np.ones(PHASES), np.zeros(PHASES), np.zeros(PHASES, dtype=int)
    last, touching = largest, np.zeros(PHASES, dtype=bool)
    try:
        for _ in range(steps):
            stepper.step()
            now = stepper.touching[tips, 0].copy() if len(model.contact.walls) else stepper.state.contact[tips, 0] < 0.0
            releases += touching & ~now
            touching, last = now, energy() / first
            largest = np.fmax(largest, last)
            force = np.fmax(force, -stepper.state.contact[tips, 0] / SPEED)
            if stepper.fault is not None:
                raise stepper.fault
    except SimulationFailure:
        largest = last = np.full(PHASES, np.inf)
    if hasattr(stepper, "destroy"):
        stepper.destroy()
    return Impacts(largest, last, releases, force, any("gains energy" in text for text in model.warnings))


def own_limit(integrator: str, parameters: dict, mass: str) -> float:
    """Return the largest step of a scheme over l/c, infinite for most implicit ones."""
    module = lookup("pfem_petsc.integrators", integrator, "")
    limit = module.Scheme(module.Parameters(**parameters)).limit()
    return 0.5 * limit / (np.sqrt(3.0) if mass == "consistent" else 1.0)


def steps_of(integrator: str, parameters: dict, mass: str) -> list[float]:
    """Return the steps over l/c in the table."""
    limit = own_limit(integrator, parameters, mass)
    return list(STEPS) if np.isinf(limit) else [0.2 * limit, 0.9 * limit]


def label(integrator: str, parameters: dict) -> str:
    """Return scheme and parameters as in a case file."""
    numbers = {28.0 / 27.0: "28/27", 0.25: "1/4", 0.5: "1/2", 1.5: "3/2"}
    parts = [
        f"{name} {numbers.get(value, f'{value:g}') if integrator != 'wilson' else value}"
        for name, value in parameters.items()
    ]
    return ", ".join([f"`{integrator}`", *parts])


def cell(found: Impacts | None) -> str:
    """Return largest energy, largest final energy, false releases, largest force; an asterisk marks a warning."""
    if found is None:
        return "-"
    star = "*" if found.warned else ""
    if not np.isfinite(found.largest).all():
        return f"blows up{star}"
    releases = int(found.releases.max()) - 1
    return f"{found.largest.max():.3f}, {found.last.max():.3f}, {max(releases, 0)}, {found.force.max():.2f}{star}"


def refused(scheme: Scheme, treatment: str, restitution: float = 0.0) -> bool:
    """Return whether a scheme cannot have a treatment or restitution."""
    if treatment == "scheme":
        return bool(restitution) and not scheme.jumps_known
    return lookup("pfem_petsc.contact.treatments", treatment, "").Treatment.refuses(scheme) is not None


def judged(
    integrator: str, parameters: dict, treatment: str, mass: str, step: float, restitution: float = 0.0
) -> Impacts | None:
    """As :func:`impacts`, for the small rods; ``step`` is relative to the explicit limit."""
    module = lookup("pfem_petsc.integrators", integrator, "")
    known = module.Parameters(**parameters)
    scheme = module.Scheme(known)
    if refused(scheme, treatment, restitution):
        return None
    impact = RodImpact(treatment, mass == "consistent", step, restitution)
    found = scan_impacts(scheme, impact)
    gain = impact_gain(integrator, tuple(known.model_dump().values()), impact)
    warned = gain > BOUND or overshoots(integrator, step)
    return Impacts(found.largest, found.last, found.releases, found.force, warned)


def table(of: Callable[..., Impacts | None], columns: dict[str, tuple]) -> str:
    """Return the table of columns with these treatments, mass matrices and restitutions."""
    rows = []
    for integrator, parameters in SCHEMES:
        for k, size in enumerate(steps_of(integrator, parameters, "lumped")):
            found = [
                of(integrator, parameters, treatment, mass, steps_of(integrator, parameters, mass)[k], restitution)
                for treatment, mass, restitution in columns.values()
            ]
            rows.append([label(integrator, parameters), f"{size:.3g}", *map(cell, found)])
    return markdown(["integrator", "step", *columns], rows) + "\n"


GAINS = {
    "central_differences": [{}],
    "chung_lee": [{"beta": beta} for beta in (1.0, 1.02, 28.0 / 27.0)],
    "hulbert_chung": [{"rho_b": rho} for rho in (0.0, 0.5, 0.8, 1.0)],
    "souza_moura": [{}],
    "noh_bathe": [{"p": p} for p in (0.54, 0.7)],
    "newmark": [
        {"beta": beta, "gamma": gamma}
        for beta, gamma in (
            *((0.25, 0.5), (0.3025, 0.6), (0.4, 0.5), (0.4225, 0.8), (0.5, 0.5), (0.5625, 1.0), (0.75, 1.0)),
            *((1.0, 0.5), (1.0, 1.0), (1.0, 1.5)),
        )
    ],
    "houbolt": [{}],
    "wilson": [{"theta": theta} for theta in (1.0, 1.4, 1.5, 1.6, 1.8, 2.0, 3.0)],
    "generalized_alpha": [{"rho_inf": rho} for rho in (0.0, 0.5, 0.8, 0.9, 1.0)],
    "hht_alpha": [{"alpha": alpha} for alpha in (-1.0 / 3.0, -0.2, -0.1, -0.05, 0.0)],
    "bathe": [{"rho_inf": rho} for rho in (0.0, 0.5, 0.8, 1.0)],
    "energy_momentum": [{}],
}
"""Integrators of the table of gains, and their parameters."""


def write_gains(integrators: Sequence[str]) -> None:
    """Write the table of gains that the program reads, or the part of some integrators."""
    with np.load(TABLE) as table:
        arrays = dict(table)
    for integrator, every in GAINS.items():
        if integrators and integrator not in integrators:
            continue
        module = lookup("pfem_petsc.integrators", integrator, "")
        gains = np.zeros((len(every), len(CASES), len(RESTITUTIONS), len(BARS), len(GAIN_STEPS)), dtype=np.float16)
        for of_parameters, parameters in zip(gains, every, strict=True):
            for of_case, (treatment, consistent) in zip(of_parameters, CASES, strict=True):
                _fill_gains(of_case, module, module.Parameters(**parameters), treatment, consistent)
        arrays[f"{integrator}.gains"] = gains
        arrays[f"{integrator}.parameters"] = np.array([list(one.values()) for one in every]).reshape(len(every), -1)
        print(integrator, flush=True)
    np.savez_compressed(TABLE, **arrays)


def _fill_gains(gains: np.ndarray, module: ModuleType, parameters: Any, treatment: str, consistent: bool) -> None:
    """Fill the gains (restitutions, bars, steps) of a treatment; only lumped masses bounce, by `scheme` or `stick`."""
    if refused(module.Scheme(parameters), treatment):
        return
    bounces = treatment in ("scheme", "stick") and not consistent
    for of_bars, restitution in zip(gains, RESTITUTIONS if bounces else RESTITUTIONS[:1], strict=False):
        for of_steps, bars in zip(of_bars, BARS, strict=True):
            for k, step in enumerate(GAIN_STEPS):
                if refused(module.Scheme(parameters), treatment, restitution):
                    break
                impact = RodImpact(treatment, consistent, step, restitution, bars)
                gain = scan_impacts(module.Scheme(parameters), impact).gain
                of_steps[k] = gain if gain < 6e4 else np.inf
                if module.Scheme.explicit and gain > 100.0:  # beyond the limit of the scheme
                    of_steps[k:] = np.inf
                    break


def main() -> None:
    """Run everything, and insert the tables between their marks in the document."""
    if "--gains" in sys.argv[1:]:
        write_gains([word for word in sys.argv[1:] if word != "--gains"])
        return
    for columns, start, end in ((COLUMNS, START, END), (REBOUNDS, START_REBOUNDS, END_REBOUNDS)):
        insert("contact_tables.md", start, end, table(judged, columns))


if __name__ == "__main__":
    main()
