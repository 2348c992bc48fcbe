"""Fused steps: bitwise identical to single steps."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.errors import EarlyStop, SimulationFailure

LATTICE = {
    "mesh": {"generator": "lattice", "kind": "cubic", "cells": [2, 2, 2], "pitch": 0.01},
    "node_set": {"foot": {"group": "bottom"}, "corner": {"nearest": [0.02, 0.02, 0.02]}},
    "material": {"it": {"young_modulus": 110e9, "density": 4500.0}},
    "section": {"it": {"area": 1e-6, "material": "it"}},
    "initial": {"velocity": [3.0, 1.0, -20.0]},
    "time": {"integrator": "central_differences", "step": 2e-7, "end": 1.2e-4},
    "output": {"fields_every": 150, "history_every": 3, "probe": [{"name": "feet", "node_set": "foot"}]},
}
PLASTIC = {"yield_stress": 100e6, "isotropic_hardening": 1e9, "kinematic_hardening": 2e9}
FLOOR = {"name": "floor", "type": "plane", "point": [0, 0, -1e-5], "normal": [0.0, 0.1, 1.0]}
SIDE = {"name": "side", "type": "plane", "point": [0.0201, 0, 0], "normal": [-1.0, 0.0, 0.0], "node_set": "foot"}

DAMPED = {"it": LATTICE["material"]["it"] | {"damping": 2e4}}

CASES = {
    "yielding": {"material": {"it": DAMPED["it"] | PLASTIC}, "wall": [FLOOR]},
    "flying": {},
    "damped": {"material": DAMPED, "support": [{"node_set": "foot", "fix": "z"}]},
    "held by feet": {"support": [{"node_set": "foot", "fix": "xyz"}]},
    "walls": {"wall": [FLOOR, SIDE]},
    "held on an inclined wall": {
        "support": [{"node_set": "foot", "fix": "x"}],
        "wall": [FLOOR | {"normal": [0.5, 0.1, 1.0], "point": [0, 0, -2e-4]}],
    },
    "held": {"support": [{"node_set": "foot", "fix": "xz"}], "gravity": {"acceleration": [0.0, 0.0, -1e4]}},
    "held and loaded": {
        "material": DAMPED,
        "support": [{"node_set": "foot", "fix": "z"}],
        "load": [{"node_set": "corner", "force": [10.0, 0.0, 0.0]}],
        "wall": [SIDE | {"node_set": "foot"}],
    },
}


def case(changes, **time):
    return Case.from_dict(LATTICE | changes | {"time": LATTICE["time"] | time})


def made(case, folder, together):
    simulation = Simulation(case, output=folder, quiet=True)
    steps = list(simulation.batches() if together else simulation)
    return simulation, len(steps)


@pytest.mark.parametrize("name", CASES)
def test_fused_stepses_are_the_single_steps(name, tmp_path):
    one, count = made(case(CASES[name]), tmp_path / "one", False)
    many, fewer = made(case(CASES[name]), tmp_path / "many", True)
    assert count == 600 and fewer < 210
    first, second = open_result(tmp_path / "one"), open_result(tmp_path / "many")
    assert sorted(first.history) == sorted(second.history)
    for column in first.history:
        np.testing.assert_array_equal(first.history[column], second.history[column], err_msg=column)
    for what in ("x", "v", "a", "f", "contact", "support"):
        np.testing.assert_array_equal(getattr(one.state, what), getattr(many.state, what), err_msg=what)
    assert np.abs(first.history["energy_imbalance"]).max() < 1e-11 * first.history["kinetic_energy"].max()
    for k in range(len(first.times)):
        np.testing.assert_array_equal(first.field("velocity", k), second.field("velocity", k))


@pytest.mark.parallel
@pytest.mark.parametrize("name", CASES)
def test_ranks_make_fused_steps_too(name, shared_tmp_path):
    changes = CASES[name] | {"mesh": LATTICE["mesh"] | {"cells": [2, 4, 3]}}
    one, count = made(case(changes, end=4e-5), shared_tmp_path / "one", False)
    many, fewer = made(case(changes, end=4e-5), shared_tmp_path / "many", True)
    assert count == 200 and fewer < 100
    first, second = open_result(shared_tmp_path / "one"), open_result(shared_tmp_path / "many")
    for column in first.history:
        np.testing.assert_array_equal(first.history[column], second.history[column], err_msg=column)
    for what in ("x", "v", "a", "f", "contact", "support"):
        np.testing.assert_array_equal(getattr(one.state, what), getattr(many.state, what), err_msg=what)


@pytest.mark.parametrize("other", ["chung_lee", "newmark"])
def test_other_integrators_take_single_steps(other, tmp_path):
    _, count = made(case({}, integrator=other, end=2e-6), tmp_path / "out", True)
    assert count == 10


def test_a_stopped_run_of_batches_goes_on_to_the_same_end(tmp_path):
    walls = CASES["yielding"]
    whole, _ = made(case(walls), tmp_path / "whole", True)
    simulation = Simulation(case(walls), output=tmp_path / "part", quiet=True)
    with pytest.raises(EarlyStop):
        for step in simulation.batches():
            if step.step > 200:
                simulation._synchroniser.stop._signal = 15
    assert 200 < simulation.state.step < 600
    rest = Simulation(case(walls), output=tmp_path / "part", restart=True, quiet=True)
    for _ in rest.batches():
        pass
    np.testing.assert_array_equal(whole.state.x, rest.state.x)
    first, second = open_result(tmp_path / "whole"), open_result(tmp_path / "part")
    for column in first.history:
        np.testing.assert_array_equal(first.history[column], second.history[column], err_msg=column)


@pytest.mark.parallel
def test_a_failure_is_that_of_single_steps(shared_tmp_path):
    crushed = {"initial": {"velocity": [0.0, 0.0, -2e4]}, "wall": [FLOOR]}
    texts, steps = [], []
    for together in (False, True):
        with pytest.raises(SimulationFailure) as failure:
            made(case(crushed), shared_tmp_path / str(together), together)
        texts.append(str(failure.value))
        steps.append(open_result(shared_tmp_path / str(together)).history["step"])
    assert "bar" in texts[0] and texts[0] == texts[1]
    np.testing.assert_array_equal(steps[0], steps[1])


@pytest.mark.parallel
@pytest.mark.parametrize("every", [1, 1000])
def test_the_first_failure_is_reported(every, shared_tmp_path):
    """A bar fails on one rank; before the ranks synchronise, more fail on others as a consequence."""
    crushed = {"mesh": LATTICE["mesh"] | {"cells": [2, 4, 3]}, "initial": {"velocity": [0.0, 0.0, -2e4]}}
    output = {"history_every": every, "fields_every": 0}
    for together in (False, True):
        with pytest.raises(SimulationFailure, match=r"step 140, .* nodes 32 and 33 "):
            made(case(crushed | {"wall": [FLOOR], "output": output}), shared_tmp_path / str(together), together)
