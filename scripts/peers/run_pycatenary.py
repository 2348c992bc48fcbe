"""A mooring line, part of it on a floor, beside pycatenary (PyPI; ``pip install pycatenary``).

    python scripts/peers/run_pycatenary.py [BARS [EA]]

Prints horizontal and vertical tension at the fairlead [N] and the length on the floor [m]. The line is 6.98 m long,
weighs 1.036 N/m and goes from (0, 0, 0) to (5.2, 1, 2.65) m; the floor is at z = 0. The chain of bars starts straight
on the floor, and its end is lifted (``static.method = "relaxation"``). pycatenary 1.0.0 has, for E A = 560 kN,
0.7552163 N, 3.4181715 N and 3.6806067 m.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from pfem_petsc import Case, Simulation, open_result

LENGTH, WEIGHT, FAIRLEAD, AREA = 6.98, 1.036, np.array([5.2, 1.0, 2.65]), 1e-4


def ours(bars: int, stiffness: float) -> tuple[float, float, float]:
    """Tensions and length on the floor of a chain of bars."""
    way = [float(value) for value in FAIRLEAD - [LENGTH, 0.0, 0.0]]
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": LENGTH, "elements": bars},
            "node_set": {"anchor": {"group": "start"}, "fairlead": {"group": "end"}},
            "material": {"line": {"young_modulus": stiffness / AREA, "density": WEIGHT / (9.81 * AREA)}},
            "section": {"line": {"area": AREA, "material": "line"}},
            "support": [
                {"node_set": "anchor", "fix": "xyz"},
                {"node_set": "fairlead", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, *way]]},
            ],
            "gravity": {"acceleration": [0.0, 0.0, -9.81]},
            "wall": [{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
            "static": {"method": "relaxation", "max_iterations": 2_000_000},
            "output": {"probe": [{"name": "fairlead", "node_set": "fairlead"}]},
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        with Simulation(case, output=Path(folder) / "out", quiet=True) as simulation:
            simulation.run()
        result = open_result(Path(folder) / "out")
        force = result.history["probe/fairlead/reaction"][-1, 0]
        lying = np.count_nonzero(result.positions(-1)[1:, 2] < 1e-9) * LENGTH / bars
    return float(np.hypot(force[0], force[1])), float(force[2]), lying


def theirs(stiffness: float) -> tuple[float, float, float]:
    """The same by pycatenary."""
    from pycatenary.cable import MooringLine

    line = MooringLine(L=LENGTH, w=WEIGHT, EA=stiffness, anchor=[0.0, 0.0, 0.0], fairlead=FAIRLEAD.tolist(), floor=True)
    line.compute_solution()
    force = line.get_tension(LENGTH)
    return float(np.hypot(force[0], force[1])), float(force[2]), float(LENGTH - line.catenary.Ls[0])


def main() -> None:
    """Both, one below the other."""
    bars = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    stiffness = float(sys.argv[2]) if len(sys.argv) > 2 else 560e3
    print(f"{'':20s} horizontal [N]  vertical [N]  on the floor [m]")
    print("{:20s} {:14.7f} {:13.7f} {:17.5f}".format("pycatenary", *theirs(stiffness)))
    print("{:20s} {:14.7f} {:13.7f} {:17.5f}".format(f"{bars} bars", *ours(bars, stiffness)))


if __name__ == "__main__":
    main()
