"""Worker of random cases: runs, checks, stops and continues each case; one line of JSON per case on stdout."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from helpers.kills import differences
from mpi4py import MPI

from pfem_petsc import open_result

from .checks import check_result, distance
from .copies import judge_copies
from .running import case_text, clear, run_case, run_in_two_parts, steps_of
from .schemes import judge_schemes

CHAOS = 100.0
"""Allowed difference between ranks, relative to the effect of a change of the positions by 1e-13."""
AGREE = 1e-9
LOOSE = 1e-6
"""The same for implicit runs whose solver stops at its default tolerance of 1e-9."""


def check_case(text: str, comm: MPI.Comm, folder: Path, source: str, restart: bool) -> dict:
    """Run a case, check its results and, if requested, that stopping and continuing changes nothing. Collective.

    The result is kept in ``folder``/whole.
    """
    outcome = run_case(text, comm, folder / "whole", source=source)
    told = asdict(outcome) | {"touched": False, "parts": False}
    if outcome.status == 0 and comm.rank == 0:
        told["faults"] += check_result(folder / "whole", outcome.warnings)
        told["touched"] = _touched(folder / "whole")
    steps = comm.bcast(steps_of(folder / "whole") if outcome.status == 0 and comm.rank == 0 else 0)
    if restart and outcome.status == 0 and steps > 4:
        files = (folder / "whole" / "result.vtkhdf", folder / "parts" / "result.vtkhdf")
        second = run_in_two_parts(text, comm, folder / "parts", steps // 2, source)
        told["faults"] += [(f"in two parts: {cause}", detail) for cause, detail in second.faults]
        told["parts"] = second.stopped > 0
        if second.status != 0 and not second.faults:
            told["faults"].append(("continued run fails", f"stopped at {second.stopped}: {second.message[:300]}"))
        elif second.status == 0 and comm.rank == 0 and (apart := differences(*files)):
            first = ", ".join(f"{name} by {size:.3g}" for name, size in list(apart.items())[:3])
            cause = "continued run differs" if second.stopped > 0 else "a second run differs"
            told["faults"].append((cause, f"stopped at step {second.stopped}: {len(apart)} datasets: {first}"))
    clear(comm, folder / "parts")
    return told


def judge_ranks(text: str, table: dict, one: Path, other: Path, folder: Path, source: str) -> list[tuple[str, str]]:
    """Check that results of one rank and of several agree; a run is chaotic if a change of the positions by 1e-13 of
    the size has the same effect."""
    apart, where = distance(one, other)
    explicit = "solver" not in table and table["time"].get("mass") != "consistent"
    tight = explicit or table.get("solver", {}).get("rtol", 1.0) < 1e-10
    if apart <= (AGREE if tight else LOOSE):
        return []
    moved = amplification(text, one, folder, source)
    if apart <= CHAOS * moved:
        return [("chaotic: ranks part as runs do that start 1e-13 apart", f"{apart:.3g} ({where}), {moved:.3g}")]
    return [("ranks differ", f"{apart:.3g} in {where}; a change of the start by 1e-13 makes {moved:.3g}")]


def amplification(text: str, whole: Path, folder: Path, source: str) -> float:
    """Return the largest distance of three runs with changed positions from the run itself, on one rank."""
    worst = 0.0
    for number in (1, 2, 3):
        outcome = run_case(text, MPI.COMM_SELF, folder / f"jiggle{number}", source=source, jiggle=number)
        if outcome.status != 0:
            worst = np.inf
        else:
            worst = max(worst, distance(whole, folder / f"jiggle{number}")[0])
        clear(MPI.COMM_SELF, folder / f"jiggle{number}")
    return worst


def work(mode: str, seeds: Iterable[int], folder: Path, every_restart: int, sources: dict[int, str]) -> None:
    """Process the cases of a worker. Collective.

    ``mode``: "check" runs and checks, "run" only runs, "judge" compares the results of both and removes them, "schemes"
    compares explicit and implicit schemes, "copies" the copies of a case.
    """
    comm = MPI.COMM_WORLD
    from .draw import draw_case

    for seed in seeds:
        _tell(comm, "begin", seed, {})
        source = sources.get(seed, f"random-{seed}.toml")
        if seed in sources:
            text, table = Path(source).read_text(), {}
        else:
            table = draw_case(seed)
            text = case_text(table)
        place = folder / str(seed)
        if mode == "check":
            restart = every_restart > 0 and seed % every_restart == 0
            told = check_case(text, comm, place / "1", source, restart)
        elif mode == "schemes":
            verdict, faults = judge_schemes(table or _table(text), seed, place, source)
            told = {"verdict": verdict, "faults": faults}
        elif mode == "copies":
            table = table or _table(text)
            whole = place / "1/whole"
            amplified = functools.partial(amplification, text, whole, place, source)
            told = {"faults": judge_copies(table, seed, whole, place, amplified)}
        elif mode == "run":
            told = check_case(text, comm, place / "n", source, False)
        else:
            table = table or _table(text)
            told = {"faults": judge_ranks(text, table, place / "1/whole", place / "n/whole", place, source)}
        clear(comm)
        _tell(comm, "done", seed, told)


def _table(text: str) -> dict:
    from pfem_petsc.case.toml import parse_toml

    return parse_toml(text, "case")


def _tell(comm: MPI.Comm, what: str, seed: int, told: dict) -> None:
    if comm.rank == 0:
        print(f"{what} {seed} {json.dumps(told, default=str)}", flush=True)


def _touched(folder: Path) -> bool:
    history = open_result(folder).history
    return bool(np.asarray(history["active_contacts"]).any())
