"""Strong and weak scaling of this program on this machine: tables, plots, and a model of larger machines.

usage: python scripts/scaling.py [--ranks 1 2 4] [--strong 1000000] [--weak 500000] [--jobs explicit matrix_free]

Every point is a run of "bench" under mpirun, stored in results/scaling; an interrupted study continues where it
stopped, and --again repeats all runs. Files written: scaling.csv, scaling.md, strong.png, weak.png, model.md,
model.png. On a cluster use --launcher "srun -n {ranks}"; docs/scaling.md has a job script and describes the model.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
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
MODEL_SIZES = [1e6, 1e7, 1e8, 1e9, 1e10]  # bars
MODEL_RANKS = np.array([1, 2, 8, 32, 128, 512, 1024, 2048, 4096, 10_000])
MOST_BARS, FEWEST_BARS = 2e8, 500  # of a rank: more do not fit in memory, fewer are not sensible
NEIGHBOURS = 26
CROSSING = 5.0  # bars per node of a face between two parts of a cubic lattice
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


def points_of(
    studies: list[str],
    kinds: list[str],
    jobs: list[str],
    sizes: dict[str, list[int]],
    ranks: list[int],
    names: Callable[[str], str],
) -> list[Point]:
    """All points, smallest first. ``names``: the integrator of a job."""
    found = [
        Point(study, kind, job, names(job), size, count)
        for study in studies
        for kind, job, size, count in product(kinds, jobs, sizes[study], ranks)
    ]
    return sorted(found, key=lambda p: (p.bars, p.ranks))


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
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={"OMP_NUM_THREADS": "1", **os.environ, "PYTHONPATH": path_of_package},
    )
    try:
        output, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        part.unlink(missing_ok=True)
        return f"failed: more than {limit:.0f} s"
    except BaseException:
        os.killpg(process.pid, signal.SIGTERM)
        part.unlink(missing_ok=True)
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
    _finish(axes, f"{study.capitalize()} scaling")
    axes.set_xticks(every, [str(r) for r in every])
    axes.minorticks_off()
    figure.legend(loc="outside lower center", ncols=2, fontsize=7)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _finish(axes: plt.Axes, title: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel="ranks", ylabel="time of a step [s]", title=title)
    axes.grid(True, alpha=0.3)


@dataclass(frozen=True)
class Parts:
    """Performance model of a step on many ranks, from measurements on few: loops, halo messages, reductions, Python.

    Assumptions:

    * Explicit steps with a row of history each. The part of a rank is a cube; its loops take the time per bar measured
      with all cores of a machine busy, independent of the size of the part (parts that fit in a cache are faster).
    * Bars between two ranks are evaluated on both. A cubic lattice has 5 of them per node of a face, half of which
      belong to a rank itself.
    * One exchange per step of 24 B per ghost with at most 26 neighbours, not overlapped with the loops; every message
      costs the latency, and all share a rank's part of the network.
    * One reduction over all ranks per row of history, log2(ranks) stages of one latency each, at least as measured.
    * Python and library calls take the measured time of a step of a tiny model on one rank.
    * Ranks of a machine share its memory: a bar takes at least its bytes over a rank's part of the machine's bandwidth.
    * The slowest rank has ``imbalance`` times the mean work; the others wait.
    * Fields are written every so many steps at the bandwidth of the file system, while nothing else happens.
    * No noise of the operating system.

    Attributes
    ----------
    bar : loops [s a bar and rank], all cores busy
    overhead : of a step outside the loops [s]
    latency : of a message [s]
    bandwidth : of a rank's messages [B/s]
    reduction : of a sum over the measured ranks [s]
    nodes_per_bar : of the lattice
    bytes_per_bar : that the loops move
    machine_ranks : that share the memory of a machine
    machine_bandwidth : of that memory [B/s]; infinite: as many times as there are ranks what they have here
    imbalance : work of the slowest rank over the mean
    snapshot : bytes of a snapshot a bar
    fields_every : steps between snapshots; 0: none
    disk : bandwidth of the file system [B/s]
    """

    bar: float
    overhead: float
    latency: float
    bandwidth: float
    reduction: float
    nodes_per_bar: float
    bytes_per_bar: float = 0.0
    machine_ranks: int = 1
    machine_bandwidth: float = np.inf
    imbalance: float = 1.0
    snapshot: float = 0.0
    fields_every: int = 0
    disk: float = np.inf

    def bar_on(self, ranks: np.ndarray) -> np.ndarray:
        """Return the time of the loops [s a bar and rank] where the ranks of a machine share its memory."""
        sharing = np.minimum(ranks, self.machine_ranks)
        return np.maximum(self.bar, self.bytes_per_bar * sharing / self.machine_bandwidth)

    @property
    def needed(self) -> float:
        """Bandwidth that a machine needs for its ranks to run as fast as measured [B/s]."""
        return self.machine_ranks * self.bytes_per_bar / self.bar if self.bar > 0.0 else 0.0


def step_time(parts: Parts, bars: float, ranks: np.ndarray) -> dict[str, np.ndarray]:
    """Seconds of a step of a lattice of ``bars`` on ``ranks``, by part and in all."""
    mine = bars / ranks
    edge = np.cbrt(mine * parts.nodes_per_bar)
    alone = ranks == 1
    ghosts = np.where(alone, 0.0, (edge + 2.0) ** 3 - edge**3)
    twice = np.where(alone, 0.0, 0.5 * CROSSING * 6.0 * edge**2)
    neighbours = np.minimum(NEIGHBOURS, ranks - 1)
    found = {
        "loops": parts.bar_on(ranks) * parts.imbalance * (mine + twice),
        "halo": neighbours * parts.latency + 24.0 * ghosts / parts.bandwidth,
        "sums": np.where(alone, 0.0, np.maximum(parts.reduction, parts.latency * np.ceil(np.log2(ranks)))),
        "python": np.full(len(ranks), parts.overhead),
        "output": np.full(len(ranks), parts.snapshot * bars / parts.disk / max(parts.fields_every, 1))
        * (parts.fields_every > 0),
    }
    found["step"] = sum(found.values())
    return found


def parts_from(found: dict, latency: float | None, bandwidth: float | None, **others: float) -> Parts:
    """Parts from what ``bench`` wrote of an explicit run on all cores; a network's figures replace those measured.

    ``others``: further attributes of :class:`Parts`.
    """
    run = max((r for r in found["runs"] if r["job"] == "explicit"), key=lambda r: r["bars"])
    # the best steps: on a shared machine the others hold waiting as well
    overhead = next(r["best"] for r in found["overhead"] if r["job"] == "tiny")
    messages = found["messages"] or {"latency": 1e-6, "bandwidth": 1e10, "reduction": 0.0}
    # on several ranks a tiny step has an exchange and a sum in it, which are counted apart
    deferred = messages["reduction"] + messages["latency"] * run["neighbours"] if found["ranks"] > 1 else 0.0
    overhead = max(overhead - deferred, 0.5 * overhead)
    return Parts(
        bar=max(run["best"] - overhead - deferred, 0.0) * found["ranks"] / run["evaluated"],
        overhead=overhead,
        latency=latency if latency is not None else messages["latency"],
        bandwidth=bandwidth if bandwidth is not None else messages["bandwidth"],
        reduction=messages["reduction"],
        nodes_per_bar=run["nodes"] / run["bars"],
        bytes_per_bar=run["traffic"] / run["bars"],
        # positions, velocities and contact forces of the nodes; stress, strain and plastic strain of the bars
        snapshot=72.0 * run["nodes"] / run["bars"] + 24.0,
        **others,
    )


def model_table(parts: Parts) -> str:
    """Strong scaling of each size by the model."""
    names = ("loops", "halo", "sums", "python", "output", "step")
    rows = []
    for bars in MODEL_SIZES:
        ranks = MODEL_RANKS[(bars / MODEL_RANKS <= MOST_BARS) & (bars / MODEL_RANKS >= FEWEST_BARS)]
        times = step_time(parts, bars, ranks)
        for k, r in enumerate(ranks):
            efficiency = f"{100 * parts.bar * bars / r / times['step'][k]:.0f} %"
            cells = (f"{1e3 * times[name][k]:.3g}" for name in names)
            rows.append([f"{bars:.0e}", f"{r:,}", f"{bars / r:,.0f}", *cells, efficiency])
    shown = ("loops ms", "halo ms", "sums ms", "Python ms", "output ms", "step ms")
    return markdown(["bars", "ranks", "bars a rank", *shown, "efficiency"], rows) + "\n"


def plot_model(parts: Parts, path: Path) -> None:
    """Steps over ranks by the model, with ideal lines."""
    figure, axes = plt.subplots(figsize=(7.5, 5.0), constrained_layout=True)
    every = np.unique(np.geomspace(1, MODEL_RANKS[-1], 60).astype(int))
    for number, bars in enumerate(MODEL_SIZES):
        ranks = every[bars / every <= MOST_BARS]
        axes.plot(ranks, step_time(parts, bars, ranks)["step"], color=f"C{number}", label=f"{bars:.0e} bars")
        axes.plot(ranks, parts.bar * bars / ranks, "--", color=f"C{number}", linewidth=0.8)
    axes.plot([], [], "k--", linewidth=0.8, label="loops alone, ideal")
    _finish(axes, "Explicit steps by the model")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def write_model(points: list[Point], folder: Path, arguments: argparse.Namespace) -> None:
    """Write the model from the explicit point with most ranks, then most bars, that has run."""
    known = [p for p in points if p.job == "explicit" and (folder / p.file).exists()]
    if not known:
        return
    point = max(known, key=lambda p: (p.ranks, p.bars))
    parts = parts_from(
        json.loads((folder / point.file).read_text(encoding="utf-8")),
        arguments.latency,
        arguments.network,
        machine_ranks=arguments.machine_ranks,
        machine_bandwidth=arguments.machine_bandwidth or float("inf"),
        imbalance=arguments.imbalance,
        fields_every=arguments.fields_every,
        disk=arguments.disk,
    )
    output = f"Snapshots every {parts.fields_every} steps, {parts.snapshot:.0f} B a bar at {parts.disk / 1e9:.1f} GB/s."
    text = (
        f"From {point.bars:,} bars on {point.ranks} ranks: {1e9 * parts.bar:.2f} ns a bar and rank, "
        f"{1e6 * parts.overhead:.0f} us outside the loops, latency {1e6 * parts.latency:.2f} us, "
        f"{parts.bandwidth / 1e9:.1f} GB/s a rank, sums {1e6 * parts.reduction:.1f} us.\n\n"
        f"{parts.machine_ranks} ranks that share a memory need {parts.needed / 1e9:.0f} GB/s of it to run as fast as "
        f"measured; the model gives them {parts.machine_bandwidth / 1e9:.0f} GB/s. The slowest rank has "
        f"{parts.imbalance:.2f} times the mean work. {output if parts.fields_every else 'No snapshots.'}\n\n"
        f"{model_table(parts)}"
    )
    rows = rows_of([p for p in known if p.kind == point.kind], folder)
    for row in {(row["bars"], row["ranks"]): row for row in rows}.values():
        modelled = step_time(parts, row["bars"], np.array([row["ranks"]]))["step"][0]
        text += f"\n{row['bars']:,} bars on {row['ranks']} ranks: model {1e3 * modelled:.4g} ms, "
        text += f"measured {1e3 * row['step_s']:.4g} ms"
    (folder / "model.md").write_text(text + "\n", encoding="utf-8")
    plot_model(parts, folder / "model.png")


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
    Table({name: [row[name] for row in rows] for name in rows[0]}).to_csv(folder / "scaling.csv")
    studies = dict.fromkeys(row["study"] for row in rows)
    text = "\n".join(table_of(rows, study) for study in studies)
    (folder / "scaling.md").write_text(text, encoding="utf-8")
    print("\n" + text)
    for study in studies:
        plot_study(rows, study, folder / f"{study}.png")
    write_model(points, folder, arguments)
    print(f"in {folder}: " + ", ".join(sorted(p.name for p in folder.iterdir() if p.suffix in (".csv", ".md", ".png"))))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
