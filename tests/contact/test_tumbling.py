"""A truss that tumbles in a closed box: no node gets out, and energy does not grow with schemes that guarantee this."""

import numpy as np
import pytest
from helpers.lattices import box, lattice_case, simulation

LOW, HIGH = np.array([-0.06, -0.05, -0.04]), np.array([0.18, 0.17, 0.19])


def tumble(integrator, treatment, steps, comm, folder, **parameters):
    """Largest distance beyond the box [m], energies over the first, and the rows."""
    case = lattice_case(
        box(LOW, HIGH),
        velocity=[3.0, -2.0, -4.0],
        spin=[40.0, 60.0, -30.0],
        integrator=integrator,
        end=2e-4 * steps,
        cells=[1, 1, 1],
        contact={"treatment": treatment},
        solver={"rtol": 1e-12},
    )
    case["time"] |= parameters
    run = simulation(case, comm, folder)
    outside, rows = 0.0, []
    for step in run:
        x = run.state.position
        outside = max(outside, (LOW - x).max(initial=0.0), (x - HIGH).max(initial=0.0))
        rows.append(step.row)
    assert len(rows) == steps
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    return max(comm.allgather(float(outside))), energy / energy[0], rows


@pytest.mark.slow
def test_three_thousand_explicit_steps(comm, shared_tmp_path):
    outside, energy, rows = tumble("central_differences", "scheme", 3_000, comm, shared_tmp_path)
    assert outside < 1e-12 * 0.2
    assert energy.max() <= 1.0 + 1e-9 and energy[-1] < 0.5
    assert sum(row["active_contacts"] > 0 for row in rows) > 300
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("treatment", ["stick", "conserving"])
def test_promised_energy(treatment, comm, shared_tmp_path):
    """The energy-momentum scheme: with stick no step gains energy, with conserving none gains or loses any."""
    outside, energy, rows = tumble("energy_momentum", treatment, 400, comm, shared_tmp_path)
    assert outside < 1e-12 * 0.2
    assert np.diff(energy).max() < 1e-11
    if treatment == "conserving":
        np.testing.assert_allclose(energy, 1.0, atol=1e-9)
    else:
        assert energy[-1] < 0.9
    assert sum(row["active_contacts"] > 0 for row in rows) > 10
