"""Massless nodes are in equilibrium at any time, even next to moving supports."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import MIDDLE, case, run, unexplained


@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "houbolt", "generalized_alpha"])
@pytest.mark.parametrize("load", ["gravity", "heat"])
def test_nodes_without_mass_start_in_equilibrium(integrator, load, shared_tmp_path):
    """Loads that massless nodes are not in equilibrium with at the start, and changing temperatures, open nothing."""
    more = {"gravity": {"acceleration": [30.0, 0.0, 0.0]}}
    if load == "heat":
        more = {
            "temperature": [{"table": [[0.0, 20.0], [0.02, 200.0], [1.0, 0.0]]}],
            "initial": {"velocity": [0.5, 0.0, 0.0]},
        }
        more["material"] = {"default": {"young_modulus": 1e4, "density": 1.0, "thermal_expansion": 1e-5}}
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=60,
            treatment="mass_redistribution",
            mesh={"generator": "rod", "length": 1.0, "elements": 4},
            node_set={"tip": {"nearest": [1.0, 0.0, 0.0]}},
            walls=[{"point": [1.01, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "node_set": "tip"}],
            **more,
        ),
        shared_tmp_path,
    )
    assert history["wall/wall0/contacts"].any()
    scale = max(np.abs(history[name]).max() for name in ("kinetic_energy", "elastic_energy"))
    assert np.abs(history["energy_imbalance"]).max() < 1e-11 * scale
    assert unexplained(history) < 1e-11


@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "generalized_alpha"])
def test_supports_that_move_beside_nodes_without_mass(integrator, shared_tmp_path):
    """The mass of a node on an oblique wall couples the components of its neighbour, whose x a support moves."""
    history = run(
        case(
            integrator,
            step=1e-3,
            steps=40,
            treatment="mass_redistribution",
            mesh={"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 0.5},
            node_set={"right": {"group": "right"}, "left": {"group": "left"}, "middle": {"box": MIDDLE}},
            walls=[{"point": [0.51, 0.5, 0.0], "normal": [-2.0, -1.0, 0.5], "node_set": "right"}],
            support=[
                {"node_set": "middle", "fix": "x", "motion": [[0.0, 0, 0, 0], [0.015, 0.02, 0, 0], [1.0, 0, 0, 0]]}
            ],
            initial={"velocity": [0.2, 0.1, 0.0]},
        ),
        shared_tmp_path,
    )
    assert np.abs(history["external_work"]).max() > 0.0
    scale = max(np.abs(history[name]).max() for name in ("kinetic_energy", "elastic_energy"))
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * scale
    assert unexplained(history) < 1e-9


def test_a_node_without_mass_turns_round_its_bar(shared_tmp_path):
    """The bar comes square to the way of its node, where its force alone holds it: no move may be far."""
    history = run(
        case(
            "central_differences",
            step=1e-3,
            steps=300,
            treatment="mass_redistribution",
            mesh={"generator": "rod", "length": 1.0, "elements": 2},
            node_set={"tip": {"group": "end"}, "root": {"group": "start"}},
            walls=[{"point": [1.2, 0.1, 0.0], "normal": [-2.0, -1.0, 0.0], "node_set": "tip"}],
            support=[{"node_set": "root", "fix": "xyz", "motion": [[0.0, 0, 0, 0], [0.3, -0.5, 2.0, 0]]}],
            initial={"velocity": [0.0, -3.0, 0.0]},
        ),
        shared_tmp_path,
    )
    scale = max(np.abs(history[name]).max() for name in ("kinetic_energy", "elastic_energy"))
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * scale
