"""Motions that nothing resists are counted and named before the first increment, by a check and by a run, once."""

import numpy as np
import pytest
from helpers.small_models import TRUSSES

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.cli.main import main
from pfem_petsc.errors import SimulationFailure

PLANE = """\
[mesh]
generator = "arrays"
points = [[0,0,0],[4,0,0],[2,0,1.5]]
bars = [[0,1],[1,2],[0,2]]
[node_set]
feet = { indices = [0, 1] }
apex = { indices = [2] }
[material.steel]
young_modulus = 210e9
density = 7850.0
[section.all]
area = 5e-4
material = "steel"
[[support]]
node_set = "feet"
fix = "xyz"
[[load]]
node_set = "apex"
force = [0.0, 0.0, -1000.0]
[static]
step = 1.0
"""
SUPPORT = '[[support]]\nnode_set = "apex"\nnormal = [0.1, 1.0, 0.2]\n'


def static(points, bars, fixed, **method):
    """A truss under loads on its last node, in a static analysis by a factorisation."""
    data = {
        "node_set": {"fixed": {"indices": fixed or [0]}, "last": {"indices": [len(points) - 1]}},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [{"node_set": "fixed", "fix": "xyz" if fixed else "x"}],
        "load": [{"node_set": "last", "force": [1.0, 2.0, 3.0]}],
        "static": {"step": 1.0, **method},
        "output": {"fields_every": 0},
    }
    return Case(data, mesh=Truss(np.array(points, dtype=float), bars))


@pytest.mark.parallel
@pytest.mark.parametrize("name", ["hinged square", "tetrahedron", "cube of edges", "square with a whip"])
def test_as_many_motions_as_counted_by_hand(name, comm):
    """Of Maxwell's count: free components less bars, and states of self-stress."""
    points, bars, fixed, (*_, self_stresses, _) = TRUSSES[name]
    free = 3 * (len(points) - len(fixed)) - (0 if fixed else 1)
    rank = len(bars) - self_stresses
    with Simulation(static(points, bars, fixed), comm, check_only=True) as simulation:
        text = simulation.obstacle()
    count = free - rank
    assert f"leaves {min(count, 8)}{' or more' * (count >= 8)} motion{'s' * (count > 1)} free" in text


@pytest.mark.parallel
@pytest.mark.parametrize("method", ["newton", "arc_length"])
def test_a_run_ends_at_once(method, comm, shared_tmp_path):
    """Without halving the increment; the message is that of the check."""
    points, bars, fixed, _ = TRUSSES["hinged square"]
    case = static(points, bars, fixed, method=method, **({"max_points": 3} if method == "arc_length" else {}))
    simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
    named = simulation.obstacle()
    with simulation, pytest.raises(SimulationFailure) as failure:
        simulation.run()
    assert str(failure.value) == named
    assert "halving" not in (shared_tmp_path / "out" / "log.txt").read_text()


def test_a_check_refuses_the_plane_truss_that_is_free_across(tmp_path, capsys):
    """Status 2 with the node and its direction; with a roller that is no axis, which stops it, the case can run."""
    (tmp_path / "free.toml").write_text(PLANE)
    (tmp_path / "held.toml").write_text(PLANE + SUPPORT)
    assert main(["check", str(tmp_path / "free.toml")]) == 2
    out, err = capsys.readouterr()
    assert "This case can run" not in out and "1 free directions out of it" in out
    assert err.count("node 2 along (0, 1, 0)") == 1
    assert "can move freely" not in out + err
    assert main(["check", str(tmp_path / "held.toml")]) == 0
    assert "This case can run" in capsys.readouterr()[0]
