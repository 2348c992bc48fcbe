"""From the keys of a lattice to one rank's part of its nodes and bars."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ...parallel.agreement import agreed, on_root
from ..slab import MeshSlab, check_length, index_type, slab_range
from .block import FACES, Block
from .cell import UnitCell
from .cutting import Cut, cut_block
from .expressions import Expression
from .keys import COORDINATES, checked_expression
from .kinds import ANGLE, KINDS, auxetic
from .mechanisms import mechanism_warning
from .numbering import Places
from .pruning import renumbered, without_dangling
from .shape import cylinder_map, graded_levels, perturbation, sphere_map
from .surface import Surface, read_surface

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..generators.lattice import Parameters

__all__ = ["build", "cell_of_kind", "field_values", "generate_block", "make_block"]


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


def build(keys: Parameters, comm: MPI.Comm, fields: Mapping[str, str], groups: Collection[str] | None) -> MeshSlab:
    """Return this rank's part; see :func:`~pfem_petsc.mesh.generators.lattice.generate_on`. Collective."""
    with agreed(comm):
        for name, key in fields.items():
            if name not in (keys.bar_fields or {}):
                known = ", ".join(keys.bar_fields or {}) or "none"
                raise InputError(f"{key} = {name!r}: mesh.bar_fields has no such field; it has {known}")
    surface, fitted = _surface(keys, comm), keys
    if surface is not None:
        with agreed(comm):
            fitted = fit_to_surface(keys, surface)
    with agreed(comm):
        block, volume = make_block(fitted, plain=not (keys.missing or surface))
        bare = block.has_bare_nodes()
    if not (keys.missing or surface or bare or keys.dangling == "remove"):
        with agreed(comm):
            return generate_block(keys, comm.rank, comm.size, fields, groups)
    cut = Cut(missing=keys.missing or 0.0, seed=keys.seed or 0, surface=surface)
    if keys.surface is not None:
        cut.clip, cut.shortest = keys.surface.cut == "clip", keys.surface.shortest
    kept, region = cut_block(block, cut, _longest(block, keys), comm)
    if keys.dangling == "remove" or (keys.dangling is None and (surface or keys.missing)):
        kept = without_dangling(kept, region, comm)
    if comm.allreduce(len(kept.bars)) == 0:
        what = "no strut is inside the surface; use a smaller pitch" if surface else "no strut is left"
        raise InputError(f"mesh: {what}")
    wanted = wanted_groups(block, groups)

    def memberships(places: Places) -> dict[str, np.ndarray]:
        return {name: mask for name, mask in block.groups_of(places).items() if name in wanted}

    def values(middles: np.ndarray) -> dict[str, np.ndarray]:
        return {name: field_values(keys, name, middles) for name in fields}

    slab = renumbered(
        block,
        kept,
        region,
        comm,
        lambda places: on_faces(block, places),
        memberships if wanted else None,
        values if fields else None,
        surface is not None,
    )
    slab.source, slab.warnings = f"generator lattice ({keys.kind})", mechanism_warning(keys.kind, block.cell)
    slab.volume = surface.volume if surface is not None else volume
    return slab


def _surface(keys: Parameters, comm: MPI.Comm) -> Surface | None:
    """Return the surface that the lattice fills, None without one. Collective."""
    if keys.surface is None:
        return None
    return on_root(comm, read_surface, Path(keys.surface.file), keys.surface.scale)


def fit_to_surface(keys: Parameters, surface: Surface) -> Parameters:
    """Return the keys with cells that cover the surface, if they give none: from a corner of cells at ``origin``.

    Raises
    ------
    InputError
        For a grading by expressions, which needs a place where it begins.
    """
    if keys.cells is not None:
        return keys
    if any(isinstance(factor, str) for factor in keys.grading or ()):
        raise InputError("mesh.grading: an expression needs mesh.cells, and mesh.origin where the block begins")
    cell = cell_of_kind(keys)
    edges = keys.pitch * cell.edges * np.array(keys.grading or (1.0, 1.0, 1.0))
    low, high = surface.bounds
    origin = np.array(keys.origin if keys.origin is not None else low)
    first = np.floor((low - origin) / edges + 1e-9)
    count = np.maximum(np.ceil((high - origin) / edges - 1e-9) - first, 1.0)
    limit = float(np.iinfo(np.int64).max) / 16.0
    if not (count < limit).all():
        raise InputError(f"mesh.pitch = {keys.pitch!r}: too small for a surface of {high - low} m")
    cells = tuple((count.astype(np.int64) * np.array(cell.layers)).tolist())
    return keys.model_copy(update={"cells": cells, "origin": tuple((origin + first * edges).tolist())})


