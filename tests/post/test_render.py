"""Pictures: not blank, walls seen, films complete, options refused, VTK's crash foreseen."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest
from helpers.pictures import drawing, pixels
from helpers.synthetic import WALL, SyntheticResult, lattice, ring, rod, write_result
from PIL import Image

from pfem_petsc import Case, Simulation, open_result
from pfem_petsc.contact.walls.plane import Parameters
from pfem_petsc.errors import InputError
from pfem_petsc.post import scene
from pfem_petsc.post.motion import walls_at
from pfem_petsc.post.render import render, render_modes

SMALL = (480, 270)


def inked(picture: np.ndarray) -> np.ndarray:
    return (picture.min(axis=2) < 200).nonzero()


def silent(text: str) -> None:
    if not text.startswith("the film of"):  # how long a short one lasts
        raise AssertionError(text)


def draw(tmp_path, result=None, **options):
    result = result or SyntheticResult(tmp_path / "result.vtkhdf", *ring())
    options = {"size": SMALL, "video": "none", "poster": False, "note": silent, **options}
    return render(result, tmp_path / "out", **options)


@pytest.mark.slow
def test_frames_film_and_poster_from_a_result_file(tmp_path):
    file = write_result(tmp_path)
    written = render(file, size=SMALL, fps=10, video="both", note=silent)
    names = [path.relative_to(tmp_path).as_posix() for path in written]
    frames = [f"frames/frame_{k:04d}.png" for k in range(5)]
    assert names == ["render.png", "render.mp4", "render.gif", *frames]
    for path in written:
        if path.suffix == ".png":
            assert len(np.unique(pixels(path).reshape(-1, 4), axis=0)) > 100
    assert pixels(written[-1]).shape[:2] == (270, 480)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "render.mp4"))
    assert count == 5 and seconds == pytest.approx(0.5, abs=0.01)
    assert Image.open(tmp_path / "render.gif").n_frames == 5


def test_folder_is_as_good_as_the_file_and_old_frames_go(tmp_path):
    write_result(tmp_path, snapshots=4)
    render(tmp_path, size=SMALL, video="none", poster=False)
    written = render(tmp_path, size=SMALL, video="none", poster=False, frames=2)
    assert sorted((tmp_path / "frames").iterdir()) == written and len(written) == 2


def test_odd_sizes_make_a_film(tmp_path):
    draw(tmp_path, size=(321, 241), video="mp4", frames=3)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "out" / "render.mp4"))
    meta = next(reader)
    reader.close()
    assert meta["size"] == (322, 242) and meta["pix_fmt"].startswith("yuv420p") and meta["codec"] == "h264"


def test_wall_is_seen_where_it_is(tmp_path):
    with_wall = drawing(draw(tmp_path, frames=[0])[0])
    result = SyntheticResult(tmp_path / "x", *ring())
    other = SimpleNamespace(**{**vars(WALL), "point": (-1.2, 0.0, 0.0), "normal": (1.0, 0.0, 0.0)})
    result.case.wall = [other]
    turned = drawing(draw(tmp_path, result, frames=[0])[0])
    # the wall is the only thing at the upper edge of the structure's field: right of it, or left when turned
    columns = [inked(picture[: picture.shape[0] // 22])[1].mean() / picture.shape[1] for picture in (with_wall, turned)]
    assert columns[0] > 0.6 and columns[1] < 0.4
    # it fades out on the side that nodes cannot reach
    row = with_wall[with_wall.shape[0] // 22, :, 0]
    darkest = int(np.argmin(row))
    assert row[darkest - 3] == 255 and row[darkest] < 150 < row[darkest + 8] < 255


@pytest.mark.parametrize(
    "moves",
    [
        {"velocity": (8.0, 0.0, 0.0)},
        {"motion": ((0.0, 0.0, 0.0, 0.0), (0.05, 0.4, 0.0, 0.0))},
        {"mass": 2.0, "velocity": (-1.0, 0.0, 0.0)},
    ],
    ids=lambda moves: next(iter(moves)),
)
def test_wall_is_drawn_where_it_is_then(moves, tmp_path):
    """To the right by 0.4 m: by velocity, by a table, or as the history has it."""
    wall = Parameters(type="plane", name="wall", point=WALL.point, normal=WALL.normal, **moves)
    result = SyntheticResult(tmp_path / "x", *ring(), walls=[wall])
    places = np.array(wall.point) + np.outer(result.history["time"], [8.0, 0.0, 0.0])
    result.history["wall/wall/position"] = places
    first, last = (drawing(file) for file in draw(tmp_path, result, frames=[0, 12]))
    faces = [int(np.argmin(picture[picture.shape[0] // 22, :, 0])) for picture in (first, last)]
    start = inked(first)[1].min()  # of the ring at x = -1; the wall is at 1.2
    assert faces[1] - faces[0] == pytest.approx(0.4 / 2.2 * (faces[0] - start), abs=2.0)


@pytest.mark.slow
def test_walls_are_drawn_in_the_stages_that_have_them(tmp_path):
    """Pressed by a plate, then let go: the plate is gone from the next stage on, also in pictures of modes."""
    plate = {"name": "plate", "type": "plane", "point": [1.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    data = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 2},
        "node_set": {"all": {"all": True}, "base": {"nearest": [0.0, 0.0, 0.0]}},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "support": [{"node_set": "all", "fix": "yz"}, {"node_set": "base", "fix": "x"}],
        "output": {"fields_every": 1},
        "modes": {"count": 1},
        "stage": [
            {"name": "press", "wall": [{**plate, "motion": [[0, 0, 0, 0], [1, -0.01, 0, 0]]}], "static": {"step": 0.5}},
            {"name": "release", "wall": [], "static": {"step": 0.5}},
        ],
    }
    with Simulation(Case.from_dict(data), output=tmp_path / "result", quiet=True) as simulation:
        simulation.run()
    result = open_result(tmp_path / "result")
    assert walls_at(result, result.times)[2].ravel().tolist() == [True] * 3 + [False] * 2
    files = render(tmp_path / "result", tmp_path / "frames", size=SMALL, video="none", poster=False, note=silent)
    inks = [len(inked(drawing(file))[0]) for file in files]
    assert min(inks[:3]) > 1.5 * max(inks[3:])
    quiet = {"size": SMALL, "video": "none", "poster": False, "note": silent}
    (mode, *_) = render_modes(tmp_path / "result", tmp_path / "modes", period=4, **quiet)
    assert len(inked(drawing(mode))[0]) < 1.5 * max(inks[3:])


def test_camera_stays_and_the_structure_moves(tmp_path):
    files = draw(tmp_path, frames=[0, 6])
    first, last = (drawing(file) for file in files)
    assert inked(last)[1].min() > inked(first)[1].min() + 3  # it flew to the right
    edge = first.shape[0] // 22
    assert np.array_equal(first[edge], last[edge])  # only wall here, not moved
    for picture in (first, last):
        rows, columns = inked(picture)
        assert rows.min() > 0 and rows.max() < picture.shape[0] - 1
        assert columns.min() > 0 and columns.max() < picture.shape[1] - 1


def test_stress_shows_in_colour(tmp_path):
    rest, hit = (drawing(file) for file in draw(tmp_path, frames=[0, 6]))

    def blue(picture):
        return int(((picture[..., 2] - picture[..., 0]) > 70).sum())

    assert blue(rest) == 0 and blue(hit) > 30


def test_point_field_and_component(tmp_path):
    files = draw(tmp_path, field="velocity", component="x", frames=[3, 9])
    there, back = (drawing(file) for file in files)
    has_thermal = [int(((p[..., 0] - p[..., 2]) > 70).sum()) for p in (there, back)]
    cold = [int(((p[..., 2] - p[..., 0]) > 70).sum()) for p in (there, back)]
    assert has_thermal[0] > 10 * max(1, cold[0]) and cold[1] > 10 * max(1, has_thermal[1])


@pytest.mark.parametrize("structure", [rod, lattice])
def test_other_shapes_fill_the_picture(tmp_path, structure):
    rows, columns = inked(drawing(draw(tmp_path, SyntheticResult(tmp_path / "x", *structure()), frames=[0])[0]))
    assert max(np.ptp(rows) / 217, np.ptp(columns) / 416) > 0.6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"field": "stres"}, "did you mean 'stress'"),
        ({"field": "velocity", "component": "w"}, "not one of x, y, z"),
        ({"component": "x"}, "one value only"),
        ({"view": "above"}, "auto, xy, xz, yz, iso"),
        ({"video": "avi"}, "mp4, gif, both, none"),
        ({"frames": [99]}, "snapshots 0 to 12"),
        ({"frames": 0}, "must be positive"),
        ({"clim": (1.0, 1.0)}, "increasing"),
        ({"cmap": "viridiss"}, "did you mean 'viridis'"),
        ({"fps": 0}, "fps = 0"),
        ({"size": (10, 10)}, "160 to 8192"),
    ],
)
def test_refused_options(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        draw(tmp_path, **options)


def test_crash_of_the_graphics_is_foreseen(monkeypatch):
    """A probe that dies like VTK without OpenGL ends in a message of what to install, not in a dead process."""
    monkeypatch.setattr(scene, "_PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(InputError, match=r"libosmesa6.*libegl1 libgl1-mesa-dri"):
        scene.require_rendering.__wrapped__()


def test_a_display_that_is_not_there_does_not_matter(tmp_path):
    environment = {**os.environ, "DISPLAY": ":987"}
    environment.pop(scene.VARIABLE, None)
    code = "import os, pfem_petsc.post.scene as h; h.require_rendering(); print(os.environ[h.VARIABLE])"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")


def test_a_window_of_another_kind_than_asked_for_does_not_count(tmp_path, monkeypatch):
    """Without an EGL library VTK draws by OSMesa all the same, and warns twice of every window: OSMesa is asked for."""
    fake = tmp_path / "vtkmodules"
    fake.mkdir()
    (fake / "__init__.py").write_text("")
    (fake / "vtkRenderingOpenGL2.py").write_text("")
    (fake / "vtkRenderingCore.py").write_text(
        "class Anything:\n"
        "    def __getattr__(self, name):\n"
        "        return lambda *arguments: self\n"
        "    def GetTuple(self, k):\n"
        "        return (255, 0, 0)\n"
        "    def GetClassName(self):\n"
        "        return 'vtkOSOpenGLRenderWindow'\n"
        "vtkRenderer = vtkRenderWindow = vtkWindowToImageFilter = Anything\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv(scene.VARIABLE, "")  # so that the end of the test takes away what is set below
    monkeypatch.delenv(scene.VARIABLE)
    assert not scene._works("vtkEGLRenderWindow")
    assert scene._works("vtkOSOpenGLRenderWindow")
    scene.require_rendering.__wrapped__()
    assert os.environ[scene.VARIABLE] == "vtkOSOpenGLRenderWindow"
