"""Checks case and mesh files with random mistakes: each must be accepted, or refused with a message.

    .venv/bin/python scripts/fuzz.py --mutants 10000

Failures are a traceback, a status other than 0 and 2, a message without the file (or, for a case, without key or line),
no answer within a minute, and a process that dies. Cases are the built-in ones, meshes are of every format. Every
mutant has a seed: ``--seed 1234 --mutants 1 --keep DIR`` reproduces it. Status 0 if there are no failures.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

BATCH = 250
MEMORY = 6 << 30  # bytes that a check may use; files that request more must be refused


def main() -> int:
    """Try the requested number of mutants in separate processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=10_000, metavar="N", help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the first; the others follow")
    parser.add_argument("--keep", type=Path, default=None, metavar="DIR", help="where the last mutant stays")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    folder = arguments.keep or Path(tempfile.mkdtemp(prefix="fuzz-"))
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.worker:
        return _work(arguments.seed, arguments.mutants, folder)
    bad = 0
    kinds: Counter[str] = Counter()
    at, end = arguments.seed, arguments.seed + arguments.mutants
    while at < end:
        count = min(BATCH, end - at)
        line = [sys.executable, __file__, "--worker", "--seed", str(at), "--mutants", str(count), "--keep", str(folder)]
        done = subprocess.run(line, capture_output=True, text=True, errors="replace")
        tried = 0
        for text in done.stdout.splitlines():
            if text.startswith("tried "):
                tried += 1
                kinds[text.split(" ", 2)[2]] += 1
            elif text.startswith("BAD "):
                bad += 1
                print(text, flush=True)
        if tried < count:
            bad += 1
            print(
                f"BAD {at + tried}: the process ended with status {done.returncode}: {done.stderr[-500:]}", flush=True
            )
            tried += 1
        at += tried
        print(f"{at - arguments.seed} mutants, {bad} bad", flush=True)
    if arguments.keep is None:
        shutil.rmtree(folder)
    for kind, count in sorted(kinds.items()):
        print(f"{count:6}  {kind}")
    print(f"{arguments.mutants} mutants from seed {arguments.seed}: {bad} bad")
    return 1 if bad else 0


def _work(seed: int, count: int, folder: Path) -> int:
    from helpers.mutations import small_cases, sound_meshes, try_one

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    texts, meshes = small_cases(), sound_meshes(folder / "sound")
    for mutant in range(seed, seed + count):
        kind, told = try_one(mutant, folder, texts, meshes)
        if kind == "bad":
            print(f"BAD {mutant}: {' | '.join(told.split(chr(10)))[:600]}", flush=True)
        what = "case" if mutant % 3 < 2 else "mesh"
        print(f"tried {mutant} {what}: {kind}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
