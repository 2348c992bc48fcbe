"""What [self_contact] costs in explicit steps: the table of docs/performance.md.

    python scripts/self_contact_costs.py             # into the document; some minutes
    python scripts/self_contact_costs.py flight      # these only, printed

flight   10^5 thin bars of an octet lattice that spins and vibrates, none of which touches: the time of a step with
         [self_contact] over that without, in turn.
crush    A block of 8 x 8 x 8 dense octet cells between plates, as in lattice_crush: the same, around 60 % of strain.
lists    The time of a search of 957,168 bars, of which the lists of close pairs are made.

Ratios are those of the shortest times. Files are written with the last step only.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tomllib
from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI
from pages import insert, markdown

from pfem_petsc import Case, Simulation
from pfem_petsc.case.toml import built_in_path, read_text

MARKS = "<!-- table: scripts/self_contact_costs.py -->\n", "<!-- end of self-contact costs -->"
ROUNDS = 4
BLOCK, PITCH = 8, 0.01


def simulation_of(tables: dict[str, Any], contact: bool, folder: str) -> Simulation:
    """Return a simulation of a case, with or without contact between bars."""
    tables = {name: table for name, table in tables.items() if contact or name != "self_contact"}
    return Simulation(Case.from_dict(tables, name="costs"), MPI.COMM_SELF, output=folder, quiet=True)


def lattice(cells: int, steps: int) -> dict[str, Any]:
    """Return the tables of a thin octet lattice that spins and vibrates."""
    return {
        "mesh": {"generator": "lattice", "kind": "octet", "cells": [cells] * 3, "pitch": PITCH},
        "node_set": {"half": {"box": [[-1.0, -1.0, -1.0], [0.5 * cells * PITCH, 1.0, 1.0]]}},
        "material": {"titanium": {"young_modulus": 110e9, "density": 4500.0}},
        "section": {"strut": {"area": 1e-8, "material": "titanium"}},
        "initial": {
            "angular_velocity": [0.0, 0.0, 20.0],
            "on": [{"node_set": "half", "velocity": [0.2, 0.0, 0.1], "angular_velocity": [0.0, 0.0, 20.0]}],
        },
        "self_contact": {},
        "time": {"integrator": "central_differences", "step": 5e-7, "end": 5e-7 * steps},
        "output": {"history_every": 50, "fields_every": 0},
    }


def time_of(tables: dict[str, Any], contact: bool, begin: float, end: float) -> tuple[float, int]:
    """Return the time [s] that a step takes, of those between two parts of a run, and the number of bars."""
    with tempfile.TemporaryDirectory() as folder, simulation_of(tables, contact, folder) as simulation:
        marks, last = [], tables["time"]["end"]
        for step in simulation.batches():
            part = step.time / last
            if begin <= part < 1.0:  # the last call ends with checks of the result
                marks.append((step.step, time.perf_counter()))
            if part >= end:
                break
    (first, started), (final, ended) = marks[0], marks[-1]
    return (ended - started) / (final - first), simulation.mesh.n_bars


def compared(tables: dict[str, Any], begin: float, end: float, rounds: int = ROUNDS) -> list[str]:
    """Return the number of bars, the shortest times of a step without and with contact between them [ms], and their
    ratio."""
    times: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(rounds):
        for contact, found in times.items():
            taken, bars = time_of(tables, contact, begin, end)
            found.append(taken)
    without, with_contact = (1e3 * min(found) for found in times.values())
    return [f"{bars:,}", f"{without:.3g}", f"{with_contact:.3g}", f"{with_contact / without:.2f}"]


def flight() -> list[str]:
    """Bars that do not touch."""
    return ["flight, none touches", *compared(lattice(16, 1500), 0.1, 0.9)]


def crush() -> list[str]:
    """Bars that touch."""
    tables = tomllib.loads(read_text(built_in_path("lattice_crush")))
    scale = BLOCK / tables["mesh"]["cells"][0]
    tables["mesh"]["cells"] = [BLOCK] * 3
    tables["wall"][1]["point"][2] = BLOCK * PITCH + 2.5e-4
    tables["time"]["end"] *= scale
    tables["output"] = {"history_every": 50, "fields_every": 0}
    speed, last = -tables["wall"][1]["velocity"][2], tables["time"]["end"]
    begin, end = (strain * BLOCK * PITCH / speed / last for strain in (0.58, 0.62))
    return ["crush, 58 to 62 % of strain", *compared(tables, begin, end, rounds=2)]


def lists() -> list[str]:
    """A search of all pairs of bars."""
    with tempfile.TemporaryDirectory() as folder, simulation_of(lattice(34, 1), True, folder) as simulation:
        simulation.start()
        touch, times = simulation.model.self_contact, []
        x, f = simulation.state.x, np.zeros_like(simulation.state.x)
        for _ in range(ROUNDS + 1):
            touch.stale = True
            started = time.perf_counter()
            touch.evaluate(x, f, 0.0, commit=False)
            times.append(time.perf_counter() - started)
        bars = simulation.model.mesh.n_bars
    return ["a search of all pairs", f"{bars:,}", "-", f"{1e3 * min(times):.3g}", "-"]


ROWS: dict[str, Callable[[], list[str]]] = {function.__name__: function for function in (flight, crush, lists)}


def main() -> None:
    """Make the rows that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", choices=[*ROWS, []], help="default: all, into the document")
    chosen = parser.parse_args().rows
    head = "steps", "bars", "without [ms]", "with contact [ms]", "ratio"
    table = markdown(head, [ROWS[name]() for name in chosen or ROWS])
    if chosen:
        print(table)
    else:
        insert("performance.md", *MARKS, table + "\n")


if __name__ == "__main__":
    main()
