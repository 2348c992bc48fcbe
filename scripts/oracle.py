"""Keeps everything that runs compute, and compares what two states of the program have computed.

    .venv/bin/python scripts/oracle.py hash before --jobs 2        # all built-in cases, 200 random ones, 1 to 3 ranks
    .venv/bin/python scripts/oracle.py hash after --like before    # the same cases, after a change
    .venv/bin/python scripts/oracle.py compare before after --within 1e-10

Each case runs twice on each number of ranks: as a whole, and stopped in the middle and continued. Hashed are all
datasets of both result files (mesh, snapshots, history, checksums), all arrays and numbers of the checkpoints of the
middle and of the end, the exit status and its message. Cases that end with status 2 or 3 count like others.

With `--within`, `compare` accepts values that differ by less than a fraction of the scale of their quantity: the
largest value of all datasets of the same file with the same unit. Checkpoints, checksums and numbers of iterations are
then left out, and integers must be equal. Of long datasets, values at even spaces are kept. Status 0 if nothing
differs. PYTHONPATH selects another checkout of the package.
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

SAMPLES = 4000
"""Values kept of each array, at even spaces."""
CHUNK = 20
"""Cases per process."""
NOT_RESULTS = {"case/text"}
"""Datasets that describe the run: file names and versions."""
NOT_COMPARED = ("checkpoint", "iterations", ":checks/")
"""Parts of names of datasets that `--within` leaves out."""


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
    check.add_argument("--within", type=float, default=0.0, metavar="FRACTION", help="of scales (default: bits)")
    check.add_argument("--all", action="store_true", help="list all arrays, not the first ones of each case")
    worker = verbs.add_parser("worker")
    worker.add_argument("folder", type=Path)
    worker.add_argument("names", nargs="+")
    arguments = parser.parse_args()
    if arguments.verb == "compare":
        return compare(*arguments.folders, arguments.within, arguments.all)
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
            whole, samples = hashed(place / "whole")
            parts, _ = hashed(place / "parts")
            apart = [key for key in whole if key in parts and not _checkpoint(key) and whole[key] != parts[key]]
            entry = {"status": outcome.status, "message": message, "continued_apart": apart, "whole": whole}
            entry["parts"] = {key: value for key, value in parts.items() if _checkpoint(key)}
            np.savez_compressed(folder / f"{name} on {comm.size}.npz", **samples)
            print(json.dumps({f"{name} on {comm.size}": entry}), flush=True)
        clear(comm, place)


def _checkpoint(key: str) -> bool:
    return key.startswith("checkpoint")


def hashed(folder: Path) -> tuple[dict[str, list], dict[str, np.ndarray]]:
    """Return the hash, largest value, unit and shape of all datasets in the files of a folder, and samples of them."""
    import h5py

    found: dict[str, list] = {}
    samples: dict[str, np.ndarray] = {}
    for path in sorted((*folder.glob("*.vtkhdf"), *folder.glob("*.h5"))):
        with h5py.File(path, "r", locking=False) as file:
            names: list[str] = []
            file.visititems(lambda name, item, names=names: names.append(name) if hasattr(item, "dtype") else None)
            for name in sorted(set(names) - NOT_RESULTS):
                key, array = f"{path.name}:{name}", np.asarray(file[name][()])
                array = array.astype(array.dtype.str)  # without the metadata of enumerations
                unit = file[name].attrs.get("unit", b"")
                found[key] = [_digest(array), 0.0, unit.decode() if isinstance(unit, bytes) else str(unit), array.shape]
                if array.dtype.kind in "fiub" and array.size:
                    flat = array.reshape(-1)
                    found[key][1] = float(np.abs(flat.astype(np.float64)).max())
                    samples[key] = flat[np.unique(np.linspace(0, len(flat) - 1, SAMPLES).astype(int))]
    return found, samples


def _digest(array: np.ndarray) -> str:
    digest = hashlib.sha256(f"{array.dtype} {array.shape}".encode())
    if array.dtype.kind in "fiub":
        digest.update(np.ascontiguousarray(array).tobytes())
    else:
        digest.update(repr(array.tolist()).encode())
    return digest.hexdigest()[:16]


def compare(one: Path, other: Path, within: float, every: bool) -> int:
    """List cases and arrays that differ, and by how much."""
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
        samples = [np.load(folder / f"{name}.npz") for folder in (one, other)]
        for part in ("whole", "parts"):
            mine, its = a[name][part], b[name][part]
            for key in sorted(mine.keys() | its.keys()):
                if within and any(text in key for text in NOT_COMPARED):
                    continue
                if key not in mine or key not in its:
                    lines.append(f"  {part} {key}: only {'before' if key in mine else 'after'}")
                elif mine[key][0] != its[key][0]:
                    found = _apart(key, (mine, its), samples, within)
                    lines += [f"  {part} {key}: {found}"] if found else []
        if lines:
            differing += 1
            print(f"{name}: {len(lines)} differences")
            print("\n".join(lines if every else lines[:4]))
    print(f"{differing} of {len(a.keys() | b.keys())} runs differ")
    return 1 if differing else 0


def _apart(key: str, entries: tuple[dict, dict], samples: list[Any], within: float) -> str:
    """How two datasets of different hashes differ; empty if it is by less than the fraction of their scale."""
    mine, its = (of[key] for of in entries)
    if mine[3] != its[3]:
        return f"shape {mine[3]} before, {its[3]} after"
    if key not in samples[0] or key not in samples[1]:
        return "" if _checkpoint(key) and within else "differs"
    one, two = (of[key].astype(np.float64) for of in samples)
    unit = mine[2]
    alike = [key] if unit in ("", "1") else [name for name in entries[0] if entries[0][name][2] == unit]
    scale = max(of[name][1] for of in entries for name in alike if name in of)
    with np.errstate(invalid="ignore"):
        difference = np.abs(one - two)
    if not scale > 0.0 or not np.array_equal(np.isnan(one), np.isnan(two)):
        return "differs"
    fraction = np.nanmax(difference, initial=0.0) / scale
    exact = samples[0][key].dtype.kind in "iub"
    return "" if fraction <= within and not exact else f"{fraction:.1e} of {scale:.3g} {unit}".rstrip()


if __name__ == "__main__":
    sys.exit(main())
