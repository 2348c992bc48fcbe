"""Writes a mesh for all codes, in the order of nodes and bars in which this program has it on one rank.

usage: make_mesh.py KIND BARS FOLDER; octet lattices, those with cells that grow along z or with moved nodes, and the
edges of Delaunay's tetrahedra of random points, without the longest ones. FOLDER/mesh.npz is for the peers, mesh.json
is the table of the mesh for this program.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import model as m
import numpy as np

from pfem_petsc import Case, Simulation, Truss
from pfem_petsc.bench import cells_for

LATTICES = {"octet": {}, "graded": {"grading": [1, 1, "1 + 5*z"]}, "disordered": {"perturbation": 0.2}}


def irregular(bars: int) -> Truss:
    """About as many bars; the nodes near the lower and the upper side are put on it."""
    from scipy.spatial import Delaunay

    nodes = max(round(bars / 7.42), 8)
    edge = m.PITCH * (nodes / 0.99) ** (1.0 / 3.0)
    points = np.random.default_rng(1).random((nodes, 3)) * edge
    z = points[:, 2]
    z[z < 0.5 * m.PITCH], z[z > edge - 0.5 * m.PITCH] = 0.0, edge
    corners = Delaunay(points).simplices
    ends = np.concatenate([corners[:, [i, j]] for i in range(4) for j in range(i)])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    lengths = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
    return Truss(points, ends[lengths < np.quantile(lengths, 0.97)])


def main() -> None:
    """Make it by this program, and write it."""
    kind, bars, folder = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
    if kind == "irregular":
        mesh = {"file": str(irregular(bars).write(folder / "mesh.h5"))}
    else:
        cells = [cells_for("octet", bars)] * 3
        mesh = {"generator": "lattice", "kind": "octet", "cells": cells, "pitch": m.PITCH, **LATTICES[kind]}
    strut = {"young_modulus": m.YOUNG_MODULUS, "density": m.DENSITY}
    tables = {"material": {"strut": strut}, "section": {"strut": {"area": m.AREA, "material": "strut"}}}
    scheme = {"integrator": "central_differences", "step": m.EXPLICIT_STEP, "end": m.EXPLICIT_STEP}
    case = Case({**tables, "mesh": mesh, "time": scheme}, name="mesh")
    with Simulation(case, output=folder / "none", quiet=True, check_only=True) as simulation:
        points, ends = simulation.mesh.points, simulation.mesh.bars
    np.savez(folder / "mesh.npz", points=points, bars=ends)
    (folder / "mesh.json").write_text(json.dumps(mesh), encoding="utf-8")


main()
