"""A result file as a mesh: its last snapshot, which is told."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.cli.main import main
from pfem_petsc.formats import read_whole


@pytest.mark.slow
def test_the_last_snapshot_is_converted(tmp_path, capsys):
    """A bar of E A = 1e5 N under 100 N is strained by 1e-3."""
    data = {
        "node_set": {"foot": {"indices": [0]}, "tip": {"indices": [1]}},
        "material": {"m": {"young_modulus": 1e9, "density": 1.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "support": [{"node_set": "foot", "fix": "xyz"}, {"node_set": "tip", "fix": "yz"}],
        "load": [{"node_set": "tip", "force": [100.0, 0.0, 0.0]}],
        "static": {"step": 0.25},
        "output": {"fields_every": 1},
    }
    Simulation(Case(data, mesh=Truss([[0, 0, 0], [1, 0, 0]], [[0, 1]])), output=tmp_path / "out", quiet=True).run()
    result = tmp_path / "out" / "result.vtkhdf"
    assert main(["mesh", "convert", str(result), str(tmp_path / "last_bars.csv")]) == 0
    assert "has 5 snapshots: the mesh and its fields are those of the last one" in capsys.readouterr().out
    mesh = read_whole(tmp_path / "last_bars.csv")
    np.testing.assert_allclose(mesh.points[:, 0], [0.0, 1.001], rtol=1e-12)
    np.testing.assert_allclose(mesh.bar_fields["axial_force"], 100.0, rtol=1e-9)
