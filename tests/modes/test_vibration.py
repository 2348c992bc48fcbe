"""Natural frequencies and shapes against closed forms, and against dense matrices that are put together here."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from helpers.small_models import ARCH_AREA, ARCH_YOUNG, arch_of, press

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.modes import pencil
from pfem_petsc.output.result import open_result

LENGTH, AREA, YOUNG, DENSITY = 2.54, 1.979325e-6, 2.06842719e11, 7801.433  # VM53
STRAIN, BARS = 0.00543228, 13
TENSION = YOUNG * AREA * STRAIN
SOLVERS = ["dense", "scipy", "slepc"]


def needs(solver):
    package = {"slepc": "slepc4py", "scipy": "scipy"}.get(solver)
    if package and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")


def modes_of(case, folder, comm):
    """Values, eigenvalues and shapes of a run's modes, and its positions at the end, on all ranks. Collective."""
    assert Simulation(case, comm, output=folder, quiet=True).run() == 0
    found = None
    if comm.rank == 0:
        result = open_result(folder)
        modes = result.modes
        found = modes.values, modes.eigenvalue, modes.shape, result.positions(-1)
    return comm.bcast(found)


def string(solver="auto", mass="lumped", count=10, bars=BARS, **tables):
    """A cable along x between fixed ends, pulled taut by cooling."""
    return Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": LENGTH, "elements": bars},
            "node_set": {"start": {"group": "start"}, "end": {"group": "end"}},
            "material": {"steel": {"young_modulus": YOUNG, "density": DENSITY, "thermal_expansion": 1e-5}},
            "section": {"cable": {"area": AREA, "material": "steel"}},
            "temperature": [{"value": -STRAIN / 1e-5}],
            "support": [{"node_set": end, "fix": "xyz"} for end in ("start", "end")],
            "modes": {"count": count, "mass": mass, "solver": solver},
            **tables,
        }
    )


def chain(k, mass, bars=BARS):
    """Frequencies [Hz] of a taut chain of equal bars: T/l (2 - 2 cos a) x = omega^2 m x, a = k pi/n; with consistent
    mass m (4 + 2 cos a)/6."""
    a, l = np.pi * np.asarray(k) / bars, LENGTH / bars
    inertia = DENSITY * AREA * l * (1.0 if mass == "lumped" else (4.0 + 2.0 * np.cos(a)) / 6.0)
    return np.sqrt(TENSION / l * (2.0 - 2.0 * np.cos(a)) / inertia) / (2.0 * np.pi)


@pytest.mark.parallel
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_ten_frequencies_of_a_taut_cable(solver, mass, shared_tmp_path, comm):
    needs(solver)
    frequency, eigenvalue, shape, _ = modes_of(string(solver, mass), shared_tmp_path, comm)
    k = np.repeat(np.arange(1, 6), 2)
    assert frequency == pytest.approx(chain(k, mass), rel=1e-10)
    assert eigenvalue == pytest.approx((2.0 * np.pi * frequency) ** 2, rel=1e-12)
    # each pair is split into the planes of y and z; the largest component is positive
    sines = np.sin(np.pi * np.outer(k, np.arange(BARS + 1)) / BARS)
    for mode, sine in zip(shape, sines, strict=True):
        axis = int(np.argmax(np.abs(mode).max(axis=0)))
        assert np.abs(np.delete(mode, axis, axis=1)).max() < 1e-9 * mode.max()
        assert np.abs(mode[:, axis]).argmax() == mode[:, axis].argmax() or mode.max() == pytest.approx(-mode.min())
        assert abs(mode[:, axis] @ sine) == pytest.approx(np.linalg.norm(mode[:, axis]) * np.linalg.norm(sine))


def test_values_of_ansys_for_a_taut_string(shared_tmp_path, comm):
    """VM53: 13 bars with consistent mass 74.890, 150.875, 229.060 Hz."""
    frequency, *_ = modes_of(Case.load("taut_cable"), shared_tmp_path, comm)
    assert frequency[:6:2] == pytest.approx([74.890, 150.875, 229.060], rel=3e-5)


def block(solver="auto", **modes):
    return Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "octet", "cells": [2, 2, 3], "pitch": 0.1},
            "material": {"it": {"young_modulus": 1e9, "density": 1000.0}},
            "section": {"it": {"area": 1e-5, "material": "it"}},
            "modes": {"count": 20, "solver": solver, **modes},
        }
    )


