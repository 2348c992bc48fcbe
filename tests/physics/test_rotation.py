"""Spinning bar and pendulum: closed forms for rotation, stretch, period and tension."""

import numpy as np
import pytest
from helpers.runs import energy, run
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan, make_stepper

LENGTH, YOUNG, DENSITY, AREA = 1.0, 1e10, 1000.0, 1e-4
SPIN = 2.0 * np.pi  # a turn a second


def spinning(integrator, turns=5, per_turn=100, young=YOUNG, mass="lumped", **parameters):
    """One bar that spins about its middle, started in steady spin at its stretched length.

    Returns angular momentum and kinetic energy over those at the start, and length, after each step.
    """
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": LENGTH, "elements": 1},
            "material": {"it": {"young_modulus": young, "density": DENSITY}},
            "section": {"it": {"area": AREA, "material": "it"}},
            "initial": {"angular_velocity": [0.0, SPIN, 0.0]},
            "time": {"integrator": integrator, "step": 1 / per_turn, "end": float(turns), "mass": mass, **parameters},
            "solver": {"rtol": 1e-13},
        }
    )
    model = Model(case, MPI.COMM_SELF)
    it = make_stepper(model, make_plan(model))
    stretch = steady_length(young, mass) / LENGTH
    x = it.state.position
    middle = x.mean(axis=0)
    x[:] = middle + stretch * (x - middle)
    spin = model.initial_velocity()
    model.initial_velocity = lambda: stretch * spin
    it.start()

    def measure():
        momentum = model.inertia.mass_times(it.state.v, np.empty_like(it.state.v))
        turning = np.cross(x - x.mean(axis=0), momentum).sum(axis=0)[1]
        return turning, 0.5 * (momentum * it.state.v).sum(), np.linalg.norm(x[1] - x[0])

    found = [measure()]
    for _ in range(turns * per_turn):
        it.step()
        found.append(measure())
    moment, kinetic, length = np.array(found).T
    return moment / moment[0], kinetic / kinetic[0], length


def steady_length(young, mass):
    """Length in steady spin: l0/(1 - m omega^2 l0/(4 EA)) with lumped mass, /(12 EA) with consistent mass."""
    whole = DENSITY * AREA * LENGTH
    return LENGTH / (1.0 - whole * SPIN**2 * LENGTH / ((4.0 if mass == "lumped" else 12.0) * young * AREA))


def test_hu_destroys_rotation():
    """Rigid spin obeys d omega/dt = -h omega^3: after 5 turns at 100 steps a turn 0.449 of it is left."""
    left, kinetic, _ = spinning("newmark")
    h = 0.01
    law = 1.0 / np.sqrt(1.0 + 2.0 * h * SPIN**2 * h * np.arange(501))
    assert law[-1] == pytest.approx(0.449, abs=1e-3)
    assert left[-1] == pytest.approx(0.449, abs=1e-3)
    assert np.abs(left - law).max() < 2e-3
    assert kinetic[-1] == pytest.approx(0.20, abs=5e-3)


@pytest.mark.parametrize(
    ("integrator", "parameters", "left", "slack"),
    [
        ("houbolt", {}, 0.9925, 1e-4),
        ("wilson", {}, 0.9987, 1e-4),
        ("newmark", {"beta": 0.25, "gamma": 0.5}, 1.0, 1e-8),
        ("generalized_alpha", {"rho_inf": 1.0}, 1.0, 1e-8),
    ],
)
def test_rotation_of_implicit_schemes(integrator, parameters, left, slack):
    assert spinning(integrator, **parameters)[0][-1] == pytest.approx(left, abs=slack)


@pytest.mark.parametrize(("integrator", "parameters"), [("central_differences", {}), ("chung_lee", {"beta": 1.0})])
def test_explicit_schemes_keep_rotation(integrator, parameters):
    """A softer bar, whose explicit limit lies above a hundredth of a turn."""
    left, _, _ = spinning(integrator, young=2e6, **parameters)
    if integrator == "central_differences":
        assert np.abs(left - 1.0).max() < 1e-13
    else:  # its velocities lag by a step, and settle; the positions are those of central differences
        assert np.abs(left[3:] - left[3]).max() < 1e-4


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_steady_spin_stays_steady(mass):
    """The stretched length is the equilibrium one: a bar started there keeps it, to the error of the step."""
    _, _, length = spinning("newmark", turns=1, per_turn=400, young=1e7, mass=mass, beta=0.25, gamma=0.5)
    stretch = steady_length(1e7, mass) - LENGTH
    assert np.abs(length - LENGTH - stretch).max() < 1e-3 * stretch


def elliptic(k):
    """Complete elliptic integral of the first kind of modulus k, by the arithmetic-geometric mean."""
    a, b = 1.0, np.sqrt(1.0 - k * k)
    while abs(a - b) > 1e-15:
        a, b = 0.5 * (a + b), np.sqrt(a * b)
    return np.pi / (2.0 * a)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "mass", "equivalent"),
    [
        ("central_differences", "lumped", 1.0),
        ("generalized_alpha", "lumped", 1.0),
        ("generalized_alpha", "consistent", 2.0 / 3.0),
    ],
)
def test_pendulum(integrator, mass, equivalent, tmp_path):
    """Let go from the horizontal: period 4 sqrt(l/g) K(sin 45 deg), tension 3 m g at the bottom."""
    gravity, length, whole = 9.81, 1.0, 0.1
    keys = [f"time.integrator={integrator}", f"time.mass={mass}", "solver.rtol=1e-12", "time.end=2.4"]
    history = run(Case.load("pendulum", keys), tmp_path / "it")
    x, time = history["probe/tip/position"][:, 0, 0], history["time"]
    passed = np.flatnonzero(np.sign(x[1:]) != np.sign(x[:-1]))
    bottom = time[passed] - x[passed] * (time[passed + 1] - time[passed]) / (x[passed + 1] - x[passed])
    period = 4.0 * np.sqrt(equivalent * length / gravity) * elliptic(np.sin(np.pi / 4))
    assert 4.0 * bottom[0] == pytest.approx(period, rel=5e-4)
    assert 2.0 * (bottom[1] - bottom[0]) == pytest.approx(period, rel=5e-4)
    # the hinge bears the bar force, and with lumped mass the weight of the bar's other half besides
    window = slice(passed[0] - 6, passed[0] + 8)  # a period of the bar's own vibration
    upward = history["probe/hinge/reaction"][window, 0, 2].mean()
    if mass == "lumped":
        assert upward == pytest.approx(3.0 * 0.5 * whole * gravity + 0.5 * whole * gravity, rel=0.01)
    else:  # m g + m omega^2 l/2 with omega^2 = 3 g/l
        assert upward == pytest.approx(2.5 * whole * gravity, rel=0.01)
    assert energy(history)[0] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * whole * gravity * length
