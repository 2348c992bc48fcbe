"""The truss on which all codes are timed; needs NumPy only, so that every environment can import it.

Cubic cells of edge PITCH with both diagonals on every face, or the mesh of the file $PEER_MESH that make_mesh.py has
made; thrown at the plane z = 0 where its foot starts. SI units.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

YOUNG_MODULUS, DENSITY, AREA, PITCH = 110e9, 4500.0, 1e-6, 0.01
SPEED = -20.0  # [m/s] along z
PRESSED = 0.005  # share of its height by which a lattice is pressed in static increments
YIELD_STRESS, HARDENING_RATIO = 900e6, 0.01  # [Pa]; tangent over Young's modulus beyond yield
WAVE_SPEED = (YOUNG_MODULUS / DENSITY) ** 0.5
MESH = os.environ.get("PEER_MESH", "")
EXPLICIT_STEP = (0.01 if MESH else 0.1) * PITCH / WAVE_SPEED  # [s]; other meshes have bars shorter than PITCH
IMPLICIT_STEP = 2.0 * PITCH / WAVE_SPEED  # [s]


def truss(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (nodes, 3) [m] and ends of bars (bars, 2) of the mesh of the file, or of a block of so many cells."""
    if not MESH:
        return lattice(cells)
    with np.load(MESH) as arrays:
        return arrays["points"], arrays["bars"]


def lattice(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (nodes, 3) [m] and ends of bars (bars, 2) of a block of ``cells`` x ``cells`` x ``cells`` cells."""
    edge = cells + 1
    place = np.indices((edge, edge, edge)).reshape(3, -1).T
    points = PITCH * place.astype(float)
    strides = np.array([edge * edge, edge, 1])
    bars = []
    # from the node ``at`` of a cell's face or edge to the node ``to``, wherever both lie in the block
    unit = np.eye(3, dtype=int)
    zero = np.zeros(3, dtype=int)
    pairs = [(zero, axis) for axis in unit]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        pairs += [(zero, unit[one] + unit[other]), (unit[one], unit[other])]
    for at, to in pairs:
        reach = np.maximum(at, to)
        start = place[(place + reach <= cells).all(axis=1)]
        bars.append(np.column_stack([(start + at) @ strides, (start + to) @ strides]))
    return points, np.concatenate(bars)


def middle(points: np.ndarray) -> int:
    """Number of the node in the middle of the edge x = y = 0, whose displacement along x static runs report."""
    return int(np.argmin(np.linalg.norm(points - [0.0, 0.0, 0.499 * points[:, 2].max()], axis=1)))


def lumped_mass(points: np.ndarray, bars: np.ndarray) -> np.ndarray:
    """Mass (nodes,) [kg]: half of each bar at each end."""
    length = np.linalg.norm(points[bars[:, 1]] - points[bars[:, 0]], axis=1)
    half = 0.5 * DENSITY * AREA * length
    return np.bincount(bars.ravel(), np.repeat(half, 2), len(points))


def timed(run: Callable[[], object], steps: int) -> dict[str, float]:
    """Make all steps by one call: seconds a step; there are no iterations."""
    wall, cpu = time.perf_counter(), time.process_time()
    run()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {"cpu": cpu / steps, "wall": wall / steps, "iterations": 0.0}


def whole(command: list[str], steps: int) -> dict[str, float]:
    """Run a command, from its start to its end, output and all: seconds a step."""
    before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - wall
    cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return {"cpu": cpu / steps, "wall": wall / steps, "iterations": 0.0, "memory": 1024 * after.ru_maxrss}


def time_steps(step: Callable[[], float], steps: int) -> dict[str, float]:
    """Make a step that is not timed, then ``steps`` that are: seconds a step, and the mean of what steps return."""
    step()
    found: list[float] = []
    times = timed(lambda: found.extend(step() for _ in range(steps)), steps)
    return times | {"iterations": sum(found) / steps}


def report(times: dict[str, float], bars: int, top: float, **further: float) -> None:
    """Print the result as one line of JSON: ``top`` is the displacement of the last node along z [m].

    In static increments it is that of :func:`middle` along x.
    """
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print("RESULT " + json.dumps({"memory": peak, **times, "bars": bars, "top": top, **further}), flush=True)


def arguments() -> tuple[int, str, int, str]:
    """Cells, mode, steps and solver of the call; modes: explicit, implicit, these with _contact, explicit_long, static,
    whole."""
    cells, mode, steps = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    return cells, mode, steps, sys.argv[4] if len(sys.argv) > 4 else ""
