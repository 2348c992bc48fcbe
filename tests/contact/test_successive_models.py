"""Models that run after one another in a process do not see each other."""

import numpy as np
import pytest
from petsc4py import PETSc

from pfem_petsc import Case, Simulation

pytestmark = pytest.mark.parallel


def wall_force(comm, folder, name, *overrides):
    case = Case.load(name, ["time.integrator=wilson", "time.theta=1.5", "output.fields_every=0", *overrides])
    simulation = Simulation(case, comm, output=folder, quiet=True)
    return np.array([step.row["wall/wall/force"][0] for step in simulation])


def test_tolerance_on_bounds_is_that_of_the_model(comm, shared_tmp_path):
    """A ring of 46 m takes a node 5e-13 m off its wall for touching; a rod of 1 m after it must not."""
    wall_force(comm, shared_tmp_path / "ring", "ring_impact", "time.step=5e-4", "time.end=0.007")
    assert not PETSc.Options("pfem_contact_").hasName("snes_vi_zero_tolerance")
    force = wall_force(comm, shared_tmp_path / "rod", "rod_impact", "time.end=0.9")
    assert (force[40:] < -0.4).all()
