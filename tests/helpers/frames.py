"""Frames drawn by tests, and what is seen in them."""

from __future__ import annotations

import numpy as np
from PIL import Image

from pfem_petsc.post.page import Page
from pfem_petsc.post.render import render

TINY = (240, 160)


def draw(folder, result, **options):
    options = {"size": TINY, "video": "none", "poster": False, "note": lambda text: None, **options}
    return render(result, folder, **options)


def pixels(file) -> np.ndarray:
    return np.asarray(Image.open(file).convert("RGBA")).astype(int)


def drawing(file) -> np.ndarray:
    picture = pixels(file)
    left, top, width, height = Page.region_of((picture.shape[1], picture.shape[0]))
    return picture[top : top + height, left : left + width]


def near(picture: np.ndarray, colour, within: int = 40) -> np.ndarray:
    return (np.abs(picture[..., :3] - np.array(colour)).max(axis=2) < within).nonzero()


def box(picture: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = (picture[..., :3].min(axis=2) < 200).nonzero()
    return rows.min(), rows.max(), columns.min(), columns.max()
