"""Each scheme on the linear oscillator, run through the program: order, damping, period, spectral radius, limits."""

import numpy as np
import pytest
from helpers import oscillator
from helpers.oscillator import OMEGA, SCHEMES, displacements, properties, roots, stepper

from pfem_petsc import Simulation
from pfem_petsc.errors import InputError
from pfem_petsc.output.result import open_result
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan

# h/T, damping ratio and its digits, period error [%] and its digits; from amplification matrices of the literature.
TABLE = {
    "central_differences": [(0.05, 0, 4, -0.41, 2), (0.1, 0, 4, -1.69, 2), (0.2, 0, 4, -7.5, 1)],
    "chung_lee 1": [(0.05, 0, 4, -0.41, 2), (0.1, 0, 4, -1.69, 2), (0.2, 0, 4, -7.5, 1)],
    "chung_lee 1.02": [(0.05, 0.0003, 4, -0.32, 2), (0.1, 0.0024, 4, -1.37, 2), (0.2, 0.0186, 4, -7.1, 1)],
    "chung_lee 28/27": [(0.05, 0.0006, 4, -0.24, 2), (0.1, 0.0045, 4, -1.09, 2), (0.2, 0.0349, 4, -6.6, 1)],
    "newmark": [(0.05, 0.155, 3, 3.2, 1), (0.1, 0.297, 3, 12.0, 1), (0.2, 0.527, 3, 39.8, 1)],
    "houbolt": [(0.05, 0.0116, 4, 3.9, 1), (0.1, 0.055, 3, 12.3, 1), (0.2, 0.169, 3, 34, 0)],
    "wilson 1.4": [(0.05, 0.0023, 4, 1.7, 1), (0.1, 0.0140, 4, 6.1, 1), (0.2, 0.056, 3, 19.4, 1)],
    "trapezoid": [(0.05, 0, 4, 0.82, 2), (0.1, 0, 4, 3.2, 1), (0.2, 0, 4, 12.0, 1)],
}
RADIUS = {  # at h/T = 0.1
    "central_differences": 1.0,
    "chung_lee 1": 1.0,
    "chung_lee 1.02": 0.9985,
    "chung_lee 28/27": 0.9972,
    "newmark": 0.847,
    "houbolt": 0.970,
    "wilson 1.4": 0.992,
    "trapezoid": 1.0,
}
# Omega of the limit, undamped
LIMITS = {
    "central_differences": 2.0,
    "chung_lee 1": 2.0,
    "chung_lee 1.02": 1.9245,
    "chung_lee 28/27": 1.8665,
    "hulbert_chung 0": 1.549,
    "hulbert_chung 1": 2.0,
    "souza_moura": 1.757,
}
DAMPED_LIMITS = {"central_differences": 2.0, "chung_lee 1": 1.640, "chung_lee 1.02": 1.589, "chung_lee 28/27": 1.550}


def response(name, omega_h, damping_ratio=0.0, steps=16, **start):
    integrator, parameters, order, _ = SCHEMES[name]
    h = omega_h / OMEGA["lumped"]
    start = start or {"x0": 2e-4, "v0": -3e-4 / h}
    return roots(
        displacements(stepper(omega_h, integrator, parameters, "lumped", damping_ratio, **start), steps), order
    )


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("fraction", [0.05, 0.1, 0.2])
def test_response_has_the_eigenvalues_of_the_scheme(name, fraction):
    """Radius, damping ratio and period error of the run against the amplification matrix, undamped and damped."""
    omega_h = 2 * np.pi * fraction
    for damping_ratio in (0.0, 0.1):
        expected = properties(SCHEMES[name][3](omega_h, damping_ratio), omega_h)
        np.testing.assert_allclose(properties(response(name, omega_h, damping_ratio), omega_h), expected, atol=1e-9)


@pytest.mark.parametrize("name", TABLE)
def test_published_properties(name):
    for fraction, damping, damping_digits, period, period_digits in TABLE[name]:
        omega_h = 2 * np.pi * fraction
        radius, found_damping, found_period = properties(response(name, omega_h), omega_h)
        assert found_damping == pytest.approx(damping, abs=0.51 * 10.0**-damping_digits)
        assert 100 * found_period == pytest.approx(period, abs=0.51 * 10.0**-period_digits)
        if fraction == 0.1:
            assert radius == pytest.approx(RADIUS[name], abs=0.51e-3)
        if name == "newmark":
            assert radius == pytest.approx(1 / np.sqrt(1 + omega_h**2), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "omega_h", "radius", "steps"),
    [
        ("newmark", 100.0, 1 / np.sqrt(1 + 100.0**2), 4),
        ("houbolt", 100.0, 0.048, 10),
        ("wilson 1.4", 300.0, 0.778, 10),
        ("wilson 2", 300.0, 0.634, 10),
        ("trapezoid", 100.0, 1.0, 10),
        ("generalized_alpha 0.8", 100.0, 0.835, 10),
        ("generalized_alpha 0", 100.0, 0.048, 8),
        ("hht_alpha -1/3", 100.0, 0.537, 14),
    ],
)
def test_radius_at_high_frequencies(name, omega_h, radius, steps):
    start = {"x0": 1e-3 / omega_h**2, "v0": 1e-3 / omega_h / (omega_h / OMEGA["lumped"])}
    found = np.abs(response(name, omega_h, steps=steps, **start)).max()
    assert found == pytest.approx(np.abs(SCHEMES[name][3](omega_h)).max(), rel=1e-4)
    assert found == pytest.approx(radius, abs=0.51e-3)


