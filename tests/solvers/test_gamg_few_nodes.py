"""Multigrid of a truss with a few nodes on each rank."""

from __future__ import annotations

import pytest

from pfem_petsc import Case, Simulation, open_result

_MISSING = {"missing": 0.0716596031064765, "dangling": "keep"}


@pytest.mark.parallel
def test_gamg_serves_ranks_with_two_nodes(comm, shared_tmp_path):
    case = Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "bcc_diagonals", "cells": [1, 1, 1], "pitch": 0.1, **_MISSING},
            "material": {"it": {"young_modulus": 1.4e7, "density": 1000.0}},
            "section": {"it": {"area": 2.5e-4, "material": "it"}},
            "initial": {"angular_velocity": [1.0, -5.0, -0.3]},
            "time": {"integrator": "central_differences", "mass": "consistent", "step": 2e-4, "end": 1e-2},
            "output": {"fields_every": 0},
            "solver": {"linear": "gamg", "operator": "matrix_free"},
        }
    )
    run = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
    assert run.run() == 0
    assert run.state.step == 50
    history = open_result(shared_tmp_path / "out").history
    assert abs(history["energy_imbalance"]).max() < 1e-8 * history["kinetic_energy"].max()
