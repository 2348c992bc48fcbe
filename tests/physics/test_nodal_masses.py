"""Masses of ``[[mass]]``, against closed forms of one bar."""

import numpy as np
import pytest
from helpers.runs import run
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.output.result import open_result

YOUNG, DENSITY, AREA, LENGTH, TIP, G = 2e6, 500.0, 1e-3, 2.0, 1.5, 9.81
BAR = DENSITY * AREA * LENGTH
EXPLICIT = ["central_differences", "chung_lee", "hulbert_chung", "souza_moura"]
IMPLICIT = ["newmark", "wilson", "houbolt", "generalized_alpha", "energy_momentum"]
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}


def inertia(mass):
    """Of the tip: its mass and its share of the bar."""
    return TIP + (BAR / 2.0 if mass == "lumped" else BAR / 3.0)


def case(**tables):
    data = {
        "mesh": {"generator": "rod", "length": LENGTH, "elements": 1},
        "node_set": {"start": {"group": "start"}, "end": {"group": "end"}, "all": {"all": True}},
        "material": {"m": {"young_modulus": YOUNG, "density": DENSITY}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "mass": [{"node_set": "end", "value": TIP - 0.5}, {"node_set": "end", "value": 0.5}],
        "support": [{"node_set": "start", "fix": "xyz"}],
        "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "end"}]},
        "solver": {"rtol": 1e-13},
        **tables,
    }
    return Case.from_dict({key: value for key, value in data.items() if value is not None})


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", [*EXPLICIT, *IMPLICIT])
def test_oscillator(scheme, mass, tmp_path):
    """x = v/w sin(w t) along the bar, w^2 = E A/(l m): of second order in the step, or of first."""
    omega = np.sqrt(YOUNG * AREA / LENGTH / inertia(mass))
    step = 0.01 / omega
    time = {"integrator": scheme, "step": step, "end": 2.0 * np.pi / omega, "mass": mass, **PARAMETERS.get(scheme, {})}
    fast = {"on": [{"node_set": "end", "velocity": [1e-3, 0.0, 0.0]}]}
    history = run(case(time=time, initial=fast), tmp_path / "out", MPI.COMM_SELF)
    x = history["probe/end/position"][:, 0, 0] - LENGTH
    exact = 1e-3 / omega * np.sin(omega * history["time"])
    assert np.abs(x - exact).max() < (0.04 if scheme == "souza_moura" else 1e-3) * 1e-3 / omega
    assert history["kinetic_energy"][0] == pytest.approx(0.5e-6 * inertia(mass), rel=1e-12)
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * history["kinetic_energy"][0]


@pytest.mark.parallel
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_modes_of_a_pendulum(mass, comm, shared_tmp_path):
    """A heavy bar hangs from one end: two modes of the tip across it by its tension, one along it."""
    mesh = {"generator": "rod", "length": LENGTH, "elements": 1}
    weight = {"acceleration": [G, 0.0, 0.0]}
    it = case(mesh=mesh, gravity=weight, static={"method": "relaxation"}, modes={"count": 3, "mass": mass})
    assert Simulation(it, comm, output=shared_tmp_path / "out", quiet=True).run() == 0
    if comm.rank == 0:
        with open_result(shared_tmp_path / "out") as result:
            tension = (TIP + BAR / 2.0) * G
            length = LENGTH * (1.0 + tension / (YOUNG * AREA))
            squares = np.array([tension / length, tension / length, YOUNG * AREA / LENGTH]) / inertia(mass)
            np.testing.assert_allclose(result.modes.eigenvalue, squares, rtol=1e-7)
            assert result.history["support_force"][-1, 0] == pytest.approx(-(TIP + BAR) * G, rel=1e-7)


def test_critical_step(tmp_path):
    """2/w of central differences."""
    it = case(time={"integrator": "central_differences", "step": "auto", "end": 1.0})
    with Simulation(it, MPI.COMM_SELF, output=tmp_path / "out", quiet=True) as simulation:
        assert simulation.plan.critical_step == pytest.approx(2.0 * np.sqrt(inertia("lumped") * LENGTH / YOUNG / AREA))
        assert simulation.model.total_mass == pytest.approx(TIP + BAR, rel=1e-14)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("scheme", ["central_differences", "newmark"])
def test_free_flight(scheme, mass, tmp_path):
    """A bar with a mass at one end falls freely and turns about the common centre of mass."""
    time = {"integrator": scheme, "step": 1e-4, "end": 0.05, "mass": mass, **PARAMETERS.get(scheme, {})}
    spin = {"angular_velocity": [0.0, 0.0, 2.0], "velocity": [0.0, 0.0, 1.0]}
    it = case(time=time, support=[], initial=spin, gravity={"acceleration": [0.0, 0.0, -G]})
    history = run(it, tmp_path / "out", MPI.COMM_SELF)
    centre = (TIP + BAR / 2.0) * LENGTH / (TIP + BAR)
    t = history["time"]
    np.testing.assert_allclose(history["centre_of_mass"][:, 0], centre, rtol=1e-12)
    np.testing.assert_allclose(history["centre_of_mass"][:, 2], t - 0.5 * G * t**2, atol=1e-4)
    np.testing.assert_allclose(history["momentum"][:, 2], (TIP + BAR) * (1.0 - G * t), atol=1e-10)
    ends = np.array([-centre, LENGTH - centre])
    turning = BAR / 2.0 * (ends**2).sum() + TIP * ends[1] ** 2
    turning -= BAR / 6.0 * LENGTH**2 if mass == "consistent" else 0.0
    assert history["kinetic_energy"][0] == pytest.approx(0.5 * (TIP + BAR) + 2.0 * turning, rel=1e-12)
    np.testing.assert_allclose(history["angular_momentum"][-1, 2], 2.0 * turning, rtol=1e-7)


def test_refusals():
    with pytest.raises(InputError, match=r"mass\[0\].value = -1.0: expected a value >= 0"):
        case(mass=[{"node_set": "end", "value": -1.0}], time={"integrator": "newmark", "step": 1.0, "end": 1.0})
    with pytest.raises(InputError, match=r"mass\[0\].node_set = 'ende'|mass\[0\].node_set = \"ende\""):
        case(mass=[{"node_set": "ende", "value": 1.0}], time={"integrator": "newmark", "step": 1.0, "end": 1.0})
