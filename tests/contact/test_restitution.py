"""Restitution by a jump of velocity: heights of bounces, moving walls, and energy that does not grow."""

import numpy as np
import pytest
from helpers.lattices import lattice_case, planes, simulation
from helpers.stopped import assert_as_on_one_rank, assert_restart_is_bitwise

from pfem_petsc import Case
from pfem_petsc.errors import InputError

G = 9.81
SCHEMES = [
    ("chung_lee", {}),
    ("hulbert_chung", {"rho_b": 0.5}),
    ("newmark", {}),
    ("newmark", {"beta": 0.25, "gamma": 0.5}),
    ("houbolt", {}),
    ("generalized_alpha", {}),
    ("energy_momentum", {}),
]


def bar(integrator, parameters, wall, *, velocity=0.0, gravity=G, step=1e-3, end=0.8, **tables):
    """A bar that is level: all its nodes do the same."""
    return {
        "mesh": {"generator": "rod", "length": 0.2, "elements": 2},
        "material": {"m": {"young_modulus": 1e6, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "initial": {"velocity": [0.0, 0.3, velocity]},
        "gravity": {"acceleration": [0.0, 0.0, -gravity]},
        "wall": [{"type": "plane", "name": "floor", "normal": [0.0, 0.0, 1.0], **wall}],
        "time": {"integrator": integrator, "step": step, "end": end, **parameters},
        "output": {"fields_every": 0},
        "solver": {"rtol": 1e-13},
        **tables,
    }


@pytest.mark.slow
@pytest.mark.parametrize(("restitution", "treatment"), [(0.5, "scheme"), (0.9, "stick"), (1.0, "scheme")])
@pytest.mark.parametrize("integrator, parameters", [("central_differences", {}), *SCHEMES])
def test_heights_of_bounces(integrator, parameters, restitution, treatment, comm, shared_tmp_path):
    """Dropped from h, a bar reaches e^(2n) h after n bounces: so its energy in flight says, to 1e-10."""
    height = 0.1
    case = bar(integrator, parameters, {"point": [0.0, 0.0, -height], "restitution": restitution})
    case["contact"] = {"treatment": "scheme" if integrator == "central_differences" else treatment}
    run = simulation(case, comm, shared_tmp_path)
    rows = [step.row for step in run]
    mass = run.model.total_mass
    energies = [
        (row["kinetic_energy"] / mass - 0.5 * 0.3**2 + G * (row["centre_of_mass"][2] + height)) / (G * height)
        for row in rows
    ]
    fall, bounces = np.sqrt(2.0 * height / G), 0
    time = fall
    for n in range(1, 5):
        flight = 2.0 * restitution**n * fall
        # every bounce is late by less than a step; velocities of central differences contain the step that follows
        last = time + flight - (1e-3 if integrator == "central_differences" else 0.0)
        inside = [e for row, e in zip(rows, energies, strict=True) if time + n * 1e-3 < row["time"] < last]
        time += flight
        if time > 0.8 or flight < 0.05:
            break
        np.testing.assert_allclose(inside, restitution ** (2 * n), rtol=1e-10)
        bounces = n
    assert bounces >= (2 if restitution > 0.5 else 1)
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-14
    np.testing.assert_allclose([row["momentum"][1] for row in rows], 0.3 * mass, rtol=1e-12)


@pytest.mark.parametrize("integrator, parameters", [*SCHEMES, ("wilson", {"theta": 1.5})])
def test_moving_wall(integrator, parameters, comm, shared_tmp_path):
    """The velocity relative to the wall is turned round and multiplied by e."""
    restitution, speed, wall = 0.6, -1.0, np.array([0.2, 0.0, 0.5])
    keys = {"point": [0.0, 0.0, -0.05], "restitution": restitution, "velocity": wall.tolist()}
    run = simulation(bar(integrator, parameters, keys, velocity=speed, gravity=0.0, end=0.1), comm, shared_tmp_path)
    last = [step.row for step in run][-1]
    expected = [0.0, 0.3, wall[2] - restitution * (speed - wall[2])]
    np.testing.assert_allclose(last["momentum"] / run.model.total_mass, expected, atol=1e-11)
    assert last["wall/floor/releases"] == 3


def tumbling(integrator, parameters, restitution, end=0.05, walls=None, **tables):
    walls = planes([[0.3, -0.2, 1.0], [1.0, 0.0, 0.1]], [-0.02, -0.03]) if walls is None else walls
    case = lattice_case(
        [wall | {"restitution": restitution} for wall in walls],
        velocity=[-1.0, -0.5, -3.0],
        spin=[10.0, 20.0, -15.0],
        integrator=integrator,
        end=end,
        **{"solver": {"rtol": 1e-13}, **tables},
    )
    case["time"] |= parameters
    return case


@pytest.mark.few_sets
@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.5, 1.0])
@pytest.mark.parametrize("integrator, parameters", SCHEMES)
def test_energy_does_not_grow(integrator, parameters, restitution, comm, shared_tmp_path):
    """A lattice that tumbles against two walls."""
    case = tumbling(integrator, parameters, restitution, contact={"treatment": "stick"})
    rows = [step.row for step in simulation(case, comm, shared_tmp_path)]
    energy = np.array([row["kinetic_energy"] + row["elastic_energy"] for row in rows])
    assert energy.max() < 1.01 * energy[0]
    assert sum(row["active_set_changes"] for row in rows) >= 10
    assert max(abs(row["energy_imbalance"]) for row in rows) < 1e-10 * energy[0]
    if integrator == "energy_momentum" and restitution == 1.0:
        assert energy[-1] > 0.8 * energy[0]


