"""Compares rules of globalisation of Newton's method on random cases; prints rows for the table of docs/statics.md.

    .venv/bin/python scripts/newton_rules.py --kind static --seeds 0:300 --rules "bt" "full, then cp"
    .venv/bin/python scripts/newton_rules.py --kind implicit --seeds 0:80

A rule is one of PETSc's line searches for all solves, or "full, then RULE": full steps as the program makes them;
solves that fail are repeated with a line search. Counted are failed solves, bisected increments or steps, Newton
iterations (those of failed solves included), and runs that fail. The static cases are trusses of random nodes whose
stiffnesses differ by up to 10^8, under loads that rotate bars by up to 30 degrees, some above a wall; the implicit ones
are those of random_cases.py with an implicit scheme.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import random
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from pfem_petsc import Truss

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT.parent / "tests" / "random_cases"))

RULES = ("bt", "l2", "cp", "basic", "full, then bt", "full, then l2", "full, then cp")
LEVELS = 6  # different stiffnesses of a truss
FINER = 20.0  # of increments of the reference
SAME = 0.05  # of the largest displacement, by which ends may differ from the reference
COUNTS = ("failed solves", "bisections", "Newton iterations", "failed runs", "other ends")


def static_case(seed: int) -> tuple[dict[str, Any], Truss]:
    """Return the tables and the truss of random nodes, each connected to three or more earlier ones."""
    chance = random.Random(f"static {seed}")
    n = chance.randint(6, 22)
    points = np.array([[chance.random() for _ in range(3)] for _ in range(n)])
    bars = []
    for i in range(3, n):
        near = np.argsort(np.linalg.norm(points[:i] - points[i], axis=1))
        bars += [[int(j), i] for j in near[: 3 + (chance.random() < 0.4)]]
    ratio = 10.0 ** chance.uniform(0.0, 8.0) if seed % 3 else 1.0
    kinds = [chance.randrange(LEVELS) for _ in bars]
    moduli = [1e9 * ratio ** (-kind / (LEVELS - 1)) for kind in kinds]
    law: dict[str, Any] = {"strain": chance.choice(("engineering", "engineering", "green", "logarithmic"))}
    if chance.random() < 0.2:
        law |= {"yield_stress": 1e6, "isotropic_hardening": 1e7}
    force = np.array([[chance.gauss(0.0, 1.0) for _ in range(3)] for _ in range(n)])
    force[:3] = 0.0
    force *= 10.0 ** chance.uniform(-3.0, -0.3) / _rotation(points, bars, moduli, force)
    used = sorted(set(kinds))
    tables: dict[str, Any] = {
        "node_set": {"base": {"indices": [0, 1, 2]}, **{f"n{k}": {"indices": [k]} for k in range(3, n)}},
        "material": {
            f"m{k}": {"young_modulus": 1e9 * ratio ** (-k / (LEVELS - 1)), "density": 1e3, **law} for k in used
        },
        "section": {f"s{k}": {"bars": f"g{k}", "area": 1e-4, "material": f"m{k}"} for k in used},
        "support": [{"node_set": "base", "fix": "xyz"}],
        "load": [{"node_set": f"n{k}", "force": force[k].tolist()} for k in range(3, n)],
        "static": {"step": chance.choice((0.25, 0.5, 1.0))},
        "output": {"fields_every": 0},
    }
    if chance.random() < 0.25:
        low = [0.5, 0.5, float(points[:, 2].min()) - 1e-3]
        tables["wall"] = [{"name": "floor", "type": "plane", "point": low, "normal": [0.0, 0.0, 1.0]}]
    return tables, Truss(points, np.array(bars), bar_groups={f"g{k}": np.flatnonzero(np.equal(kinds, k)) for k in used})


def _rotation(points: np.ndarray, bars: list[list[int]], moduli: list[float], force: np.ndarray) -> float:
    """Return the largest difference of displacements over the length of a bar of the linear solution."""
    n = len(points)
    matrix = np.zeros((n, 3, n, 3))
    for (i, j), modulus in zip(bars, moduli, strict=True):
        way = points[j] - points[i]
        block = modulus * 1e-4 / np.linalg.norm(way) ** 3 * np.outer(way, way)
        for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            matrix[a, :, b] += sign * block
    u = np.zeros((n, 3))
    u[3:] = np.linalg.solve(matrix[3:, :, 3:].reshape(3 * n - 9, -1), force[3:].ravel()).reshape(-1, 3)
    i, j = np.array(bars).T
    return float((np.linalg.norm(u[j] - u[i], axis=1) / np.linalg.norm(points[j] - points[i], axis=1)).max())


def implicit_seeds(first: int, last: int) -> list[int]:
    """Return the seeds of the random implicit cases from number ``first`` to before ``last``."""
    from random_trusses.draw import IMPLICIT, draw_case

    found, seed = [], 0
    while len(found) < last:
        found += [seed] * (draw_case(seed)["time"]["integrator"] in IMPLICIT)
        seed += 1
    return found[first:]


def run(kind: str, seed: int, finer: float = 1.0) -> np.ndarray | None:
    """Return the last positions of a case, None if it fails; ``finer`` divides static increments.

    Raises
    ------
    InputError
        If the case is refused.
    """
    from mpi4py import MPI
    from random_trusses.draw import draw_case

    from pfem_petsc import Case, Simulation
    from pfem_petsc.errors import SimulationFailure

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        if kind == "static":
            tables, truss = static_case(seed)
            tables["static"]["step"] /= finer
            case = Case(tables, mesh=truss)
        else:
            case = Case.from_dict(draw_case(seed))
        try:
            with Simulation(case, MPI.COMM_WORLD, output=Path(folder) / "out", quiet=True) as simulation:
                simulation.run()
                mesh, ends = simulation.model.mesh, np.empty_like(simulation.state.position)
                ends[mesh.node_ids[: mesh.n_owned]] = simulation.state.position
                return ends
        except SimulationFailure:
            return None


def count(kind: str, seeds: list[int], rule: str, folder: Path) -> dict[int, dict[str, int]]:
    """Run cases with a rule; return the counts of each. Reference positions are kept in ``folder``."""
    from petsc4py import PETSc

    from pfem_petsc.errors import InputError
    from pfem_petsc.stepping.implicit import HalvedSteps

    newton = importlib.import_module("pfem_petsc.solvers.newton")
    totals: Counter[str] = Counter()
    solve = newton.NewtonSolver.solve

    def counted(self: Any, *arguments: Any) -> Any:
        report = solve(self, *arguments)
        totals["Newton iterations"] += report.newton
        totals["failed solves"] += not report.converged
        return report

    told_failure = HalvedSteps.tell_failure

    def halved(self: Any, *arguments: Any) -> None:
        totals["bisections"] += 1
        told_failure(self, *arguments)

    newton.NewtonSolver.solve, HalvedSteps.tell_failure = counted, halved
    options, told = PETSc.Options(), {}
    names = [f"{prefix}snes_linesearch_type" for prefix in ("pfem_", "pfem_contact_")]
    for seed in seeds:
        file, reference = folder / f"{seed}.npy", None
        try:
            if kind == "static" and not file.exists():
                np.save(file, ends if (ends := run(kind, seed, FINER)) is not None else np.empty(0))
            totals.clear()
            if rule.startswith("full, then "):
                newton._CAREFUL = rule.removeprefix("full, then ")
            else:
                for name in names:
                    options[name] = rule
            end = run(kind, seed)
        except InputError:
            continue
        finally:
            for name in names:
                options.delValue(name)
        totals["failed runs"] += end is None
        if kind == "static" and end is not None:
            reference = np.load(file)
            moved = np.abs(reference - static_case(seed)[1].points).max() if reference.size else 0.0
            totals["other ends"] += not reference.size or bool(np.abs(end - reference).max() > SAME * moved)
        told[seed] = dict(totals)
    return told


def main() -> None:
    """Run the rules, each in a process of its own, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=("implicit", "static"), required=True)
    parser.add_argument("--seeds", default="0:300", metavar="A:B", help="from A to before B (default: %(default)s)")
    parser.add_argument("--rules", nargs="+", default=list(RULES), metavar="RULE")
    arguments = parser.parse_args()
    first, last = map(int, arguments.seeds.split(":"))
    seeds = list(range(first, last)) if arguments.kind == "static" else implicit_seeds(first, last)
    # a process for each rule, which changes the solver; none is forked from one in which MPI runs
    processes = ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1)
    with tempfile.TemporaryDirectory() as folder, processes as pool:
        for rule in arguments.rules:
            counted = pool.submit(count, arguments.kind, seeds, rule, Path(folder)).result()
            sums = [sum(case.get(name, 0) for case in counted.values()) for name in COUNTS]
            row = f"| {rule} | " + " | ".join(f"{value:,}" for value in sums) + " |"
            print(row, f"{len(counted)} cases", flush=True)


if __name__ == "__main__":
    main()
