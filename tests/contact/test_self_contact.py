"""Bars that touch each other, as capsules: distances, forces, conservation, impacts, friction, ranks, restarts."""

import numpy as np
import pytest
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.contact.bar_springs import PairLaw, damping_of, restitution_of
from pfem_petsc.contact.neighbours import segment_distance
from pfem_petsc.contact.self_contact import (
    DISSIPATED,
    ENERGY,
    FORCE,
    WIDTH,
    NodeArrays,
    PairArrays,
    evaluate_pairs,
    find_beginning,
)
from pfem_petsc.errors import InputError, SimulationFailure

RADIUS = 0.01
AREA = np.pi * RADIUS**2


def evaluate(x, reach=0.1, stiffness=3.0, crossed=0.1):
    """Energy, gradient (4, 3) and force of one pair of bars with ends at x (4, 3)."""
    numbers = (np.array([number]) for number in (reach, crossed, stiffness, True, stiffness, 0.0, 0.0))
    pairs, state = PairArrays(np.arange(4).reshape(1, 4), *numbers), np.zeros(1, dtype=np.uint8)
    nodes = NodeArrays(np.hstack([x, np.zeros((4, 3))]), np.ones(4), np.zeros((4, 3)))
    sums, memory, law = np.zeros(6), np.zeros((1, WIDTH)), PairLaw(0.0, 0.0, 0.0, 0.0, 0.0)
    assert find_beginning(pairs, state, memory, nodes, law, np.zeros((4, 3))) == (1, 0, 0.0)
    assert evaluate_pairs(pairs, state, memory, memory.copy(), nodes, law, sums) == 0
    assert sums[DISSIPATED] == 0.0
    return sums[ENERGY], nodes.force, sums[FORCE]


def near_pairs(random, count):
    """Ends (4, 3) of bars of a length of about 1 closer than 0.1, some nearly parallel, some end on end."""
    made = 0
    while made < count:
        centre, one = random.uniform(-0.3, 0.3, 3), random.normal(size=3)
        other = random.normal(size=3) if made % 2 else one + 0.2 * random.normal(size=3)
        x = np.array([-0.5 * one, 0.5 * one, centre - 0.5 * other, centre + 0.5 * other])
        x[2:] += random.uniform(-0.6, 0.6) * other
        if 0.01 < closest(x) < 0.09:
            made += 1
            yield x


def closest(x):
    """Distance of two bars with ends at x (4, 3)."""
    return segment_distance(x, np.array([[0, 1], [2, 3]]), 0, 1)[0]


def test_distances_are_those_of_another_program():
    ipctk = pytest.importorskip("ipctk")
    for x in near_pairs(np.random.default_rng(5), 100):
        square = min(
            ipctk.edge_edge_distance(*x),
            *(ipctk.point_edge_distance(x[i], *x[2:]) for i in (0, 1)),
            *(ipctk.point_edge_distance(x[i], *x[:2]) for i in (2, 3)),
        )
        assert closest(x) == pytest.approx(np.sqrt(square), abs=1e-12)


def test_force_is_the_gradient_of_the_energy():
    random, h = np.random.default_rng(1), 1e-6
    for x in near_pairs(random, 60):
        energy, force, _ = evaluate(x)
        assert energy >= 0.0
        for i, c in np.ndindex(4, 3):
            around = []
            for sign in (-1.0, 1.0):
                moved = x.copy()
                moved[i, c] += sign * h
                around.append(evaluate(moved)[0])
            assert (around[1] - around[0]) / (2.0 * h) == pytest.approx(force[i, c], abs=2e-6)
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-15)
        np.testing.assert_allclose(np.cross(x, force).sum(axis=0), 0.0, atol=1e-15)


