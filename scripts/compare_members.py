"""Axial forces of ``members`` under small loads beside those of PyNite: a tower, a dome, a bridge.

    python scripts/compare_members.py PYTHON    # PYTHON: the interpreter of an environment with PyNiteFEA

PyNite's equilibrium is that of the undeformed truss; differences are in proportion to the loads. Prints the largest
difference over the largest force; status 1 if one is above 1e-6.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.post.members import members, truss_of

LOAD = 0.5
"""Load of a node [N], of bars that carry some million times as much."""


def tower() -> tuple[Truss, list[int], list[int]]:
    """Six storeys on four legs with crossed braces: mesh, fixed nodes, loaded ones."""
    storeys, points, bars = 6, [], []
    for level in range(storeys + 1):
        half, z = 3.0 - 1.8 * level / storeys, 24.0 * level / storeys
        points += [(x * half, y * half, z) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    for below in range(0, 4 * storeys, 4):
        for j in range(4):
            k = (j + 1) % 4
            up = below + 4
            bars += [(below + j, up + j), (below + j, up + k), (below + k, up + j), (up + j, up + k)]
        bars.append((below + 4, below + 6))
    return Truss(points, bars), list(range(4)), list(range(4 * storeys, 4 * storeys + 4))


def dome() -> tuple[Truss, list[int], list[int]]:
    """A spherical cap with three rings of twelve nodes, and diagonals."""
    count, rings, points, bars = 12, 3, [(0.0, 0.0, 3.0)], []
    for ring in range(1, rings + 1):
        radius, z = 4.0 * ring, 3.0 * (1.0 - (ring / rings) ** 2)
        turn = 2.0 * np.pi * np.arange(count) / count
        points += [(radius * np.cos(a), radius * np.sin(a), z) for a in turn]
    for ring in range(rings):
        for j in range(count):
            outer, following = 1 + ring * count + j, 1 + ring * count + (j + 1) % count
            inner = 0 if ring == 0 else outer - count
            bars += [(outer, following), (inner, outer)]
            bars += [(inner, following)] if ring else []
    return Truss(points, bars), list(range(1 + 2 * count, 1 + 3 * count)), list(range(1 + 2 * count))


def bridge() -> tuple[Truss, list[int], list[int]]:
    """A through truss of ten panels, braced across below, above and between."""
    n, length, width, height = 10, 6.0, 4.0, 6.0
    points = [(length * i, y, 0.0) for y in (0.0, width) for i in range(n + 1)]
    points += [(length * i, y, height) for y in (0.0, width) for i in range(1, n)]
    low = lambda side, i: side * (n + 1) + i  # noqa: E731
    top = lambda side, i: 2 * (n + 1) + side * (n - 1) + i - 1  # noqa: E731
    bars = []
    for s in (0, 1):
        bars += [(low(s, i), low(s, i + 1)) for i in range(n)] + [(top(s, i), top(s, i + 1)) for i in range(1, n - 1)]
        bars += [(low(s, i), top(s, i)) for i in range(1, n)] + [(low(s, 0), top(s, 1)), (low(s, n), top(s, n - 1))]
        bars += [(top(s, i), low(s, i + 1)) for i in range(1, n // 2)]
        bars += [(top(s, i), low(s, i - 1)) for i in range(n // 2 + 1, n)]
    bars += [(low(0, i), low(1, i)) for i in range(n + 1)] + [(top(0, i), top(1, i)) for i in range(1, n)]
    bars += [(low(0, i), low(1, i + 1)) for i in range(n)] + [(top(0, i), top(1, i + 1)) for i in range(1, n - 1)]
    bars += [(low(0, i), top(1, i)) for i in range(1, n)]
    return (
        Truss(points, bars),
        [low(s, i) for s in (0, 1) for i in (0, n)],
        [low(s, i) for s in (0, 1) for i in range(1, n)],
    )


def difference(name: str, folder: Path, python: str) -> float:
    """Return the largest difference of axial forces over the largest one."""
    mesh, fixed, loaded = {"tower": tower, "dome": dome, "bridge": bridge}[name]()
    force = [0.3 * LOAD, 0.2 * LOAD, -LOAD]
    case = Case(
        {
            "mesh": mesh,
            "material": {"steel": {"young_modulus": 2.1e11, "density": 7850.0}},
            "section": {"bar": {"area": 2e-3, "material": "steel"}},
            "node_set": {"fixed": {"indices": fixed}, "loaded": {"indices": loaded}},
            "support": [{"node_set": "fixed", "fix": "xyz"}],
            "load": [{"node_set": "loaded", "force": force}],
            "static": {"method": "newton", "step": 1.0},
        },
        name=name,
    )
    with Simulation(case, output=folder / name, quiet=True) as simulation:
        simulation.run()
    with open_result(folder / name) as result:
        table, truss, points = members(result, per="bar"), truss_of(result), result.positions(0)
        ours = np.zeros(len(result.bars))
        ours[table["bars"].astype(int)] = table["axial_force"]
        model = {
            "points": points.tolist(),
            "bars": result.bars.tolist(),
            "areas": truss.bars.area.tolist(),
            "young_modulus": 2.1e11,
            "fixed": fixed,
            "loads": [[node, force] for node in loaded],
        }
    files = [folder / f"{name}.{kind}.json" for kind in ("model", "forces")]
    files[0].write_text(json.dumps(model))
    script = Path(__file__).parent / "peers" / "run_pynite.py"
    subprocess.run([python, str(script), *map(str, files)], check=True, stdout=subprocess.DEVNULL)
    theirs = np.array(json.loads(files[1].read_text()))
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def main() -> int:
    """Compare all."""
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        found = {name: difference(name, Path(folder), sys.argv[1]) for name in ("tower", "dome", "bridge")}
    for name, value in found.items():
        print(f"{name:8} {value:.1e}")
    return int(max(found.values()) > 1e-6)


if __name__ == "__main__":
    raise SystemExit(main())
