"""Walls at nodes with a prescribed component: walls with different normals bound the same free component."""

import numpy as np
import pytest
from helpers.small_models import case_of
from helpers.triangles import write_surface

from pfem_petsc import Simulation
from pfem_petsc.errors import SimulationFailure

STIFFNESS, MASS = 1e4, 0.1  # of bars of 1 m [N/m], [kg]
APEX, ALONG = np.array([0.0, 0.0, 0.02]), np.array([1.0, 0.0, 0.0])
LEFT, RIGHT = np.array([[0.0, 0.51, -np.sqrt(1.0 - 0.51**2)], [0.0, -np.sqrt(1.0 - 0.51**2), -0.51]])
"""Normals of the faces of a groove above the node, orthogonal to each other and so along each other's face."""


def groove(kind, folder, comm, friction):
    """The groove as two planes or as four triangles."""
    if kind == "planes":
        normals = {"left": LEFT.tolist(), "right": RIGHT.tolist()}
        walls = [{"name": k, "type": "plane", "point": APEX.tolist(), "normal": n} for k, n in normals.items()]
    else:
        points = np.array([APEX + x * ALONG + way for way in (0.0, RIGHT, LEFT) for x in (-2.0, 2.0)])
        file = write_surface(
            folder / "groove.obj", points, np.array([[0, 1, 3], [0, 3, 2], [0, 4, 5], [0, 5, 1]]), comm
        )
        walls = [{"name": "faces", "type": "surface", "file": file}]
    return [wall | {"friction": friction, "node_set": "node"} for wall in walls]


def node_between_hands(folder, comm, walls, rise, sway, steps, static):
    """A node whose z is prescribed to rise, between two tight bars along y whose other ends sway together by a table
    and rise with it."""
    rows = [[t, 0.0, 0.0, rise * t] for t in (0.0, 1.0)]
    hands = {
        name: [[t, 0.0, sign * 0.1 * min(1.0, 10.0 * t) + y, rise * t] for t, y in sway]
        for name, sign in (("back", -1.0), ("front", 1.0))
    }
    unit = 1.0 if static else 0.1  # of time [s]
    supports = [{"node_set": "node", "fix": "z", "motion": [[unit * t, *way] for t, *way in rows]}]
    supports += [
        {"node_set": name, "fix": "xyz", "motion": [[unit * t, *way] for t, *way in table]}
        for name, table in hands.items()
    ]
    tables = {"static": {"step": 1.0 / steps}} if static else {}
    if not static:
        tables["time"] = {"integrator": "newmark", "step": unit / steps, "end": unit}
    return case_of(
        folder,
        comm,
        [[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]],
        [[0, 1], [0, 2]],
        node_set={name: {"indices": [k]} for k, name in enumerate(("node", "back", "front"))},
        material={"rope": {"young_modulus": 1e4 * STIFFNESS, "density": 1e4 * MASS}},
        section={"all": {"area": 1e-4, "material": "rope"}},
        support=[support | {"interpolation": "linear"} for support in supports],
        wall=walls,
        solver={"rtol": 1e-13},
        output={"fields_every": 0},
        **tables,
    )


SWAY = [[0.0, 0.0], [0.1, 0.0], [0.3, -0.06], [0.325, 0.06], [0.6, 0.05], [0.625, -0.05], [1.0, -0.06]]


@pytest.mark.parallel
@pytest.mark.parametrize("friction", [0.0, 0.2])
@pytest.mark.parametrize("kind", ["planes", "triangles"])
@pytest.mark.parametrize("static", [True, False], ids=["static", "newmark"])
def test_a_node_goes_from_face_to_face_of_a_groove(static, kind, friction, comm, shared_tmp_path):
    """In one step as well: its force is that of equilibrium along y, with Coulomb's drag along the face pressed."""
    walls = groove(kind, shared_tmp_path, comm, friction)
    case = node_between_hands(shared_tmp_path, comm, walls, 0.01, SWAY, 40, static)
    presses = []
    with Simulation(case, comm, output=shared_tmp_path / "out", quiet=True) as simulation:
        before = np.zeros(3)
        for step in simulation:
            state = simulation.state
            x, hands, a = (simulation.gather(np.asarray(part)) for part in (state.position, state.position, state.a))
            x, back, front, a = comm.bcast((x[0], hands[1, 1], hands[2, 1], a[0, 1]) if comm.rank == 0 else None)
            force = sum(np.array(step.row[f"wall/{wall['name']}/force"]) for wall in walls)
            pull = STIFFNESS * (back + front - 2.0 * x[1])
            inertia = 0.0 if static else MASS * a
            assert force[1] + pull == pytest.approx(inertia, abs=1e-7 * STIFFNESS * 0.1)
            gaps = np.array([LEFT, RIGHT]) @ (x - APEX)
            assert gaps.min() > -1e-11
            side = int(gaps.argmin())
            n, t = (LEFT, RIGHT) if side == 0 else (RIGHT, LEFT)
            normal_force, drag = force @ n, force @ t
            if gaps[side] > 1e-11:
                assert not force.any()
            else:
                presses.append((side, normal_force))
                slip = t @ (x - before)
                assert drag == pytest.approx(-friction * normal_force * np.sign(slip), abs=1e-6)
            before = x
    pressed = [[force for side, force in presses if side == k and force > 10.0] for k in (0, 1)]
    assert len(pressed[0]) > 5 and len(pressed[1]) > 5


@pytest.mark.parallel
@pytest.mark.parametrize("kind", ["planes", "triangles"])
@pytest.mark.parametrize("static", [True, False], ids=["static", "newmark"])
def test_a_support_that_carries_a_node_through_a_groove(static, kind, comm, shared_tmp_path):
    """The two faces leave no y to the node once it is above the apex: a failure that says so."""
    walls = groove(kind, shared_tmp_path, comm, 0.0)
    case = node_between_hands(shared_tmp_path, comm, walls, 0.03, [[0.0, 0.0], [1.0, 0.0]], 40, static)
    with pytest.raises(SimulationFailure, match="no position of node 0 satisfies all walls .* and its supports"):
        Simulation(case, comm, output=shared_tmp_path / "out", quiet=True).run()