def test_energies_of_simple_pairs():
    cross = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0, -0.5, 0.08], [0, 0.5, 0.08]])
    beside = np.array([[-0.5, 0, 0], [0.5, 0, 0], [-0.2, 0, 0.08], [0.8, 0, 0.08]])
    end_on = np.array([[-1.0, 0, 0], [0, 0, 0], [0.08, 0, 0], [1.08, 0, 0]])
    for x in (cross, beside, end_on):
        energy, force, pushed = evaluate(x)
        assert energy == pytest.approx(0.5 * 3.0 * 0.02**2)
        assert pushed == pytest.approx(3.0 * 0.02)
        np.testing.assert_allclose(np.abs(force[:2].sum(axis=0)).max(), 3.0 * 0.02)
    # side by side over their whole lengths, they are held at both ends
    beside[2:, 0] = beside[:2, 0]
    energy, force, _ = evaluate(beside)
    np.testing.assert_allclose(force[:, 2], 3.0 * 0.02 * np.array([1, 1, -1, -1]))


def test_damping_ratio_gives_the_restitution():
    for restitution in (1.0, 0.9, 0.5, 0.2, 0.1, 0.02):
        assert restitution_of(damping_of(restitution)) == pytest.approx(restitution, rel=1e-9)
    # integrated with tiny steps: m x'' = max(-k x - c x', 0) from x = 0 with x' = -1
    for ratio in (0.1, 0.6, 1.0, 1.5):
        x, v, h = 0.0, -1.0, 1e-5
        while True:
            v_before, push = v, -x - 2.0 * ratio * v
            if push < 0.0:
                break
            v += h * push
            x += 0.5 * h * (v + v_before)
        assert v == pytest.approx(restitution_of(ratio), abs=1e-4)


def case_of(points, bars, speed, **tables):
    """Bars of steel-like wood; ``speed``: velocities by rows [[nodes], [vx, vy, vz]]."""
    sets = {f"part{k}": {"indices": nodes} for k, (nodes, _) in enumerate(speed)}
    case = {
        "material": {"m": {"young_modulus": 2e9, "density": 1000.0}},
        "section": {"s": {"area": AREA, "material": "m"}},
        "node_set": sets,
        "initial": {"on": [{"node_set": f"part{k}", "velocity": v} for k, (_, v) in enumerate(speed)]},
        "self_contact": {},
        "time": {"integrator": "central_differences", "step": 5e-5, "end": 1e-2},
        "output": {"history_every": 1, "fields_every": 0},
    }
    for key, value in tables.items():
        if isinstance(value, dict) and isinstance(case.get(key), dict):
            case[key] = case[key] | value
        else:
            case[key] = value
    return Case(case, mesh=Truss(points, bars))


def crossed(angle=90.0, speed=2.0, lift=0.03, **tables):
    c, s = 0.5 * np.cos(np.deg2rad(angle)), 0.5 * np.sin(np.deg2rad(angle))
    points = np.array([[-0.5, 0, 0], [0.5, 0, 0], [-c, -s, lift], [c, s, lift]])
    return case_of(points, [[0, 1], [2, 3]], [([2, 3], [0.0, 0.0, -speed])], **tables)


def chain_tables():
    """Two chains of four bars that fly against each other, askew, and touch at joints and bars."""
    points = [[0.25 * i, 0, 0.02 * (i % 2)] for i in range(5)]
    points += [[0.52 + 0.05 * i, 0.25 * i - 0.5, 0.045 + 0.02 * (i % 2)] for i in range(5)]
    bars = [[i, i + 1] for i in range(4)] + [[i, i + 1] for i in range(5, 9)]
    speed = [(list(range(5)), [0.3, 0.0, 0.0]), (list(range(5, 10)), [-0.4, 0.2, -3.0])]
    return np.array(points), np.array(bars), speed


def chains(**tables):
    return case_of(*chain_tables(), **tables)


def rows_of(case, comm, folder, name):
    with Simulation(case, comm, output=folder / name) as simulation:
        rows = [step.row for step in simulation if step.row is not None]
        x = simulation.gather(simulation.state.position)
    return rows, x


def column(rows, name):
    return np.array([row[name] for row in rows])


