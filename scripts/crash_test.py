"""Kills runs at random times, restarts them, and compares with uninterrupted runs.

    .venv/bin/python scripts/crash_test.py --kills 200 --ranks 1,2
    .venv/bin/python scripts/crash_test.py --kills 200 --python .venv-petsc/bin/python
    .venv/bin/python scripts/crash_test.py --kills 1000 --cases 0:400

Explicit, implicit, plastic and multistep cases, with and without contact, are run in turn on all numbers of ranks, so
that each gets the same number of kills. With --cases A:B they are the cases that scripts/random_cases.py draws by these
numbers, except those that are refused or fail without a kill. A run is killed by SIGKILL, all ranks or one of them,
possibly before its first checkpoint, and restarted, and often killed again, until it is done. After each kill the
result file must open in VTK and in open_result; at the end all its values must be bitwise identical to those of the
uninterrupted run. Status 0 if all tests pass.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from helpers.kills import KINDS, LEFT_OVER, Kind, VtkReader, assert_readable, differences, killed, run  # noqa: E402

EVERY = (7, 40, 1000)  # steps between checkpoints: many, some, none before the end
MOST = 4  # kills of a run before it may run to its end
COUNTED = ("kills", "before 1st checkpoint", "runs", "launcher left", "unreadable", "different", "failed")


def main() -> int:
    """Kill the requested number of runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, metavar="N", help="how many (default: %(default)s)")
    parser.add_argument("--ranks", type=_numbers, default=[1, 2], metavar="N,N", help="in turn (default: 1,2)")
    parser.add_argument("--python", default=sys.executable, metavar="PATH", help="of the runs; default: this one")
    parser.add_argument("--seed", type=int, default=None, help="of the random moments")
    parser.add_argument("--folder", type=Path, default=None, help="where to work; default: a temporary folder")
    parser.add_argument("--cases", default=None, metavar="A:B", help="random cases with these numbers")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="crash-test-"))
    folder.mkdir(parents=True, exist_ok=True)
    seed = random.SystemRandom().randrange(10**6) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    chance = random.Random(seed)
    begin = time.monotonic()
    kinds = KINDS if arguments.cases is None else _random_kinds(arguments.cases, folder)
    # a random case runs on one number of ranks, chosen in turn
    several = [(name, ranks) for ranks in arguments.ranks for name in kinds]
    single = list(zip(kinds, arguments.ranks * len(kinds)))
    counts = {turn: Counter() for turn in (several if arguments.cases is None else single)}
    references: dict[tuple[str, int], tuple[Path, float]] = {}
    with VtkReader() as vtk:
        while (left := arguments.kills - sum(count["kills"] for count in counts.values())) > 0:
            # next is the case with the fewest kills, of random cases the one with the fewest runs
            name, ranks = min(counts, key=lambda turn: counts[turn]["kills" if arguments.cases is None else "runs"])
            if (name, ranks) not in references:
                reference = _reference(name, kinds[name], ranks, folder, arguments.python, arguments.cases is None)
                if reference is None:
                    del counts[name, ranks]
                    continue
                references[name, ranks] = reference
            kind, reference = kinds[name], references[name, ranks]
            one = _one_run(name, kind, ranks, reference, folder, min(left, MOST), chance, vtk, arguments.python)
            counts[name, ranks].update(one)
            if not one["kills"]:  # finished before a kill: the reference run took longer, as when it compiled loops
                references[name, ranks] = reference[0], 0.5 * reference[1]
            if one["failed"]:
                kept = folder / f"failed-{sum(count['failed'] for count in counts.values())}"
                shutil.copytree(folder / "killed", kept, dirs_exist_ok=True)
            total = sum(count["kills"] for count in counts.values())
            print(f"{total} kills: {name} on {ranks}: {one['kills']} in this run", flush=True)
    bad = _table(counts, time.monotonic() - begin)
    if arguments.folder is None and not bad:
        shutil.rmtree(folder)
    return 1 if bad else 0


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def _random_kinds(numbers: str, folder: Path) -> dict[str, Kind]:
    """Write the cases that the generator draws by these numbers to files."""
    from random_trusses.draw import draw_case
    from random_trusses.running import case_text

    first, _, end = numbers.partition(":")
    kinds = {}
    for seed in range(int(first), int(end)):
        path = folder / f"random-{seed}.toml"
        path.write_text(case_text(draw_case(seed)))
        kinds[f"random {seed}"] = Kind(str(path), ())
    return kinds


