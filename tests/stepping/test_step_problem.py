"""Residual and Hessian of a step against whole-mesh algebra and complex steps; supports and oblique wall frames."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.twins import COMPLEX_STEP, Law, shaken, whole_truss

from pfem_petsc import Case
from pfem_petsc.contact.frames import Planes, build_frames
from pfem_petsc.contact.transform import Transform
from pfem_petsc.solvers.matrix_free import MatrixFreeHessian
from pfem_petsc.stepping.model import Model
from pfem_petsc.stepping.plan import make_plan
from pfem_petsc.stepping.problem import StepProblem
from pfem_petsc.stepping.time_stepping import make_stepper

pytestmark = pytest.mark.parallel

AREA, DENSITY, DAMPING, H = 2e-3, 7800.0, 2e7, 2e-4
ELASTIC, PLASTIC = Law(70e9), Law(70e9, 90e6, isotropic=3e9, kinematic=5e9)
STRAINS = ("engineering", "green", "logarithmic")
SCHEMES = [{"integrator": "newmark"}, {"integrator": "generalized_alpha"}, {"integrator": "houbolt"}]
SCHEMES += [{"integrator": "wilson", "theta": 1.5}]


class Twin:
    """A step problem and its whole-mesh counterpart, with every array in mesh numbering."""

    def __init__(self, comm, law, scheme, mass="lumped", supports=False, walls=()):
        tables = {"support": [{"node_set": "base", "fix": "xz"}]} if supports else {}
        self.model = Model(
            Case.from_dict(
                {
                    "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 1.0},
                    "node_set": {"base": {"box": [[-1.0, -1.0, -0.1], [2.0, 2.0, 0.1]]}},
                    "material": {"it": law.case(density=DENSITY, damping=DAMPING)},
                    "section": {"it": {"area": AREA, "material": "it"}},
                    "gravity": {"acceleration": [1.0, 2.0, -9.81]},
                    "time": {"step": H, "end": 1.0, "mass": mass, **scheme},
                    **tables,
                }
            ),
            comm,
        )
        self.truss = whole_truss(self.model, AREA, law)
        n = self.model.mesh.n_nodes
        self.owned = self.model.mesh.node_ids[: self.model.mesh.n_owned]
        plan = make_plan(self.model)
        self.stepper = make_stepper(self.model, plan)
        random = np.random.default_rng(4)
        self.start = shaken(self.truss, 2e-3, seed=9)
        self.v, self.a = random.normal(size=(n, 3)), 10.0 * random.normal(size=(n, 3))
        state = self.stepper.state
        state.position[:], state.v, state.a = self.start[self.owned], self.v[self.owned], self.a[self.owned]
        self.stepper.evaluate(commit=False)
        self.balance = plan.scheme.balance(state, H)
        state.external = self.stepper.load_of(self.balance)
        self.basis = np.tile(np.eye(3), (n, 1, 1))
        frames = self._frames(walls) if walls else None
        self.problem = StepProblem(self.model, state, self.balance, state.external, Transform(self.model.mesh, frames))
        self.fixed = np.zeros((n, 3), dtype=bool)
        if supports:
            self.fixed[np.abs(self.truss.points[:, 2]) < 0.1] = (True, False, True)
        m, c = self.truss.lumped_mass(DENSITY), self.truss.lumped_mass(DAMPING)
        consistent = mass == "consistent"
        self.mass = self.truss.consistent_mass(DENSITY) if consistent else np.diag(m)
        self.damping = self.truss.consistent_mass(DAMPING) if consistent else np.diag(c)
        self.gravity = m[:, None] * np.array([1.0, 2.0, -9.81])

    def _frames(self, walls):
        """Frames of the nodes at the top, each with the first one, two or three of the oblique walls."""
        normals = np.array(walls) / np.linalg.norm(walls, axis=1)[:, None]
        top = np.flatnonzero(self.truss.points[:, 2] > 0.9)
        mine = np.flatnonzero(np.isin(self.owned, top))
        offsets = np.full((len(mine), len(walls)), -np.inf)
        for i, node in enumerate(self.owned[mine]):
            offsets[i, : 1 + node % len(walls)] = 0.0
        fixed = self.model.supports.fixed[mine]
        gaps = np.tile(np.arange(len(walls), dtype=float), (len(mine), 1))
        every = np.tile(normals, (len(mine), 1, 1))
        frames = build_frames(mine, Planes(fixed, every, offsets, gaps, np.zeros((len(mine), 3))))
        basis = np.zeros((self.model.mesh.n_nodes, 3, 3))
        basis[self.owned[mine]] = frames.basis
        total = self.model.comm.allreduce(basis)
        turned = np.abs(total).max(axis=(1, 2)) > 0.0
        self.basis[turned] = total[turned]
        assert len(top) == turned.sum()
        return frames

    def residual(self, w):
        """g(w) from the equations of the step, in mesh numbering; w may be complex."""
        b = self.balance
        u = np.linalg.solve(self.basis, w[:, :, None])[:, :, 0]
        a, v = b.alpha * u, b.eta * u + self.whole(b.v_hat)
        if b.a_hat is not None:
            a = a + self.whole(b.a_hat)
        internal = b.weight * self.truss.forces(self.whole(b.predictor) + u)
        if b.weight < 1.0:
            internal = internal + (1.0 - b.weight) * self.truss.forces(self.start)
        g = self.mass @ a + self.damping @ v + internal - self.gravity
        g = np.linalg.solve(self.basis.transpose(0, 2, 1), g[:, :, None])[:, :, 0]
        return np.where(self.fixed, 0.0, g)

    def hessian(self, w):
        """dg/dw (3n, 3n), by complex steps; prescribed components have rows and columns of the unit matrix."""
        n = w.size
        out = np.empty((n, n))
        for k in range(n):
            z = w.astype(complex).ravel()
            z[k] += 1j * COMPLEX_STEP
            out[:, k] = self.residual(z.reshape(w.shape)).imag.ravel() / COMPLEX_STEP
        out[:, self.fixed.ravel()] = 0.0
        held = np.flatnonzero(self.fixed)
        out[held, held] = 1.0
        return out

    def whole(self, values):
        out = np.zeros((self.model.mesh.n_nodes, *values.shape[1:]))
        out[self.owned] = values
        return self.model.comm.allreduce(out)

    def program_residual(self, w):
        g = np.empty((len(self.owned), 3))
        self.problem.residual(np.ascontiguousarray(w[self.owned]), g)
        return self.whole(g)

    def program_hessian(self, w):
        """The assembled matrix, dense in mesh numbering; rows of prescribed components scaled to one."""
        mesh, mine = self.model.mesh, np.ascontiguousarray(w[self.owned])
        matrix = self.stepper.hessian.fill(lambda values: self.problem.hessian(mine, self.stepper.hessian, values))
        numbers = np.zeros(mesh.n_nodes, dtype=np.int64)
        numbers[mesh.first_node : mesh.first_node + mesh.n_owned] = self.owned
        numbers = self.model.comm.allreduce(numbers)
        place = (3 * numbers[:, None] + np.arange(3)).ravel()
        dense = np.zeros((3 * mesh.n_nodes, 3 * mesh.n_nodes))
        first, last = matrix.getOwnershipRange()
        for row in range(first, last):
            columns, values = matrix.getRow(row)
            dense[place[row], place[columns]] = values
        dense = self.model.comm.allreduce(dense)
        held = np.flatnonzero(self.fixed)
        assert (dense[held, held] == self.problem_scale()).all()
        dense[held, held] = 1.0
        return dense

    def problem_scale(self):
        """What the program puts on the diagonal of prescribed components: of the size of this rank's inertia."""
        scales = np.zeros(self.model.mesh.n_nodes)
        scales[self.owned] = self.problem.scale
        return np.repeat(self.model.comm.allreduce(scales), 3)[np.flatnonzero(self.fixed)]

    def increment(self, size=2e-3):
        """Unknowns (n, 3), zero where prescribed."""
        w = np.random.default_rng(6).uniform(-size, size, (self.model.mesh.n_nodes, 3))
        return np.where(self.fixed, 0.0, w)

    def check(self):
        w = self.increment()
        expected = self.residual(w)
        assert np.abs(self.program_residual(w) - expected).max() < 1e-11 * np.abs(expected).max()
        expected, found = self.hessian(w), self.program_hessian(w)
        assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()
        self.check_matrix_free(w, found)
        return w, found

    def check_matrix_free(self, w, dense):
        """The operator that assembles nothing: its products and its diagonal are those of the matrix."""
        operator = MatrixFreeHessian(self.model)
        operator.update(self.problem, np.ascontiguousarray(w[self.owned]))
        dense = dense.copy()
        held = np.flatnonzero(self.fixed)
        dense[held, held] = self.problem_scale()
        vector = np.random.default_rng(11).normal(size=w.shape)
        right, left = operator.mat.createVecs()
        right.array[:] = vector[self.owned].ravel()
        operator.mat.mult(right, left)
        found, expected = self.whole(left.array.reshape(-1, 3)), (dense @ vector.ravel()).reshape(-1, 3)
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()
        operator.mat.getDiagonal(left)
        found = self.whole(left.array.reshape(-1, 3)).ravel()
        assert np.abs(found - np.diag(dense)).max() < 1e-12 * np.abs(np.diag(dense)).max()
        for thing in (right, left, operator):
            thing.destroy()


