"""Surfaces of several bodies: what is inside by the even-odd rule, whatever the orientation of the triangles."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from helpers.meshes import CORNERS, CUBE, assert_part_of, filled, write_stl
from mpi4py import MPI

from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators.lattice.surface import read_surface

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def boxes(*bodies):
    """Corners and triangles of boxes, each given by two corners and whether it is inside out."""
    points = [np.array(low) + CORNERS * (np.array(high) - low) for low, high, _ in bodies]
    triangles = [(CUBE[:, ::-1] if flip else CUBE) + 8 * k for k, (_, _, flip) in enumerate(bodies)]
    return np.vstack(points), np.vstack(triangles)


def two_tetrahedra(path, flips=(False, True)):
    corner = np.vstack([np.zeros(3), np.eye(3)])
    triangles = [(TETRAHEDRON[:, ::-1] if flip else TETRAHEDRON) + 4 * k for k, flip in enumerate(flips)]
    return write_stl(path, np.vstack([corner, 0.8 * corner + (2.0, 0.0, 0.0)]), np.vstack(triangles))


@pytest.mark.parametrize("flips", list(product((False, True), repeat=2)))
def test_two_bodies_are_filled_and_nothing_outside(tmp_path, flips):
    """Nodes of octet cells have whole coordinates with an even sum, in halves of the pitch: in a corner up to n,
    (s + 1)(s + 2)/2 for each even s."""
    path = two_tetrahedra(tmp_path / "two.stl", flips)
    mesh = filled(kind="octet", pitch=0.1, surface={"file": str(path)})
    expected = [sum((s + 1) * (s + 2) // 2 for s in range(0, n + 1, 2)) for n in (20, 16)]
    assert [int((mesh.points[:, 0] < 1.5).sum()), int((mesh.points[:, 0] > 1.5).sum())] == expected
    assert mesh.volume == pytest.approx((1.0 + 0.8**3) / 6.0)
    assert not mesh.warnings


NESTED = [
    ([0, 0, 0], [4, 4, 4]),
    ([0.5, 0.5, 0.5], [3.5, 3.5, 3.5]),
    ([1, 1, 1], [1.5, 1.5, 1.5]),
    ([2, 2, 2], [3, 3, 3]),
    ([2.2, 2.2, 2.2], [2.8, 2.8, 2.8]),
]
ARRANGEMENTS = {
    "apart": [([0, 0, 0], [1, 1, 1]), ([2, 0, 0], [3, 1, 1])],
    "one in another": [([0, 0, 0], [4, 4, 4]), ([1, 1, 1], [3, 3, 3])],
    "nested": NESTED,
    "nested, the innermost first": NESTED[::-1],
    "on a face": [([0, 0, 0], [2, 2, 1]), ([0.5, 0.5, 1], [1, 1, 2])],
    "beyond a face": [([0, 0, 0], [2, 2, 1]), ([1, 1, 1], [3, 3, 2])],
    "at an edge": [([0, 0, 0], [1, 1, 1]), ([1, 1, 0], [2, 2, 1])],
    "at a corner": [([0, 0, 0], [1, 1, 1]), ([1, 1, 1], [2, 2, 2])],
    "a cavity that touches": [([0, 0, 0], [4, 4, 4]), ([1, 1, 2], [3, 3, 4])],
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
@pytest.mark.parametrize("flips", [(0, 0, 0, 0, 0), (1, 1, 1, 1, 1), (0, 1, 0, 1, 0), (1, 0, 0, 1, 1)])
def test_inside_is_where_an_odd_number_of_bodies_is(tmp_path, name, flips):
    bodies = ARRANGEMENTS[name]
    points, triangles = boxes(*((*body, flip) for body, flip in zip(bodies, flips)))
    random = np.random.default_rng(5)
    turned = random.random(len(triangles)) < (0.2 if flips[0] == flips[1] == 1 else 0.0)
    triangles[turned] = triangles[turned, ::-1]
    surface = read_surface(write_stl(tmp_path / "s.stl", points, triangles[random.permutation(len(triangles))]), 1.0)
    places = random.uniform(-0.5, 4.5, (4000, 3))
    within = np.array([((places > low) & (places < high)).all(axis=1) for low, high in bodies])
    np.testing.assert_array_equal(surface.distances(places) < 0.0, within.sum(axis=0) % 2 == 1)
    volumes = [np.prod(np.subtract(high, low)) for low, high in bodies]
    depth = [
        sum(np.greater_equal(low, a).all() and np.less_equal(high, b).all() for a, b in bodies) for low, high in bodies
    ]
    assert surface.volume == pytest.approx(sum(v if d % 2 else -v for v, d in zip(volumes, depth)))
    told = sum("of the same orientation" in text for text in surface.warnings)
    assert told == (name == "one in another" and flips[0] == flips[1] == 0) or name in (
        "nested",
        "nested, the innermost first",
        "a cavity that touches",
    )


def test_bodies_that_share_a_face_are_one(tmp_path):
    points, triangles = boxes(([0, 0, 0], [1, 1, 1], 0), ([1, 0, 0], [2, 1, 1], 0))
    surface = read_surface(write_stl(tmp_path / "s.stl", points, triangles), 1.0)
    assert surface.volume == pytest.approx(2.0)
    assert len(surface.triangles) == 20
    twice = read_surface(write_stl(tmp_path / "t.stl", CORNERS, np.vstack([CUBE, CUBE])), 1.0)
    assert twice.volume == pytest.approx(1.0)


@pytest.mark.parametrize(
    "bodies",
    [
        [([0, 0, 0], [2, 2, 2]), ([1, 1, 1], [3, 3, 3])],
        [([0, 1, 1], [4, 2, 2]), ([1, 0, 1.2], [2, 4, 1.6])],  # no corner of one is in the other
        [([0, 1, 1], [4, 2, 2]), ([1, 0, 1], [2, 4, 2])],
        [([0, 0, 0], [2, 1, 1]), ([1, 0, 0], [3, 1, 1])],
    ],
)
def test_bodies_that_intersect_are_refused(tmp_path, bodies):
    path = write_stl(tmp_path / "s.stl", *boxes(*((*body, False) for body in bodies)))
    with pytest.raises(
        InputError, match="mesh.surface.file: .*s.stl: two bodies intersect, one of which has the corner"
    ):
        filled(surface={"file": str(path)})


def test_edges_that_cannot_be_assigned_and_strips_are_refused(tmp_path):
    points, triangles = boxes(([0, 0, 0], [1, 1, 1], 0), ([1, 0, 0], [2, 1, 1], 0))
    with_wall = np.vstack([triangles, [[1, 3, 7], [1, 7, 5]]])  # one more than the two that cancel each other
    with pytest.raises(InputError, match="not closed|is not known which of them belong to one body"):
        read_surface(write_stl(tmp_path / "s.stl", points, with_wall), 1.0)
    # the projective plane with six corners: closed, with one side
    faces = [
        (0, 1, 2),
        (0, 2, 3),
        (0, 3, 4),
        (0, 4, 5),
        (0, 5, 1),
        (1, 2, 4),
        (2, 3, 5),
        (3, 4, 1),
        (4, 5, 2),
        (5, 1, 3),
    ]
    corners = np.random.default_rng(2).random((6, 3)).round(3)
    with pytest.raises(InputError, match="has one side only, like a Möbius strip"):
        read_surface(write_stl(tmp_path / "p.stl", corners, np.array(faces)), 1.0)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_other_formats(tmp_path, suffix):
    import pyvista

    points, triangles = boxes(([0, 0, 0], [4, 4, 4], 1), ([1, 1, 1], [3, 3, 3], 1))
    pyvista.PolyData.from_regular_faces(points, triangles).save(tmp_path / f"s.{suffix}")  # STL and PLY are binary
    assert read_surface(tmp_path / f"s.{suffix}", 0.5).volume == pytest.approx(7.0)


def test_flat_bodies_are_left_out_with_a_warning(tmp_path):
    points = np.vstack([CORNERS, [[2, 0, 0], [3, 0, 0], [3, 1, 0], [2, 1, 0]]])
    flat = np.array([(8, 9, 10), (8, 10, 11), (8, 11, 9), (9, 11, 10)])
    surface = read_surface(write_stl(tmp_path / "s.stl", points, np.vstack([CUBE, flat])), 1.0)
    assert surface.volume == pytest.approx(1.0)
    assert "left out 4 triangles that enclose no volume, at (2, 0, 0) in the file" in surface.warnings[0]


def test_bodies_at_the_same_place_count_as_one_with_a_warning(tmp_path):
    surface = read_surface(write_stl(tmp_path / "s.stl", CORNERS, np.vstack([CUBE, CUBE])), 1.0)
    assert surface.volume == pytest.approx(1.0)
    (warning,) = surface.warnings
    assert warning.endswith("12 triangles are in the file more than once: bodies at the same place count as one")


def test_the_volume_of_the_cells_is_compared_with_that_inside(tmp_path):
    """Whole cubes: 4 x 4 x 4 cells have 5/4 of the struts of their share along each axis that struts lie across."""
    path = write_stl(tmp_path / "cube.stl", CORNERS, CUBE)
    mesh = filled(kind="cubic", pitch=0.25, surface={"file": str(path)}, origin=[0.0, 0.0, 0.0])
    edges, diagonals = 3 * 4 * 25, 6 * 16 * 5
    assert mesh.filled == pytest.approx((edges + diagonals) / 9.0 / 64.0)
    assert not mesh.warnings
    path = write_stl(tmp_path / "long.stl", CORNERS * (8.0, 1.0, 1.0), CUBE)
    whole = filled(kind="octet", pitch=0.25, surface={"file": str(path)})
    part = filled(kind="octet", pitch=0.25, surface={"file": str(path)}, cells=[4, 4, 4], origin=[0.0, 0.0, 0.0])
    assert not whole.warnings
    assert part.filled < 1.4
    assert "surface encloses 8 m3, which differs by more than the size of cells explains" in part.warnings[0]


@pytest.mark.parallel
def test_every_rank_has_its_part_of_bodies_that_touch(comm, shared_tmp_path):
    path = shared_tmp_path / "s.stl"
    if comm.rank == 0:
        write_stl(path, *boxes(([0, 0, 0], [2, 2, 1], 1), ([0.5, 0.5, 1], [1, 1, 2], 0)))
    comm.Barrier()
    keys = {"kind": "bcc", "pitch": 0.3, "surface": {"file": str(path), "cut": "clip"}}
    slab, alone = filled(comm, **keys), filled(MPI.COMM_SELF, **keys)
    assert_part_of(slab, alone, comm)
    assert slab.filled == pytest.approx(alone.filled)
