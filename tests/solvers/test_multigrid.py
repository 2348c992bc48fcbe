"""Multigrid on a background grid: the coarse matrix, the bound of the smoother, and iterations that do not grow."""

import numpy as np
import pytest
from helpers.stopped import TWO_RODS
from petsc4py import PETSc

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.contact.transform import Transform
from pfem_petsc.errors import InputError
from pfem_petsc.solvers.linear import Demand, choose_linear
from pfem_petsc.solvers.matrix import StepProblem
from pfem_petsc.solvers.multigrid import GridMultigrid

MULTIGRID = {"linear": "multigrid", "rtol": 1e-12}
NEWMARK = {"integrator": "newmark", "beta": 0.25, "gamma": 0.5}
LATTICE = {
    "mesh": {"generator": "lattice", "kind": "octet", "cells": [4, 3, 3], "pitch": 0.01},
    "node_set": {
        "half": {"box": [[-1.0, -1.0, 0.011], [1.0, 1.0, 1.0]]},
        "foot": {"box": [[-1.0, -1.0, -1e-6], [1.0, 1.0, 1e-6]]},
        "side": {"box": [[-1e-6, -1.0, 0.004], [1e-6, 1.0, 0.021]]},
        "top": {"box": [[-1.0, -1.0, 0.0299], [1.0, 1.0, 1.0]]},
    },
    "material": {"m": {"young_modulus": 110e9, "density": 4500.0}},
    "section": {"s": {"area": 1e-6, "material": "m"}},
    "initial": {"velocity": [0.0, 0.0, 0.0], "on": [{"node_set": "half", "velocity": [0.3, 0.0, 1.0]}]},
    "output": {"fields_every": 0, "fields": []},
}
HELD = {
    "support": [{"node_set": "foot", "fix": "xz"}, {"node_set": "side", "normal": [1.0, 0.3, 0.2]}],
    "spring": [{"node_set": "half", "stiffness": [1e6, 2e6, 0.0]}],
}


def irregular(n, seed=1):
    """A truss without layers, whose bars join boxes."""
    random = np.random.default_rng(seed)
    points = random.random((n, 3))
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = np.argsort(distances, axis=1)[:, 1:9]
    bars = {tuple(sorted((i, int(j)))) for i in range(n) for j in near[i]}
    return Truss(points, np.array(sorted(bars)))


def simulation_of(comm, folder, step, steps=1, mesh=None, lattice=LATTICE["mesh"], **tables):
    case = LATTICE | {"time": {**NEWMARK, "step": step, "end": steps * step}, "solver": MULTIGRID, "mesh": lattice}
    case |= tables
    if mesh is not None:
        case = {key: value for key, value in case.items() if key != "mesh"}
    return Simulation(Case.from_dict(case, mesh=mesh), comm, output=folder, quiet=True)


def made(simulation):
    """The preconditioner of the first step, some components of which are held as if by walls."""
    stepper = simulation.stepper
    balance = stepper.scheme.balance(stepper.state, stepper.h)
    problem = StepProblem(
        simulation.model, stepper.state, balance, stepper.state.external, Transform(simulation.model.mesh)
    )
    problem.place(problem.increment(np.zeros_like(stepper.state.v)))
    multigrid = GridMultigrid(simulation.model)
    held = np.zeros((simulation.mesh.n_owned, 3))
    held[simulation.mesh.node_ids[: simulation.mesh.n_owned] % 7 == 3, 1] = 1.0
    inclined = simulation.model.supports.inclined
    if inclined is not None:  # walls cannot hold these nodes
        held[inclined.nodes] = 0.0
    multigrid.make(problem, held)
    return multigrid


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["held", "irregular"])
def test_coarse_matrix_is_that_of_the_interpolated_displacements(comm, shared_tmp_path, kind):
    """P^T K P c, from the bars, is what interpolation, a product and restriction give one after the other."""
    tables = HELD if kind == "held" else {"node_set": {}, "initial": {"velocity": [0.0, 0.0, 1.0]}}
    mesh = irregular(90) if kind == "irregular" else None
    simulation = simulation_of(comm, shared_tmp_path, 2e-5, mesh=mesh, **tables)
    multigrid = made(simulation)
    grid = multigrid.grid
    assert grid.total > 8
    values = np.zeros((len(grid.numbers), 3))
    values[: grid.n_owned] = np.sin(1.0 + 3.0 * (grid.numbers[: grid.n_owned, None] * 3 + np.arange(3)))
    grid.bring(values)
    at, turned = multigrid._special, multigrid._turned
    fine, product = grid.prolongation @ values, np.zeros((simulation.mesh.n_owned, 3))
    fine[at] = np.einsum("kij,kj->ki", turned, fine[at])
    multigrid.product.extension.times(fine, product)
    product[at] = np.einsum("kji,kj->ki", turned, product[at])
    expected = grid.prolongation.T @ product
    grid.give(expected)
    x, y = multigrid._right.duplicate(), multigrid._right.duplicate()
    x.setArray(values[: grid.n_owned].ravel())
    multigrid._matrix.mult(x, y)
    size = comm.allreduce(np.abs(expected[: grid.n_owned]).max(initial=0.0), op=max)
    assert size > 0.0
    # besides what is added to the diagonal
    assert np.abs(y.array.reshape(-1, 3) - expected[: grid.n_owned]).max(initial=0.0) < 1e-7 * size


