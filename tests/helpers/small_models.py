"""Small models as cases: chains and rows of bars, arches, trusses counted by hand, blocks with stages."""

from __future__ import annotations

import numpy as np

from pfem_petsc import Case, write_mesh
from pfem_petsc.columns import HEAD


def case_of(tmp_path, comm, points, bars, fixed=(), **tables):
    """A case whose mesh is written to a file."""
    import h5py

    if comm.rank == 0:
        with h5py.File(tmp_path / "mesh.h5", "w") as file:
            file["points"], file["bars"] = np.asarray(points, dtype=float), np.asarray(bars)
    comm.Barrier()
    data = {
        "mesh": {"file": "mesh.h5"},
        "material": {"steel": {"young_modulus": 2.1e11, "density": 7850.0}},
        "section": {"default": {"area": 1e-4, "material": "steel"}},
        **tables,
    }
    if "static" not in tables and "stage" not in tables:
        data = {"time": {"integrator": "newmark", "step": 1e-4, "end": 1e-2}} | data
    if fixed:
        data["node_set"] = {"base": {"indices": list(fixed)}}
        data["support"] = [{"node_set": "base", "fix": "xyz"}]
    return Case.from_dict(data, source="truss.toml", folder=tmp_path)


SCHEMES = {
    "central_differences": {},
    "chung_lee": {},
    "souza_moura": {},
    "hulbert_chung": {"rho_b": 0.8},
    "noh_bathe": {},
    "newmark": {"beta": 0.25, "gamma": 0.5},
    "wilson": {},
    "houbolt": {},
    "generalized_alpha": {"rho_inf": 0.6},
    "hht_alpha": {},
    "bathe": {"rho_inf": 0.5},
    "energy_momentum": {},
}


def in_time(scheme, mass="lumped", step=1e-4, end=3e-3):
    """Tables of a run with an integrator."""
    return {"time": {"integrator": scheme, "step": step, "end": end, "mass": mass, **SCHEMES[scheme]}}


YOUNG, DENSITY, AREA = 1e9, 1000.0, 1e-4
SPEED = np.sqrt(YOUNG / DENSITY)
MATERIAL = {"young_modulus": YOUNG, "density": DENSITY}


def chain(folder, comm, elements, weak, limits, time, length=1.0, **tables):
    """A chain with its first node fixed; the bars with the numbers ``weak`` have the limits of rupture."""
    points = np.zeros((elements + 1, 3))
    points[:, 0] = np.linspace(0.0, length, elements + 1)
    bars = np.column_stack([np.arange(elements), np.arange(1, elements + 1)])
    groups = {"weak": np.array(weak, dtype=np.int64)}
    if comm.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
    comm.Barrier()
    write_mesh(folder / "chain.h5", points, bars, bar_groups=groups, comm=comm)
    data = {
        "mesh": {"file": "chain.h5"},
        "node_set": {"foot": {"indices": [0]}, "tip": {"indices": [elements]}},
        "material": {"it": MATERIAL, "weak": {**MATERIAL, "rupture": limits}},
        "section": {"it": {"area": AREA, "material": "it"}, "weak": {"area": AREA, "material": "weak", "bars": "weak"}},
        "support": [{"node_set": "foot", "fix": "xyz"}],
        "time": time,
        "output": {"fields_every": 0},
        **tables,
    }
    return Case.from_dict({k: v for k, v in data.items() if v is not None}, source="chain.toml", folder=folder)


ARCH_YOUNG, ARCH_AREA = 1e9, 1e-4
LIMIT = 2 * ARCH_YOUNG * ARCH_AREA * (1 - (1.0 / np.hypot(1.0, 0.1)) ** (2 / 3)) ** 1.5


def arch_of(folder, comm, tables, **more):
    """Half span 1 m, rise 0.1 m; the apex moves along z alone."""
    import h5py

    if comm.rank == 0:
        with h5py.File(folder / "mesh.h5", "w") as file:
            file["points"], file["bars"] = np.array([[-1.0, 0, 0], [0, 0, 0.1], [1.0, 0, 0]]), [[0, 1], [1, 2]]
    comm.Barrier()
    return Case.from_dict(
        {
            "mesh": {"file": "mesh.h5"},
            "node_set": {"feet": {"indices": [0, 2]}, "apex": {"indices": [1]}},
            "material": {"it": {"young_modulus": ARCH_YOUNG, "density": 1000.0}},
            "section": {"it": {"area": ARCH_AREA, "material": "it"}},
            "support": [{"node_set": "feet", "fix": "xyz"}, {"node_set": "apex", "fix": "xy"}],
            **tables,
            **more,
        },
        folder=folder,
    )


def press(part):
    """Tables of a load of a part of the limit load."""
    return {"load": [{"node_set": "apex", "force": [0.0, 0.0, -part * LIMIT]}], "static": {"step": 0.25}}


def von_mises(*overrides, method="arc_length", **static):
    """The two-bar truss of the built-in case, with other keys of ``[static]``."""
    case = Case.load("von_mises").to_dict()
    for key in ("constraint", "max_step", "min_step"):
        case["static"].pop(key, None)
    case["static"] |= {"method": method, **static}
    case["output"]["fields_every"] = 0
    return Case.from_dict(case, overrides=overrides)


def events(history):
    """Kind, load factor and displacement of each event."""
    return list(zip(history["event/kind"].tolist(), history["event/load_factor"], history["event/displacement"]))


