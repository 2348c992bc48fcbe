"""Rods for tests of energies and impulses, and their imbalances."""

from __future__ import annotations

import numpy as np

from pfem_petsc import Case

SCHEMES = [
    "central_differences",
    "chung_lee",
    "hulbert_chung",
    "newmark",
    "houbolt",
    "wilson",
    "generalized_alpha",
    "energy_momentum",
]
GRAVITY = 9.81
MIDDLE = [[0.2, -1.0, -1.0], [0.3, 1.0, 1.0]]


def case(integrator, *, step, steps, treatment="scheme", mass="lumped", mesh=None, walls=(), **more) -> Case:
    """Return the case of a rod, or of another mesh, with 1 kg/m."""
    return Case.from_dict(
        {
            "mesh": mesh or {"generator": "rod", "length": 1.0, "elements": 1},
            "material": {"default": {"young_modulus": 1e4, "density": 1.0}},
            "section": {"default": {"area": 1.0, "material": "default"}},
            "wall": [{"type": "plane", "name": f"wall{k}", **wall} for k, wall in enumerate(walls)],
            "contact": {"treatment": treatment},
            "time": {"integrator": integrator, "step": step, "end": step * steps, "mass": mass},
            "output": {"fields_every": 0},
            **more,
        }
    )


def unexplained(history) -> float:
    """Return the momentum not accounted for by impulses, relative to the largest impulse."""
    momentum = history["momentum"] - history["momentum"][0]
    names = [name for name in history if name.endswith(("_impulse", "/impulse"))]
    names = [name for name in names if not name.startswith("pair/")]  # they cancel
    left = momentum - sum(history[name] for name in names)
    return np.abs(left).max() / max(np.abs(history[name]).max() for name in names)


def floor(**more):
    """A wall below."""
    return {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], **more}
