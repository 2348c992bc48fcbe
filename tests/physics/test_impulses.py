"""Momentum is the sum of impulses: of contact and its jumps, damping, and moving supports."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import SCHEMES, case, run, unexplained
from mpi4py import MPI

from pfem_petsc import Case, Simulation


@pytest.mark.parametrize("treatment", ["scheme", "stick", "conserving", "mass_redistribution", "consistent"])
@pytest.mark.parametrize("integrator", SCHEMES)
def test_momentum_is_that_of_impulses_and_jumps(integrator, treatment, shared_tmp_path):
    """Each force's impulse by the scheme's own rule, and what treatments change, make the momentum of the truss."""
    if treatment == "conserving" and integrator not in ("newmark", "houbolt", "energy_momentum"):
        pytest.skip("the scheme does not go with the treatment")
    if treatment == "mass_redistribution" and integrator in ("chung_lee", "hulbert_chung"):
        pytest.skip("the scheme does not go with the treatment")
    mass = "consistent" if treatment == "consistent" else "lumped"
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=60,
            mass=mass,
            treatment="scheme" if treatment == "consistent" else treatment,
            mesh={"generator": "rod", "length": 1.0, "elements": 4},
            node_set={"tip": {"nearest": [1.0, 0.0, 0.0]}, "root": {"nearest": [0.0, 0.0, 0.0]}},
            walls=[{"point": [1.007, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "tip"}],
            support=[{"node_set": "root", "fix": "y"}],
            load=[{"node_set": "root", "force": [3.0, 2.0, 0.0], "table": [[0.0, 1.0], [0.03, -1.0], [1.0, 0.0]]}],
            initial={"velocity": [1.0, 0.0, 0.0]},
        ),
        shared_tmp_path,
    )
    assert history["wall/wall0/contacts"].any()
    assert unexplained(history) < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()
    if treatment == "conserving":
        assert np.abs(history["wall/wall0/jump_impulse"]).max() > 0.01
    if treatment in ("conserving", "mass_redistribution"):
        assert not history["impact_dissipation"].any()


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("integrator", SCHEMES)
def test_impulses_of_supports_that_move(integrator, mass, shared_tmp_path):
    """Velocities that a motion prescribes are not the scheme's: the difference is an impulse of the support."""
    motion = [[0.0, 0.0, 0.0, 0.0], [0.01, 0.005, 0.001, 0.0], [0.02, 0.006, -0.002, 0.0], [0.03, 0.0, 0.0, 0.0]]
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=40,
            mass=mass,
            mesh={"generator": "rod", "length": 1.0, "elements": 3},
            node_set={"root": {"nearest": [0.0, 0.0, 0.0]}},
            support=[{"node_set": "root", "fix": "xyz", "motion": motion}],
        ),
        shared_tmp_path,
    )
    assert np.abs(history["support_impulse"]).max() > 0.1
    assert unexplained(history) < 1e-9
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()


@pytest.mark.parametrize("integrator", ["central_differences", "hulbert_chung"])
def test_consistent_mass_of_explicit_schemes_leaves_no_impulse(integrator, tmp_path):
    """What the solver leaves of a balance is an impulse that nothing accounts for: 2e-9 of the momentum before."""
    truss = Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "bcc", "cells": [1, 3, 2], "pitch": 0.25},
            "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
            "section": {"s": {"area": 1e-3, "material": "m"}},
            "node_set": {"bottom": {"group": "bottom"}},
            "support": [{"node_set": "bottom", "fix": "xy", "velocity": [0.2, -0.1, 0.0]}],
            "gravity": {"acceleration": [100.0, -20.0, -180.0]},
            "initial": {"velocity": [-1.0, 1.0, 1.0], "angular_velocity": [0.0, 0.6, -1.0]},
            "time": {"integrator": integrator, "mass": "consistent", "step": 4e-4, "end": 0.04},
            "output": {"fields_every": 0},
            "solver": {"linear": "cg", "rtol": 1e-9},
        }
    )
    simulation = Simulation(truss, MPI.COMM_SELF, output=tmp_path, quiet=True)
    rows = [step.row for step in simulation]
    change = rows[-1]["momentum"] - rows[0]["momentum"]
    impulses = sum(rows[-1][name] - rows[0][name] for name in ("external_impulse", "support_impulse"))
    assert np.abs(change - impulses).max() < 2e-11 * np.abs(rows[-1]["momentum"]).max()
    energy = rows[-1]["kinetic_energy"] + rows[-1]["elastic_energy"]
    assert abs(rows[-1]["energy_imbalance"]) < 2e-11 * energy