def check_conservation(rows, of_angular_momentum=1e-12):
    kinetic = column(rows, "kinetic_energy")
    for name, error in (("momentum", 1e-12), ("angular_momentum", of_angular_momentum)):
        values = column(rows, name)
        np.testing.assert_allclose(values, np.broadcast_to(values[0], values.shape), rtol=0.0, atol=error)
    assert np.abs(column(rows, "energy_imbalance")).max() < 1e-12 * kinetic.max()


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
@pytest.mark.parametrize("angle", [0.0, 0.5, 90.0])
def test_two_bars_exchange_their_velocities(angle, integrator, comm, shared_tmp_path):
    case = crossed(angle, time={"integrator": integrator})
    rows, _ = rows_of(case, comm, shared_tmp_path, "run")
    check_conservation(rows)
    assert column(rows, "self_contact/contacts").max() == 1
    kinetic, touching = column(rows, "kinetic_energy"), column(rows, "self_contact/contacts") > 0
    assert not touching[-1]
    # of the bars as bodies, as their waves take some where they touch askew
    assert kinetic[-1] == pytest.approx(kinetic[0], rel=2e-3)
    # a spring between two masses: largest overlap v sqrt(m/k), m half the mass of a bar, the force k times that
    if angle == 90.0:
        stiffness, mass = 2e9 * AREA, 0.5 * 1000.0 * AREA
        overlap = 2.0 * np.sqrt(mass / stiffness)
        assert column(rows, "self_contact/overlap").max() == pytest.approx(overlap, rel=1e-2)
        assert column(rows, "self_contact/force").max() == pytest.approx(overlap * stiffness, rel=1e-2)
        assert touching.sum() * 5e-5 == pytest.approx(np.pi * np.sqrt(mass / stiffness), rel=0.05)


@pytest.mark.slow
def test_energy_converges_with_the_square_of_the_step(tmp_path):
    lost = []
    for step in (4e-5, 1e-5, 2.5e-6):
        case = crossed(lift=0.0201, time={"step": step, "end": 1.8e-3})
        rows, _ = rows_of(case, MPI.COMM_SELF, tmp_path, f"{step}")
        kinetic = column(rows, "kinetic_energy")
        lost.append(abs(kinetic[-1] / kinetic[0] - 1.0))
    assert lost[2] < 4e-6 and lost[1] < 1e-4 and lost[0] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.9, 0.5, 0.2])
def test_restitution(restitution, tmp_path):
    for step, accuracy in ((5e-5, 0.02), (5e-6, 2e-3)):
        case = crossed(lift=0.0201, time={"step": step, "end": 3e-3}, self_contact={"restitution": restitution})
        rows, _ = rows_of(case, MPI.COMM_SELF, tmp_path, f"{step}")
        check_conservation(rows)
        kinetic = column(rows, "kinetic_energy")
        # bars of equal mass, one at rest: half of the energy is that of the centre of mass
        assert np.sqrt(2.0 * kinetic[-1] / kinetic[0] - 1.0) == pytest.approx(restitution, abs=accuracy)
        lost = column(rows, "self_contact_dissipation")
        assert lost[-1] == pytest.approx(kinetic[0] - kinetic[-1], rel=0.02)
        assert np.diff(lost).min() > -1e-12


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
def test_chains(integrator, comm, shared_tmp_path):
    case = chains(time={"integrator": integrator, "step": 2e-5})
    rows, x = rows_of(case, comm, shared_tmp_path, "all")
    check_conservation(rows, 1e-12 if integrator == "central_differences" else 1e-6)
    assert column(rows, "self_contact/contacts").max() >= 2
    assert column(rows, "self_contact_energy").max() > 0.05
    # numbers of ranks, and the order of nodes and bars
    one, y = rows_of(case, MPI.COMM_SELF, shared_tmp_path, f"one{comm.rank}")
    for name in ("kinetic_energy", "self_contact_energy", "self_contact/force", "self_contact/contacts"):
        np.testing.assert_allclose(column(rows, name), column(one, name), rtol=1e-7, atol=1e-9)
    if comm.rank == 0:
        np.testing.assert_allclose(x, y, atol=1e-12)


