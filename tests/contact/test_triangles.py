"""Surfaces of triangles: distances against every face by other formulas, sides by winding numbers, and nodes that are
stopped on random ways never end behind a surface."""

import numpy as np
import pytest
from helpers.triangles import ball, box, groove, torus

from pfem_petsc.contact.projection import project
from pfem_petsc.contact.triangles import Triangles, nearest, stopping_faces
from pfem_petsc.mechanics.compiled import by_reference, kernel

BODIES = {"box": box((-1.0, -0.6, -0.3), (1.0, 0.6, 0.3)), "ball": ball(2), "torus": torus()}


@kernel
def signed_distances(triangles, x, reach, distances, faces, places):
    for i in range(len(x)):
        distances[i], faces[i, 0], faces[i, 1], places[i, 0], places[i, 1], places[i, 2] = nearest(
            triangles, x[i, 0], x[i, 1], x[i, 2], reach
        )


def query(triangles, x, reach=np.inf):
    distances, faces, places = np.empty(len(x)), np.empty((len(x), 2), np.int64), np.empty((len(x), 3))
    signed_distances(by_reference(triangles), x, reach, distances, faces, places)
    return distances, faces, places


def stopped(triangles, start, free, tolerance=1e-9, fixed=None):
    """Where nodes get to, and the planes that stop them."""
    fixed = np.zeros((len(free), 3), bool) if fixed is None else fixed
    normals, offsets = np.zeros((len(free), 3, 3)), np.zeros((len(free), 3))
    ways = np.stack([start, free])
    stopping_faces(by_reference(triangles), ways, fixed, np.full(len(free), tolerance), normals, offsets)
    end = free.copy()
    assert project(end, fixed, normals, offsets, 1e-13, np.empty((len(free), 3))) == -1
    return end, normals, offsets


