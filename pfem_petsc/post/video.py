"""Encodes numbered pictures to films with ffmpeg."""

from __future__ import annotations

import subprocess
from pathlib import Path

from ..errors import InputError

__all__ = ["encode"]

# H.264 with 4:2:0 colours is supported everywhere, and requires even sizes
_FILTERS = {
    "mp4": ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-c:v", "libx264", "-preset", "medium", "-crf", "18"],
    "gif": [
        "-vf",
        "scale='min(800,iw)':-2:flags=lanczos,split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none",
    ],
    # with a transparent background
    "webm": ["-c:v", "libvpx-vp9", "-pix_fmt", "yuva420p", "-crf", "24", "-b:v", "0", "-row-mt", "1", "-cpu-used", "4"],
    # moving pictures for web pages
    "webp": ["-vf", "scale='min(960,iw)':-2:flags=lanczos", "-c:v", "libwebp_anim", "-q:v", "70", "-loop", "0"],
}


def encode(pattern: Path, target: Path, fps: float) -> Path:
    """Encode pictures to a film.

    Parameters
    ----------
    pattern : path with a ``%04d`` for the number, from 0
    target : ``.mp4`` (H.264, yuv420p), ``.gif`` (at most 800 pixels wide), ``.webm`` (VP9, with transparency) or
        ``.webp`` (at most 960 pixels wide, with transparency)
    fps : pictures per second

    Raises
    ------
    InputError
        If ffmpeg cannot be found or fails, with the last line of its output.
    """
    import imageio_ffmpeg

    kind = target.suffix.lstrip(".")
    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise InputError(
            f"{target}: no ffmpeg for the film ({error}); install imageio-ffmpeg, or use video = none"
        ) from error
    command = [program, "-y", "-loglevel", "error", "-framerate", f"{fps:g}", "-i", str(pattern), *_FILTERS[kind]]
    if kind == "mp4":
        command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    done = subprocess.run([*command, str(target)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise InputError(f"{target}: ffmpeg failed ({last[0]}); the pictures are in {pattern.parent}")
    return target
