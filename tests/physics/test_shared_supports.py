"""Components that several supports prescribe: they agree or are refused, and hold until the last of them is removed."""

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import in_time
from scipy.spatial.transform import Rotation

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.errors import InputError

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.8]], dtype=float)
BARS = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]]
TURN = Rotation.from_rotvec([0.4, -0.9, 0.7]).as_matrix()
FORCE = np.array([1.0, 0.5, -2.0])
RISE = [[0.0, 0.0, 0.0, 0.0], [0.004, 0.0, 0.0, 0.01]]
OF_FACTOR = [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.01]]
ANALYSES = {
    "newton": {"static": {"step": 0.25}},
    "relaxation": {"static": {"step": 0.25, "method": "relaxation"}},
    "explicit": in_time("central_differences", step=2e-4, end=4e-3),
    "implicit": in_time("generalized_alpha", step=2e-4, end=4e-3),
}


def tripod(analysis, turn=None, guide_first=False, motion=None, guide="x", **tables):
    """A tripod with feet fixed by one support and a guide of a foot and of the top by another, which is removed."""
    frame, turn = ({}, np.eye(3)) if turn is None else ({"frame": turn.T[:2].tolist()}, turn)
    rows = {} if motion is None else {"motion": [[row[0], *(turn @ row[1:])] for row in np.array(motion)]}
    feet = {"name": "feet", "node_set": "feet", "fix": "xyz", **frame, **rows}
    guided = {"name": "guide", "node_set": "guide", "fix": guide, **frame}
    time = 2e-3 if "time" in analysis else 0.5
    data = {
        "node_set": {"feet": {"indices": [0, 1, 2]}, "guide": {"indices": [0, 3]}, "all": {"all": True}},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [guided, feet] if guide_first else [feet, guided],
        "load": [{"node_set": "top", "force": (turn @ FORCE).tolist()}],
        "remove": [{"supports": "guide", "time": time}],
        "output": {"fields_every": 0, "probe": [{"name": "all", "node_set": "all"}]},
        "solver": {"rtol": 1e-13},
        **analysis,
        **tables,
    }
    data["node_set"]["top"] = {"indices": [3]}
    return Case(data, mesh=Truss(POINTS @ turn.T, BARS))


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("guide_first", [False, True])
@pytest.mark.parametrize(
    "name, motion",
    [*((name, None) for name in ANALYSES), ("newton", OF_FACTOR), ("explicit", RISE), ("implicit", RISE)],
)
def test_a_foot_stays_when_its_guide_goes(name, motion, guide_first, comm, shared_tmp_path):
    """The foot has the prescribed displacement to the end, turned supports give the turned answer, and the top, which
    the guide alone held, is free of it: in equilibrium the answer is that without a guide."""
    analysis = ANALYSES[name]
    plain = run(tripod(analysis, None, guide_first, motion), shared_tmp_path / "plain", comm)
    turned = run(tripod(analysis, TURN, guide_first, motion), shared_tmp_path / "turned", comm)
    place = plain["probe/all/position"]
    lift = 0.01 if motion else 0.0
    np.testing.assert_allclose(place[-1, :3], POINTS[:3] + [0.0, 0.0, lift], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(place[:, :3, :2] - POINTS[:3, :2], 0.0, atol=1e-15)
    assert abs(place[-1, 3, 0] - POINTS[3, 0]) > 1e-6
    for column in ("position", "reaction"):
        back = turned[f"probe/all/{column}"] @ TURN
        np.testing.assert_allclose(back, plain[f"probe/all/{column}"], rtol=0.0, atol=1e-8)
    if "static" in analysis:
        alone = [{"name": "feet", "node_set": "feet", "fix": "xyz", **({"motion": motion} if motion else {})}]
        free = run(tripod(analysis, support=alone, remove=[]), shared_tmp_path / "free", comm)
        np.testing.assert_allclose(place[-1], free["probe/all/position"][-1], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(plain["probe/all/reaction"][-1].sum(axis=0), -FORCE, atol=1e-7)


@pytest.mark.parametrize("turn", [None, TURN])
@pytest.mark.parametrize("order", [("feet", "guide"), ("guide", "feet")])
def test_a_reaction_is_released_with_the_last_support(order, turn, comm, tmp_path):
    """The x reaction R of a foot goes when both of its supports are gone, and does so over a duration:
    at half of it, R / 2 acts as a load, which the feet that are left take."""
    frame = {} if turn is None else {"frame": turn.T[:2].tolist()}
    back = np.eye(3) if turn is None else turn
    one = [
        {"name": "feet", "node_set": "foot", "fix": "x", **frame},
        {"name": "guide", "node_set": "foot", "fix": "x", **frame},
        {"node_set": "foot", "fix": "yz", **frame},
        {"node_set": "others", "fix": "xyz", **frame},
    ]
    first, second = ({"supports": name, "time": time, "duration": 0.5} for name, time in zip(order, (0.25, 0.5)))
    case = tripod(
        {"static": {"step": 0.125}},
        turn,
        support=one,
        remove=[first, second],
        node_set={
            "foot": {"indices": [0]},
            "others": {"indices": [1, 2]},
            "top": {"indices": [3]},
            "all": {"all": True},
        },
        load=[{"node_set": "top", "force": (back @ FORCE).tolist(), "table": [[0.0, 1.0], [1.0, 1.0]]}],
    )
    history = run(case, tmp_path / "out", comm)
    factor, place = history["load_factor"], history["probe/all/position"] @ back
    sums = history["probe/all/reaction"].sum(axis=1) @ back
    held = factor < 0.5
    assert held.any()
    np.testing.assert_allclose(place[held, 0], np.broadcast_to(POINTS[0], place[held, 0].shape), atol=1e-14)
    reaction = (history["probe/all/reaction"][held] @ back)[-1, 0, 0]
    at = np.flatnonzero(np.isclose(factor, 0.75))[0]
    np.testing.assert_allclose(sums[at], -FORCE - [0.5 * reaction, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(sums[-1], -FORCE, atol=1e-6)


@pytest.mark.parametrize("turn", [None, TURN])
@pytest.mark.parametrize("guide_first", [False, True])
def test_motions_of_shared_components_agree(guide_first, turn, comm, tmp_path):
    """Rest and a motion along the component that both prescribe is refused in any order; equal motions are not."""
    with pytest.raises(InputError, match="node 0 is already prescribed by an earlier support with another motion"):
        case = tripod(ANALYSES["newton"], turn, guide_first, OF_FACTOR, guide="z")
        Simulation(case, comm, tmp_path / "refused", quiet=True)
    case = tripod(ANALYSES["newton"], turn, guide_first, OF_FACTOR, guide="z").to_dict()
    rows = next(entry for entry in case["support"] if entry["name"] == "feet")["motion"]
    entry = next(entry for entry in case["support"] if entry["name"] == "guide")
    entry["motion"] = rows
    history = run(Case(case), tmp_path / "out", comm)
    place = history["probe/all/position"] @ (np.eye(3) if turn is None else turn)
    np.testing.assert_allclose(place[-1, :3], POINTS[:3] + [0.0, 0.0, 0.01], rtol=0.0, atol=1e-14)
