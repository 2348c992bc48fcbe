"""Inclined supports against closed forms, and refusals."""

import copy

import numpy as np
import pytest
from helpers.runs import run
from helpers.small_models import SCHEMES, case_of, in_time

from pfem_petsc import Case
from pfem_petsc.errors import InputError


@pytest.mark.parametrize("integrator", SCHEMES)
def test_block_on_an_incline(integrator, comm, shared_tmp_path):
    """A bar slides down a plane: a = g sin b along it, reactions m g cos b across it."""
    b, g, mass = np.radians(25.0), 9.81, 0.3 * 1e-3 * 500.0
    normal = [-np.sin(b), 0.0, np.cos(b)]
    down = np.array([-np.cos(b), 0.0, -np.sin(b)])
    case = case_of(
        shared_tmp_path,
        comm,
        [[0, 0, 0], [0.3 * down[0], 0, 0.3 * down[2]]],
        [[0, 1]],
        node_set={"all": {"all": True}},
        material={"m": {"young_modulus": 1e6, "density": 500.0}},
        section={"s": {"area": 1e-3, "material": "m"}},
        support=[{"node_set": "all", "normal": normal}, {"node_set": "all", "fix": "y"}],
        gravity={"acceleration": [0.0, 0.0, -g]},
        output={"fields_every": 0},
        solver={"rtol": 1e-13},
        **in_time(integrator, step=1e-3, end=0.2),
    )
    history = run(case, shared_tmp_path / "out", comm)
    t = history["time"][:, None]
    way = 0.5 * g * np.sin(b) * t**2 * down
    loose = {"newmark": 0, "souza_moura": 0.02, "houbolt": 0.02}.get(integrator, 0) + 1e-9
    assert np.abs(history["centre_of_mass"] - history["centre_of_mass"][0] - way).max() < loose
    reactions = mass * g * np.cos(b) * np.array(normal)
    assert np.abs(history["support_force"][2:] - reactions).max() < 1e-10 * mass * g
    gained = history["momentum"] - history["support_impulse"] - history["external_impulse"]
    assert np.abs(gained).max() < 1e-11 * mass * g
    assert np.abs(history["energy_imbalance"]).max() < 1e-12 * history["external_work"].max()
    assert np.abs(history["external_work"] - mass * g * np.sin(b) * np.linalg.norm(way, axis=1)).max() < loose + 1e-9


@pytest.mark.parallel
def test_three_bars_on_an_inclined_roller(comm, shared_tmp_path):
    """A triangle on a hinge A and a roller B on a plane inclined by b, under P at C: by hand, moments about A."""
    b, load = np.radians(30.0), 1000.0
    ends = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [1.0, 0.0, 2.0]])
    case = case_of(
        shared_tmp_path,
        comm,
        ends,
        [[0, 1], [1, 2], [0, 2]],
        node_set={name: {"indices": [k]} for k, name in enumerate("ABC")} | {"all": {"all": True}},
        support=[
            {"node_set": "all", "fix": "y"},
            {"node_set": "A", "fix": "xz"},
            {"node_set": "B", "normal": [-np.sin(b), 0.0, np.cos(b)]},
        ],
        load=[{"node_set": "C", "force": [0.0, 0.0, -load]}],
        output={"fields_every": 0, "probe": [{"name": "all", "node_set": "all"}]},
        solver={"rtol": 1e-13},
        static={"step": 1.0},
    )
    probe = run(case, shared_tmp_path / "out", comm)
    x, r = probe["probe/all/position"][-1], probe["probe/all/reaction"][-1]
    normal = np.array([-np.sin(b), 0.0, np.cos(b)])
    assert abs((x[1] - ends[1]) @ normal) < 1e-15 and np.linalg.norm(x[1] - ends[1]) > 1e-5
    lever = x - x[0]
    force = load * lever[2, 0] / (lever[1, 0] * normal[2] - lever[1, 2] * normal[0])
    assert np.abs(r[1] - force * normal).max() < 1e-9 * load
    assert np.abs(r[0] - [force * np.sin(b), 0.0, load - force * np.cos(b)]).max() < 1e-9 * load


