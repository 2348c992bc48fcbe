"""Walls with mass: momentum of truss and walls together, and a collision with a closed form."""

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, simulation

from pfem_petsc import Case, Simulation
from pfem_petsc.errors import InputError, SimulationFailure
from pfem_petsc.preflight import warnings_before

SCHEMES = [("central_differences", {}), ("chung_lee", {}), ("newmark", {}), ("houbolt", {})]
SPEED = np.array([1.0, -0.5, -4.0])


def walls_of(kind):
    if kind == "plane":
        return planes([[0.2, 0.1, 1.0]], [-0.02], mass=0.05, velocity=[0.0, 0.0, 0.5])
    if kind == "corner":
        return planes([[0.2, 0.1, 1.0], [1.0, 0.3, 0.4]], [-0.015, -0.02], mass=0.02)
    return [{"type": "sphere", "point": [0.1, 0.05, -0.12], "radius": 0.1, "mass": 0.03, "velocity": [0.0, 0.1, 1.0]}]


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator, parameters", SCHEMES)
@pytest.mark.parametrize("kind", ["plane", "corner", "sphere"])
def test_momentum_is_shared(kind, integrator, parameters, comm, shared_tmp_path):
    """Momentum of truss plus walls stays to 1e-12, and the walls are moved."""
    walls = walls_of(kind)
    case = lattice_case(walls, velocity=SPEED.tolist(), integrator=integrator, end=0.02, solver={"rtol": 1e-12})
    case["time"] |= parameters
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    names = run.model.contact.names
    start = run.model.total_mass * SPEED + sum(w["mass"] * np.array(w.get("velocity", (0, 0, 0))) for w in walls)
    for row in rows:
        total = row["momentum"] + sum(w["mass"] * row[f"wall/{n}/velocity"] for w, n in zip(walls, names, strict=True))
        np.testing.assert_allclose(total, start, atol=1e-12 * np.abs(start).max())
    moved = rows[-1][f"wall/{names[0]}/velocity"] - np.array(walls[0].get("velocity", (0, 0, 0)))
    assert np.abs(moved).max() > 0.1
    # nobody is beyond a wall where it is at the end
    x = run.state.position
    assert run.model.contact.gaps(x, run.state.time).min(initial=0.0) > -2e-12 * 0.2


@pytest.mark.slow
@pytest.mark.parametrize("integrator, parameters", [*SCHEMES, ("generalized_alpha", {}), ("energy_momentum", {})])
def test_wall_with_weight(integrator, parameters, comm, shared_tmp_path):
    """It falls freely until it meets the truss, and from then on truss and wall have their weight in common."""
    gravity, speed, mass = np.array([1.0, -2.0, -9.81]), np.array([0.0, 0.0, -1.0]), 0.03
    walls = planes([[0.0, 0.0, -1.0]], [-0.12], mass=mass, velocity=speed.tolist(), gravity=True, name="ram")
    walls += planes([[0.0, 0.0, -1.0]], [-0.9], mass=mass, name="light")
    case = lattice_case(walls, integrator=integrator, end=0.04, gravity=gravity, solver={"rtol": 1e-12})
    case["time"] |= parameters
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    met = next(k for k, row in enumerate(rows) if row["active_contacts"])
    assert 20 < met < 0.7 * len(rows)
    for row in rows[: met - 2]:
        fallen = speed * row["time"] + 0.5 * gravity * row["time"] ** 2
        np.testing.assert_allclose(row["wall/ram/position"] - [0.0, 0.0, 0.12], fallen, atol=1e-12)
    total = run.model.total_mass + mass
    for row in rows:
        momentum = row["momentum"] + mass * row["wall/ram/velocity"]
        np.testing.assert_allclose(momentum, mass * speed + total * gravity * row["time"], atol=1e-12)
        np.testing.assert_array_equal(row["wall/light/velocity"], 0.0)