@pytest.mark.slow
def test_numbers_do_not_matter(tmp_path):
    tables = {"time": {"step": 2e-5}, "self_contact": {"friction": 0.3, "restitution": 0.8}}
    points, bars, speed = chain_tables()
    random = np.random.default_rng(8)
    order, of_bars = random.permutation(10), random.permutation(8)
    place = np.argsort(order)
    renumbered = points[order], place[bars][of_bars][:, ::-1], [(place[nodes].tolist(), v) for nodes, v in speed]
    rows, x = rows_of(chains(**tables), MPI.COMM_SELF, tmp_path, "one")
    others, y = rows_of(case_of(*renumbered, **tables), MPI.COMM_SELF, tmp_path, "other")
    np.testing.assert_allclose(y, x[order], atol=1e-9)
    lost = column(rows, "self_contact_dissipation")
    assert lost[-1] > 0.01
    np.testing.assert_allclose(column(others, "self_contact_dissipation"), lost, atol=1e-6)


def sliding(comm, **tables):
    """A bar that slides on two others, fixed and across it."""
    points = np.array([[-0.3, -0.2, 0], [-0.3, 0.2, 0], [0.3, -0.2, 0], [0.3, 0.2, 0], [-0.5, 0, 0.02], [0.5, 0, 0.02]])
    return case_of(
        points,
        [[0, 1], [2, 3], [4, 5]],
        [([0, 1, 2, 3], [0.0, 0.0, 0.0]), ([4, 5], [0.3, 0.0, 0.0])],
        support=[{"node_set": "part0", "fix": "xyz"}],
        gravity={"acceleration": [0.0, 0.0, -10.0]},
        time={"step": 1e-4, "end": 0.13},
        output={"history_every": 10},
        **tables,
    )


@pytest.mark.slow
@pytest.mark.parallel
def test_friction_stops_a_bar(comm, shared_tmp_path):
    case = sliding(comm, self_contact={"friction": 0.3, "restitution": 0.6})
    rows, x = rows_of(case, comm, shared_tmp_path, "run")
    mass = 1000.0 * AREA
    assert column(rows, "self_contact/contacts")[-1] == 2
    assert column(rows, "self_contact_dissipation")[-1] == pytest.approx(0.5 * mass * 0.3**2, rel=0.02)
    assert column(rows, "kinetic_energy")[-1] < 1e-4 * column(rows, "kinetic_energy")[0]
    assert np.abs(column(rows, "energy_imbalance")).max() < 1e-12
    if comm.rank == 0:  # v^2/(2 mu g)
        np.testing.assert_allclose(x[4:, 0] - [-0.5, 0.5], 0.3**2 / (2.0 * 0.3 * 10.0), rtol=0.02)
        np.testing.assert_allclose(x[4:, 2], 0.02, atol=1e-5)


@pytest.mark.slow
def test_single_steps_are_those_of_calls(tmp_path):
    """The same steps in compiled calls and one by one, which a function of the user brings about."""
    made = []
    for called in (False, True):
        case = chains(time={"step": 2e-5}, self_contact={"friction": 0.3, "restitution": 0.8})
        with Simulation(case, MPI.COMM_SELF, output=tmp_path / f"{called}") as simulation:
            if called:
                simulation.external_force(lambda t, state: np.zeros_like(state.position))
            rows = [step.row for step in simulation if step.row is not None]
            made.append((rows, simulation.gather(simulation.state.position)))
    (rows, x), (others, y) = made
    np.testing.assert_allclose(x, y, atol=1e-11)
    for name in ("self_contact_energy", "self_contact_dissipation", "self_contact/force", "numerical_dissipation"):
        one, other = column(rows, name), column(others, name)
        np.testing.assert_allclose(one, other, atol=1e-7 * np.abs(one).max())


@pytest.mark.slow
def test_rows_within_calls_are_those_of_single_steps(tmp_path):
    """A call of many steps has the columns of each row, not of its last step alone."""
    case = chains(time={"step": 2e-5})
    rows, _ = rows_of(case, MPI.COMM_SELF, tmp_path, "steps")
    with Simulation(case, MPI.COMM_SELF, output=tmp_path / "calls", quiet=True) as simulation:
        simulation.run()
    history = open_result(tmp_path / "calls").history
    for name in ("self_contact/contacts", "self_contact/overlap", "self_contact/force"):
        np.testing.assert_array_equal(history[name][-len(rows) :], column(rows, name))


