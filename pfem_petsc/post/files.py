"""Files of pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError

__all__ = ["emptied", "save"]


def emptied(folder: Path) -> None:
    """Create the folder of the frames and remove frames of an earlier film, which would end up in this one."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("frame_*.png"):
            old.unlink()
    except OSError as error:
        raise InputError(
            f"{folder}: pictures cannot be written here ({error.strerror}); give another folder"
        ) from error


def save(picture: np.ndarray, file: Path) -> Path:
    """Write a picture (height, width, 3 or 4) uint8."""
    from PIL import Image

    try:
        # fast compression, because a film has hundreds of frames
        Image.fromarray(picture).save(file, compress_level=3)
    except OSError as error:
        raise InputError(f"{file}: the picture cannot be written ({error}); give another folder") from error
    return file
