"""Output of ``info`` about a result."""

from pathlib import Path

import numpy as np

from pfem_petsc import Case
from pfem_petsc.cli.results import describe
from pfem_petsc.output.result import Result


class Given(Result):
    """A result of some arrays, without a file."""

    history = None

    def __init__(self, history, times=(0.0, 0.5, 1.0), **attributes):
        self.path, self.case = Path("rod/result.vtkhdf"), Case.load("rod_impact", ["title=A rod"])
        self.n_nodes, self.n_bars, self.n_modes, self.times = 1234, 5, 0, np.array(times)
        self.attributes, self._static_stages = attributes, []
        self.history = {name: np.array(values) for name, values in history.items()}
        self._n_rows = len(self.history.get("time", ()))
        self.history.setdefault("step", np.arange(self._n_rows))

    def positions(self, i):
        return np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.5]])


def test_summary():
    lines = describe(Given({"time": [0.0, 2e-3]}, times=[0.0, 1e-3], ranks=2, petsc_options={}))
    assert lines[0] == "A rod"
    shown = {
        line.split()[0]: line.split(maxsplit=1)[1] for line in lines[1:] if line.startswith("  ") and " " in line[2:]
    }
    assert shown["mesh"] == "1,234 nodes, 5 bars"
    assert shown["extent"] == "2.000 m × 0 m × 500.0 mm"
    assert shown["ranks"] == "2"
    assert shown["snapshots"] == "2: 0 s to 1.000 ms"
    assert shown["history"] == "2 rows: 0 s to 2.000 ms"
    assert "petsc_options" not in "\n".join(lines)


def test_energies_and_their_balance():
    """Stored plus lost minus supplied, since the start: 20 + 1 + 2 - 0.5 - 1 - 0.5 - 10 = 11 J, of at most 20 J."""
    history = {
        "time": [0.0, 0.5, 1.0],
        "kinetic_energy": [10.0, 20.0, 3.0],
        "elastic_energy": [0.0, 1.0, 1.0],
        "plastic_dissipation": [0.0, 2.0, 4.0],
        "numerical_dissipation": [0.0, -0.5, -0.1],
        "external_work": [0.0, 1.0, -1.5],
        "thermal_work": [0.0, 0.5, 0.5],
    }
    rows = {line[2:].split("  ")[0]: line.split("  ")[-1].strip() for line in describe(Given(history))}
    assert rows["kinetic energy"] == "10.00 J at the start, largest 20.00 J, 3.000 J at the end"
    assert rows["numerical dissipation"] == "0 J at the start, largest -500.0 mJ, -100.0 mJ at the end"
    assert rows["balance error"] == "11.00 J (5.5e-01 of the largest energy)"


def test_result_without_history():
    lines = describe(Given({}, times=[]))
    assert any(line.split() == ["history", "0", "rows"] for line in lines)
    assert any(line.split() == ["snapshots", "0"] for line in lines)
    assert not any("balance" in line for line in lines)
