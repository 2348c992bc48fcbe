"""Bodies that collide and slide: lattices, rods that meet, in any frame, and walls for them."""

from __future__ import annotations

import copy

import numpy as np
import pyvista as pv
from mpi4py import MPI

from pfem_petsc import Case, Simulation
from pfem_petsc.mesh import load_slab


def rotation(seed):
    """A random proper rotation (3, 3)."""
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return matrix * np.sign(np.linalg.det(matrix))


def lattice_case(
    walls,
    *,
    velocity=(0.0, 0.0, 0.0),
    spin=(0.0, 0.0, 0.0),
    integrator="central_differences",
    step=2e-4,
    end=0.02,
    cells=(2, 1, 1),
    material=None,
    supports=(),
    gravity=None,
    **tables,
):
    """An octet lattice of pitch 0.1 m with its corner at the origin; wave speed 31.6 m/s."""
    case = {
        "mesh": {"generator": "lattice", "kind": "octet", "cells": list(cells), "pitch": 0.1},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0, **(material or {})}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "initial": {"velocity": list(velocity), "angular_velocity": list(spin)},
        "wall": walls,
        "time": {"integrator": integrator, "step": step, "end": end},
        "output": {"fields_every": 0},
        "support": list(supports),
        **tables,
    }
    if gravity is not None:
        case["gravity"] = {"acceleration": list(gravity)}
    return case


def simulation(case, comm, folder, name="result"):
    """A quiet simulation of a case dictionary."""
    return Simulation(Case.from_dict(case, name=name), comm, output=folder / name, quiet=True)


def planes(normals, offsets, **keys):
    """Plane walls n . x >= d."""
    walls = []
    for normal, offset in zip(normals, offsets, strict=True):
        normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
        walls.append({"type": "plane", "point": (offset * normal).tolist(), "normal": normal.tolist(), **keys})
    return walls


def box(low, high):
    """Six planes."""
    normals = np.vstack([np.eye(3), -np.eye(3)])
    return planes(normals, [*low, *(-np.asarray(high))])


def two_lattices(
    file,
    integrator,
    *,
    turn=None,
    step=2e-4,
    end=0.02,
    direction=(1.0, 0.1, -0.2),
    velocity=(2.0, 0.3, -0.2),
    cells=(1, 2, 2),
    **tables,
):
    """Octet lattices of pitch 0.1 m, shaken, 3 mm apart; the direction of their pairs is oblique to their faces."""
    turn = np.eye(3) if turn is None else turn
    slab = load_slab(Case.from_dict(lattice_case([], cells=cells)).mesh, MPI.COMM_SELF)
    one, n = slab.points, len(slab.points)
    points = np.vstack([one, one + [0.103, 0.0, 0.0]])
    points += 1e-3 * np.random.default_rng(3).uniform(-1.0, 1.0, points.shape)
    if MPI.COMM_WORLD.rank == 0:
        bars = np.vstack([slab.bars, slab.bars + n])
        cells = np.column_stack([np.full(len(bars), 2), bars]).ravel()
        pv.UnstructuredGrid(cells, np.full(len(bars), pv.CellType.LINE), points @ turn.T).save(file)
    MPI.COMM_WORLD.Barrier()
    case = lattice_case(
        [],
        velocity=(turn @ velocity).tolist(),
        spin=(turn @ [5.0, -3.0, 8.0]).tolist(),
        integrator=integrator,
        step=step,
        end=end,
        **tables,
    )
    case["mesh"] = {"file": str(file)}
    case["node_set"] = {
        "left": {"indices": np.flatnonzero(np.abs(one[:, 0] - 0.1) < 1e-9).tolist()},
        "right": {"indices": (n + np.flatnonzero(np.abs(one[:, 0]) < 1e-9)).tolist()},
        "second": {"indices": list(range(n, 2 * n))},
        "held": {"indices": [int(np.flatnonzero(np.abs(one[:, 0] - 0.1) < 1e-9)[2])]},
        "hinged": {"indices": [n + int(np.flatnonzero(np.abs(one[:, 0]) < 1e-9)[1])]},
    }
    other = {"velocity": (turn @ [-2.5, 0.0, 0.4]).tolist(), "angular_velocity": (turn @ [1.0, 2.0, 3.0]).tolist()}
    case["initial"]["on"] = [{"node_set": "second", **other}]
    pair = {"name": "faces", "first": "left", "second": "right", "direction": (turn @ direction).tolist()}
    case["contact_pair"] = [pair]
    return case


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


G = 9.81
SCHEMES = [
    ("newmark", {}),
    ("houbolt", {}),
    ("generalized_alpha", {"rho_inf": 0.0}),
    ("wilson", {"theta": 1.8}),
    ("energy_momentum", {}),
    ("central_differences", {"mass": "consistent"}),
    ("newmark", {"mass": "consistent"}),
]


def rod(
    integrator, parameters, friction, *, velocity=(0.0, 0.0, 0.0), angle=0.0, height=0.0, step=1e-3, end=0.1, **keys
):
    """A rod across a plane that is inclined along x, in axes of the plane: all its nodes do the same."""
    floor = {"type": "plane", "name": "floor", "point": [0, 0, -height], "normal": [0, 0, 1.0], "friction": friction}
    return {
        "mesh": {"generator": "rod", "length": 0.2, "elements": 3},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "initial": {"velocity": list(velocity)},
        "gravity": {"acceleration": [0.0, G * np.sin(angle), -G * np.cos(angle)]},
        "contact": keys.pop("contact", {}),
        "wall": [floor | keys],
        "time": {"integrator": integrator, "step": step, "end": end, **parameters},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-13},
    }


def rows_of(case, comm, folder, name="result"):
    run = simulation(case, comm, folder, name)
    return [step.row for step in run], run


def tumbling(walls, integrator, parameters, step=1e-3, end=0.05, **tables):
    case = lattice_case(
        walls,
        velocity=[1.0, -0.5, -3.0],
        spin=[10.0, 20.0, -15.0],
        integrator=integrator,
        step=step,
        end=end,
        gravity=[0.0, 0.0, -100.0],
        **{"solver": {"rtol": 1e-12}, **tables},
    )
    case["time"] |= parameters
    return case


TRAPEZOID = {"integrator": "newmark", "beta": 0.25, "gamma": 0.5}
DIRECTION = [2.0, 0.0, 0.0]


def two_rods(integrator="central_differences", linear="auto", **pair):
    """Equal rods that fly at each other; wave speed 1, gap 0.1."""
    return {
        "mesh": {"generator": "two_rods", "length": 1.0, "elements": 10, "gap": 0.1},
        "node_set": {
            "left": {"group": "first_end"},
            "right": {"group": "second_start"},
            "second": {"box": [[1.05, -1, -1], [3, 1, 1]]},
        },
        "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "initial": {"velocity": [0.1, 0, 0], "on": [{"node_set": "second", "velocity": [-0.1, 0, 0]}]},
        "contact_pair": [{"name": "faces", "first": "left", "second": "right", "direction": DIRECTION, **pair}],
        "time": {"integrator": integrator, "step": 0.02, "end": 4.0},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-13, "linear": linear},
    }


def half():
    case = two_rods()
    case["mesh"] = {"generator": "rod", "length": 1.0, "elements": 10}
    case["node_set"] = {"left": {"group": "end"}}
    case["initial"] = {"velocity": [0.1, 0, 0]}
    del case["contact_pair"]
    case["wall"] = [
        {"type": "plane", "name": "symmetry", "point": [1.05, 0, 0], "normal": [-1.0, 0, 0], "node_set": "left"}
    ]
    return case
