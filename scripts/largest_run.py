"""An explicit run of 10^8 bars on one rank: a cubic lattice dropped on a floor; time per step, memory, and a picture.

    .venv/bin/python scripts/largest_run.py -o results/largest                  # 100,403,520 bars: 10 GB, some minutes
    .venv/bin/python scripts/largest_run.py --cells 48 --steps 40 -o results/smaller

The picture shows the vertical velocity in the middle plane at the end, with the wave reflected by the floor.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path
from statistics import median

import matplotlib
import numpy as np

from pfem_petsc import Case, Simulation

matplotlib.use("Agg")

PITCH, SPEED = 0.01, 20.0  # [m], [m/s]
YOUNG_MODULUS, DENSITY = 110e9, 4500.0  # [Pa], [kg/m3]


def main() -> int:
    """Run, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=223, help="along each edge (default %(default)s)")
    parser.add_argument("--steps", type=int, default=20, help="default %(default)s")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/largest"), help="folder")
    arguments = parser.parse_args()
    step = 0.4 * PITCH / np.sqrt(YOUNG_MODULUS / DENSITY)
    table = {
        "title": f"cubic lattice of {arguments.cells}^3 cells on a floor",
        "mesh": {"generator": "lattice", "kind": "cubic", "cells": [arguments.cells] * 3, "pitch": PITCH},
        "material": {"strut": {"young_modulus": YOUNG_MODULUS, "density": DENSITY}},
        "section": {"strut": {"area": 1e-6, "material": "strut"}},
        "initial": {"velocity": [0.0, 0.0, -SPEED]},
        "wall": [{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
        "time": {"integrator": "central_differences", "step": step, "end": arguments.steps * step},
        "output": {"fields_every": 0, "fields": []},
    }
    begin = time.perf_counter()
    simulation = Simulation(Case.from_dict(table, source="largest run"), output=arguments.output)
    ready = time.perf_counter()
    times, row, running = [], None, iter(simulation)
    while simulation.state.step < arguments.steps:
        before = time.perf_counter()
        row = next(running).row
        times.append(time.perf_counter() - before)
    figures = {
        "bars": simulation.mesh.n_bars,
        "nodes": simulation.mesh.n_nodes,
        "set-up s": ready - begin,
        "first step s": times[0],
        "step s": median(times[1:]),
        "peak memory GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
        "energy_imbalance over kinetic_energy": abs(row["energy_imbalance"]) / row["kinetic_energy"],
        "wall force N": row["wall/floor/force"][2],
    }
    draw(simulation, arguments.output / "middle_plane.png")
    running.close()
    figures["all s"] = time.perf_counter() - begin
    (arguments.output / "figures.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    for name, value in figures.items():
        print(f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value:,}")
    return 0


def draw(simulation: Simulation, path: Path) -> None:
    """Draw the velocity along z of the nodes of the middle plane at their positions in the lattice."""
    from matplotlib import pyplot

    points = simulation.mesh.points
    middle = PITCH * round(0.5 * points[:, 1].max() / PITCH)
    chosen = np.flatnonzero(np.abs(points[:, 1] - middle) < 0.25 * PITCH)
    place = np.rint(points[chosen][:, [2, 0]] / PITCH).astype(int)
    image = np.full(place.max(axis=0) + 1, np.nan)
    image[place[:, 0], place[:, 1]] = simulation.state.v[chosen, 2]
    figure, axes = pyplot.subplots(figsize=(7.0, 6.0), layout="constrained")
    extent = [0.0, PITCH * image.shape[1], 0.0, PITCH * image.shape[0]]
    shown = axes.imshow(image, origin="lower", extent=extent, cmap="RdBu_r", vmin=-SPEED, vmax=SPEED)
    figure.colorbar(shown, ax=axes, label="velocity along z [m/s]")
    time = simulation.state.time
    axes.set(xlabel="x [m]", ylabel="z [m]", title=f"{simulation.mesh.n_bars:,} bars, t = {time * 1e6:.3g} µs")
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


if __name__ == "__main__":
    raise SystemExit(main())
