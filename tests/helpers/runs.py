"""Runs of cases, quantities from their histories, and rods for balances of energy and momentum."""

from __future__ import annotations

import tempfile

import numpy as np
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result


def run(case, folder, comm=MPI.COMM_WORLD) -> dict[str, np.ndarray]:
    """Run a case to its end; its history as arrays, the same on all ranks. Collective."""
    assert Simulation(case, comm, output=folder, quiet=True).run() == 0
    history = None
    if comm.rank == 0:
        result = open_result(folder)
        history = {column: result.history[column] for column in result.history}
    return comm.bcast(history)


def run_alone(name, *overrides) -> dict[str, np.ndarray]:
    """Run a built-in case on this rank without field snapshots; its history."""
    with tempfile.TemporaryDirectory(prefix="pfem-test-") as folder:
        return run(Case.load(name, [*overrides, "output.fields_every=0"]), folder, MPI.COMM_SELF)


def inspected(case, comm=MPI.COMM_WORLD) -> tuple[dict[str, str], list[str]]:
    """Entries and warnings of ``check``. Collective."""
    return Simulation(case, comm, check_only=True).inspect()


def touching(history, wall):
    """Whether the wall pushes, row by row."""
    return np.linalg.norm(history[f"wall/{wall}/force"], axis=1) > 0.0


def episodes(history, wall):
    """First and last time [s] of each contact."""
    on = np.concatenate([[0], touching(history, wall), [0]]).astype(int)
    first, last = np.flatnonzero(np.diff(on) == 1), np.flatnonzero(np.diff(on) == -1) - 1
    return list(zip(history["time"][first], history["time"][last]))


def force(history, wall):
    """Magnitude of the wall's force [N], row by row."""
    return np.linalg.norm(history[f"wall/{wall}/force"], axis=1)


def energy(history):
    """Kinetic and elastic energy [J]."""
    return history["kinetic_energy"] + history["elastic_energy"]


def imbalance(history):
    """Largest energy imbalance, relative to the initial energy."""
    return np.abs(history["energy_imbalance"]).max() / energy(history)[0]


def run_with_fields(case, comm, folder):
    """Run a case; its history and the fields of its last snapshot, the same on all ranks."""
    history = run(case, folder, comm)
    fields = None
    if comm.rank == 0:
        result = open_result(folder)
        fields = {name: result.field(name, -1) for name in result.cell_fields}
    return history, comm.bcast(fields)


SCHEMES = [
    "central_differences",
    "chung_lee",
    "hulbert_chung",
    "noh_bathe",
    "newmark",
    "houbolt",
    "wilson",
    "generalized_alpha",
    "energy_momentum",
]
GRAVITY = 9.81
MIDDLE = [[0.2, -1.0, -1.0], [0.3, 1.0, 1.0]]


def case(integrator, *, step, steps, treatment="scheme", mass="lumped", mesh=None, walls=(), **more) -> Case:
    """Return the case of a rod, or of another mesh, with 1 kg/m."""
    return Case.from_dict(
        {
            "mesh": mesh or {"generator": "rod", "length": 1.0, "elements": 1},
            "material": {"default": {"young_modulus": 1e4, "density": 1.0}},
            "section": {"default": {"area": 1.0, "material": "default"}},
            "wall": [{"type": "plane", "name": f"wall{k}", **wall} for k, wall in enumerate(walls)],
            "contact": {"treatment": treatment},
            "time": {"integrator": integrator, "step": step, "end": step * steps, "mass": mass},
            "output": {"fields_every": 0},
            **more,
        }
    )


def unexplained(history) -> float:
    """Return the momentum not accounted for by impulses, relative to the largest impulse."""
    momentum = history["momentum"] - history["momentum"][0]
    names = [name for name in history if name.endswith(("_impulse", "/impulse"))]
    names = [name for name in names if not name.startswith("pair/")]  # they cancel
    left = momentum - sum(history[name] for name in names)
    return np.abs(left).max() / max(np.abs(history[name]).max() for name in names)


def floor(**more):
    """A wall below."""
    return {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], **more}
