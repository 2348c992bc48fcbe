"""Models that run after one another in a process do not see each other."""

import numpy as np
import pytest

from pfem_petsc import Case, Simulation

pytestmark = pytest.mark.parallel


def wall_force(comm, folder, name, *overrides):
    case = Case.load(name, ["time.integrator=wilson", "time.theta=1.5", "output.fields_every=0", *overrides])
    simulation = Simulation(case, comm, output=folder, quiet=True)
    return np.array([step.row["wall/wall/force"][0] for step in simulation])


def test_tolerance_on_bounds_is_that_of_the_model(comm, shared_tmp_path):
    """A ring of 46 m takes a node 5e-13 m off its wall for touching; a rod of 1 m after it must not."""
    rod = ("rod_impact", "time.end=0.9")
    before = wall_force(comm, shared_tmp_path / "before", *rod)
    wall_force(comm, shared_tmp_path / "ring", "ring_impact", "time.step=5e-4", "time.end=0.007")
    after = wall_force(comm, shared_tmp_path / "after", *rod)
    assert np.array_equal(before, after)
    assert (after[40:] < -0.4).all()
