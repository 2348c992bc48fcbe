#!/usr/bin/env python
"""Damages a result file many times, by a bit, a byte or a page, and tests readers and restarts with it.

    python scripts/damage_test.py [NUMBER] [SEED]

Damage may be refused (status 2) or have no effect: the continued results are then those of the undamaged file. The
status is 1 if damage affected continued results silently, or if a reader crashed or had an internal error.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import h5py

ROOT = Path(__file__).resolve().parents[1]
CASE = ["rod_impact", "--quiet", "--set", "time.end=0.6", "output.fields_every=2", "output.checkpoint_every=40"]


def damaged(source: Path, target: Path, chance: random.Random) -> str:
    """Write a damaged copy of a file, and return a description of the damage."""
    content = bytearray(source.read_bytes())
    kind, at = chance.choice(["bit", "byte", "page"]), chance.randrange(len(content))
    if kind == "bit":
        content[at] ^= 1 << chance.randrange(8)
    elif kind == "byte":
        content[at] = (content[at] + chance.randrange(1, 256)) % 256
    else:
        at -= at % 4096
        size = len(content[at : at + 4096])
        content[at : at + 4096] = bytes(size) if chance.random() < 0.5 else chance.randbytes(size)
    target.write_bytes(content)
    return f"{kind} at {at}"


def different(one: Path, other: Path) -> bool:
    """Return whether two results differ in any dataset."""
    with h5py.File(one, "r", locking=False) as a, h5py.File(other, "r", locking=False) as b:
        names: list[list[str]] = [[], []]
        for file, found in zip((a, b), names, strict=True):
            file.visititems(
                lambda name, item, found=found: found.append(name) if isinstance(item, h5py.Dataset) else None
            )
        return names[0] != names[1] or any(a[name][()].tobytes() != b[name][()].tobytes() for name in names[0])


def program(*words: str | Path) -> subprocess.CompletedProcess:
    """Run the program on one rank."""
    return subprocess.run([sys.executable, "-m", "pfem_petsc", *map(str, words)], capture_output=True, text=True)


def main() -> int:
    """Damage files, read and restart them, and count the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("number", nargs="?", type=int, default=200, help="of damages; default: %(default)s")
    parser.add_argument("seed", nargs="?", type=int, default=1)
    arguments = parser.parse_args()
    chance, counts, bad = random.Random(arguments.seed), Counter(), []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        first, whole, tried = folder / "first", folder / "whole", folder / "tried"
        assert program(*CASE, "-o", first).returncode == 0
        shutil.copytree(first, whole)
        longer = [*CASE, "time.end=0.8"]
        assert program(*longer, "-o", whole, "--restart").returncode == 0
        for _ in range(arguments.number):
            shutil.rmtree(tried, ignore_errors=True)
            shutil.copytree(first, tried)
            what = damaged(first / "result.vtkhdf", tried / "result.vtkhdf", chance)
            info = program("info", tried, "--verify")
            done = program(*longer, "-o", tried, "--restart")
            for process in (info, done):
                if process.returncode not in (0, 2) or "internal error" in process.stderr:
                    bad.append(f"{what}: status {process.returncode}: {process.stderr.strip()[:300]}")
            if done.returncode == 0 and different(tried / "result.vtkhdf", whole / "result.vtkhdf"):
                bad.append(f"{what}: went into continued results in silence")
            outcome = "refused" if done.returncode else "does not matter"
            counts[f"{what.split()[0]}: {outcome}, info --verify status {info.returncode}"] += 1
            print(f"{what}: {outcome}, info --verify status {info.returncode}", flush=True)
    for outcome, number in sorted(counts.items()):
        print(f"{number:5}  {outcome}")
    print("\n".join(bad) or "none went into results in silence, none crashed")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
