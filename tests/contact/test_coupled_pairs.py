"""Pairs that share nodes, and nodes of pairs that walls stop: the optimum of every explicit step, and its failures."""

from itertools import combinations

import numpy as np
import pytest
from helpers.lattices import box, planes, simulation, two_lattices

from pfem_petsc.contact.projection import find_multipliers
from pfem_petsc.errors import InputError, SimulationFailure


@pytest.mark.parametrize("seed", range(40))
def test_complementary_is_the_best_active_set(seed):
    """Random problems of up to six rows in four dimensions, some of them repeated, against all active sets."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    rows = rng.normal(size=(n, 4))
    if n > 3 and seed % 3 == 0:
        rows[-1] = rows[0]
    values = rows @ rng.normal(size=4) + rng.uniform(-0.5, 1.0, n) * (seed % 2)
    z = np.zeros(n)
    assert find_multipliers(rows @ rows.T, values, 1e-12, z)
    move = rows.T @ z
    left = rows @ move + values
    assert z.min() >= 0.0 and left.min() > -1e-10 and np.abs(z * left).max() < 1e-10
    best = np.inf
    for count in range(min(n, 4) + 1):
        for chosen in map(list, combinations(range(n), count)):
            trial = -np.linalg.pinv(rows[chosen]) @ values[chosen] if chosen else np.zeros(4)
            if (rows @ trial + values).min() > -1e-9:
                best = min(best, float(trial @ trial))
    assert move @ move == pytest.approx(best, rel=1e-8, abs=1e-12)


def test_rows_against_each_other_have_no_solution():
    rows = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
    z = np.zeros(3)
    assert not find_multipliers(rows @ rows.T, np.array([-1.0, -0.5, -3.0]), 1e-12, z)
    assert find_multipliers(rows @ rows.T, np.array([-1.0, 1.0, -3.0]), 1e-12, z)
    assert z == pytest.approx([1.0, 0.0, 3.0])


WALLS = {
    "floor": planes([[0.0, 0.1, 1.0]], [-0.001]),
    "box": box([-0.004, -0.004, -0.004], [0.207, 0.204, 0.204]),
    "moving": [
        {"type": "plane", "point": [0.0, 0.0, -0.002], "normal": [0.0, 0.3, 1.0], "velocity": [0.0, 0.0, 1.0]},
        {
            "type": "rectangle",
            "point": [0.21, 0.1, 0.1],
            "normal": [-1.0, 0, 0],
            "along": [0, 1.0, 0],
            "size": [0.3, 0.3],
        },
    ],
    "none": [],
}


def crowded(walls, file, integrator="central_differences", **options):
    """Two lattices whose faces meet along two directions at once, in walls that stop every node."""
    case = two_lattices(file, integrator, step=2e-4, end=0.02, **options)
    other = {**case["contact_pair"][0], "name": "across", "direction": [1.0, -0.4, 0.3]}
    case["contact_pair"].append(other)
    case["wall"] = walls
    return case


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("supported", [False, True], ids=["free", "supported"])
@pytest.mark.parametrize("name", WALLS)
def test_every_step_is_optimal(name, supported, comm, shared_tmp_path):
    """Feasible, pressing only where closed, and pushed from the free positions by these forces and no others."""
    supports = [{"node_set": "held", "fix": "y"}, {"node_set": "hinged", "fix": "xz"}] if supported else []
    case = crowded(WALLS[name], shared_tmp_path / "m.vtu", supports=supports)
    run = simulation(case, comm, shared_tmp_path)
    stepper, pairs, contact = run.stepper, run.model.links, run.model.contact
    run.external_force(lambda time, state: np.zeros_like(run.state.v))  # without batches: each step is solved here
    assert (np.bincount(pairs.rows.ends.ravel()) > 1).all()
    seen = []

    def check():
        balance, solution = stepper.balance, stepper.solution
        x = balance.predictor + solution.u
        gaps = pairs.rows.values(pairs.rows.gather(x))
        assert gaps.min() > -1e-12 and pairs.force.min() >= 0.0
        assert np.abs(gaps[pairs.force > 0.0]).max(initial=0.0) < 1e-12
        walls = contact.gaps(x, balance.time)
        fixed = run.model.supports.fixed
        if not contact.partial:
            assert walls[~fixed.any(axis=1)].min(initial=0.0) > -1e-12
        # what pushes a node is its pairs' and walls' forces
        state = stepper.state
        push = np.zeros_like(x)
        pairs.add_forces(push)
        held, touching = solution.walls.nodes, solution.walls.touching
        alone = np.setdiff1d(np.arange(len(x)), held)
        np.testing.assert_allclose(state.contact[alone], push[alone], atol=1e-12)
        if len(held):
            normals, _ = contact.planes(touching, x[held], contact.motion.poses(balance.time))
            normals = np.where(touching[:, :, None], normals, 0.0)
            rest = (state.contact - push)[held]
            strengths = np.einsum("mwi,mi->mw", np.linalg.pinv(normals.transpose(0, 2, 1)), rest)
            np.testing.assert_allclose(np.einsum("mwi,mw->mi", normals, strengths), rest, atol=1e-9)
            assert strengths.min() > -1e-9
            assert np.abs(np.where(touching, walls[held], 0.0)).max() < 1e-12
        both = np.intersect1d(held, pairs.two.pressed(pairs.force)[0])
        mine = (pairs.force > 0.0) & (pairs.two.nodes[0] >= 0)  # a pair counts where its first node is owned
        seen.append((comm.allreduce(len(both)), comm.allreduce(int(mine.sum()))))

    rows = []
    for step in run:
        check()
        rows.append(step.row)
    assert max(count for _, count in seen) > 13
    assert name == "none" or max(count for count, _ in seen) > 1
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10
    if name == "none" and not supported:
        momentum = np.array([row["momentum"] for row in rows])
        np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(rows), 1)), atol=1e-13)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("heavy", [False, True], ids=["alone", "beside a wall with mass"])
def test_no_room(heavy, comm, shared_tmp_path):
    """A wall that drives the first body's face into the second one's, which another wall holds."""
    walls = planes([[1.0, 0.0, 0.0]], [0.09], node_set="left") + planes([[-1.0, 0, 0]], [-0.106], node_set="right")
    walls[0]["velocity"] = [1.0, 0.0, 0.0]
    if heavy:  # for which all ranks solve, while only some find no room
        walls += planes([[1.0, 0.0, 0.0]], [-1.0], node_set="rear", mass=1.0)
    case = crowded(walls, shared_tmp_path / "m.vtu", velocity=(0.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0))
    case["node_set"]["rear"] = {"indices": [0]}
    with pytest.raises(SimulationFailure, match=r"step \d+, t = .* s: no positions of nodes \d+.* satisfy") as failure:
        simulation(case, comm, shared_tmp_path).run()
    assert comm.allgather(str(failure.value)) == [str(failure.value)] * comm.size


@pytest.mark.parametrize(
    "change, message",
    [
        ({"integrator": "newmark", "one": True, "treatment": "stick"}, "a wall stops it as well, which needs contact"),
        ({"treatment": "stick"}, "is in several pairs, or a wall stops it as well, which needs contact.treatment"),
        (
            {"restitution": 0.2, "integrator": "newmark"},
            "wall 'wall1' stops nodes of pairs or constraints: such a wall must be without restitution",
        ),
    ],
)
def test_refusals(change, message, comm, shared_tmp_path):
    keys = {name: value for name, value in change.items() if name in ("restitution", "mass")}
    walls = planes([[0.0, 0.0, 1.0]], [-0.01], **keys)
    case = crowded(walls, shared_tmp_path / "m.vtu", change.get("integrator", "central_differences"))
    if change.get("one"):
        case["contact_pair"].pop()
    case["contact"] = {"treatment": change.get("treatment", "scheme")}
    with pytest.raises(InputError, match=message):
        simulation(case, comm, shared_tmp_path)
