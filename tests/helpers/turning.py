"""The same problem in a rotated frame: mesh, velocities and walls are rotated together."""

import copy

import numpy as np
import pyvista as pv
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.mesh import load_slab


def with_mesh_file(case, file, turn=None, shake=0.0):
    """Return the case with its mesh in a file, nodes perturbed by ``shake`` [m], and everything rotated by ``turn``."""
    turn = np.eye(3) if turn is None else turn
    slab = load_slab(Case.from_dict(case).mesh, MPI.COMM_SELF)
    points = slab.points + shake * np.random.default_rng(1).uniform(-1.0, 1.0, slab.points.shape)
    case = copy.deepcopy(case)
    for name, chosen in case.get("node_set", {}).items():
        case["node_set"][name] = {"indices": _indices(chosen, points)}
    if MPI.COMM_WORLD.rank == 0:
        cells = np.column_stack([np.full(len(slab.bars), 2), slab.bars]).ravel()
        kinds = np.full(len(slab.bars), pv.CellType.LINE)
        pv.UnstructuredGrid(cells, kinds, points @ turn.T).save(file)
    MPI.COMM_WORLD.Barrier()
    case["mesh"] = {"file": str(file)}
    tables = [case.get("initial", {}), *case.get("initial", {}).get("on", []), case.get("gravity", {})]
    for table in [*tables, *case.get("wall", []), *case.get("load", [])]:
        for key in (
            "velocity",
            "angular_velocity",
            "centre",
            "acceleration",
            "point",
            "normal",
            "axis",
            "along",
            "force",
        ):
            if key in table:
                table[key] = (turn @ np.array(table[key])).tolist()
    for wall in case.get("wall", []):
        if "motion" in wall:
            wall["motion"] = [[row[0], *(turn @ np.array(row[1:]))] for row in wall["motion"]]
    return case


def _indices(chosen, points):
    if "nearest" in chosen:
        return [int(np.argmin(np.linalg.norm(points - np.array(chosen["nearest"]), axis=1)))]
    if "box" in chosen:
        low, high = np.array(chosen["box"])
        return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)).tolist()
    return chosen["indices"]
