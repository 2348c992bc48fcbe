"""The elastoplastic law along strain paths: sub-stepped integration of the rates, consistency, work."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pfem_petsc.mechanics.materials.elastoplastic import Parameters
from pfem_petsc.mechanics.materials.elastoplastic import response as law

YOUNG = 200e9


def pack(material):
    return Parameters(density=1.0, **vars(material)).pack()


moduli = st.sampled_from([0.0, 1e9, 20e9, 300e9])
yields = st.floats(50e6, 500e6)
paths = st.lists(st.floats(-0.01, 0.01), min_size=1, max_size=5)
materials = st.builds(
    lambda s, k, h: SimpleNamespace(young_modulus=YOUNG, yield_stress=s, isotropic_hardening=k, kinematic_hardening=h),
    yields,
    moduli,
    moduli,
)


def response(strain, p, history, k, commit):
    """The law on row k of a history array, as the bars' loops use it."""
    stress, tangent, variables, (elastic, heat, hardening) = law(strain, 0.0, 0.0, 0.0, p, tuple(history[k]))
    if commit:
        history[k] = variables
    return stress, tangent, elastic, heat, hardening


def integrated(m, path, pieces):
    """The rate equations by many small strain steps: elastic inside the yield surface, else not."""
    stress = plastic = accumulated = before = work = 0.0
    k, h = m.isotropic_hardening, m.kinematic_hardening
    for target in path:
        d = (target - before) / pieces
        for _ in range(pieces):
            relative = stress - h * plastic
            inside = abs(relative) < m.yield_stress + k * accumulated
            flow = 0.0 if inside or relative * d <= 0.0 else YOUNG * d / (YOUNG + k + h)
            after = stress + YOUNG * (d - flow)
            work += 0.5 * (stress + after) * d
            stress, plastic, accumulated = after, plastic + flow, accumulated + abs(flow)
        before = target
    return stress, plastic, accumulated, work


@given(materials, paths)
def test_strain_path_follows_the_rate_equations(material, path):
    p, history, before = pack(material), np.zeros((1, 2)), 0.0
    for strain in path:
        stress, *_ = response(strain, p, history, 0, True)
    pieces = 400
    expected = integrated(material, path, pieces)
    moved = np.abs(np.diff([before, *path])).max() * (1 + len(path))
    slack = 2.0 * moved / pieces + 1e-15  # yielding is noticed up to a strain step late
    assert abs(stress - expected[0]) <= YOUNG * slack
    assert abs(history[0, 0] - expected[1]) <= slack
    assert abs(history[0, 1] - expected[2]) <= slack


@given(materials, paths)
def test_every_step_is_admissible_and_consistent(material, path):
    p, history = pack(material), np.zeros((1, 2))
    k, h = material.isotropic_hardening, material.kinematic_hardening
    for strain in path:
        plastic, accumulated = history[0]
        stress, tangent, elastic, heat, hardening = response(strain, p, history, 0, True)
        relative = stress - h * history[0, 0]
        excess = abs(relative) - (material.yield_stress + k * history[0, 1])
        flow = history[0, 0] - plastic
        rounding = 1e-13 * (YOUNG * abs(strain) + (YOUNG + h) * abs(history[0, 0]) + material.yield_stress)
        assert excess <= rounding
        assert stress == pytest.approx(YOUNG * (strain - history[0, 0]), abs=rounding)
        assert history[0, 1] - accumulated == pytest.approx(abs(flow), rel=1e-9, abs=1e-17)
        if flow:
            assert abs(excess) <= rounding
            assert flow * relative >= 0.0
        plastic_modulus = pytest.approx(YOUNG * (k + h) / (YOUNG + k + h), rel=1e-14)
        if abs(flow) > rounding / YOUNG:
            assert tangent == plastic_modulus
        elif excess < -rounding:
            assert tangent == YOUNG
        else:  # on the yield surface, to rounding: either
            assert tangent in (YOUNG, plastic_modulus)
        assert elastic == pytest.approx(0.5 * stress * stress / YOUNG, rel=1e-9, abs=1e-3)
        assert heat == pytest.approx(material.yield_stress * history[0, 1], rel=1e-14)
        stored = 0.5 * (k * history[0, 1] ** 2 + h * history[0, 0] ** 2)
        assert hardening == pytest.approx(stored, rel=1e-13)
        again = response(strain, p, history, 0, False)
        assert again[0] == pytest.approx(stress, abs=rounding)


@given(materials, paths)
def test_work_of_the_stress_is_stored_or_dissipated(material, path):
    """In many small steps: the integral of stress over strain is the change of elastic, heat and hardening energy."""
    p, history, before, work, stress = pack(material), np.zeros((1, 2)), 0.0, 0.0, 0.0
    pieces, sizes = 200, 0.0
    for target in path:
        for strain in np.linspace(before, target, pieces + 1)[1:]:
            after, _, elastic, heat, hardening = response(strain, p, history, 0, True)
            work += 0.5 * (stress + after) * (strain - before)
            stress, before = after, strain
        sizes += 1.0
    # the trapezoidal rule errs only in the steps in which yielding sets in, by less than E d^2 each
    step = 0.02 / pieces
    assert work == pytest.approx(elastic + heat + hardening, abs=YOUNG * step**2 * (sizes + 1.0) + 1e-6)
    assert heat >= 0.0


def test_trial_states_leave_no_trace():
    material = SimpleNamespace(
        young_modulus=YOUNG, yield_stress=100e6, isotropic_hardening=1e9, kinematic_hardening=2e9
    )
    history = np.zeros((1, 2))
    response(0.01, pack(material), history, 0, False)
    assert not history.any()


def test_closed_cycle_of_pure_kinematic_hardening():
    """From +e to -e and back: the plastic strain at the ends is the bilinear law's, and the loop repeats."""
    yield_stress, h, e = 100e6, 10e9, 0.004
    material = SimpleNamespace(
        young_modulus=YOUNG, yield_stress=yield_stress, isotropic_hardening=0.0, kinematic_hardening=h
    )
    p, history = pack(material), np.zeros((1, 2))
    plastic = (YOUNG * e - yield_stress) / (YOUNG + h)
    for strain in (e, -e, e, -e):
        stress, *_ = response(strain, p, history, 0, True)
        assert history[0, 0] == pytest.approx(np.sign(strain) * plastic, rel=1e-12)
        assert stress == pytest.approx(np.sign(strain) * (yield_stress + h * plastic), rel=1e-12)
    assert history[0, 1] == pytest.approx(7.0 * plastic, rel=1e-12)
