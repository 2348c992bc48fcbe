"""Quantities of a run to which the paper's statements refer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .exact import Rod
from .running import Run

ENERGIES = ("kinetic_energy", "elastic_energy", "plastic_dissipation")
WINDOW = 20  # steps after the first contact in which the velocity jump is evaluated
PAUSE = 2.5e-3  # a release of the ring shorter than this belongs to the same contact [s]
REST = 0.01  # relative to the impact speed: a slower tip counts as at rest


def contact_episodes(time: np.ndarray, contacts: np.ndarray) -> list[tuple[float, float]]:
    """First and last recorded time [s] of each uninterrupted contact; (rows,) times and numbers of contacts."""
    touching = np.concatenate([[0], (contacts > 0).astype(np.int64), [0]])
    change = np.diff(touching)
    first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    return [(float(time[a]), float(time[b])) for a, b in zip(first, last)]


def _wall(run: Run) -> str:
    (name,) = {column.split("/")[1] for column in run.history if column.startswith("wall/")}
    return name


def wall_force(run: Run) -> np.ndarray:
    """Force that the wall takes, positive in compression: (rows,) [N]."""
    return -run.history[f"wall/{_wall(run)}/force"][:, 0]


def tip_velocity(run: Run) -> np.ndarray:
    """Of the node that hits, along the rod: (rows,) [m/s]."""
    return run.history["probe/tip/velocity"][:, 0, 0]


def _episodes(run: Run) -> list[tuple[float, float]]:
    return contact_episodes(run.time, run.history[f"wall/{_wall(run)}/contacts"])


@dataclass
class RodImpact:
    """A rod against a wall. Speeds are relative to the impact speed, forces to the exact one, energies to the initial.

    Quantities that a run did not reach are NaN.

    Attributes
    ----------
    end : last contact [s]
    duration : from first to last contact [s]
    releases : uninterrupted contacts
    peak, median, roughness : largest force; median and standard deviation in the first 90 % of the exact contact
    undershoot : largest velocity against the direction of flight in the first steps of contact
    excess : variation of the tip's velocity in the first steps of contact beyond the jump to rest
    rest_steps : steps after the first contact until the tip stays at rest, in the first half of the exact contact
    held : largest speed of the tip between 30 % and 90 % of the exact contact
    mean_rebound, rebound_std, rebound_rms : of the tip after contact: mean and standard deviation of its velocity, root
        mean square deviation from the exact one
    whole_rebound : velocity of the centre of mass at the end
    energy : kinetic and elastic energy at the end
    dissipated : plastic work
    """

    end: float
    duration: float
    releases: int
    peak: float
    median: float
    roughness: float
    undershoot: float
    excess: float
    rest_steps: int
    held: float
    mean_rebound: float
    rebound_std: float
    rebound_rms: float
    whole_rebound: float
    energy: float
    dissipated: float


def measure_rod(run: Run, exact: Rod) -> RodImpact:
    """Measure a rod or bar that hits a wall."""
    time, history = run.time, run.history
    force = wall_force(run) / exact.force
    velocity = tip_velocity(run) / exact.speed
    episodes = _episodes(run)
    first = int(np.searchsorted(time, episodes[0][0] - 0.5 * run.h))
    jump = velocity[max(first - 1, 0) : first + WINDOW]
    t0, duration = exact.impact, exact.duration
    early = velocity[first : np.searchsorted(time, t0 + 0.5 * duration)]
    moving = np.flatnonzero(np.abs(early) > REST)
    inside = (time > t0 + 2.0 * run.h) & (time < t0 + 0.9 * duration)
    middle = (time > t0 + 0.3 * duration) & (time < t0 + 0.9 * duration)
    # the same time interval for all schemes, before any of them leaves the wall
    free = time > max(episodes[-1][1], exact.release) + 0.1 * duration
    kinetic = history["kinetic_energy"][0]
    after = velocity[free]
    return RodImpact(
        end=episodes[-1][1],
        duration=episodes[-1][1] - episodes[0][0],
        releases=len(episodes),
        peak=float(force.max()),
        median=float(np.median(force[inside])),
        roughness=float(force[inside].std()),
        undershoot=float(max(-jump.min(), 0.0)),
        excess=float(np.abs(np.diff(jump)).sum() - 1.0),
        rest_steps=int(moving[-1]) + 1 if len(moving) else 0,
        held=float(np.abs(velocity[middle]).max()) if middle.any() else np.nan,
        mean_rebound=float(after.mean()) if len(after) else np.nan,
        rebound_std=float(after.std()) if len(after) else np.nan,
        rebound_rms=float(np.sqrt(((after + 1.0) ** 2).mean())) if len(after) else np.nan,
        whole_rebound=float(history["momentum"][-1, 0] / history["momentum"][0, 0]),
        energy=float((history["kinetic_energy"][-1] + history["elastic_energy"][-1]) / kinetic),
        dissipated=float(history["plastic_dissipation"][-1] / kinetic),
    )


@dataclass
class RingImpact:
    """The ring against the wall.

    Attributes
    ----------
    phases : first and last time of each contact, with releases shorter than 2.5 ms passed over [s]
    touching : time in contact [s]
    thrown : farthest that node 1 is from where it first touched, in the 25 ms after that [m]
    strain, plastic_strain : largest of all bars and snapshots, and plastic strain left at the end
    dissipated : plastic work at the end, of the kinetic energy at the start
    kept : kinetic, elastic and plastic energy at the end, of the kinetic energy at the start
    shortened : displacement of node 1 against that of node 2 at the end [m]
    """

    phases: list[tuple[float, float]]
    touching: float
    thrown: float
    strain: float
    plastic_strain: float
    left: float
    dissipated: float
    kept: float
    shortened: float


def measure_ring(run: Run) -> RingImpact:
    """Measure the ring; reads its snapshots."""
    history, result = run.history, run.result
    strains = [np.abs(result.field("strain", i)).max() for i in range(len(result.times))]
    plastic = [np.abs(result.field("plastic_strain", i)).max() for i in range(len(result.times))]
    kinetic = history["kinetic_energy"][0]
    one, two = (history[f"probe/{name}/position"][:, 0, 0] for name in ("impact", "opposite"))
    touching = history[f"wall/{_wall(run)}/contacts"] > 0
    episodes = _episodes(run)
    early = (run.time > episodes[0][0] + 0.5 * run.h) & (run.time < episodes[0][0] + 25e-3)
    phases = [episodes[0]]
    for start, end in episodes[1:]:
        if start - phases[-1][1] < PAUSE:
            phases[-1] = (phases[-1][0], end)
        else:
            phases.append((start, end))
    return RingImpact(
        phases=phases,
        touching=float(touching.sum() * run.h),
        thrown=float(one[early].max() - one[early].min()),
        strain=float(max(strains)),
        plastic_strain=float(max(plastic)),
        left=float(plastic[-1]),
        dissipated=float(history["plastic_dissipation"][-1] / kinetic),
        kept=float(sum(history[name][-1] for name in ENERGIES) / kinetic),
        shortened=float((one[0] - two[0]) - (one[-1] - two[-1])),
    )


def spread(run: Run, reference: Run, probe: str) -> float:
    """Root mean square distance of a probe's displacement along x from that of another run [m], at the run's times."""
    mine = run.history[f"probe/{probe}/position"][:, 0, 0]
    other = np.interp(run.time, reference.time, reference.history[f"probe/{probe}/position"][:, 0, 0])
    return float(np.sqrt(((mine - other) ** 2).mean()))
