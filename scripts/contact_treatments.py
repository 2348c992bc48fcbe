"""A table and the figure of docs/contact_tables.md: treatments of impact times integrators, on a rod and a wall.

    python scripts/contact_treatments.py            # rewrites both, in about a minute
    python scripts/contact_treatments.py --sliding  # rewrites the table of slides on a curved wall, in about a minute

The exact force is constant, rho c A v for 2 L/c, and no energy is lost; none is lost in a slide either.
"""

from __future__ import annotations

import argparse
import tempfile

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from pages import DOCS, insert, markdown

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError

SPEED = 0.1
FORCE, ENERGY = SPEED, 0.5 * SPEED**2  # rho c A v and m v^2/2 with rho = c = A = L = 1
STEP = 0.01
TREATMENTS = ("scheme", "stick", "conserving", "mass_redistribution")
SCHEMES = (
    ("central_differences", {}),
    ("chung_lee", {}),
    ("hulbert_chung", {"rho_b": 0.5}),
    ("noh_bathe", {}),
    ("newmark", {}),
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("houbolt", {}),
    ("wilson", {"theta": 1.4}),
    ("wilson", {"theta": 1.5}),
    ("generalized_alpha", {}),
    ("hht_alpha", {}),
    ("bathe", {}),
    ("energy_momentum", {}),
)


def run(treatment: str, integrator: str, parameters: dict[str, float]) -> list[dict] | None:
    """Return the history rows of the rod, None if the treatment is not compatible with the scheme."""
    overrides = [
        f"time.integrator={integrator}",
        f"time.step={STEP}",
        "time.end=5.0",
        "output.fields_every=0",
        f'contact.treatment="{treatment}"',
        f"initial.velocity=[{SPEED}, 0.0, 0.0]",
        *(f"time.{name}={value}" for name, value in parameters.items()),
    ]
    with tempfile.TemporaryDirectory() as folder:
        try:
            simulation = Simulation(Case.load("rod_impact", overrides), output=folder, quiet=True)
        except InputError:
            return None
        return [step.row for step in simulation]


def label(integrator: str, parameters: dict[str, float]) -> str:
    """Return scheme and parameters as in a case file."""
    return ", ".join([integrator, *(f"{name} {value:g}" for name, value in parameters.items())])


def table(results: dict) -> str:
    """Return the table, with one line per scheme and one column per treatment."""

    def cell(rows: list[dict] | None) -> str:
        if rows is None:
            return "-"
        force = max(abs(row["wall/wall/force"][0]) for row in rows) / FORCE
        rebound = -rows[-1]["momentum"][0] / SPEED
        energy = (rows[-1]["kinetic_energy"] + rows[-1]["elastic_energy"]) / ENERGY
        return f"{force:.2f}, {rebound:.3f}, {energy:.4f}, {rows[-1]['wall/wall/releases']}"

    names = [label(*scheme) for scheme in SCHEMES]
    return markdown(
        ["integrator", *TREATMENTS], [[name, *(cell(results[name, each]) for each in TREATMENTS)] for name in names]
    )


