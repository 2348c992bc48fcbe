"""Which linear solver is fastest at which step and size: the table behind ``solver.linear = "auto"``.

    python scripts/linear_solvers.py                          # 10^4 and 10^5 bars; some minutes
    python scripts/linear_solvers.py --cells 10 22 48         # 10^6 bars as well
    mpirun -n 2 python scripts/linear_solvers.py --cells 22

Newmark steps (beta = 1/4, gamma = 1/2) of an elastic cubic lattice that flies, vibrating, at 1, 10, 100 and 1000 times
the critical step of central differences. Writes Markdown and JSON; times are CPU seconds of the slowest rank, per step.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from mpi4py import MPI

SOLVERS = {
    "auto": (),
    "CG, Jacobi, matrix-free": ("solver.linear=cg", "solver.operator=matrix_free"),
    "CG, point-block Jacobi": ("solver.linear=cg", "solver.operator=assembled"),
    "CG, incomplete Cholesky": ("solver.linear=cg", "solver.operator=assembled"),
    "CG, multigrid": ("solver.linear=gamg",),
    "MUMPS": ("solver.linear=mumps",),
}
CHOLESKY = ["-pfem_pc_type", "bjacobi", "-pfem_sub_pc_type", "icc"]
MUMPS_UP_TO = 15_000  # unknowns; the factorisation of a lattice beyond takes minutes


def case(cells: int, step: float, steps: int, overrides: tuple[str, ...]):
    """The lattice with a velocity field that bends and stretches it: a rotation and a shear."""
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


def measure(cells: int, ratio: float, overrides: tuple[str, ...], steps: int) -> dict[str, float | str]:
    """Seconds, Newton and linear iterations a step, after a first step that is not counted."""
    from pfem_petsc import Simulation

    comm = MPI.COMM_WORLD
    folder = comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None)
    critical = 0.01 / np.sqrt(110e9 / 4500.0) * 1.93  # of this lattice; the exact ratio is printed by the program
    simulation = Simulation(case(cells, ratio * critical, steps + 1, overrides), comm, output=folder, quiet=True)
    newton, linear, began = 0, 0, 0.0
    for made, done in enumerate(simulation):
        if made == 0:
            began = time.process_time()
        else:
            newton += done.newton
            linear += done.linear
    seconds = comm.allreduce(time.process_time() - began, op=MPI.MAX) / steps
    return {
        "seconds": seconds,
        "newton": newton / steps,
        "linear": linear / steps,
        "bars": simulation.mesh.n_bars,
        "chosen": simulation.plan.linear.why,
    }


def main() -> None:
    """Measure and write the tables."""
    import petsc4py

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[10, 22], help="cells along an edge: 10, 22, 48")
    parser.add_argument("--ratios", type=float, nargs="+", default=[1.0, 10.0, 100.0, 1000.0])
    parser.add_argument("--steps", type=int, default=3, help="steps measured")
    parser.add_argument("-o", "--output", type=Path, default=Path("results/linear_solvers"))
    arguments = parser.parse_args()
    petsc4py.init(["linear_solvers"])
    from petsc4py import PETSc

    from pfem_petsc.errors import PfemError

    root = MPI.COMM_WORLD.rank == 0
    rows, lines = [], ["| bars | step | solver | s a step | Newton | linear |", "|---|---|---|---|---|---|"]
    for cells in arguments.cells:
        for ratio in arguments.ratios:
            for name, overrides in SOLVERS.items():
                if name == "MUMPS" and 3 * (cells + 1) ** 3 > MUMPS_UP_TO:
                    continue
                options = PETSc.Options()
                if "Cholesky" in name:
                    options["pfem_pc_type"], options["pfem_sub_pc_type"] = CHOLESKY[1], CHOLESKY[3]
                try:
                    row = measure(cells, ratio, overrides, arguments.steps)
                except PfemError as error:
                    row = {"seconds": float("nan"), "newton": 0, "linear": 0, "bars": 0, "chosen": str(error)}
                for key in ("pfem_pc_type", "pfem_sub_pc_type"):
                    options.delValue(key)
                rows.append({"cells": cells, "ratio": ratio, "solver": name, **row})
                shown = f"auto: {row['chosen']}" if name == "auto" else name
                lines.append(
                    f"| {row['bars']:,} | {ratio:g} x | {shown} | {row['seconds']:.3g} | {row['newton']:.1f} | "
                    f"{row['linear']:.0f} |"
                )
                if root:
                    print(lines[-1], flush=True)
    if root:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "table.md").write_text("\n".join(lines) + "\n")
        (arguments.output / "table.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
