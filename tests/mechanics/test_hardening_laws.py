"""Nonlinear hardening, rates and softening along strain paths: closed forms, SciPy, tangents, work."""

import math

import numpy as np
import pytest
from helpers.twins import KEYS, RATES, SOFTENING, YOUNG, cycles, flow_stress, follow, integrated, make, yield_stress
from pydantic import ValidationError

STATIC = [name for name in KEYS if name not in RATES]
SIXTH = tuple(zip((-3, -2, -1, 1, 2, 3), (-1 / 60, 3 / 20, -3 / 4, 3 / 4, -3 / 20, 1 / 60), strict=True))


@pytest.mark.parametrize("name", STATIC)
def test_monotone_loading_follows_the_curve(name):
    """Tension in 1, 7 and 100 steps: strain = stress/E + plastic strain, with the stress of the curve."""
    hardening = KEYS[name].get("kinematic_hardening", 0.0)
    for plastic in (1e-9, 1e-4, 0.02):
        stress = yield_stress(name, plastic, KEYS[name]) + hardening * plastic
        for count in (1, 7, 100):
            path = np.linspace(0.0, stress / YOUNG + plastic, count + 1)[1:]
            found, _, q, _, _ = follow(name, path, np.ones(count))[-1]
            assert found == pytest.approx(stress, rel=1e-13)
            assert q[:2] == pytest.approx((plastic, plastic), rel=1e-9, abs=1e-16)


@pytest.mark.parametrize("name", KEYS)
@pytest.mark.parametrize("temperature", [0.0, 120.0])
def test_cyclic_path_is_integrated_as_by_scipy(name, temperature):
    path, steps = cycles()
    rows = follow(name, path, steps, temperature)
    expected = integrated(name, path, steps, temperature)
    stress = np.array([row[0] for row in rows])
    assert np.abs(stress - expected[:, 0]).max() < 1e-10 * np.abs(expected[:, 0]).max()
    for column in (0, 1):
        found = np.array([row[2][column] for row in rows])
        assert np.abs(found - expected[:, 1 + column]).max() < 1e-10 * np.abs(expected[:, 1 + column]).max()
    assert expected[-1, 2] > 0.03 > 2.0 * abs(expected[-1, 1])  # there and back
    if name in RATES:
        hardening = KEYS[name].get("kinematic_hardening", 0.0)
        dissipated = np.array([sum(row[3][1:]) for row in rows]) - 0.5 * hardening * expected[:, 1] ** 2
        assert np.abs(dissipated - expected[:, 3]).max() < 1e-10 * expected[-1, 3]
    if name == "johnson_cook":
        rise = np.array([row[2][4] for row in rows])
        assert np.abs(rise - expected[:, 4]).max() < 1e-10 * expected[-1, 4] and expected[-1, 4] > 1.0


@pytest.mark.parametrize("name", KEYS)
def test_energy_and_dissipation_are_the_work(name):
    """The work of the mean stress is elastic energy, heat and hardening energy, step by step; heat never falls."""
    path, steps = cycles(2)
    rows = follow(name, path, steps, 50.0)
    work, energy = np.array([row[4] for row in rows]), np.array([row[3] for row in rows])
    assert np.abs(work - energy.sum(axis=1)).max() < 1e-12 * work.max()
    assert (np.diff(energy[:, 1]) >= 0.0).all() and energy[-1, 1] > 0.5 * work[-1]


@pytest.mark.parametrize("name", STATIC)
def test_work_of_the_mean_stress_is_that_of_the_path(name):
    """The path in 1 step and in 4,000: same end, and the trapezoidal rule in small steps tends to the same work."""
    for ends in ((0.003,), (0.003, -0.004), (0.003, -0.004, 0.001)):
        path, before = [], 0.0
        for end in ends:
            path += list(np.linspace(before, end, 4001)[1:])
            before = end
        rows = follow(name, path, np.ones(len(path)))
        stress = np.array([0.0, *(row[0] for row in rows)])
        trapezoidal = float((0.5 * (stress[1:] + stress[:-1]) * np.diff([0.0, *path])).sum())
        assert follow(name, ends, np.ones(len(ends)))[-1][4] == pytest.approx(trapezoidal, rel=3e-6)


