"""Meshes of the lattice generator, and whole meshes assembled from the parts of all ranks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from pfem_petsc.mesh.generators import lattice
from pfem_petsc.mesh.slab import MeshSlab, slab_range
from pfem_petsc.mesh.whole import check_mesh


def whole(slab: MeshSlab, comm: MPI.Comm) -> MeshSlab:
    """Return the mesh of all slabs on every rank."""

    def joined(parts: np.ndarray) -> np.ndarray:
        return np.concatenate(comm.allgather(parts))

    return MeshSlab(
        n_nodes=slab.n_nodes,
        n_bars=slab.n_bars,
        first_node=0,
        points=joined(slab.points),
        first_bar=0,
        bars=joined(slab.bars).astype(np.int64),
        node_groups={name: joined(members) for name, members in slab.node_groups.items()},
        bar_groups={name: joined(members) for name, members in slab.bar_groups.items()},
        source=slab.source,
        structured=slab.structured,
        warnings=slab.warnings,
    )


def assert_part_of(slab: MeshSlab, alone: MeshSlab, comm: MPI.Comm) -> MeshSlab:
    """Check that the slabs of all ranks are the sound mesh that one rank makes alone; return that of all."""
    mesh = whole(slab, comm)
    assert (mesh.n_nodes, mesh.n_bars) == (len(mesh.points), len(mesh.bars))
    np.testing.assert_array_equal(mesh.points, alone.points)
    np.testing.assert_array_equal(mesh.bars, alone.bars)
    for found, expected in ((mesh.node_groups, alone.node_groups), (mesh.bar_groups, alone.bar_groups)):
        assert list(found) == list(expected)
        for name, members in expected.items():
            np.testing.assert_array_equal(np.sort(found[name]), members)
    for name, values in alone.bar_fields.items():
        np.testing.assert_array_equal(np.concatenate(comm.allgather(slab.bar_fields[name])), values)
    assert check_mesh(replace(slab, structured=False, warnings=[]), comm) == []
    return mesh


def slab_from(
    points: np.ndarray,
    bars: np.ndarray,
    comm: MPI.Comm,
    node_groups: dict[str, list[int]] | None = None,
    bar_groups: dict[str, list[int]] | None = None,
) -> MeshSlab:
    """Return this rank's slab of a small mesh that every rank has."""
    points, bars = np.asarray(points, dtype=float).reshape(-1, 3), np.asarray(bars, dtype=np.int64).reshape(-1, 2)
    nodes = slab_range(len(points), comm.rank, comm.size)
    edges = slab_range(len(bars), comm.rank, comm.size)

    def members(groups: dict[str, list[int]] | None, first: int, last: int) -> dict[str, np.ndarray]:
        arrays = {name: np.array(sorted(numbers), dtype=np.int64) for name, numbers in (groups or {}).items()}
        return {name: numbers[(numbers >= first) & (numbers < last)] for name, numbers in arrays.items()}

    return MeshSlab(
        n_nodes=len(points),
        n_bars=len(bars),
        first_node=nodes[0],
        points=points[slice(*nodes)],
        first_bar=edges[0],
        bars=bars[slice(*edges)],
        node_groups=members(node_groups, *nodes),
        bar_groups=members(bar_groups, *edges),
        source="test mesh",
    )


def every_node(model, values: np.ndarray) -> np.ndarray:
    """Return values of owned nodes (owned, 3) for all nodes in the numbering of the mesh, on every rank."""
    mesh = model.mesh
    found = np.zeros((mesh.n_nodes, 3))
    found[mesh.node_ids[: mesh.n_owned]] = values
    return model.comm.allreduce(found)


def stiffness_modes(points: np.ndarray, bars: np.ndarray) -> int:
    """Return the number of motions that stretch no bar: 6 for a braced, unsupported space truss."""
    direction = points[bars[:, 1]] - points[bars[:, 0]]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    stretch = np.zeros((len(bars), len(points), 3))
    stretch[np.arange(len(bars)), bars[:, 0]] = -direction
    stretch[np.arange(len(bars)), bars[:, 1]] = direction
    return 3 * len(points) - np.linalg.matrix_rank(stretch.reshape(len(bars), -1), tol=1e-8)


def generated(comm=MPI.COMM_SELF, fields=(), **keys):
    """The mesh of a lattice with these keys, on the ranks of a communicator."""
    keys = {"pitch": 0.2} | keys
    return lattice.generate_on(lattice.Parameters(**keys), comm, dict.fromkeys(fields, "section.s"), None)


def lengths(mesh):
    """Lengths (bars,)."""
    return np.linalg.norm(mesh.points[mesh.bars[:, 1]] - mesh.points[mesh.bars[:, 0]], axis=1)


def degrees(mesh):
    """Numbers of bars (nodes,) of each node."""
    return np.bincount(mesh.bars.ravel(), minlength=mesh.n_nodes)


OCTET = {
    # corners and face centres of the cube, each given on every side
    "points": [
        *[[i, j, k] for i in (0.0, 1.0) for j in (0.0, 1.0) for k in (0.0, 1.0)],
        *([0.5, 0.5, 0.0], [0.5, 0.5, 1.0], [0.5, 0.0, 0.5], [0.5, 1.0, 0.5], [0.0, 0.5, 0.5], [1.0, 0.5, 0.5]),
    ],
}
OCTET["struts"] = [
    [p, q]
    for p in range(14)
    for q in range(p)
    if abs(np.linalg.norm(np.subtract(OCTET["points"][p], OCTET["points"][q])) - np.sqrt(0.5)) < 1e-9
]

CORNERS = np.array([(i, j, k) for i in (0.0, 1.0) for j in (0.0, 1.0) for k in (0.0, 1.0)])
CUBE = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4)]
    + [(1, 5, 7), (1, 7, 3)]
)


def write_stl(path, points, triangles):
    """Write triangles of points (n, 3) as text; the path."""
    corners = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in points[list(triangle)])
        + "endloop\nendfacet\n"
        for triangle in triangles
    )
    path.write_text(f"solid s\n{corners}endsolid s\n")
    return path


def filled(comm=MPI.COMM_SELF, **keys):
    """The mesh of a lattice of octet cells, which fills a surface."""
    keys = {"kind": "octet", "pitch": 0.25} | keys
    return lattice.generate_on(lattice.Parameters(**keys), comm, {}, None)
