"""Films: cameras, curves beside them, results side by side, times between snapshots, backgrounds, ranks."""

from __future__ import annotations

import imageio_ffmpeg
import numpy as np
import pytest
from helpers.pictures import TINY, box, draw, drawing, pixels, projected
from helpers.synthetic import SyntheticResult, ring
from PIL import Image

from pfem_petsc.errors import InputError
from pfem_petsc.output.units import LOAD_FACTOR
from pfem_petsc.post.motion import Motion, resampled
from pfem_petsc.post.page import Page
from pfem_petsc.post.render import Options, render
from pfem_petsc.post.scene import cameras


@pytest.fixture
def flying(tmp_path):
    return SyntheticResult(tmp_path / "x" / "result.vtkhdf", *ring(), walls=())


def test_results_side_by_side(tmp_path, flying):
    """Two rings at one scale beside each other, the second at half the size."""
    points, bars = ring()
    other = SyntheticResult(tmp_path / "y" / "result.vtkhdf", 0.5 * points, bars, walls=())
    file = draw(tmp_path, [flying, other], frames=[0], size=(640, 300), nodes=False)[0]
    picture = drawing(file)
    middle = picture.shape[1] // 2
    strip = round(34 * 300 / 720)  # with the captions
    boxes = [box(half) for half in (picture[strip:, :middle], picture[strip:, middle:])]
    heights = [bottom - top for top, bottom, _, _ in boxes]
    assert heights[1] == pytest.approx(0.5 * heights[0], abs=3)
    with pytest.raises(InputError, match="3 labels for 2 results"):
        draw(tmp_path, [flying, other], labels=["a", "b", "c"])
    other.axis = LOAD_FACTOR
    with pytest.raises(InputError, match="different axes \\(t, load factor\\)"):
        draw(tmp_path, [flying, other])


@pytest.mark.slow
def test_slow_motion_is_between_snapshots(tmp_path, flying):
    """0.05 s at 1000 frames a second from 13 snapshots: the middle of two of them is the mean of their positions."""
    told = []
    files = draw(tmp_path, flying, rate=1000, span=(0.0, 0.0201), note=told.append, fps=20)
    assert len(files) == 21 and "21 frames last 1.1 s" in told[0] and "50 times slower" in told[0]
    half = 0.5 * (flying.times[3] + flying.times[4])
    mean = 0.5 * (flying.positions(3) + flying.positions(4))
    slow = resampled(flying, np.array([half, 1.0]))
    assert slow.positions(0) == pytest.approx(mean, abs=1e-12)
    assert (slow.positions(1) == flying.positions(12)).all()


def motion_of(result):
    return Motion(result, list(range(len(result.times))), Options(), print)


def test_orbit_keeps_everything_in_view(tmp_path, flying):
    motion = motion_of(flying)
    made = cameras(Options(orbit=180.0, view="iso"), motion, 1.5)
    assert len(made) == 13 and made[0].towards @ made[-1].towards < 0.5
    for camera in made:
        x, y, _ = projected(camera, motion.surroundings, (300, 200))
        assert x.min() >= -0.5 and x.max() <= 300.5 and y.min() >= -0.5 and y.max() <= 200.5


@pytest.mark.parametrize(
    ("times", "text"),
    [
        (np.linspace(0.0, 5.0, 101), "t = 0.05 s"),
        (np.linspace(0.0, 0.2, 201), "t = 1.0 ms"),
        (np.linspace(0.0, 6e-4, 31), "t = 20 µs"),
        (np.linspace(0.0, 3.0, 4), "t = 1.0 s"),
        (np.arange(5) * 1.2345e-3, "t = 1.2 ms"),
    ],
)
def test_times_have_the_unit_of_the_film_and_the_digits_that_tell_frames_apart(flying, times, text):
    flying.times = times
    flying.positions = lambda i: flying.start
    assert motion_of(flying).time(1) == text


def test_structures_fill_the_picture_from_any_side(tmp_path):
    """A dome seen obliquely: all of its nodes are in view, and they span nearly the whole width."""
    radius, angle = np.meshgrid([0.0, 1.0, 2.0], np.linspace(0.0, 2 * np.pi, 13)[:12])
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.3 * (4.0 - radius**2) / 4.0], axis=-1)
    bars = np.array([[3 * k + j, 3 * k + j + 1] for k in range(12) for j in (0, 1)])
    motion = motion_of(SyntheticResult(tmp_path / "result.vtkhdf", points.reshape(-1, 3), bars, walls=()))
    motion.frames, motion.times, motion.hulls = [0], motion.times[:1], motion.hulls[:1]
    (camera,) = cameras(Options(view="iso"), motion, 1.5)
    x, y, _ = projected(camera, motion.start, (300, 200))
    assert x.min() > 0 and x.max() < 300 and y.min() > 0 and y.max() < 200
    assert np.ptp(x) > 250  # by the corners of its box: 190
    motion.reach = 0.3
    (camera,) = cameras(Options(view="iso"), motion, 1.5)
    x, y, scale = projected(camera, motion.start, (300, 200))
    assert (x - 0.3 * scale).min() > 0 and (x + 0.3 * scale).max() < 300  # of stout bars, too


def test_followed_structure_stays_in_the_middle(flying):
    motion = motion_of(flying)
    for camera, bounds in zip(cameras(Options(follow="structure"), motion, 1.5), motion.boxes, strict=True):
        x, y, _ = projected(camera, bounds.mean(axis=0)[None, :], (300, 200))
        assert (x[0], y[0]) == pytest.approx((150.0, 100.0))
    assert len(cameras(Options(follow="tip"), motion, 1.5)) == 13


def test_films_for_web_pages(tmp_path, flying):
    for video, transparent in (("webp", False), ("webm", True)):
        draw(tmp_path / video, flying, frames=3, video=video, transparent=transparent, size=(160, 120))
    assert Image.open(tmp_path / "webp" / "render.webp").n_frames == 3
    count, _ = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "webm" / "render.webm"))
    assert count == 3


@pytest.mark.parallel
def test_ranks_divide_the_frames(shared_tmp_path, comm):
    """The same frames on any number of ranks, which the first rank makes a film of."""
    alone = SyntheticResult(shared_tmp_path / "x" / "result.vtkhdf", *ring(), walls=())
    options = {"size": (160, 120), "poster": False, "note": lambda text: None, "frames": 4}
    written = render(alone, shared_tmp_path / "together", video="gif", comm=comm, **options)
    assert len(written) == 5 and all(path.is_file() for path in written)
    if comm.rank == 0:
        own = render(alone, shared_tmp_path / "alone", video="none", **options)
        assert [path.read_bytes() for path in written[1:]] == [path.read_bytes() for path in own]


def test_transparent_background(tmp_path, flying):
    file = draw(tmp_path, flying, frames=[0], transparent=True)[0]
    picture = pixels(file)
    left, top, width, height = Page.region_of(TINY)
    alpha = picture[top : top + height, left : left + width, 3]
    assert alpha.min() == 0 and alpha.max() == 255 and (alpha == 0).mean() > 0.5
    plain = pixels(draw(tmp_path / "plain", flying, frames=[0])[0])
    over = picture[..., :3] * (picture[..., 3:] / 255) + 255 - picture[..., 3:]
    assert np.abs(over - plain[..., :3])[top : top + height, left : left + width].max() <= 3
    with pytest.raises(InputError, match="webm"):
        draw(tmp_path, flying, transparent=True, video="mp4")
