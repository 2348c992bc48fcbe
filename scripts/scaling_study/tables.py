"""Rows of speed-up and efficiency from the points of a study."""

from __future__ import annotations

import csv
from pathlib import Path

from .points import Point, read_point

COLUMNS = (
    *("study", "kind", "job", "integrator", "size", "ranks", "bars", "nodes", "step_s", "best_s", "rate"),
    *("speedup", "ideal", "efficiency", "bandwidth_ratio", "percent_of_bound", "ghosts", "neighbours"),
    *("evaluated_twice", "memory_B_per_bar", "newton", "linear", "bandwidth_alone", "noise"),
)

REPEATS = 1.15
"""Median over best step from which the repeats of a point are noise."""

BANDWIDTH = 0.8
"""Bandwidth of one process, over the best of the study, below which another program was running; and the lowest ratio
of the bandwidths of all processes and of one that a machine can have."""


def rows_of(points: list[Point], folder: Path) -> list[dict]:
    """One row a point that has run: ``speedup`` in bars a second over the fewest ranks of its series."""
    rows = []
    for point in points:
        found = read_point(point, folder)
        if found is None:
            continue
        run = found["runs"][0]
        rows.append(
            {
                "study": point.study,
                "kind": point.kind,
                "job": point.job,
                "integrator": point.integrator,
                "size": point.size,
                "ranks": point.ranks,
                "bars": run["bars"],
                "nodes": run["nodes"],
                "step_s": run["median"],
                "best_s": run["best"],
                "rate": run["bars_per_second"],
                "bandwidth_ratio": found["bandwidth"]["ratio"],
                "percent_of_bound": run["share"],
                "ghosts": run["ghosts"],
                "neighbours": run["neighbours"],
                "evaluated_twice": run["evaluated"] / run["bars"] - 1.0,
                "memory_B_per_bar": run["memory"] / run["bars"],
                "newton": run["newton"],
                "linear": run["linear"],
                "bandwidth_alone": found["bandwidth"]["alone"],
            }
        )
    for row in rows:
        row["noise"] = noise_of(row, max(other["bandwidth_alone"] for other in rows))
    for series in series_of(rows).values():
        first = series[0]
        for row in series:
            row["speedup"] = row["rate"] / first["rate"]
            row["ideal"] = row["ranks"] / first["ranks"]
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
    for row in rows:
        series.setdefault(tuple(row[k] for k in ("study", "kind", "job", "integrator", "size")), []).append(row)
    return {key: sorted(value, key=lambda row: row["ranks"]) for key, value in series.items()}


def write_csv(rows: list[dict], path: Path) -> None:
    """All columns."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def markdown(rows: list[dict]) -> str:
    """The columns that matter, a table each study."""
    lines = []
    for study in dict.fromkeys(row["study"] for row in rows):
        size = "bars a rank" if study == "weak" else "bars"
        lines += [f"### {study.capitalize()} scaling", ""]
        lines += [
            f"| lattice | job | {size} | ranks | step ms | bars/s | speed-up | efficiency | machine's bandwidth ratio "
            "| noise |"
        ]
        lines += ["|---|---|---|---|---|---|---|---|---|---|"]
        for (name, kind, job, integrator, size), series in series_of(rows).items():
            if name != study:
                continue
            for row in series:
                lines.append(
                    f"| {kind} | {job} ({integrator}) | {size:,} | {row['ranks']} | {1e3 * row['step_s']:.4g} "
                    f"| {row['rate']:.3g} | {row['speedup']:.2f} | {100 * row['efficiency']:.0f} % "
                    f"| {row['bandwidth_ratio']:.2f} | {row['noise'] or '-'} |"
                )
        lines.append("")
    return "\n".join(lines)
