"""Hashes everything that runs compute, and compares the hashes of two states of the program.

    .venv/bin/python scripts/oracle.py hash before --jobs 2        # all built-in cases, 200 random ones, 1 to 3 ranks
    .venv/bin/python scripts/oracle.py hash after --like before    # the same cases, after a change
    .venv/bin/python scripts/oracle.py compare before after

Each case runs twice on each number of ranks: as a whole, and stopped in the middle and continued. Hashed are all
datasets of both result files (mesh, snapshots, history, checksums), all arrays and numbers of the checkpoints of the
middle and of the end, the exit status and its message. Cases that end with status 2 or 3 count like others. For arrays
that differ, `compare` gives the largest difference of some sampled values, relative to the largest value. Status 0 if
all hashes are equal. PYTHONPATH selects another checkout of the package.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "random_cases")]

SAMPLES = 12
"""Values kept of each array, evenly spaced, from which the size of a difference is estimated."""
CHUNK = 20
"""Cases per process."""
NOT_RESULTS = {"case/text"}
"""Datasets that describe the run: file names and versions."""


def main() -> int:
    """Hash or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    make = verbs.add_parser("hash")
    make.add_argument("folder", type=Path)
    make.add_argument("--seeds", default="0:200", metavar="A:B", help="random cases (default: %(default)s)")
    make.add_argument("--like", type=Path, metavar="DIR", help="the cases of a former run")
    make.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 3])
    make.add_argument("--jobs", type=int, default=1, help="processes at a time (default: 1)")
    check = verbs.add_parser("compare")
    check.add_argument("folders", type=Path, nargs=2)
    check.add_argument("--all", action="store_true", help="list all arrays, not the first ones of each case")
    worker = verbs.add_parser("worker")
    worker.add_argument("folder", type=Path)
    worker.add_argument("names", nargs="+")
    arguments = parser.parse_args()
    if arguments.verb == "compare":
        return compare(*arguments.folders, arguments.all)
    if arguments.verb == "worker":
        work(arguments.folder, arguments.names)
        return 0
    return hash_cases(arguments)


