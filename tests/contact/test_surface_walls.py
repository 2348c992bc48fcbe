"""Walls that are surfaces of triangles: files of all formats, what is refused, distances, pictures, and a run."""

import struct

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, simulation
from helpers.triangles import ball, box, groove
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.contact.walls import surface
from pfem_petsc.errors import InputError
from pfem_petsc.post.motion import wall_surfaces

POINTS, CORNERS = box((-1.0, -2.0, 0.0), (1.0, 2.0, 0.5))
QUADS = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]]


def wall_of(path, **keys):
    return surface.Wall(surface.Parameters(name="anvil", type="surface", file=str(path), **keys))


def binary_stl(points, corners):
    rows = np.zeros(len(corners), [("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    rows["numbers"][:, 1:] = points[corners]
    return b"solid whatever".ljust(80) + struct.pack("<I", len(corners)) + rows.tobytes()


def text_stl(points, corners):
    facets = [
        "facet normal 0 0 0\n outer loop\n"
        + "".join(f"  vertex {x!r} {y!r} {z!r}\n" for x, y, z in points[own].tolist())
        + " endloop\nendfacet\n"
        for own in corners
    ]
    return f"solid part\n{''.join(facets)}endsolid part\n".encode()


def obj(points, faces):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    lines += ["f " + " ".join(f"{k + 1 if n % 2 else k - len(points)}//1" for k in own) for n, own in enumerate(faces)]
    return "\n".join(["o part", *lines, ""]).encode()


def ply(points, faces, order="ascii"):
    head = f"ply\nformat {order} 1.0\nelement vertex {len(points)}\n" + "".join(f"property double {c}\n" for c in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    if order == "ascii":
        rows = [" ".join(map(repr, row)) for row in points.tolist()]
        rows += [" ".join(map(str, [len(own), *own])) for own in faces]
        return (head + "\n".join(rows) + "\n").encode()
    sign = "<" if "little" in order else ">"
    body = points.astype(f"{sign}f8").tobytes()
    return head.encode() + body + b"".join(struct.pack(f"{sign}B{len(own)}i", len(own), *own) for own in faces)


def places(wall):
    """The corners of the triangles, each turned so that its lowest comes first, in ascending order."""
    rows = []
    for own in wall.points[wall.corners].tolist():
        first = own.index(min(own))
        rows.append([*own[first:], *own[:first]])
    return np.array(sorted(rows))


FILES = {
    "binary.stl": binary_stl(POINTS, CORNERS),
    "text.stl": text_stl(POINTS, CORNERS),
    "triangles.obj": obj(POINTS, CORNERS.tolist()),
    "quads.obj": obj(POINTS, QUADS),
    "text.ply": ply(POINTS, CORNERS.tolist()),
    "quads.ply": ply(POINTS, QUADS),
    "little.ply": ply(POINTS, QUADS, "binary_little_endian"),
    "big.PLY": ply(POINTS, CORNERS.tolist(), "binary_big_endian"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_surface_is_the_same_from_all_formats(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(FILES[name])
    wall = wall_of(path, scale=0.5, point=[0.0, 0.0, 1.0])
    assert wall.closed and wall.width == 0.25 and len(wall.points) == 8
    np.testing.assert_array_equal(wall.centre, [0.0, 0.0, 1.125])
    expected = np.array(sorted(POINTS.tolist())) * 0.5 + [0.0, 0.0, 1.0]
    np.testing.assert_array_equal(np.array(sorted(wall.points.tolist())), expected)
    first = tmp_path / "first.stl"
    first.write_bytes(FILES["text.stl"])
    np.testing.assert_array_equal(places(wall), places(wall_of(first, scale=0.5, point=[0.0, 0.0, 1.0])))
    x = np.array([[0.0, 0.0, 1.5], [0.0, 0.0, 1.2], [3.5, 0.0, 1.1], [3.5, 5.0, 1.1]])
    np.testing.assert_allclose(wall.gaps(x), [0.25, -0.05, 3.0, 5.0], atol=1e-15)
    np.testing.assert_allclose(wall_of(path, scale=0.5, point=[0.0, 0.0, 1.0], flip=True).gaps(x), -wall.gaps(x))


FLOOR = {"name": "floor", "type": "plane", "point": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0]}


def cut(name, size):
    return FILES[name][:-size]


TENT = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.0]], float)
BAD = {
    "short.stl": (cut("binary.stl", 10), "is not STL|a triangle|endsolid"),
    "head.stl": (b"\0" * 50, "is not STL: neither text .* nor binary"),
    "cut.stl": (cut("text.stl", 100), "33 vertices, 11 times endfacet and no endsolid.*truncated"),
    "word.stl": (FILES["text.stl"].replace(b"vertex -1.0", b"vertex one", 1), "vertex: 'one' is not a number"),
    "none.stl": (b"solid empty\nendsolid empty\n", "has no faces"),
    "nan.stl": (FILES["text.stl"].replace(b"vertex -1.0", b"vertex nan"), "coordinates that are not finite"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no faces"),
    "far.obj": (
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 9\n",
        "line 5: there is no point 9: the file has 3, numbered from 1",
    ),
    "zero.obj": (
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
        "line 4: 'f 0 1 2': there is no point 0: points are numbered from 1",
    ),
    "two.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2\n", "face 1 .from 0. has 2 corners: expected 3 or more"),
    "text.obj": (b"v 0 0 zero\n", "line 1: 'v 0 0 zero': expected three numbers"),
    "early.ply": (cut("little.ply", 5), "ends early"),
    "type.ply": (b"solid\n", "is not PLY"),
    "concave.obj": (b"v 0 0 0\nv 1 0 0\nv 0.2 0.2 0\nv 0 1 0\nf 2 3 4 1\n", "face at .* is not convex: divide it"),
    "line.obj": (obj(TENT, [[0, 2, 4], [0, 1, 2]]) + b"v 2 2 0\nf 1 3 6\n", r"a triangle is a line, at \(0, 0, 0\) to"),
    "twice.obj": (obj(TENT, [[0, 1, 4], [1, 4, 0], [1, 2, 4]]), "a triangle is in the file twice"),
    "pillow.obj": (obj(TENT, [[0, 1, 4], [4, 1, 0]]), "a triangle is in the file twice"),
    "three.obj": (
        obj(TENT, [[0, 1, 4], [1, 0, 2], [0, 1, 3]]),
        r"more than two .* \(0, 0, 0\) to \(1, 0, 0\) .*divide it",
    ),
    "turned.obj": (obj(TENT, [[0, 1, 4], [4, 2, 1]]), "opposite sides in front .*consistent_normals"),
    "dot.obj": (obj(TENT * 0.0, [[0, 1, 4]]), "at one place"),
    "missing.stl": (None, "there is no file .*missing.stl"),
    "wall.step": (b"", "no reader for 'wall.step'; known suffixes: .obj, .ply, .stl"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_surface_is_refused(tmp_path, name):
    content, message = BAD[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        wall_of(tmp_path / name)
    assert str(caught.value).startswith(f'file = "{tmp_path / name}": ')
    assert str(caught.value).count(str(tmp_path)) == 1 + (content is None)


@pytest.mark.parametrize("staged", [False, True])
def test_the_file_and_key_of_a_wall_are_named(staged, tmp_path):
    (tmp_path / "far.obj").write_bytes(BAD["far.obj"][0])
    case = lattice_case([FLOOR, {"name": "anvil", "type": "surface", "file": "far.obj"}])
    table = "wall[1]"
    if staged:
        case["stage"] = [{"name": "one", "time": case.pop("time")}]
        case["stage"][0]["wall"] = case.pop("wall")
        table = "stage[0]: wall[1]"
    told = f'a.toml: {table}.file = "{tmp_path / "far.obj"}": line 5: there is no point 9: '
    with pytest.raises(InputError) as caught:
        Simulation(Case.from_dict(case, folder=tmp_path, source="a.toml"), MPI.COMM_SELF, check_only=True)
    assert str(caught.value).startswith(told)


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_sizes_whose_squares_are_no_numbers_are_refused(tmp_path, scale):
    (tmp_path / "block.obj").write_bytes(FILES["quads.obj"])
    with pytest.raises(
        InputError, match=r"block.obj.: the surface is 4e.300 m large.*correct the wall's scale = 1e.300"
    ):
        wall_of(tmp_path / "block.obj", scale=scale)


def test_points_within_rounding_are_one(tmp_path):
    path = tmp_path / "near.stl"
    near = POINTS[CORNERS] + 3e-10 * np.random.default_rng(0).uniform(-1, 1, (12, 3, 3))
    path.write_bytes(text_stl(near.reshape(-1, 3), np.arange(36).reshape(12, 3)))
    wall = wall_of(path)
    assert wall.closed and len(wall.points) == 8
    path.write_bytes(text_stl(1000.0 * near.reshape(-1, 3) + 1e-4 * near.ravel()[0], np.arange(36).reshape(12, 3)))
    assert wall_of(path).closed
    far = np.array(POINTS[CORNERS])
    far[0, 0, 0] -= 1e-6
    path.write_bytes(text_stl(far.reshape(-1, 3), np.arange(36).reshape(12, 3)))
    assert not wall_of(path).closed


def test_triangles_with_two_corners_at_one_place_are_left_out(tmp_path):
    path = tmp_path / "needle.obj"
    path.write_bytes(obj(POINTS, [*CORNERS.tolist(), [0, 0, 1]]))
    assert len(wall_of(path).corners) == 12


@pytest.mark.parametrize("side", ["front", "both"])
@pytest.mark.parametrize("shape", ["ball", "groove"])
def test_planes_are_those_of_the_nearest_places(tmp_path, side, shape):
    points, corners = ball(2) if shape == "ball" else groove()
    path = tmp_path / "shape.obj"
    path.write_bytes(obj(points, corners.tolist()))
    wall = wall_of(path, side=side, **({"thickness": 0.02} if side == "both" else {}))
    assert wall.closed == (shape == "ball") and wall.width == (2.0 if shape == "ball" else 4.0)
    x = np.concatenate([np.random.default_rng(1).uniform(-1.5, 1.5, (60, 3)), wall.points[:4]])
    normals, offsets = wall.planes(x)
    distance = np.einsum("ij,ij->i", normals, x) - offsets
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-14)
    signed = wall.closed and side == "front"
    np.testing.assert_allclose(
        distance if signed else np.abs(distance), wall.gaps(x) if signed else np.abs(wall.gaps(x))
    )
    feet = x - (distance + 0.5 * wall.triangles.limits[0, 1] * 2)[:, None] * normals
    np.testing.assert_allclose(wall.gaps(feet) + wall.triangles.limits[0, 1], 0.0, atol=1e-14)
    below = np.array([[0.0, 0.0, -0.3 if shape == "groove" else 0.4]])
    expected = {"ballfront": -0.6, "ballboth": 0.6, "groovefront": 0.3, "grooveboth": 0.3}[shape + side]
    assert wall.gaps(below)[0] == pytest.approx(expected - 0.01 * (side == "both"), abs=0.03)


def test_bars_through_bodies_and_sheets_are_found(tmp_path):
    path = tmp_path / "shape.obj"
    path.write_bytes(FILES["triangles.obj"])
    starts = np.array([[0.0, 0.0, 0.5], [-2.0, 0.0, 0.25], [-2.0, 0.0, 0.49], [0.0, 0.0, 2.0]])
    ends = np.array([[1.0, 0.0, 0.5], [2.0, 0.0, 0.25], [2.0, 0.0, 0.49], [1.0, 0.0, 3.0]])
    assert wall_of(path).crossed(starts, ends).tolist() == [False, True, False, False]
    path.write_bytes(obj(*groove()))
    starts = np.array([[0.5, 0.0, 1.0], [0.5, 0.0, 1.0], [3.0, 0.0, 1.0], [0.5, 0.0, 0.25]])
    ends = np.array([[0.5, 0.0, -1.0], [0.5, 0.0, 0.3], [3.0, 0.0, -1.0], [0.5, 0.0, -1.0]])
    for side in ("front", "both"):
        assert wall_of(path, side=side).crossed(starts, ends).tolist() == [True, False, False, False]
        assert wall_of(path, side=side).crossed(ends, starts).tolist() == [True, False, False, False]


def test_pictures_have_the_triangles_with_outlines(tmp_path):
    path = tmp_path / "shape.obj"
    for (points, corners), lines in (((POINTS, CORNERS), 12), (ball(3), 3 * 32), (groove(), 7)):
        path.write_bytes(obj(points, corners.tolist()))
        drawn = surface.surface(surface.Parameters(name="w", type="surface", file=str(path)), np.zeros((2, 3)))
        assert drawn.faces.shape == corners.shape
        assert len(drawn.edge) == lines
        assert drawn.depth.shape == drawn.points.shape[:1]
        if lines == 96:  # three circles, which have points on all axes' planes
            on = np.abs(drawn.points[drawn.edge]).max(axis=1) < 1e-12
            assert on.any(axis=1).all() and (np.linalg.norm(drawn.points, axis=1) > 0.99).all()


def test_a_picture_is_drawn_without_a_file_that_is_gone(tmp_path):
    path = tmp_path / "shape.obj"
    path.write_bytes(FILES["quads.obj"])
    parameters = surface.Parameters(name="anvil", type="surface", file=str(path))
    notes = []
    assert len(wall_surfaces([parameters], np.zeros((2, 3)), notes.append)) == 1
    path.unlink()
    assert wall_surfaces([parameters], np.zeros((2, 3)), notes.append) == []
    (note,) = notes
    assert note.startswith("wall 'anvil' is left out of the picture: ") and "there is no file" in note


def test_files_are_relative_to_the_case_and_known_by_their_content(tmp_path):
    (tmp_path / "parts").mkdir()
    path = tmp_path / "parts" / "anvil.stl"
    path.write_bytes(FILES["text.stl"])
    wall = {"name": "anvil", "type": "surface", "file": "parts/anvil.stl"}
    case = Case.from_dict(lattice_case([wall]), folder=tmp_path)
    assert case.wall[0].file == str(path.resolve()) and len(case.wall[0].digest) == 64
    again = Case.from_dict(case.to_dict(), folder=tmp_path.parent)
    assert again.wall[0] == case.wall[0]
    assert surface.Wall(again.wall[0]).closed
    path.write_bytes(FILES["binary.stl"])
    with pytest.raises(InputError, match=r"is not the file that the case was made with \(digest .*new run without"):
        surface.Wall(again.wall[0])
    for keys, message in (
        ({"file": "anvil.stl"}, r"wall\[0\].file.*there is no file anvil.stl in .*relative to the case file"),
        ({"thickness": 0.1}, 'thickness is that of a surface with side = "both"'),
        ({"side": "both", "flip": True}, "flip has no effect"),
        ({"scale": 0.0}, "scale"),
    ):
        with pytest.raises(InputError, match=message):
            Case.from_dict(lattice_case([{**wall, **keys}]), folder=tmp_path)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_the_top_of_a_block_is_a_plane(comm, shared_tmp_path, integrator):
    """A lattice that falls on the middle of a block moves as on a plane, with friction."""
    path = shared_tmp_path / "block.obj"
    if comm.rank == 0:
        path.write_bytes(obj(*box((-1.0, -2.0, -0.5), (1.0, 2.0, -0.001))))
    comm.Barrier()
    keys = {"name": "floor", "friction": 0.3}
    ends = []
    for wall in ({"type": "surface", "file": str(path)}, planes([[0.0, 0.0, 1.0]], [-0.001])[0]):
        case = lattice_case([{**wall, **keys}], integrator=integrator, velocity=(0.3, 0.0, -1.0), end=0.004)
        run = simulation(case, comm, shared_tmp_path, wall["type"])
        touched = [step.row["wall/floor/contacts"] for step in run]
        ends.append(run.state.position.copy())
        assert comm.allreduce(max(touched)) > 0
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-10)