def _longest(block: Block, keys: Parameters) -> float:
    """Return a length [m] that no bar of the block exceeds."""
    edges = np.array([level if isinstance(level, float) else np.diff(level).max() for level in block.levels])
    length = float(np.linalg.norm(block.cell.vectors() / block.cell.edges * edges, axis=1).max())
    length += 2.0 * math.sqrt(3.0) * (keys.perturbation or 0.0) * keys.pitch
    if keys.curved is not None:
        # lines away from the inner side are longer, and those of x and y on a sphere are not at right angles
        length *= math.sqrt(2.0) * (1.0 + float(block.extents()[2]) / keys.curved.radius)
    return length * (1.0 + 1e-9)


def generate_block(
    keys: Parameters,
    rank: int,
    size: int,
    fields: Collection[str] = (),
    groups: Collection[str] | None = None,
) -> MeshSlab:
    """Return a rank's part of a block of which nothing is left out, without messages."""
    block, volume = make_block(keys, plain=True)
    first_node, last_node = slab_range(block.nodes.total, rank, size)
    first_bar, last_bar = slab_range(block.bars.total, rank, size)
    points = np.empty((last_node - first_node, 3))
    faces: dict[str, list[np.ndarray]] = {name: [] for name in face_names(block)}
    for numbers, places in block.nodes.pieces(first_node, last_node):
        points[numbers[0] - first_node : numbers[-1] + 1 - first_node] = block.positions(numbers, places)
        for name, mask in on_faces(block, places).items():
            faces[name].append(numbers[mask])
    bars = np.empty((last_bar - first_bar, 2), index_type(block.nodes.total))
    wanted = wanted_groups(block, groups)
    members: dict[str, list[np.ndarray]] = {name: [] for name in wanted}
    values = {name: np.empty(len(bars)) for name in fields}
    for numbers, places in block.bars.pieces(first_bar, last_bar):
        here = slice(numbers[0] - first_bar, numbers[-1] + 1 - first_bar)
        ends = [block.end(places, which) for which in (0, 1)]
        bars[here, 0], bars[here, 1] = ends[0][0], ends[1][0]
        if wanted:
            for name, mask in block.groups_of(places).items():
                members[name].append(numbers[mask])
        if fields:
            middles = 0.5 * (block.positions(*ends[0]) + block.positions(*ends[1]))
            for name in fields:
                values[name][here] = field_values(keys, name, middles)
    return MeshSlab(
        n_nodes=block.nodes.total,
        n_bars=block.bars.total,
        first_node=first_node,
        points=points,
        first_bar=first_bar,
        bars=bars,
        node_groups=_joined(faces),
        bar_groups=_joined(members),
        bar_fields=values,
        source=f"generator lattice ({keys.kind})",
        structured=True,
        warnings=mechanism_warning(keys.kind, block.cell),
        volume=volume,
    )


def face_names(block: Block) -> list[str]:
    """Return the names of the node groups of faces: z, x, y; a closed block has none along x."""
    return [name for axis in (2, 0, 1) if not (axis == 0 and block.closed) for name in FACES[axis]]


def on_faces(block: Block, places: Places) -> dict[str, np.ndarray]:
    """Return which nodes (n,) are in each node group of faces."""
    names = face_names(block)
    faces = {name: (axis, upper) for axis, pair in enumerate(FACES) for upper, name in enumerate(pair)}
    return {name: block.on_face(places, faces[name][0], bool(faces[name][1])) for name in names}


def wanted_groups(block: Block, groups: Collection[str] | None) -> list[str]:
    """Return the bar groups to make: none, if none of those asked for is a bar group here."""
    known = list(block.cell.groups) + ["skin"] * bool(block.cell.skin)
    # a name that is not known may be misspelt: the message about it lists them all
    return known if groups is None or any(name not in FACE_NAMES for name in groups) else []


FACE_NAMES = tuple(name for pair in FACES for name in pair)


def field_values(keys: Parameters, name: str, middles: np.ndarray) -> np.ndarray:
    """Return the values (n,) of a cell field at the middles (n, 3) [m] of bars.

    Raises
    ------
    InputError
        If the expression has no finite value somewhere.
    """
    text = (keys.bar_fields or {})[name]
    values = checked_expression(text)(dict(zip(COORDINATES, middles.T)))
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        where = ", ".join(f"{x:.6g}" for x in middles[bad[0]])
        raise InputError(f"mesh.bar_fields.{name} = {text!r} has no finite value at ({where}) m")
    return values


def _joined(parts: dict[str, list[np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([np.empty(0, np.int64), *some]) for name, some in parts.items()}
