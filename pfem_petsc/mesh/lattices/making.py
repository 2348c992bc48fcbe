"""The block of cells that the keys of a lattice describe."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ..slab import check_length, check_size
from .block import Block
from .cell import UnitCell
from .expressions import Expression
from .keys import COORDINATES
from .kinds import ANGLE, KINDS, auxetic
from .shape import cylinder_map, graded_count, graded_levels, perturbation, sphere_map
from .surface import Surface

if TYPE_CHECKING:
    from ..generators.lattice import Parameters

__all__ = ["cell_of_kind", "fit_to_surface", "longest_bar", "make_block"]


def cell_of_kind(keys: Parameters) -> UnitCell:
    """Return the unit cell that the keys name."""
    if keys.cell is not None:
        return keys.cell.made()
    return auxetic(keys.angle if keys.angle is not None else ANGLE) if keys.kind == "auxetic" else KINDS[keys.kind]()


def make_block(keys: Parameters, plain: bool) -> tuple[Block, float]:
    """Return the block of cells and its volume [m3].

    Parameters
    ----------
    plain : whether nothing is left out, so that nodes and bars keep the numbering of their kind

    Raises
    ------
    InputError
        For lengths, gradings, perturbations or maps that do not fit the block.
    """
    cell, cells = cell_of_kind(keys), np.array(keys.cells)
    check_length(keys.pitch, "mesh.pitch")
    factors = keys.grading or (1.0, 1.0, 1.0)
    levels: list[float | np.ndarray] = []
    for axis, factor in enumerate(factors):
        edge = keys.pitch * cell.aspect[axis]
        if isinstance(factor, str):
            count = -(-int(cells[axis]) // cell.layers[axis])
            try:
                levels.append(graded_levels(count, edge, Expression(factor, (COORDINATES[axis],)), COORDINATES[axis]))
            except ValueError as error:
                raise InputError(f"mesh.grading[{axis}]: {error}") from None
        else:
            check_length(edge * factor, f"mesh.pitch times mesh.grading[{axis}]")
            levels.append(float(edge * factor))
    block = Block(cell, cells, levels, keys.curved is not None and keys.curved.closed, plain)
    if keys.perturbation:
        amplitude, shortest = keys.perturbation * keys.pitch, _shortest(block)
        if 2.0 * math.sqrt(3.0) * amplitude >= shortest:
            raise InputError(
                f"mesh.perturbation = {keys.perturbation!r}: ends of a strut of {shortest:.4g} m could meet; choose "
                f"less than {shortest / (2.0 * math.sqrt(3.0) * keys.pitch):.4g}"
            )
        block.moves.append(perturbation(block, amplitude, keys.seed or 0))
    extents = block.extents()
    check_length(
        float(np.abs(keys.origin or 0.0).max()) + float(extents.max()), "mesh.origin and the extent of the block"
    )
    for length, axis in zip(extents, COORDINATES):
        check_length(float(length), f"mesh.cells: extent along {axis}")
    volume = float(np.prod(extents))
    if keys.curved is not None:
        volume = _curve(block, keys, extents)
    if keys.origin is not None:
        origin = np.array(keys.origin)
        block.moves.append(lambda points, _numbers, _places: points + origin)
    return block, volume


def _shortest(block: Block) -> float:
    """Return the length [m] of the shortest strut, in the smallest cell along each axis."""
    edges = np.array([level if isinstance(level, float) else np.diff(level[:-1]).min() for level in block.levels])
    return float(np.linalg.norm(block.cell.vectors() / block.cell.edges * edges, axis=1).min())


def _curve(block: Block, keys: Parameters, extents: np.ndarray) -> float:
    """Add the map to a shell, and return the volume of the shell [m3]."""
    curved = keys.curved
    assert curved is not None
    inner, outer = curved.radius, curved.radius + float(extents[2])
    if curved.shape == "cylinder":
        if not curved.closed and extents[0] > 2.0 * np.pi * inner * (1.0 + 1e-9):
            raise InputError(
                f"mesh.curved.radius = {inner!r}: the block is {extents[0]:.6g} m long, more than the circumference "
                f"of {2.0 * np.pi * inner:.6g} m; use fewer cells, or closed = true"
            )
        block.moves.append(cylinder_map(inner, float(extents[0]) if curved.closed else None))
        angle = 2.0 * np.pi if curved.closed else extents[0] / inner
        return float(0.5 * angle * (outer**2 - inner**2) * extents[1])
    half = 0.5 * extents[:2] / inner
    if half.max() >= 0.45 * np.pi:
        raise InputError(
            f"mesh.curved.radius = {inner!r}: the block spans {np.degrees(2.0 * half.max()):.0f} degrees of the "
            "sphere; at most 160 are mapped: use fewer cells or a larger radius"
        )
    block.moves.append(sphere_map(inner, 0.5 * extents[:2]))
    solid_angle = 4.0 * np.arcsin(np.sin(half[0]) * np.sin(half[1]))
    return float(solid_angle * (outer**3 - inner**3) / 3.0)


def fit_to_surface(keys: Parameters, surface: Surface) -> Parameters:
    """Return the keys with cells that cover the surface, if they give none: from a corner of cells at ``origin``.

    Along an axis whose grading is an expression the block begins at ``origin``, which must not be above the lower side
    of the surface. All ranks compute the same.

    Raises
    ------
    InputError
        For a pitch that takes too many cells, and an origin or an expression that does not fit the surface.
    """
    if keys.cells is not None:
        return keys
    cell, factors = cell_of_kind(keys), keys.grading or (1.0, 1.0, 1.0)
    low, high = surface.bounds
    origin = np.array(keys.origin if keys.origin is not None else low)
    start, count = origin.copy(), np.ones(3)
    for axis, factor in enumerate(factors):
        edge = keys.pitch * cell.edges[axis]
        if isinstance(factor, str):
            count[axis] = _graded_count(factor, axis, edge, (low, high), origin)
            continue
        first = np.floor((low[axis] - origin[axis]) / (edge * factor) + 1e-9)
        count[axis] = max(np.ceil((high[axis] - origin[axis]) / (edge * factor) - 1e-9) - first, 1.0)
        start[axis] += first * edge * factor
    limit = float(np.iinfo(np.int64).max) / 16.0
    size = f"a surface of {' x '.join(f'{length:.4g}' for length in high - low)} m"
    if keys.surface is not None and keys.surface.scale == 1.0:
        size += " (if its file is in millimetres, set mesh.surface.scale = 0.001)"
    if not (count < limit).all():
        raise InputError(f"mesh.pitch = {keys.pitch!r}: too small for {size}")
    check_size(
        int(np.prod([int(number) for number in count.tolist()], dtype=object)),
        f"mesh.pitch = {keys.pitch!r}, with cells that cover {size}",
    )
    cells = tuple((count.astype(np.int64) * np.array(cell.layers)).tolist())
    return keys.model_copy(update={"cells": cells, "origin": tuple(start.tolist())})


def _graded_count(factor: str, axis: int, edge: float, box: tuple[np.ndarray, np.ndarray], origin: np.ndarray) -> int:
    """Return the number of cells along an axis, from ``origin`` to the upper side of the surface."""
    name, (low, high) = COORDINATES[axis], box
    around = f"the surface is in the box from {_place(low)} to {_place(high)} m"
    if origin[axis] > low[axis] + 1e-9 * edge:
        raise InputError(
            f"mesh.grading[{axis}] = {factor!r}: an expression begins at mesh.origin, and the surface below it would "
            f"stay empty: {around}; use {name} = {low[axis]:.9g} or less in mesh.origin, or leave mesh.origin out"
        )
    try:
        return graded_count(float(high[axis] - origin[axis]), edge, Expression(factor, (name,)), name)
    except ValueError as error:
        raise InputError(
            f"mesh.grading[{axis}]: {error}; {around}, and {name} of the expression is measured from "
            f"{name} = {origin[axis]:.9g} m"
        ) from None


def _place(point: np.ndarray) -> str:
    return f"({', '.join(f'{x:.6g}' for x in point.tolist())})"


def longest_bar(block: Block, keys: Parameters) -> float:
    """Return a length [m] that no bar of the block exceeds."""
    edges = np.array([level if isinstance(level, float) else np.diff(level).max() for level in block.levels])
    length = float(np.linalg.norm(block.cell.vectors() / block.cell.edges * edges, axis=1).max())
    length += 2.0 * math.sqrt(3.0) * (keys.perturbation or 0.0) * keys.pitch
    if keys.curved is not None:
        # lines away from the inner side are longer, and those of x and y on a sphere are not at right angles
        length *= math.sqrt(2.0) * (1.0 + float(block.extents()[2]) / keys.curved.radius)
    return length * (1.0 + 1e-9)
