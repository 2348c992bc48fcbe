"""Oblique nodal coordinates: planes become bounds, rows are independent, and axes are kept if possible."""

import numpy as np
import pytest

from pfem_petsc.contact.frames import MIN_VOLUME, Planes, build_frames


def frames_of(normals, offsets, fixed=(False, False, False), rank=None):
    normals = np.asarray(normals, dtype=float)[None]
    offsets = np.asarray(offsets, dtype=float)[None]
    rank = offsets * 0.0 if rank is None else np.asarray(rank, dtype=float)[None]
    planes = Planes(np.array([fixed]), normals.copy(), offsets, rank, np.zeros((1, 3)))
    return build_frames(np.array([0]), planes, 1e-12)


@pytest.mark.parametrize("walls", [1, 2, 3, 5])
def test_bounds_are_the_planes(walls):
    """For planes that have a row, n . x - d equals the distance of y to its bound; B and its inverse are inverse."""
    rng = np.random.default_rng(walls)
    for _ in range(200):
        normals = rng.normal(size=(walls, 3))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        offsets = rng.normal(size=walls)
        fixed = rng.random(3) < 0.25
        frames = frames_of(normals, offsets - 10.0, fixed, rng.random(walls))
        basis, inverse = frames.basis[0], frames.inverse[0]
        np.testing.assert_allclose(basis @ inverse, np.eye(3), atol=1e-13 / MIN_VOLUME)
        assert np.linalg.cond(basis) < 2.6 / MIN_VOLUME
        x = rng.normal(size=3)
        for k in range(walls):
            row, ratio = frames.rows[0, k], frames.ratios[0, k]
            if row >= 0:
                # the places are zero, where the prescribed components are as well
                here, free = np.where(fixed, 0.0, x), basis @ np.where(fixed, 0.0, x)
                gap = ratio * (free[row] - frames.bounds[0, k])
                assert gap == pytest.approx(normals[k] @ here - offsets[k] + 10.0, abs=1e-12 / MIN_VOLUME)
        for c in np.flatnonzero(fixed):
            np.testing.assert_array_equal(basis[c], np.eye(3)[c])
        given = len(set(frames.rows[0].tolist()) - {-1})
        assert given == min(walls, 3 - fixed.sum()) or walls > given


def test_overlapping_bounds():
    """Opposite planes that overlap by rounding meet in the middle; by more, the node is named."""
    normals = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    met = frames_of(normals, [1.0 + 4e-13, -1.0])
    assert met.contradiction == -1 and met.lower[0, 0] == met.upper[0, 0]
    assert frames_of(normals, [1.1, -1.0]).contradiction == 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_almost_parallel_planes_share_a_bound_that_is_exact_at_the_place(sign):
    """Planes 3e-8 apart in direction, 7 m from the origin: without regard to the place the bound is 2e-7 m off."""
    angle = 3e-8
    normals = np.array([[[0.0, 0.0, 1.0], [angle, 0.0, sign]]])
    place = np.array([[7.0, 2.0, 0.5]])
    offsets = np.array([[0.1, normals[0, 1] @ place[0] + 0.05]])
    planes = Planes(np.zeros((1, 3), bool), normals, offsets, np.array([[0.0, 1.0]]), place)
    frames = build_frames(np.array([0]), planes, 1.0)
    assert frames.rows.tolist() == [[2, 2]] and frames.shared.tolist() == [[False, True]]
    # the node is 0.05 m beyond the second plane: at its bound it is on it
    moved = place[0] + [0.0, 0.0, frames.bounds[0, 1] - place[0, 2]]
    assert abs(normals[0, 1] @ moved - offsets[0, 1]) < 1e-15
    same = build_frames(np.array([0]), planes._replace(normals=normals[:, [0, 0]], places=np.zeros((1, 3))))
    assert not same.shared.any() and same.bounds.tolist() == offsets.tolist()


@pytest.mark.parametrize("off", [1e-8, 1e-12])
def test_normals_next_to_an_axis_keep_their_direction(off):
    """Off by 1e-8, the part along the axis is 1 to the last digit; the force has the direction of the row."""
    normal = np.array([-1.0, off, 0.0])
    frames = frames_of([normal], [-0.5])
    np.testing.assert_array_equal(frames.basis[0, 0], normal)
    assert frames.oblique
    np.testing.assert_allclose(frames.basis[0] @ frames.inverse[0], np.eye(3), atol=1e-15)
