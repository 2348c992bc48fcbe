"""A state as a web page: what it holds, and in a browser: drawn, turned by dragging, nothing from a network."""

from __future__ import annotations

import pytest
from helpers.pictures import PROGRAM, Browser
from helpers.synthetic import SyntheticResult, lattice

from pfem_petsc.errors import InputError
from pfem_petsc.post.render import render_html


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
