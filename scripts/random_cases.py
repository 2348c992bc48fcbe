"""Runs random valid cases and checks properties that the results of any case must have.

    .venv/bin/python scripts/random_cases.py --seeds 0:1000 --jobs 2 --keep failing
    .venv/bin/python scripts/random_cases.py --staged --seeds 0:300 --jobs 2 --keep failing
    .venv/bin/python scripts/random_cases.py --touching --seeds 0:300 --restart-every 2 --keep failing
    .venv/bin/python scripts/random_cases.py --cases failing/*.toml

Cases are drawn over all documented keys and their combinations, one per seed; with `--staged` they have two to four
stages, forms before and load cases after them, with `--touching` surfaces of triangles, walls that turn, pairs that rub
and rebound, and bars that touch. Each is run on one rank and on three, in
one process for many cases; every third one is also stopped in the middle and continued. Checks: status 0, 2 or 3, with
a message unless it is 0; no node beyond a wall; finite results; energy balance and growth; dissipations; momentum;
tables of members; a load case or combination as stages by hand; agreement between numbers of ranks to 1e-9; bitwise
identical continued runs; with `--schemes-every` also convergence of
an explicit and an implicit scheme to the same motion; with `--copies-every` that copies of a case which are moved by 1
and 1000 km, turned, renumbered, and in other units give the same results. Cases that crash or hang are reported and
skipped. Status 0 if there are no faults.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TextIO

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "random_cases")]

CHUNK = 40
"""Number of cases per process, which limits side effects between cases."""
LOOSE = ("energy balance above 1e-9", "chaotic: ")
"""Causes that are counted but are not failures."""


def main() -> int:
    """Run the requested cases, and report faults by cause."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seeds", default="0:200", metavar="A:B", help="from A to before B, or A,B,C (default: %(default)s)"
    )
    parser.add_argument("--cases", type=Path, nargs="+", default=[], metavar="FILE", help="case files instead")
    parser.add_argument("--ranks", type=int, default=3, metavar="N", help="beside one (default: 3; 1: none)")
    parser.add_argument("--restart-every", type=int, default=3, metavar="N", help="continue every N-th; 0: none")
    parser.add_argument("--schemes-every", type=int, default=0, metavar="N", help="both kinds of schemes; 0: none")
    parser.add_argument("--copies-every", type=int, default=0, metavar="N", help="moved, turned ... ones; 0: none")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--staged", action="store_const", dest="kind", const="staged", default="single",
        help="cases of two to four stages, statics and motion",
    )  # fmt: skip
    kinds.add_argument(
        "--touching", action="store_const", dest="kind", const="touching",
        help="cases with surfaces of triangles, walls that turn, rough pairs and bars that touch",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes at a time (default: 1)")
    parser.add_argument("--patience", type=float, default=60.0, metavar="S", help="longest time of a case [s]")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where the cases with a fault are put, as TOML files")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        from random_trusses.comparisons import work

        seeds = json.loads(arguments.seeds)
        sources = {number: str(path) for number, path in enumerate(arguments.cases)}
        work(arguments.worker, seeds, arguments.folder, arguments.restart_every, sources, arguments.kind)
        return 0
    if arguments.kind == "touching" and arguments.copies_every:
        parser.error("--copies-every: surfaces of triangles are in files, which are not copied")
    if arguments.cases:
        seeds = list(range(len(arguments.cases)))
    elif "," in arguments.seeds:
        seeds = [int(seed) for seed in arguments.seeds.split(",")]
    else:
        first, _, end = arguments.seeds.partition(":")
        seeds = list(range(int(first), int(end or int(first) + 1)))
    begin = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="random-cases-"))
    study = Study(arguments, folder)
    chunks = [seeds[at : at + CHUNK] for at in range(0, len(seeds), CHUNK)]
    try:
        with ThreadPoolExecutor(arguments.jobs) as pool:
            list(pool.map(study.chunk, chunks))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return study.report(time.monotonic() - begin)


