"""Measures the fastest linear solver by step and size: the table behind ``solver.linear = "auto"``.

    python scripts/linear_solvers.py                          # 10^4 and 10^5 bars; some minutes
    python scripts/linear_solvers.py --cells 48 --steps 1     # 10^6 bars, in 10 GB of memory
    mpirun -n 2 python scripts/linear_solvers.py --cells 22

Newmark steps (beta = 1/4, gamma = 1/2) of an elastic cubic lattice that flies, vibrating, at 1, 10, 100 and 1000 times
the critical step of central differences. Writes Markdown and JSON; times are CPU seconds of the slowest rank, per step,
after a first step. The set-up of a lagged preconditioner, in that first step, has a separate column; other
preconditioners are set up at every Newton iteration. An entry that takes 10 times the best so far is stopped, with ">".
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

if TYPE_CHECKING:
    from pfem_petsc import Case

SOLVERS = {
    "CG, Jacobi, matrix-free": ("solver.linear=cg", "solver.operator=matrix_free"),
    "CG, multigrid on a background grid": ("solver.linear=multigrid",),
    "CG, lagged multigrid, matrix-free": ("solver.linear=gamg", "solver.operator=matrix_free"),
    "CG, lagged MUMPS, matrix-free": ("solver.linear=mumps", "solver.operator=matrix_free"),
    "CG, point-block Jacobi, assembled": ("solver.linear=cg", "solver.operator=assembled"),
    "CG, incomplete Cholesky, assembled": ("solver.linear=cg", "solver.operator=assembled"),
    "CG, lagged multigrid, assembled": ("solver.linear=gamg", "solver.operator=assembled"),
    "MUMPS": ("solver.linear=mumps", "solver.operator=assembled"),
    "auto": (),
}
CHOLESKY = {"pfem_pc_type": "bjacobi", "pfem_sub_pc_type": "icc"}
FACTORISED_UP_TO = 100_000  # unknowns; a lattice of 10^6 bars would take some 15 GB and minutes
ENDED = 10.0  # times the best


def case(cells: int, step: float, steps: int, overrides: tuple[str, ...]) -> Case:
    """Return the lattice with a velocity field that bends and stretches it: a rotation and a shear."""
    from pfem_petsc import Case

    pitch, extent = 0.01, 0.01 * cells
    return Case.from_dict(
        {
            "title": "linear solvers",
            "mesh": {"generator": "lattice", "kind": "cubic", "cells": [cells] * 3, "pitch": pitch},
            "node_set": {"top": {"box": [[-1.0, -1.0, 0.6 * extent], [1.0, 1.0, 1.0]]}},
            "material": {"m": {"young_modulus": 110e9, "density": 4500.0}},
            "section": {"s": {"area": 1e-6, "material": "m"}},
            "initial": {
                "velocity": [0.0, 0.0, 0.0],
                "on": [{"node_set": "top", "velocity": [2e-7 / step, 0.0, 1e-7 / step]}],
            },
            "time": {"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": step, "end": steps * step},
            "output": {"fields_every": 0, "fields": []},
        },
        overrides=list(overrides),
    )


def measure(
    cells: int, ratio: float, overrides: tuple[str, ...], steps: int, most: float = np.inf, horizon: int = 10
) -> dict[str, float | str | bool]:
    """Return seconds, Newton and linear iterations per step, after a first step that is not counted.

    The run is stopped as soon as more than ``most`` seconds per step are certain. Its end corresponds to at least
    ``horizon`` steps, of which only the first are made, because the automatic choice depends on the number of steps.
    """
    from pfem_petsc import Simulation

    comm = MPI.COMM_WORLD
    folder = comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None)
    critical = 0.01 / np.sqrt(110e9 / 4500.0) * 1.93  # of this lattice; the exact ratio is printed by the program
    simulation = Simulation(
        case(cells, ratio * critical, max(steps + 1, horizon), overrides), comm, output=folder, quiet=True
    )
    stepper = simulation.stepper
    once = 0.0

    def timed_renewal(*arguments: Any) -> None:
        nonlocal once
        began = time.process_time()
        renew(*arguments)
        once += time.process_time() - began

    if stepper.lagged is not None:
        renew, stepper.lagged.renew = stepper.lagged.renew, timed_renewal
    newton, linear, began, set_up, ended = 0, 0, 0.0, 0.0, False
    running = iter(simulation)
    for made, done in enumerate(running):
        spent = comm.allreduce(time.process_time() - began, op=MPI.MAX)
        if made == 0:
            began, set_up = time.process_time(), once
            continue
        newton += done.newton
        linear += done.linear
        ended = bool(spent > most * steps and made < steps)
        if made == steps or ended:
            break
    running.close()
    bars, why = simulation.mesh.n_bars, simulation.plan.linear.why
    stepper.destroy()
    return {
        "seconds": spent / made,
        "set_up": set_up,
        "ended": ended,
        "newton": newton / made,
        "linear": linear / made,
        "bars": bars,
        "chosen": why,
    }


def main() -> None:
    """Measure and write the tables."""
    import petsc4py

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[10, 22], help="cells along an edge: 10, 22, 48")
    parser.add_argument("--ratios", type=float, nargs="+", default=[1.0, 10.0, 100.0, 1000.0])
    parser.add_argument("--steps", type=int, default=3, help="steps measured")
    parser.add_argument("--solvers", nargs="+", help="only those with one of these words in their names")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/linear_solvers"))
    arguments = parser.parse_args()
    petsc4py.init(["linear_solvers"])
    from petsc4py import PETSc

    from pfem_petsc.errors import PfemError

    root = MPI.COMM_WORLD.rank == 0
    rows = []
    lines = ["| bars | step | solver | s a step | set-up, once | Newton | linear |", "|---|---|---|---|---|---|---|"]
    options = PETSc.Options()
    for cells in arguments.cells:
        for ratio in arguments.ratios:
            best = np.inf
            for name, overrides in SOLVERS.items():
                if arguments.solvers and not any(word in name for word in arguments.solvers):
                    continue
                if "MUMPS" in name and 3 * (cells + 1) ** 3 > FACTORISED_UP_TO:
                    continue
                for key, value in CHOLESKY.items() if "Cholesky" in name else ():
                    options[key] = value
                try:
                    row = measure(cells, ratio, overrides, arguments.steps, ENDED * best)
                except PfemError as error:
                    row = {"seconds": np.nan, "set_up": 0.0, "ended": False, "newton": 0, "linear": 0, "bars": 0}
                    row["chosen"] = str(error)
                for key in CHOLESKY:
                    options.delValue(key)
                best = float(np.fmin(best, row["seconds"]))
                rows.append({"cells": cells, "ratio": ratio, "solver": name, **row})
                shown = f"auto: {row['chosen']}" if name == "auto" else name
                lines.append(
                    f"| {row['bars']:,} | {ratio:g} x | {shown} | {'> ' * row['ended']}{row['seconds']:.3g} | "
                    f"{row['set_up']:.2g} | {row['newton']:.1f} | {row['linear']:.0f} |"
                )
                if root:
                    print(lines[-1], flush=True)
    if root:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "table.md").write_text("\n".join(lines) + "\n")
        (arguments.output / "table.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
