"""Bars whose laws depend on temperature, while they are heated: energy balance and thermal work."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.runs import run
from helpers.twins import AREA, SOFTENING, STEP, YOUNG, one_bar, pulled

from pfem_petsc import Case, Simulation


@pytest.mark.slow
@pytest.mark.parallel
def test_softened_elastic_bar_keeps_its_energy_while_heated(comm, shared_tmp_path):
    """Heat supplies what softening and expansion take; nothing is lost, in steps of a tenth of a period."""
    case = one_bar("elastic", "energy_momentum", steps=80, elements=2, softening=SOFTENING, thermal_expansion=1.2e-5)
    case["temperature"] = [{"table": [[0.0, 0.0], [8e-4, 400.0]]}]
    case["time"] |= {"step": 1e-5}
    history = run(Case.from_dict(case), shared_tmp_path / "out")
    start = history["kinetic_energy"][0]
    assert abs(history["numerical_dissipation"]).max() < 1e-12 * start
    assert abs(history["thermal_work"]).max() > 1e-2 * start
    total = history["kinetic_energy"] + history["elastic_energy"] - history["thermal_work"]
    assert np.ptp(total) < 1e-12 * start


@pytest.mark.slow
@pytest.mark.parametrize("law, keys", [("elastic", {"softening": SOFTENING}), ("perzyna", {}), ("voce", {})])
def test_halved_steps_keep_the_balance_of_heat(law, keys, comm, tmp_path):
    """Whole steps are refused: temperatures, also those of the failed solve, are taken at the ends of the halves."""
    case = one_bar(law, "energy_momentum", steps=60, elements=2, thermal_expansion=1.2e-5, **keys)
    case["temperature"] = [{"table": [[0.0, 0.0], [6e-4, 400.0]]}]
    run = Simulation(Case.from_dict(case), comm, output=tmp_path / "out", quiet=True)
    solve = run.stepper.newton.solve

    def refuse_whole_steps(*arguments):
        report = solve(*arguments)
        return replace(report, converged=report.converged and run.stepper.part < STEP, why="refused")

    run.stepper.newton.solve = refuse_whole_steps
    rows = [step.row for step in run]
    assert run.stepper.smallest == 0.5 * STEP and rows[-1]["newton_iterations"] >= 2
    start = rows[0]["kinetic_energy"]
    assert max(abs(row["thermal_work"]) for row in rows) > 1e-2 * start
    assert max(abs(row["numerical_dissipation"]) for row in rows) < 1e-11 * start


@pytest.mark.slow
def test_restrained_bar_that_softens(tmp_path):
    """Held at both ends: the stress follows -E(T) alpha T until it yields at s_Y(T)."""
    perfect = {"yield_stress": 250e6, "isotropic_hardening": 0.0, "kinematic_hardening": 0.0}
    for law, keys in (("elastic", {}), ("elastoplastic", perfect)):
        case = pulled(law, 0.0, softening=SOFTENING, thermal_expansion=1.2e-5, **keys)
        case["temperature"] = [{"table": [[0.0, 0.0], [1.0, 250.0]]}]
        history = run(Case.from_dict(case), tmp_path / law)
        stress = -0.75 * YOUNG * 1.2e-5 * 250.0
        stress = max(stress, -0.55 * 250e6) if keys else stress
        assert history["probe/tip/reaction"][-1, 0, 0] == pytest.approx(stress * AREA, rel=1e-9)
