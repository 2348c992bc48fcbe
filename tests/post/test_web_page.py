"""A state as a web page: what it holds, and what is refused."""

from __future__ import annotations

import pytest
from helpers.synthetic import SyntheticResult, lattice, write_result

from pfem_petsc.cli.main import main
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


def test_options_of_pictures_alone_are_refused(tmp_path, capsys):
    file = str(write_result(tmp_path))
    assert main(["render", file, "--html", "--ghost", "--show", "loads"]) == 2
    assert "--html does not take ghost, show; it takes frames, field," in capsys.readouterr().err
