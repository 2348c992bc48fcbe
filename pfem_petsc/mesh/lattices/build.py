"""From the keys of a lattice to one rank's part of its nodes and bars."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ...parallel.agreement import agreed, on_root
from ..slab import MeshSlab, index_type, slab_range
from .block import FACES, Block
from .cutting import Cut, cut_block
from .fields import Fields
from .making import fit_to_surface, longest_bar, make_block
from .mechanisms import mechanism_warning
from .numbering import Places
from .pruning import renumbered, without_dangling
from .surface import Surface
from .surface_files import read_surface

if TYPE_CHECKING:
    from mpi4py import MPI

    from ..generators.lattice import Parameters

__all__ = ["build", "generate_block"]


def build(keys: Parameters, comm: MPI.Comm, fields: Mapping[str, str], groups: Collection[str] | None) -> MeshSlab:
    """Return this rank's part; see :func:`~pfem_petsc.mesh.generators.lattice.generate_on`. Collective."""
    with agreed(comm):
        for name, key in fields.items():
            if name not in (keys.bar_fields or {}):
                known = ", ".join(keys.bar_fields or {}) or "none"
                raise InputError(f"{key} = {name!r}: mesh.bar_fields has no such field; it has {known}")
    surface, expressions = _surface(keys, comm), Fields(keys)
    with agreed(comm):
        fitted = fit_to_surface(keys, surface) if surface is not None else keys
        partial = bool(keys.missing or surface or keys.keep is not None)
        block, volume = make_block(fitted, plain=not partial)
        bare = block.has_bare_nodes()
        if keys.map is not None:
            block.moves.append(expressions.mapped)
            _try_places(block, comm.rank, comm.size)
    if not (partial or bare or keys.dangling == "remove"):
        with agreed(comm):
            try:
                return _generated(keys, block, volume, comm.rank, comm.size, fields, groups)
            except MemoryError:
                raise InputError("mesh: the lattice does not fit in this machine's memory") from None
    cut = Cut(missing=keys.missing or 0.0, seed=keys.seed or 0, surface=surface)
    if keys.surface is not None:
        cut.clip, cut.shortest = keys.surface.cut == "clip", keys.surface.shortest
    if keys.keep is not None:
        cut.keep = expressions.kept
    longest = longest_bar(block, keys) if keys.map is None else _longest_of_all(block, comm)
    kept, region = cut_block(block, cut, longest, comm)
    if keys.dangling == "remove" or (keys.dangling is None and partial):
        kept = without_dangling(kept, region, comm)
    if comm.allreduce(len(kept.bars)) == 0:
        remedy = "use a smaller pitch" if surface else 'use more cells, leave out less, or dangling = "keep"'
        raise InputError(f"mesh: no strut is {'inside the surface' if surface else 'left'}; {remedy}")
    wanted = wanted_groups(block, groups)

    def memberships(places: Places) -> dict[str, np.ndarray]:
        return {name: mask for name, mask in block.groups_of(places).items() if name in wanted}

    def values(middles: np.ndarray) -> dict[str, np.ndarray]:
        return {name: expressions.of_bars(name, middles) for name in fields}

    slab = renumbered(
        block,
        kept,
        region,
        comm,
        lambda places: on_faces(block, places),
        memberships if wanted else None,
        values if fields else None,
        surface is not None or keys.keep is not None,
    )
    slab.source, slab.warnings = f"generator lattice ({keys.kind})", mechanism_warning(keys.kind, block.cell)
    slab.structured = keys.map is None
    if keys.keep is None and keys.map is None:  # else it is not known what the lattice fills
        slab.volume = surface.volume if surface is not None else volume
    return slab


def _try_places(block: Block, rank: int, size: int) -> None:
    """Compute the positions of this rank's nodes, so that what cannot be computed is found before anything is sent."""
    for numbers, places in block.nodes.pieces(*slab_range(block.nodes.total, rank, size)):
        block.positions(numbers, places)


def _longest_of_all(block: Block, comm: MPI.Comm) -> float:
    """Return a length [m] that no bar exceeds, from all bars. Collective."""
    longest = 0.0
    for _, places in block.bars.pieces(*slab_range(block.bars.total, comm.rank, comm.size)):
        one, two = (block.positions(*block.end(places, which)) for which in (0, 1))
        longest = max(longest, float(np.linalg.norm(two - one, axis=1).max()))
    return max(comm.allgather(longest)) * (1.0 + 1e-9)


def _surface(keys: Parameters, comm: MPI.Comm) -> Surface | None:
    """Return the surface that the lattice fills, None without one. Collective."""
    if keys.surface is None:
        return None
    return on_root(comm, read_surface, Path(keys.surface.file), keys.surface.scale)


def generate_block(keys: Parameters, rank: int, size: int) -> MeshSlab:
    """Return a rank's part of a block of which nothing is left out, without messages."""
    block, volume = make_block(keys, plain=True)
    if keys.map is not None:
        block.moves.append(Fields(keys).mapped)
    return _generated(keys, block, volume, rank, size, (), None)


def _generated(
    keys: Parameters,
    block: Block,
    volume: float,
    rank: int,
    size: int,
    fields: Collection[str],
    groups: Collection[str] | None,
) -> MeshSlab:
    expressions = Fields(keys)
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
                values[name][here] = expressions.of_bars(name, middles)
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
        structured=keys.map is None,  # a map may make nodes of a bar meet
        warnings=mechanism_warning(keys.kind, block.cell),
        volume=volume if keys.map is None else None,
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
    return known if groups is None or any(name not in NODE_GROUPS for name in groups) else []


NODE_GROUPS = ("surface", *(name for pair in FACES for name in pair))


def _joined(parts: dict[str, list[np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([np.empty(0, np.int64), *some]) for name, some in parts.items()}
