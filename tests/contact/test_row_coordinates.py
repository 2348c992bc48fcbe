"""The coordinates that make rows of pairs and constraints bounds: matrix, adjoint and inverse, and both operators."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from helpers.lattices import planes, two_lattices
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.contact.constraints.base import Constraint
from pfem_petsc.contact.constraints.base import ConstraintKeys as Parameters
from pfem_petsc.contact.contact import Candidates
from pfem_petsc.contact.transform import Transform
from pfem_petsc.solvers.matrix import HessianMatrix
from pfem_petsc.solvers.matrix_free import MatrixFreeHessian
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan
from pfem_petsc.stepping.problem import StepProblem
from pfem_petsc.stepping.time_stepping import make_stepper


class Distances(Constraint):
    """Distances of nodes 0-1-2-3 of a chain, and the area of triangle 4-5-6 over a length: rows of two widths."""

    def __init__(self, parameters, nodes_of) -> None:
        self.nodes = np.array([[0, 1], [1, 2], [2, 3]]) if parameters.name == "chain" else np.array([[4, 5, 6]])
        if MPI.COMM_WORLD.rank > 0:  # a rank makes its part of the rows
            self.nodes = self.nodes[:0]

    def values(self, x):
        return 10.0 - np.linalg.norm(np.diff(x, axis=1), axis=2).sum(axis=1)

    def gradients(self, x):
        arms = np.diff(x, axis=1)
        along = arms / np.linalg.norm(arms, axis=2)[:, :, None]
        nothing = np.zeros_like(along[:, :1])
        return np.concatenate([along, nothing], axis=1) - np.concatenate([nothing, along], axis=1)


SUPPORTS = [{"node_set": "held", "fix": "y"}, {"node_set": "hinged", "fix": "xz"}]
MODELS = ["constraints", "pairs", "pairs, supported", "pairs at walls", "pairs at walls, supported"]


@pytest.fixture(params=MODELS)
def model(request, comm, shared_tmp_path, monkeypatch):
    if "pairs" in request.param:
        supports = SUPPORTS if "supported" in request.param else []
        case = two_lattices(shared_tmp_path / "mesh.vtu", "newmark", supports=supports, cells=(1, 1, 1))
        if "walls" in request.param:
            case["wall"] = planes([[0.0, 0.3, 1.0], [0.2, 0.1, -1.0]], [-0.002, -0.3])
        return Model(Case.from_dict(case), comm)
    module = type("module", (), {"Parameters": Parameters, "Constraint": Distances})
    for place in ("case.model", "contact.constraint_set"):
        found = importlib.import_module(f"pfem_petsc.{place}")
        lookup = found.lookup
        monkeypatch.setattr(
            found,
            "lookup",
            lambda package, name, where, own=lookup: module if name == "d" else own(package, name, where),
        )
    keys = [
        "mesh.cells=[1, 1, 1]",
        "node_set.corner.nearest=[0, 0, 0]",
        "wall=[]",
        "time.integrator=newmark",
        "time.step=1e-3",
    ]
    keys += ['constraint=[{name="chain", kind="d"}, {name="three", kind="d"}]', "solver.linear=cg", "contact={}"]
    keys += ["node_set.low.indices=[2]", 'support=[{node_set="low", fix="xz"}]']
    return Model(Case.load("tumbling_lattice", keys), comm)


def frames_of(model):
    """Frames of nodes near walls that stop them, low ones with the first, high ones with both; None without walls."""
    if not model.contact.any:
        return None
    x = model.mesh.points[: model.mesh.n_owned]
    nodes = np.flatnonzero((x[:, 2] < 0.02) | (x[:, 2] > 0.08))
    applicable = np.stack([np.ones(len(nodes), dtype=bool), x[nodes, 2] > 0.05], axis=1)
    return model.contact.frames(Candidates(nodes, applicable), x, 0.0)


def whole(apply, model, comm) -> np.ndarray:
    """The matrix of a linear map of (owned, 3)."""
    owned, n = model.mesh.n_owned, 3 * model.mesh.n_nodes
    matrix = np.zeros((n, n))
    first = 3 * model.mesh.first_node
    for k in range(n):
        unit = np.zeros(3 * owned)
        if first <= k < first + 3 * owned:
            unit[k - first] = 1.0
        array = unit.reshape(owned, 3)
        apply(array)
        matrix[first : first + 3 * owned, k] = array.ravel()
    return comm.allreduce(matrix)


def dense(mat, comm) -> np.ndarray:
    """A PETSc matrix of a few rows, by products."""
    right, left = mat.createVecs()
    n = mat.getSize()[0]
    matrix = np.zeros((n, n))
    first, last = mat.getOwnershipRange()
    for k in range(n):
        right.set(0.0)
        if first <= k < last:
            right.array[k - first] = 1.0
        mat.mult(right, left)
        matrix[first:last, k] = left.array
    return comm.allreduce(matrix)


@pytest.mark.parallel
def test_matrix_adjoint_inverse_and_both_operators(model, comm):
    stepper = make_stepper(model, make_plan(model))
    stepper.start()
    state, owned = stepper.state, model.mesh.n_owned
    balance = stepper.scheme.balance(state, stepper.h)
    (link,) = stepper.links
    rng = np.random.default_rng(5)
    u = 1e-2 * rng.normal(size=(model.mesh.n_nodes, 3))[model.mesh.node_ids[:owned]]
    u[model.supports.fixed] = 0.0
    frames = frames_of(model)
    link.place(frames, balance, state, balance.predictor + u)
    mat = link.matrix()
    matrix = dense(mat, comm)
    mat.destroy()
    np.testing.assert_allclose(whole(link.forward, model, comm), matrix, atol=1e-13)
    np.testing.assert_allclose(whole(link.adjoint, model, comm), matrix.T, atol=1e-13)
    np.testing.assert_allclose(whole(link.inverse, model, comm), np.linalg.inv(matrix), atol=1e-12)
    fixed = np.zeros(len(matrix))
    fixed[3 * model.mesh.first_node :][: 3 * owned] = model.supports.fixed.ravel()
    fixed = comm.allreduce(fixed) > 0.0
    np.testing.assert_array_equal(matrix[fixed], np.eye(len(matrix))[fixed])
    np.testing.assert_array_equal(matrix[:, fixed], np.eye(len(matrix))[:, fixed])
    plain = StepProblem(model, state, balance, state.external, Transform(model.mesh, frames))
    coupled = StepProblem(model, state, balance, state.external, Transform(model.mesh, frames, [link]))
    # the row of each bound is the row of the constraints, per the size of its gradient
    w, lower = coupled.coordinates(u), np.full((owned, 3), -np.inf)
    link.bound(balance.predictor + u, w, lower)
    assert comm.allreduce(int(np.isfinite(lower).sum())) == comm.allreduce(int(link.rows.counted.sum())) > 3
    slack = np.sort(comm.allreduce((w - lower)[np.isfinite(lower)].tolist()))
    rows = link.rows
    x = rows.gather(balance.predictor + u)
    size = np.sqrt(rows.along(rows.gradients(x) ** 2, rows.free))
    counted = comm.allreduce((rows.values(x) / size)[rows.counted].tolist())
    if frames is None:
        np.testing.assert_allclose(slack, np.sort(counted), rtol=1e-12)
    if model.case.contact_pair:  # whose rows are linear: unknowns on their bounds are rows that are closed
        closed = coupled.increment(np.where(np.isfinite(lower), lower, w))
        np.testing.assert_allclose(rows.values(rows.gather(balance.predictor + closed)), 0.0, atol=1e-13)
        np.testing.assert_allclose(closed[model.supports.fixed], 0.0, atol=1e-16)
    # the residual of forces of rows gives these forces, whatever walls and supports do
    expected, g = 1.0 + link.rows.ids, np.zeros((owned, 3))
    model.links.force, model.links.jacobian = expected, link.jacobian
    model.links.add_forces(g)
    if frames is not None:
        g[frames.nodes] = np.einsum("nji,nj->ni", frames.inverse, g[frames.nodes])
    link.solve_forces(np.where(np.isfinite(lower), lower, w), g, lower, 1e-9)
    np.testing.assert_allclose(model.links.force, expected, rtol=1e-12)
    assembled, free = HessianMatrix(model.mesh, model.supports), MatrixFreeHessian(model)
    assembled.update(plain, plain.coordinates(u))
    expected = matrix.T @ dense(assembled.mat, comm) @ matrix
    diagonal = np.zeros(len(expected))
    assembled.couple([link])
    for operator in (assembled, free):
        operator.update(coupled, w)
        np.testing.assert_allclose(dense(operator.bounded, comm), expected, atol=1e-12 * np.abs(expected).max())
    diagonal[3 * model.mesh.first_node :][: 3 * owned] = free.diagonal().ravel()
    if model.case.contact_pair:  # bars between the nodes of a group are neglected
        np.testing.assert_allclose(comm.allreduce(diagonal), np.diag(expected), rtol=1e-12)
    assembled.destroy()
    free.destroy()
    stepper.destroy()