def hash_cases(arguments: argparse.Namespace) -> int:
    """Write the cases, run them on all numbers of ranks, and collect their hashes in ``hashes.json``."""
    cases = arguments.folder / "cases"
    cases.mkdir(parents=True, exist_ok=True)
    if arguments.like:
        shutil.copytree(arguments.like / "cases", cases, dirs_exist_ok=True)
    else:
        _write_cases(cases, arguments.seeds)
    names = sorted(path.stem for path in cases.glob("*.toml"))
    chunks = [names[at :: -(-len(names) // CHUNK)] for at in range(-(-len(names) // CHUNK))]
    jobs = [(ranks, chunk) for ranks in arguments.ranks for chunk in chunks]
    hashes: dict[str, Any] = {}
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for found in pool.map(lambda job: _process(arguments.folder, *job), jobs):
            for line in found:
                hashes |= json.loads(line)
            # after each process: a run that is ended keeps what it has
            (arguments.folder / "hashes.json").write_text(json.dumps(hashes, indent=0, sort_keys=True))
    statuses = defaultdict(int)
    for entry in hashes.values():
        statuses[entry["status"]] += 1
    print(f"{len(hashes)} runs of {len(names)} cases; status: {dict(statuses)}")
    missing = len(names) * len(arguments.ranks) - len(hashes)
    if missing:
        print(f"{missing} runs are missing")
    apart = [name for name, entry in hashes.items() if entry["continued_apart"]]
    if apart:
        print(f"continued runs that differ from whole ones: {', '.join(apart)}")
    return 1 if missing or apart else 0


def _write_cases(folder: Path, seeds: str) -> None:
    from random_trusses.draw import draw_case
    from random_trusses.running import case_text

    import pfem_petsc

    for path in (Path(pfem_petsc.__file__).parent / "cases").iterdir():
        if path.suffix == ".toml":
            shutil.copy(path, folder / f"builtin-{path.name}")
        elif path.suffix not in (".py", ""):
            shutil.copy(path, folder)
    first, _, end = seeds.partition(":")
    for seed in range(int(first), int(end)):
        (folder / f"random-{seed:05d}.toml").write_text(case_text(draw_case(seed)))


def _process(folder: Path, ranks: int, names: list[str]) -> list[str]:
    line = [sys.executable, __file__, "worker", str(folder), *names]
    if ranks > 1:
        line = ["mpirun", "--oversubscribe", "-n", str(ranks), *line]
    told = subprocess.run(line, stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    if told.returncode != 0:
        print(f"worker on {ranks} ranks ended with status {told.returncode}: {' '.join(names)}", flush=True)
    return [text for text in told.stdout.splitlines() if text.startswith("{")]


def work(folder: Path, names: list[str]) -> None:
    """Run cases one after the other and print the hashes of each as a line of JSON. Collective."""
    from mpi4py import MPI
    from random_trusses.running import clear, run_case, run_in_two_parts, steps_of

    comm, folder = MPI.COMM_WORLD, folder.resolve()
    os.chdir(folder / "cases")  # files that cases name lie there
    for name in names:
        text = (folder / "cases" / f"{name}.toml").read_text()
        place = folder / f"{name}-on-{comm.size}"
        source = str(folder / "cases" / f"{name}.toml")
        clear(comm, place / "whole", place / "parts")
        outcome = run_case(text, comm, place / "whole", source=source)
        steps = comm.bcast(steps_of(place / "whole") if outcome.status == 0 and comm.rank == 0 else 0)
        if steps > 2:
            run_in_two_parts(text, comm, place / "parts", steps // 2, source)
        if comm.rank == 0:
            # a message may hold the folder of its file
            message = outcome.message.replace(str(folder), "")
            whole, parts = hashed(place / "whole"), hashed(place / "parts")
            apart = [key for key in whole if key in parts and not _checkpoint(key) and whole[key] != parts[key]]
            entry = {"status": outcome.status, "message": message, "continued_apart": apart, "whole": whole}
            entry["parts"] = {key: value for key, value in parts.items() if _checkpoint(key)}
            print(json.dumps({f"{name} on {comm.size}": entry}), flush=True)
        clear(comm, place)


def _checkpoint(key: str) -> bool:
    return key.startswith("checkpoint")


def hashed(folder: Path) -> dict[str, list]:
    """Return the hash, the largest value and samples of all datasets in the files of a folder."""
    import h5py

    found: dict[str, list] = {}
    for path in sorted((*folder.glob("*.vtkhdf"), *folder.glob("*.h5"))):
        with h5py.File(path, "r", locking=False) as file:
            names: list[str] = []
            file.visititems(lambda name, item, names=names: names.append(name) if hasattr(item, "dtype") else None)
            for name in sorted(set(names) - NOT_RESULTS):
                found[f"{path.name}:{name}"] = _entry(file[name][()])
    return found


def _entry(values: Any) -> list:
    array = np.asarray(values)
    digest = hashlib.sha256(f"{array.dtype} {array.shape}".encode())
    if array.dtype.kind not in "fiub":
        digest.update(repr(array.tolist()).encode())
        return [digest.hexdigest()[:16], 0.0, []]
    digest.update(np.ascontiguousarray(array).tobytes())
    flat = array.reshape(-1).astype(np.float64)
    if not len(flat):
        return [digest.hexdigest()[:16], 0.0, []]
    sample = flat[np.unique(np.linspace(0, len(flat) - 1, SAMPLES).astype(int))]
    return [digest.hexdigest()[:16], float(np.abs(flat).max()), sample.tolist()]


def compare(one: Path, other: Path, every: bool) -> int:
    """List cases and arrays whose hashes differ, and by how much."""
    a, b = (json.loads((folder / "hashes.json").read_text()) for folder in (one, other))
    differing = 0
    for name in sorted(a.keys() | b.keys()):
        if name not in a or name not in b:
            print(f"{name}: only in {one if name in a else other}")
            differing += 1
            continue
        lines = []
        if (a[name]["status"], a[name]["message"]) != (b[name]["status"], b[name]["message"]):
            lines += [f"  status {entry['status']}: {entry['message'][:200]}" for entry in (a[name], b[name])]
        for part in ("whole", "parts"):
            mine, its = a[name][part], b[name][part]
            for key in sorted(mine.keys() | its.keys()):
                if key not in mine or key not in its:
                    lines.append(f"  {part} {key}: only {'before' if key in mine else 'after'}")
                elif mine[key][0] != its[key][0]:
                    lines.append(f"  {part} {key}: {_apart(mine[key], its[key])}")
        if lines:
            differing += 1
            print(f"{name}: {len(lines)} differences")
            print("\n".join(lines if every else lines[:4]))
    print(f"{differing} of {len(a.keys() | b.keys())} runs differ")
    return 1 if differing else 0


def _apart(mine: list, its: list) -> str:
    largest = max(mine[1], its[1])
    if len(mine[2]) != len(its[2]) or not largest > 0.0:
        return "another length or type"
    return f"about {np.abs(np.subtract(mine[2], its[2])).max() / largest:.1e} of {largest:.3g}"


if __name__ == "__main__":
    sys.exit(main())
