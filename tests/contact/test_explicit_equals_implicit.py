"""Every explicit step with contact is the solution of the variational inequality of the same step."""

import numpy as np
import pytest
from helpers.lattices import box, lattice_case, planes, rotation, simulation

from pfem_petsc.integrators.base import Balance
from pfem_petsc.solvers.linear import LinearChoice
from pfem_petsc.stepping.implicit import ImplicitStepper
from pfem_petsc.tolerances import ON_BOUND


def wedge(angle, seed):
    half = 0.5 * angle
    return planes(
        np.array([[np.cos(half), np.sin(half), 0.0], [-np.cos(half), np.sin(half), 0.0]]) @ rotation(seed).T,
        [-0.16, -0.16],
    )


def around(count, seed):
    """Planes all around the lattice, in random directions."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    corners = np.array([[x, y, z] for x in (0.0, 0.2) for y in (0.0, 0.1) for z in (0.0, 0.1)])
    return planes(normals, (corners @ normals.T).min(axis=0) - 0.01)


WALLS = {
    "plane": planes([[0.3, -0.2, 1.0]], [-0.08]),
    "wedge": planes([[0.0, 0.6, 0.8], [0.0, -0.3, 1.0]], [-0.02, -0.06]),
    "sharp wedge": planes([[0.0, 1.0, 0.1], [0.0, -1.0, 0.1]], [-0.005, -0.105]),
    "corner": planes([[1.0, 0.2, 0.3], [0.1, 1.0, -0.2], [-0.3, 0.2, 1.0]], [-0.03, -0.04, -0.07]),
    "box": box([-0.01, -0.01, -0.01], [0.21, 0.11, 0.11]),
    "seven": around(7, 3),
    "twelve": around(12, 4),
    "sphere": [{"type": "sphere", "point": [0.1, 0.05, -0.31], "radius": 0.3}],
    "inside a sphere": [{"type": "sphere", "point": [0.1, 0.05, 0.05], "radius": 0.13, "side": "inside"}],
    "inside a cylinder": [
        {"type": "cylinder", "point": [0.1, 0.05, 0.05], "axis": [1.0, 0.0, 0.0], "radius": 0.075, "side": "inside"}
    ],
    "cylinder and plane": [
        {"type": "cylinder", "point": [0.1, 0.05, -0.11], "axis": [0.2, 1.0, 0.1], "radius": 0.09},
        *planes([[0.0, 0.3, 1.0]], [-0.02]),
    ],
}
for name, keys in (
    ("plane", {"friction": 0.4}),
    ("wedge", {"friction": 0.3, "static_friction": 0.6}),
    ("corner", {"friction": 0.4, "velocity": [0.5, 1.0, 0.0]}),
    ("twelve", {"friction": 0.2}),
    ("sphere", {"friction": 0.5, "static_friction": 0.7}),
    ("inside a sphere", {"friction": 0.3}),
    ("cylinder and plane", {"friction": 0.3}),
):
    WALLS[f"rough {name}"] = [wall | keys for wall in WALLS[name]]
SUPPORTS = [{"node_set": "held", "fix": "y"}, {"node_set": "hinged", "fix": "xz"}]
SETS = {"held": {"nearest": [0.0, 0.0, 0.0]}, "hinged": {"nearest": [0.2, 0.1, 0.1]}}


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("supported", [False, True], ids=["free", "supported"])
@pytest.mark.parametrize("name", WALLS)
def test_steps_are_the_same(name, supported, comm, shared_tmp_path):
    tables = {"supports": SUPPORTS, "node_set": SETS} if supported else {}
    case = lattice_case(
        WALLS[name],
        velocity=[3.0, -2.0, -8.0],
        spin=[40.0, 90.0, -60.0],
        step=2e-4,
        end=0.03,
        solver={"rtol": 1e-13},
        **tables,
    )
    run = simulation(case, comm, shared_tmp_path)
    explicit = run.stepper
    implicit = ImplicitStepper(run.model, explicit.scheme, explicit.h, LinearChoice("preonly", "lu", "test"))
    implicit.state = run.model.contact.state = explicit.state
    solve, worst, contacts = explicit.solve, [], []
    curved = any(wall["type"] != "plane" for wall in WALLS[name])
    # both follow curved walls to ON_BOUND of the length, and may be on different sides of them
    within = (2.0 if curved else 1.0) * ON_BOUND * run.model.size
    least = within * run.model.inertia.mass.max() / explicit.h**2 if curved else 0.0

    def both(balance: Balance):
        state = explicit.state
        kept = state.contact.copy()
        other = implicit.solve(balance)
        force = state.contact.copy()
        state.contact = kept
        solution = solve(balance)
        difference = np.abs(solution.u - other.u).max(initial=0.0)
        contacts.append(comm.allreduce(solution.contacts))
        scale = max(comm.allgather(float(np.abs(state.contact).max(initial=0.0))))
        apart = np.abs(state.contact - force).max(initial=0.0)
        worst.append((difference / within, apart / (max(1e-8 * scale, least) or 1e-8)))
        return solution

    explicit.solve = both
    run.external_force(lambda time, state: np.zeros_like(run.state.v))  # without batches: each step is solved here
    assert run.run() == 0
    implicit.destroy()
    assert max(contacts) >= 1 and sum(c > 0 for c in contacts) >= 2
    assert max(w[0] for w in worst) < 1.0
    assert max(w[1] for w in worst) < 1.0
