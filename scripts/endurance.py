"""Runs that are killed, and files with mistakes, many times.

    .venv/bin/python scripts/endurance.py kills 200 --ranks 1,2
    .venv/bin/python scripts/endurance.py mutants 10000

kills     Explicit, implicit, plastic and multistep cases, with and without contact, run in turn on all numbers of
          ranks. A run is killed by SIGKILL, all ranks or one of them, possibly before its first checkpoint, and
          restarted, and often killed again, until it is done. After each kill the result file must open in VTK and in
          open_result; at the end all its values must be bitwise those of the uninterrupted run.
mutants   Case and mesh files with random mistakes are accepted, or refused with a message. Failures are a traceback, a
          status other than 0 and 2, a message without the file (or, for a case, without key or line), no answer
          within a minute, and a process that dies. --seed 1234 with one mutant and --folder DIR reproduces one.

Status 0 if there are no failures.
"""

from __future__ import annotations

import argparse
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path.insert(0, str(TESTS))

from helpers.kills import (  # noqa: E402
    KINDS,
    LEFT_OVER,
    VtkReader,
    assert_readable,
    differences,
    killed,
    run,
)

EVERY = (7, 40, 1000)  # steps between checkpoints: many, some, none before the end
MOST = 4  # kills of a run before it may run to its end
COUNTED = ("kills", "before 1st checkpoint", "runs", "launcher left", "unreadable", "different", "failed")
BATCH = 250  # mutants of a process
MEMORY = 6 << 30  # bytes that a check may use; files that request more must be refused


def main() -> int:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("test", choices=("kills", "mutants"))
    parser.add_argument("number", type=int, help="of kills or mutants")
    parser.add_argument("--seed", type=int, help="of what is random; default: another one each time, 0 for mutants")
    parser.add_argument("--folder", type=Path, help="where to work; default: a temporary one, removed if all is well")
    parser.add_argument("--ranks", default="1,2", metavar="N,N", help="of kills, in turn (default: 1,2)")
    parser.add_argument("--python", default=sys.executable, metavar="PATH", help="of killed runs; default: this one")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="endurance-"))
    folder.mkdir(parents=True, exist_ok=True)
    seed = arguments.seed
    if seed is None:
        seed = 0 if arguments.test == "mutants" else random.SystemRandom().randrange(10**6)
    if arguments.worker:
        return try_mutants(seed, arguments.number, folder)
    print(f"seed {seed}", flush=True)
    if arguments.test == "kills":
        bad = Kills(arguments, folder, random.Random(seed)).all(arguments.number)
    else:
        bad = mutants(seed, arguments.number, folder)
    if arguments.folder is None and not bad:
        shutil.rmtree(folder)
    return 1 if bad else 0


