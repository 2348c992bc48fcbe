"""The explicit contact problem of a node against a search over all active sets, and its optimality conditions."""

import itertools

import numpy as np
import pytest

from pfem_petsc.contact.projection import project


def search(x, fixed, normals, offsets):
    """Nearest position and multipliers by trying every set of up to three planes; None where none fits."""
    free = np.where(fixed, 0.0, normals)
    usable = [k for k in range(len(offsets)) if offsets[k] > -np.inf and free[k] @ free[k] > 1e-12]
    gap = normals @ x - np.where(np.isfinite(offsets), offsets, 0.0)
    best = None
    for n in range(4):
        for active in itertools.combinations(usable, n):
            a = free[list(active)].reshape(-1, 3)
            if n and np.linalg.matrix_rank(a, tol=1e-6) < n:
                continue
            multipliers = np.linalg.solve(a @ a.T, -gap[list(active)]) if n else np.zeros(0)
            move = multipliers @ a
            fits = (multipliers >= 0.0).all() and all(gap[k] + free[k] @ move >= -1e-12 for k in usable)
            if fits and (best is None or move @ move < best[1] @ best[1]):
                best = (active, move, multipliers)
    return best


@pytest.mark.parametrize("walls", [1, 2, 3, 4, 6])
def test_equals_search_over_all_sets(walls):
    """Random planes through and around the origin: corners, wedges, converging walls; supports on some components."""
    rng = np.random.default_rng(walls)
    for _ in range(300):
        normals = rng.normal(size=(walls, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        inside = 0.3 * rng.normal(size=3)
        offsets = normals @ inside - rng.uniform(0.0, 0.3, walls)  # `inside` keeps them all
        offsets[rng.random(walls) < 0.1] = -np.inf
        fixed = rng.random(3) < 0.2
        x = rng.normal(size=3)
        x[fixed] = inside[fixed]
        expected = search(x, fixed, normals, offsets)
        moved, multipliers = x[None].copy(), np.zeros((1, walls))
        infeasible = project(moved, fixed[None], normals[None].copy(), offsets[None].copy(), 1e-13, multipliers)
        assert infeasible == -1 and expected is not None
        np.testing.assert_allclose(moved[0] - x, expected[1], atol=1e-12)
        assert (multipliers >= 0.0).all()
        np.testing.assert_allclose(multipliers[0] @ np.where(fixed, 0.0, normals), moved[0] - x, atol=1e-12)


def test_contradiction_is_told():
    """Opposite walls that overlap leave no room; the first such node is named."""
    normals = np.tile(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), (2, 1, 1))
    offsets = np.array([[0.0, -1.0], [0.2, 0.0]])
    x = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert project(x, np.zeros((2, 3), bool), normals, offsets, 1e-13, np.zeros((2, 2))) == 1
    assert x[0, 0] == 0.0


def test_sphere_of_planes_beyond_reach():
    """Only planes broken on the way matter: forty around the node, and the result is that of the three near ones."""
    rng = np.random.default_rng(0)
    far = rng.normal(size=(37, 3))
    far /= np.linalg.norm(far, axis=1)[:, None]
    normals = np.vstack([np.eye(3), far])
    offsets = np.concatenate([np.zeros(3), np.full(37, -10.0)])
    x = np.array([[-0.1, -0.2, 0.3]])
    multipliers = np.zeros((1, 40))
    assert project(x, np.zeros((1, 3), bool), normals[None].copy(), offsets[None].copy(), 1e-13, multipliers) == -1
    np.testing.assert_allclose(x[0], [0.0, 0.0, 0.3], atol=1e-15)
    assert (np.flatnonzero(multipliers[0]) == [0, 1]).all()
