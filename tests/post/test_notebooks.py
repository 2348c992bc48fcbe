"""What notebooks show: tables and curves during a run."""

from __future__ import annotations

import io
import re
import sys
import types

import pytest
from mpi4py import MPI

from pfem_petsc import Case, InputError, LivePlot, Simulation, open_result


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
    fake.HTML, fake.display, fake.Image = str, display, lambda data: data
    ipython = types.ModuleType("IPython")
    ipython.version_info = (9, 0)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", fake)
    cell = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})()
    return cell, shown


def test_live_plot(notebook, tmp_path, monkeypatch):
    cell, shown = notebook
    monkeypatch.setattr(sys, "stdout", cell)
    case = Case.load("rod_impact", ["time.end=0.3"])
    plot = LivePlot("kinetic_energy", "momentum", interval=0.0, file=tmp_path / "live.png")
    with Simulation(case, MPI.COMM_SELF, output=tmp_path / "out", quiet=True) as simulation:
        simulation.on_step(plot, every=10)
        simulation.run()
    assert plot.times == pytest.approx([0.1, 0.2, 0.3]) and len(shown) == 3
    history = open_result(tmp_path / "out").history
    assert plot.columns["kinetic_energy"] == history["kinetic_energy"][[10, 20, 30]].tolist()
    assert list(plot.columns) == ["kinetic_energy", "momentum.x", "momentum.y", "momentum.z"]
    assert (tmp_path / "live.png").read_bytes() == shown[-1] == plot._repr_png_()
    with (
        Simulation(case, MPI.COMM_SELF, output=tmp_path / "bad", quiet=True) as simulation,
        pytest.raises(InputError, match="LivePlot: the history has no column kinetic_enrgy, did you mean"),
    ):
        simulation.on_step(LivePlot("kinetic_enrgy"))
        simulation.run()
