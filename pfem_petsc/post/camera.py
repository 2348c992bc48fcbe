"""Cameras of a film: at rest with the whole motion in view, around the structure, or with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError

VIEWS = ("auto", "xy", "xz", "yz", "iso", "front", "back", "left", "right", "top", "bottom")

_X, _Y, _Z = (tuple(row) for row in np.eye(3).tolist())
_FLAT = {  # direction from the structure to the eye, and the upward direction
    "xy": (_Z, _Y),
    "xz": ((0.0, -1.0, 0.0), _Z),
    "yz": (_X, _Z),
    "front": ((0.0, -1.0, 0.0), _Z),
    "back": (_Y, _Z),
    "left": ((-1.0, 0.0, 0.0), _Z),
    "right": (_X, _Z),
    "top": (_Z, _Y),
    "bottom": ((0.0, 0.0, -1.0), _Y),
}
_OPENING = 25.0  # degrees, vertical


@dataclass(frozen=True)
class Camera:
    """Position and orientation of the camera.

    Parameters
    ----------
    towards, up, right : (3,) unit vectors: from the structure to the eye, and the picture's axes
    centre : (3,) [m], the point in the middle of the picture
    distance : [m], from the centre to the eye
    half_height : [m], half of the vertical extent of the picture, at the centre
    parallel : whether there is no perspective
    """

    towards: np.ndarray
    up: np.ndarray
    right: np.ndarray
    centre: np.ndarray
    distance: float
    half_height: float
    parallel: bool

    def zoomed(self, factor: float) -> Camera:
        """Return the camera that shows what is in the middle larger by a factor."""
        return replace(self, half_height=self.half_height / factor, distance=self.distance / factor)

    def ahead(self, points: np.ndarray) -> np.ndarray:
        """Return the direction (3,) or directions (n, 3) from points (n, 3) [m] to the eye."""
        return self.towards if self.parallel else self.centre + self.distance * self.towards - points

    def metres(self, points: np.ndarray) -> np.ndarray:
        """Return the vertical extent (n,) [m] of the picture at points (n, 3) [m], zero behind the eye."""
        depth = 0.0 if self.parallel else (points - self.centre) @ self.towards / self.distance
        return 2.0 * self.half_height * np.maximum(0.0, 1.0 - depth) * np.ones(len(points))


def direction(
    view: str | Sequence[float], bounds: np.ndarray, normals: Sequence[np.ndarray], upward: Sequence[float]
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the direction to the eye (3,), the upward direction (3,), and whether there is no perspective.

    Parameters
    ----------
    view : one of :data:`VIEWS`, or the direction (3,) from the structure to the eye
    bounds : (2, 3) [m], bounds of the structure's motion, from which ``"auto"`` determines whether it is flat
    normals : allowed sides of the walls; the oblique view looks at walls from there
    upward : upward direction of the oblique view

    Raises
    ------
    InputError
        For an unknown view.
    """
    up = np.asarray(upward, dtype=float)
    if not isinstance(view, str):
        towards = np.asarray(view, dtype=float)
        size = float(np.linalg.norm(towards)) if towards.shape == (3,) else 0.0
        if not (size > 0.0 and np.isfinite(size)):
            raise InputError(f"render: view = {view!r} is not a direction; give three numbers that are not all zero")
        towards = towards / size
        if np.linalg.norm(np.cross(up, towards)) < 1e-3:
            up = np.eye(3)[(int(np.argmax(np.abs(up))) + 2) % 3]
        return towards, up, False
    if view not in VIEWS:
        raise InputError(f"render: view = {view!r} is not known; it is one of {', '.join(VIEWS)}, or a direction x,y,z")
    if view == "auto":
        extent = bounds[1] - bounds[0]
        flat = extent <= 1e-6 * max(extent.max(), 1e-300)
        view = next((name for axis, name in ((2, "xy"), (1, "xz"), (0, "yz")) if flat[axis]), "iso")
    if view in _FLAT:
        towards, up = (np.array(vector) for vector in _FLAT[view])
        return towards, up, True
    return _oblique(normals, up), up, False


