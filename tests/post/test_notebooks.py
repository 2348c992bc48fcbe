"""What notebooks show: tables."""

from __future__ import annotations

import re

import pytest
from mpi4py import MPI

from pfem_petsc import Case, InputError, Simulation, open_result


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "rod"
    case = Case.load("rod_impact", ["time.end=0.5"])
    with Simulation(case, MPI.COMM_SELF, output=folder, quiet=True) as simulation:
        simulation.run()
    return open_result(folder)


def test_history_as_a_table(result):
    table = result.table()
    assert table.n_rows == 51
    assert table["wall/wall/force.x"].tolist() == result.history["wall/wall/force"][:, 0].tolist()
    assert list(result.table(["wall/wall", "kinetic_energy"]))[:3] == ["step", "time", "wall/wall/contact_time"]
    probe = next(name for name in table if name.startswith("probe/"))
    assert re.fullmatch(r"probe/\w+/\w+\[0\]\.x", probe)
    with pytest.raises(InputError, match="no column 'kinetic_enrgy', did you mean 'kinetic_energy'"):
        result.table(["kinetic_enrgy"])
    assert result.grid(-1).n_cells == result.n_bars