def dense(points, bars, young, area, density, mass):
    """K and M of unstressed bars, node by node and bar by bar."""
    stiff, inert = np.zeros((2, 3 * len(points), 3 * len(points)))
    for a, b in bars:
        way = points[b] - points[a]
        length = np.linalg.norm(way)
        here = np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
        unit = np.outer(way, way) / length**2
        stiff[np.ix_(here, here)] += young * area / length * np.kron([[1, -1], [-1, 1]], unit)
        pattern = [[0.5, 0.0], [0.0, 0.5]] if mass == "lumped" else [[1 / 3, 1 / 6], [1 / 6, 1 / 3]]
        inert[np.ix_(here, here)] += density * area * length * np.kron(pattern, np.eye(3))
    return stiff, inert


@pytest.mark.parallel
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_free_octet_block(solver, mass, shared_tmp_path, comm):
    """Six zeros first, then what a dense solve gives; shapes are orthonormal in M and satisfy K x = lambda M x."""
    needs(solver)
    frequency, eigenvalue, shape, points = modes_of(block(solver, mass=mass), shared_tmp_path, comm)
    assert (frequency[:6] == 0.0).all()
    bars = comm.bcast(open_result(shared_tmp_path).bars if comm.rank == 0 else None)
    stiff, inert = dense(points, bars, 1e9, 1e-5, 1000.0, mass)
    reference = np.sort(np.linalg.eigvals(np.linalg.solve(inert, stiff)).real)[:20]
    assert eigenvalue[6:] == pytest.approx(reference[6:], rel=1e-8)
    vectors = shape.reshape(20, -1)
    assert vectors @ inert @ vectors.T == pytest.approx(np.eye(20), abs=1e-8)
    force = stiff @ vectors.T
    assert np.abs(force - inert @ vectors.T * eigenvalue).max() < 1e-8 * np.abs(force).max()
    # translations first, then rotations
    moved = shape[:3] / np.abs(shape[:3]).max()
    assert moved == pytest.approx(np.broadcast_to(np.eye(3)[:, None], moved.shape), abs=1e-8)


def test_state_under_load(shared_tmp_path, comm):
    """Pressed to half its limit load, the arch has the stiffness of its path there."""
    case = arch_of(shared_tmp_path, comm, press(0.5), modes={"count": 1})
    frequency, _, _, points = modes_of(case, shared_tmp_path / "out", comm)
    z = points[1, 2]
    length, rest = np.hypot(1.0, z), np.hypot(1.0, 0.1)
    stiffness = 2.0 * ARCH_YOUNG * ARCH_AREA * (1.0 / rest - 1.0 / length + z * z / length**3)
    mass = 1000.0 * ARCH_AREA * rest
    assert z < 0.095
    assert frequency == pytest.approx([np.sqrt(stiffness / mass) / (2.0 * np.pi)], rel=1e-9)


@pytest.mark.parallel
@pytest.mark.parametrize("held", [False, True])
def test_multigrid_in_place_of_a_factorisation(held, shared_tmp_path, comm, monkeypatch):
    """As for models that are too large to be factorised; the numbers are those of dense matrices."""
    pytest.importorskip("slepc4py")
    data = block("dense", count=8).to_dict()
    if held:
        data |= {"node_set": {"feet": {"group": "bottom"}}, "support": [{"node_set": "feet", "fix": "xyz"}]}
    expected = modes_of(Case.from_dict(data), shared_tmp_path / "dense", comm)
    monkeypatch.setattr(pencil, "FACTORISED_UP_TO", 0)
    data["modes"]["solver"] = "slepc"
    found = modes_of(Case.from_dict(data), shared_tmp_path / "multigrid", comm)
    assert found[0] == pytest.approx(expected[0], rel=1e-8)
    assert found[2] == pytest.approx(expected[2], abs=1e-8 * np.abs(expected[2]).max())


