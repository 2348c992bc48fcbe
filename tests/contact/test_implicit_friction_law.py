"""Friction in implicit steps of a lattice: Coulomb's law node by node, and the explicit solution in the limit."""

import numpy as np
import pytest
from helpers.lattices import SCHEMES, G, lattice_case, planes, simulation, tumbling
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case

WALLS = {
    "plane": planes([[0.3, -0.2, 1.0]], [-0.02], friction=0.4),
    "static": planes([[0.3, -0.2, 1.0]], [-0.02], friction=0.4, static_friction=0.7),
    "moving": planes([[0.3, -0.2, 1.0]], [-0.02], friction=0.4, velocity=[1.0, 0.5, 0.5]),
    "corner": planes([[1.0, 0.2, 0.3], [0.1, 1.0, -0.2], [-0.3, 0.2, 1.0]], [-0.03, -0.04, -0.07], friction=0.4),
    "sphere": [{"type": "sphere", "point": [0.1, 0.05, -0.31], "radius": 0.3, "friction": 0.5}],
    "bowl": [{"type": "sphere", "point": [0.1, 0.05, 0.05], "radius": 0.15, "side": "inside", "friction": 0.5}],
}


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "integrator", "parameters"),
    [("plane", *scheme) for scheme in SCHEMES]
    + [(name, *SCHEMES[k]) for k in (0, 1, 4) for name in ("static", "moving", "sphere", "bowl")],
)
def test_law_of_coulomb(name, integrator, parameters, comm, shared_tmp_path):
    """Every force of every step: within the cone, and on it against the slip where there is any."""
    wall = WALLS[name][0]
    run = simulation(tumbling(WALLS[name], integrator, parameters), comm, shared_tmp_path)
    solve, infeasible, slipping = run.stepper.solve, 0, 0

    def observed(balance):
        nonlocal infeasible, slipping
        state = run.state
        before, start = state.position.copy(), state.time
        solution = solve(balance)
        x, r = balance.predictor + solution.u, state.contact
        pressed = np.abs(r).max(axis=1) > 0.0
        x, r, before = x[pressed], r[pressed], before[pressed]
        if wall["type"] == "plane":
            n = np.tile(wall["normal"], (len(x), 1))
        else:
            # the normal where the forces of the balance act: a conserving scheme takes them half way
            arm = before + balance.acting * (x - before) - np.array(wall["point"])
            n = arm / np.linalg.norm(arm, axis=1)[:, None] * (-1.0 if wall.get("side") else 1.0)
        strength = np.einsum("mi,mi->m", r, n)
        drag = r - strength[:, None] * n
        slip = x - before - (balance.time - start) * np.array(wall.get("velocity", (0.0, 0.0, 0.0)))
        slip -= np.einsum("mi,mi->m", slip, n)[:, None] * n
        size = np.linalg.norm(slip, axis=1)
        largest = strength.max(initial=0.0)
        assert (strength > 0.0).all()
        # what is below the tolerance of the forces is no slip: k s
        slips = size > 1e-11
        holds = wall.get("static_friction", wall["friction"])
        assert (np.linalg.norm(drag, axis=1)[~slips] <= holds * strength[~slips] + 1e-9 * largest).all()
        expected = -wall["friction"] * strength[slips, None] * slip[slips] / size[slips, None]
        assert np.abs(drag[slips] - expected).max(initial=0.0) <= 1e-6 * largest
        infeasible, slipping = infeasible + int((~slips).sum()), slipping + int(slips.sum())
        return solution

    run.stepper.solve = observed
    rows = [step.row for step in run]
    infeasible, slipping = comm.allreduce(infeasible), comm.allreduce(slipping)
    assert infeasible >= 3 and slipping >= 10
    most = max(row["kinetic_energy"] for row in rows)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-9 * most


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "keys"),
    [("houbolt", {}), ("newmark", {"static_friction": 0.6}), ("newmark", {"velocity": [0.0, 0.4, 0.0]})],
)
def test_implicit_steps_tend_to_the_explicit_ones(keys, integrator, comm, shared_tmp_path):
    """A lattice that is pushed to and fro over the floor, parts of it at a time."""
    apart = []
    for step in (4e-4, 1e-4):
        x = {}
        for scheme in ("central_differences", integrator):
            floor = planes([[0.0, 0.0, 1.0]], [0.0], friction=0.4, **keys)
            case = lattice_case(
                floor,
                integrator=scheme,
                step=step,
                end=0.04,
                gravity=[0.0, 0.0, -G],
                cells=[3, 1, 1],
                material={"damping": 2e4},
                node_set={"end": {"box": [[-0.01, -0.01, -0.01], [0.01, 0.11, 0.11]]}},
                load=[{"node_set": "end", "force": [0.02, 0.0, 0.0], "table": [[0, 0], [0.015, 1], [0.04, -1]]}],
            )
            run = simulation(case, comm, shared_tmp_path, f"{scheme} {step}")
            for _ in run:
                pass
            x[scheme] = run.gather(run.state.position)
        if comm.rank == 0:
            far = np.abs(x["central_differences"] - run.mesh.points[: len(x[scheme])]).max()
            apart.append(np.abs(x[integrator] - x["central_differences"]).max() / far)
    if comm.rank == 0:
        assert apart[1] < 0.7 * apart[0] and apart[1] < 0.001


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("name", ["static", "corner", "sphere"])
def test_any_number_of_ranks(name, comm, shared_tmp_path):
    """The run on all ranks is that on one, and a run in two parts is the run in one, bit for bit."""
    # on several ranks MUMPS sums in the order in which messages come
    solver = {"rtol": 1e-13, "linear": "cg"}
    case = Case.from_dict(tumbling(WALLS[name], "newmark", {}, end=0.03, solver=solver))
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 20)
    names = "contact_work", "friction_dissipation", "centre_of_mass", "elastic_energy"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names, within=1e-8)