@pytest.mark.parametrize(
    ("integrator", "wall", "tables", "message"),
    [
        ("newmark", {"friction": 0.1}, {}, "restitution together with friction needs central_differences"),
        ("newmark", {"mass": 1.0}, {}, "restitution of a wall with mass needs central_differences"),
        ("newmark", {}, {"contact": {"treatment": "conserving"}}, 'needs contact.treatment = "scheme" or "stick"'),
        (
            "central_differences",
            {},
            {"contact": {"treatment": "stick"}},
            'restitution needs contact.treatment = "scheme"',
        ),
        ("newmark", {}, {"time": {"mass": "consistent"}}, 'restitution needs time.mass = "lumped"'),
    ],
)
def test_refused(integrator, wall, tables, message, comm, shared_tmp_path):
    case = bar(integrator, {}, {"point": [0.0, 0.0, -0.1], "restitution": 0.5, **wall})
    case["time"] |= tables.pop("time", {})
    with pytest.raises(InputError, match=message):
        simulation(case | tables, comm, shared_tmp_path)


@pytest.mark.slow
@pytest.mark.parallel
@pytest.mark.parametrize("integrator", ["chung_lee", "newmark"])
def test_any_number_of_ranks(integrator, comm, shared_tmp_path):
    """The run on all ranks is that on one, and a run in two parts is the run in one, bit for bit."""
    solver = {"rtol": 1e-13, "linear": "cg"}
    case = Case.from_dict(tumbling(integrator, {}, 0.8, 0.03, solver=solver))
    history = assert_restart_is_bitwise(case, comm, shared_tmp_path, 100)
    assert history["wall/wall1/releases"][-1] >= 1
    names = "wall/wall1/releases", "impact_dissipation", "centre_of_mass", "elastic_energy"
    assert_as_on_one_rank(history, case, comm, shared_tmp_path, *names, within=1e-8)


@pytest.mark.parametrize(
    ("integrator", "parameters", "treatment", "restitution"),
    [
        *((name, {}, "scheme", e) for name in ("central_differences", "chung_lee") for e in (0.5, 1.0)),
        ("central_differences", {}, "scheme", 0.0),
        ("chung_lee", {}, "stick", 0.0),
        *((name, {}, "stick", e) for name in ("energy_momentum", "houbolt", "generalized_alpha") for e in (0.0, 0.5)),
        ("newmark", {"beta": 0.25, "gamma": 0.5}, "stick", 0.0),
        ("newmark", {"beta": 0.25, "gamma": 0.5}, "conserving", 0.0),
    ],
)
def test_guided_node_on_an_oblique_wall(integrator, parameters, treatment, restitution, comm, shared_tmp_path):
    """An end of a bar, free along y and z, hits a wall with normal (0.6, 0, 0.8), which stops its motion along z.

    What leaves is e times that; the energy of it, m (1 - e^2)/2, is that of the impact. Supports take the rest.
    """
    case = {
        "mesh": {"generator": "rod", "length": 0.2, "elements": 1},
        "material": {"m": {"young_modulus": 1e3, "density": 1000.0}},
        "section": {"s": {"area": 1e-5, "material": "m"}},
        "node_set": {"all": {"all": True}, "start": {"group": "start"}},
        "support": [{"node_set": "all", "fix": "x"}],
        "initial": {"velocity": [0.0, 0.3, -1.0]},
        "wall": [{"type": "plane", "name": "slope", "node_set": "start", "point": [0.0, 0.0, -0.0103]}],
        "contact": {"treatment": treatment},
        "time": {"integrator": integrator, "step": 1e-3, "end": 0.015, **parameters},
        "output": {"fields_every": 0, "probe": [{"name": "end", "node_set": "start"}]},
        "solver": {"linear": "mumps", "rtol": 1e-12},
    }
    case["wall"][0] |= {"normal": [0.6, 0.0, 0.8], "restitution": restitution}
    run = simulation(case, comm, shared_tmp_path)
    last = [step.row for step in run][-1]
    leaves = 1.0 if treatment == "conserving" else restitution
    np.testing.assert_allclose(last["probe/end/velocity"], [[0.0, 0.3, leaves]], atol=2e-3)
    mass = 0.5 * run.model.total_mass
    assert last["impact_dissipation"] == pytest.approx(0.5 * mass * (1.0 - leaves**2), abs=1e-12)
    assert abs(last["numerical_dissipation"]) < 2e-6 * mass
    assert abs(last["energy_imbalance"]) < 1e-15


def test_rough_cylinders_return_nodes_too(comm, tmp_path):
    """A bar that falls along a cylinder does not slide, so friction changes nothing."""
    case = bar("central_differences", {}, {}, velocity=-1.0, gravity=0.0, end=0.3)
    case["initial"]["velocity"] = [0.0, 0.0, -1.0]
    roller = {"point": [0.0, 0.0, -0.6005], "axis": [1.0, 0.0, 0.0], "radius": 0.5, "restitution": 0.8, "friction": 0.3}
    case["wall"] = [{"type": "cylinder", "name": "roller", **roller}]
    run = simulation(case, comm, tmp_path)
    for _ in run:
        pass
    np.testing.assert_allclose(run.state.v, np.broadcast_to([0.0, 0.0, 0.8], run.state.v.shape), atol=1e-9)
