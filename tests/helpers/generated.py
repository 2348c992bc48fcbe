"""Meshes of the lattice generator, lengths of their struts and degrees of their nodes; a cube as a surface."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from pfem_petsc.mesh.generators import lattice


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