def test_radius_in_the_limit():
    """What the matrices that the runs agree with tend to: rho_inf, Wilson's 0.778, the bifurcation of Chung and Lee."""
    for name, radius in (("generalized_alpha 0.8", 0.8), ("hht_alpha -1/3", 0.5), ("wilson 1.4", 0.778)):
        assert np.abs(SCHEMES[name][3](1e7)).max() == pytest.approx(radius, abs=0.51e-3)
    omega_b = np.sqrt(27 / 8)
    # a triple eigenvalue, which a sequence resolves to the third root of rounding
    assert np.abs(response("chung_lee 28/27", omega_b)).max() == pytest.approx(0.5, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCHEMES)
def test_order(name, comm, shared_tmp_path):
    """Error of the position after one period, by full runs with 200 and 400 steps: second order but Hu's."""
    integrator, parameters, _, _ = SCHEMES[name]
    period = 2 * np.pi / OMEGA["lumped"]
    errors = []
    for steps in (200, 400):
        case = oscillator.case(integrator, parameters, h=period / steps, end=0.8 * period, velocity=1e-3)
        folder = shared_tmp_path / f"{steps}"
        Simulation(case, comm, output=folder, quiet=True).run()
        history = open_result(folder).history
        x = history["probe/mass/position"][:, 0, 0] - oscillator.LENGTH
        exact = 1e-3 / OMEGA["lumped"] * np.sin(OMEGA["lumped"] * history["time"])
        errors.append(np.abs(x - exact).max())
    order = 1.0 if name == "newmark" else 2.0
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


def bounded(name, omega_h, damping_ratio=0.0, mass="lumped", steps=1500, start=1e-5):
    """Whether a tiny motion stays tiny."""
    integrator, parameters, _, _ = SCHEMES[name]
    it = stepper(omega_h, integrator, parameters, mass, damping_ratio, x0=start, v0=-start)
    found = displacements(it, steps)
    return bool(np.abs(found).max() < 1e-3)


@pytest.mark.parametrize("name", LIMITS)
def test_stability_limit(name):
    assert bounded(name, 0.99 * LIMITS[name])
    assert not bounded(name, 1.01 * LIMITS[name])
    if name in DAMPED_LIMITS:
        assert bounded(name, 0.99 * DAMPED_LIMITS[name], 0.1)
        assert not bounded(name, 1.01 * DAMPED_LIMITS[name], 0.1)


def test_limit_with_consistent_mass():
    assert bounded("central_differences", 1.98, mass="consistent", steps=300)
    assert not bounded("central_differences", 2.02, mass="consistent", steps=300)


@pytest.mark.parametrize("name", [n for n in SCHEMES if n in LIMITS])
@pytest.mark.parametrize("damping_ratio", [0.0, 0.1])
def test_program_knows_the_limit(name, damping_ratio, comm):
    """The critical step of the plan, and the refusal of a step above it."""
    integrator, parameters, _, _ = SCHEMES[name]
    if damping_ratio and name not in DAMPED_LIMITS:
        return
    limit = (DAMPED_LIMITS if damping_ratio else LIMITS)[name]

    def plan(h):
        case = oscillator.case(integrator, parameters, damping_ratio=damping_ratio, h=h)
        return make_plan(Model(case, comm))

    critical = limit / OMEGA["lumped"]
    assert plan(0.5 * critical).critical_step == pytest.approx(critical, rel=1e-3)
    plan(0.999 * critical)
    with pytest.raises(InputError, match=r"time\.step = .* above the limit of .* unstable"):
        plan(1.01 * critical)


@pytest.mark.parametrize("name", ["newmark", "houbolt", "wilson 1.4", "generalized_alpha 0.8"])
def test_implicit_schemes_have_no_limit(name):
    assert bounded(name, 300.0, steps=100, start=1e-9)  # Wilson's first steps overshoot by Omega^2


@pytest.mark.slow
def test_newmark_with_a_limit_of_its_own():
    """Limit of beta = 0.1, gamma = 1/2: stable to Omega = 1/sqrt(gamma/2 - beta)."""
    limit = 1 / np.sqrt(0.15)
    for factor, stays in ((0.99, True), (1.01, False)):
        it = stepper(factor * limit, "newmark", {"beta": 0.1, "gamma": 0.5}, x0=1e-5, v0=-1e-5)
        assert (np.abs(displacements(it, 600)).max() < 1e-3) == stays


@pytest.mark.slow
def test_wilson_below_its_threshold_has_a_limit():
    """Theta = 1.3: where the program says."""
    case = oscillator.case("wilson", {"theta": 1.3}, h=1e-3)
    limit = make_plan(Model(case, stepper(1.0, "newmark").model.comm)).critical_step * OMEGA["lumped"]
    assert 1.0 < limit < 20.0
    for factor, stays in ((0.99, True), (1.01, False)):
        it = stepper(factor * limit, "wilson", {"theta": 1.3}, x0=1e-5, v0=-1e-5)
        assert (np.abs(displacements(it, 3000)).max() < 1e-3) == stays
