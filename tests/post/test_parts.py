"""Camera, wall surfaces, colours and choice of instants, as numbers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pictures import camera_of, corners
from helpers.synthetic import SyntheticResult, ring

from pfem_petsc.post.motion import chosen_frames, plane, wall_surfaces
from pfem_petsc.post.page import ColourField, grid
from pfem_petsc.post.render import instants

BOX = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 1.0]])


@pytest.mark.parametrize(
    ("extent", "towards"),
    [((1, 1, 0), (0, 0, 1)), ((1, 0, 1), (0, -1, 0)), ((0, 1, 1), (1, 0, 0)), ((1, 0, 0), (0, 0, 1))],
)
def test_flat_structures_are_seen_square_on(extent, towards):
    bounds = np.array([(3.0, 4.0, 5.0), np.add((3.0, 4.0, 5.0), extent)])
    camera = camera_of(bounds, "auto", 1.6)
    assert camera.parallel and np.array_equal(camera.towards, towards)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_oblique_view_holds_every_point(aspect):
    camera = camera_of(BOX, "auto", aspect)
    assert not camera.parallel
    eye = camera.centre + camera.distance * camera.towards
    ahead = corners(BOX) - eye
    depth = -ahead @ camera.towards
    slope = camera.half_height / camera.distance
    high = np.abs(ahead @ camera.up) / (depth * slope)
    wide = np.abs(ahead @ camera.right) / (depth * slope * aspect)
    assert max(high.max(), wide.max()) < 1.0  # inside
    assert max(high.max(), wide.max()) > 0.8  # and not small


@pytest.mark.parametrize("normal", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
def test_oblique_view_looks_at_walls_from_their_allowed_side(normal):
    camera = camera_of(BOX, "iso", 1.6, [np.array(normal, dtype=float)])
    assert camera.towards @ normal > 0.25 and camera.towards[2] > 0


@pytest.mark.parametrize("normal", [(0, 0, 2.0), (-1, 0, 0), (1.0, -2.0, 0.5)])
def test_plane_is_drawn_on_the_plane_and_behind_it(normal):
    wall = SimpleNamespace(name="w", type="plane", point=(0.3, -0.2, 0.1), normal=normal)
    surface = plane(wall, BOX)
    unit = np.array(normal) / np.linalg.norm(normal)
    height = (surface.points - wall.point) @ unit
    assert np.allclose(height[surface.depth == 0], 0.0, atol=1e-12)
    assert np.all(height[surface.depth == 1] < 0.0)
    # the face points to the allowed side, and covers the shadow of the structure
    face = surface.points[surface.faces[0]]
    assert np.cross(face[1] - face[0], face[2] - face[1]) @ unit > 0
    for side, other in ((face[1] - face[0], face[0]), (face[3] - face[0], face[0])):
        along = (corners(BOX) - other) @ side / (side @ side)
        assert along.min() > 0 and along.max() < 1


def test_walls_without_a_drawing_are_named():
    notes = []
    walls = [SimpleNamespace(name="a", type="pyramid"), SimpleNamespace(name="b", type="plane", point=(0, 0, 0))]
    walls[1].normal = (0, 0, 1)
    assert [surface.name for surface in wall_surfaces(walls, BOX, notes.append)] == ["b"]
    assert len(notes) == 1 and "'a'" in notes[0]


class Values:
    """A result with one cell field."""

    point_fields, cell_fields, bars = [], ["stress", "plastic_strain"], ()

    def __init__(self, *snapshots):
        self.snapshots = [np.asarray(s, dtype=float) for s in snapshots]

    def field(self, name, index):
        return self.snapshots[index]


def test_range_is_symmetric_for_signed_fields_and_fixed_over_time():
    field = ColourField(Values([1.0, 2.0], [-5.0, 3.0]), "stress")
    assert field.limits(range(2)) == (-5.0, 5.0)
    assert ColourField(Values([0.0, 2.0], [1.0, 3.0]), "plastic_strain").limits(range(2)) == (0.0, 3.0)
    assert ColourField(Values([0.0, 0.0]), "stress").limits([0]) == (-1.0, 1.0)


def test_range_of_one_sign_begins_at_zero():
    """Tension of cables, also with a compression that no colour would tell from zero."""
    assert ColourField(Values([0.0, 2.0], [-0.01, 3.0]), "stress").limits(range(2)) == (0.0, 3.0)
    assert ColourField(Values([-0.1, 2.0], [0.0, 3.0]), "stress").limits(range(2)) == (-3.0, 3.0)
    assert ColourField(Values([-2.0, -3.0]), "stress").limits([0]) == (-3.0, 3.0)


def test_a_spike_does_not_take_the_contrast():
    values = np.concatenate([np.linspace(-1, 1, 1000), [500.0]])
    low, high = ColourField(Values(np.zeros(1001), values), "stress").limits(range(2))
    assert 0.9 < high < 1.0 and low == -high


def test_instants_are_evenly_distributed(tmp_path):
    """Of 101 snapshots every twentieth, of 14 two or three steps apart, of few all; those that --frames 6 takes."""
    result = SyntheticResult(tmp_path / "x", *ring(), snapshots=101)
    assert instants(result, range(101), 6) == [0, 20, 40, 60, 80, 100]
    chosen = instants(result, range(14), 6)
    assert chosen[0] == 0 and chosen[-1] == 13 and set(np.diff(chosen)) == {2, 3}
    assert chosen == chosen_frames(6, result.times[:14], print)
    assert instants(result, [3, 1], 6) == [1, 3]


def test_tiles_suit_the_shape():
    assert grid(6, 1.0, (1400, 750)) == (3, 2)
    assert grid(6, 8.0, (1400, 750)) == (1, 6) or grid(6, 8.0, (1400, 750)) == (2, 3)
    assert grid(6, 0.1, (1400, 750)) == (6, 1)
