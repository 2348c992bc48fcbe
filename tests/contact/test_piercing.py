"""Bars that walls pass through between their nodes are reported before the run, at snapshots, and at its end."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.contact.walls import cylinder, sphere
from pfem_petsc.preflight import warnings_before

SHAPES = {
    "sphere": {"type": "sphere", "point": [1.0, 0.0, 0.6], "radius": 0.4},
    "cylinder": {"type": "cylinder", "point": [1.0, 5.0, 0.6], "axis": [0.0, 1.0, 0.0], "radius": 0.4},
    "rectangle": {
        "type": "rectangle",
        "point": [1.0, 0.0, 0.6],
        "normal": [1.0, 0, 0.1],
        "along": [0, 1.0, 0],
        "size": [0.2, 0.3],
    },
}


def bar(shape, **keys):
    """One bar of 2 m along x, at whose middle a wall is aimed."""
    wall = {"name": "it", "velocity": [0.0, 0.0, -2.0], **SHAPES[shape], **keys}
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 2.0, "elements": 1},
            "node_set": {"start": {"indices": [0]}, "all": {"all": True}},
            "material": {"it": {"young_modulus": 1e6, "density": 1000.0}},
            "section": {"it": {"area": 1e-2, "material": "it"}},
            "support": [{"node_set": "all", "fix": "xyz"}],
            "wall": [wall, {"name": "far", "type": "plane", "point": [0, 0, -50.0], "normal": [0, 0, 1.0]}],
            "time": {"integrator": "central_differences", "step": 1e-2, "end": 0.6},
            "output": {"fields_every": 5},
        }
    )


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("shape", SHAPES)
def test_wall_that_flies_through_a_bar(shape, comm, shared_tmp_path, capfd):
    case = bar(shape)
    run = Simulation(case, comm, output=shared_tmp_path / "it", quiet=True)
    (told,) = [text for text in warnings_before(case, run.model, run.plan) if "only nodes touch walls" in text]
    width = "200.0 mm" if shape == "rectangle" else "800.0 mm"
    assert told.startswith(f"wall 'it' is {width} wide, and the bars of its nodes are up to 2.000 m long")
    assert run.run() == 0
    error = capfd.readouterr().err
    if comm.rank == 0:
        assert error.count("bar 0 intersects wall 'it'") == 1
        log = (shared_tmp_path / "it" / "log.txt").read_text()
        assert "wall 'it' was never touched by a node" in log
        assert "wall 'far' was never touched by a node" in log
        # at 2 m/s: within 0.3 m of the axis from 0.15 to 0.45 s, snapshots every 0.05 s; or for the rectangle's height
        seen = 7 if shape != "rectangle" else 3
        found = [line for line in log.splitlines() if "bars intersected wall 'it' in" in line]
        assert len(found) == 1
        count = int(found[0].split(" snapshots")[0].split()[-3])
        assert abs(count - seen) <= 2 and "of 13 snapshots" in found[0]


@pytest.mark.parametrize(
    "keys",
    [{"radius": 1.45, "point": [1.0, 0.0, 1.6]}, {"side": "inside", "radius": 3.0}],
    ids=["larger than the bar", "around the bar"],
)
def test_no_warning_of_walls_that_nodes_cannot_pass(keys, comm):
    run = Simulation(bar("sphere", **keys), comm, check_only=True)
    assert not any("only nodes touch" in text for text in warnings_before(run.case, run.model, run.plan))


def test_a_chord_of_a_wall_is_no_defect(comm, shared_tmp_path, capfd):
    """Short bars on a sphere, which touch it at their ends."""
    case = bar("sphere", radius=5.0, point=[1.0, 0.0, -5.2], velocity=[0.0, 0.0, 0.01], node_set="start").to_dict()
    run = Simulation(Case.from_dict(case), comm, output=shared_tmp_path / "it", quiet=True)
    assert run.run() == 0
    assert "only nodes touch walls" not in capfd.readouterr().err


@pytest.mark.parametrize("kind", [sphere, cylinder])
def test_deepest_places_against_sampling(kind):
    rng = np.random.default_rng(4)
    ends = rng.normal(size=(50, 2, 3))
    keys = {"axis": [0.6, 0.0, 0.8]} if kind is cylinder else {}
    keys |= {"name": "it", "type": kind.__name__.rpartition(".")[2], "point": [0.1, 0.0, 0.0], "radius": 0.7}
    wall = kind.Wall(kind.Parameters(**keys))
    part = np.linspace(0.0, 1.0, 4001)[:, None, None]
    gaps = wall.gaps((ends[:, 0] + part * (ends[:, 1] - ends[:, 0])).reshape(-1, 3)).reshape(len(part), -1)
    within = (gaps.argmin(axis=0) % 4000 > 0) & (gaps.min(axis=0) < 0.0)
    where, least = wall.deepest(ends)
    assert 5 < within.sum() < 50 and np.isinf(least[gaps.argmin(axis=0) % 4000 == 0]).all()
    np.testing.assert_allclose(least[within], gaps.min(axis=0)[within], atol=1e-5)
    np.testing.assert_allclose(where[within], part[gaps.argmin(axis=0)[within], 0, 0], atol=2e-3)
    np.testing.assert_array_equal(wall.crossed(ends[:, 0], ends[:, 1]), least < -0.25 * 0.7)
