"""This program on the lattice; usage: run_ours.py CELLS MODE STEPS [OPERATOR].

In long runs there is a row of the history every 500 steps, else in every step. Whole runs have the default output, and
their time is that from the shell to the prompt. With contact the bars are elastoplastic (kinematic hardening) and the
wall is rigid. Without, bars are elastic and the foot is held along z. In static
increments bars are elastic, the foot is held, and the top is pressed down.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path

import model as m
import numpy as np
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result


def block(cells: int) -> tuple[dict, dict, np.ndarray]:
    """The table of the mesh, node sets (foot, head, last node, middle of an edge), place of the last node [m]."""
    if not m.MESH:
        corner = [cells * m.PITCH] * 3
        sets = {"foot": {"group": "bottom"}, "head": {"group": "top"}, "last": {"nearest": corner}}
        sets["middle"] = {"indices": [cells // 2]}
        return {"generator": "lattice", "kind": "cubic", "cells": [cells] * 3, "pitch": m.PITCH}, sets, np.array(corner)
    points, _ = m.truss(cells)
    far, high = 1e3, float(points[:, 2].max())
    sides = {"foot": (-far, 1e-6), "head": (high - 1e-6, far)}
    sets = {name: {"box": [[-far, -far, low], [far, far, up]]} for name, (low, up) in sides.items()}
    sets |= {name: {"nearest": points[k].tolist()} for name, k in (("last", -1), ("middle", m.middle(points)))}
    return json.loads(Path(m.MESH).with_suffix(".json").read_text(encoding="utf-8")), sets, points[-1]


def table(cells: int, mode: str, steps: int, operator: str) -> dict:
    """The case."""
    explicit, contact = not mode.startswith(("implicit", "static")), mode.endswith("contact")
    material = {"young_modulus": m.YOUNG_MODULUS, "density": m.DENSITY}
    if contact:
        # tangent E H / (E + H)
        hardening = m.YOUNG_MODULUS * m.HARDENING_RATIO / (1.0 - m.HARDENING_RATIO)
        material |= {"yield_stress": m.YIELD_STRESS, "kinematic_hardening": hardening}
    h = m.EXPLICIT_STEP if explicit else m.IMPLICIT_STEP
    mesh, sets, last = block(cells)
    if mode == "static":
        return pressed(mesh, sets, float(last[2]), material, steps, operator)
    if explicit:
        scheme = {"integrator": "central_differences"}
    else:
        scheme = {"integrator": "newmark", "beta": 0.25, "gamma": 0.5}
    case = {
        "title": "peers",
        "mesh": mesh,
        "node_set": sets,
        "material": {"strut": material},
        "section": {"strut": {"area": m.AREA, "material": "strut"}},
        "initial": {"velocity": [0.0, 0.0, m.SPEED]},
        "time": {**scheme, "step": h, "end": h * (steps + 1)},
        "output": {
            "fields_every": 0,
            "fields": [],
            "history_every": 500 if mode.endswith("long") else 1,
            "probe": [{"name": "top", "node_set": "last"}],
        },
        "solver": {"operator": operator or "auto"},
    }
    if mode.startswith("whole"):
        case["output"] = {}
        case["time"]["end"] = h * steps
    if contact:
        case["wall"] = [{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}]
    else:
        case["support"] = [{"node_set": "foot", "fix": "z"}]
    return case


def pressed(mesh: dict, sets: dict, height: float, material: dict, steps: int, linear: str) -> dict:
    """The case of static increments; ``linear`` is the solver."""
    motion = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -m.PRESSED * height]]
    return {
        "title": "peers",
        "mesh": mesh,
        "node_set": sets,
        "material": {"strut": material},
        "section": {"strut": {"area": m.AREA, "material": "strut"}},
        "support": [
            {"node_set": "foot", "fix": "xyz"},
            {"node_set": "head", "fix": "xyz", "motion": motion, "interpolation": "linear"},
        ],
        "static": {"step": 1.0 / (steps + 1)},
        "output": {"fields_every": 0, "fields": [], "probe": [{"name": "top", "node_set": "middle"}]},
        "solver": {"linear": linear or "auto"},
    }


def run(cells: int, mode: str, steps: int, operator: str, folder: str) -> tuple[Simulation, dict[str, float], int]:
    """Run as from the command line; seconds a step after the first, and iterations of the linear solver."""
    case = Case.from_dict(table(cells, mode, steps, operator), source="peers", folder=Path(folder))
    simulation = Simulation(case, output=folder, quiet=True)
    running = simulation.batches()  # as a long run
    linear = next(running).linear
    if mode.startswith("explicit"):
        next(running)  # orders the bars for many steps in one call
    newton = 0
    marks = [(simulation.state.step, time.process_time(), time.perf_counter(), newton)]
    while simulation.state.step < steps + 1:
        done = next(running)
        linear += done.linear
        newton += done.newton
        marks.append((simulation.state.step, time.process_time(), time.perf_counter(), newton))
    running.close()
    last = marks[-2 if len(marks) > 2 else -1]  # the end of the run is not timed
    timed, cpu, wall, newton = (after - before for after, before in zip(last, marks[0]))
    return simulation, {"cpu": cpu / timed, "wall": wall / timed, "iterations": newton / timed}, linear


def main() -> None:
    """Run and report."""
    cells, mode, steps, operator = m.arguments()
    if mode.startswith("whole"):
        folder = Path(os.environ["PEER_FOLDER"])
        case = folder / "lattice.toml"
        case.write_text(Case.from_dict(table(cells, mode, steps, operator), source="peers").to_toml())
        command = [sys.executable, "-m", "pfem_petsc", str(case), "-o", str(folder / "out")]
        times = m.whole(command, steps)
        with open_result(folder / "out") as result:
            first, last = result.positions(0), result.positions(-1)
        node = np.argmin(np.linalg.norm(first - block(cells)[2], axis=1))
        top = last[node, 2] - first[node, 2]
        m.report(times, len(m.truss(cells)[1]), float(top))
        return
    with tempfile.TemporaryDirectory() as own:
        folder = MPI.COMM_WORLD.bcast(own)
        if mode.startswith("explicit"):
            run(1, mode, 1000, operator, folder + "/first")  # all loops are compiled and loaded
        simulation, times, linear = run(cells, mode, steps, operator, folder + "/timed")
        top = simulation.row["probe/top/position"][0]
        top = top[0] if mode == "static" else top[2] - block(cells)[2][2]
        MPI.COMM_WORLD.Barrier()
        if MPI.COMM_WORLD.rank:
            return
        m.report(times, int(simulation.mesh.n_bars), float(top), linear=linear / (steps + 1))


main()
