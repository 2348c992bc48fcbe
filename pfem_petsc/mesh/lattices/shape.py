"""What moves the nodes of a block: grading along its axes, random perturbation, and curved maps."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from .block import Block, Move
from .expressions import Expression
from .numbering import Places

__all__ = [
    "cylinder_map",
    "graded_count",
    "graded_levels",
    "perturbation",
    "random_numbers",
    "sphere_map",
]

_STEPS = 16
"""Runge-Kutta steps within a cell of graded pitch."""


def random_numbers(seed: int, stream: int, numbers: np.ndarray) -> np.ndarray:
    """Return a uniform random number in [0, 1) for each number (n,) int64, of one of several streams.

    Each depends on seed, stream and number alone, and not on which others are asked for or in what order.

    Notes
    -----
    The finaliser of SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, "Fast splittable pseudorandom number generators",
    OOPSLA 2014), applied to the seed with the stream and then to a counter.
    """
    start = _mixed(np.array([seed % (1 << 63)], np.uint64) ^ (np.uint64(stream) << np.uint64(56)))
    counter = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return (_mixed(counter + start) >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _mixed(z: np.ndarray) -> np.ndarray:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def perturbation(block: Block, amplitude: float, seed: int) -> Move:
    """Return the move of each node by up to ``amplitude`` [m] along each axis; nodes of outer faces remain in them."""

    def move(points: np.ndarray, numbers: np.ndarray, places: Places) -> np.ndarray:
        points = points.copy()
        for axis in range(3):
            free = ~(block.on_face(places, axis, False) | block.on_face(places, axis, True))
            points[:, axis] += free * (amplitude * (2.0 * random_numbers(seed, axis, numbers) - 1.0))
        return points

    return move


def graded_levels(cells: int, edge: float, factor: Expression, axis: str) -> np.ndarray:
    """Return the coordinates (cells + 2,) [m] of the borders of cells along an axis, and of one more.

    Cell numbers s are mapped to coordinates x by dx/ds = edge factor(x), x(0) = 0 (Runge-Kutta of order 4).

    Raises
    ------
    ValueError
        If the factor is not positive somewhere.
    """
    levels = list(islice(_borders(edge, factor, axis), cells + 1))
    # no expression has to hold beyond the last cell: what lies there only completes the arithmetic
    levels.append(2.0 * levels[-1] - levels[-2])
    return np.array(levels)


def graded_count(length: float, edge: float, factor: Expression, axis: str, most: int = 20_000) -> int:
    """Return the least number of graded cells that cover a length [m] from x = 0 on.

    Raises
    ------
    ValueError
        If the factor is not positive somewhere, or more than ``most`` cells are needed.
    """
    start = 0.0
    for count, end in enumerate(islice(_borders(edge, factor, axis), 1, most + 1), 1):
        if end >= length - 1e-9 * (end - start):
            return count
        start = end
    raise ValueError(f"{factor.text!r} takes more than {most:,} cells over {length:g} m, and reaches {start:g} m")


def _borders(edge: float, factor: Expression, axis: str) -> Iterator[float]:
    """Yield the coordinates [m] of the borders of graded cells, from 0 on."""

    def slope(x: float) -> float:
        value = float(factor({axis: np.array([x])})[0])
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{factor.text!r} is {value:g} at {axis} = {x:g} m; expected a factor > 0 in the block")
        return edge * value

    x, h = 0.0, 1.0 / _STEPS
    yield x
    while True:
        for _ in range(_STEPS):
            k1 = slope(x)
            k2 = slope(x + 0.5 * h * k1)
            k3 = slope(x + 0.5 * h * k2)
            x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(x + h * k3))
        yield x


def cylinder_map(radius: float, length: float | None) -> Move:
    """Return the map of a block to a cylinder about the y axis: x along the circumference, z outwards from ``radius``.

    x = 0 goes to the positive z axis. With ``length`` [m], the extent along x, the circumference is closed.
    """

    def move(points: np.ndarray, _numbers: np.ndarray, _places: Places) -> np.ndarray:
        angle = points[:, 0] * (1.0 / radius if length is None else 2.0 * np.pi / length)
        outwards = radius + points[:, 2]
        return np.stack([outwards * np.sin(angle), points[:, 1], outwards * np.cos(angle)], axis=1)

    return move


def sphere_map(radius: float, middle: np.ndarray) -> Move:
    """Return the map of a block to a part of a spherical shell about the origin: z outwards from ``radius``.

    Lines of x and y become great circles at angles x/radius and y/radius from the middle (2,) [m] of the block, which
    goes to the positive z axis (the equiangular projection of a face of a cube).
    """

    def move(points: np.ndarray, _numbers: np.ndarray, _places: Places) -> np.ndarray:
        a, b = np.tan((points[:, 0] - middle[0]) / radius), np.tan((points[:, 1] - middle[1]) / radius)
        factor = (radius + points[:, 2]) / np.sqrt(1.0 + a * a + b * b)
        return np.stack([a * factor, b * factor, factor], axis=1)

    return move
