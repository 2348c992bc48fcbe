"""Two level bars, one on the other: bodies whose nodes all do the same."""

from __future__ import annotations

import numpy as np

from pfem_petsc import Case, Simulation
from pfem_petsc.mesh.generators.arrays import Truss

G = 9.81
AREAS = np.array([1e-5, 3e-5])  # of the lower and the upper body, whose masses are as these


def case_points(heights=(0.0, 0.01)):
    x = np.array([0.0, 0.1, 0.2])
    return np.concatenate([np.column_stack([x, 0.0 * x, z + 0.0 * x]) for z in heights])


def bodies(
    comm,
    integrator="central_differences",
    *,
    gravity=(0.0, 0.0, -G),
    heights=(0.0, 0.01),
    end=0.1,
    pair=None,
    pairs=True,
    on=None,
    parameters=None,
    **tables,
):
    """Two level bars of three nodes, one on the other along z; all nodes of a body do the same."""
    mesh = Truss(
        case_points(heights),
        [[0, 1], [1, 2], [3, 4], [4, 5]],
        node_groups={"lower": [0, 1, 2], "upper": [3, 4, 5]},
        bar_groups={"first": [0, 1], "second": [2, 3]},
    )
    case = {
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {
            "s": {"area": AREAS[0], "material": "m", "bars": "first"},
            "t": {"area": AREAS[1], "material": "m", "bars": "second"},
        },
        "node_set": {
            "lower": {"group": "lower"},
            "upper": {"group": "upper"},
            "lower_end": {"indices": [0, 2]},
            "lower_middle": {"indices": [1]},
            "upper_end": {"indices": [3, 5]},
            "upper_middle": {"indices": [4]},
        },
        "initial": {"on": [{"node_set": name, "velocity": velocity} for name, velocity in (on or {}).items()]},
        "gravity": {"acceleration": list(gravity)},
        "contact_pair": [
            {
                "name": "faces",
                "first": "lower",
                "second": "upper",
                "direction": [0.0, 0.0, 1.0],
                "gap": 0.01,
                **(pair or {}),
            }
        ]
        if pairs
        else [],
        "time": {"integrator": integrator, "step": 1e-3, "end": end, **(parameters or {})},
        "output": {"fields_every": 0},
        **tables,
    }
    return Case({key: value for key, value in case.items() if value is not None}, mesh=mesh)


HELD = {"support": [{"node_set": "lower", "fix": "xyz"}]}
MASSES = 1000.0 * 0.2 * AREAS


def rows_of(case, comm, folder, name="result"):
    run = Simulation(case, comm, output=folder / name, quiet=True)
    return [step.row for step in run], run


def upper(run):
    """Motion of the upper body: positions and velocities (3, 3)."""
    x, v = run.gather(run.state.position), run.gather(run.state.v)
    return run.comm.bcast((x[3:], v[3:]) if run.comm.rank == 0 else None)
