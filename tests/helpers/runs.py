"""Runs of cases and quantities from their histories."""

from __future__ import annotations

import tempfile

import numpy as np
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.output.result import open_result


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
