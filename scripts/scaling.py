"""Strong and weak scaling of this program on this machine: tables and plots.

usage: python scripts/scaling.py [--ranks 1 2 4] [--strong 1000000] [--weak 500000] [--jobs explicit matrix_free]

Every point is a run of "bench" under mpirun, stored in results/scaling; an interrupted study continues where it
stopped, and --again repeats all runs. Files written: scaling.csv, scaling.md, strong.png, weak.png. On a cluster use
--launcher "srun -n {ranks}"; docs/scaling.md has a job script.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
from itertools import product
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from pages import markdown

from pfem_petsc.output.table import Table

matplotlib.use("Agg")
from matplotlib import pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent
REPEATS = 1.15
"""Median over best step from which the repeats of a point are noise."""
BANDWIDTH = 0.8
"""Bandwidth of one process, over the best of the study, below which another program was running; and the lowest ratio
of the bandwidths of all processes and of one that a machine can have."""


class Point(NamedTuple):
    """So many bars on so many ranks; ``study`` is strong or weak, ``size`` in bars, whole or a rank."""

    study: str
    kind: str
    job: str
    integrator: str
    size: int
    ranks: int

    @property
    def bars(self) -> int:
        """Of the whole lattice, about."""
        return self.size * self.ranks if self.study == "weak" else self.size

    @property
    def file(self) -> str:
        """Name of its file; points of both studies with as many bars and ranks share one."""
        return f"{self.kind}_{self.job}_{self.integrator}_{self.bars}bars_{self.ranks}ranks.json"


def run_point(point: Point, folder: Path, launcher: str, seconds: float, limit: float) -> str:
    """Run a point unless its file is there. Gives what happened: kept, done or a failure."""
    path = folder / point.file
    if path.exists():
        return "kept"
    part = path.with_suffix(".part")
    option = "--explicit" if point.job.startswith("explicit") else "--implicit"
    command = [
        *shlex.split(launcher.format(ranks=point.ranks)),
        *(sys.executable, "-m", "pfem_petsc", "bench", "--sizes", str(point.bars), "--kind", point.kind),
        *("--jobs", point.job, option, point.integrator, "--seconds", str(seconds), "-o", str(part)),
    ]
    path_of_package = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    # a group of its own: a launcher that is ended must take its ranks along
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    environment = {"OMP_NUM_THREADS": "1", **os.environ, "PYTHONPATH": path_of_package}
    process = subprocess.Popen(command, env=environment, **options)
    try:
        output, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        output = f"more than {limit:.0f} s"
    except BaseException:
        os.killpg(process.pid, signal.SIGTERM)
        raise
    if process.returncode != 0 or not part.exists() or part.stat().st_size == 0:
        part.unlink(missing_ok=True)
        return "failed: " + (output.strip().splitlines() or ["no message"])[-1]
    part.replace(path)
    return "done"


def rows_of(points: list[Point], folder: Path) -> list[dict]:
    """One row a point that has run: ``speedup`` in bars a second over the fewest ranks of its series."""
    rows = []
    for point in points:
        if not (folder / point.file).exists():
            continue
        found = json.loads((folder / point.file).read_text(encoding="utf-8"))
        run, bandwidth = found["runs"][0], found["bandwidth"]
        rows.append(
            {
                **point._asdict(),
                "bars": run["bars"],
                "nodes": run["nodes"],
                "step_s": run["median"],
                "best_s": run["best"],
                "rate": run["bars_per_second"],
                "bandwidth_ratio": bandwidth["ratio"],
                "percent_of_bound": run["share"],
                "ghosts": run["ghosts"],
                "neighbours": run["neighbours"],
                "evaluated_twice": run["evaluated"] / run["bars"] - 1.0,
                "memory_B_per_bar": run["memory"] / run["bars"],
                "newton": run["newton"],
                "linear": run["linear"],
                "bandwidth_alone": bandwidth["alone"],
            }
        )
    for row in rows:
        row["noise"] = noise_of(row, max(other["bandwidth_alone"] for other in rows))
    for series in series_of(rows).values():
        for row in series:
            row["speedup"] = row["rate"] / series[0]["rate"]
            row["ideal"] = row["ranks"] / series[0]["ranks"]
            row["efficiency"] = row["speedup"] / row["ideal"]
    return rows


def noise_of(row: dict, best_bandwidth: float) -> str:
    """Return why the time of a point is noise, empty if nothing shows that it is.

    ``best_bandwidth``: the largest that one process had in the study [B/s].
    """
    reasons = []
    if row["step_s"] > REPEATS * row["best_s"]:
        reasons.append(f"repeats differ {row['step_s'] / row['best_s']:.2f} x")
    if row["bandwidth_alone"] < BANDWIDTH * best_bandwidth:
        reasons.append(f"one process had {row['bandwidth_alone'] / best_bandwidth:.2f} x the best bandwidth")
    if not BANDWIDTH <= row["bandwidth_ratio"] <= row["ranks"] / BANDWIDTH:
        reasons.append(f"bandwidth ratio {row['bandwidth_ratio']:.2f} of {row['ranks']} processes")
    return "; ".join(reasons)


def series_of(rows: list[dict]) -> dict[tuple, list[dict]]:
    """Rows that differ in ranks only, by rising ranks."""
    series: dict[tuple, list[dict]] = {}
    for row in sorted(rows, key=lambda row: row["ranks"]):
        series.setdefault(tuple(row[k] for k in ("study", "kind", "job", "integrator", "size")), []).append(row)
    return series


def table_of(rows: list[dict], study: str) -> str:
    """The columns that matter."""
    head = ["lattice", "job", "bars a rank" if study == "weak" else "bars", "ranks", "step ms", "bars/s", "speed-up"]
    head += ["efficiency", "machine's bandwidth ratio", "noise"]
    lines = [
        [
            *(kind, f"{job} ({integrator})", f"{size:,}", str(row["ranks"]), f"{1e3 * row['step_s']:.4g}"),
            *(f"{row['rate']:.3g}", f"{row['speedup']:.2f}", f"{100 * row['efficiency']:.0f} %"),
            *(f"{row['bandwidth_ratio']:.2f}", row["noise"] or "-"),
        ]
        for (name, kind, job, integrator, size), series in series_of(rows).items()
        for row in series
        if name == study
    ]
    return f"### {study.capitalize()} scaling\n\n{markdown(head, lines)}\n"


def plot_study(rows: list[dict], study: str, path: Path) -> None:
    """Time of a step over ranks; ideal lines dashed, the machine's bandwidth as the ceiling dotted."""
    figure, axes = plt.subplots(figsize=(7.5, 6.0), constrained_layout=True)
    series = {key: value for key, value in series_of(rows).items() if key[0] == study}
    for number, ((_, kind, job, integrator, size), points) in enumerate(series.items()):
        colour = f"C{number % 10}"
        ranks, times, bars, ratio = (
            np.array([row[name] for row in points]) for name in ("ranks", "step_s", "bars", "bandwidth_ratio")
        )
        label = f"{kind}, {job} ({integrator}), {size:,} {'bars a rank' if study == 'weak' else 'bars'}"
        axes.plot(ranks, times, "o-", color=colour, label=label)
        doubtful = np.array([bool(row["noise"]) for row in points])
        axes.plot(ranks[doubtful], times[doubtful], "o", color=colour, markerfacecolor="white", zorder=3)
        work = times[0] * bars / bars[0]
        axes.plot(ranks, work * ranks[0] / ranks, "--", color=colour, linewidth=0.8)
        axes.plot(ranks, work * ratio[0] / ratio, ":", color=colour, linewidth=1.2)
    axes.plot([], [], "k--", linewidth=0.8, label="ideal")
    axes.plot([], [], "ko", markerfacecolor="white", label="noise: see the table")
    axes.plot([], [], "k:", linewidth=1.2, label="as the machine's memory bandwidth grows")
    every = sorted({row["ranks"] for points in series.values() for row in points})
    title = f"{study.capitalize()} scaling"
    axes.set(xscale="log", yscale="log", xlabel="ranks", ylabel="time of a step [s]", title=title)
    axes.grid(True, alpha=0.3)
    axes.set_xticks(every, [str(r) for r in every])
    axes.minorticks_off()
    figure.legend(loc="outside lower center", ncols=2, fontsize=7)
    figure.savefig(path, dpi=150)
    plt.close(figure)


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
    arguments = parser.parse_args()
    folder: Path = arguments.results
    folder.mkdir(parents=True, exist_ok=True)
    points = []
    for study, kind, job, ranks in product(arguments.studies, arguments.kinds, arguments.jobs, set(arguments.ranks)):
        integrator = arguments.explicit if job.startswith("explicit") else arguments.implicit
        points += [Point(study, kind, job, integrator, size, ranks) for size in getattr(arguments, study)]
    points.sort(key=lambda point: (point.bars, point.ranks))
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
    Table({name: [row[name] for row in rows] for name in rows[0]}).to_csv(folder / "scaling.csv")
    studies = dict.fromkeys(row["study"] for row in rows)
    text = "\n".join(table_of(rows, study) for study in studies)
    (folder / "scaling.md").write_text(text, encoding="utf-8")
    print("\n" + text)
    for study in studies:
        plot_study(rows, study, folder / f"{study}.png")
    print(f"in {folder}: " + ", ".join(sorted(p.name for p in folder.iterdir() if p.suffix in (".csv", ".md", ".png"))))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
