"""Performance model of a step on many ranks, from measurements on few: loops, halo messages, reductions, Python.

Assumptions
-----------
* Explicit steps with a row of history each. The part of a rank is a cube; its loops take the time per bar measured with
  all cores of a machine busy, independent of the size of the part (parts that fit in a cache are faster).
* Bars between two ranks are evaluated on both. A cubic lattice has 5 of them per node of a face, half of which belong
  to a rank itself.
* One exchange per step of 24 B per ghost with at most 26 neighbours, not overlapped with the loops; every message costs
  the latency, and all share a rank's part of the network.
* One reduction over all ranks per row of history, log2(ranks) stages of one latency each, at least as measured.
* Python and library calls take the measured time of a step of a tiny model on one rank.
* Ranks of a machine share its memory: a bar takes at least its bytes over a rank's part of the machine's bandwidth.
* The slowest rank has ``imbalance`` times the mean work; the others wait.
* Fields are written every so many steps at the bandwidth of the file system, while nothing else happens.
* No noise of the operating system.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

NEIGHBOURS = 26
CROSSING = 5.0  # bars per node of a face between two parts of a cubic lattice


@dataclass(frozen=True)
class Parts:
    """Measured or assumed.

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


def table(parts: Parts, sizes: list[float], most: int = 10_000) -> str:
    """Markdown: strong scaling of each size, to where the efficiency is a half, and to ``most`` ranks."""
    ranks = np.array([r for r in (1, 2, 8, 32, 128, 512, 1024, 2048, 4096, 10_000) if r <= most])
    lines = [
        "| bars | ranks | bars a rank | loops ms | halo ms | sums ms | Python ms | output ms | step ms | efficiency |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for bars in sizes:
        times = step_time(parts, bars, ranks)
        for k, r in enumerate(ranks):
            if bars / r > 2e8 or bars / r < 500:  # does not fit in memory, or is not sensible
                continue
            efficiency = parts.bar * bars / r / times["step"][k]
            cells = " | ".join(
                f"{1e3 * times[name][k]:.3g}" for name in ("loops", "halo", "sums", "python", "output", "step")
            )
            lines.append(f"| {bars:.0e} | {r:,} | {bars / r:,.0f} | {cells} | {100 * efficiency:.0f} % |")
    return "\n".join(lines) + "\n"


def plot_model(parts: Parts, sizes: list[float], path: Path, most: int = 10_000) -> None:
    """Steps over ranks by the model, with ideal lines."""
    ranks = np.unique(np.geomspace(1, most, 60).astype(int))
    figure, axes = plt.subplots(figsize=(7.5, 5.0), constrained_layout=True)
    for number, bars in enumerate(sizes):
        colour, fits = f"C{number}", bars / ranks <= 2e8
        axes.plot(ranks[fits], step_time(parts, bars, ranks)["step"][fits], color=colour, label=f"{bars:.0e} bars")
        axes.plot(ranks[fits], (parts.bar * bars / ranks)[fits], "--", color=colour, linewidth=0.8)
    axes.plot([], [], "k--", linewidth=0.8, label="loops alone, ideal")
    title = "Explicit steps by the model"
    axes.set(xscale="log", yscale="log", xlabel="ranks", ylabel="time of a step [s]", title=title)
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)
