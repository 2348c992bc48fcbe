"""Bars and supports that are removed: peaks, static answers, energies, stages, restarts."""

import numpy as np
import pytest
from helpers.kills import differences
from helpers.runs import run
from helpers.small_models import AREA, MATERIAL, YOUNG
from helpers.stopped import assert_restart_is_bitwise
from mpi4py import MPI

from pfem_petsc import Case, Simulation, write_mesh
from pfem_petsc.errors import InputError

HEIGHT = 2.0
STIFF = YOUNG * AREA * HEIGHT**2 / (HEIGHT**2 + 1.0) ** 1.5  # of a leg, vertically [N/m]
WEIGHT = 1e-5 * STIFF
NODE_MASS = 3 * 0.5 * MATERIAL["density"] * AREA * np.sqrt(HEIGHT**2 + 1.0)


def tower(folder, comm, **tables):
    """Three legs that lean to a top, which is guided vertically and loaded."""
    angle = 2.0 * np.pi * np.arange(3) / 3.0
    feet = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(3)])
    groups = {"leg": np.array([2]), "second": np.array([1])}
    if comm.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
    comm.Barrier()
    points = np.vstack([feet, [[0.0, 0.0, HEIGHT]]])
    write_mesh(folder / "tower.h5", points, [[0, 3], [1, 3], [2, 3]], bar_groups=groups, comm=comm)
    data = {
        "mesh": {"file": "tower.h5"},
        "node_set": {"feet": {"indices": [0, 1]}, "third": {"indices": [2]}, "top": {"indices": [3]}},
        "material": {"it": MATERIAL},
        "section": {"it": {"area": AREA, "material": "it"}},
        "support": [
            {"node_set": "feet", "fix": "xyz"},
            {"name": "foot", "node_set": "third", "fix": "xyz"},
            {"node_set": "top", "fix": "xy"},
        ],
        "load": [{"node_set": "top", "force": [0.0, 0.0, -WEIGHT]}],
        "output": {"fields_every": 0, "probe": [{"name": "top", "node_set": "top"}]},
        **tables,
    }
    return Case.from_dict(data, source="tower.toml", folder=folder)


PERIOD = 2.0 * np.pi * np.sqrt(NODE_MASS / (2.0 * STIFF))


def fall(history):
    return HEIGHT - history["probe/top/position"][:, 0, 2]


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["energy_momentum", "central_differences"])
@pytest.mark.parametrize("duration, factor", [(0.0, 2.0), (10.0, 1.0)])
def test_a_tower_that_loses_a_leg(duration, factor, integrator, comm, shared_tmp_path):
    """Sudden: 1 - cos of the change from W/3k to W/2k, a peak of twice it; slow: the static answer."""
    static = {"name": "load", "static": {"step": 1.0}}
    end = (duration + 1.2) * PERIOD
    time = {"integrator": integrator, "step": PERIOD / 200.0, "end": end}
    remove = [{"bars": "leg", "time": 0.0, "duration": duration * PERIOD}]
    motion = {
        "name": "loss",
        "time": time,
        "remove": remove,
        "load": [{"node_set": "top", "force": [0.0, 0.0, -WEIGHT]}],
    }
    case = tower(shared_tmp_path, comm, stage=[static, motion], solver={"rtol": 1e-11})
    history = run(case, shared_tmp_path / "out", comm)
    down = fall(history)
    before, after = WEIGHT / (3.0 * STIFF), WEIGHT / (2.0 * STIFF)
    assert down[history["stage"] == 0][-1] == pytest.approx(before, rel=1e-4)
    peak = before + factor * (after - before)
    assert down.max() == pytest.approx(peak, rel=0.01 if factor == 2.0 else 0.02)
    assert history["broken_bars"].max() == 0
    stored = 0.5 * STIFF * before**2
    if not duration:
        assert history["rupture_dissipation"][-1] == pytest.approx(stored, rel=1e-3)
    scale = WEIGHT * after
    assert np.abs(history["energy_imbalance"]).max() < 1e-7 * scale


def test_a_leg_is_taken_away_in_equilibrium(comm, tmp_path):
    """Load factors are those of the loads; equilibrium is found with the leg at 0.5 and without it from there on."""
    case = tower(tmp_path, comm, static={"step": 0.3}, remove=[{"bars": "leg", "time": 0.5}])
    history = run(case, tmp_path / "out", comm)
    factor = history["load_factor"]
    assert 0.5 in factor
    legs = np.where(factor < 0.5, 3, 2)
    np.testing.assert_allclose(fall(history), factor * WEIGHT / (legs * STIFF), rtol=1e-4, atol=1e-15)
    assert np.abs(history["energy_imbalance"]).max() < 1e-8 * history["external_work"][-1]


