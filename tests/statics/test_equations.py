"""Residual and Hessian for solvers of one's own."""

from __future__ import annotations

import numpy as np
import pytest
from petsc4py import PETSc

from pfem_petsc import Case, InputError, Simulation, Truss, open_result

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.8], [1.2, 0.9, 0.7]])
BARS = np.array([[0, 3], [1, 3], [2, 3], [1, 4], [2, 4], [3, 4]])


HOLDS = {"along an axis": {"fix": "x"}, "along a direction": {"normal": [1.0, 0.4, 0.1]}}


def case(hold="along an axis", **tables):
    lifted = {"node_set": "feet", "fix": "xyz", "motion": [[0, 0, 0, 0], [1, 0.01, 0, 0.02]], "interpolation": "linear"}
    given = {
        "node_set": {"feet": {"indices": [0, 1, 2]}, "tops": {"indices": [3, 4]}},
        "material": {"m": {"young_modulus": 1e6, "density": 1.0, "thermal_expansion": 1e-4, "strain": "green"}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "support": [lifted, {"node_set": "tops", **HOLDS[hold]}],
        "load": [{"node_set": "tops", "force": [0.0, 2.0, -5.0]}],
        "gravity": {"acceleration": [0.0, 0.0, -1e3]},
        "temperature": [{"value": 30.0}],
        "spring": [{"node_set": "tops", "stiffness": [0.0, 50.0, 0.0]}],
        "static": {"step": 0.5},
        "solver": {"rtol": 1e-12},
    }
    given = {key: table for key, table in (given | tables).items() if table is not None}
    return Case(given, mesh=Truss(POINTS, BARS), name="frame")


def solved(simulation):
    """Find the equilibrium at the last load factor with a SNES of one's own."""
    x = simulation.position_vector()
    residual, hessian = simulation.residual(x), simulation.hessian(x)
    snes = PETSc.SNES().create(simulation.comm)
    snes.setFunction(lambda snes, x, g: simulation.residual(x, out=g), residual)
    snes.setJacobian(lambda snes, x, a, p: simulation.hessian(x), hessian)
    snes.getKSP().setType("preonly")
    snes.getKSP().getPC().setType("lu")
    snes.getKSP().getPC().setFactorSolverType("mumps")
    snes.setTolerances(rtol=0.0, atol=1e-9, stol=0.0, max_it=40)
    snes.solve(None, x)
    assert snes.getConvergedReason() > 0
    found = simulation.gather(x.array.reshape(-1, 3))
    snes.destroy()
    return found


@pytest.mark.parallel
@pytest.mark.parametrize("hold", HOLDS)
def test_own_solver_finds_the_static_equilibrium(comm, shared_tmp_path, hold):
    with Simulation(case(hold), comm, output=shared_tmp_path / "own", quiet=True) as simulation:
        found = solved(simulation)
    with Simulation(case(hold), comm, output=shared_tmp_path / "static", quiet=True) as simulation:
        simulation.run()
        # at the solution the residual is zero, and elsewhere it is not
        assert simulation.residual(simulation.state.position).norm() < 1e-8
        assert simulation.residual(simulation.state.position, at=0.5).norm() > 1.0
    if comm.rank == 0:
        expected = open_result(shared_tmp_path / "static").positions(-1)
        assert np.abs(expected - POINTS).max() > 0.01
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("hold", HOLDS)
def test_hessian_is_the_derivative_of_the_residual(comm, shared_tmp_path, hold):
    with Simulation(case(hold), comm, output=shared_tmp_path, check_only=True) as simulation:
        x = simulation.position_vector(at=0.3)
        x.array[:] += 0.01 * np.sin(3.0 * np.arange(*x.owner_range))
        way, there, g = x.duplicate(), x.duplicate(), x.duplicate()
        free = np.cos(np.arange(*x.owner_range) ** 2).reshape(-1, 3)
        simulation.model.supports.clear(free)
        way.array[:] = free.ravel()
        differences = x.duplicate()
        for sign in (1.0, -1.0):
            there.waxpy(sign * 1e-6, way, x)
            differences.axpy(sign / 2e-6, simulation.residual(there, out=g, at=0.3))
        product = simulation.hessian(x, at=0.3) * way
        assert (product - differences).norm() < 1e-7 * product.norm()
        again = simulation.hessian(x.array.reshape(-1, 3), at=0.3)
        assert again.handle == simulation.hessian(x).handle and again.isSymmetric(1e-6)


@pytest.mark.parallel
def test_of_a_motion_at_its_time(comm, shared_tmp_path):
    """Loads without inertia: what the nodes of a run lack to be at rest is mass times acceleration."""
    moving = case(
        static=None,
        support=[{"node_set": "feet", "fix": "xyz"}],
        spring=[],
        time={"integrator": "newmark", "beta": 0.25, "gamma": 0.5, "step": 1e-5, "end": 1e-4},
    )
    with Simulation(moving, comm, output=shared_tmp_path, quiet=True) as simulation:
        simulation.external_force(lambda t, state: 0.1 * state.position)
        simulation.run()
        g = simulation.residual(simulation.state.position).array.reshape(-1, 3)
        inertia = simulation.model.inertia.mass[:, None] * simulation.state.a
        free = ~simulation.model.supports.fixed
        assert np.abs(g + inertia)[free].max(initial=0.0) < 1e-4


def test_refused(comm, shared_tmp_path):
    simulation = Simulation(case(), comm, output=shared_tmp_path, check_only=True)
    with pytest.raises(InputError, match="4 numbers on rank 0, which has 5 nodes"):
        simulation.residual(np.zeros(4))
    simulation.close()
    with pytest.raises(InputError, match="was closed"):
        simulation.hessian(POINTS)
