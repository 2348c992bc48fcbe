"""The coordinates that make bounds of contact pairs: their matrix, gradient and inverse, and both operators in them."""

import numpy as np
import pytest
from helpers.bodies import two_lattices
from helpers.lattices import planes

from pfem_petsc import Case
from pfem_petsc.contact.contact import Candidates
from pfem_petsc.contact.links import Transform
from pfem_petsc.contact.pair_link import PairCoordinates
from pfem_petsc.solvers.matrix import HessianMatrix
from pfem_petsc.solvers.matrix_free import MatrixFreeHessian
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan
from pfem_petsc.stepping.problem import StepProblem
from pfem_petsc.stepping.time_stepping import make_stepper

pytestmark = pytest.mark.parallel

SUPPORTS = [{"node_set": "held", "fix": "y"}, {"node_set": "hinged", "fix": "xz"}]


@pytest.fixture(params=[(), SUPPORTS], ids=["free", "supported"])
def model(request, comm, shared_tmp_path):
    case = two_lattices(shared_tmp_path / "mesh.vtu", "newmark", supports=request.param, cells=(1, 1, 1))
    return Model(Case.from_dict(case), comm)


def dense(mat, comm):
    """A PETSc matrix on every rank."""
    rows, columns = mat.getSize()[0], mat.getSize()[1]
    start, stop = mat.getOwnershipRange()
    whole = np.zeros((rows, columns))
    x, y = mat.createVecs()
    for k in range(columns):
        x.set(0.0)
        if x.getOwnershipRange()[0] <= k < x.getOwnershipRange()[1]:
            x[k] = 1.0
        x.assemble()
        mat.mult(x, y)
        whole[start:stop, k] = y.array
    x.destroy()
    y.destroy()
    return comm.allreduce(whole)


def whole(function, model, comm):
    """The matrix of a linear map of nodal arrays (owned, 3), by columns."""
    n = 3 * model.mesh.n_nodes
    mine = slice(3 * model.mesh.first_node, 3 * (model.mesh.first_node + model.mesh.n_owned))
    out = np.zeros((n, n))
    for k in range(n):
        unit = np.zeros(n)
        unit[k] = 1.0
        values = unit[mine].reshape(-1, 3).copy()
        function(values)
        out[mine, k] = values.ravel()
    return comm.allreduce(out)


def test_matrix_gradient_and_inverse(model, comm):
    pairs = PairCoordinates(model.pairs)
    mat = pairs.matrix()
    matrix = dense(mat, comm)
    mat.destroy()
    np.testing.assert_allclose(whole(pairs.increment, model, comm), matrix, atol=1e-15)
    np.testing.assert_allclose(whole(pairs.gradient, model, comm), matrix.T, atol=1e-15)
    np.testing.assert_allclose(whole(pairs.coordinates, model, comm), np.linalg.inv(matrix), atol=1e-13)
    assert (np.abs(matrix - np.eye(len(matrix))) > 1e-3).any(axis=1).sum() == 15  # 5 carriers
    fixed = np.zeros(len(matrix), dtype=bool)
    fixed[3 * model.mesh.first_node :][: 3 * model.mesh.n_owned] = model.supports.fixed.ravel()
    fixed = comm.allreduce(fixed.astype(int)) > 0
    np.testing.assert_array_equal(matrix[fixed], np.eye(len(matrix))[fixed])
    np.testing.assert_array_equal(matrix[:, fixed], np.eye(len(matrix))[:, fixed])


def test_bounds_are_the_distances(model, comm):
    """An unknown on its bound is a pair that is closed, whatever the supports do; its force is the gradient's."""
    pairs = PairCoordinates(model.pairs)
    rng = np.random.default_rng(1)
    u = rng.normal(size=(model.mesh.n_nodes, 3))[model.mesh.node_ids[: model.mesh.n_owned]]
    x = model.mesh.points[: model.mesh.n_owned]
    lower = np.full(u.shape, -np.inf)
    w = u.copy()
    pairs.coordinates(w)
    pairs.bound(x + u, w, lower)
    assert comm.allreduce(int(np.isfinite(lower).sum())) == 5
    on = np.where(np.isfinite(lower), lower, w)
    closed = on.copy()
    pairs.increment(closed)
    np.testing.assert_allclose(model.pairs.distances(model.pairs.gather(x + closed)), model.pairs.gaps, atol=1e-13)
    np.testing.assert_array_equal(closed[model.supports.fixed], u[model.supports.fixed])
    expected = 1.0 + model.pairs.first
    model.pairs.force = expected.copy()
    g = np.zeros_like(u)
    model.pairs.push(g)
    model.pairs.release()
    pairs.press(on, g, lower, 1e-9)
    np.testing.assert_allclose(model.pairs.force, expected, rtol=1e-13)