@pytest.mark.parametrize("strain", STRAINS)
@pytest.mark.parametrize("law", [ELASTIC, PLASTIC], ids=["elastic", "plastic"])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_hessian_is_the_derivative_of_the_residual(comm, law, strain, mass):
    """By complex steps of the twin to 1e-10, by finite differences of the program's own residual to 1e-8."""
    twin = Twin(comm, replace(law, strain=strain), {"integrator": "newmark"}, mass)
    w, hessian = twin.check()
    d = np.random.default_rng(7).normal(size=w.shape)
    h = 3e-7
    # fourth order, so that what is left is rounding
    parts = [twin.program_residual(w + k * h * d) for k in (-2, -1, 1, 2)]
    slope = (parts[0] - 8 * parts[1] + 8 * parts[2] - parts[3]) / (12 * h)
    exact = (hessian @ d.ravel()).reshape(w.shape)
    assert np.abs(slope - exact).max() < 1e-8 * np.abs(exact).max()
    if law is PLASTIC:
        x = twin.whole(twin.balance.predictor) + w
        yielding = np.mean(twin.truss.response(x)["accumulated"] > 0.0)
        assert 0.1 < yielding < 1.0


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s["integrator"])
def test_every_implicit_scheme(comm, scheme):
    Twin(comm, PLASTIC, scheme).check()


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_supports_have_unit_rows_and_columns(comm, mass):
    twin = Twin(comm, ELASTIC, {"integrator": "newmark"}, mass, supports=True)
    assert twin.fixed.sum() == 2 * 5  # four corners and the face's middle
    twin.check()


@pytest.mark.parametrize("supports", [False, True])
@pytest.mark.parametrize("mass", ["lumped", "consistent"])
def test_oblique_frames(comm, mass, supports):
    """Nodes with one, two and three oblique walls: B^-T g and B^-T H B^-1 against dense algebra."""
    walls = [[0.3, 0.1, -1.0], [1.0, 0.5, 0.2], [-0.4, 1.0, 0.6]]
    twin = Twin(comm, PLASTIC, {"integrator": "newmark"}, mass, supports=supports, walls=walls)
    assert sum(not np.array_equal(b, np.eye(3)) for b in twin.basis) == 5
    twin.check()
    w = twin.increment()
    mine = np.ascontiguousarray(w[twin.owned])
    back = twin.problem.coordinates(twin.problem.increment(mine).copy())
    np.testing.assert_allclose(back, mine, atol=1e-15)
