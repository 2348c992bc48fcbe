"""Nearest neighbours in a plane: equal to an exhaustive search, including ties, and fast."""

import numpy as np
import pytest

from pfem_petsc.contact.constraint_set import across, nearest_points


def nearest(points, queries, normal):
    """The indices of the nearest points, seen along a direction."""
    return nearest_points(across(points, normal), across(queries, normal))


def looking_at_all(points, queries, normal):
    points, queries = across(points, normal), across(queries, normal)
    return np.array([int(np.argmin(((points - query) ** 2).sum(axis=1))) for query in queries])


def cloud(kind, rng, normal, n, m):
    if kind == "scattered":
        return rng.normal(size=(n, 3)), 3.0 * rng.normal(size=(m, 3))
    if kind == "ties":
        return 0.1 * rng.integers(0, 6, size=(n, 3)), 0.05 * rng.integers(-3, 15, size=(m, 3))
    if kind == "line":
        along = np.array([1.0, 2.0, 0.5])
        return np.outer(rng.random(n), along), np.outer(rng.random(m), along) + 1e-3 * rng.normal(size=(m, 3))
    if kind == "one place":
        return np.outer(rng.random(n), normal), rng.normal(size=(m, 3))
    points = 1e6 + 1e-2 * rng.normal(size=(n, 3))
    points[0] += 50.0
    return points, 1e6 + rng.normal(size=(m, 3))


@pytest.mark.parametrize("kind", ["scattered", "ties", "line", "one place", "far away"])
def test_nearest_is_that_of_looking_at_all(kind):
    rng = np.random.default_rng(4)
    for trial in range(40):
        normal = rng.normal(size=3) if trial % 2 else np.eye(3)[trial % 3]
        normal = normal / np.linalg.norm(normal)
        points, queries = cloud(kind, rng, normal, *rng.integers(1, 200, size=2))
        found = nearest(points, queries, normal)
        np.testing.assert_array_equal(found, looking_at_all(points, queries, normal))
