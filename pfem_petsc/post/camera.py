"""A camera that is fixed for all frames and has the whole motion in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError

__all__ = ["VIEWS", "Camera", "aim", "direction", "fit"]

VIEWS = ("auto", "xy", "xz", "yz", "iso", "front", "back", "left", "right", "top", "bottom")

_FLAT = {  # direction from the structure to the eye, and the upward direction
    "xy": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "xz": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "yz": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "front": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "back": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "left": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "right": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "top": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "bottom": ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
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

    def project(self, points: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
        """Project points (n, 3) [m] into a picture of ``size`` pixels.

        Returns
        -------
        Columns and rows (n,) [pixels], how near the points are (n,), which is linear in the picture and larger where
        nearer, and pixels per metre there (n,), 0 behind the eye.
        """
        away = points - self.centre
        across, along, deep = away @ self.right, away @ self.up, away @ self.towards
        if self.parallel:
            scale = np.full(len(points), size[1] / (2.0 * self.half_height))
            near = deep * scale
        else:
            distance = self.distance - deep
            seen = distance > 0.02 * self.distance
            near = np.where(seen, 1.0 / np.where(seen, distance, 1.0), 0.0)
            scale = self._focal(size) * near
        return 0.5 * size[0] + across * scale, 0.5 * size[1] - along * scale, near, scale

    def zoomed(self, factor: float) -> Camera:
        """Return the camera that shows what is in the middle larger by a factor."""
        return replace(self, half_height=self.half_height / factor, distance=self.distance / factor)

    def lift(self, size: tuple[int, int]) -> np.ndarray:
        """Return (2,): what is nearer by a pixel has a nearness larger by ``lift[0] + lift[1]*near``."""
        return np.array([1.0, 0.0]) if self.parallel else np.array([0.0, 1.0 / self._focal(size)])

    def _focal(self, size: tuple[int, int]) -> float:
        return 0.5 * size[1] * self.distance / self.half_height


def aim(
    points: np.ndarray,
    bounds: np.ndarray,
    normals: Sequence[np.ndarray],
    view: str | Sequence[float],
    aspect: float,
    upward: Sequence[float] = (0.0, 0.0, 1.0),
    margin: float = 1.05,
) -> Camera:
    """Return a camera that has all ``points`` in view.

    Parameters
    ----------
    points : (n, 3) [m], points that must be visible (corners suffice)
    bounds : (2, 3) [m], bounds of the structure's motion, from which ``"auto"`` determines whether it is flat
    normals : allowed sides of the walls; the oblique view looks at walls from there
    view : one of :data:`VIEWS`, or the direction (3,) from the structure to the eye
    aspect : width over height of the picture
    upward : upward direction of the oblique view
    margin : factor on the visible extent

    Raises
    ------
    InputError
        For an unknown view.
    """
    return fit(points, *direction(view, bounds, normals, upward), aspect, margin)


def direction(
    view: str | Sequence[float], bounds: np.ndarray, normals: Sequence[np.ndarray], upward: Sequence[float]
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the direction to the eye (3,), the upward direction (3,), and whether there is no perspective.

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
        view = _flat_view(bounds)
    if view in _FLAT:
        towards, up = (np.array(vector) for vector in _FLAT[view])
        return towards, up, True
    return *_oblique(normals, up), False


def fit(
    points: np.ndarray,
    towards: np.ndarray,
    up: np.ndarray,
    parallel: bool,
    aspect: float,
    margin: float = 1.05,
    centre: np.ndarray | None = None,
) -> Camera:
    """Return the camera in a direction that has all points (n, 3) [m] in view.

    Parameters
    ----------
    centre : (3,) [m], what is in the middle of the picture; None: the middle of the points
    """
    right = np.cross(up, towards)
    right = right / np.linalg.norm(right)
    up = np.cross(towards, right)
    ways = (right, up, towards)
    spans = [points @ way for way in ways]
    middle = [0.5 * (values.min() + values.max()) for values in spans] if centre is None else [centre @ w for w in ways]
    centre = sum(value * way for value, way in zip(middle, ways, strict=True))
    across, along, deep = (values - value for values, value in zip(spans, middle, strict=True))
    half = max(float(np.abs(along).max()), float(np.abs(across).max()) / aspect) * margin or 1.0
    if parallel:
        return Camera(towards, up, right, centre, 10.0 * (half * max(1.0, aspect) + np.ptp(deep)), half, True)
    # with perspective each point requires its own distance, larger for nearer points
    slope = np.tan(np.radians(_OPENING) / 2)
    needed = np.maximum(np.abs(along), np.abs(across) / aspect) * margin / slope
    distance = float((needed + deep).max()) or 1.0
    return Camera(towards, up, right, centre, distance, distance * slope, False)


def _flat_view(bounds: np.ndarray) -> str:
    extent = bounds[1] - bounds[0]
    flat = extent <= 1e-6 * max(extent.max(), 1e-300)
    for axis, view in ((2, "xy"), (1, "xz"), (0, "yz")):
        if flat[axis]:
            return view
    return "iso"


def _oblique(normals: Sequence[np.ndarray], upward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction of the eye: slightly from above, from the quadrant that sees most walls from the front."""
    first = np.array([1.0, 0.0, 0.0]) if abs(upward[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first -= (first @ upward) * upward
    first /= np.linalg.norm(first)
    second = np.cross(upward, first)
    # -second points towards the viewer in a right-handed picture, the default quadrant
    quarters = [a * first + b * second for b in (-1.3, 1.3) for a in (0.9, -0.9)]
    quarters += [1.3 * a * first + 0.9 * b * second for b in (-1.0, 1.0) for a in (1.0, -1.0)]
    directions = [quarter + 0.65 * upward for quarter in quarters]
    directions = [direction / np.linalg.norm(direction) for direction in directions]
    seen = [sum(min(0.3, float(normal @ direction)) for normal in normals) for direction in directions]
    return directions[int(np.argmax(np.round(seen, 6)))], upward
