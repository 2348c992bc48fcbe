"""Motions from tables: interpolation, exact derivatives, integrals."""

from types import SimpleNamespace

import numpy as np
import pytest

from pfem_petsc.mechanics.motion import motion_of, spline_slopes


def motion(rows=None, interpolation="smooth", velocity=None, acceleration=None):
    rows = None if rows is None else [[row[0], row[1], 0.0, -row[1]] for row in rows]
    return motion_of(
        SimpleNamespace(motion=rows, velocity=velocity, interpolation=interpolation, acceleration=acceleration)
    )


def along(it, times):
    """Displacement, velocity and acceleration along x, (times, 3)."""
    return np.array([it.at(time)[:, 0] for time in times])


def test_two_rows_are_an_s():
    it = motion([[1.0, 0.0], [3.0, 0.4]])
    s = np.linspace(0.01, 0.99, 21)
    found = along(it, 1.0 + 2.0 * s)
    np.testing.assert_allclose(found[:, 0], 0.4 * s * s * (3.0 - 2.0 * s), atol=1e-15)
    np.testing.assert_allclose(found[:, 1], 0.2 * 6.0 * s * (1.0 - s), atol=1e-15)
    np.testing.assert_allclose(found[:, 2], 0.1 * 6.0 * (1.0 - 2.0 * s), atol=1e-14)
    np.testing.assert_array_equal(it.at(2.0)[:, 2], -it.at(2.0)[:, 0])
    assert (along(it, [0.0, 0.5]) == 0.0).all()
    assert (along(it, [3.0, 5.0]) == [0.4, 0.0, 0.0]).all()


def test_derivatives_are_those_of_the_displacement():
    rows = np.column_stack([np.cumsum([0.0, 0.3, 0.1, 0.4, 0.2, 0.3, 0.2]), [0.0, 0.1, 0.3, 0.2, -0.3, 0.1, 0.1]])
    for it in (motion(rows.tolist()), motion(acceleration=[[t, x, 0.0, -x] for t, x in rows])):
        times, d = np.linspace(0.011, 1.44, 83), 1e-5
        before, here, after = along(it, times - d), along(it, times), along(it, times + d)
        np.testing.assert_allclose((after - before)[:, 0] / (2 * d), here[:, 1], atol=1e-8)
        np.testing.assert_allclose((after - before)[:, 1] / (2 * d), here[:, 2], atol=2e-4)


def test_second_derivative_is_continuous_between_first_and_last_row():
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.uniform(0.1, 1.0, 12))
    it = motion(np.column_stack([times, rng.normal(size=12)]).tolist())
    for time in times[1:-1]:
        before, after = it.at(time, ahead=False), it.at(time)
        np.testing.assert_allclose(before, after, atol=1e-12 * np.abs(after).max())
    assert it.at(times[0])[1, 0] == 0.0 and it.at(times[-1], ahead=False)[1, 0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    "values",
    [[0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, 0.5, 1.0, 1.0, 0.5, 0.0, 0.0]],
)
def test_rows_that_stand_still_are_a_rest(values):
    """No swing beyond a ramp's end, and exactly nothing while it is held."""
    it = motion([[float(t), x] for t, x in enumerate(values)])
    times = np.linspace(0.0, len(values) - 1.0, 40 * len(values))
    found = along(it, times)
    assert found[:, 0].min() >= -1e-15 and found[:, 0].max() <= 1.0 + 1e-15
    for k in np.flatnonzero(np.diff(values) == 0.0):
        assert (along(it, np.linspace(k, k + 0.99, 9)) == [values[k], 0.0, 0.0]).all()


def test_crest_of_a_sampled_wave_is_no_rest():
    """Two equal samples beside a crest: acceleration is largest there."""
    times = 0.02 * np.arange(-30, 31) + 0.01
    it = motion(np.column_stack([times, np.cos(2.0 * np.pi * times).round(12)]).tolist())
    near = np.linspace(-0.2, 0.2, 41)
    exact = -((2.0 * np.pi) ** 2) * np.cos(2.0 * np.pi * near)
    np.testing.assert_allclose(along(it, near)[:, 2], exact, rtol=3e-3)


def test_accelerations_are_second_order():
    errors = []
    for h in (0.04, 0.02):
        times = np.arange(0.0, 4.0 + 0.5 * h, h)
        it = motion(np.column_stack([times, 1.0 - np.cos(2.0 * np.pi * times)]).tolist())
        at = np.linspace(1.0, 3.0, 333)
        errors.append(np.abs(along(it, at)[:, 2] - (2.0 * np.pi) ** 2 * np.cos(2.0 * np.pi * at)).max())
    assert errors[1] < 0.3 * errors[0] and errors[1] < 0.01 * (2.0 * np.pi) ** 2


def test_accelerations_are_integrated_exactly():
    it = motion(acceleration=[[0.5, 2.0, 0.0, 0.0], [1.5, 4.0, 0.0, 0.0], [2.5, -1.0, 0.0, 0.0]])
    assert (it.at(0.4) == 0.0).all()
    np.testing.assert_allclose(it.at(1.0)[:, 0], [0.25 + 0.125 / 3.0, 1.25, 3.0], rtol=1e-15)
    np.testing.assert_allclose(it.at(1.5)[:, 0], [1.0 + 1.0 / 3.0, 3.0, 4.0], rtol=1e-15)
    v, x = 3.0 + 1.5, 4.0 / 3.0 + 3.0 + 2.0 - 5.0 / 6.0
    np.testing.assert_allclose(it.at(3.5)[:, 0], [x + v, v, 0.0], rtol=1e-15, atol=1e-15)


def test_linear_tables_and_constant_velocities():
    it = motion([[0.0, 0.0], [1.0, 0.5], [2.0, 0.2]], "linear")
    assert it.at(0.25)[:, 0] == pytest.approx([0.125, 0.5, 0.0])
    assert it.at(1.0)[1, 0] == pytest.approx(-0.3) and it.at(1.0, ahead=False)[1, 0] == pytest.approx(0.5)
    # a jump of velocity is an acceleration over the step that it falls into, and that only
    steps = [it.at(0.1 * k, span=0.1)[2, 0] for k in range(25)]
    assert steps == pytest.approx([-8.0 if k == 10 else 3.0 if k == 20 else 0.0 for k in range(25)], abs=1e-12)
    moved = motion(velocity=(2.0, 0.0, 0.0)).at(3.0)
    assert (moved == [[6.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]).all()


@pytest.mark.filterwarnings("error")
def test_a_row_alone_stands_still():
    np.testing.assert_array_equal(spline_slopes(np.array([0.5]), np.array([2.0])), [0.0])
