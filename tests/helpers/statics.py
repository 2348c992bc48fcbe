"""The shallow arch of two bars under a static load."""

import numpy as np

from pfem_petsc import Case

__all__ = ["ARCH_AREA", "ARCH_YOUNG", "LIMIT", "arch_of", "press"]

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