class Kills:
    """Runs that are killed, each case and number of ranks as often as the others."""

    def __init__(self, arguments: argparse.Namespace, folder: Path, chance: random.Random) -> None:
        self.folder, self.chance, self.python = folder, chance, arguments.python
        self.turns = [(name, int(ranks)) for ranks in arguments.ranks.split(",") for name in KINDS]
        self.references: dict[tuple[str, int], tuple[Path, float]] = {}

    def all(self, number: int) -> int:
        """Kill so many runs, print the counts and return the number of failures."""
        begin, total = time.monotonic(), Counter()
        counts = {turn: Counter() for turn in self.turns}
        with VtkReader() as vtk:
            while total["kills"] < number:
                turn = min(counts, key=lambda each: counts[each]["kills"])
                if turn not in self.references:
                    self._reference(*turn)
                one = self._one_run(*turn, min(number - total["kills"], MOST), vtk)
                counts[turn].update(one)
                total.update(one)
                if not one["kills"]:  # finished before a kill: the reference run took longer, as when it compiled
                    whole, seconds = self.references[turn]
                    self.references[turn] = whole, 0.5 * seconds
                if one["failed"]:
                    shutil.copytree(self.folder / "killed", self.folder / f"failed-{total['failed']}")
                print(f"{total['kills']} kills: {turn[0]} on {turn[1]}: {one['kills']} in this run", flush=True)
        width = max(len(name) for name, _ in counts)
        print(f"\n{'case':{width}}  ranks  {'  '.join(COUNTED)}")
        for (name, ranks), count in [*counts.items(), (("all", ""), total)]:
            print(f"{name:{width}}  {ranks:5}  {'  '.join(f'{count[what]:{len(what)}}' for what in COUNTED)}")
        bad = total["unreadable"] + total["different"] + total["failed"]
        took = f"{time.monotonic() - begin:.0f} s"
        print(f"{took}; restarts that failed, results that differ or cannot be read: {bad}")
        return bad

    def _one_run(self, name: str, ranks: int, most: int, vtk: VtkReader) -> Counter:
        """Kill a run up to ``most`` times, let it run to its end, and compare; return the counts."""
        whole, seconds = self.references[name, ranks]
        kind, count, work = KINDS[name], Counter(runs=1), self.folder / "killed"
        every = self.chance.choice(EVERY)
        for old in self.folder.glob("killed*"):
            # a run that is killed between its end and the release of its folder leaves the lock
            old.unlink() if old.is_file() else shutil.rmtree(old)
        told, restart = [], []
        while count["kills"] < most:
            told.append(killed(kind, ranks, work, every, seconds, self.chance, *restart, python=self.python))
            restart = ["--restart"]
            if told[-1] == "done before":
                break
            count.update({"kills": 1, "launcher left": LEFT_OVER in told[-1]})
            count["before 1st checkpoint"] += not (work / "checkpoint.h5").exists()
            for path in self.folder.glob("killed*/result.vtkhdf"):
                try:
                    assert_readable(path, vtk)
                except Exception as error:  # noqa: BLE001 - every way to be unreadable counts
                    count["unreadable"] += 1
                    print(f"UNREADABLE {name} on {ranks}: {path}: {type(error).__name__}: {error}", flush=True)
        done = run(kind, ranks, work, every, "--restart", python=self.python)
        if done.returncode != 0:
            count["failed"] += 1
            print(f"FAILED {name} on {ranks} (every {every}): {told}\n{done.stderr}", flush=True)
        elif apart := differences(whole, work / "result.vtkhdf"):
            count["different"] += 1
            print(f"DIFFERENT {name} on {ranks} (every {every}): {told}: {apart}", flush=True)
        return count

    def _reference(self, name: str, ranks: int) -> None:
        """Run without kills, and keep the result file and the time of its steps [s]."""
        place = self.folder / f"{name.replace(' ', '-').replace(',', '')}-{ranks}"
        for _ in range(2):  # the first run compiles the loops
            shutil.rmtree(place, ignore_errors=True)
            begin = time.time()
            done = run(KINDS[name], ranks, place, 0, python=self.python)
        if done.returncode != 0:
            raise SystemExit(f"{name} on {ranks} ranks fails undisturbed:\n{done.stderr}")
        # the log is opened just before the first step, after the model is set up
        opened = (place / "log.txt").read_text().splitlines()[0]
        first = time.mktime(time.strptime(opened[:19], "%Y-%m-%d %H:%M:%S"))
        seconds = max(0.3, time.time() - max(first, begin) - 0.3)
        print(f"{name} on {ranks}: {seconds:.1f} s of steps", flush=True)
        self.references[name, ranks] = place / "result.vtkhdf", seconds


def mutants(seed: int, number: int, folder: Path) -> int:
    """Try mutants in separate processes, count what became of them, and return the number of failures."""
    bad, at, kinds = 0, seed, Counter()
    while at < seed + number:
        count = min(BATCH, seed + number - at)
        line = [sys.executable, __file__, "mutants", str(count), "--seed", str(at), "--folder", str(folder), "--worker"]
        done = subprocess.run(line, capture_output=True, text=True, errors="replace")
        tried = [text.split(" ", 2)[2] for text in done.stdout.splitlines() if text.startswith("tried ")]
        told = [text for text in done.stdout.splitlines() if text.startswith("BAD ")]
        at += len(tried)
        if len(tried) < count:
            told.append(f"BAD {at}: the process ended with status {done.returncode}: {done.stderr[-500:]}")
            at += 1
        kinds.update(tried)
        bad += len(told)
        print("\n".join([*told, f"{at - seed} mutants, {bad} bad"]), flush=True)
    for kind, count in sorted(kinds.items()):
        print(f"{count:6}  {kind}")
    print(f"{number} mutants from seed {seed}: {bad} bad")
    return bad


def try_mutants(seed: int, count: int, folder: Path) -> int:
    """Try mutants in this process, which one of them may end."""
    from helpers.files import small_cases, sound_meshes, try_one

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    texts, meshes = small_cases(), sound_meshes(folder / "sound")
    for mutant in range(seed, seed + count):
        kind, told = try_one(mutant, folder, texts, meshes)
        if kind == "bad":
            print(f"BAD {mutant}: {' | '.join(told.split(chr(10)))[:600]}", flush=True)
        print(f"tried {mutant} {'case' if mutant % 3 < 2 else 'mesh'}: {kind}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
