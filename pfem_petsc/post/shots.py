"""Where the camera is in each frame of a film: at rest, around the structure, along a path, or with it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .camera import Camera, direction, fit

if TYPE_CHECKING:
    from .motion import Motion

__all__ = ["Moves", "at_one_scale", "camera_path", "shots"]


@dataclass(frozen=True)
class Moves:
    """The view of a film and its movement.

    Parameters
    ----------
    view : name of a view, or the direction (3,) from the structure to the eye
    zoom : factor on the size of the structure in the picture
    orbit : angle [degrees] that the camera goes around the upward direction from the first frame to the last
    path : (k, 4) times [s], azimuths and elevations [degrees], zooms; between these the camera moves smoothly
    follow : "structure", or the name of a probe, that stays in the middle of the picture; None: nothing
    """

    view: str | Sequence[float] = "auto"
    zoom: float = 1.0
    orbit: float = 0.0
    path: np.ndarray | None = None
    follow: str | None = None

    @property
    def any(self) -> bool:
        """Whether the camera moves."""
        return bool(self.orbit) or self.path is not None or self.follow is not None

    def checked(self) -> Moves:
        """Return itself.

        Raises
        ------
        InputError
            For numbers that make no film.
        """
        if not 1e-3 <= self.zoom <= 1e3:
            raise InputError(f"render: zoom = {self.zoom:g} must be from 0.001 to 1000")
        if not np.isfinite(self.orbit):
            raise InputError(f"render: orbit = {self.orbit:g} is not a number of degrees")
        if self.path is None:
            return self
        if self.orbit:
            raise InputError("render: orbit and path both move the camera; give one of the two")
        path = np.asarray(self.path, dtype=float)
        if path.ndim != 2 or path.shape[1] != 4 or not len(path) or not np.isfinite(path).all():
            raise InputError("render: path takes rows of four numbers: time, azimuth, elevation, zoom")
        if (np.diff(path[:, 0]) <= 0.0).any():
            raise InputError("render: path: times must increase from row to row")
        if (np.abs(path[:, 2]) > 89.0).any() or (path[:, 3] <= 0.0).any():
            raise InputError("render: path: elevations go from -89 to 89 degrees, and zooms are positive")
        return replace(self, path=path)


def camera_path(file: Path | str) -> np.ndarray:
    """Read the path of a camera (k, 4): columns time, azimuth, elevation, zoom, with or without a line of names.

    Raises
    ------
    InputError
        If the file cannot be read, or a line is not four numbers.
    """
    rows: list[list[float]] = []
    try:
        lines = list(csv.reader(Path(file).read_text().splitlines()))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: the camera's path cannot be read ({error})") from error
    for number, words in enumerate(lines, start=1):
        if not words or words[0].lstrip().startswith("#"):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            if number == 1:
                continue
            row = []
        if len(row) != 4:
            raise InputError(f"{file}: line {number} is not four numbers: time, azimuth, elevation, zoom")
        rows.append(row)
    return np.array(rows).reshape(-1, 4)


def shots(motion: Motion, moves: Moves, aspect: float) -> list[Camera]:
    """Return the camera of each frame; all have the same scale, but for the zooms of a path."""
    towards, up, parallel = direction(moves.view, motion.bounds, motion.normals, motion.upward)
    points = motion.surroundings
    if not moves.any:
        return [fit(points, towards, up, parallel, aspect).zoomed(moves.zoom)] * len(motion.frames)
    count = len(motion.frames)
    ways, zooms = [(towards, up)] * count, np.full(count, moves.zoom)
    if moves.orbit:
        angles = np.radians(moves.orbit) * np.linspace(0.0, 1.0, count)
        ways = [(_turned(towards, up, angle), up) for angle in angles]
    if moves.path is not None:
        parallel = False
        azimuths, elevations, factors = (_smooth(motion.times, moves.path[:, 0], moves.path[:, k]) for k in (1, 2, 3))
        ways = [(_towards(*np.radians(each), motion.upward), motion.upward) for each in zip(azimuths, elevations)]
        zooms = zooms * factors
    if moves.follow is None:
        centre = motion.bounds.mean(axis=0)
        made = [fit(points, *way, parallel, aspect, centre=centre) for way in ways]
    else:
        boxes = motion.boxes
        centres = boxes.mean(axis=1) if moves.follow == "structure" else motion.probe(moves.follow)
        made = []
        for way, hull, centre in zip(ways, motion.hulls, centres, strict=True):
            made.append(fit(hull, *way, parallel, aspect, margin=1.25, centre=centre))
    (made,) = at_one_scale([made])
    return [camera.zoomed(zoom) for camera, zoom in zip(made, zooms, strict=True)]


def at_one_scale(films: list[list[Camera]]) -> list[list[Camera]]:
    """Return the cameras of films with the smallest scale of all, so that sizes can be compared."""
    every = [camera for film in films for camera in film]
    half, distance = max(camera.half_height for camera in every), max(camera.distance for camera in every)
    return [[replace(camera, half_height=half, distance=distance) for camera in film] for film in films]


def _turned(vector: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    axis = axis / np.linalg.norm(axis)
    along = (vector @ axis) * axis
    return along + np.cos(angle) * (vector - along) + np.sin(angle) * np.cross(axis, vector)


def _towards(azimuth: float, elevation: float, up: np.ndarray) -> np.ndarray:
    """Return a direction from angles [rad]; the azimuth is from x, about the upward direction."""
    first = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    around = np.cos(azimuth) * first + np.sin(azimuth) * np.cross(up, first)
    return np.cos(elevation) * around + np.sin(elevation) * up


def _smooth(times: np.ndarray, when: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values between given times by cubics without overshoot, at rest at both ends.

    The rates at inner times are the weighted harmonic means of the slopes beside them, zero where these have different
    signs (Fritsch and Butland 1984, eq. 5): the camera passes through them without a stop where it goes on in the same
    direction.
    """
    if len(when) == 1:
        return np.full(len(times), values[0])
    steps = np.diff(when)
    slopes = np.diff(values) / steps
    rates = np.zeros(len(when))
    before, after = slopes[:-1], slopes[1:]
    same = before * after > 0.0
    first, second = 2.0 * steps[1:] + steps[:-1], steps[1:] + 2.0 * steps[:-1]
    inner = (first + second) / (first / np.where(same, before, 1.0) + second / np.where(same, after, 1.0))
    rates[1:-1] = np.where(same, inner, 0.0)
    k = np.clip(np.searchsorted(when, times, side="right") - 1, 0, len(when) - 2)
    u = np.clip((times - when[k]) / steps[k], 0.0, 1.0)
    ease = u * u * (3.0 - 2.0 * u)
    bend = steps[k] * (rates[k] * u * (1.0 - u) ** 2 - rates[k + 1] * u * u * (1.0 - u))
    return values[k] + (values[k + 1] - values[k]) * ease + bend