@pytest.mark.slow
@pytest.mark.parallel
def test_a_restart_continues_to_the_bit(comm, shared_tmp_path):
    tables = {"time": {"step": 2e-5, "end": 8e-3}, "self_contact": {"friction": 0.3, "restitution": 0.8}}
    whole, x = rows_of(chains(**tables), comm, shared_tmp_path, "whole")
    touching = column(whole, "self_contact/contacts")
    for step in (int(np.argmax(touching > 0)) + 3, int(np.argmax(touching)) + 1):
        tables["output"] = {"checkpoint_every": step}
        tables["time"]["end"] = (step + 0.5) * 2e-5
        name = f"part{step}"
        rows_of(chains(**tables), comm, shared_tmp_path, name)
        tables["time"]["end"] = 8e-3
        with Simulation(chains(**tables), comm, output=shared_tmp_path / name, restart=True) as simulation:
            rows = [one.row for one in simulation]
            y = simulation.gather(simulation.state.position)
        if comm.rank == 0:
            np.testing.assert_array_equal(x, y)
        for key in ("self_contact_energy", "self_contact_dissipation", "self_contact/force", "energy_imbalance"):
            # PT-Scotch may give the parts to other ranks the next time in a process, and sums over ranks are rounded
            error = 0.0 if comm.size == 1 else 1e-14
            np.testing.assert_allclose(column(rows, key), column(whole, key)[-len(rows) :], rtol=error, atol=error)


@pytest.mark.parallel
@pytest.mark.parametrize("speed", [200.0, 600.0])  # the fast one is beyond the other bar within a step
def test_bars_that_would_jump_end_the_run(speed, comm, shared_tmp_path):
    case = crossed(speed=speed, time={"step": 1e-4, "end": 1e-3})
    with (
        pytest.raises(SimulationFailure, match="bars 0 and 1, which are about to touch, move by more than half"),
        Simulation(case, comm, output=shared_tmp_path) as simulation,
    ):
        simulation.run()


@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
def test_bars_that_pass_through_each_other_end_the_run(integrator, tmp_path):
    case = crossed(speed=150.0, time={"integrator": integrator, "step": 2e-5, "end": 1e-3})
    with (
        pytest.raises(SimulationFailure, match=r"step \d+, t = .*: bars 0 and 1 pass through each other"),
        Simulation(case, MPI.COMM_SELF, output=tmp_path) as simulation,
    ):
        simulation.run()


def test_bars_that_cross_in_the_mesh_do_not_touch(tmp_path):
    for lift, contacts in ((0.0, 0), (0.004, 0), (0.01, 1)):
        rows, _ = rows_of(crossed(lift=lift, speed=1.0, time={"end": 3e-3}), MPI.COMM_SELF, tmp_path, f"{lift}")
        assert column(rows, "self_contact/contacts").max() == contacts
    # the distance in the mesh takes the place of the sum of radii: there is no force at the start
    assert column(rows, "self_contact/overlap")[0] == pytest.approx(5e-5)


def test_chosen_bars_and_radius(tmp_path):
    case = crossed(lift=0.05, time={"end": 1.2e-2}, self_contact={"radius": 0.02})
    rows, _ = rows_of(case, MPI.COMM_SELF, tmp_path, "wide")
    begin = rows[int(np.argmax(column(rows, "self_contact/contacts") > 0))]
    assert begin["time"] == pytest.approx(0.01 / 2.0, abs=1e-4)
    truss = Truss(np.eye(3)[[0, 1, 2]], [[0, 1], [1, 2]], bar_groups={"one": [0]})
    tables = {key: value for key, value in case.to_dict().items() if key not in ("mesh", "initial", "node_set")}
    with pytest.raises(InputError, match=r"self_contact.bars = 'two'"):
        Simulation(Case(tables | {"self_contact": {"bars": "two"}}, mesh=truss), MPI.COMM_SELF, output=tmp_path / "no")


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"time": {"mass": "consistent"}}, "needs time.mass"),
        ({"time": {"step": 7e-4}}, "leaves no room for the stiffness"),
        ({"self_contact": {"restitution": 0.0}}, "restitution"),
        ({"self_contact": {"radius": -1.0}}, "radius"),
    ],
)
def test_what_does_not_work_is_refused(tables, message, tmp_path):
    with pytest.raises(InputError, match=message):
        Simulation(crossed(**tables), MPI.COMM_SELF, output=tmp_path)


