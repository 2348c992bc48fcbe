"""Strong and weak scaling of this program on this machine: tables, plots, and a model of larger machines.

usage: python scripts/scaling.py [--ranks 1 2 4] [--strong 1000000] [--weak 500000] [--jobs explicit matrix_free]

Every point is a run of "bench" under mpirun, stored in results/scaling; an interrupted study continues where it
stopped, and --again repeats all runs. Files written: scaling.csv, scaling.md, strong.png, weak.png, model.md,
model.png. On a cluster use --launcher "srun -n {ranks}"; docs/scaling.md has a job script and describes the model.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from scaling_study.model import parts_from, plot_model, step_time, table
from scaling_study.plots import plot_study
from scaling_study.points import Point, points_of, read_point, run_point
from scaling_study.tables import markdown, rows_of, write_csv

if TYPE_CHECKING:
    import numpy as np

ROOT = Path(__file__).resolve().parent.parent
MODEL_SIZES = [1e6, 1e7, 1e8, 1e9, 1e10]


def main() -> int:
    """Run missing points, then make tables, plots and model from all points."""
    cores = os.cpu_count() or 1
    powers = [2**k for k in range(12) if 2**k <= cores]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--studies", nargs="+", choices=["strong", "weak"], default=["strong", "weak"])
    parser.add_argument("--ranks", type=int, nargs="+", default=powers, help="default: powers of two up to the cores")
    parser.add_argument("--strong", type=int, nargs="+", default=[100_000, 1_000_000], help="bars")
    parser.add_argument("--weak", type=int, nargs="+", default=[500_000], help="bars a rank")
    parser.add_argument("--kinds", nargs="+", choices=["cubic", "octet", "bcc"], default=["cubic"], help="of lattice")
    parser.add_argument("--jobs", nargs="+", default=["explicit", "matrix_free"], help="as bench calls them")
    parser.add_argument("--explicit", default="central_differences", help="explicit integrator")
    parser.add_argument("--implicit", default="newmark", help="implicit integrator")
    parser.add_argument("--seconds", type=float, default=2.0, help="to time each point for, about")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds after which a point is given up")
    parser.add_argument("--launcher", default="mpirun --oversubscribe -n {ranks}", help="starts a run")
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "scaling", help="folder")
    parser.add_argument("--again", action="store_true", help="run points that are there already anew")
    parser.add_argument("--latency", type=float, help="of the network, for the model [s]; default: as measured")
    parser.add_argument("--network", type=float, help="bandwidth of a rank's messages, for the model [B/s]")
    parser.add_argument("--machine-ranks", type=int, default=1, help="that share a memory, for the model")
    parser.add_argument("--machine-bandwidth", type=float, help="of that memory [B/s]; default: what its ranks need")
    parser.add_argument("--imbalance", type=float, default=1.0, help="slowest rank over the mean, for the model")
    parser.add_argument("--fields-every", type=int, default=0, help="steps between snapshots, for the model")
    parser.add_argument("--disk", type=float, default=1e9, help="bandwidth of the file system, for the model [B/s]")
    arguments = parser.parse_args()
    folder: Path = arguments.results
    folder.mkdir(parents=True, exist_ok=True)
    points = points_of(
        arguments.studies,
        arguments.kinds,
        arguments.jobs,
        {"strong": arguments.strong, "weak": arguments.weak},
        sorted(set(arguments.ranks)),
        lambda job: arguments.explicit if job.startswith("explicit") else arguments.implicit,
    )
    if arguments.again:
        for point in points:
            (folder / point.file).unlink(missing_ok=True)
    failed = 0
    for number, point in enumerate(points, start=1):
        outcome = run_point(point, folder, arguments.launcher, arguments.seconds, arguments.limit)
        failed += outcome.startswith("failed")
        what = f"{point.study}, {point.kind}, {point.job}, {point.bars:,} bars, {point.ranks} ranks"
        print(f"{number}/{len(points)} {what}: {outcome}", flush=True)
    rows = rows_of(points, folder)
    if not rows:
        print("no point has run: nothing to show", file=sys.stderr)
        return 1
    write_csv(rows, folder / "scaling.csv")
    text = markdown(rows)
    (folder / "scaling.md").write_text(text, encoding="utf-8")
    print("\n" + text)
    for study in arguments.studies:
        plot_study(rows, study, folder / f"{study}.png")
    _model(points, folder, arguments)
    print(f"in {folder}: " + ", ".join(sorted(p.name for p in folder.iterdir() if p.suffix in (".csv", ".md", ".png"))))
    return 1 if failed else 0


def _model(points: list[Point], folder: Path, arguments: argparse.Namespace) -> None:
    """The model from the explicit point with most ranks, then most bars, that has run."""
    known = [p for p in points if p.job == "explicit" and (folder / p.file).exists()]
    if not known:
        return
    point = max(known, key=lambda p: (p.ranks, p.bars))
    parts = parts_from(
        read_point(point, folder),
        arguments.latency,
        arguments.network,
        machine_ranks=arguments.machine_ranks,
        machine_bandwidth=arguments.machine_bandwidth or float("inf"),
        imbalance=arguments.imbalance,
        fields_every=arguments.fields_every,
        disk=arguments.disk,
    )
    text = (
        f"From {point.bars:,} bars on {point.ranks} ranks: {1e9 * parts.bar:.2f} ns a bar and rank, "
        f"{1e6 * parts.overhead:.0f} us outside the loops, latency {1e6 * parts.latency:.2f} us, "
        f"{parts.bandwidth / 1e9:.1f} GB/s a rank, sums {1e6 * parts.reduction:.1f} us.\n\n"
    )
    text += (
        f"{parts.machine_ranks} ranks that share a memory need {parts.needed / 1e9:.0f} GB/s of it to run as fast as "
        f"measured; the model gives them {parts.machine_bandwidth / 1e9:.0f} GB/s. The slowest rank has "
        f"{parts.imbalance:.2f} times the mean work. "
    )
    text += (
        f"Snapshots every {parts.fields_every} steps, {parts.snapshot:.0f} B a bar at {parts.disk / 1e9:.1f} GB/s.\n\n"
        if parts.fields_every
        else "No snapshots.\n\n"
    )
    text += table(parts, MODEL_SIZES)
    rows = rows_of([p for p in known if p.kind == point.kind], folder)
    for row in {(row["bars"], row["ranks"]): row for row in rows}.values():
        told = step_time(parts, row["bars"], _array(row["ranks"]))["step"][0]
        text += f"\n{row['bars']:,} bars on {row['ranks']} ranks: model {1e3 * told:.4g} ms, "
        text += f"measured {1e3 * row['step_s']:.4g} ms"
    (folder / "model.md").write_text(text + "\n", encoding="utf-8")
    plot_model(parts, MODEL_SIZES, folder / "model.png")


def _array(ranks: int) -> np.ndarray:  # NumPy is imported by the model alone
    import numpy as np

    return np.array([ranks])


if __name__ == "__main__":
    sys.exit(main())
