"""Cases of a few bars whose mesh is in a file."""

import numpy as np

from pfem_petsc import Case


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
