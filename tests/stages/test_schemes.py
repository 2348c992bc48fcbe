"""Schemes after one another: rest in every one, and balances in any order."""

from __future__ import annotations

import random

import numpy as np
import pytest
from helpers.kills import differences
from helpers.small_models import BLOCK, FLOOR, PLATE, check_balances

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.case.model import INTEGRATORS
from pfem_petsc.registry import choices

HELD = [{"node_set": "base", "fix": "xyz"}]


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("walls", [False, True])
@pytest.mark.parametrize("integrator", choices(INTEGRATORS))
def test_what_is_in_equilibrium_stays_at_rest(integrator, walls, tmp_path):
    """After self-weight, between walls too: speeds of the rounding alone; a thousand steps give no more."""
    plate = {**PLATE, "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -1e-5]]}
    press = {"name": "press", "static": {"step": 0.5}, **({"wall": [FLOOR, plate]} if walls else {"support": HELD})}
    watch = {"name": "watch", "time": {"integrator": integrator, "step": 1e-5, "end": 4e-4}}
    tables = {} if walls else {"wall": []}
    case = Case.from_dict({**BLOCK, **tables, "stage": [press, watch]})
    fastest = 0.0
    with Simulation(case, output=tmp_path / "out", quiet=True) as simulation:
        for step in simulation:
            if step.step > 2:
                fastest = max(fastest, abs(simulation.state.v).max())
        assert fastest < 1e-12 * simulation.model.wave_speed
    history = open_result(tmp_path / "out").history
    assert history["elastic_energy"][2] > 0.0
    np.testing.assert_allclose(history["elastic_energy"][2:], history["elastic_energy"][2], rtol=1e-7)


def drawn(seed):
    """A case of four stages with schemes, tables and walls by chance."""
    chance = random.Random(seed)
    stages = []
    for k in range(4):
        stage = {"name": f"{k}"}
        if chance.random() < 0.3:
            stage["static"] = {"step": 0.5}
            stage["support"] = HELD
        else:
            stage["time"] = {"integrator": chance.choice(choices(INTEGRATORS)), "step": 1e-6, "end": 1e-5}
            stage["time"]["mass"] = chance.choice(["lumped", "lumped", "consistent"])
            if chance.random() < 0.5:
                stage["support"] = []
            if chance.random() < 0.5:
                stage["initial"] = {"velocity": [chance.uniform(-1.0, 1.0) for _ in range(3)]}
        if chance.random() < 0.4:
            stage["load"] = [{"node_set": "side", "force": [chance.uniform(-1.0, 1.0) for _ in range(3)]}]
        if chance.random() < 0.4:
            stage["temperature"] = [{"value": chance.uniform(0.0, 30.0)}]
        if chance.random() < 0.4:
            stage["gravity"] = {"acceleration": [0.0, 0.0, chance.uniform(-100.0, 0.0)]}
        if chance.random() < 0.3:
            stage["output"] = {"history_every": chance.choice([1, 3])}
        stages.append(stage)
    return Case.from_dict({**BLOCK, "support": HELD, "stage": stages}, name=f"drawn {seed}")


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("seed", range(6))
def test_balances_of_stages_drawn_by_chance(seed, comm, shared_tmp_path):
    with Simulation(drawn(seed), comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        simulation.run()
    result = open_result(shared_tmp_path / "out")
    check_balances({name: result.history[name] for name in result.history}, 1e-8)
    assert (np.diff(result.history["time"]) > 0.0).all()
    assert result.history["stage"][-1] == 3


@pytest.mark.slow
def test_steps_of_later_stages_are_made_together_to_the_last_bit(tmp_path):
    stages = [
        {"name": "weight", "static": {"step": 0.5}, "support": HELD},
        {"name": "flies", "time": {"integrator": "central_differences", "step": 1e-6, "end": 1e-4}, "support": []},
        {"name": "flies on", "time": {"integrator": "central_differences", "step": 2e-6, "end": 1e-4}},
    ]
    stages[1]["initial"] = {"velocity": [0.0, 0.0, 0.1]}
    case = Case.from_dict({**BLOCK, "output": {"fields_every": 40, "history_every": 10}, "stage": stages}, name="block")
    made = []
    for number, together in enumerate((True, False)):
        with Simulation(case, output=tmp_path / str(number), quiet=True) as simulation:
            made.append(sum(1 for _ in (simulation.batches() if together else simulation)))
    assert made[0] < 60 < made[1] == 152
    assert differences(*(tmp_path / str(number) / "result.vtkhdf" for number in range(2))) == {}
