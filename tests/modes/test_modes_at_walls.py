"""Walls that press on nodes hold them; curved ones change the stiffness."""

from __future__ import annotations

import numpy as np
import pytest

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import SimulationFailure
from pfem_petsc.output.result import open_result

YOUNG, DENSITY, AREA = 1e6, 1000.0, 1e-4
STIFF, MASS = YOUNG * AREA, 2 * 0.5 * DENSITY * AREA  # of a bar of 1 m [N/m], of the node that has two [kg]


def corner(folder, comm, wall, force, **tables):
    """A node at the origin with bars along x and z to fixed nodes, which does not move along y, pressed on a wall."""
    import h5py

    if comm.rank == 0:
        with h5py.File(folder / "mesh.h5", "w") as file:
            file["points"], file["bars"] = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]), [[0, 1], [0, 2]]
    comm.Barrier()
    return Case.from_dict(
        {
            "mesh": {"file": "mesh.h5"},
            "node_set": {"ends": {"indices": [1, 2]}, "node": {"indices": [0]}},
            "material": {"it": {"young_modulus": YOUNG, "density": DENSITY}},
            "section": {"it": {"area": AREA, "material": "it"}},
            "support": [{"node_set": "ends", "fix": "xyz"}, {"node_set": "node", "fix": "y"}],
            "load": [{"node_set": "node", "force": force}],
            "wall": [wall],
            "static": {"step": 1.0},
            "modes": {"count": 5},
            **tables,
        },
        folder=folder,
    )


def eigenvalues(case, folder, comm):
    assert Simulation(case, comm, output=folder, quiet=True).run() == 0
    return comm.bcast((lambda m: (m.eigenvalue, m.shape))(open_result(folder).modes) if comm.rank == 0 else None)


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_plane(angle, shared_tmp_path, comm):
    """The node slides along the plane: (k t t) with the tangent t."""
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    wall = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": normal.tolist()}
    case = corner(shared_tmp_path, comm, wall, (-10.0 * normal).tolist())
    values, shape = eigenvalues(case, shared_tmp_path / "out", comm)
    assert values == pytest.approx([STIFF / MASS], rel=1e-9)
    assert np.abs(shape[0, 0] @ normal) < 1e-12 * np.abs(shape).max()
    assert np.linalg.norm(shape[0, 0]) == pytest.approx(1.0 / np.sqrt(MASS), rel=1e-12)


def test_a_wall_that_does_not_press_holds_nothing(shared_tmp_path, comm):
    wall = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
    case = corner(shared_tmp_path, comm, wall, [0.0, 0.0, 0.0])
    values, _ = eigenvalues(case, shared_tmp_path / "out", comm)
    assert values == pytest.approx([STIFF / MASS] * 2, rel=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize(("side", "sign"), [("outside", -1.0), ("inside", 1.0)])
def test_sphere(side, sign, shared_tmp_path, comm):
    """On top of a ball the force of the wall pushes the node further off, F/R; in a bowl it brings it back."""
    radius, force = 0.5, 20.0
    wall = {"type": "sphere", "point": [0.0, 0.0, sign * radius], "radius": radius, "side": side}
    wall["node_set"] = "node"
    case = corner(shared_tmp_path, comm, wall, [0.0, 0.0, -force])
    values, shape = eigenvalues(case, shared_tmp_path / "out", comm)
    assert values == pytest.approx([(STIFF + sign * force / radius) / MASS], rel=1e-6)
    assert shape[0, 0] == pytest.approx([1.0 / np.sqrt(MASS), 0.0, 0.0], abs=1e-6)


def test_friction_holds_in_all_directions(shared_tmp_path, comm):
    wall = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.5}
    case = corner(shared_tmp_path, comm, wall, [0.0, 0.0, -10.0])
    with pytest.raises(SimulationFailure, match="hold all nodes"):
        Simulation(case, comm, output=shared_tmp_path / "out", quiet=True).run()


def test_at_the_end_of_a_motion(shared_tmp_path, comm):
    """Pressed from the start, the node is at rest on the wall after steps of an explicit scheme, too."""
    wall = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}
    time = {"integrator": "central_differences", "step": "auto", "end": 0.05}
    case = corner(shared_tmp_path, comm, wall, [0.0, 0.0, -10.0])
    data = {key: value for key, value in case.to_dict().items() if key != "static"} | {"time": time}
    case = Case.from_dict(data, folder=shared_tmp_path)
    values, _ = eigenvalues(case, shared_tmp_path / "out", comm)
    assert values == pytest.approx([STIFF / MASS], rel=1e-9)


@pytest.mark.parallel
def test_pairs_in_contact_are_refused(shared_tmp_path, comm):
    """Two rods pressed together: modes are refused with the reason, and the results are kept."""
    case = Case.from_dict(
        {
            "mesh": {"generator": "two_rods", "length": 1.0, "elements": 2, "gap": 0.01},
            "node_set": {
                "one": {"group": "first_end"},
                "other": {"group": "second_start"},
                "start": {"group": "start"},
                "end": {"group": "end"},
                "all": {"all": True},
            },
            "material": {"it": {"young_modulus": YOUNG, "density": DENSITY}},
            "section": {"it": {"area": AREA, "material": "it"}},
            "support": [
                {"node_set": "all", "fix": "yz"},
                {"node_set": "start", "fix": "x"},
                {"node_set": "end", "fix": "x"},
            ],
            "load": [
                {"node_set": "one", "force": [10.0, 0.0, 0.0]},
                {"node_set": "other", "force": [-10.0, 0.0, 0.0]},
            ],
            "contact_pair": [{"first": "one", "second": "other", "direction": [1.0, 0.0, 0.0]}],
            "static": {"step": 1.0},
            "modes": {},
        }
    )
    with pytest.raises(SimulationFailure, match="press on each other"):
        Simulation(case, comm, output=shared_tmp_path, quiet=True).run()
    assert comm.bcast(open_result(shared_tmp_path).times[-1] if comm.rank == 0 else None) == 1.0
