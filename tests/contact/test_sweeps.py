"""Friction of rows that share nodes, with walls, against Uzawa's method with De Saxce's projection on cones."""

import numpy as np
import pytest

from pfem_petsc.contact.projection import INFEASIBLE, JAMMED, Groups, Planes, System, project_groups
from pfem_petsc.contact.sweeps import Pushes, RubbingRows


def frames(normals):
    """Orthonormal bases (r, 3, 3), the normals first."""
    bases = np.empty((len(normals), 3, 3))
    for basis, n in zip(bases, normals, strict=True):
        t = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        basis[0], basis[1] = n, t / np.linalg.norm(t)
        basis[2] = np.cross(n, basis[1])
    return bases


def uzawa(jacobian, softness, gaps, slips, friction):
    """Contact forces (r, 3) in local frames: projections of r - rho (u + mu |u_t| n) on Coulomb's cones.

    ``jacobian`` (3 r, 3 n) by positions, ``softness`` (3 n,), ``gaps`` (r,), ``slips`` (r, 2).
    """
    matrix = jacobian @ (softness[:, None] * jacobian.T)
    free = np.column_stack([gaps, slips]).ravel()
    forces, rho = np.zeros(len(free)), 0.9 / np.linalg.eigvalsh(matrix)[-1]
    for _ in range(200_000):
        u = (matrix @ forces + free).reshape(-1, 3)
        trial = forces.reshape(-1, 3) - rho * u
        trial[:, 0] -= rho * friction * np.linalg.norm(u[:, 1:], axis=1)
        size = np.linalg.norm(trial[:, 1:], axis=1)
        normal = np.maximum((trial[:, 0] + friction * size) / (1.0 + friction**2), 0.0)
        inside = size <= friction * trial[:, 0]
        normal = np.where(inside, trial[:, 0], normal)
        factor = np.where(inside, 1.0, friction * normal / np.maximum(size, 1e-300))
        new = np.column_stack([normal, factor[:, None] * trial[:, 1:]]).ravel()
        if np.abs(new - forces).max() < 1e-15 * max(1.0, np.abs(new).max()):
            return new.reshape(-1, 3)
        forces = new
    return forces.reshape(-1, 3)


class Group:
    """Nodes, pairs between them and walls at some, in random positions; every pair is closed or nearly so."""

    def __init__(self, seed, most=0.5, fixed=0.0):
        rng = self.rng = np.random.default_rng(seed)
        n, r = int(rng.integers(2, 6)), int(rng.integers(1, 6))
        self.stiffness = np.exp(rng.uniform(-1.0, 1.0, n))
        self.ends = np.array([rng.permutation(n)[:2] for _ in range(r)])
        self.free = np.where(rng.random((n, 3)) < fixed, 0.0, 1.0)
        walls = int(rng.integers(0, 3))
        at = np.flatnonzero(rng.random(n) < 0.6) if walls else np.empty(0, dtype=int)
        self.plane = np.full(n, -1)
        self.plane[at] = np.arange(len(at))
        self.nodes_at_walls = at
        unit = lambda *shape: (v := rng.normal(size=(*shape, 3))) / np.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
        self.normals, self.wall_normals = unit(r), unit(len(at), walls)
        # no motion satisfies all bounds that are above zero by the motion of a point that is inside
        inside = rng.normal(size=(n, 3)) * self.free
        self.values = -self._along(inside) + rng.uniform(0.0, 0.3, r)
        self.gaps = -np.einsum("mwi,mi->mw", self.wall_normals, inside[at]) + rng.uniform(0.0, 0.3, (len(at), walls))
        self.friction, self.wall_friction = rng.uniform(0.0, most, r), rng.uniform(0.0, most, (len(at), walls))
        self.slips, self.wall_slips = rng.normal(size=(r, 3)), rng.normal(size=(len(at), walls, 3))

    def _along(self, y):
        return np.einsum("ri,ri->r", self.normals, y[self.ends[:, 1]] - y[self.ends[:, 0]])

    def solve(self, static=1.0):
        """Forces (r, 3) of rows, and displacements."""
        r, n = len(self.ends), len(self.stiffness)
        gradients = np.stack([-self.normals, self.normals], axis=1)
        groups = Groups(np.array([0, r]), np.arange(r), np.array([0, n]), np.arange(n))
        both = lambda mu: np.stack([mu, static * mu], axis=-1)  # noqa: E731
        weights = np.tile([-1.0, 1.0], (r, 1))
        nowhere, soft, friction = np.empty((0, 3)), self.free / self.stiffness[:, None], both(self.friction)
        rows = RubbingRows(
            self.ends, weights, gradients, nowhere, self.values, self.slips, friction, soft, np.empty((0, 2))
        )
        planes = Planes(self.wall_normals, self.gaps, both(self.wall_friction), self.wall_slips)
        system = System(rows, self.plane, planes)
        pushes = Pushes(np.zeros(r), np.zeros((r, 3)), np.zeros((n, 3)))
        found = project_groups(np.array([0]), groups, system, np.full(1, 1e-13), 1.0, pushes)
        return found, pushes

    def reference(self):
        """The same by Uzawa's method."""
        n, r = len(self.stiffness), len(self.ends)
        normals = np.concatenate([self.normals, self.wall_normals.reshape(-1, 3)])
        bases = frames(normals)
        jacobian = np.zeros((len(normals), 3, n, 3))
        for a, (i, j) in enumerate(self.ends):
            jacobian[a, :, i], jacobian[a, :, j] = -bases[a], bases[a]
        walls = self.wall_normals.shape[1]
        for m, i in enumerate(self.nodes_at_walls):
            for w in range(walls):
                jacobian[r + m * walls + w, :, i] = bases[r + m * walls + w]
        slips = np.concatenate([self.slips, self.wall_slips.reshape(-1, 3)])
        local = np.einsum("aki,ai->ak", bases, slips)[:, 1:]
        gaps = np.concatenate([self.values, self.gaps.ravel()])
        friction = np.concatenate([self.friction, self.wall_friction.ravel()])
        jacobian, softness = jacobian.reshape(3 * len(normals), -1), (self.free / self.stiffness[:, None]).ravel()
        forces = uzawa(jacobian, softness, gaps, local, friction)
        moves = (softness * (jacobian.T @ forces.ravel())).reshape(n, 3)
        return np.einsum("aki,ak->ai", bases, forces)[:r], moves


