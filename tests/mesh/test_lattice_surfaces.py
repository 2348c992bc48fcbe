"""Lattices that fill closed surfaces: files that are read or refused, what is inside, clipped struts, graded cells."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.meshes import CORNERS, CUBE, assert_part_of, degrees, filled, lengths, write_stl
from mpi4py import MPI

from pfem_petsc.case.toml import FOLDER
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.generators.lattice.surface import read_surface


def ball(path, rings=24):
    """A sphere of radius 1 m of triangles whose corners lie on it, and its volume."""
    import pyvista

    sphere = pyvista.Sphere(radius=1.0, theta_resolution=2 * rings, phi_resolution=rings + 1)
    sphere.save(path)
    return path, sphere.volume


def test_volume_and_distance_of_a_surface(tmp_path):
    path, volume = ball(tmp_path / "ball.stl")
    surface = read_surface(path, 2.0)
    assert surface.volume == pytest.approx(8.0 * volume, rel=1e-6)  # the file has single precision in VTK
    assert volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.01)
    points = np.random.default_rng(1).uniform(-2.5, 2.5, (4000, 3))
    exact = np.linalg.norm(points, axis=1) - 2.0
    found = surface.distances(points)
    assert np.abs(found - exact).max() < 0.02  # height of a triangle's corners over its middle
    rough = surface.rough_distances(points, 0.1)
    assert (np.sign(rough) == np.sign(found)).all()
    assert (np.abs(rough) <= np.abs(found) + 1e-12).all()
    near = np.abs(found) < 0.2
    np.testing.assert_array_equal(rough[near], found[near])


def test_trimmed_struts_are_those_inside(tmp_path):
    path, _ = ball(tmp_path / "ball.stl")
    mesh = filled(surface={"file": str(path)})
    block = lattice.generate(lattice.Parameters(kind="octet", cells=(8, 8, 8), pitch=0.25), 0, 1)
    place = block.points - 1.0
    # no node is between this radius and the triangles, except at six corners of these
    inside = (np.linalg.norm(place, axis=1) < 0.99) | (np.sort(np.abs(place), axis=1) == (0.0, 0.0, 1.0)).all(axis=1)
    bars = block.bars[inside[block.bars].all(axis=1)]
    assert (mesh.n_nodes, mesh.n_bars) == (len(np.unique(bars)), len(bars))
    middles = [np.round(points[ends].sum(axis=1) * 16.0) for points, ends in ((mesh.points, mesh.bars), (place, bars))]
    np.testing.assert_array_equal(*(rows[np.lexsort(rows.T)] for rows in middles))
    lost = degrees(mesh) < 12
    np.testing.assert_array_equal(np.flatnonzero(lost), mesh.node_groups["surface"])


def test_clipped_struts_end_on_the_surface(tmp_path):
    """Total length against chords of the sphere; what has both ends outside is not part of the lattice."""
    path, volume = ball(tmp_path / "ball.stl", rings=60)
    mesh = filled(surface={"file": str(path), "cut": "clip", "shortest": 0.0}, dangling="keep")
    block = lattice.generate(lattice.Parameters(kind="octet", cells=(8, 8, 8), pitch=0.25), 0, 1)
    a, b = (block.points[block.bars[:, k]] - 1.0 for k in (0, 1))
    way = b - a
    p, q, r = (way * way).sum(axis=1), (a * way).sum(axis=1), (a * a).sum(axis=1) - 1.0
    root = np.sqrt(np.maximum(q * q - p * r, 0.0))
    part = np.clip((-q + root) / p, 0.0, 1.0) - np.clip((-q - root) / p, 0.0, 1.0)
    inside = np.linalg.norm(np.stack([a, b], axis=1), axis=2) < 0.9999
    expected = (part * np.sqrt(p))[inside.any(axis=1)].sum()
    assert lengths(mesh).sum() == pytest.approx(expected, rel=2.0 * (1.0 - volume / (4.0 / 3.0 * np.pi)))
    # within a pitch of the surface: length over volume is that of the infinite lattice
    assert lengths(mesh).sum() / volume * 0.25**2 == pytest.approx(24.0 * np.sqrt(0.5), rel=0.04)
    new = mesh.node_groups["surface"][degrees(mesh)[mesh.node_groups["surface"]] == 1]
    assert len(new) > 1000
    np.testing.assert_allclose(np.linalg.norm(mesh.points[new], axis=1), 1.0, atol=0.002)
    assert (np.diff(new) == 1).all()  # they come last
    assert new[-1] == mesh.n_nodes - 1


def test_what_is_left_of_clipped_struts_is_not_short(tmp_path):
    path, _ = ball(tmp_path / "ball.stl")
    mesh = filled(surface={"file": str(path), "cut": "clip", "shortest": 0.3})
    assert lengths(mesh).min() >= 0.3 * 0.25 * np.sqrt(0.5) * (1.0 - 1e-9)
    loose = np.flatnonzero(degrees(mesh) == 1)
    assert set(loose) <= set(mesh.node_groups["surface"])


def test_nodes_on_the_surface_are_inside(tmp_path):
    """A cube whose faces lie in faces of cells is filled as a block of cells is."""
    path = write_stl(tmp_path / "cube.stl", CORNERS, CUBE)
    for cut in ("trim", "clip"):
        mesh = filled(kind="cubic", surface={"file": str(path), "cut": cut}, origin=[0.0, 0.0, 0.0])
        assert (mesh.n_nodes, mesh.n_bars) == (5**3, 3 * 4 * 25 + 6 * 16 * 5)
    assert mesh.volume == pytest.approx(1.0)


def test_struts_across_a_gap_are_cut(tmp_path):
    """Two boxes with a gap of a fifth of a strut: their nodes are inside, the struts between them are not."""
    second = CORNERS + (1.02, 0.0, 0.0)
    path = write_stl(tmp_path / "boxes.stl", np.vstack([CORNERS, second]), np.vstack([CUBE, CUBE + 8]))
    keys = {"kind": "cubic", "pitch": 0.35, "origin": [-0.04, 0.0, 0.0]}
    trimmed = filled(surface={"file": str(path)}, **keys)
    crossing = (trimmed.points[trimmed.bars][:, :, 0] < 1.01).sum(axis=1) == 1
    assert not crossing.any()
    assert (trimmed.points[:, 0] < 1.0).any()
    assert (trimmed.points[:, 0] > 1.02).any()
    clipped = filled(surface={"file": str(path), "cut": "clip", "shortest": 0.0}, **keys)
    faces = [np.isclose(clipped.points[:, 0], x, atol=1e-6).sum() for x in (1.0, 1.02)]
    assert faces[0] == faces[1] > 3  # a strut that passes the gap is divided into two


def test_sides_of_points_near_edges():
    """Around the inner edge of the bracket and the rims of a hole, where the nearest place is an edge or a corner."""
    surface = read_surface(FOLDER / "bracket.stl", 1.0)
    random, sector = np.random.default_rng(3), 2.0 * np.pi / 48
    points = np.vstack(
        [random.uniform(*box, (2000, 3)) for box in (((14, -1, 14), (18, 49, 18)), ((28, 16, -1), (45, 33, 17)))]
    )
    inside = ((points >= 0.0) & (points <= (80.0, 48.0, 80.0))).all(axis=1)
    inside &= (points[:, 0] <= 16.0) | (points[:, 2] <= 16.0)
    apart = points[:, :2] - (36.0, 24.0)
    turn = np.mod(np.arctan2(apart[:, 1], apart[:, 0]), sector) - 0.5 * sector
    hole = np.linalg.norm(apart, axis=1) * np.cos(turn) < 7.0 * np.cos(0.5 * sector)
    np.testing.assert_array_equal(surface.distances(points) <= 0.0, inside & ~hole)


def test_dangling_struts_are_removed_one_after_the_other(tmp_path):
    """A chain of struts that is cut off at its end goes entirely; a loop stays."""
    path = write_stl(tmp_path / "cube.stl", CORNERS, CUBE)
    mesh = filled(kind="diamond", pitch=0.6, surface={"file": str(path)})
    kept = filled(kind="diamond", pitch=0.6, surface={"file": str(path)}, dangling="keep")
    assert degrees(kept).min() == 1
    assert degrees(mesh).min() >= 2
    assert mesh.n_bars < kept.n_bars


def test_inverted_triangles_are_turned(tmp_path):
    inside_out = write_stl(tmp_path / "out.stl", CORNERS, CUBE[:, ::-1])
    mixed = CUBE.copy()
    mixed[::3] = mixed[::3, ::-1]
    for path in (inside_out, write_stl(tmp_path / "mixed.stl", CORNERS, mixed)):
        surface = read_surface(path, 1.0)
        assert surface.volume == pytest.approx(1.0)
        assert surface.distances(np.array([[0.5, 0.5, 0.5], [2.0, 0.5, 0.5]])) == pytest.approx([-0.5, 1.0])


@pytest.mark.parametrize("kind", ["octet", "tetrahedral_octahedral"])
@pytest.mark.parametrize("below", [None, 0.02])
def test_graded_cells_cover_the_surface(tmp_path, kind, below):
    """Without ``cells`` the mesh is that of a block which is given with more cells than the surface needs."""
    low = np.array([0.25, -0.5, 0.125])
    path = write_stl(tmp_path / "cube.stl", CORNERS + low, CUBE)
    factor = "0.5 + x/2" if below is None else "0.5 + (x - 0.02)/2"
    keys = {"kind": kind, "pitch": 0.2, "surface": {"file": str(path)}, "grading": (factor, 1.0, 1.0)}
    begin = (low - (below or 0.0, 0.0, 0.0)).tolist()
    own = filled(**keys, **({} if below is None else {"origin": begin}))
    wide = filled(**keys, origin=begin, cells=(12, 8, 24))
    assert own.n_bars == wide.n_bars > 100
    assert np.array_equal(np.sort(lengths(own)), np.sort(lengths(wide)))
    reached = own.points.max(axis=0) - low
    assert (reached > 0.6).all() and (reached <= 1.0 + 1e-9).all()
    columns = np.unique(own.points[:, 0].round(9))
    assert columns[-1] - columns[-2] > 1.5 * (columns[1] - columns[0])  # the cells grow along x


@pytest.mark.parametrize(
    "factor, origin, told",
    [
        (
            "1 + z",
            [0.0, 0.0, 0.2],
            r"mesh.grading\[2\] = '1 \+ z': an expression begins at mesh.origin.* use z = 0.125",
        ),
        ("1 - 2*z", None, r"mesh.grading\[2\]: '1 - 2\*z' is 0 at z = 0.5 m; expected"),
        ("1e-9", None, r"mesh.grading\[2\]: '1e-9' takes more than 20,000 cells over 1 m, and reaches 5e-06 m"),
    ],
)
def test_gradings_that_do_not_fit_the_surface(tmp_path, factor, origin, told, monkeypatch):
    path = write_stl(tmp_path / "cube.stl", CORNERS + (0.0, 0.0, 0.125), CUBE)
    monkeypatch.setattr("pfem_petsc.mesh.generators.lattice.block._STEPS", 1)
    with pytest.raises(InputError, match=told):
        filled(kind="cubic", pitch=0.25, surface={"file": str(path)}, grading=(1, 1, factor), origin=origin)


@pytest.mark.parallel
@pytest.mark.parametrize(
    "keys",
    [
        {"surface": {"cut": "trim"}},
        {"kind": "kelvin", "surface": {"cut": "clip"}, "perturbation": 0.02, "missing": 0.05, "seed": 2},
        {"kind": "diamond", "pitch": 0.9, "surface": {"cut": "trim"}},
        {"surface": {"cut": "clip"}, "grading": (1.5, "1 + y/2", 1.0), "origin": (0.1, -1.1, 0.2)},
        {
            "cells": (12, 10, 2),
            "origin": (0.1, -1.2, 0.0),
            "surface": {"cut": "clip"},
            "curved": {"shape": "cylinder", "radius": 0.6, "closed": True},
        },
    ],
)
def test_every_rank_has_its_part_of_the_same_lattice(comm, shared_tmp_path, keys):
    if comm.rank == 0:
        ball(shared_tmp_path / "ball.stl", rings=12)
    comm.Barrier()
    keys = keys | {"surface": {"file": str(shared_tmp_path / "ball.stl")} | keys["surface"]}
    assert_part_of(filled(comm, **keys), filled(MPI.COMM_SELF, **keys), comm)


def test_a_surface_in_millimetres_is_suspected(tmp_path):
    """A pitch in metres for a file in millimetres takes more cells than can be numbered, or counted."""
    path = write_stl(tmp_path / "cube.stl", 120.0 * CORNERS, CUBE)
    told = r"120 x 120 x 120 m \(if its file is in millimetres, set mesh.surface.scale = 0.001\)"
    with pytest.raises(
        InputError, match=f"mesh.pitch = 0.003, with cells that cover a surface of {told}: .* nodes have"
    ):
        filled(pitch=3e-3, surface={"file": str(path)})
    with pytest.raises(InputError, match=f"mesh.pitch = 1e-20: too small for a surface of {told}"):
        filled(pitch=1e-20, surface={"file": str(path)})
    with pytest.raises(InputError, match=r"a surface of 12 x 12 x 12 m: .* nodes have"):
        filled(pitch=3e-3, surface={"file": str(path), "scale": 0.1})


def test_obj_and_ply_are_read(tmp_path):
    vertices = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in CORNERS)
    obj = "".join(f"v {line}\n" for line in vertices.splitlines())
    (tmp_path / "cube.obj").write_text(obj + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in CUBE))
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 12\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "cube.ply").write_text(head + vertices + "".join(f"3 {a} {b} {c}\n" for a, b, c in CUBE))
    for name in ("cube.obj", "cube.ply"):
        assert read_surface(tmp_path / name, 0.1).volume == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("open.stl", "the surface is not closed: 4 of its edges"),
        ("empty.stl", "no surface of triangles"),
        ("cube.step", "no reader for .step; known: .stl, .obj, .ply"),
        ("absent.stl", "cannot open: No such file"),
        ("flat.stl", "encloses no volume"),
    ],
)
def test_files_that_are_refused(tmp_path, name, text):
    write_stl(tmp_path / "open.stl", CORNERS, CUBE[:-2])
    write_stl(tmp_path / "flat.stl", CORNERS, [(0, 1, 3), (0, 3, 1)])
    (tmp_path / "empty.stl").write_text("solid s\nendsolid s\n")
    with pytest.raises(InputError, match=f"mesh.surface.file: .*{name}.*{text}|no reader"):
        filled(surface={"file": str(tmp_path / name)})


def test_damaged_files_are_refused(tmp_path, capfd):
    """With one message, and nothing from VTK beside it."""
    good = (FOLDER / "bracket.stl").read_bytes()
    random = np.random.default_rng(4)
    for number in range(24):
        data = bytearray(good)
        if number % 3 == 0:
            data = random.bytes(int(random.integers(0, 4000)))
        elif number % 3 == 1:
            data = good[: int(random.integers(0, len(good) - 50))]
        else:
            data[random.integers(84, len(data))] ^= 0xFF
            for place in random.integers(84, len(data), 20):
                data[place] = int(random.integers(0, 256))
        path = tmp_path / f"damaged{number}{('.stl', '.ply', '.obj')[number // 3 % 3]}"
        path.write_bytes(bytes(data))
        with pytest.raises(InputError, match="no surface of triangles|is not closed|encloses no volume"):
            read_surface(path, 1e-3)
    assert capfd.readouterr().err == ""


def test_too_coarse_a_lattice_is_refused(tmp_path):
    path = write_stl(tmp_path / "cube.stl", CORNERS, CUBE)
    with pytest.raises(InputError, match="no strut is inside the surface; use a smaller pitch"):
        filled(kind="kelvin", pitch=5.0, surface={"file": str(path)})
