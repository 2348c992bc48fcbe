"""Stability of contact over the phases of an impact: the small rod, the program itself, the warning and the page."""

import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.contact.impact_phases import Asked, scan_impacts
from pfem_petsc.registry import lookup
from pfem_petsc.stepping.contact_check import BOUND, contact_gain
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.prepare import make_plan, make_stepper

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
import impact_phases as table  # noqa: E402

TRAPEZOID = {"beta": 0.25, "gamma": 0.5}


def scheme(integrator, parameters):
    module = lookup("pfem_petsc.integrators", integrator, "")
    return module.Scheme(module.Parameters(**parameters))


@pytest.mark.parametrize(
    ("integrator", "parameters", "treatment", "mass", "step", "restitution"),
    [
        ("central_differences", {}, "scheme", "lumped", 0.9, 0.0),
        ("central_differences", {}, "mass_redistribution", "lumped", 0.9, 0.0),
        ("chung_lee", {}, "stick", "lumped", 0.84, 0.0),
        ("newmark", {}, "scheme", "consistent", 5.0, 0.0),
        ("newmark", TRAPEZOID, "scheme", "lumped", 5.0, 0.0),
        ("newmark", TRAPEZOID, "conserving", "lumped", 1.0, 0.0),
        ("newmark", TRAPEZOID, "mass_redistribution", "lumped", 5.0, 0.0),
        ("houbolt", {}, "stick", "lumped", 1.0, 0.0),
        ("houbolt", {}, "conserving", "lumped", 5.0, 0.0),
        ("wilson", {"theta": 1.5}, "stick", "lumped", 5.0, 0.0),
        ("wilson", {"theta": 1.5}, "scheme", "consistent", 1.0, 0.0),
        ("generalized_alpha", {}, "scheme", "lumped", 1.0, 0.0),
        ("energy_momentum", {}, "conserving", "lumped", 1.0, 0.0),
        ("energy_momentum", {}, "mass_redistribution", "lumped", 5.0, 0.0),
        ("newmark", TRAPEZOID, "stick", "lumped", 20.0, 0.0),
        ("newmark", TRAPEZOID, "scheme", "lumped", 1.0, 1.0),
        ("chung_lee", {"beta": 1.0}, "stick", "lumped", 0.9, 0.5),
        ("central_differences", {}, "scheme", "lumped", 0.9, 1.0),
    ],
)
def test_small_rod_and_program_agree(integrator, parameters, treatment, mass, step, restitution):
    """A linear rod with dense matrices, written for itself, does in all phases what the program does."""
    found = table.impacts(integrator, parameters, treatment, mass, step, restitution)
    expected = scan_impacts(scheme(integrator, parameters), Asked(treatment, mass == "consistent", step, restitution))
    np.testing.assert_allclose(found.largest, expected.largest, rtol=1e-9)
    np.testing.assert_allclose(found.last, expected.last, rtol=1e-9)
    np.testing.assert_allclose(found.force, expected.force, rtol=1e-9)
    np.testing.assert_array_equal(found.releases, expected.releases)
