"""The energy-momentum scheme conserves energy and both momenta of a tumbling elastic truss."""

import numpy as np
import pytest
from helpers.runs import energy, imbalance, run

from pfem_petsc import Case


@pytest.mark.parallel
@pytest.mark.slow
@pytest.mark.parametrize("strain", ["engineering", "green", "logarithmic"])
def test_conservation(strain, shared_tmp_path, comm):
    case = Case.load("tumbling_lattice")
    material = next(iter(case.material))
    case = Case.load(
        "tumbling_lattice",
        [
            "time.integrator=energy_momentum",
            "time.step=2e-4",
            "time.end=0.04",
            "solver.rtol=1e-13",
            "output.fields_every=0",
            f"material.{material}.strain={strain}",
        ],
    )
    history = run(case, shared_tmp_path)
    assert history["elastic_energy"].max() > 0.1 * energy(history)[0]
    assert np.abs(energy(history) / energy(history)[0] - 1.0).max() < 1e-12
    for name in ("momentum", "angular_momentum"):
        scale = max(np.linalg.norm(history["angular_momentum"][0]), np.linalg.norm(history[name][0]))
        assert np.abs(history[name] - history[name][0]).max() < 1e-12 * scale
    assert imbalance(history) < 1e-12


@pytest.mark.parametrize("hardening", [0.0, 0.05])
def test_plastic_work_is_what_is_lost(hardening, shared_tmp_path, comm):
    """A free truss that yields: energy and plastic dissipation together are kept, momenta too."""
    case = Case.load("tumbling_lattice")
    material = next(iter(case.material))
    young = case.material[material].young_modulus
    case = Case.load(
        "tumbling_lattice",
        [
            "time.integrator=energy_momentum",
            "time.step=2e-4",
            "time.end=0.02",
            "solver.rtol=1e-13",
            "output.fields_every=0",
            f"material.{material}.yield_stress={5e-4 * young}",
            f"material.{material}.isotropic_hardening={hardening * young}",
        ],
    )
    history = run(case, shared_tmp_path)
    start = energy(history)[0]
    assert history["plastic_dissipation"][-1] > 0.01 * start
    assert (np.diff(history["plastic_heat"]) >= 0.0).all()
    assert np.abs(energy(history) + history["plastic_dissipation"] - start).max() < 1e-11 * start
    assert np.abs(history["numerical_dissipation"]).max() < 1e-11 * start
    assert imbalance(history) < 1e-12