@pytest.mark.parametrize("method", ["newton", "relaxation"])
def test_a_support_is_taken_away_in_equilibrium(method, comm, tmp_path):
    """The leg that loses its foot hangs on the top without force; it is held in the horizontal directions."""
    support = [
        {"node_set": "feet", "fix": "xyz"},
        {"name": "foot", "node_set": "third", "fix": "z"},
        {"node_set": "third", "fix": "xy"},
        {"node_set": "top", "fix": "xy"},
    ]
    remove = [{"supports": "foot", "time": 0.5, "duration": 0.25}]
    case = tower(tmp_path, comm, static={"step": 0.125, "method": method}, support=support, remove=remove)
    history = run(case, tmp_path / "out", comm)
    down, factor = fall(history), history["load_factor"]
    first, last = factor < 0.5, factor > 0.75
    np.testing.assert_allclose(down[first], factor[first] * WEIGHT / (3.0 * STIFF), rtol=1e-4, atol=1e-15)
    np.testing.assert_allclose(down[last], factor[last] * WEIGHT / (2.0 * STIFF), rtol=1e-4)
    assert np.abs(history["energy_imbalance"]).max() < 1e-7 * history["external_work"][-1]


@pytest.mark.parametrize("scheme", ["central_differences", "chung_lee", "newmark"])
def test_what_a_support_leaves_decreases_over_its_duration(scheme, tmp_path):
    """A bar under F at both ends, whose supports go from t = 0.1 over D = 0.5: momentum 2 F s^2/(2 D), s = t - 0.1, up
    to F D, and 2 F more per time after it."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"all": {"all": True}},
            "material": {"it": {"young_modulus": 1e4, "density": 1.0}},
            "section": {"it": {"area": 1.0, "material": "it"}},
            "support": [{"name": "held", "node_set": "all", "fix": "xyz"}],
            "load": [{"node_set": "all", "force": [1.0, 0.0, 0.0]}],
            "remove": [{"supports": "held", "time": 0.1, "duration": 0.5}],
            "time": {"integrator": scheme, "step": 1e-3, "end": 2.0},
        }
    )
    history = run(case, tmp_path, MPI.COMM_SELF)
    since = np.clip(history["time"] - 0.1, 0.0, None)
    expected = np.where(since < 0.5, 2.0 * since**2, 2.0 * since - 0.5)
    # a step and what is left at its end: the sum of forces is taken at its beginning, middle or end
    np.testing.assert_allclose(history["momentum"][:, 0], expected, atol=2.5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
@pytest.mark.parametrize("what", [{"bars": "leg"}, {"supports": "foot"}, {"supports": "foot", "duration": 0.0}])
def test_restarts_are_bitwise_while_something_is_removed(what, scheme, comm, tmp_path):
    """From before, within and after a gradual removal; in batches of steps as in single ones."""
    step = PERIOD / 100.0
    time = {"integrator": scheme, "step": step, "end": 60 * step}
    case = tower(tmp_path, comm, time=time, remove=[{"time": 20 * step, "duration": 20 * step, **what}])
    whole = assert_restart_is_bitwise(case, comm, tmp_path, 15, 20, 30, 45)
    with Simulation(case, comm, tmp_path / "batches", quiet=True) as simulation:
        for _ in simulation.batches():
            pass
    assert differences(tmp_path / "whole/result.vtkhdf", tmp_path / "batches/result.vtkhdf") == {}
    assert np.abs(whole["energy_imbalance"]).max() < 1e-8 * whole["external_work"].max()


@pytest.mark.slow
@pytest.mark.parallel
def test_what_is_gone_stays_away_in_later_stages(comm, shared_tmp_path):
    """Stages with and without a table [[remove]] go on without what stages before have removed."""
    remove = [{"bars": "leg", "time": 0.5}, {"supports": "foot", "time": 0.25}]
    first = {"name": "loss", "static": {"step": 0.25}, "remove": remove}
    second = {"name": "other loss", "static": {"step": 0.5}, "remove": [{"bars": "second", "time": 0.5}]}
    third = {
        "name": "more",
        "static": {"step": 0.5},
        "load": [{"node_set": "top", "force": [0.0, 0.0, -2.0 * WEIGHT]}],
    }
    support = [
        {"node_set": "feet", "fix": "xyz"},
        {"name": "foot", "node_set": "third", "fix": "z"},
        {"node_set": "third", "fix": "xy"},
        {"node_set": "top", "fix": "xy"},
    ]
    case = tower(shared_tmp_path, comm, stage=[first, second, third], support=support)
    history = run(case, shared_tmp_path / "out", comm)
    for number, (load, legs) in enumerate([(1.0, 2.0), (1.0, 1.0), (2.0, 1.0)]):
        assert fall(history)[history["stage"] == number][-1] == pytest.approx(load * WEIGHT / (legs * STIFF), rel=1e-4)
    assert np.abs(history["energy_imbalance"]).max() < 1e-7 * history["external_work"][-1]


@pytest.mark.parametrize(
    "remove, told",
    [
        ({"time": 0.5}, "exactly one of the keys bars, supports"),
        ({"bars": "leg", "supports": "foot", "time": 0.5}, "exactly one of the keys bars, supports"),
        ({"bars": "legs", "time": 0.5}, r"remove\[0\].bars = 'legs': no such group of bars"),
        ({"supports": "feet", "time": 0.5}, r"remove\[0\].supports"),
        ({"bars": "leg", "time": -0.5}, r"remove\[0\].time"),
    ],
)
def test_removals_that_make_no_sense_are_refused(remove, told, comm, tmp_path):
    with pytest.raises(InputError, match=told):
        Simulation(tower(tmp_path, comm, static={"step": 0.3}, remove=[remove]), comm, tmp_path / "out", quiet=True)