def distances_to_all(places, x):
    """Distances (m, t) of points from triangles (t, 3, 3): from the plane if the foot is inside, or from the sides."""
    a, b, c = places[:, 0], places[:, 1], places[:, 2]
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    height = np.einsum("mti,ti->mt", x[:, None] - a, normals)
    foot = x[:, None] - height[:, :, None] * normals
    inside, nearest = np.ones(height.shape, bool), np.full(height.shape, np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("mti,ti->mt", np.cross(v - u, foot - u), normals) >= 0.0
        part = np.clip(np.einsum("mti,ti->mt", x[:, None] - u, v - u) / ((v - u) ** 2).sum(axis=1), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(x[:, None] - u - part[:, :, None] * (v - u), axis=2))
    return np.where(inside, np.abs(height), nearest)


def winding_numbers(places, x):
    """How many times a closed surface encloses points: the sum of solid angles (A. van Oosterom, J. Strackee, 1983)."""
    a, b, c = (places[None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(arm, axis=2) for arm in (a, b, c))
    below = la * lb * lc + (a * b).sum(axis=2) * lc + (b * c).sum(axis=2) * la + (c * a).sum(axis=2) * lb
    angles = 2.0 * np.arctan2(np.einsum("mti,mti->mt", a, np.cross(b, c)), below)
    return angles.sum(axis=1) / (4.0 * np.pi)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("turned", [False, True])
def test_distances_and_sides_are_those_of_all_faces(name, turned):
    points, corners = BODIES[name]
    triangles = Triangles.of(points, corners[:, ::-1] if turned else corners)
    x = np.random.default_rng(0).uniform(-1.6, 1.6, (150, 3))
    distances, faces, places = query(triangles, x)
    expected = distances_to_all(triangles.points, x)
    np.testing.assert_allclose(np.abs(distances), expected.min(axis=1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(expected[np.arange(len(x)), faces[:, 0]], np.abs(distances), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(x - places, axis=1), np.abs(distances), rtol=0, atol=1e-12)
    enclosed = np.abs(winding_numbers(triangles.points, x)) > 0.5
    assert 0 < enclosed.sum() < len(x)
    np.testing.assert_array_equal(distances < 0.0, enclosed != turned)
    near, far = np.abs(distances) < 0.3, query(triangles, x, 0.3)[0]
    np.testing.assert_array_equal(far, np.where(near, distances, np.inf))


def test_corners_edges_and_faces_themselves():
    """Points along the normals of corners, edges and faces have these as the nearest, at their distance."""
    triangles = Triangles.of(*BODIES["torus"])
    at = np.concatenate([triangles.points.mean(axis=1), triangles.points.reshape(-1, 3)])
    normals = np.concatenate([triangles.normals[:, 0], triangles.normals[:, 4:].reshape(-1, 3)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    np.testing.assert_allclose(query(triangles, at)[0], 0.0, atol=1e-15)
    outside, _, places = query(triangles, at + 1e-3 * normals)
    inside = query(triangles, at - 1e-3 * normals)[0]
    faces = slice(len(triangles.points))
    np.testing.assert_allclose(outside[faces], 1e-3, rtol=1e-10)
    np.testing.assert_allclose(inside[faces], -1e-3, rtol=1e-10)
    np.testing.assert_allclose(places[faces], at[faces], atol=1e-15)
    assert (outside > 0.0).all() and (inside < 0.0).all()


def test_distance_from_a_fine_sphere_is_that_of_the_sphere():
    """Chords of length h are up to h^2 / 8 inside, triangles up to h^2 / 6."""
    x = np.random.default_rng(1).normal(size=(200, 3))
    for level in (3, 4, 5):
        triangles = Triangles.of(*ball(level))
        longest = np.linalg.norm(np.diff(triangles.points, axis=1), axis=2).max()
        error = query(triangles, x)[0] - (np.linalg.norm(x, axis=1) - 1.0)
        assert 0.0 <= error.min() and error.max() < longest**2 / 6.0
    assert len(triangles.points) == 8192


def test_triangles_of_very_different_sizes():
    rng = np.random.default_rng(2)
    sizes = 10.0 ** rng.uniform(-5.0, 1.0, 300)
    points = (rng.uniform(-1.0, 1.0, (300, 1, 3)) + sizes[:, None, None] * rng.normal(size=(300, 3, 3))).reshape(-1, 3)
    triangles = Triangles.of(points, np.arange(900).reshape(-1, 3))
    x = rng.uniform(-2.0, 2.0, (50, 3))
    np.testing.assert_allclose(
        np.abs(query(triangles, x)[0]), distances_to_all(triangles.points, x).min(axis=1), atol=1e-12
    )
    assert len(triangles.boxes) <= len(triangles.points)


def test_groove_stops_nodes_as_two_planes_do():
    triangles = Triangles.of(*groove())
    slopes = np.array([[1.0, 0, 2.0], [-1.0, 0, 2.0]]) / np.sqrt(5.0)
    rng = np.random.default_rng(5)
    start = rng.uniform([-0.5, -1, 0.4], [0.5, 1, 0.8], (400, 3))
    free = start + rng.uniform([-0.5, -1, -1.5], [0.5, 1, 0.1], (400, 3))
    end, normals, offsets = stopped(triangles, start, free)
    expected = free.copy()
    planes, levels = np.broadcast_to(slopes, (400, 2, 3)).copy(), np.zeros((400, 2))
    project(expected, np.zeros((400, 3), bool), planes, levels, 1e-13, np.empty((400, 2)))
    np.testing.assert_allclose(end, expected, atol=1e-12)
    count = np.isfinite(offsets).sum(axis=1)
    assert set(count) == {0, 1, 2}
    valley = np.abs(expected[:, 0]) < 1e-12
    assert valley.any() and (count[valley] == 2).all()
    for i, k in np.argwhere(np.isfinite(offsets)):
        assert np.abs(slopes - normals[i, k]).max(axis=1).min() < 1e-15 and abs(offsets[i, k]) < 1e-15


def test_corner_of_a_room_has_three_faces_and_that_of_a_box_one():
    points, corners = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    room = Triangles.of(points, corners[:, ::-1])
    start = np.array([[0.2, 0.3, 0.1], [0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    free = np.array([[-0.1, -0.2, -0.3], [-1e-3, -2e-3, -1e-3], [-1e-3, 0.5, -1e-4]])
    end, normals, offsets = stopped(room, start, free)
    np.testing.assert_allclose(end, [[0, 0, 0], [0, 0, 0], [0, 0.5, 0]], atol=1e-15)
    assert np.isfinite(offsets).sum(axis=1).tolist() == [3, 3, 2]
    np.testing.assert_allclose(np.sort(normals[0], axis=0), [[0, 0, 0], [0, 0, 0], [1, 1, 1]], atol=1e-15)
    solid = Triangles.of(points, corners)
    start = np.array([[0.0, 0.0, 0.0], [-0.01, -0.01, -0.02], [-0.1, 0.5, 0.5]])
    end, _, offsets = stopped(solid, start, start + [0.05, 0.06, 0.04])
    assert np.isfinite(offsets).sum(axis=1).tolist() == [1, 1, 0]
    np.testing.assert_allclose(end, [[0.05, 0.06, 0.0], [0.04, 0.05, 0.0], [-0.05, 0.56, 0.54]], atol=1e-15)


@pytest.mark.parametrize("off", [0.0, 1e-16, -1e-16, 1e-11, -1e-11])
def test_nodes_that_start_on_edges_slide_along_faces(off):
    """A node that rests on the edge or corner of a table slides over it, and off it, as others do."""
    table = Triangles.of(*box((0.0, 0.0, -1.0), (1.0, 2.0, 0.0)))
    start = np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.5, 0.0]]) + off
    way = np.array([[0.1, 0.2, -1e-4], [0.1, 0.2, -1e-4], [-0.1, 0.2, -1e-4], [-1e-4, 0.2, -0.1]])
    end = stopped(table, start, start + way)[0]
    np.testing.assert_allclose(end[:2], start[:2] + [0.1, 0.2, 0.0], atol=2e-11)
    assert (end[2:, 0] < 0.0).all() and (end[2:, 2] <= 2e-11).all()
    np.testing.assert_allclose(end[:, 1], start[:, 1] + 0.2, atol=2e-11)


@pytest.mark.parametrize("size", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", BODIES)
def test_nodes_on_random_ways_stay_in_front(name, turned, size):
    """They are pushed against the surface for 20 steps in one direction, along it, into edges and corners."""
    points, corners = BODIES[name]
    triangles = Triangles.of(points, corners[:, ::-1] if turned else corners)
    rng = np.random.default_rng(6)
    x = rng.uniform(-1.3, 1.3, (600, 3))
    x = x[query(triangles, x)[0] > 0.0][:100]
    assert len(x) > 20
    most = 0
    for step in range(60):
        if step % 20 == 0:
            drift = size * rng.normal(size=x.shape)
        free = x + drift + 0.3 * size * rng.normal(size=x.shape)
        end, _, offsets = stopped(triangles, x, free)
        most = max(most, int(np.isfinite(offsets).sum(axis=1).max()))
        assert query(triangles, end)[0].min() > -1e-12
        x = np.clip(end, -1.6, 1.6)
    convex = name != "torus" and not turned
    assert most == 1 if convex else most > (size > 0.05)


@pytest.mark.parametrize("size", [0.02, 0.4])
def test_a_sheet_keeps_nodes_on_the_side_they_come_from(size):
    """A bag, with nodes inside and outside, that are pushed against it at random."""
    bag = Triangles.of(*BODIES["ball"], True, 1e-6)
    rng = np.random.default_rng(8)
    x = rng.normal(size=(150, 3))
    x *= (rng.choice([0.9, 1.1], 150) / np.linalg.norm(x, axis=1))[:, None]
    x = x[np.abs(query(bag, x)[0]) > 1e-6]
    side = query(bag, x)[0] > 0.0
    assert 20 < side.sum() < len(x) - 20
    met = np.zeros(len(x), bool)
    for _ in range(60):
        free = x + size * rng.normal(size=x.shape)
        x, _, offsets = stopped(bag, x, free)
        met |= np.isfinite(offsets).any(axis=1)
        distances = query(bag, x)[0]
        np.testing.assert_array_equal(distances > 0.0, side)
        assert np.abs(distances).min() > 1e-6 - 1e-12
        far = np.linalg.norm(x, axis=1) > 1.3
        x[far] *= 1.2 / np.linalg.norm(x[far], axis=1)[:, None]
    assert met.mean() > 0.4


def test_a_node_passes_the_ridge_of_a_sheet_on_its_side():
    """It starts behind the plane of the face that it ends at, but has not passed through the sheet."""
    points, corners = groove()
    ridge = Triangles.of(points * [1.0, 1.0, -1.0], corners[:, ::-1], True, 0.01)
    normal = np.array([1.0, 0.0, 2.0]) / np.sqrt(5.0)  # of the right face, upwards
    foot = np.array([[-0.2, 0.0, 0.1], [0.5, 0.0, -0.25]])
    start, free = foot + np.array([-0.001, 0.006])[:, None] * normal
    for turned in (1.0, -1.0):
        sheet = ridge if turned > 0.0 else Triangles.of(points * [1.0, 1.0, -1.0], corners, True, 0.01)
        end, _, offsets = stopped(sheet, start[None], free[None])
        assert np.isfinite(offsets).sum() == 1
        np.testing.assert_allclose(end[0], foot[1] + 0.01 * normal, atol=1e-14)


def test_nodes_move_in_the_directions_that_supports_leave_free():
    """Down a vertical line, and along a horizontal one, onto the slopes of a groove."""
    triangles = Triangles.of(*groove())
    start = np.array([[0.5, 0.1, 1.0], [-1.0, 0.2, 0.6], [0.0, 0.0, 0.3]])
    free = np.array([[0.5, 0.1, -1.0], [-1.5, 0.2, 0.6], [0.0, 0.0, -0.2]])
    fixed = np.array([[True, True, False], [False, True, True], [True, True, False]])
    end, _, offsets = stopped(triangles, start, free, fixed=fixed)
    np.testing.assert_allclose(end, [[0.5, 0.1, 0.25], [-1.2, 0.2, 0.6], [0.0, 0.0, 0.0]], atol=1e-14)
    assert np.isfinite(offsets).any(axis=1).all()
    held = stopped(triangles, start[:1], free[:1], fixed=np.ones((1, 3), bool))[0]
    np.testing.assert_array_equal(held, free[:1])


def test_thin_plate_and_sheets_stop_fast_nodes():
    plate = Triangles.of(*box((-1.0, -1.0, -1e-4), (1.0, 1.0, 1e-4)))
    start = np.array([[0.1, 0.2, 0.5], [0.1, 0.2, -0.5], [0.1, 0.2, 1e-4], [1.1, 0.2, 0.5], [0.3, 0.3, 1e-4 - 1e-12]])
    free = start * [1.0, 1.0, -1.0]
    free[2, 2] = -0.3
    end = stopped(plate, start, free)[0]
    np.testing.assert_allclose(end[:, 2], [1e-4, -1e-4, 1e-4, -0.5, 1e-4], atol=1e-15)
    np.testing.assert_array_equal(end[:, :2], free[:, :2])
    points, corners = box((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0))
    for both, z in ((False, [0.0, 0.5, 0.0, -0.5, 0.0]), (True, [0.01, -0.01, 0.01, -0.5, 0.01])):
        sheet = Triangles.of(points, corners[-4:-2, ::-1], both, 0.01 * both)  # the face z = 0, seen from above
        start[:, 2] = [0.5, -0.5, 0.01 * both, 0.5, 0.01 * both - 1e-12]
        free[:, 2] = [-0.5, 0.5, -0.3, -0.5, -1e-6]
        end = stopped(sheet, start, free)[0]
        np.testing.assert_allclose(end[:, 2], z, atol=1e-15)
        np.testing.assert_array_equal(end[:, :2], free[:, :2])


def test_what_was_behind_the_surface_is_not_stopped():
    solid = Triangles.of(*BODIES["box"])
    start = np.array([[0.0, 0.0, 0.29], [0.0, 0.0, 0.3 - 1e-6], [0.0, 0.0, 0.3 - 1e-12], [0.99, 0.0, 0.0]])
    free = start + [1e-3, 0.0, -1e-3]
    end = stopped(solid, start, free)[0]
    np.testing.assert_array_equal(end[[0, 1, 3]], free[[0, 1, 3]])
    np.testing.assert_allclose(end[2], [1e-3, 0.0, 0.3], atol=1e-15)


def test_resting_nodes_stay_where_they_are():
    """On faces, edges and corners of a body and of a groove, pushed downwards in 50 steps, by 1e-15 m too."""
    for points, corners, x in (
        (*BODIES["box"], [[0.1, 0.2, 0.3], [0.25, 0.0, 0.3], [1.0, 0.1, 0.3], [1.0, 0.6, 0.3]]),
        (*groove(), [[0.0, 0.3, 0.0], [0.5, 0.0, 0.25], [0.0, 1.0, 0.0], [-1.0, 1.0, 0.5]]),
    ):
        triangles, x = Triangles.of(points, corners), np.array(x)
        for push in (1e-15, 1e-9, 1e-3):
            rest = x
            for _ in range(50):
                end, normals, offsets = stopped(triangles, rest, rest - [0.0, 0.0, push])
                assert np.isfinite(offsets).any(axis=1).all()
                drift = np.where(normals[:, 0, 2] > 1.0 - 1e-12, 0.0, push)  # down the slope
                assert (np.abs(end - rest)[:, 2] <= 0.5 * drift + 1e-15).all()
                rest = end


def test_the_order_of_nodes_does_not_matter():
    triangles = Triangles.of(*BODIES["torus"])
    rng = np.random.default_rng(7)
    start = rng.uniform(-1.5, 1.5, (80, 3))
    free = start + rng.normal(scale=0.3, size=(80, 3))
    order = rng.permutation(80)
    for found, expected in zip(stopped(triangles, start[order], free[order]), stopped(triangles, start, free)):
        np.testing.assert_array_equal(found, expected[order])
