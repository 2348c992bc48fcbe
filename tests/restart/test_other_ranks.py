"""Restarts on another number of ranks, with another distribution of nodes."""

import numpy as np
import pytest
from helpers.stopped import CASES, everywhere, request_stop, simulate
from mpi4py import MPI

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import EarlyStop


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


@pytest.mark.parallel
def test_state_comes_back_to_the_last_bit_with_nodes_elsewhere(comm, shared_tmp_path):
    """One rank writes a yielding lattice, all read it: nodal arrays and plastic strains are the same numbers."""
    case, overrides = CASES["plastic lattice"]
    folder = shared_tmp_path / "lattice"
    before = {}
    if comm.rank == 0:
        first = Simulation(Case.load(case, overrides), MPI.COMM_SELF, output=folder, quiet=True)
        request_stop(first, 60)
        with pytest.raises(EarlyStop):
            first.run()
        before = _by_number(first, MPI.COMM_SELF)
        assert np.abs(before["plastic_strain"]).max() > 1e-6
    before = comm.bcast(before)
    again = Simulation(Case.load(case, overrides), comm, output=folder, quiet=True, restart=True)
    again.start()
    after = _by_number(again, comm)
    again._finish("stopped")
    assert before.keys() == after.keys()
    for name in before:
        assert before[name].tobytes() == after[name].tobytes(), name


def _by_number(simulation, comm):
    """Nodal arrays and plastic strains in mesh numbering, checked to be equal where a bar is on two ranks."""
    mesh, state = simulation.mesh, simulation.state
    owned = mesh.n_owned
    found = {}
    arrays = {"x": state.position, "v": state.v, "a": state.a, "f": state.f[:owned], "contact": state.contact}
    for name, array in {**arrays, **state.memory}.items():
        whole = np.zeros((mesh.n_nodes, 3))
        whole[mesh.node_ids[:owned]] = array
        found[name] = comm.allreduce(whole)
    strain = simulation.model.bars.fields(state.x)["plastic_strain"]
    low, high = np.full(mesh.n_bars, np.inf), np.full(mesh.n_bars, -np.inf)
    low[mesh.bar_ids] = high[mesh.bar_ids] = strain
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    np.testing.assert_array_equal(low, high)
    found["plastic_strain"] = low
    return found
