"""What ``check`` tells of the lowest frequency and of the steps in its period."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.runs import inspected

from pfem_petsc import Case, Truss

FREQUENCY = np.sqrt(1e4 / 2.0) / (2.0 * np.pi)


def oscillator(**time):
    return Case.from_dict(
        {
            "mesh": Truss([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [(0, 1)]),
            "material": {"m": {"young_modulus": 1e8, "density": 1e-6}},
            "section": {"s": {"area": 1e-4, "material": "m"}},
            "node_set": {"base": {"indices": [0]}, "mass": {"indices": [1]}},
            "support": [{"node_set": "base", "fix": "xyz"}, {"node_set": "mass", "fix": "yz"}],
            "mass": [{"node_set": "mass", "value": 2.0}],
            "time": {"end": 1.0, **time},
        }
    )


@pytest.mark.parametrize(("steps", "advised"), [(25.0, True), (50.0, False)])
def test_steps_of_a_period(steps, advised):
    case = oscillator(integrator="newmark", step=1.0 / (steps * FREQUENCY))
    entries, warnings = inspected(case)
    assert entries["lowest frequency"] == f"11.25 Hz in the initial state, {steps:g} steps a period"
    told = [text for text in warnings if "in the period of the lowest frequency" in text]
    assert len(told) == advised
    assert not told or "take 40 for damped motion and 100, 888.6 µs, for resonance" in told[0]


def test_explicit_steps_are_not_compared():
    entries, _ = inspected(oscillator(integrator="central_differences", step=1e-4))
    assert "lowest frequency" not in entries
