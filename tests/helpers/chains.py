"""Chains of bars along x with groups of bars, as mesh files."""

from __future__ import annotations

import numpy as np

from pfem_petsc import Case, write_mesh

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
