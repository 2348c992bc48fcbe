"""Filters and spectra against closed forms and the standard's recursion."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc.errors import InputError
from pfem_petsc.post.curves import (
    WINDOWS,
    amplitude_spectrum,
    butterworth,
    cfc,
    make_filter,
    window_mean,
)

RATE = 10_000.0
TIME = np.arange(4001) / RATE


def response(filtered: np.ndarray, frequency: float) -> complex:
    """Complex amplitude of a filtered sine, away from the ends; 1 where it is unchanged."""
    inner = slice(1000, 3000)  # whole periods of multiples of 5 Hz
    return complex(2j * np.mean(filtered[inner] * np.exp(-2j * np.pi * frequency * TIME[inner])))


@pytest.mark.parametrize(("size", "corner"), [(60, 100.0), (180, 300.0), (600, 1000.0)])
def test_channel_classes_have_the_gain_and_phase_of_the_standard(size, corner):
    """|H|^2 of two passes: 1/(1 + (tan(pi f h)/tan(pi f_d h))^4), one half at f_d = 2.0775 CFC; no phase."""
    for frequency in (0.2 * corner, corner, 1.25 * corner, 2.0 * corner):
        frequency = 5.0 * round(frequency / 5.0)
        found = response(cfc(TIME, np.sin(2 * np.pi * frequency * TIME), size), frequency)
        ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 2.0775 * size / RATE)
        assert found == pytest.approx(1.0 / (1.0 + ratio**4), abs=1e-9)
    # limits of SAE J211-1: -0.5..+0.5 dB up to the class, -3 dB at the corner (1.65 times the class) within 1 dB
    at_class = response(cfc(TIME, np.sin(2 * np.pi * size * TIME), size), size)
    assert abs(20 * np.log10(abs(at_class))) < 0.5
    at_corner = response(cfc(TIME, np.sin(2 * np.pi * corner * TIME), size), corner)
    assert 20 * np.log10(abs(at_corner)) == pytest.approx(-3.0, abs=0.2)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_butterworth_has_half_the_power_at_its_cutoff(order):
    for frequency in (200.0, 500.0, 800.0):
        found = response(butterworth(TIME, np.sin(2 * np.pi * frequency * TIME), 500.0, order), frequency)
        ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 500.0 / RATE)
        assert found == pytest.approx(1.0 / (1.0 + (2**0.5 - 1.0) * ratio ** (2 * order)), abs=1e-8)
        if frequency == 500.0:
            assert abs(found) == pytest.approx(2**-0.5)


def test_constants_and_lines_pass_to_the_ends():
    line = 3.0 + 40.0 * TIME
    assert cfc(TIME, line, 60.0) == pytest.approx(line, rel=1e-9)
    assert butterworth(TIME, line, 50.0, 6) == pytest.approx(line, rel=1e-9)


def test_names_tell_the_cutoff():
    assert make_filter("cfc:180").name == "CFC 180 of SAE J211-1 (two passes, −3 dB at 300 Hz)"
    assert make_filter("butterworth:250:4").name == "Butterworth of order 4 (two passes, −3 dB at 250 Hz)"
    values = np.random.default_rng(1).normal(size=len(TIME))
    assert np.array_equal(make_filter("none").apply(TIME, values), values)
    # the mean of a sine over 0.4429 periods has half of its power
    name, apply = make_filter("mean:0.004429")
    assert "−3 dB at 100 Hz" in name
    assert abs(response(apply(TIME, np.sin(2 * np.pi * 100.0 * TIME)), 100.0)) == pytest.approx(2**-0.5, abs=2e-3)


@pytest.mark.parametrize("window", WINDOWS)
def test_spectrum_of_a_sine_has_its_amplitude(window):
    time = np.arange(1000) / 1000.0
    values = 7.0 + 2.5 * np.cos(2 * np.pi * 60.0 * time + 0.3) + 0.5 * np.sin(2 * np.pi * 200.0 * time)
    frequency, amplitude = amplitude_spectrum(time, values, window)
    assert frequency[60] == pytest.approx(60.0) and frequency[-1] == pytest.approx(500.0)
    assert amplitude[[60, 200]] == pytest.approx([2.5, 0.5], rel=1e-9)
    assert amplitude[0] < 1e-12 * 7.0
    # halfway between two frequencies: the loss that the description states
    lost = amplitude_spectrum(time, np.cos(2 * np.pi * 60.5 * time), window)[1].max()
    loss = {"rectangular": 3.92, "hann": 1.42, "hamming": 1.75, "blackman": 1.10, "flattop": 0.01}[window]
    assert -20 * np.log10(lost) == pytest.approx(loss, abs=0.06)


def test_highest_frequency_of_an_even_number_of_rows():
    values = np.where(np.arange(64) % 2, -1.0, 1.0)
    assert amplitude_spectrum(np.arange(64) * 0.5, values, "rectangular")[1][-1] == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["cfc:180", "butterworth:300:4"])
def test_forces_are_zero_before_the_run(name):
    """A spike in the first row is filtered as if rows of zero came before; odd reflection keeps it as it is."""
    values = np.exp(-TIME / 0.02)
    values[0] += 50.0
    before = np.concatenate([np.zeros(4000), values])
    longer = np.concatenate([TIME[:4000] - 4000 / RATE, TIME])
    apply = make_filter(name).apply
    found = apply(TIME, values, True)
    assert found == pytest.approx(apply(longer, before)[4000:], abs=1e-9)
    assert found.max() < 0.2 * values[0] < apply(TIME, values).max()


@pytest.mark.parametrize("rows", [101, 201, 401])
def test_mean_of_a_spike_in_the_first_row_does_not_grow(rows):
    """A force F, and an impulse P in the first row: the mean is (P/2 + F t)/w up to the window w, then at most F."""
    time = np.linspace(0.0, 1.0, rows)
    impulse, force, width = 3.0, 2.0, 0.2
    values = np.full(rows, force)
    values[0] += impulse * (rows - 1)
    found = window_mean(time, values, width, zero_before=True)
    inside = (time > 0.0) & (time < width - 1e-9)
    assert found[inside] == pytest.approx((0.5 * impulse + force * time[inside]) / width)
    assert found[time > width + 2.0 / rows] == pytest.approx(force)
    assert found[0] == 0.0


def test_filters_that_the_history_cannot_carry_are_refused():
    """Ten rows per second and unit of the class; a period of the corner; three rows; more than two rows per period."""

    def apply(name, rows, end):
        time = np.linspace(0.0, end, rows)
        return make_filter(name).apply(time, np.ones(rows), False)

    assert apply("cfc:100", 1001, 1.0) == pytest.approx(1.0)
    with pytest.raises(InputError, match="CFC 100 needs 1000 rows of the history per second, and this one has 990"):
        apply("cfc:100", 991, 1.0)
    with pytest.raises(InputError, match="CFC 100 is slower than the history of 4.000 ms"):
        apply("cfc:100", 101, 0.004)
    for name in ("cfc:100", "butterworth:5"):
        with pytest.raises(InputError, match="three rows or more, and this one has 2"):
            apply(name, 2, 0.001)
    with pytest.raises(InputError, match="500 Hz needs 1005 rows of the history per second, and this one has 1000"):
        apply("butterworth:500", 1001, 1.0)
    assert apply("butterworth:497", 1001, 1.0) == pytest.approx(1.0)
    # one long interval is too long, however short the others are
    time = np.concatenate([np.linspace(0.0, 1.0, 2001), [1.002], np.linspace(1.003, 2.0, 2001)])
    with pytest.raises(InputError, match="this one has 500 where they are farthest apart"):
        cfc(time, np.ones(len(time)), 100.0)
