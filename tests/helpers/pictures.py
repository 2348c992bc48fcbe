"""Frames and charts, and what is seen in them."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
from PIL import Image

from pfem_petsc.post.page import Page
from pfem_petsc.post.render import render
from pfem_petsc.post.scene import Scene, direction, fit


def saturated(file) -> np.ndarray:
    """Pixels (n, 3) with a colour: curves, not axes and text."""
    picture = np.asarray(Image.open(file).convert("RGB")).reshape(-1, 3).astype(int)
    return picture[np.ptp(picture, axis=1) > 60]


def table_columns(path):
    head, *rows = csv.reader(path.open())
    return head, np.array(rows, dtype=float).T


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


def corners(bounds) -> np.ndarray:
    return np.array(np.meshgrid(*np.transpose(bounds))).reshape(3, -1).T


def camera_of(bounds, view="iso", aspect=1.0, normals=()):
    """The camera that has the corners of a box in view."""
    return fit(corners(bounds), direction(view, np.asarray(bounds), normals, (0.0, 0.0, 1.0)), aspect)


def projected(camera, points, size) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows [pixels] of points (n, 3) in a picture, and pixels per metre there, 0 behind the eye."""
    away = points - camera.centre
    ahead = np.ones(len(points)) if camera.parallel else 1.0 - away @ camera.towards / camera.distance
    scale = size[1] / (2.0 * camera.half_height) * np.where(ahead > 0.02, 1.0 / np.maximum(ahead, 0.02), 0.0)
    return 0.5 * size[0] + away @ camera.right * scale, 0.5 * size[1] - away @ camera.up * scale, scale


def picture_of(points, bars, colours, camera, size, style, layers=()) -> np.ndarray:
    """Bars without text; layers may be a function of the scene."""
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    motion = SimpleNamespace(start=points, bars=np.array(bars), bounds=bounds)
    scene = Scene(motion, camera, size, style, unit=min(size[0] / 1110, size[1] / 604))
    added = layers(scene) if callable(layers) else layers
    picture = scene.draw(points, np.array(colours, dtype=np.uint8), camera, layers=added)
    scene.close()
    return picture.astype(int)
