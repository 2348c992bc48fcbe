"""Start several runs into one folder at once, round after round: three starts, then two restarts.

    .venv/bin/python scripts/together.py --rounds 20
    .venv/bin/python scripts/together.py --rounds 20 --ranks 2

Of each round one run must work, the others must be refused with status 2 and say why, and what is in the folders must
be whole and equal to the results of a run that nobody disturbed, bit for bit. Status 0 when all rounds were so.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "restart"))

from kills import environment  # noqa: E402
from together import LATER, line, play  # noqa: E402


def main() -> int:
    """Play as often as asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, metavar="N", help="how many (default: %(default)s)")
    parser.add_argument("--ranks", type=int, default=1, metavar="N", help="of each run (default: %(default)s)")
    arguments = parser.parse_args()
    starts, restarts, failed = Counter(), Counter(), 0
    with tempfile.TemporaryDirectory(prefix="together-") as name:
        alone = Path(name, "alone")
        subprocess.run(line(alone, LATER, ranks=arguments.ranks), env=environment(), check=True)
        for number in range(arguments.rounds):
            try:
                found = play(Path(name, f"round{number}"), alone / "result.vtkhdf", arguments.ranks)
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
