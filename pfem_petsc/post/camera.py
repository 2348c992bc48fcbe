"""A camera that is fixed for all frames and has the whole motion in view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError

__all__ = ["VIEWS", "Camera", "aim"]

VIEWS = ("auto", "xy", "xz", "yz", "iso")

_FLAT = {  # direction from the structure to the eye, and the upward direction
    "xy": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "xz": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "yz": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
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

    def apply(self, camera: Any) -> None:
        """Set a VTK camera."""
        camera.SetFocalPoint(*self.centre)
        camera.SetPosition(*(self.centre + self.distance * self.towards))
        camera.SetViewUp(*self.up)
        camera.SetParallelProjection(self.parallel)
        camera.SetParallelScale(self.half_height)
        camera.SetViewAngle(_OPENING)
        camera.SetClippingRange(0.02 * self.distance, 4.0 * self.distance)


def aim(
    points: np.ndarray,
    bounds: np.ndarray,
    normals: Sequence[np.ndarray],
    view: str,
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
    view : one of :data:`VIEWS`
    aspect : width over height of the picture
    upward : upward direction of the oblique view
    margin : factor on the visible extent

    Raises
    ------
    InputError
        For an unknown view.
    """
    if view not in VIEWS:
        raise InputError(f"render: view = {view!r} is not known; it is one of {', '.join(VIEWS)}")
    if view == "auto":
        view = _flat_view(bounds)
    if view in _FLAT:
        towards, up = (np.array(vector) for vector in _FLAT[view])
    else:
        towards, up = _oblique(normals, np.asarray(upward, dtype=float))
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    across, along, deep = points @ right, points @ up, points @ towards
    middle = [0.5 * (values.min() + values.max()) for values in (across, along, deep)]
    centre = middle[0] * right + middle[1] * up + middle[2] * towards
    half = 0.5 * max(np.ptp(along), np.ptp(across) / aspect) * margin or 1.0
    if view in _FLAT:
        return Camera(towards, up, right, centre, 10.0 * (half * max(1.0, aspect) + np.ptp(deep)), half, True)
    # with perspective each point requires its own distance, larger for nearer points
    slope = np.tan(np.radians(_OPENING) / 2)
    needed = np.maximum(np.abs(along - middle[1]), np.abs(across - middle[0]) / aspect) * margin / slope
    distance = float((needed + deep - middle[2]).max()) or 1.0
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