@pytest.mark.slow
def test_point_mass_hits_a_wall_with_mass(comm, shared_tmp_path):
    """A bar hits flat: with restitution e the relative velocity is turned round and multiplied by e."""
    step, e, mass = 1e-4, 0.6, 4e-3
    case = {
        "mesh": {"generator": "rod", "length": 0.2, "elements": 2},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "initial": {"velocity": [0.0, 0.0, -1.0]},
        "wall": [
            {
                "type": "plane",
                "name": "plate",
                "point": [0, 0, -0.05],
                "normal": [0, 0, 1.0],
                "mass": mass,
                "velocity": [0, 0, 0.2],
                "restitution": e,
            }
        ],
        "time": {"integrator": "central_differences", "step": step, "end": 0.1},
        "output": {"fields_every": 0},
    }
    run = simulation(case, comm, shared_tmp_path)
    last = [s.row for s in run][-1]
    truss = run.model.total_mass
    common = (truss * -1.0 + mass * 0.2) / (truss + mass)
    assert last["momentum"][2] / truss == pytest.approx(common + e * 1.2 * mass / (truss + mass), rel=0.02)
    assert last["wall/plate/velocity"][2] == pytest.approx(common - e * 1.2 * truss / (truss + mass), rel=0.02)


@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee"])
@pytest.mark.parametrize(("friction", "mass"), [(5.0, 0.1), (5.0, 100.0), (0.3, 0.1), (0.3, 1.0)])
def test_friction_moves_a_wall_with_mass(friction, mass, integrator, comm, shared_tmp_path):
    """A bar of 1 kg that meets it flat: their relative velocity along the wall decreases by mu times the approach."""
    normal, along = np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.0, -0.6])
    drift = np.array([0.1, 0.2, -0.3])
    wall = {"type": "plane", "name": "plate", "point": (-0.0035 * normal).tolist(), "normal": normal.tolist()}
    case = {
        "mesh": {"generator": "arrays", "points": [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "bars": [[0, 1]]},
        "material": {"m": {"young_modulus": 1e-3, "density": 1000.0}},
        "section": {"s": {"area": 1e-3, "material": "m"}},
        "initial": {"velocity": (drift + 0.5 * along - normal).tolist()},
        "wall": [wall | {"friction": friction, "mass": mass, "velocity": drift.tolist()}],
        "time": {"integrator": integrator, "step": 1e-3, "end": 0.01},
        "output": {"fields_every": 0},
    }
    row = [step.row for step in simulation(case, comm, shared_tmp_path)][-1]
    plate = row["wall/plate/velocity"]
    total = row["momentum"] + mass * plate
    np.testing.assert_allclose(total, (1.0 + mass) * drift + 0.5 * along - normal, atol=1e-9 * (1.0 + mass))
    if integrator == "central_differences":  # others leave the velocity of nodes in contact to their formulas
        left = max(0.5 - friction, 0.0)
        np.testing.assert_allclose(row["momentum"] - plate, left * along, atol=1e-8)


def test_refused(comm, shared_tmp_path):
    with pytest.raises(InputError, match="at most one of the keys mass, motion"):
        simulation(
            lattice_case(planes([[0, 0, 1.0]], [-0.1], mass=1.0, motion=[[0.0, 0, 0, 0]])), comm, shared_tmp_path
        )
    with pytest.raises(InputError, match="gravity = true needs the wall's mass"):
        simulation(lattice_case(planes([[0, 0, 1.0]], [-0.1], gravity=True)), comm, shared_tmp_path)
    with pytest.raises(InputError, match="change velocities by jumps"):
        case = lattice_case(planes([[0, 0, 1.0]], [-0.1], mass=1.0), contact={"treatment": "stick"})
        simulation(case, comm, shared_tmp_path)


@pytest.mark.parallel
def test_gravity_of_a_wall_in_a_case_without_is_told(comm, shared_tmp_path):
    case = lattice_case(planes([[0, 0, 1.0]], [-0.1], gravity=True, mass=1.0, name="ram"))
    with_gravity = Case.from_dict({**case, "gravity": {"acceleration": [0.0, 0.0, -9.81]}})
    for told, built in ((1, Case.from_dict(case)), (0, with_gravity)):
        run = Simulation(built, comm, check_only=True)
        texts = warnings_before(run.case, run.model, run.plan)
        assert sum("wall 'ram': gravity = true, but the case has no [gravity]" in t for t in texts) == told


@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["central_differences", "souza_moura", "newmark"])
def test_a_wall_with_mass_takes_over_from_another(integrator, comm, shared_tmp_path):
    """A slow ram comes through the wall that a tip is pressed on, a little oblique: for a step both carry the tip, and
    whether the ram does depends on the last digits of where it is."""
    rows = _rammed([-1.0, 0.05, 0.0], integrator, comm, shared_tmp_path)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10
    assert any(row["wall/wall/contacts"] and row["wall/ram/contacts"] for row in rows)
    for row in rows:
        total = row["momentum"] + 0.5 * row["wall/ram/velocity"] - row["wall/wall/impulse"]
        np.testing.assert_allclose(total, [0.5 - 0.0025, 0.0, 0.0], atol=1e-9)