@pytest.fixture(params=[(), SUPPORTS], ids=["free", "supported"])
def walled(request, comm, shared_tmp_path):
    case = two_lattices(shared_tmp_path / "walled.vtu", "newmark", supports=request.param, cells=(1, 1, 1))
    case["wall"] = planes([[0.0, 0.3, 1.0], [0.2, 0.1, -1.0]], [-0.002, -0.3])
    return Model(Case.from_dict(case), comm)


def framed(model, pairs):
    """Frames of nodes near walls that stop them, low ones with the first, high ones with both."""
    x = model.mesh.points[: model.mesh.n_owned]
    nodes = np.flatnonzero((x[:, 2] < 0.02) | (x[:, 2] > 0.08))
    applicable = np.stack([np.ones(len(nodes), dtype=bool), x[nodes, 2] > 0.05], axis=1)
    frames = model.contact.frames(Candidates(nodes, applicable), x, 0.0)
    pairs.place(frames)
    return frames


def test_matrix_gradient_and_inverse_beside_walls(walled, comm):
    pairs = PairCoordinates(walled.pairs)
    mat = pairs.matrix()
    framed(walled, pairs)
    pairs.refresh(mat)
    matrix = dense(mat, comm)
    mat.destroy()
    np.testing.assert_allclose(whole(pairs.increment, walled, comm), matrix, atol=1e-14)
    np.testing.assert_allclose(whole(pairs.gradient, walled, comm), matrix.T, atol=1e-14)
    np.testing.assert_allclose(whole(pairs.coordinates, walled, comm), np.linalg.inv(matrix), atol=1e-12)
    assert len(pairs.deferred) == 0


def test_both_operators_are_the_congruent_matrix_beside_walls(walled, comm):
    test_both_operators_are_the_congruent_matrix(walled, comm, beside=True)


def test_both_operators_are_the_congruent_matrix(model, comm, beside=False):
    stepper = make_stepper(model, make_plan(model))
    stepper.start()
    state = stepper.state
    balance = stepper.scheme.balance(state, stepper.h)
    (link,) = stepper.links
    pairs = link.own
    rng = np.random.default_rng(2)
    u = 1e-3 * rng.normal(size=(model.mesh.n_nodes, 3))[model.mesh.node_ids[: model.mesh.n_owned]]
    frames = framed(model, pairs) if beside else None
    plain = StepProblem(model, state, balance, state.external, Transform(model, frames))
    coupled = StepProblem(model, state, balance, state.external, Transform(model, frames, [link]))
    w = coupled.coordinates(u)
    np.testing.assert_allclose(coupled.increment(w), u, atol=1e-17)
    assembled, free = HessianMatrix(model.mesh, model.supports), MatrixFreeHessian(model)
    assembled.update(plain, plain.coordinates(u))
    hessian = dense(assembled.mat, comm)
    mat = pairs.matrix()
    matrix = dense(mat, comm)
    mat.destroy()
    expected = matrix.T @ hessian @ matrix
    assembled.couple([link])
    for operator in (assembled, free):
        operator.update(coupled, w)
        np.testing.assert_allclose(dense(operator.bounded, comm), expected, atol=1e-12 * np.abs(expected).max())
    diagonal = np.zeros(len(expected))
    diagonal[3 * model.mesh.first_node :][: 3 * model.mesh.n_owned] = free.diagonal().ravel()
    np.testing.assert_allclose(comm.allreduce(diagonal), np.diag(expected), rtol=1e-12)
    assembled.destroy()
    free.destroy()
    stepper.destroy()
