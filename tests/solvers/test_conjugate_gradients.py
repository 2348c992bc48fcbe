"""Conjugate gradients in loops of this program, and how accurately linear systems are solved."""

import numpy as np
import pytest
from petsc4py import PETSc

from pfem_petsc import Case, Simulation
from pfem_petsc.solvers.matrix_free import pass_less_often

STEP = 4e-6  # twice the passage of a wave through a cell
LATTICE = {
    "mesh": {"generator": "lattice", "kind": "cubic", "cells": [6, 5, 4], "pitch": 0.01},
    "node_set": {"foot": {"group": "bottom"}},
    "material": {"m": {"young_modulus": 110e9, "density": 4500.0}},
    "section": {"s": {"area": 1e-6, "material": "m"}},
    "initial": {"angular_velocity": [0.0, 0.0, 600.0]},
    "time": {"integrator": "newmark", "step": STEP, "end": 12 * STEP},
    "solver": {"operator": "matrix_free", "linear": "cg"},
    "output": {"fields_every": 0},
}


def solve(ksp, matrix, right):
    """Solution and number of iterations of a linear solver."""
    left = right.duplicate()
    ksp.setOperators(matrix)
    ksp.setTolerances(rtol=1e-9)
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.solve(right, left)
    found = left.array.copy(), ksp.getIterationNumber(), ksp.getConvergedReason()
    left.destroy()
    return found


@pytest.mark.parallel
@pytest.mark.parametrize("restricted", [False, True])
def test_the_method_is_that_of_petsc(restricted, comm, shared_tmp_path):
    supported = {"support": [{"node_set": "foot", "fix": "z"}], "initial": {"velocity": [1.0, 2.0, -20.0]}}
    simulation = Simulation(Case.from_dict(LATTICE | supported), comm, output=shared_tmp_path / "out", quiet=True)
    steps = iter(simulation)
    next(steps)
    whole = simulation.stepper.hessian.mat
    matrix = whole
    if restricted:
        first, last = whole.getOwnershipRange()
        some = PETSc.IS().createGeneral(np.arange(first, last, dtype=PETSc.IntType)[::2], comm=comm)
        matrix = whole.createSubMatrix(some, some)
    right = matrix.createVecLeft() if not restricted else PETSc.Vec().createMPI(matrix.getSizes()[0], comm=comm)
    place = np.arange(*right.getOwnershipRange())
    right.array[:] = np.sin(1.0 + place)
    ksp = PETSc.KSP().create(comm)
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    expected, iterations, reason = solve(ksp, matrix, right)
    pass_less_often(ksp, simulation.stepper.hessian)
    assert ksp.getType() == "python"
    found, ours, why = solve(ksp, matrix, right)
    assert (ours, why) == (iterations, reason) and iterations > 10
    largest = comm.allreduce(np.abs(expected).max(initial=0.0), op=max)
    assert comm.allreduce(np.abs(found - expected).max(initial=0.0), op=max) < 1e-9 * largest
    ksp.destroy()
    right.destroy()
    steps.close()
    simulation.stepper.destroy()


def test_an_indefinite_matrix_is_reported(comm, tmp_path):
    simulation = Simulation(Case.from_dict(LATTICE), comm, output=tmp_path / "out", quiet=True)
    steps = iter(simulation)
    next(steps)
    hessian = simulation.stepper.hessian
    hessian.stored *= -1.0  # its largest eigenvalues
    hessian.bars.take()
    right = hessian.mat.createVecLeft()
    right.array[:] = np.sin(1.0 + np.arange(len(right.array)))
    ksp = PETSc.KSP().create(comm)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.getPC().setType("jacobi")
    pass_less_often(ksp, hessian)
    *_, reason = solve(ksp, hessian.mat, right)
    reasons = PETSc.KSP.ConvergedReason
    assert reason in (reasons.DIVERGED_INDEFINITE_MAT, reasons.DIVERGED_INDEFINITE_PC)
    ksp.destroy()
    right.destroy()
    steps.close()
    simulation.stepper.destroy()


@pytest.mark.parametrize("operator", ["matrix_free", "assembled"])
def test_smooth_steps_take_one_iteration(operator, comm, tmp_path):
    """The first linear solve is as accurate as linearisation allows, and the residual is the required one."""
    case = Case.from_dict(LATTICE | {"solver": {"operator": operator, "linear": "cg"}})
    simulation = Simulation(case, comm, output=tmp_path / "out", quiet=True)
    made = [(step.newton, step.linear) for step in simulation]
    newton, linear = np.array(made[4:]).T
    assert (newton == 1).all()
    assert linear.mean() > 1.5 * made[0][1] / made[0][0]
    simulation.stepper.destroy()


def test_options_for_the_accuracy_of_linear_solves_are_followed(comm, tmp_path):
    options = PETSc.Options()
    options["pfem_ksp_rtol"] = 1e-2
    try:
        simulation = Simulation(Case.from_dict(LATTICE), comm, output=tmp_path / "out", quiet=True)
        newton = [step.newton for step in simulation]
    finally:
        options.delValue("pfem_ksp_rtol")
    assert min(newton) > 1
    simulation.stepper.destroy()
