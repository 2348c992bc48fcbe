"""What notebooks show: tables and progress."""

from __future__ import annotations

import io
import re
import sys
import types

import pytest
from mpi4py import MPI

from pfem_petsc import Case, InputError, Simulation, open_result
from pfem_petsc.output import bar
from pfem_petsc.output.progress import Progress


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
    with pytest.raises(InputError, match="has no kinetic_enrgy, did you mean 'kinetic_energy'"):
        result.table(["kinetic_enrgy"])
    assert result.grid(-1).n_cells == result.n_bars


class Handle:
    def __init__(self, shown):
        self.shown = shown

    def update(self, thing):
        self.shown.append(thing)


@pytest.fixture
def notebook(monkeypatch):
    """The output of a cell, and what is displayed below it."""
    shown: list[object] = []

    def display(thing, display_id=False):
        shown.append(thing)
        return Handle(shown)

    fake = types.ModuleType("IPython.display")
    fake.HTML, fake.display = str, display
    ipython = types.ModuleType("IPython")
    ipython.version_info = (9, 0)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", fake)
    cell = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})()
    return cell, shown


def test_progress_in_a_notebook_is_one_bar(notebook):
    cell, shown = notebook
    now = [0.0]
    progress = Progress(MPI.COMM_SELF, "A <rod>", 1000, 1.0, stream=cell, clock=lambda: now[0])
    assert bar.is_notebook(cell) and not bar.is_notebook(io.StringIO())
    progress.summary({"nodes": "3"})
    for step in range(1, 1001):
        now[0] += 0.05
        progress.update(step, step / 1000, 1e-3)
    progress.close()
    # fifty seconds of the run within a moment: redrawn at its start and its end
    assert 2 <= len(shown) <= 4 and "100 %" in shown[-1] and "A &lt;rod&gt;" in shown[-1]
    assert "nodes" not in cell.getvalue() and cell.getvalue().count("\n") == 1
    assert "done: 1,000 steps" in cell.getvalue()
