"""Path of equilibria of a dome beside OpenSees; usage: path_openseespy.py MODEL.tcl [POINTS [OPENSEES PYTHON]].

MODEL.tcl is an example of OpenSees of corotational trusses with one nodal load, written out node by node, such as
EXAMPLES/EQPath/DLSD.tcl: a double-layer dome of 391 nodes and 1,470 bars (Rezaiee-Pajand, Ghalishooyan and
Salehi-Ahmadabad, Structural Engineering and Mechanics 48 (2013) 879, problem 14). This program follows the path by arc
length. OpenSees then goes through the same displacements of the loaded node by displacement control, and its load
factors and positions are compared point by point. OpenSeesPy may be in an environment of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

STEP, LARGEST = 0.02, 1.0
"""First increment of the load factor and largest length."""


def read_model(path: Path) -> dict:
    """Nodes, bars, supports, load, area and modulus of a Tcl script of plain commands."""
    names: dict[str, str] = {}
    model: dict = {"points": {}, "bars": [], "fixed": []}
    loop = 0
    for line in path.read_text().splitlines():
        if line.startswith("while {$i<") and not model["fixed"]:
            loop = int(line.split("<")[1].split("}")[0])
        if line.split()[:2] == ["fix", "$i"]:  # the one loop over supports
            model["fixed"] = list(range(loop))
            continue
        words = [
            names.get(word.lstrip("$"), word) if word.startswith("$") else word for word in line.strip(" ;").split()
        ]
        match words:
            case ["set", name, value, *_]:
                names[name] = value.rstrip(";")
            case ["node", number, x, y, z, *_]:
                model["points"][int(number)] = [float(x), float(y), float(z)]
            case ["element", "corotTruss", _, first, second, area, *_]:
                model["bars"].append([int(first), int(second)])
                model["area"] = float(area)
            case ["fix", number, *_]:
                model["fixed"].append(int(number))
            case ["uniaxialMaterial", "Elastic", _, modulus, *_]:
                model["modulus"] = float(modulus)
            case ["load", number, x, y, z, *_]:
                model["load"] = [int(number), [float(x), float(y), float(z)]]
    model["points"] = [model["points"][k] for k in range(len(model["points"]))]
    return model


def ours(model: dict, points: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Load factors, positions (points, nodes, 3) and critical points of this program."""
    import h5py
    from mpi4py import MPI

    from pfem_petsc import Case, Simulation, open_result

    node, force = model["load"]
    with tempfile.TemporaryDirectory() as folder:
        with h5py.File(f"{folder}/mesh.h5", "w") as file:
            file["points"], file["bars"] = np.array(model["points"]), np.array(model["bars"])
        case = Case.from_dict(
            {
                "mesh": {"file": "mesh.h5"},
                "node_set": {"crown": {"indices": [node]}, "feet": {"indices": model["fixed"]}},
                "material": {"it": {"young_modulus": model["modulus"], "density": 7850.0}},
                "section": {"it": {"area": model["area"], "material": "it"}},
                "support": [{"node_set": "feet", "fix": "xyz"}],
                "load": [{"node_set": "crown", "force": force}],
                "static": {
                    "method": "arc_length",
                    "step": STEP,
                    "max_step": LARGEST,
                    "max_points": points,
                    "node_set": "crown",
                    "direction": force,
                },
                "output": {"fields_every": 1, "fields": []},
            },
            folder=folder,
        )
        assert Simulation(case, MPI.COMM_SELF, output=f"{folder}/a", quiet=True).run() == 0
        result = open_result(f"{folder}/a")
        history = result.history
        events = zip(history["event/kind"], history["event/load_factor"], history["event/displacement"], strict=True)
        told = [f"{kind} at load factor {factor:.6g}, displacement {way:.6g} m" for kind, factor, way in events]
        return history["load_factor"], np.array([result.positions(k) for k in range(len(result.times))]), told


def theirs(model: dict, ways: list[float]) -> tuple[list[float], list]:
    """Load factors and displacements of OpenSees at displacements of the loaded node along z; stops where it does."""
    import openseespy.opensees as ops

    ops.wipe()
    ops.model("basic", "-ndm", 3, "-ndf", 3)
    for number, point in enumerate(model["points"]):
        ops.node(number, *point)
    for number in model["fixed"]:
        ops.fix(number, 1, 1, 1)
    ops.uniaxialMaterial("Elastic", 1, model["modulus"])
    for number, (first, second) in enumerate(model["bars"]):
        ops.element("corotTruss", number, first, second, model["area"], 1)
    node, force = model["load"]
    ops.timeSeries("Linear", 1)
    ops.pattern("Plain", 1, 1)
    ops.load(node, *force)
    ops.constraints("Plain")
    ops.numberer("RCM")
    ops.system("UmfPack")
    ops.test("NormUnbalance", 1e-9 * abs(force[2]), 50, 0)
    ops.algorithm("Newton")
    ops.analysis("Static", "-noWarnings")
    factors, moved, before = [], [], 0.0
    for way in ways:
        ops.integrator("DisplacementControl", node, 3, way - before)
        if ops.analyze(1):
            break
        before = way
        factors.append(ops.getLoadFactor(1))
        moved.append([[ops.nodeDisp(k, c) for c in (1, 2, 3)] for k in range(len(model["points"]))])
    return factors, moved


def main() -> None:
    """Run and compare; with --theirs do OpenSees' part, of what is on standard input."""
    if sys.argv[1] == "--theirs":
        given = json.load(sys.stdin)
        json.dump(theirs(given["model"], given["ways"]), sys.stdout)
        return
    model = read_model(Path(sys.argv[1]))
    points = int(sys.argv[2]) if len(sys.argv) > 2 else 200
    python = sys.argv[3] if len(sys.argv) > 3 else sys.executable
    factors, positions, events = ours(model, points)
    node = model["load"][0]
    moved = positions - positions[0]
    ways = moved[1:, node, 2].tolist()
    text = json.dumps({"model": model, "ways": ways})
    done = subprocess.run([python, __file__, "--theirs"], input=text, stdout=subprocess.PIPE, text=True, check=True)
    other, other_moved = json.loads(done.stdout.strip().splitlines()[-1])
    n = len(other)
    print(f"{len(factors) - 1} points, OpenSees followed {n}; displacement {min(ways):.4g} to {max(ways):.4g} m")
    print(f"load factors {factors.min():.6g} to {factors.max():.6g}")
    print("\n".join(events))
    apart = np.abs(factors[1 : n + 1] - other) / np.abs(factors).max()
    way = np.abs(moved[1 : n + 1] - other_moved).max(axis=(1, 2)) / np.abs(moved).max()
    print(f"load factors differ by {apart.max():.2g} of the largest, displacements by {way.max():.2g} of the largest")
    for k in np.flatnonzero((apart > 1e-4) | (way > 1e-4))[:10]:
        print(
            f"point {k + 1}: load factor {factors[k + 1]:.8g} and {other[k]:.8g}, displacements differ by {way[k]:.2g}"
        )


if __name__ == "__main__":
    main()
