"""Damping multiplied by a factor over time, against the closed form of a bar that flies."""

import numpy as np
import pytest
from helpers.runs import run
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError

DENSITY, RATE, END = 500.0, 8.0, 0.4
EXPLICIT = ["central_differences", "chung_lee", "hulbert_chung", "souza_moura"]
IMPLICIT = ["newmark", "wilson", "houbolt", "generalized_alpha", "energy_momentum"]


def case(scheme, mass="lumped", table=((0.0, 1.0), (0.2, 0.0)), time_step=1e-3, **tables):
    parameters = {"beta": 0.25, "gamma": 0.5} if scheme == "newmark" else {}
    time = {"integrator": scheme, "step": time_step, "end": END, "mass": mass, **parameters}
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 2.0, "elements": 2},
            "node_set": {"end": {"group": "end"}, "start": {"group": "start"}},
            "material": {"m": {"young_modulus": 2e6, "density": DENSITY, "damping": RATE * DENSITY}},
            "section": {"s": {"area": 1e-3, "material": "m"}},
            "initial": {"velocity": [0.0, 0.3, 0.4]},
            "time": {**time, "damping_table": [list(row) for row in table]},
            "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
            "solver": {"rtol": 1e-13},
            **tables,
        }
    )


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_decay(scheme, mass, tmp_path):
    """v = v0 exp(-rate times the integral of the factor), a factor that falls from 1 to 0; then it flies on."""
    history = run(case(scheme, mass), tmp_path / "out", MPI.COMM_SELF)
    t = np.minimum(history["time"], 0.2)
    exact = 0.4 * np.exp(-RATE * (t - 2.5 * t**2))
    momentum, kinetic = history["momentum"], history["kinetic_energy"]
    assert np.abs(momentum[:, 2] - exact).max() < (8e-3 if scheme == "souza_moura" else 2e-3) * 0.4
    assert np.ptp(momentum[-50:, 2]) < 1e-12
    np.testing.assert_allclose(history["damping_dissipation"], kinetic[0] - kinetic, atol=0.02 * kinetic[0])
    np.testing.assert_allclose(momentum - momentum[0], history["damping_impulse"], atol=1e-11)
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * kinetic[0]


@pytest.mark.parametrize("scheme", ["central_differences", "newmark", "bathe"])
def test_factor_of_the_state_from_which_a_run_continues(scheme):
    """To the bit that at the exact end of each step, of times that no sum of steps reaches."""
    factors, step = [], 0.008047780619187745
    with Simulation(case(scheme, time_step=step), quiet=True) as simulation:
        inertia = simulation.model.inertia
        simulation.on_step(lambda done: factors.append((done.time, inertia.factor)))
        simulation.run()
    times, found = np.array(factors).T
    np.testing.assert_array_equal(found, np.interp(times, [0.0, 0.2], [1.0, 0.0]))


def test_refusals():
    with pytest.raises(InputError, match=r"time.damping_table.*expected factors >= 0"):
        case("newmark", table=((0.0, -1.0),))
    with pytest.raises(InputError, match=r"time.damping_table"):
        case("newmark", table=((1.0, 1.0), (0.0, 1.0)))
