"""Comparison of two results of a case: bitwise, and by relative differences."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from .loading import Loaded
from .oracle import energy_scale

__all__ = ["bitwise", "distance", "paths_distance"]


def bitwise(one: Path, other: Path) -> dict[str, float]:
    """Return the datasets of two results that are not bitwise identical, with the largest difference over the largest
    value (inf: of another shape)."""
    found: dict[str, float] = {}
    with (
        h5py.File(one / "result.vtkhdf", "r", locking=False) as a,
        h5py.File(other / "result.vtkhdf", "r", locking=False) as b,
    ):
        names: set[str] = set()
        for file in (a, b):
            file.visititems(lambda name, item: names.add(name) if isinstance(item, h5py.Dataset) else None)
        for name in sorted(names - {"case/text"}):
            if name not in a or name not in b or a[name].shape != b[name].shape:
                found[name] = np.inf
                continue
            x, y = a[name][()], b[name][()]
            if x.tobytes() != y.tobytes():
                largest = max(float(np.abs(x).max()), np.finfo(float).tiny)
                found[name] = float(np.abs(x - y).max()) / largest
    return found


def distance(one: Path, other: Path) -> tuple[float, str]:
    """Return the largest relative difference of two results, and where it is.

    Positions are relative to the size of the truss, energies to the largest energy, momenta to the largest momentum (or
    that of the displacement of the centre, if they cancel), forces of walls to the largest force.
    """
    a, b = Loaded(one), Loaded(other)
    worst = paths_distance(a, b)
    history = a.history
    energy = max(energy_scale(history), 1e-300)
    speed = np.abs(history["momentum"]).max()
    size = max(a.size, 1e-300)
    scales = {"momentum": speed, "angular_momentum": speed * size, "centre_of_mass": size}
    for name in history:
        if name.endswith(("_iterations", "releases", "changes", "contact_time", "active_contacts", "contacts")):
            continue
        x, y = (np.asarray(run.history[name], dtype=float) for run in (a, b))
        if x.shape != y.shape:
            return np.inf, f"{name}: {x.shape} and {y.shape}"
        if name.endswith(("_energy", "_work", "_dissipation", "_heat", "_imbalance")):
            scale = energy
        elif name in scales:
            scale = max(scales[name], 1e-300)
        elif name in ("time", "step", "step_size") or name.endswith("/position"):
            scale = max(np.abs(x).max(), size)
        else:
            continue
        apart = float(np.abs(x - y).max()) / scale
        if apart > worst[0]:
            worst = apart, name
    return worst


def paths_distance(a: Loaded, b: Loaded) -> tuple[float, str]:
    """Largest distance of a node in one result from itself in the other, over the truss's size."""
    if a.positions.shape != b.positions.shape:
        return np.inf, f"{len(a.steps)} and {len(b.steps)} snapshots"
    if not a.positions.size:
        return 0.0, "nothing"
    apart = np.abs(a.positions - b.positions).max(axis=(1, 2)) / max(a.size, 1e-300)
    i = int(apart.argmax())
    return float(apart[i]), f"positions in snapshot {i} of {len(a.steps)}"