def test_directions_of_several_supports_at_a_node(comm, shared_tmp_path):
    """Two oblique rollers that move: the node follows both."""
    one, two = np.array([1.0, 2.0, 0.0]), np.array([0.0, 1.0, 1.0])
    case = case_of(
        shared_tmp_path,
        comm,
        [[0, 0, 0], [1, 0, 0]],
        [[0, 1]],
        node_set={"a": {"indices": [0]}, "b": {"indices": [1]}},
        support=[
            {"node_set": "a", "fix": "xyz"},
            {"node_set": "b", "normal": one.tolist(), "velocity": [0.3, 0.0, 0.0]},
            {"node_set": "b", "normal": two.tolist(), "motion": [[0, 0, 0, 0], [0.1, 0, 0, 0.2]]},
        ],
        output={"fields_every": 0, "probe": [{"name": "b", "node_set": "b"}]},
        solver={"rtol": 1e-14},
        **in_time("newmark", step=0.01, end=0.1),
    )
    history = run(case, shared_tmp_path / "out", comm)
    moved = history["probe/b/position"][:, 0] - [1.0, 0.0, 0.0]
    assert np.abs(moved @ one - 0.3 * history["time"]).max() < 1e-14
    assert abs(moved[-1] @ two - 0.2) < 1e-14
    assert np.abs(history["energy_imbalance"]).max() < 1e-10 * np.abs(history["external_work"]).max()


ROLLER = {"node_set": "end", "normal": [1.0, 1.0, 0.0]}
REFUSED = {
    "both": ({"support": [{**ROLLER, "fix": "x"}]}, "exactly one of the keys fix, normal"),
    "neither": ({"support": [{"node_set": "end"}]}, "exactly one of the keys fix, normal"),
    "nothing": ({"support": [{"node_set": "end", "normal": [0.0, 0.0, 0.0]}]}, "zero length"),
    "flat": ({"support": [{"node_set": "end", "fix": "x", "frame": [[1.0, 0, 0], [2.0, 0, 0]]}]}, "parallel"),
    "loose": ({"support": [{**ROLLER, "frame": [[1.0, 0, 0], [0, 1.0, 0]]}]}, "expected the key fix"),
    "across": ({"support": [{**ROLLER, "velocity": [1.0, -1.0, 3.0]}]}, "no component along normal"),
    "twice": (
        {"support": [{"node_set": "end", "fix": "xy"}, {**ROLLER, "velocity": [1.0, 0.0, 0.0]}]},
        "support[1]: a direction of node 1 is already prescribed",
    ),
    "wall": (
        {"support": [ROLLER], "wall": [{"type": "plane", "point": [0, 0, -1.0], "normal": [0, 0, 1.0], "name": "w"}]},
        "wall 'w': a [[support]] prescribes a direction that is not an axis at node 1",
    ),
    "pair": (
        {
            "support": [ROLLER],
            "contact_pair": [{"name": "p", "first": "start", "second": "end", "direction": [1.0, 0, 0]}],
        },
        "contact_pair, constraint: a [[support]] prescribes a direction that is not an axis at node 1",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name, comm, shared_tmp_path):
    tables, words = REFUSED[name]
    with pytest.raises(InputError) as caught:
        case = Case.from_dict(
            {
                "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
                "node_set": {"start": {"group": "start"}, "end": {"group": "end"}},
                "material": {"m": {"young_modulus": 1e6, "density": 500.0}},
                "section": {"s": {"area": 1e-3, "material": "m"}},
                "time": {"integrator": "central_differences", "step": 1e-4, "end": 1e-2},
                **copy.deepcopy(tables),
            }
        )
        run(case, shared_tmp_path / "out", comm)
    assert words in str(caught.value)
