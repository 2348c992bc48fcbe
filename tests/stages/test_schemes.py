"""Schemes after one another: rest in every one, and balances in any order."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.small_models import BLOCK, FLOOR, PLATE

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
