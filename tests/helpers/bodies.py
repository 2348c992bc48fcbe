"""Two lattices that collide, with contact pairs between their faces, as a mesh file in any frame."""

import numpy as np
import pyvista as pv
from mpi4py import MPI

from pfem_petsc import Case
from pfem_petsc.mesh import load_slab

from .lattices import lattice_case


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
