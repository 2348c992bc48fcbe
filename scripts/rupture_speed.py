"""Explicit steps of an octet block of 10^5 bars, of which a tenth is broken, beside the same block without a break.

    python scripts/rupture_speed.py                 # 16 x 16 x 16 cells, in about a minute
    python scripts/rupture_speed.py --cells 6 --share 0.5 --law elastoplastic

Both are prestressed in the bars that are weak, which in one of them break in the first step. Batches of steps of both
alternate, so that other load of the machine meets both; the table has the shortest batch of each, in CPU time, and the
ratio of the two. The last line is the ratio of the ``steps per second`` after the break to those before.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from pathlib import Path

import numpy as np

from pfem_petsc import Case, Simulation, write_mesh
from pfem_petsc.mesh.generators import lattice

BATCH = 2  # steps; few, so that some batches are not interrupted on a machine with other load
YOUNG, DENSITY, AREA, PITCH = 1e9, 1000.0, 1e-6, 0.1


def main() -> None:
    """Run both blocks and print their times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=16, metavar="N", help="cells along each edge (default: 16)")
    parser.add_argument("--share", type=float, default=0.1, help="of the bars that break (default: 0.1)")
    parser.add_argument("--batches", type=int, default=1500, metavar="N", help="of 2 steps each (default: 1500)")
    parser.add_argument("--law", choices=("elastic", "elastoplastic"), default="elastic")
    arguments = parser.parse_args()
    slab = lattice.generate(lattice.Parameters(kind="octet", cells=(arguments.cells,) * 3, pitch=PITCH), 0, 1)
    bars = len(slab.bars)
    weak = np.sort(np.random.default_rng(1).permutation(bars)[: round(arguments.share * bars)])
    seconds: dict[str, list[float]] = {"whole": [], "broken": []}
    with tempfile.TemporaryDirectory(prefix="rupture-speed-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        write_mesh(folder / "block.h5", slab.points, slab.bars, bar_groups={"weak": weak})
        runs = {
            name: stack.enter_context(Simulation(case_of(folder, limit, arguments), output=folder / name, quiet=True))
            for name, limit in (("whole", 1e30), ("broken", 1e3))
        }
        steps = {name: run.batches() for name, run in runs.items()}
        for number in range(arguments.batches + 2):
            for name, batches in steps.items():
                begin = time.process_time()
                first = next(batches).step
                while next(batches).step < first + BATCH:
                    pass
                if number > 1:  # the first ones compile, and break the bars
                    seconds[name].append((time.process_time() - begin) / BATCH)
        counts = [int((run.model.bars.rupture() > 0.0).sum()) for run in runs.values()]
    if counts != [0, len(weak)]:
        raise SystemExit(f"not what was asked for: {counts} bars broken of {len(weak)}")
    print(f"{bars} bars, {len(weak)} broken ({100.0 * len(weak) / bars:.3g} %), law {arguments.law}")
    for name, times in seconds.items():
        print(f"{name:8s} {1e3 * min(times):.4f} ms a step, median {1e3 * float(np.median(times)):.4f} ms")
    print(f"steps per second after over before: {min(seconds['whole']) / min(seconds['broken']):.3f}")


def case_of(folder: Path, limit: float, arguments: argparse.Namespace) -> Case:
    """Return the case of a block whose weak bars break at a stress [Pa]."""
    material = {"young_modulus": YOUNG, "density": DENSITY, "rupture": {"stress": 1e30}}
    if arguments.law == "elastoplastic":
        material |= {"yield_stress": 2e6, "isotropic_hardening": 1e7}
    section = {"area": AREA, "material": "it"}
    step = 0.1 * PITCH / np.sqrt(YOUNG / DENSITY)
    return Case.from_dict(
        {
            "mesh": {"file": "block.h5"},
            "material": {"it": material, "weak": {**material, "rupture": {"stress": limit}}},
            "section": {"it": section, "weak": {**section, "material": "weak", "bars": "weak", "prestress": 1e6}},
            "initial": {"angular_velocity": [0.0, 0.0, 1.0]},
            "time": {
                "integrator": "central_differences",
                "step": step,
                "end": step * BATCH * (2 * arguments.batches + 8),
            },
            "output": {"fields_every": 0, "history_every": 1000},
        },
        folder=folder,
    )


if __name__ == "__main__":
    main()