def test_broken_bars_touch_nothing(tmp_path):
    removed = [{"bars": "gone", "time": 1e-3}]
    base = crossed(time={"end": 1e-2}).to_dict()
    base.pop("mesh")
    points = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0, -0.5, 0.03], [0, 0.5, 0.03]])
    truss = Truss(points, [[0, 1], [2, 3]], bar_groups={"gone": [0]})
    rows, _ = rows_of(Case(base | {"remove": removed}, mesh=truss), MPI.COMM_SELF, tmp_path, "run")
    assert column(rows, "self_contact/contacts").max() == 0


def test_deep_overlap_is_told(tmp_path, capfd):
    rows_of(crossed(speed=40.0, time={"step": 2e-5, "end": 3e-3}), MPI.COMM_SELF, tmp_path, "run")
    assert "bars have overlapped by up to" in capfd.readouterr().err


def test_contact_goes_over_to_the_next_stage(tmp_path):
    """Bars that touch when a stage ends keep their forces and friction, and the energy balance goes on."""
    case = sliding(None, self_contact={"friction": 0.3, "restitution": 0.6}).to_dict()
    time = case.pop("time")
    mesh = Truss(
        np.array([[-0.3, -0.2, 0], [-0.3, 0.2, 0], [0.3, -0.2, 0], [0.3, 0.2, 0], [-0.5, 0, 0.02], [0.5, 0, 0.02]]),
        [[0, 1], [2, 3], [4, 5]],
    )
    case.pop("mesh")
    case["stage"] = [
        {"name": "one", "time": {**time, "end": 0.05}},
        {"name": "two", "time": {**time, "end": 0.08}},
    ]
    rows, x = rows_of(Case(case, mesh=mesh), MPI.COMM_SELF, tmp_path, "stages")
    np.testing.assert_allclose(x[4:, 0] - [-0.5, 0.5], 0.3**2 / (2.0 * 0.3 * 10.0), rtol=0.02)
    assert np.abs(column(rows, "energy_imbalance")).max() < 1e-12
    lost = column(rows, "self_contact_dissipation")
    assert np.diff(lost).min() > -1e-9 and lost[-1] == pytest.approx(0.5 * 1000.0 * AREA * 0.3**2, rel=0.02)
    # and rest on each other in equilibrium, held by friction
    case["stage"].append({"name": "still", "static": {"method": "newton"}})
    rows, y = rows_of(Case(case, mesh=mesh), MPI.COMM_SELF, tmp_path, "still")
    np.testing.assert_allclose(y, x, atol=1e-5)
    load = 1000.0 * AREA * 10.0 * (0.3 + y[4, 0] + 0.5) / 0.6  # of the contact that is nearer to the middle of the bar
    stiffness = 2.0 * 2e9 * AREA / 1.4
    assert rows[-1]["self_contact/overlap"] == pytest.approx(load / stiffness, rel=1e-4)
    assert rows[-1]["self_contact/contacts"] == 2
    case["stage"][-1]["static"] = {"method": "arc_length"}
    with pytest.raises(InputError, match=r"\[self_contact\] does not serve static.method"):
        Simulation(Case(case, mesh=mesh), MPI.COMM_SELF, output=tmp_path / "no")