class Study:
    """Results so far.

    Attributes
    ----------
    faults : cause to (seed, detail)
    statuses : how many ended how
    refusals : message without numbers to seeds
    """

    def __init__(self, arguments: argparse.Namespace, folder: Path) -> None:
        self.arguments, self.folder = arguments, folder
        self.faults: dict[str, list[tuple[int, str]]] = defaultdict(list)
        self.statuses: Counter[str] = Counter()
        self.refusals: dict[str, list[int]] = defaultdict(list)
        self._lock = threading.Lock()

    def chunk(self, seeds: list[int]) -> None:
        """Run some cases on one rank and on several, compare, and remove their results."""
        alone = self._work("check", seeds, 1)
        ended = [seed for seed in seeds if alone.get(seed, {}).get("status") == 0]
        for seed, told in alone.items():
            self._note(seed, told)
        if self.arguments.ranks > 1:
            clear = [seed for seed in seeds if alone.get(seed, {}).get("status") in (0, 2, 3)]
            several = self._work("run", clear, self.arguments.ranks)
            for seed, told in several.items():
                if told["status"] != alone[seed]["status"]:
                    detail = f"{alone[seed]['status']} on 1, {told['status']} on several: {told['message'][:200]}"
                    self._fault(seed, "status differs between ranks", detail)
                mine = {cause for cause, _ in alone[seed]["faults"]}
                for cause, detail in told["faults"]:
                    if cause not in mine:
                        self._fault(seed, f"on {self.arguments.ranks} ranks: {cause}", detail)
            both = [seed for seed in ended if several.get(seed, {}).get("status") == 0]
            for seed, told in self._work("judge", both, 1).items():
                for cause, detail in told["faults"]:
                    self._fault(seed, cause, detail)
        for mode, every in (("copies", self.arguments.copies_every), ("schemes", self.arguments.schemes_every)):
            chosen = [seed for seed in ended if every > 0 and seed % every == 0]
            for seed, told in (self._work(mode, chosen, 1) if chosen else {}).items():
                with self._lock:
                    self.statuses[f"{mode}: {told.get('verdict', 'compared')}"] += 1
                for cause, detail in told["faults"]:
                    self._fault(seed, cause, detail)
        for seed in seeds:
            shutil.rmtree(self.folder / str(seed), ignore_errors=True)
        with self._lock:
            bad = {seed for cause, found in self.faults.items() if not cause.startswith(LOOSE) for seed, _ in found}
            cases = sum(count for what, count in self.statuses.items() if what.startswith("status"))
            print(f"{cases} cases, {len(bad)} with a fault", flush=True)

    def _note(self, seed: int, told: dict) -> None:
        with self._lock:
            self.statuses[f"status {told['status']}"] += 1
            self.statuses["with contact"] += bool(told.get("touched"))
            self.statuses["stopped and continued"] += bool(told.get("parts"))
            if told["status"] in (2, 3):
                text = told["message"].replace(f"random-{seed}.toml", "CASE")
                self.refusals[" ".join(re.findall(r"(?<!\S)[^\s\d]+(?!\S)", text))[:110]].append(seed)
        for cause, detail in told["faults"]:
            self._fault(seed, cause, detail)

    def _fault(self, seed: int, cause: str, detail: str) -> None:
        with self._lock:
            self.faults[cause].append((seed, detail))
            if not cause.startswith(LOOSE):
                print(f"{self._name(seed)}: {cause}: {detail[:300]}", flush=True)
        if self.arguments.keep is not None and not self.arguments.cases and not cause.startswith(LOOSE):
            from random_trusses.comparisons import DRAWN
            from random_trusses.running import case_text

            table = DRAWN[self.arguments.kind](seed)
            self.arguments.keep.mkdir(parents=True, exist_ok=True)
            (self.arguments.keep / f"random-{seed}.toml").write_text(case_text(table))

    def _name(self, seed: int) -> str:
        return self.arguments.cases[seed].name if self.arguments.cases else str(seed)

    def _work(self, mode: str, seeds: Sequence[int], ranks: int) -> dict[int, dict]:
        """Return the worker's report of each case, starting new processes after cases that end one."""
        told: dict[int, dict] = {}
        left = list(seeds)
        while left:
            at, ending = self._process(mode, left, ranks, told)
            if at is None and not ending:
                break
            if at is None and not set(left) & set(told):
                raise SystemExit(f"the workers do not start: {ending}")
            # where it ended between two cases, the one before
            culprit = at if at is not None else max(set(left) & set(told), key=left.index)
            if mode in ("judge", "schemes", "copies"):
                told[culprit] = {"faults": [("comparison ends", ending)]}
            else:
                cause = "hangs" if ending.startswith("no answer") else "process ends"
                if mode == "check":
                    told[culprit] = {"status": 1, "message": ending, "faults": [(cause, ending)]}
                else:
                    self._fault(culprit, f"on {ranks} ranks: {cause}", ending)
            left = left[left.index(culprit) + 1 :]
        return told

    def _process(self, mode: str, seeds: list[int], ranks: int, told: dict[int, dict]) -> tuple[int | None, str]:
        """Run one worker process; if it ends early, return the case in progress and how it ended."""
        line = [sys.executable, __file__, "--worker", mode, "--seeds", json.dumps(seeds)]
        line += ["--folder", str(self.folder), "--restart-every", str(self.arguments.restart_every)]
        line += [] if self.arguments.kind == "single" else [f"--{self.arguments.kind}"]
        if self.arguments.cases:
            line += ["--cases", *map(str, self.arguments.cases)]
        if ranks > 1:
            line = ["mpirun", "--oversubscribe", "-n", str(ranks), *line]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        with tempfile.TemporaryFile("w+") as errors:
            process = subprocess.Popen(
                line, stdout=subprocess.PIPE, stderr=errors, text=True, errors="replace", env=environment,
                start_new_session=True,
            )  # fmt: skip
            lines: queue.Queue[str | None] = queue.Queue()
            threading.Thread(target=_pump, args=(process.stdout, lines), daemon=True).start()
            current, alone = None, ""
            # compiling loops may take long at the first case
            patience = 5.0 * self.arguments.patience
            while True:
                try:
                    text = lines.get(timeout=patience)
                except queue.Empty:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
                    return current, f"no answer in {patience:.0f} s"
                if text is None:
                    break
                what, _, rest = text.partition(" ")
                if what == "begin":
                    current = int(rest.split()[0])
                elif what == "done":
                    seed, _, record = rest.partition(" ")
                    told[int(seed)], current = json.loads(record), None
                    patience = self.arguments.patience
                elif what == "alone":
                    alone = f"only rank {rest.strip()}; "
            status = process.wait()
            if status == 0 and current is None:
                return None, ""
            errors.seek(0)
            return current, f"{alone}status {status}: {' | '.join(errors.read()[-400:].split(chr(10)))}"

    def report(self, seconds: float) -> int:
        """Print the table by cause; return the exit status."""
        print("\n".join(f"{count:6}  {what}" for what, count in sorted(self.statuses.items())))
        print("\nrefused or failed with a message:")
        for text, seeds in sorted(self.refusals.items(), key=lambda entry: -len(entry[1])):
            print(f"{len(seeds):6}  {text} ({', '.join(map(self._name, seeds[:4]))})")
        print("\ncause, cases, seeds:")
        bad = 0
        for cause, found in sorted(self.faults.items(), key=lambda entry: -len(entry[1])):
            bad += 0 if cause.startswith(LOOSE) else len(found)
            print(f"{len(found):6}  {cause}: {', '.join(self._name(seed) for seed, _ in found)}")
        print(f"{seconds:.0f} s, {bad} faults")
        return 1 if bad else 0


def _pump(stream: TextIO, lines: queue.Queue[str | None]) -> None:
    for text in stream:
        lines.put(text)
    lines.put(None)


if __name__ == "__main__":
    sys.exit(main())
