"""Tied walls: nodes that touch them stay, whatever the forces."""

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, simulation
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case
from pfem_petsc.errors import InputError, SimulationFailure

SCHEMES = [("central_differences", {}), ("chung_lee", {}), ("newmark", {}), ("houbolt", {})]
SCHEMES += [("generalized_alpha", {}), ("wilson", {"theta": 1.8}), ("energy_momentum", {})]
STICK = ("generalized_alpha", "energy_momentum")


def rod(integrator, parameters, *, gap=0.0213, speed=1e-3, end=9.0, step=0.01, elements=40, **wall):
    """A rod of length, wave speed and mass one, thrown along x at a wall that ties its tip."""
    return {
        "mesh": {"generator": "rod", "length": 1.0, "elements": elements},
        "material": {"m": {"young_modulus": 1.0, "density": 1.0}},
        "section": {"s": {"area": 1.0, "material": "m"}},
        "node_set": {"tip": {"nearest": [1.0, 0.0, 0.0]}},
        "initial": {"velocity": [speed, 0.0, 0.0]},
        "wall": planes([[-1.0, 0.0, 0.0]], [-1.0 - gap * speed], node_set="tip", tied=True, name="glue", **wall),
        "time": {"integrator": integrator, "step": step, "end": end, **parameters},
        "contact": {"treatment": "stick" if integrator in STICK else "scheme"},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-12},
    }


def columns(run):
    rows = [step.row for step in run]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", SCHEMES)
def test_rod_stays_and_oscillates(integrator, parameters, comm, shared_tmp_path):
    """After the touch the rod is one with a fixed end: the force is a square wave of period 4 L/c, its first half
    presses with rho c A v and its second pulls as much, and momentum is the initial one plus the impulse."""
    speed = 1e-3
    found = columns(simulation(rod(integrator, parameters, speed=speed), comm, shared_tmp_path))
    since = found["time"] - 0.0213
    force = -found["wall/glue/force"][:, 0] / speed
    for start, sign in ((0.0, 1.0), (2.0, -1.0), (4.0, 1.0), (6.0, -1.0)):
        inside = (since > start + 0.4) & (since < start + 1.6)
        tolerance = 0.03 if integrator != "newmark" else 0.35  # Hu's pair damps waves
        assert np.mean(force[inside]) == pytest.approx(sign, abs=tolerance), start
    momentum, impulse = found["momentum"][:, 0], found["wall/glue/impulse"][:, 0]
    impulse = impulse + found["wall/glue/jump_impulse"][:, 0]
    np.testing.assert_allclose(momentum, speed + impulse, atol=1e-9 * speed)
    contacts = found["wall/glue/contacts"]
    assert (contacts[since > 0.02] == 1).all() and found["wall/glue/releases"][-1] == 0
    assert np.abs(found["energy_imbalance"]).max() < 1e-9 * found["kinetic_energy"][0]
    if integrator in ("central_differences", "chung_lee"):
        # v(t) of the mass centre: the triangle wave v (1 - t c/L), period 4
        triangle = speed * (np.abs((since % 4.0) - 2.0) - 1.0)
        late = since > 0.1
        assert np.abs(momentum - triangle)[late].max() < 0.05 * speed


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_tip_keeps_its_place(integrator, comm, shared_tmp_path):
    """From the touch on the tip is where it was then, to rounding, on a wall at rest and on one that moves about."""
    for name, keys in (("rest", {}), ("moved", {"motion": [[0.0, 0, 0, 0], [0.5, 0, 0.02, 0.01], [2.0, -0.01, 0, 0]]})):
        case = rod(integrator, {}, end=1.5, speed=0.05, step=0.02, elements=10, **keys)
        case["initial"]["velocity"] = [0.05, 0.01, 0.0]
        run = simulation(case, comm, shared_tmp_path, name)
        place = None
        for _ in run:
            nodes, _, places = run.model.contact.ties.targets(run.state.time)
            if len(nodes) == 0:
                continue
            away = run.state.position[nodes] - run.model.contact.motion.displacements(run.state.time)[0]
            if place is None and run.state.time > 0.3:
                place = away
            if place is not None:
                np.testing.assert_allclose(away, place, atol=1e-14)
        assert comm.allreduce(int(place is not None)) == 1


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_touching_at_the_start(integrator, comm, shared_tmp_path):
    """At gap zero the first push ties, and one that moves away is free."""
    for sign, contacts in ((1.0, 1), (-1.0, 0)):
        case = rod(integrator, {}, gap=0.0, end=0.1, elements=5)
        case["initial"]["velocity"] = [sign * 1e-3, 0, 0]
        found = columns(simulation(case, comm, shared_tmp_path, f"{contacts}"))
        assert (found["wall/glue/contacts"][1:] == contacts).all()
    case["initial"]["velocity"] = [0.0, 0.0, 0.0]
    found = columns(simulation(case, comm, shared_tmp_path, "rest"))
    assert (found["wall/glue/contacts"] == 0).all()