@pytest.mark.parametrize("name", [*KEYS, "elastic"])
@pytest.mark.parametrize("softens", [False, True])
def test_tangents_are_derivatives(name, softens):
    """Of stress and mean stress, at all points of the path away from kinks, by differences of sixth order."""
    keys = {"softening": SOFTENING} if softens else {}
    if softens and name == "johnson_cook":
        pytest.skip("has a softening of its own")
    (material, law), (path, steps) = make(name, **keys), cycles(3)
    p, q, before, stress0, d, checked = material.numbers(), (0.0,) * len(law.internal), 0.0, 0.0, 3e-7, 0
    for strain, h in zip(path, steps, strict=True):

        def stress(e, before=before, h=h, q=q):
            return law.response(e, (e - before) / h if law.rate else 0.0, h, 130.0, p, q)

        def mean(e, before=before, h=h, q=q, stress0=stress0):
            return law.mean_stress(stress0, before, e, h, 130.0, p, q)

        sides = [stress(strain + j * d)[1] for j, _ in SIXTH]
        if max(sides) - min(sides) < 0.02 * YOUNG:  # neither a kink nor nearly one
            functions = (stress,) if law.mean_stress is None else (stress, mean)
            for function in functions:
                if function is mean and abs(strain - before) < 10.0 * d:
                    continue
                slope = sum(c * function(strain + j * d)[0] for j, c in SIXTH) / d
                scale = YOUNG * (1.0 if max(sides) - min(sides) < 1e-4 * YOUNG else 1e3)
                assert function(strain)[1] == pytest.approx(slope, abs=1e-10 * scale), (strain, function)
                checked += 1
        stress0, _, q, _ = stress(strain)
        before = strain
    assert checked > 60


@pytest.mark.parametrize("name", RATES)
def test_slow_loading_is_static(name):
    """Small rates, and the infinite step of static analyses: the static curve, with the static tangent."""
    keys = {"melting_temperature": 1e30, "rate_reference": 1.0} if name == "johnson_cook" else {}
    keys |= {"rate_exponent": 1.0} if name == "cowper_symonds" else {}
    keys |= {"overstress_exponent": 1.0} if name == "perzyna" else {}
    static = "ludwik" if name == "johnson_cook" else "voce"
    same = {key: value for key, value in KEYS[name].items() if key in type(make(static)[0]).model_fields}
    path = cycles()[0]
    expected = follow(static, path, np.ones(len(path)), **({"kinematic_hardening": 0.0} | same))
    for size, accuracy in ((1e9, 1e-9), (math.inf, 1e-13)):
        rows = follow(name, path, np.full(len(path), size), **keys)
        for change, row, (stress, tangent, q, *_) in zip(np.diff([0.0, *path]), rows, expected, strict=True):
            assert row[0] == pytest.approx(stress, rel=accuracy, abs=accuracy * 1e9)
            assert row[2][:2] == pytest.approx(q[:2], rel=accuracy, abs=accuracy)
            if change:  # else the state is on the yield surface, where rounding decides
                assert row[1] == pytest.approx(tangent, rel=1e-6)
    # the static laws themselves without rates
    assert follow(name, [0.01], [math.inf])[0][0] == pytest.approx(flow_end(name, 0.01), rel=1e-12)


def flow_end(name, strain):
    """Stress after static loading in one step."""
    return integrated(name, [strain], [1e300])[0, 0]


def test_no_flow_while_no_time_passes():
    for name in RATES:
        stress, tangent, q, _, _ = follow_at_once(name, 0.01)
        assert stress == YOUNG * 0.01 and tangent == YOUNG and not any(q)


def follow_at_once(name, strain):
    material, law = make(name)
    return (*law.response(strain, 0.0, 0.0, 0.0, material.numbers(), (0.0,) * len(law.internal)), 0.0)


def test_relaxation_of_perzyna():
    """Linear overstress at constant strain: backward Euler is (1 + E g h/s_Y)^-k, and tends to exp(-E g t/s_Y)."""
    keys = {key: 0.0 for key in ("kinematic_hardening", "isotropic_hardening", "saturation_stress")}
    keys |= {"overstress_exponent": 1.0, "fluidity": 2.0, "yield_stress": 100e6}
    t, over = 4e-4, 200e6
    strain, ends = (100e6 + over) / YOUNG, []
    for count in (16, 32, 64, 128, 256, 512):
        h = t / count
        material, law = make("perzyna", **keys)
        p, q = material.numbers(), (0.0,) * len(law.internal)
        for k in range(count):
            stress, _, q, _ = law.response(strain, 0.0, h, 0.0, p, q)
            assert stress == pytest.approx(100e6 + over * (1.0 + YOUNG * 2.0 * h / 100e6) ** -(k + 1), rel=1e-13)
        # all of the elastic energy that is lost is heat
        assert q[2] == pytest.approx(0.5 * ((100e6 + over) ** 2 - stress**2) / YOUNG, rel=1e-12)
        ends.append(stress)
    table = np.array(ends)
    for order in range(1, len(ends)):  # extrapolation to h = 0
        table = table[1:] + (table[1:] - table[:-1]) / (2.0**order - 1.0)
    assert table[0] == pytest.approx(100e6 + over * math.exp(-YOUNG * 2.0 * t / 100e6), rel=1e-9)


