"""The same run on one rank and on all: positions, histories and the structure of the result files."""

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.output.result import open_result

pytestmark = pytest.mark.parallel

LATTICE = [
    "mesh.cells=[5, 4, 3]",
    "node_set.foot.box=[[-1.0, -1.0, -1e-6], [1.0, 1.0, 1e-6]]",
    "node_set.top.nearest=[0.05, 0.04, 0.03]",
    "time.end=1e-4",
    "output.precision='float64'",
]
CASES = {
    "rod_impact": (["time.end=2.6"], ["time.integrator=newmark"], 1.0),
    "ring_impact": (["time.end=0.04", "time.step=2e-4"], ["time.integrator=newmark", "time.step=5e-4"], 45.0),
    "lattice_drop": (LATTICE, ["time.integrator=newmark", "time.step=2e-6"], 0.05),
}


def structure(path):
    """Name, shape and type of everything in a file but what the run says about itself."""
    found = {}
    with h5py.File(path, "r") as file:
        file.visititems(
            lambda name, item: found.update({name: (getattr(item, "shape", ()), str(getattr(item, "dtype", "")))})
        )
    return {name: value for name, value in found.items() if not name.startswith("case")}


def end_of(case, folder, comm):
    """Final positions and the structure of the file, on every rank. Collective."""
    Simulation(case, comm, output=folder, quiet=True).run()
    found = None
    if comm.rank == 0:
        result = open_result(folder)
        history = {name: result.history[name] for name in result.history}
        found = result.positions(-1), result.bars, history, structure(result.path)
    return comm.bcast(found)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
@pytest.mark.parametrize("name", CASES)
def test_run_on_all_ranks_is_the_run_on_one(name, scheme, comm, shared_tmp_path):
    both, implicit, size = CASES[name]
    keys = [*both, *(implicit if scheme == "newmark" else []), "solver.rtol=1e-13", "output.fields_every=20"]
    case = Case.load(name, keys)
    positions, bars, history, tree = end_of(case, shared_tmp_path / "all", comm)
    alone = None
    if comm.rank == 0:
        alone = end_of(case, shared_tmp_path / "one", MPI.COMM_SELF)
    alone = comm.bcast(alone)
    assert np.abs(positions - alone[0]).max() < 1e-10 * size
    assert np.abs(positions - positions.mean(axis=0)).max() > 0.3 * size
    assert np.array_equal(bars, alone[1])
    assert tree == alone[3]
    for column in ("active_contacts", "step"):
        assert np.array_equal(history[column], alone[2][column]), column
    for column in ("kinetic_energy", "elastic_energy", "external_work", "contact_work", "plastic_dissipation"):
        start = alone[2]["kinetic_energy"][0]
        assert np.abs(history[column] - alone[2][column]).max() < 1e-9 * start, column
    assert history["active_contacts"].max() > 0
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * history["kinetic_energy"][0]
