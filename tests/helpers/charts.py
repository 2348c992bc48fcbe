"""What is seen in charts, and what is in their tables."""

from __future__ import annotations

import csv

import numpy as np
from PIL import Image


def saturated(file) -> np.ndarray:
    """Pixels (n, 3) with a colour: curves, not axes and text."""
    picture = np.asarray(Image.open(file).convert("RGB")).reshape(-1, 3).astype(int)
    return picture[np.ptp(picture, axis=1) > 60]


def table_columns(path):
    head, *rows = csv.reader(path.open())
    return head, np.array(rows, dtype=float).T
