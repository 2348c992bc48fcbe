"""Waves and vibrations of chains and lattices against dispersion relations."""

import numpy as np
import pytest
from helpers.runs import run

from pfem_petsc import Case

ELEMENTS, LENGTH, YOUNG, DENSITY, AREA = 20, 1.0, 1e9, 1000.0, 1e-4
STRAIN = 0.01
SPEED = np.sqrt(YOUNG / DENSITY)


def frequency(time, signal):
    """Angular frequency of a signal that oscillates about zero, by its zero crossings."""
    at = np.flatnonzero(np.sign(signal[1:]) != np.sign(signal[:-1]))
    crossings = time[at] - signal[at] * (time[at + 1] - time[at]) / (signal[at + 1] - signal[at])
    return np.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])


def fixed_chain(tmp_path, mode, axis, periods, step, integrator="central_differences", mass="lumped"):
    """A chain between fixed ends, taut by cooling where it moves crosswise, started in one mode; time and midpoint."""
    rest = LENGTH / ELEMENTS
    shape = 1e-5 * np.sin(mode * np.pi * np.arange(ELEMENTS + 1) / ELEMENTS)
    nodes = {f"n{k}": {"nearest": [k * rest, 0.0, 0.0]} for k in range(ELEMENTS + 1)}
    velocity = np.zeros(3)
    velocity[axis] = 1.0
    case = {
        "mesh": {"generator": "rod", "length": LENGTH, "elements": ELEMENTS},
        "node_set": {**nodes, "ends": {"indices": [0, ELEMENTS]}},
        "material": {"it": {"young_modulus": YOUNG, "density": DENSITY, "thermal_expansion": 1e-5}},
        "section": {"it": {"area": AREA, "material": "it"}},
        "initial": {"on": [{"node_set": f"n{k}", "velocity": list(s * velocity)} for k, s in enumerate(shape)]},
        "support": [{"node_set": "ends", "fix": "xyz"}],
        "time": {"integrator": integrator, "step": step, "end": periods, "mass": mass},
        "output": {"fields_every": 0, "probe": [{"name": "it", "node_set": f"n{ELEMENTS // (2 * mode)}"}]},
        "solver": {"rtol": 1e-12},
    }
    if axis != 0:
        case["temperature"] = [{"value": -STRAIN / 1e-5}]
    if integrator == "newmark":
        case["time"] |= {"beta": 0.25, "gamma": 0.5}
    history = run(Case.from_dict(case), tmp_path / f"{mode}{axis}")
    return history["time"], history["probe/it/velocity"][:, 0, axis]


@pytest.mark.parametrize("mode", [1, 2])
def test_longitudinal_modes(mode, tmp_path):
    """Longitudinal modes: omega = 2 (c/l) sin(k pi/2N) with lumped mass."""
    size = LENGTH / ELEMENTS
    omega = 2.0 * SPEED / size * np.sin(mode * np.pi / (2 * ELEMENTS))
    time, v = fixed_chain(tmp_path, mode, 0, 6.3 * 2 * np.pi / omega, 0.02 * size / SPEED)
    assert frequency(time, v) == pytest.approx(omega, rel=1e-4)


@pytest.mark.parametrize("mode", [1, 2])
def test_transverse_modes_of_a_taut_chain(mode, tmp_path):
    """Taut chain: c_t = sqrt(T l/(rho A l0)), omega = 2 (c_t/l) sin(k pi/2N); tension by cooling, so that l = l0."""
    size = LENGTH / ELEMENTS
    speed = np.sqrt(YOUNG * STRAIN / DENSITY)
    omega = 2.0 * speed / size * np.sin(mode * np.pi / (2 * ELEMENTS))
    time, v = fixed_chain(tmp_path, mode, 2, 4.3 * 2 * np.pi / omega, 0.2 * size / SPEED)
    assert frequency(time, v) == pytest.approx(omega, rel=1e-4)
    assert speed == pytest.approx(omega * LENGTH / (mode * np.pi), rel=2e-2)


@pytest.mark.slow
def test_longitudinal_mode_with_consistent_mass(tmp_path):
    """Consistent mass: omega^2 = 6 (c/l)^2 (1 - cos q)/(2 + cos q), q = k pi/N, above the continuum's."""
    size, q = LENGTH / ELEMENTS, 4 * np.pi / ELEMENTS
    omega = SPEED / size * np.sqrt(6.0 * (1.0 - np.cos(q)) / (2.0 + np.cos(q)))
    period = 2 * np.pi / omega
    time, v = fixed_chain(tmp_path, 4, 0, 4.3 * period, period / 400, "newmark", "consistent")
    assert frequency(time, v) == pytest.approx(omega, rel=1e-4)
    assert omega > 4 * np.pi * SPEED / LENGTH


@pytest.mark.parametrize(("axis", "share"), [(0, 1.0), (1, 0.5), (2, 0.5)])
def test_long_waves_in_an_octet_lattice(axis, share, tmp_path):
    """A lattice four cells thick: speeds sqrt(C/(relative density rho_s)), to the share of its surface bars.

    C_11 = sqrt(2) E A/l^2 and C_12 = C_44 = C_11/2 for pure shear; struts of length l = pitch/sqrt(2).
    """
    cells, pitch, area = 16, 0.1, 1e-5
    strut = pitch / np.sqrt(2.0)
    stiffness = share * np.sqrt(2.0) * YOUNG * area / strut**2
    density = 6.0 * np.sqrt(2.0) * area / strut**2 * DENSITY
    speed = np.sqrt(stiffness / density)
    length = cells * pitch
    # standing wave cos(pi x/L) between free ends; no motion across, so that the strain is uniaxial or pure shear
    planes = np.arange(2 * cells + 1) * 0.5 * pitch
    sets = {f"p{k}": {"box": [[x - 1e-6, -1.0, -1.0], [x + 1e-6, 1.0, 1.0]]} for k, x in enumerate(planes)}
    direction = np.eye(3)[axis]
    fixed = "".join(c for k, c in enumerate("xyz") if k != axis)
    start = [
        {"node_set": f"p{k}", "velocity": list(1e-4 * np.cos(np.pi * x / length) * direction)}
        for k, x in enumerate(planes)
    ]
    omega = np.pi * speed / length
    case = Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": [cells, 4, 4], "pitch": pitch},
            "node_set": {**sets, "all": {"all": True}},
            "material": {"it": {"young_modulus": YOUNG, "density": DENSITY}},
            "section": {"it": {"area": area, "material": "it"}},
            "initial": {"on": start},
            "support": [{"node_set": "all", "fix": fixed}],
            "time": {
                "integrator": "central_differences",
                "step": "auto",
                "safety": 0.5,
                "end": 1.3 * 2 * np.pi / omega,
            },
            "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "p0"}]},
        }
    )
    history = run(case, tmp_path / "it")
    v = history["probe/end/velocity"][:, :, axis].mean(axis=1)
    assert frequency(history["time"], v) / omega == pytest.approx(1.0, abs=0.015)
