"""Files of closed surfaces that lattices fill: what is read, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.surfaces import CORNERS, CUBE, filled, write_stl

from pfem_petsc import Case, cases
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.lattices.surface import read_surface


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
    ],
)
def test_files_that_are_refused(tmp_path, name, text):
    write_stl(tmp_path / "open.stl", CORNERS, CUBE[:-2])
    (tmp_path / "empty.stl").write_text("solid s\nendsolid s\n")
    with pytest.raises(InputError, match=f"mesh.surface.file: .*{name}.*{text}|no reader"):
        filled(surface={"file": str(tmp_path / name)})


def test_damaged_files_are_refused(tmp_path, capfd):
    """With one message, and nothing from VTK beside it."""
    good = (Path(cases.__file__).parent / "bracket.stl").read_bytes()
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


def test_a_surface_without_volume_is_refused(tmp_path):
    flat = write_stl(tmp_path / "flat.stl", CORNERS, [(0, 1, 3), (0, 3, 1)])
    with pytest.raises(InputError, match="encloses no volume"):
        read_surface(flat, 1.0)


def test_too_coarse_a_lattice_is_refused(tmp_path):
    path = write_stl(tmp_path / "cube.stl", CORNERS, CUBE)
    with pytest.raises(InputError, match="no strut is inside the surface; use a smaller pitch"):
        filled(kind="kelvin", pitch=5.0, surface={"file": str(path)})


def test_file_is_relative_to_the_case(tmp_path):
    write_stl(tmp_path / "cube.stl", CORNERS, CUBE)
    case = {
        "mesh": {"generator": "lattice", "pitch": 0.5, "surface": {"file": "cube.stl"}},
        "material": {"m": {"young_modulus": 1e9, "density": 1000.0}},
        "section": {"s": {"area": 1e-6, "material": "m"}},
        "time": {"integrator": "central_differences", "step": "auto", "end": 1e-5},
    }
    read = Case.from_dict(case, folder=tmp_path)
    assert read.mesh.parameters.surface.file == str((tmp_path / "cube.stl").resolve())
    assert Case.from_toml(read.to_toml()).mesh == read.mesh