CUBE = [[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)]
CUBE_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
TRUSSES = {
    # points, bars, fixed nodes; free unknowns, rigid motions, mechanisms, states of self-stress, unbraced nodes
    "triangle": ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [(0, 1), (1, 2), (2, 0)], [], (6, 3, 0, 0, 0)),
    "square": ([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [(0, 1), (1, 2), (2, 3), (3, 0)], [], (8, 3, 1, 0, 0)),
    "square, both diagonals": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)],
        [],
        (8, 3, 0, 1, 0),
    ),
    "square with a whip": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [3, 1, 0]],
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (2, 4)],
        [],
        (10, 3, 1, 0, 1),
    ),
    "hinged square": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)],
        [0, 1],
        (4, 0, 0, 1, 0),
    ),
    "tetrahedron": (
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1)],
        [],
        (12, 6, 0, 0, 0),
    ),
    "cube of edges": (CUBE, CUBE_EDGES, [], (24, 6, 6, 0, 0)),
    "tetrahedron, one bar short": (
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)],
        [],
        (12, 6, 1, 0, 2),
    ),
    "chain": ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [(0, 1), (1, 2)], [], (3, 1, 0, 0, 0)),
}


FLOOR = {"name": "floor", "type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
PLATE = {"name": "plate", "type": "plane", "point": [0.0, 0.0, 0.1], "normal": [0.0, 0.0, -1.0]}

BLOCK = {
    "mesh": {"generator": "lattice", "kind": "octet", "cells": [1, 1, 1], "pitch": 0.1},
    "node_set": {
        "centre": {"nearest": [0.0, 0.0, 0.0]},
        "base": {"box": [[-1, -1, -1e-3], [1, 1, 1e-3]]},
        "side": {"nearest": [0.1, 0.0, 0.0]},
    },
    "material": {
        "m": {
            "young_modulus": 7e9,
            "density": 2700.0,
            "yield_stress": 7e6,
            "kinematic_hardening": 7e8,
            "thermal_expansion": 1e-5,
        }
    },
    "section": {"s": {"area": 1e-6, "material": "m"}},
    "gravity": {"acceleration": [0.0, 0.0, -9.81]},
    "wall": [FLOOR],
    "support": [{"node_set": "centre", "fix": "xy"}, {"node_set": "side", "fix": "y"}],
    "output": {"fields_every": 5, "probe": [{"name": "side", "node_set": "side"}]},
    "stage": [
        {
            "name": "press",
            "wall": [FLOOR, {**PLATE, "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, -3e-4]]}],
            "static": {"step": 0.25},
        },
        {
            "name": "shake",
            "temperature": [{"table": [[0.0, 0.0], [1e-4, 20.0]]}],
            "time": {"integrator": "newmark", "step": 5e-6, "end": 6e-5},
        },
        {
            "name": "fly",
            "wall": [FLOOR],
            "support": [],
            "initial": {"velocity": [0.1, 0.0, 0.2]},
            "output": {"fields_every": 7, "history_every": 3},
            "time": {"integrator": "central_differences", "step": 1e-6, "end": 4e-5},
        },
        {
            "name": "settle",
            "support": [{"node_set": "base", "fix": "xyz"}],
            "static": {"step": 0.5},
        },
    ],
}
"""Pressed beyond yield between plates, heated between them, let go with a kick, and held; 4 + 12 + 40 + 2 steps."""


def check_balances(history: dict[str, np.ndarray], tolerance: float = 1e-9) -> None:
    """Energy is balanced over all stages, and momentum is what the impulses made of it."""
    scale = max(abs(history[name]).max() for name in ("elastic_energy", "kinetic_energy", "external_work"))
    assert abs(history["energy_imbalance"]).max() <= tolerance * scale
    impulses = sum(history[name] for name in HEAD.places if name.endswith("_impulse"))
    impulses = impulses + sum(
        history[name] for name in history if name.startswith("wall/") and name.endswith("impulse")
    )
    change = history["momentum"] - history["momentum"][0]
    made = impulses - impulses[0]
    scale = max(abs(impulses).max(), abs(change).max())
    assert abs(change - made).max() <= tolerance * scale


_PUSH = {"node_set": "apex", "force": [0.0, 0.0, -1000.0]}
_PATH = {"method": "arc_length", "step": 0.03, "node_set": "apex", "direction": [0.0, 0.0, -1.0]}
DOME = {
    "mesh": {"generator": "star_dome"},
    "node_set": {"apex": {"group": "apex"}, "feet": {"group": "feet"}},
    "material": {"m": {"young_modulus": 3.03e9, "density": 1000.0}},
    "section": {"s": {"area": 3.17e-4, "material": "m"}},
    "support": [{"node_set": "feet", "fix": "xyz"}],
    "output": {"fields_every": 5},
    "stage": [
        {"name": "path", "load": [_PUSH], "static": {**_PATH, "displacement": 0.009}},
        {"name": "free", "load": [], "time": {"integrator": "newmark", "step": 1e-4, "end": 1e-3}},
        {"name": "relax", "static": {"method": "relaxation", "step": 1.0}},
        {"name": "again", "load": [_PUSH], "static": {**_PATH, "displacement": 0.009}},
    ],
}
"""Pushed along its path over the limit point, let go, brought to rest, and pushed again."""
