"""A state as a web page: what it holds, and in a browser: drawn, turned by dragging, nothing from a network."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pictures import PROGRAM, Browser
from helpers.synthetic import WALL, SyntheticResult, lattice, ring

from pfem_petsc.errors import InputError
from pfem_petsc.post.interactive import plotter_of, render_html, show


@pytest.fixture
def result(tmp_path):
    return SyntheticResult(tmp_path / "result.vtkhdf", *lattice(3))


def test_one_file_that_loads_nothing(tmp_path, result):
    pytest.importorskip("plotly")
    result.case.title = "</script><b>Ring & wall"
    page = render_html(result, tmp_path / "out").read_text()
    assert "<script src" not in page and "<link" not in page.partition("<script")[0]
    assert "<b>Ring" not in page


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"field": "stres"}, "did you mean 'stress'"),
        ({"frame": 99}, "snapshots 0 to 12"),
        ({"style": "dots"}, "auto, tubes, lines"),
    ],
)
def test_refused_pages(tmp_path, result, options, message):
    with pytest.raises(InputError, match=message):
        render_html(result, tmp_path, **options)


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium")
def test_page_turns_in_a_browser(tmp_path, result):
    pytest.importorskip("plotly")
    file = render_html(result, tmp_path, frame=6)
    with Browser(file) as browser:
        browser.settle()
        before = browser.picture()
        browser.drag((320, 220), (420, 260))
        browser.settle()
        after = browser.picture()
        assert browser.requests == [file.absolute().as_uri()]
    drawn = [(picture[100:400, :500].min(axis=2) < 200).sum() for picture in (before, after)]
    assert min(drawn) > 3000
    assert (before != after).any(axis=2).sum() > 5000


@pytest.mark.slow
def test_window_moves_the_nodes(tmp_path, result):
    plotter, go_to = plotter_of(result, 0, print, off_screen=True)
    pictures = []
    for snapshot in (0, 6):
        go_to(snapshot)
        plotter.render()
        pictures.append(np.asarray(plotter.screenshot(return_img=True)).astype(int))
    plotter.close()
    assert (pictures[0] != pictures[1]).any(axis=2).sum() > 300


def test_window_has_walls_and_radii(result, monkeypatch):
    """More of the picture is covered with a wall, and with bars of radii."""

    def covered(walls, radius):
        result.case.wall = walls
        monkeypatch.setattr("pfem_petsc.post.render.drawn_radii", lambda *_: radius)
        plotter, _ = plotter_of(result, 0, print, off_screen=True, view=(1.0, 0.3, 0.3))
        picture = np.asarray(plotter.screenshot(return_img=True))
        plotter.close()
        return (picture.min(axis=2) < 250).mean()

    radius = np.full(result.n_bars, 0.04)
    plain, wall, thick = covered([], None), covered([WALL], None), covered([], radius)
    assert wall > 1.3 * plain and thick > 1.3 * plain


def test_window_without_a_display(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match="no display.*--html"):
        show(SyntheticResult(tmp_path / "result.vtkhdf", *ring()))