def drop(integrator, **keys):
    """A spinning lattice that a tied, oblique plane catches by a corner, under gravity that pulls it off again."""
    walls = planes([[0.2, 0.1, 1.0]], [-0.004], tied=True, name="glue", **keys)
    return lattice_case(
        walls,
        velocity=[0.5, 0.1, -1.5],
        spin=[3.0, 2.0, -5.0],
        integrator=integrator,
        end=0.05,
        gravity=[20.0, 0.0, 30.0],
        solver={"rtol": 1e-13},
    )


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["central_differences", "newmark", "houbolt"])
def test_wall_with_mass(integrator, comm, shared_tmp_path):
    """Momentum of truss and wall together stays, and they end up with one velocity on average."""
    case = drop(integrator, mass=0.05)
    del case["gravity"]
    case["time"]["end"] = 0.03
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    total = np.array([row["momentum"] + 0.05 * row["wall/glue/velocity"] for row in rows])
    np.testing.assert_allclose(total, total[:1].repeat(len(rows), axis=0), atol=1e-12 * np.abs(total).max())
    assert rows[-1]["wall/glue/contacts"] >= 1 and rows[-1]["wall/glue/releases"] == 0


@pytest.mark.parametrize("mass", [0.5, None])
def test_energy_momentum_comes_to_rest_on_its_wall(mass, comm, shared_tmp_path):
    """Velocity of a tied node is that of the wall, with mass or without, not 0.5 and 1.5 of it in turns for ever."""
    speed, keys = 0.05, {} if mass is None else {"mass": mass}
    case = rod("energy_momentum", {}, speed=speed, elements=5, step=0.02, end=0.8, gap=0.0513, **keys)
    case["contact"]["treatment"] = "scheme"
    case["initial"]["velocity"] = [speed, 0.01, 0.0]
    run = simulation(case, comm, shared_tmp_path)
    apart, rows = [], []
    for step in run:
        nodes, walls, places = run.model.contact.ties.targets(run.state.time)
        rows.append(step.row)
        if len(nodes):
            apart.append(np.abs(run.state.v[nodes] - run.model.contact.motion.rates(run.state.time)[walls]).max())
            gap = run.model.contact.gaps(run.state.position, run.state.time)[nodes, walls]
            assert -1e-12 <= gap.min() <= gap.max() <= 0.5 * 0.02 * speed
    assert len(apart) > 30 and apart[0] > 0.1 * speed
    assert max(apart[1:]) < 1e-9 * speed
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-9 * rows[0]["kinetic_energy"]
    if mass:
        total = np.array([row["momentum"] + mass * row["wall/glue/velocity"] for row in rows])
        np.testing.assert_allclose(total, total[:1].repeat(len(rows), axis=0), atol=1e-12)


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_supports_carry_a_node_through_its_own_wall(integrator, comm, shared_tmp_path):
    """A component that a support moves is the support's: where it takes the node beyond the wall, that is told."""
    case = rod(integrator, {}, end=1.0, elements=5, step=0.02, speed=0.0, gap=0.0)
    normal = np.array([-1.0, 0.0, 1.0]) / np.sqrt(2.0)
    case["wall"] = planes([normal], [normal @ [1.0, 0.0, 0.0]], node_set="tip", tied=True, name="glue")
    case["gravity"] = {"acceleration": [0.0, 0.0, -1.0]}
    table = [[0.0, 0.0, 0.0, 0.0], [0.4, 0.0, 0.0, 0.0], [1.0, 0.1, 0.0, 0.0]]
    case["support"] = [{"node_set": "tip", "fix": "x", "motion": table}]
    with pytest.raises(SimulationFailure, match=r"node 5 is tied to wall 'glue' and its supports move it .* beyond"):
        simulation(case, comm, shared_tmp_path).run()


@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_carried_through_another_wall(integrator, comm, shared_tmp_path):
    case = rod(integrator, {}, end=1.0, elements=5, velocity=[0.0, 0.0, -1.0])
    case["wall"] += planes([[0.0, 0.0, 1.0]], [-0.1], name="floor")
    with pytest.raises(SimulationFailure, match=r"node 5, tied to wall 'glue', is moved .* beyond wall 'floor'"):
        simulation(case, comm, shared_tmp_path).run()


def test_refused(comm, shared_tmp_path):
    with pytest.raises(InputError, match="a tied wall cannot have friction or restitution"):
        Case.from_dict(rod("newmark", {}, friction=0.1))
    case = rod("newmark", {})
    case["contact"]["treatment"] = "conserving"
    with pytest.raises(InputError, match='tied needs contact.treatment = "scheme" or "stick"'):
        simulation(case, comm, shared_tmp_path)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "newmark"])
def test_restart_and_ranks(integrator, comm, shared_tmp_path):
    """A run in two parts is the run in one to the last bit, and that on one rank nearly."""
    case = drop(integrator)
    case["time"]["end"], case["solver"]["linear"] = 0.03, "cg"  # MUMPS sums in the order in which messages come
    case = Case.from_dict(case)
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 100)
    assert history["wall/glue/contacts"][100] >= 1 and history["wall/glue/contacts"][-1] >= 2
    names = "wall/glue/contacts", "wall/glue/impulse", "centre_of_mass", "elastic_energy"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names, within=1e-8)