@pytest.mark.parallel
def test_parallel_walls_that_carry_a_node_together_are_told(comm, shared_tmp_path):
    """Which of them carries it is not determined: the run ends, instead of going on with either."""
    with pytest.raises(SimulationFailure) as failure:
        _rammed([-1.0, 0.0, 0.0], "central_differences", comm, shared_tmp_path)
    assert all("walls with mass ('ram') have no position" in text for text in comm.allgather(str(failure.value)))


def _rammed(normal, integrator, comm, folder):
    """The rod and its wall, with a ram of 0.5 kg that comes through the wall at t = 0.2 s, while the tip is on it."""
    wall = 'type = "plane", node_set = "tip"'
    ram = f'{wall}, name = "ram", point = [1.051, 0, 0], normal = {normal}, mass = 0.5, velocity = [-0.005, 0, 0]'
    walls = f'wall=[{{{wall}, name = "wall", point = [1.05, 0, 0], normal = [-1, 0, 0]}}, {{{ram}}}]'
    case = Case.load("rod_impact", [walls, "output.fields_every=0", "time.end=0.4", f"time.integrator={integrator}"])
    return [step.row for step in Simulation(case, comm, output=folder / "rod", quiet=True)]


@pytest.mark.parametrize("integrator", ["central_differences", "chung_lee", "hulbert_chung"])
def test_what_hits_a_truss_at_rest_brings_energy_into_it(integrator, comm, shared_tmp_path):
    """A truss without load has no energy but that of the wall with mass: the run is not taken for unstable.

    A stop of mass M at v on a fixed bar of stiffness k and end mass m, M >> m: it leaves after half a period, and the
    bar's end has moved by v sqrt((M + m)/k) at most.
    """
    mass, speed, area = 50.0, 0.5, 1e-4
    case = Case.from_dict(
        {
            "mesh": {"generator": "rod", "length": 1.0, "elements": 1},
            "node_set": {"foot": {"group": "start"}, "tip": {"group": "end"}},
            "material": {"steel": {"young_modulus": 210e9, "density": 7850.0}},
            "section": {"bar": {"area": area, "material": "steel"}},
            "support": [{"node_set": "foot", "fix": "xyz"}, {"node_set": "tip", "fix": "yz"}],
            "wall": [
                {
                    "name": "stop",
                    "type": "plane",
                    "point": [1.001, 0.0, 0.0],
                    "normal": [-1.0, 0.0, 0.0],
                    "mass": mass,
                    "velocity": [-speed, 0.0, 0.0],
                }
            ],
            "time": {"integrator": integrator, "step": "auto", "end": 0.008},
            "output": {"probe": [{"name": "tip", "node_set": "tip"}]},
        }
    )
    run = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
    rows = [step.row for step in run]
    assert min(row["numerical_dissipation"] for row in rows) < -1e-6  # what the watch of the energy looks at
    reach = speed * np.sqrt((mass + 0.5 * 7850.0 * area) / (210e9 * area))
    assert 1.0 - min(row["probe/tip/position"][0, 0] for row in rows) == pytest.approx(reach, rel=0.03)
    assert rows[-1]["wall/stop/velocity"][0] == pytest.approx(speed, rel=0.03)


@pytest.mark.parametrize("integrator, parameters", [("wilson", {"theta": 1.8}), ("newmark", {})])
def test_wall_is_where_its_state_says_after_every_step(integrator, parameters, comm, shared_tmp_path):
    """The sum of steps and the time of a step differ by rounding: the wall is not at t + theta h for that.

    All the energy is the wall's at the start: none is created by an unstable motion.
    """
    step = 1e-3 / 3.0
    walls = planes([[0.0, 0.0, 1.0]], [-0.02], mass=0.05, velocity=[0.0, 0.0, 5.0], name="ram")
    case = lattice_case(walls, integrator=integrator, step=step, end=30 * step)
    case["time"] |= parameters
    run = simulation(case, comm, shared_tmp_path)
    motion, sums = run.model.contact.motion, 0.0
    for _ in run:
        sums += step
        np.testing.assert_array_equal(motion.displacements(run.state.time)[0], motion.bodies.state.x[0])
    assert sums != run.state.time
    assert np.abs(run.row["wall/ram/impulse"]).max() > 0.0
