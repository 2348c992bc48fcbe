"""Cases with all kinds of loads, connectors and supports at once: bitwise over restarts, and as on one rank."""

import numpy as np
import pytest
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case

PARAMETERS = {"wilson": {"theta": 1.5}}
STEP = 2e-4


def case(integrator, mass):
    """A lattice that swings on an inclined support; a leg and a support of it go, and stages follow one another."""
    time = {"integrator": integrator, "mass": mass, "step": STEP, "end": 40 * STEP, **PARAMETERS.get(integrator, {})}
    return Case.from_dict(
        {
            "mesh": {"generator": "lattice", "kind": "cubic", "cells": [2, 2, 2], "pitch": 0.5},
            "node_set": {
                "foot": {"group": "bottom"},
                "corner": {"nearest": [1.0, 1.0, 1.0]},
                "side": {"nearest": [0.0, 1.0, 1.0]},
            },
            "material": {"it": {"young_modulus": 1e6, "density": 1000.0, "damping": 50.0, "thermal_expansion": 1e-5}},
            "section": {
                "it": {"area": 1e-4, "material": "it"},
                "edges": {"area": 2e-4, "material": "it", "bars": "edges", "pretension": [[0.0, 0.0], [0.007, 5.0]]},
            },
            "support": [
                {"node_set": "foot", "normal": [0.0, 0.6, 0.8]},
                {"name": "held", "node_set": "corner", "fix": "x"},
            ],
            "remove": [{"supports": "held", "time": 10.3 * STEP, "duration": 9.1 * STEP}],
            "spring": [
                {"node_set": "foot", "stiffness": [500.0, 800.0, 300.0], "frame": [[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0]]},
                {"between": ["corner", "side"], "stiffness": 400.0},
            ],
            "dashpot": [
                {"node_set": "corner", "coefficient": 0.3},
                {"between": ["corner", "side"], "coefficient": 2.0},
            ],
            "mass": [{"node_set": "corner", "value": 0.2}],
            "wind": {"velocity": [[0.0, 0.0, 0.0, 0.0], [0.015, 0.0, 30.0, 0.0]], "density": 1.2},
            "gravity": {"acceleration": [[0.0, 0.0, 0.0, -9.8], [0.012, 3.0, 0.0, -9.8]]},
            "temperature": [{"table": [[0.0, 0.0], [0.004, 30.0], [0.016, -10.0]]}],
            "initial": {"velocity": [0.3, 0.0, 0.0], "angular_velocity": [0.0, 0.0, 2.0]},
            "stage": [
                {"name": "one", "time": time | {"damping_table": [[0.0, 1.0], [0.01, 3.0]]}},
                {"name": "two", "time": time, "load": [{"node_set": "side", "force": [9.0, 0.0, 1.0]}]},
            ],
            "solver": {"linear": "cg", "rtol": 1e-12},
            "output": {"fields_every": 0, "probe": [{"name": "side", "node_set": "side"}]},
        }
    )


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize(
    ("integrator", "mass"),
    [
        ("central_differences", "lumped"),
        ("central_differences", "consistent"),
        ("energy_momentum", "lumped"),
        ("wilson", "consistent"),
        ("generalized_alpha", "consistent"),
    ],
)
def test_everything_is_bitwise_over_restarts_and_as_on_one_rank(integrator, mass, comm, shared_tmp_path):
    it = case(integrator, mass)
    history = assert_restart_is_bitwise(it, comm, shared_tmp_path, 15, 47, allowed=1e-9 if comm.size > 1 else 0.0)
    assert np.abs(history["energy_imbalance"]).max() < 1e-9 * history["kinetic_energy"].max()
    for name in ("thermal_work", "prestress_work", "viscous_dissipation", "damping_dissipation", "external_work"):
        assert np.ptp(history[name]) > 0.0, name
    assert_as_on_one_rank(history, it, comm, shared_tmp_path, "probe/side/position", "elastic_energy")
