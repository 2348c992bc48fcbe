"""Shapes of cross-sections: area, second moments and plastic modulus from sizes, and sizes from an area.

Circles by their formulas; angles, boxes, I sections and channels as polygons, integrated along their edges exactly.
Values of second moments and plastic moduli are those about the weak axis, about which a bar buckles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

Point = tuple[float, float]
Outline = list[list[Point]]
"""Closed polygons: the outline in one sense, holes in the other."""


class Shape(NamedTuple):
    """A shape of thin parts, by its outline.

    Attributes
    ----------
    outline : from width, height, thickness of the flanges and of the web [m]
    webs : whether the web may have a thickness of its own
    inner : largest thickness of the flanges and of the web, from width and height [m], at which the shape has parts
    """

    outline: Callable[[float, float, float, float], Outline]
    webs: bool
    inner: Callable[[float, float], tuple[float, float]]


POLYGONS: dict[str, Shape] = {
    "angle": Shape(
        lambda b, h, t, _: [[(0.0, 0.0), (b, 0.0), (b, t), (t, t), (t, h), (0.0, h)]],
        False,
        lambda b, h: (min(b, h), math.inf),
    ),
    "box": Shape(
        lambda b, h, t, _: [
            [(0.0, 0.0), (b, 0.0), (b, h), (0.0, h)],
            [(t, t), (t, h - t), (b - t, h - t), (b - t, t)],
        ],
        False,
        lambda b, h: (0.5 * min(b, h), math.inf),
    ),
    # with the origin in the middle of the web
    "I": Shape(
        lambda b, h, t, w: [
            [(-w / 2, t), (-b / 2, t), (-b / 2, 0.0), (b / 2, 0.0), (b / 2, t), (w / 2, t)]
            + [(w / 2, h - t), (b / 2, h - t), (b / 2, h), (-b / 2, h), (-b / 2, h - t), (-w / 2, h - t)]
        ],
        True,
        lambda b, h: (0.5 * h, b),
    ),
    "channel": Shape(
        lambda b, h, t, w: [
            [(0.0, 0.0), (b, 0.0), (b, t), (w, t), (w, h - t), (b, h - t), (b, h), (0.0, h)],
        ],
        True,
        lambda b, h: (0.5 * h, b),
    ),
}
"""Shapes by name. A new one is an outline and a line here."""

CIRCLES = ("round", "tube")
SHAPES = (*CIRCLES, *POLYGONS)
SIZES = ("diameter", "width", "height", "thickness", "web_thickness")
"""Keys of a section that are sizes of its shape [m]."""


class CrossSection(NamedTuple):
    """Cross-sections of bars: arrays (b,) or numbers, in SI units, zero where the shape is not known.

    Attributes
    ----------
    area : [m2]
    second_moment : about the weak axis [m4]
    plastic_modulus : about the weak axis [m3]
    radius : of the circle around it, or of the solid circle of its area for shapes that are none [m]
    width : largest width that wind meets [m]
    """

    area: np.ndarray | float
    second_moment: np.ndarray | float
    plastic_modulus: np.ndarray | float
    radius: np.ndarray | float
    width: np.ndarray | float


def cross_section(
    shape: str | None,
    sizes: Mapping[str, float],
    area: np.ndarray | float | None = None,
    second_moment: float | None = None,
) -> CrossSection:
    """Return the cross-section of a shape.

    Parameters
    ----------
    shape : one of :data:`SHAPES`, or None for a bar of an area, with or without a second moment
    sizes : sizes [m], by the keys in :data:`SIZES`: of circles the diameter, of tubes a thickness; of others width,
        height (default: width), thickness, web_thickness (default: thickness)
    area : area [m2], one or several (b,), instead of one of the sizes: the diameter, the thickness of others
    second_moment : second moment of area [m4] without a shape: of a hollow circle if it can be, else of a rectangle

    Raises
    ------
    ValueError
        If sizes are missing, too many, or contradict each other; the message begins with their names.
    """
    if shape is None:
        return _without_shape(sizes, area, second_moment)
    allowed = {"round": ("diameter",), "tube": ("diameter", "thickness")}.get(shape, ("width", "height", "thickness"))
    allowed += ("web_thickness",) if shape in POLYGONS and POLYGONS[shape].webs else ()
    for size in [size for size in sizes if size not in allowed][:1]:
        raise ValueError(f'{size} is no size of shape = "{shape}", which has {", ".join(allowed)}')
    if shape in CIRCLES:
        return _circle(shape, sizes, area)
    return _polygon(shape, sizes, area)


def _without_shape(
    sizes: Mapping[str, float], area: np.ndarray | float | None, second_moment: float | None
) -> CrossSection:
    for size in [size for size in sizes if size != "diameter"][:1]:
        raise ValueError(f"{size} needs a shape: {', '.join(SHAPES)}")
    if area is None:
        raise ValueError("expected area, area_field, or a shape with its sizes")
    radius, moment, modulus = np.sqrt(area / np.pi), 0.0 * area, 0.0 * area
    if second_moment is not None:
        moment = second_moment + moment
        squares, difference = 4.0 * moment / area, area / np.pi  # sum and difference of the squares of the radii
        hollow = squares >= difference
        radius = np.where(hollow, np.sqrt(0.5 * (squares + difference)), radius)
        inner = np.where(hollow, np.sqrt(0.5 * np.maximum(squares - difference, 0.0)), 0.0)
        flat = 0.25 * area * np.sqrt(3.0 * squares)
        modulus = np.where(hollow, 4.0 / 3.0 * (radius**3 - inner**3), flat)
    return CrossSection(area, moment, modulus, radius, sizes.get("diameter", 2.0 * radius))


def _circle(shape: str, sizes: Mapping[str, float], area: np.ndarray | float | None) -> CrossSection:
    given = [*sizes, *(["area"] if area is not None else [])]
    needed = ("area", "diameter") if shape == "round" else ("area", "diameter", "thickness")
    if len(given) != len(needed) - 1:
        count = "one" if shape == "round" else "two"
        raise ValueError(f'shape = "{shape}" needs {count} of {", ".join(needed)}, got {" and ".join(given) or "none"}')
    diameter, thickness = sizes.get("diameter"), sizes.get("thickness")
    if shape == "round":
        outer = np.sqrt(area / np.pi) if diameter is None else 0.5 * diameter
        inner = 0.0 * outer
    elif diameter is None:
        solid = float(np.sqrt(np.min(area) / np.pi))
        if thickness > solid:
            raise ValueError(
                f"thickness = {thickness!r} m is too much for a tube of area = {float(np.min(area))!r} m2: a solid bar "
                f"of this area has a radius of {solid:.6g} m"
            )
        outer = area / (2.0 * np.pi * thickness) + 0.5 * thickness
        inner = np.maximum(outer - thickness, 0.0)
    elif thickness is None:
        outer, solid = 0.5 * diameter, 0.25 * np.pi * diameter**2
        if np.max(area) > solid:
            raise ValueError(f"diameter = {diameter!r} m is too little: a solid bar of it has {solid:.6g} m2")
        inner = np.sqrt(np.maximum(outer**2 - area / np.pi, 0.0))
    else:
        outer = 0.5 * diameter
        if thickness > outer:
            raise ValueError(f"thickness = {thickness!r} m is more than half of diameter = {diameter!r} m")
        inner = outer - thickness
    area = np.pi * (outer**2 - inner**2) if area is None else area
    outer = outer + 0.0 * area
    moment, modulus = 0.25 * np.pi * (outer**4 - inner**4), 4.0 / 3.0 * (outer**3 - inner**3)
    return CrossSection(area, moment, modulus, outer, 2.0 * outer)


def _polygon(shape: str, sizes: Mapping[str, float], area: np.ndarray | float | None) -> CrossSection:
    width, web = sizes.get("width"), sizes.get("web_thickness")
    if width is None or (area is None) == ("thickness" not in sizes):
        raise ValueError(f'shape = "{shape}" needs width and thickness, or width and area')
    if np.ndim(area):
        raise ValueError(f'shape = "{shape}" has one area for all bars of a section; area_field goes with circles')
    height = sizes.get("height", width)
    outline, _, inner = POLYGONS[shape]
    flanges, webs = inner(width, height)
    if web is not None and web > webs:
        raise ValueError(f"web_thickness = {web!r} m is too much: at most {webs:g} m")

    def made(thickness: float) -> Outline:
        return outline(width, height, thickness, thickness if web is None else web)

    def area_of(thickness: float) -> float:
        return _first(_edges(made(thickness)))[0]

    if area is None:
        thickness = sizes["thickness"]
        if thickness > min(flanges, webs if web is None else math.inf):
            raise ValueError(f"thickness = {thickness!r} m is too much: at most {min(flanges, webs):g} m")
    else:
        most = min(flanges, webs if web is None else math.inf)
        least = 1e-12 * most
        if not area_of(least) < area < area_of(most):
            raise ValueError(
                f'area = {area!r} m2 cannot be that of shape = "{shape}" with these sizes: a thickness up to '
                f"{most:g} m gives {area_of(least):.6g} to {area_of(most):.6g} m2"
            )
        thickness = brentq(lambda value: area_of(value) - area, least, most, xtol=1e-15 * most, rtol=1e-14)
    found, moment, modulus = weak_axis(made(thickness))
    return CrossSection(found, moment, modulus, math.sqrt(found / math.pi), max(width, height))


def weak_axis(outline: Outline) -> tuple[float, float, float]:
    """Return area [m2], smallest second moment [m4] and the plastic modulus [m3] about its axis, of polygons.

    Moments are integrals along the edges (Green's theorem): of x^2, y^2 and x y over the area; the smallest is the
    smaller eigenvalue of their tensor about the centroid. The plastic modulus is that of the two halves of equal area.
    """
    edges = _edges(outline)
    area, centre = _first(edges)
    edges[:, 0::2] -= centre[0]
    edges[:, 1::2] -= centre[1]
    ax, ay, bx, by = edges.T
    twice = ax * by - bx * ay
    xx = float(np.sum(twice * (ax**2 + ax * bx + bx**2)) / 12.0)
    yy = float(np.sum(twice * (ay**2 + ay * by + by**2)) / 12.0)
    xy = float(np.sum(twice * (ax * by + 2.0 * ax * ay + 2.0 * bx * by + bx * ay)) / 24.0)
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    direction = vectors[:, 0]  # in which the shape extends least: distances from the weak axis
    distance = np.column_stack([edges[:, :2] @ direction, edges[:, 2:] @ direction])
    along = (edges[:, 2:] - edges[:, :2]) @ np.array([-direction[1], direction[0]])

    def excess(level: float) -> float:
        return _beyond(distance, along, level, 1) - 0.5 * area

    level = brentq(excess, distance.min(), distance.max(), xtol=1e-15 * np.ptp(distance), rtol=1e-14)
    # distances from the level of the half beyond it, and of the other, as those from the centroid have no integral
    return area, float(values[0]), 2.0 * _beyond(distance, along, level, 2) + area * level


def _edges(outline: Outline) -> np.ndarray:
    """Return the edges (e, 4), from one point to another."""
    edges = np.array(
        [(*a, *b) for polygon in outline for a, b in zip(polygon, [*polygon[1:], polygon[0]], strict=True)]
    )
    edges[:, 0::2] -= edges[:, 0].mean()
    edges[:, 1::2] -= edges[:, 1].mean()
    return edges


def _first(edges: np.ndarray) -> tuple[float, np.ndarray]:
    ax, ay, bx, by = edges.T
    twice = ax * by - bx * ay
    area = 0.5 * float(np.sum(twice))
    return area, np.array([np.sum(twice * (ax + bx)), np.sum(twice * (ay + by))]) / (6.0 * area)


def _beyond(distance: np.ndarray, along: np.ndarray, level: float, power: int) -> float:
    """Return the integral of max(d - level, 0)^power/power along the edges, whose ends have distances (e, 2)."""
    low, high = np.maximum(distance - level, 0.0).min(axis=1), np.maximum(distance - level, 0.0).max(axis=1)
    span = np.abs(distance[:, 1] - distance[:, 0])
    sloping = span > 1e-9 * np.ptp(distance)  # spans of others are rounding
    share = np.where(sloping, (high - low) / np.where(sloping, span, 1.0), high > 0.0)
    mean = 0.5 * (low + high) if power == 1 else (low**2 + low * high + high**2) / 6.0
    return float(np.sum(along * share * mean))
