"""Rods that slide on an inclined plane, and lattices that tumble onto walls with friction."""

import numpy as np

from helpers.lattices import lattice_case, simulation

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