def test_buckled_state(shared_tmp_path, comm):
    """A spring pushes the arch to where its own stiffness is negative; the frequency is that of both together."""
    import h5py

    if comm.rank == 0:
        with h5py.File(shared_tmp_path / "mesh.h5", "w") as file:
            file["points"] = np.array([[-1.0, 0, 0], [0, 0, 0.1], [1.0, 0, 0], [0, 0, 1.1]])
            file["bars"] = [[0, 1], [1, 2], [1, 3]]
            file["bar_groups/spring"] = [2]
    comm.Barrier()
    spring = 0.05 * ARCH_AREA
    case = Case.from_dict(
        {
            "mesh": {"file": "mesh.h5"},
            "node_set": {"held": {"indices": [0, 2]}, "driver": {"indices": [3]}, "apex": {"indices": [1]}},
            "material": {"it": {"young_modulus": ARCH_YOUNG, "density": 1000.0}},
            "section": {
                "arch": {"area": ARCH_AREA, "material": "it"},
                "spring": {"bars": "spring", "area": spring, "material": "it"},
            },
            "support": [
                {"node_set": "held", "fix": "xyz"},
                {"node_set": "apex", "fix": "xy"},
                {"node_set": "driver", "fix": "xyz", "motion": [[0, 0, 0, 0], [1, 0, 0, -0.09]]},
            ],
            "static": {"step": 0.1},
            "modes": {"count": 1},
        },
        folder=shared_tmp_path,
    )
    _, eigenvalue, _, points = modes_of(case, shared_tmp_path / "out", comm)
    z = points[1, 2]
    length, rest = np.hypot(1.0, z), np.hypot(1.0, 0.1)
    own = 2.0 * ARCH_YOUNG * ARCH_AREA * (1.0 / rest - 1.0 / length + z * z / length**3)
    assert own < 0.0
    mass = 1000.0 * (ARCH_AREA * rest + 0.5 * spring)
    assert eigenvalue == pytest.approx([(own + ARCH_YOUNG * spring) / mass], rel=1e-9)


def test_unstable_state(shared_tmp_path, comm, capfd):
    """Two bars in line that heat compresses: the middle node is unstable across, with -2N/l/m as eigenvalue."""
    case = string("auto", count=3, bars=2, temperature=[{"value": STRAIN / 1e-5}])
    frequency, eigenvalue, _, _ = modes_of(case, shared_tmp_path, comm)
    half = LENGTH / 2
    expected = -2.0 * TENSION / half / (DENSITY * AREA * half)
    axial = 2.0 * YOUNG * AREA / half / (DENSITY * AREA * half)
    assert eigenvalue == pytest.approx([expected, expected, axial], rel=1e-9)
    assert frequency[:2] == pytest.approx(-np.sqrt(-expected) / (2.0 * np.pi), rel=1e-9)
    if comm.rank == 0:
        assert "unstable equilibrium: 2 eigenvalues are negative" in capfd.readouterr().err


@pytest.mark.parametrize("solver", SOLVERS)
def test_lowest_of_a_very_unstable_state_come_first(solver, shared_tmp_path, comm):
    """Negative eigenvalues far below zero are not missed, whatever the shift that a solver begins with."""
    needs(solver)
    heated = string(solver, count=8, temperature=[{"value": STRAIN / 1e-5}])
    _, eigenvalue, _, _ = modes_of(heated, shared_tmp_path, comm)
    k = np.repeat(np.arange(BARS - 1, BARS - 5, -1), 2)
    assert eigenvalue == pytest.approx(-((2.0 * np.pi * chain(k, "lumped")) ** 2), rel=1e-9)


def test_more_modes_than_there_are(shared_tmp_path, comm):
    frequency, *_ = modes_of(string("auto", count=50, bars=2), shared_tmp_path, comm)
    assert len(frequency) == 3


def test_yielded_bars_vibrate_with_the_tangent_of_unloading(shared_tmp_path, comm):
    """Bars that cooling has made yield are on the yield surface; small vibrations about the state unload them."""
    material = {
        "young_modulus": YOUNG,
        "density": DENSITY,
        "thermal_expansion": 1e-5,
        "yield_stress": 0.5 * YOUNG * STRAIN,
        "kinematic_hardening": 0.01 * YOUNG,
    }
    case = string("auto", count=3, bars=2, material={"steel": material})
    _, eigenvalue, _, _ = modes_of(case, shared_tmp_path, comm)
    half = LENGTH / 2
    assert eigenvalue[2] == pytest.approx(2.0 * YOUNG / half / (DENSITY * half), rel=1e-6)


@pytest.mark.parallel
def test_nothing_can_move(shared_tmp_path, comm):
    data = string(count=1, bars=1)
    with pytest.raises(SimulationFailure, match="nothing can move"):
        Simulation(data, comm, output=shared_tmp_path / "out", quiet=True).run()
