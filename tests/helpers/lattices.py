"""Small trusses and walls for the contact tests, as case dictionaries, and how to run them."""

import numpy as np

from pfem_petsc import Case, Simulation


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