def test_stage_does_not_begin_with_overlaps_that_the_one_before_allowed(tmp_path):
    """Bars 0.03 m apart approach at 2 m/s to 0.01 m, without contact; their radii are 0.01 m."""
    case = crossed(time={"step": 1e-4, "end": 0.01}).to_dict()
    mesh = Truss(np.array([[-0.5, 0, 0], [0.5, 0, 0], [0, -0.5, 0.03], [0, 0.5, 0.03]]), [[0, 1], [2, 3]])
    case.pop("mesh")
    time, table = case.pop("time"), case.pop("self_contact")
    case["stage"] = [{"name": "one", "time": time}, {"name": "two", "time": time, "self_contact": table}]
    with pytest.raises(SimulationFailure, match=r"stage 'two'.*: bars that may touch now overlap by up to 0\.01 m"):
        rows_of(Case(case, mesh=mesh), MPI.COMM_SELF, tmp_path, "late")
    case["stage"][0]["time"], case["stage"][1]["time"] = {**time, "end": 2e-3}, {**time, "end": 0.03}
    rows, _ = rows_of(Case(case, mesh=mesh), MPI.COMM_SELF, tmp_path, "apart")
    momentum = column(rows, "momentum")[:, 2]
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-12)
    assert column(rows, "self_contact/contacts").max() == 1 and abs(rows[-1]["energy_imbalance"]) < 1e-12


@pytest.mark.parallel
def test_bars_that_break_on_some_ranks_only(comm, shared_tmp_path):
    """A bar of octets torn apart: lists are made again on all ranks, and the balances close."""
    case = {
        "mesh": {"generator": "lattice", "kind": "octet", "cells": [6, 1, 1], "pitch": 0.1},
        "node_set": {"right": {"box": [[0.31, -1.0, -1.0], [1.0, 1.0, 1.0]]}},
        "material": {"m": {"young_modulus": 1e9, "density": 1e3, "rupture": {"strain": 2e-3}}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "initial": {"on": [{"node_set": "right", "velocity": [10.0, 0.0, 0.0]}]},
        "self_contact": {},
        "time": {"integrator": "central_differences", "step": "auto", "end": 2e-4},
    }
    rows, _ = rows_of(Case(case), comm, shared_tmp_path, "torn")
    assert rows[-1]["broken_bars"] > 0
    momentum = column(rows, "momentum")[:, 0]
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-12)
    assert np.abs(column(rows, "energy_imbalance")).max() < 1e-12 * rows[0]["kinetic_energy"]


def test_a_radius_in_another_unit_is_told(comm, tmp_path):
    """Bars that are closer in the mesh than a quarter of their thickness do not touch, which would be all of them."""
    case = {
        "mesh": {
            "generator": "arrays",
            "points": [[-1, 0, 0], [1, 0, 0], [0, -1, 0.1], [0, 1, 0.1]],
            "bars": [[0, 1], [2, 3]],
        },
        "material": {"m": {"young_modulus": 1e7, "density": 1000.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "self_contact": {"radius": 5.0},
        "time": {"integrator": "central_differences", "step": 1e-3, "end": 2e-3},
    }
    run = Simulation(Case.from_dict(case), comm, output=tmp_path, quiet=True)
    assert any("bars are up to 10 m thick and 2 m long on average" in text for text in run.model.warnings)


def test_what_is_dissipated_stays_so_when_supports_are_removed(comm, tmp_path):
    """Loops that begin anew while no bars are near have not called for forces yet."""
    case = {
        "mesh": {
            "generator": "arrays",
            "points": [[-1, 0, 0], [1, 0, 0], [0, -1, 0.03], [0, 1, 0.03], [0, 0, 9], [1, 0, 9]],
            "bars": [[0, 1], [2, 3], [4, 5]],
        },
        "node_set": {"b": {"indices": [2, 3]}, "c": {"indices": [4, 5]}},
        "material": {"m": {"young_modulus": 1e7, "density": 1000.0}},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "initial": {"on": [{"node_set": "b", "velocity": [0.0, 0.0, -0.4]}]},
        "support": [{"name": "held", "node_set": "c", "fix": "xyz"}],
        "self_contact": {"radius": 0.01, "restitution": 0.6},
        "remove": [{"supports": "held", "time": 0.16}],
        "time": {"integrator": "central_differences", "step": 2e-4, "end": 0.18},
        "output": {"history_every": 7, "fields_every": 0},
    }
    run = Simulation(Case.from_dict(case), comm, output=tmp_path, quiet=True)
    run.run()
    if comm.rank == 0:
        lost = open_result(tmp_path).history["self_contact_dissipation"]
        assert lost[-1] > 0.0 and np.diff(lost).min() >= 0.0