def _one_run(
    name: str,
    kind: Kind,
    ranks: int,
    reference: tuple[Path, float],
    folder: Path,
    most: int,
    chance: random.Random,
    vtk: VtkReader,
    python: str,
) -> Counter:
    """Kill a run up to ``MOST`` times, let it run to its end, and compare; return the counts."""
    count = Counter(runs=1)
    every, work = chance.choice(EVERY), folder / "killed"
    for old in folder.glob("killed*"):
        # a run that is killed between its end and the release of its folder leaves the lock
        old.unlink() if old.is_file() else shutil.rmtree(old)
    told, restart = [], []
    while count["kills"] < most:
        how = killed(kind, ranks, work, every, reference[1], chance, *restart, python=python)
        restart = ["--restart"]
        told.append(how)
        if how == "done before":
            break
        count["kills"] += 1
        count["launcher left"] += LEFT_OVER in how
        count["before 1st checkpoint"] += not (work / "checkpoint.h5").exists()
        for path in folder.glob("killed*/result.vtkhdf"):
            try:
                assert_readable(path, vtk)
            except Exception as error:  # noqa: BLE001 - every way to be unreadable counts
                count["unreadable"] += 1
                print(f"UNREADABLE {name} on {ranks}: {path}: {type(error).__name__}: {error}", flush=True)
    done = run(kind, ranks, work, every, "--restart", python=python)
    if done.returncode != 0:
        count["failed"] += 1
        print(f"FAILED {name} on {ranks} (every {every}): {told}\n{done.stderr}", flush=True)
    elif apart := differences(reference[0], work / "result.vtkhdf"):
        count["different"] += 1
        print(f"DIFFERENT {name} on {ranks} (every {every}): {told}: {apart}", flush=True)
    return count


def _reference(
    name: str, kind: Kind, ranks: int, folder: Path, python: str, must_run: bool
) -> tuple[Path, float] | None:
    """Run without kills; return the result file and the time of its steps [s], None for a case that does not run."""
    place = folder / f"{name.replace(' ', '-').replace(',', '')}-{ranks}"
    shutil.rmtree(place, ignore_errors=True)
    if must_run:
        run(kind, ranks, place, 0, python=python)  # compiles the loops
        shutil.rmtree(place, ignore_errors=True)
    begin = time.time()
    done = run(kind, ranks, place, 0, python=python)
    if done.returncode in (2, 3) and not must_run:
        return None
    if done.returncode != 0:
        raise SystemExit(f"{name} on {ranks} ranks fails undisturbed:\n{done.stderr}")
    # the log is opened just before the first step, after the model is set up
    opened = (place / "log.txt").read_text().splitlines()[0]
    first = time.mktime(time.strptime(opened[:19], "%Y-%m-%d %H:%M:%S"))
    seconds = max(0.3, time.time() - max(first, begin) - 0.3)
    print(f"{name} on {ranks}: {seconds:.1f} s of steps", flush=True)
    return place / "result.vtkhdf", seconds


def _table(counts: dict[tuple[str, int], Counter], seconds: float) -> int:
    """Print the counts; return the number of failures."""
    width = max(len(name) for name, _ in counts)
    print(f"\n{'case':{width}}  ranks  {'  '.join(COUNTED)}")
    total = Counter()
    for (name, ranks), count in counts.items():
        total.update(count)
        if not name.startswith("random ") or count["unreadable"] + count["different"] + count["failed"]:
            print(f"{name:{width}}  {ranks:5}  {'  '.join(f'{count[what]:{len(what)}}' for what in COUNTED)}")
    print(f"{'all':{width}}         {'  '.join(f'{total[what]:{len(what)}}' for what in COUNTED)}")
    print(f"{seconds:.0f} s; restarts that failed, results that differ or cannot be read: ", end="")
    bad = total["unreadable"] + total["different"] + total["failed"]
    print(bad)
    return bad


if __name__ == "__main__":
    sys.exit(main())
