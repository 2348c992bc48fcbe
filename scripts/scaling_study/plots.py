"""Log-log plots of a study with ideal lines."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from .tables import series_of


def plot_study(rows: list[dict], study: str, path: Path) -> None:
    """Time of a step over ranks; ideal lines dashed, the machine's bandwidth as the ceiling dotted."""
    series = {key: value for key, value in series_of(rows).items() if key[0] == study}
    if not series:
        return
    figure, axes = plt.subplots(figsize=(7.5, 6.0), constrained_layout=True)
    for number, ((_, kind, job, integrator, size), points) in enumerate(series.items()):
        colour = f"C{number % 10}"
        ranks = [row["ranks"] for row in points]
        first = points[0]
        unit = "bars a rank" if study == "weak" else "bars"
        label = f"{kind}, {job} ({integrator}), {size:,} {unit}"
        axes.plot(ranks, [row["step_s"] for row in points], "o-", color=colour, label=label)
        doubtful = [row for row in points if row["noise"]]
        axes.plot(
            [row["ranks"] for row in doubtful],
            [row["step_s"] for row in doubtful],
            "o",
            color=colour,
            markerfacecolor="white",
            zorder=3,
        )
        work = [row["bars"] / first["bars"] for row in points]
        ideal = [first["step_s"] * w * first["ranks"] / r for w, r in zip(work, ranks)]
        axes.plot(ranks, ideal, "--", color=colour, linewidth=0.8)
        ceiling = [
            first["step_s"] * w * first["bandwidth_ratio"] / row["bandwidth_ratio"] for w, row in zip(work, points)
        ]
        axes.plot(ranks, ceiling, ":", color=colour, linewidth=1.2)
    axes.plot([], [], "k--", linewidth=0.8, label="ideal")
    axes.plot([], [], "ko", markerfacecolor="white", label="noise: see the table")
    axes.plot([], [], "k:", linewidth=1.2, label="as the machine's memory bandwidth grows")
    axes.set(
        xscale="log", yscale="log", xlabel="ranks", ylabel="time of a step [s]", title=f"{study.capitalize()} scaling"
    )
    every = sorted({row["ranks"] for points in series.values() for row in points})
    axes.set_xticks(every, [str(r) for r in every])
    axes.minorticks_off()
    axes.grid(True, which="major", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, fontsize=7)
    figure.savefig(path, dpi=150)
    plt.close(figure)