@pytest.mark.parametrize("seed", range(30))
def test_groups_as_by_another_method(seed):
    group = Group(seed)
    found, pushes = group.solve()
    assert found == (-1, 0)
    forces, moves = group.reference()
    scale = max(1.0, np.abs(forces).max())
    np.testing.assert_allclose(pushes.normal[:, None] * group.normals + pushes.drag, forces, atol=1e-7 * scale)
    np.testing.assert_allclose(pushes.moves, moves, atol=1e-7 * scale)


@pytest.mark.parametrize("seed", range(60))
def test_supported_groups_obey_the_law(seed):
    """Supports at some components, and more friction: what is found satisfies all conditions."""
    group = Group(seed, most=0.8, fixed=0.3)
    found, pushes = group.solve()
    if found == (0, JAMMED):
        return  # a jam, or more friction than any position can balance
    if found == (0, INFEASIBLE):
        assert group.free.min() == 0.0  # supports leave no room
        return
    n, ends = group.normals, group.ends
    usable = (n**2 * (group.free[ends[:, 0]] + group.free[ends[:, 1]])).sum(axis=1) > 1e-12
    moved = pushes.moves[ends[:, 1]] - pushes.moves[ends[:, 0]]
    gaps = group.values + np.einsum("ri,ri->r", n, moved)
    slips = group.slips + moved
    slips -= np.einsum("ri,ri->r", slips, n)[:, None] * n
    size, drag = np.linalg.norm(slips, axis=1), np.linalg.norm(pushes.drag, axis=1)
    scale = max(1.0, pushes.normal.max())
    assert gaps[usable].min(initial=0.0) > -1e-9 * scale and pushes.normal.min() >= 0.0
    assert np.abs(pushes.normal * gaps).max() < 1e-8 * scale
    assert (drag <= group.friction * pushes.normal + 1e-12 * scale).all()
    slides = (pushes.normal > 0.0) & (size > 1e-6)
    against = -(group.friction * pushes.normal / np.maximum(size, 1e-300))[:, None] * slips
    np.testing.assert_allclose(pushes.drag[slides], against[slides], atol=1e-6 * scale)
    # the forces of pairs, and of nothing else at nodes without walls, move the nodes
    push = np.zeros_like(pushes.moves)
    force = pushes.normal[:, None] * n + pushes.drag
    np.add.at(push, ends[:, 1], force)
    np.add.at(push, ends[:, 0], -force)
    alone = group.plane < 0
    expected = push * group.free / group.stiffness[:, None]
    np.testing.assert_allclose(pushes.moves[alone], expected[alone], atol=1e-9 * scale)
