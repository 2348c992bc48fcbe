"""Models that run one after the other in a process do not affect each other."""

import gc

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, simulation
from petsc4py import PETSc

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.solvers import matrix_free as restricted


def wall_force(comm, folder, name, *overrides):
    case = Case.load(name, ["time.integrator=wilson", "time.theta=1.5", "output.fields_every=0", *overrides])
    simulation = Simulation(case, comm, output=folder, quiet=True)
    return np.array([step.row["wall/wall/force"][0] for step in simulation])


@pytest.mark.slow
def test_tolerance_on_bounds_is_that_of_the_model(comm, shared_tmp_path):
    """A ring of 46 m takes a node 5e-13 m off its wall for touching; a rod of 1 m after it must not."""
    wall_force(comm, shared_tmp_path / "ring", "ring_impact", "time.step=5e-4", "time.end=0.007")
    assert not PETSc.Options("pfem_contact_").hasName("snes_vi_zero_tolerance")
    force = wall_force(comm, shared_tmp_path / "rod", "rod_impact", "time.end=0.9")
    assert (force[40:] < -0.4).all()


def resting(steps, **tables):
    """A lattice that lies on a floor."""
    tables = {"integrator": "newmark", "cells": (2, 2, 2), "gravity": (0.0, 0.0, -9.81), **tables}
    return lattice_case(planes([[0.0, 0.0, 1.0]], [0.0]), step=1e-3, end=1e-3 * steps, **tables)


@pytest.mark.parallel
@pytest.mark.slow
def test_restrictions_to_inactive_unknowns_are_freed(comm, shared_tmp_path):
    """Every Newton iteration in contact makes a matrix of the inactive unknowns: PETSc keeps the last one alone."""

    def restrictions():
        gc.collect()
        # by type: isinstance would ask for what weak proxies stand for
        return sum(type(thing) is restricted.Restriction for thing in gc.get_objects())

    before = restrictions()  # of other tests' runs
    run = simulation(resting(25, solver={"operator": "matrix_free", "linear": "cg"}), comm, shared_tmp_path)
    iterations = sum(step.row["newton_iterations"] for step in run)
    assert iterations >= 25
    assert restrictions() - before <= 2
    run.stepper.destroy()
    run.stepper.destroy()
    assert restrictions() <= before


def test_consistent_mass_is_inverted_by_a_solver_with_options_and_a_check(comm, shared_tmp_path):
    case = resting(1, gravity=(1.0, 0.5, -9.81))
    case["time"]["mass"] = "consistent"
    for step in simulation(case, comm, shared_tmp_path):
        assert step.row["time"] >= 0.0
    options = PETSc.Options("pfem_mass_")
    options["ksp_max_it"] = 1
    try:
        with pytest.raises(SimulationFailure, match="consistent mass matrix: the limit of linear iterations"):
            list(simulation(case, comm, shared_tmp_path))
    finally:
        options.delValue("ksp_max_it")