def figure(results: dict) -> None:
    """Plot the force over time of three schemes with all treatments."""
    shown = [SCHEMES[0], SCHEMES[4], SCHEMES[5]]
    colours = dict(zip(TREATMENTS, ("#bbbbbb", "#d55e00", "#009e73", "#0072b2"), strict=True))
    widths = dict(zip(TREATMENTS, (3.0, 1.4, 0.9, 1.4), strict=True))  # wide under narrow where curves are the same
    picture, axes = plt.subplots(len(shown), 1, figsize=(8, 8), sharex=True, layout="constrained")
    for axis, (integrator, parameters) in zip(axes, shown, strict=True):
        for treatment in TREATMENTS:
            rows = results[label(integrator, parameters), treatment]
            if rows is not None:
                force = [-row["wall/wall/force"][0] / FORCE for row in rows]
                style = {"color": colours[treatment], "lw": widths[treatment], "label": treatment}
                axis.plot([row["time"] for row in rows], force, **style)
        axis.plot([0.0, 0.5, 0.5, 2.5, 2.5, 3.0], [0, 0, 1, 1, 0, 0], "k--", lw=0.8, label="exact")
        axis.set(ylim=(-0.2, 3.2), xlim=(0.3, 3.0), ylabel="F / (ρ c A v)", title=label(integrator, parameters))
    handles = {text: line for axis in axes for line, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    order = [*TREATMENTS, "exact"]  # not every scheme has every treatment
    picture.legend([handles[name] for name in order], order, loc="outside upper center", ncols=5, fontsize=11)
    axes[-1].set_xlabel("time [s]")
    plt.savefig(DOCS / "images" / "contact_treatments.png", dpi=110)


SLIDES = (
    ("central_differences", {}, (13.6, 7.1, 3.6)),
    ("chung_lee", {}, (13.6, 7.1, 3.6)),
    ("hulbert_chung", {}, (13.6, 7.1, 3.6)),
    ("souza_moura", {}, (13.6, 7.1, 3.6)),
    ("generalized_alpha", {}, (6.3, 3.2, 1.6)),
    ("energy_momentum", {}, (7.1, 3.6, 1.8)),
    ("newmark", {"beta": 0.25, "gamma": 0.5}, None),
    ("houbolt", {}, None),
    ("wilson", {"theta": 2.0}, None),
    ("newmark", {}, None),
)
"""Schemes, and what they lose [%] with forces along the normal of the new position (version 0.2), where it differs."""


def slide(integrator: str, parameters: dict[str, float], step: float) -> float:
    """Energy [%] that a bar loses in a frictionless tube of radius 1 m, from 60 degrees, within 1.2 periods."""
    place, g = [np.sqrt(0.75), 0.0, -0.5], 9.81
    case = {
        "mesh": {"generator": "arrays", "points": [place, [place[0], 1.0, -0.5]], "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "gravity": {"acceleration": [0.0, 0.0, -g]},
        "wall": [
            {"name": "w", "type": "cylinder", "point": [0, 0, 0], "axis": [0, 1, 0], "radius": 1.0, "side": "inside"}
        ],
        "time": {"integrator": integrator, "step": step, "end": 2.583, **parameters},
        "output": {"fields_every": 0, "history_every": 100},
    }
    with tempfile.TemporaryDirectory() as folder, Simulation(Case(case), output=folder, quiet=True) as simulation:
        simulation.run()
        x, v = simulation.state.position, simulation.state.v
        return -100.0 * (0.5 * (v * v).sum(axis=1).mean() + g * (x[:, 2].mean() + 0.5)) / (0.5 * g)


def sliding() -> str:
    """The table of slides."""
    rows = []
    for integrator, parameters, other in SLIDES:
        lost = (f"{round(slide(integrator, parameters, step), 4) + 0.0:.4f} %" for step in (4e-3, 2e-3, 1e-3))
        earlier = "the same" if other is None else ", ".join(f"{value:.1f}" for value in other) + " %"
        rows.append([label(integrator, parameters), *lost, earlier])
    return markdown(["", "4 ms", "2 ms", "1 ms", "by the new normal"], rows)


def main() -> None:
    """Run everything, and insert the table between its marks in the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sliding", action="store_true", help="the table of slides only")
    if parser.parse_args().sliding:
        start = "<!-- table: scripts/contact_treatments.py --sliding -->\n"
        insert("contact_tables.md", start, "<!-- end of slides -->", sliding() + "\n")
        return
    results = {
        (label(integrator, parameters), treatment): run(treatment, integrator, parameters)
        for integrator, parameters in SCHEMES
        for treatment in TREATMENTS
    }
    start = "<!-- table: scripts/contact_treatments.py -->\n"
    insert("contact_tables.md", start, "<!-- end of table -->", table(results) + "\n")
    figure(results)


if __name__ == "__main__":
    main()
