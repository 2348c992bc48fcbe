"""The figures of docs/theory.md are drawn, and show what the equations say."""

from __future__ import annotations

import re

import numpy as np
import pytest
import theory_figures
from PIL import Image

PAGE = theory_figures.FOLDER.parents[1] / "theory.md"


@pytest.mark.slow
def test_figures_are_drawn(tmp_path):
    drawn = {path.name: Image.open(path).size for path in theory_figures.main(tmp_path)}
    shown = re.findall(r"images/theory/(\w+\.png)", PAGE.read_text())
    assert sorted(shown) == sorted(drawn)
    for name in shown:
        assert Image.open(theory_figures.FOLDER / name).size == pytest.approx(drawn[name], rel=0.02)


def test_limit_load_of_the_two_bars():
    z = np.linspace(0.3, 0.8, 20001)
    peak = np.abs(theory_figures.two_bar_load("engineering", z)).max()
    assert peak == pytest.approx(2.0 * (1.0 - 0.5 ** (1.0 / 3.0)) ** 1.5, rel=1e-8)


def test_nearest_point_of_two_walls():
    normals = np.array([[0.0, 1.0], [-0.6, -0.8]])
    assert theory_figures.nearest(np.array([0.9, -0.35]), normals) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert theory_figures.nearest(np.array([-2.0, -0.35]), normals) == pytest.approx([-2.0, 0.0], abs=1e-15)


def test_no_paragraph_is_taken_for_code():
    """Four spaces after an empty line make a code block; formulas here are LaTeX, and lists are indented by two."""
    assert re.findall(r"\n\n {4,}\S.*", PAGE.read_text()) == []
