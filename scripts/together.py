"""Starts several runs into one folder at once, in repeated rounds of three starts and two restarts.

    .venv/bin/python scripts/together.py --rounds 20

In each round one run must succeed, the others must be refused with status 2 and a message, and the results must be
complete and bitwise identical to those of a single run. Status 0 if all rounds pass.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from helpers.together import LATER, play, words  # noqa: E402

from pfem_petsc.cli.main import main as program  # noqa: E402


def main() -> int:
    """Run the requested number of rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, metavar="N", help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=None, help="of the moments of the starts")
    parser.add_argument("--folder", type=Path, default=None, help="where to work; default: a temporary folder")
    arguments = parser.parse_args()
    seed = random.SystemRandom().randrange(10**6) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    chance = random.Random(seed)
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="together-"))
    starts, restarts, failed = Counter(), Counter(), 0
    program(words(folder / "alone", LATER))
    for number in range(arguments.rounds):
        try:
            found = play(folder / f"round{number}", folder / "alone" / "result.vtkhdf", chance)
        except AssertionError as error:
            failed += 1
            print(f"round {number}: {error}", flush=True)
            continue
        starts.update(found[0])
        restarts.update(found[1])
        print(f"round {number}: starts {dict(found[0])}, restarts {dict(found[1])}", flush=True)
    print(f"{arguments.rounds} rounds: starts {dict(starts)}, restarts {dict(restarts)}, failed {failed}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