@pytest.mark.filterwarnings("ignore:overflow")  # slopes at denormal plastic strains
@pytest.mark.parametrize("name", ["ludwik", "ramberg_osgood", "cowper_symonds", "perzyna", "johnson_cook"])
def test_flow_of_any_magnitude_is_found(name):
    """Trial stresses from 1e-12 above the yield stress to 1e4 times it, with steep curves and with flat ones."""
    steep = {
        "ludwik": {"hardening_exponent": 0.02, "strength_coefficient": 1e9, "kinematic_hardening": 0.0},
        "ramberg_osgood": {"exponent": 60.0},
        "cowper_symonds": {"rate_exponent": 30.0},
        "perzyna": {"overstress_exponent": 30.0},
        "johnson_cook": {"hardening_exponent": 0.02, "rate_coefficient": 2.0},
    }
    for keys in ({}, steep[name]):
        static = KEYS[name].get("yield_stress", 0.0)
        for h in (1e-9, 1.0):
            for more in 10.0 ** np.linspace(-12.0, 4.0, 33):
                strain = (static + 250e6 * more) / YOUNG
                stress, tangent, q, _, _ = follow(name, [strain], [h], **keys)[0]
                a, rise = q[1], q[4] if name == "johnson_cook" else 0.0
                least = -0.1 * YOUNG if name == "johnson_cook" else 0.0  # heating softens
                assert least <= tangent <= YOUNG and a >= 0.0
                there = KEYS[name] | keys
                expected = flow_stress(name, a, a / h, rise, there) + there.get("kinematic_hardening", 0.0) * a
                if a > 1e-300:
                    assert stress == pytest.approx(expected, rel=1e-12, abs=1e-12 * YOUNG * strain)


def test_rows_of_a_curve_are_refused():
    for curve, words in (
        ([[0.00125, -1.0]], "must be positive"),
        ([[0.003, 250e6]], "end of the elastic line"),
        ([[0.00125, 250e6], [0.01, 200e6]], "the stress decreases"),
        ([[0.00125, 250e6], [0.01, 300e6], [0.0101, 400e6]], "plastic strain"),
        ([], "at least 1"),
    ):
        with pytest.raises(ValidationError) as error:
            make("multilinear", curve=curve)
        assert words in str(error.value)


def test_softening_takes_factors_between_rows():
    material, law = make("voce", softening=SOFTENING)
    for temperature, modulus, strength in (
        (-20.0, 1.0, 1.0),
        (50.0, 0.95, 0.9),
        (250.0, 0.75, 0.55),
        (900.0, 0.6, 0.3),
    ):
        scaled = {key: strength * KEYS["voce"][key] for key in KEYS["voce"] if key != "saturation_rate"}
        expected = follow("voce", [0.01, -0.002], [1.0, 1.0], young_modulus=modulus * YOUNG, **scaled)
        found = follow("voce", [0.01, -0.002], [1.0, 1.0], temperature, softening=SOFTENING)
        for one, other in zip(found, expected, strict=True):
            assert one[0] == pytest.approx(other[0], rel=1e-13) and one[3] == pytest.approx(other[3], rel=1e-12)
    assert material.upper_modulus() == YOUNG and law.internal[-1] == ("hardening_energy_density", "J/m³")


@pytest.mark.parametrize("name", ["elastoplastic", "voce", "cowper_symonds"])
def test_heat_stays_when_bars_cool(name):
    """Dissipation is history: a bar that has yielded keeps heat and hardening energy at any later temperature."""
    material, law = make(name, softening=SOFTENING, yield_stress=250e6)
    p, q = material.numbers(), (0.0,) * len(law.internal)
    _, _, q, hot = law.response(0.006, 6.0, 1e-3, 300.0, p, q)
    plastic = q[0]
    _, _, q, cold = law.response(plastic, 0.0, 1e-3, -100.0, p, q)
    assert hot[1] > 0.0 and cold[1:] == hot[1:]
