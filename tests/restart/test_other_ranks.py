"""Restarts on another number of ranks, with another distribution of nodes."""

import numpy as np
import pytest
from helpers.stopped import CASES, everywhere, simulate
from mpi4py import MPI

from pfem_petsc import open_result


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", ["central differences", "houbolt", "plastic lattice", "newmark"])
def test_restart_on_another_number_of_ranks(comm, shared_tmp_path, name):
    """Written by one rank, continued by all, and the other way round."""
    case, overrides = CASES[name]
    whole = shared_tmp_path / "whole"
    simulate(case, overrides, whole, comm)
    for first, then in ((MPI.COMM_SELF, comm), (comm, MPI.COMM_SELF)):
        folder = shared_tmp_path / f"stopped-{first == comm}"
        if comm.rank == 0 or first == comm:
            simulate(case, overrides, folder, first, stop_after=33)
        comm.Barrier()
        if comm.rank == 0 or then == comm:
            simulate(case, overrides, folder, then, restart=True)
        comm.Barrier()
        apart = everywhere(comm, _far, whole, folder)
        assert apart == {}


def _far(one, other):
    """Columns of the history that differ by more than 1e-10 of their largest value; energies by all energies."""
    found = {}
    with open_result(one) as a, open_result(other) as b:
        np.testing.assert_array_equal(a.history["step"], b.history["step"])
        np.testing.assert_array_equal(a.steps, b.steps)
        energy = np.abs(a.history["kinetic_energy"]).max() + np.abs(a.history["elastic_energy"]).max()
        momentum = np.abs(a.history["momentum"]).max()
        for name in a.history:
            x, y = np.asarray(a.history[name], dtype=float), np.asarray(b.history[name], dtype=float)
            scale = np.abs(x).max()
            if name.endswith(("_work", "_dissipation", "_imbalance", "_energy", "_heat")):
                scale = energy
            if name == "angular_momentum":
                scale = max(scale, momentum)
            if np.abs(x - y).max() > 1e-10 * scale:
                found[name] = (np.abs(x - y).max(), scale)
        for i in range(len(a.times)):
            if np.abs(a.positions(i) - b.positions(i)).max() > 1e-10 * np.abs(a.positions(i)).max():
                found[f"positions {i}"] = i
    return found