def test_eigenvalues_that_the_smoother_assumes(comm, tmp_path):
    """D^-1 K has none above 2, with supports, springs and held components."""
    multigrid = made(simulation_of(comm, tmp_path, 2e-3, **HELD))
    n = 3 * multigrid.mesh.n_owned
    stiffness, inverse = np.zeros((n, n)), np.zeros((n, n))
    for column in range(n):
        unit = np.zeros((n // 3, 3))
        unit.reshape(-1)[column] = 1.0
        out = np.zeros_like(unit)
        multigrid.product.extension.times(unit, out)
        stiffness[:, column] = out.ravel()
    each = multigrid._inverse[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    for k, block in enumerate(each):
        inverse[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    values = np.linalg.eigvals(inverse @ stiffness).real
    assert 1.2 < values.max() <= 2.0 + 1e-12
    assert values.min() > 0.0
    assert np.abs(stiffness - stiffness.T).max() < 1e-12 * np.abs(stiffness).max()
    kept = multigrid.product.extension.kept
    diagonal = multigrid.product.diagonal().ravel()
    assert np.abs(diagonal - np.diag(stiffness))[kept].max() < 1e-12 * diagonal.max()


def test_rigid_motions_are_interpolated(comm, tmp_path):
    """All fields that are linear in the positions, whatever the mesh."""
    simulation = simulation_of(comm, tmp_path, 2e-5, mesh=irregular(60), node_set={}, initial={"velocity": [0, 0, 1]})
    grid = made(simulation).grid
    gradient = np.array([[0.0, -3.0, 2.0], [3.0, 0.5, -1.0], [-2.0, 1.0, 0.2]])
    fine = grid.prolongation @ (grid.positions @ gradient)
    assert np.abs(fine - simulation.mesh.points @ gradient).max() < 1e-12


def iterations(comm, folder, cells, ratio):
    """Mean number of iterations of a solve."""
    pitch = 0.01
    critical = pitch / np.sqrt(110e9 / 4500.0) * 1.93
    speed = 2e-7 / (ratio * critical)
    moving = {"velocity": [0.0, 0.0, 0.0], "on": [{"node_set": "half", "velocity": [speed, 0.0, 0.5 * speed]}]}
    simulation = simulation_of(
        comm,
        folder,
        ratio * critical,
        2,
        None,
        lattice={"generator": "lattice", "kind": "cubic", "cells": [cells] * 3, "pitch": pitch},
        node_set={"half": {"box": [[-1.0, -1.0, 0.6 * pitch * cells], [9.0, 9.0, 9.0]]}},
        initial=moving,
        solver={"linear": "multigrid"},
    )
    newton = linear = 0
    for step in simulation:
        newton, linear = newton + step.newton, linear + step.linear
    return linear / newton


@pytest.mark.slow
def test_iterations_do_not_grow(comm, tmp_path):
    """From 10^4 to 10^5 unknowns, at 100 times the explicit limit, for solves of equal accuracy; Jacobi needs twice as
    many for the larger one."""
    options = PETSc.Options()
    options["pfem_ksp_rtol"] = 1e-3
    try:
        small, large = (iterations(comm, tmp_path / str(cells), cells, 100.0) for cells in (14, 31))
    finally:
        options.delValue("pfem_ksp_rtol")
    assert 2.0 < small < 8.0
    assert large < 1.5 * small


SCHEMES = ["houbolt", "newmark", "wilson", "generalized_alpha"]


def displacements(simulation, points):
    """Displacements from points (owned, 3) in mesh numbering, on every rank. Collective."""
    mesh = simulation.mesh
    found = np.zeros((mesh.n_nodes, 3))
    found[mesh.node_ids[: mesh.n_owned]] = simulation.state.position - points
    return simulation.comm.allreduce(found)


def final(simulation):
    """Displacements at the end, of a run in which walls hold nodes and bars yield."""
    most = max(simulation.comm.allreduce(int(simulation.stepper.solution.contacts)) for _ in simulation)
    assert most > 0
    strain = simulation.model.bars.fields(simulation.stepper.state.x)["plastic_strain"]
    assert simulation.comm.allreduce(float(np.abs(strain).max(initial=0.0)), op=max) > 0.0
    return displacements(simulation, simulation.mesh.points[: simulation.mesh.n_owned])


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("scheme", SCHEMES)
def test_same_motion_as_with_a_factorisation(comm, shared_tmp_path, scheme):
    """Supports along axes and others, springs, yielding bars and an oblique wall, at 50 times the explicit limit."""
    step, steps = 2e-5, 5
    material = {"m": {"young_modulus": 110e9, "density": 4500.0, "yield_stress": 1e6, "isotropic_hardening": 11e9}}
    roof = {"type": "plane", "node_set": "top", "point": [0.0, 0.0, 0.0300001], "normal": [0.1, 0.0, -1.0]}
    tables = {
        **HELD,
        "material": material,
        "time": {"integrator": scheme, "step": step, "end": steps * step},
        "wall": [{"name": "roof", **roof}],
    }
    found = final(simulation_of(comm, shared_tmp_path / "multigrid", step, **tables))
    direct = {"linear": "mumps", "rtol": 1e-12}
    expected = final(simulation_of(comm, shared_tmp_path / "direct", step, **tables | {"solver": direct}))
    moved = np.abs(expected).max()
    assert moved > 1e-7
    assert np.abs(found - expected).max() < 1e-8 * moved


def test_what_it_cannot_do_is_refused():
    with pytest.raises(InputError, match='solver.linear = "multigrid".*not symmetric; use "gamg"'):
        choose_linear("multigrid", "auto", Demand(30_000, 100.0, symmetric=False))
    with pytest.raises(InputError, match='solver.linear = "multigrid" is matrix-free'):
        choose_linear("multigrid", "assembled", Demand(30_000, 100.0))


DROP = ("mesh.cells=[3,3,3]", "time.end=3e-5", "time.step=1.5e-6", "time.integrator=newmark")
CONTACTS = {
    "pairs": ("rod_impact", (*TWO_RODS, "time.end=0.25", "time.integrator=newmark")),
    "friction": ("lattice_drop", (*DROP, "wall.0.friction=0.3")),
    "tied": ("lattice_drop", (*DROP, "wall.0.tied=true")),
}


@pytest.mark.parallel
@pytest.mark.parametrize("kind", CONTACTS)
def test_same_contact_as_with_a_factorisation(comm, shared_tmp_path, kind):
    """Solves in which links close or nodes slip have the diagonal as preconditioner; ties are bounds as others."""
    name, changes = CONTACTS[kind]
    runs, reduced = [], 0
    for linear in ("multigrid", "mumps"):
        case = Case.load(name, [*changes, "output.fields_every=0", "solver.rtol=1e-12", f"solver.linear={linear}"])
        simulation = Simulation(case, comm, output=shared_tmp_path / linear, quiet=True)
        for _ in simulation:
            reduced += simulation.stepper.lagged.inner.reduced if linear == "multigrid" else 0
        runs.append(displacements(simulation, 0.0))
        if linear == "multigrid":
            told = "Jacobi where links may close or nodes slip" in simulation.plan.linear.why
            assert told == (reduced > 0) == (kind != "tied")
    assert np.abs(runs[0] - runs[1]).max() < 1e-10 * np.ptp(runs[1])
