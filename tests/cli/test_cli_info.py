"""Output of ``info`` about a result."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pfem_petsc.cli.results import describe
from pfem_petsc.output.units import TIME


def result(history, times=(0.0, 0.5, 1.0), **attributes):
    return SimpleNamespace(
        path=Path("rod/result.vtkhdf"),
        case=SimpleNamespace(title="A rod"),
        n_nodes=1234,
        n_bars=5,
        times=np.array(times),
        axis=TIME,
        place=TIME.place,
        n_modes=0,
        attributes=attributes,
        history={name: np.array(values) for name, values in history.items()},
    )


def test_summary():
    lines = describe(result({"time": [0.0, 2e-3]}, times=[0.0, 1e-3], ranks=2, petsc_options={}))
    assert lines[0] == "A rod"
    shown = {line.split()[0]: line.split(maxsplit=1)[1] for line in lines[1:6]}
    assert shown["mesh"] == "1,234 nodes, 5 bars"
    assert shown["ranks"] == "2"
    assert shown["snapshots"] == "2: 0 s to 1.000 ms"
    assert shown["history"] == "2 rows: 0 s to 2.000 ms"
    assert "petsc_options" not in "\n".join(lines)


def test_energies_and_their_balance():
    """Stored plus lost minus supplied, end minus start: (3 + 1 + 4) - (10) - (-1.5) - (0.5) = -1 J, of at most 20 J."""
    history = {
        "time": [0.0, 0.5, 1.0],
        "kinetic_energy": [10.0, 20.0, 3.0],
        "elastic_energy": [0.0, 1.0, 1.0],
        "plastic_dissipation": [0.0, 2.0, 4.0],
        "external_work": [0.0, 1.0, -1.5],
        "thermal_work": [0.0, 0.5, 0.5],
    }
    lines = describe(result(history))
    rows = {line.split()[0]: line.split() for line in lines}
    assert rows["kinetic_energy"][1:] == ["10.00", "J", "3.000", "J"]
    assert rows["balance"][1:] == ["error", "-1.000", "J", "(-5.0e-02", "of", "the", "largest)"]


def test_result_without_history():
    lines = describe(result({}, times=[]))
    assert any(line.split() == ["history", "0", "rows"] for line in lines)
    assert any(line.split() == ["snapshots", "0"] for line in lines)
    assert not any("balance" in line for line in lines)