def _oblique(normals: Sequence[np.ndarray], upward: np.ndarray) -> np.ndarray:
    """Return the direction of the eye: slightly from above, from the quadrant that sees most walls from the front."""
    first = np.array(_X if abs(upward[0]) < 0.9 else _Y)
    second = np.cross(upward, first)
    # -second points towards the viewer in a right-handed picture, the default quadrant
    quarters = [a * first + b * second for b in (-1.3, 1.3) for a in (0.9, -0.9)]
    quarters += [1.3 * a * first + 0.9 * b * second for b in (-1.0, 1.0) for a in (1.0, -1.0)]
    directions = [(each + 0.65 * upward) / np.linalg.norm(each + 0.65 * upward) for each in quarters]
    seen = [sum(min(0.3, float(normal @ each)) for normal in normals) for each in directions]
    return directions[int(np.argmax(np.round(seen, 6)))]


def fit(
    points: np.ndarray,
    way: tuple[np.ndarray, np.ndarray, bool],
    aspect: float,
    margin: float = 1.05,
    centre: np.ndarray | None = None,
    reach: float = 0.0,
) -> Camera:
    """Return the camera in a direction that has all points (n, 3) [m] in view.

    Parameters
    ----------
    way : of :func:`direction`
    aspect : width over height of the picture
    margin : factor on the visible extent
    centre : (3,) [m], what is in the middle of the picture; None: the middle of the points
    reach : [m], how far pictures of points extend around them
    """
    towards, up, parallel = way
    right = np.cross(up, towards)
    right = right / np.linalg.norm(right)
    up = np.cross(towards, right)
    axes = np.stack([right, up, towards])
    spans = points @ axes.T
    middle = 0.5 * (spans.min(axis=0) + spans.max(axis=0)) if centre is None else axes @ centre
    across, along, deep = np.abs((spans - middle).T) + reach
    centre = middle @ axes
    high = np.maximum(along, across / aspect) * margin
    half = float(high.max()) or 1.0
    if parallel:
        return Camera(towards, up, right, centre, 10.0 * (half * max(1.0, aspect) + 2.0 * deep.max()), half, True)
    # with perspective each point requires its own distance, larger for nearer points
    slope = np.tan(np.radians(_OPENING) / 2)
    distance = float((high / slope + (spans - middle)[:, 2] + reach).max()) or 1.0
    return Camera(towards, up, right, centre, distance, distance * slope, False)


def cameras(options: Any, motion: Any, aspect: float) -> list[Camera]:
    """Return the camera of each frame of a motion; all have the same scale.

    Parameters
    ----------
    options : ``view``: name of a view, or the direction (3,) from the structure to the eye; ``zoom``: factor on the
        size in the picture; ``orbit``: angle [degrees] that the camera goes around the upward direction from the first
        frame to the last; ``follow``: "structure" or the name of a probe that stays in the middle of the picture
    motion : of the film
    aspect : width of the picture over its height
    """
    way = towards, up, parallel = direction(options.view, motion.bounds, motion.normals, motion.upward)
    points, reach, count = motion.surroundings, motion.reach, len(motion.frames)
    if not options.orbit and options.follow is None:
        return [fit(points, way, aspect, reach=reach).zoomed(options.zoom)] * count
    ways = [way] * count
    if options.orbit:
        from scipy.spatial.transform import Rotation

        turns = np.linspace(0.0, np.radians(options.orbit), count)[:, None] * up / np.linalg.norm(up)
        ways = [(each, up, parallel) for each in Rotation.from_rotvec(turns).apply(towards)]
    if options.follow is None:
        centre = motion.bounds.mean(axis=0)
        made = [fit(points, way, aspect, centre=centre, reach=reach) for way in ways]
    else:
        centres = motion.boxes.mean(axis=1) if options.follow == "structure" else motion.probe(options.follow)
        held = zip(ways, motion.hulls, centres, strict=True)
        made = [fit(hull, way, aspect, margin=1.25, centre=centre, reach=reach) for way, hull, centre in held]
    (made,) = at_one_scale([made])
    return [camera.zoomed(options.zoom) for camera in made]


def at_one_scale(films: list[list[Camera]]) -> list[list[Camera]]:
    """Return the cameras of films with the smallest scale of all, so that sizes can be compared."""
    every = [camera for film in films for camera in film]
    half, distance = max(camera.half_height for camera in every), max(camera.distance for camera in every)
    return [[replace(camera, half_height=half, distance=distance) for camera in film] for film in films]
