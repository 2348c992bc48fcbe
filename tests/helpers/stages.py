"""A small block with all kinds of stages, and what is checked of the history of any case with stages."""

from __future__ import annotations

import numpy as np

from pfem_petsc.columns import HEAD

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
