"""Loose rods that fall into a box, settle on each other with friction, and rest without passing through each other."""

import crush_study
import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result

RADIUS, LENGTH, SIDE, ROWS, LAYERS = 0.005, 0.1, 0.4, 3, 7
WALLS = {
    "floor": ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
    "left": ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
    "right": ([SIDE, 0.0, 0.0], [-1.0, 0.0, 0.0]),
    "front": ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
    "back": ([0.0, SIDE, 0.0], [0.0, -1.0, 0.0]),
}


def heap():
    """Layers of rods, each turned at random."""
    random = np.random.default_rng(3)
    numbers = np.stack(np.meshgrid(*map(np.arange, (ROWS, ROWS, LAYERS)), indexing="ij"), axis=-1).reshape(-1, 3)
    centre = (numbers + 0.5) * [SIDE / ROWS, SIDE / ROWS, 0.025]
    angle = random.uniform(0.0, np.pi, len(centre))
    half = 0.5 * LENGTH * np.stack([np.cos(angle), np.sin(angle), random.uniform(-0.05, 0.05, len(centre))], axis=1)
    points = np.stack([centre - half, centre + half], axis=1).reshape(-1, 3)
    tables = {
        "material": {"m": {"young_modulus": 1e7, "density": 1000.0, "damping": 6000.0}},
        "section": {"s": {"area": np.pi * RADIUS**2, "material": "m"}},
        "wall": [
            {"name": name, "type": "plane", "point": point, "normal": normal, "friction": 0.4}
            for name, (point, normal) in WALLS.items()
        ],
        "gravity": {"acceleration": [0.0, 0.0, -9.81]},
        "self_contact": {"friction": 0.4, "restitution": 0.3},
        "time": {"integrator": "central_differences", "step": "auto", "safety": 0.4, "end": 1.5},
        "output": {"history_every": 20, "fields_every": 20, "fields": []},
    }
    return Case(tables, mesh=Truss(points, np.arange(len(points)).reshape(-1, 2)))


@pytest.mark.slow
def test_rods_settle(tmp_path):
    with Simulation(heap(), MPI.COMM_SELF, output=tmp_path, quiet=True) as simulation:
        simulation.run()
    result = open_result(tmp_path)
    history = result.history
    passages, least, _ = crush_study.count_passages(result, RADIUS)
    assert passages == 0 and least > 0.5
    assert history["self_contact/contacts"][-1] > 20
    kinetic, work = history["kinetic_energy"], history["external_work"][-1]
    assert kinetic[-1] < 2e-3 * kinetic.max()
    assert history["self_contact_dissipation"][-1] > 0.3 * work
    assert abs(history["energy_imbalance"]).max() < 1e-12 * work
    assert result.positions(-1)[:, 2].max() < 0.6 * result.positions(0)[:, 2].max()
