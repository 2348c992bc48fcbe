"""Kill runs at random moments, restart them, and compare with runs that nobody disturbed.

    .venv/bin/python scripts/crash_test.py --kills 200

Explicit, implicit, plastic, multistep cases with contact, on 1 and 2 ranks in turn. A run is killed by SIGKILL, all
ranks or one of them, and restarted, and often killed again, until it is done. After each kill the result file must
open in VTK and in open_result; at the end all its values must equal those of the undisturbed run bit for bit. Status 0
when all did.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "restart"))

from kills import KINDS, VtkReader, assert_readable, differences, killed, run  # noqa: E402

EVERY = (7, 40, 1000)  # steps between checkpoints: many, some, none before the end


def main() -> int:
    """Kill as often as asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, metavar="N", help="how many (default: %(default)s)")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2], metavar="N", help="in turn (default: 1 2)")
    parser.add_argument("--seed", type=int, default=None, help="of the random moments")
    parser.add_argument("--folder", type=Path, default=None, help="where to work; default: a temporary folder")
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="crash-test-"))
    folder.mkdir(parents=True, exist_ok=True)
    chance = random.Random(arguments.seed)
    references: dict[tuple[str, int], tuple[Path, float]] = {}
    kills = unreadable = different = failed = finished = 0
    before_first = 0
    with VtkReader() as vtk:
        while kills < arguments.kills:
            name = list(KINDS)[finished % len(KINDS)]
            ranks = arguments.ranks[(finished // len(KINDS)) % len(arguments.ranks)]
            if (name, ranks) not in references:
                references[name, ranks] = _reference(name, ranks, folder)
            reference, seconds = references[name, ranks]
            every, work = chance.choice(EVERY), folder / "killed"
            for old in folder.glob("killed*"):
                shutil.rmtree(old)
            told = []
            restart: list[str] = []
            while True:
                how = killed(KINDS[name], ranks, work, every, seconds, chance, *restart)
                restart = ["--restart"]
                told.append(how)
                if how == "done before":
                    break
                kills += 1
                before_first += not (work / "checkpoint.h5").exists()
                for path in folder.glob("killed*/result.vtkhdf"):
                    try:
                        assert_readable(path, vtk)
                    except Exception as error:  # noqa: BLE001 - every way to be unreadable counts
                        unreadable += 1
                        print(f"UNREADABLE {name} on {ranks}: {path}: {type(error).__name__}: {error}", flush=True)
                if len(told) >= 4:
                    break
            done = run(KINDS[name], ranks, work, every, "--restart")
            if done.returncode != 0:
                failed += 1
                print(f"FAILED {name} on {ranks} (every {every}): {told}\n{done.stderr}", flush=True)
                shutil.copytree(work, folder / f"failed-{failed}", dirs_exist_ok=True)
            else:
                apart = differences(reference, work / "result.vtkhdf")
                if apart:
                    different += 1
                    print(f"DIFFERENT {name} on {ranks} (every {every}): {told}: {apart}", flush=True)
            finished += 1
            print(
                f"{kills} kills, {finished} runs: {name} on {ranks}, every {every}: {len(told) - 1} kills", flush=True
            )
    print(
        f"{kills} kills ({before_first} before the first checkpoint) of {finished} runs: {unreadable} unreadable "
        f"files, {different} runs with other results, {failed} restarts that failed"
    )
    if arguments.folder is None:
        shutil.rmtree(folder)
    return 1 if unreadable or different or failed else 0


def _reference(name: str, ranks: int, folder: Path) -> tuple[Path, float]:
    """The undisturbed run: its result file, and how long its steps take [s]."""
    place = folder / f"{name.replace(' ', '-').replace(',', '')}-{ranks}"
    shutil.rmtree(place, ignore_errors=True)
    run(KINDS[name], ranks, place, 0)  # compiles what is to be compiled
    shutil.rmtree(place)
    begin = time.time()
    done = run(KINDS[name], ranks, place, 0)
    if done.returncode != 0:
        raise SystemExit(f"{name} on {ranks} ranks fails undisturbed:\n{done.stderr}")
    # the log is opened just before the first step, after the model is set up
    opened = next(line for line in (place / "log.txt").read_text().splitlines())
    first = time.mktime(time.strptime(opened[:19], "%Y-%m-%d %H:%M:%S"))
    seconds = max(0.3, time.time() - max(first, begin) - 0.3)
    print(f"{name} on {ranks}: {seconds:.1f} s of steps", flush=True)
    return place / "result.vtkhdf", seconds


if __name__ == "__main__":
    sys.exit(main())
