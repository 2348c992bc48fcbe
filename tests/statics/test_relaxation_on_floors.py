"""Dynamic relaxation against walls."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cables import chain, run

from pfem_petsc import Case

pytestmark = pytest.mark.parallel


@pytest.mark.slow
@pytest.mark.parametrize("newton", [True, False])
def test_a_net_lies_down_on_a_floor(comm, shared_tmp_path, newton):
    """The floor and the corners bear the weight; nodes are on the floor or above it."""
    keys = ["mesh.cells=[4, 4]",
            "wall=[{name='floor', type='plane', point=[0.0, 0.0, -2.0], normal=[0.0, 0.0, 1.0]}]",
            "material.rope.young_modulus=1e7", f"static.newton={str(newton).lower()}"]  # fmt: skip
    row, x = run(Case.load("hanging_net", keys), comm, shared_tmp_path / "out")
    weight = 1000.0 * 1e-4 * 9.81 * 2 * 5 * 10.0
    assert x[:, 2].min() > -2.0 - 1e-11
    down = x[:, 2] < -2.0 + 1e-9
    assert 1 <= down.sum() == row["active_contacts"] < 21
    floor = row["wall/floor/force"]
    # Newton's method begins with the nodes on the floor where the relaxed ones are, not with those at the start
    assert (0 < row["newton_iterations"] < 10) == newton
    assert 0.05 * weight < floor[2] == pytest.approx(weight - row["support_force"][2], rel=1e-7)
    assert np.abs(floor[:2]).max() < 1e-9


@pytest.mark.slow
def test_chain_that_rests_on_a_floor(comm, shared_tmp_path):
    """A mooring line, anchor and part of it on the floor, beside pycatenary 1.0.0 (scripts/peers/run_pycatenary.py).

    ``MooringLine(L=6.98, w=1.036, EA=5600.0, anchor=[0, 0, 0], fairlead=[5.2, 1, 2.65], floor=True)`` has the
    horizontal and vertical tension at the fairlead and the length on the floor below. The reaction there bears half of
    the last bar's weight, as the end of a cable does.
    """
    horizontal, vertical, lying = 0.7530436, 3.4154658, 3.6832184
    n, top = 60, np.array([5.2, 1.0, 2.65])
    points = np.outer(np.linspace(0.0, 1.0, n + 1), [6.98, 0.0, 0.0])
    case = chain(
        shared_tmp_path,
        comm,
        points,
        material={"m": {"young_modulus": 5600e4, "density": 1.036 / 9.81e-4}},
        support=[
            {"node_set": "at0", "fix": "xyz"},
            {"node_set": f"at{n}", "fix": "xyz", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, *(top - points[-1])]]},
        ],
        gravity=-9.81,
        wall=[{"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}],
    )
    row, x = run(case, comm, shared_tmp_path / "out")
    anchor, fairlead = row["probe/ends/reaction"]
    assert np.hypot(*anchor[:2]) == pytest.approx(horizontal, rel=1e-3)
    assert np.hypot(*fairlead[:2]) == pytest.approx(horizontal, rel=1e-3)
    assert fairlead[2] == pytest.approx(vertical, rel=1e-3)
    assert (x[1:, 2] < 1e-9).sum() * 6.98 / n == pytest.approx(lying, abs=6.98 / n)
    assert fairlead[:2] / np.hypot(*fairlead[:2]) == pytest.approx(top[:2] / np.hypot(*top[:2]), abs=1e-6)
