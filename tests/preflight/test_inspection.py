"""Checks before a run against counts by hand (Maxwell's rule), and forecasts against the actual run."""

import numpy as np
import pytest
from helpers.counted import CUBE, CUBE_EDGES, TRUSSES
from helpers.mesh_files import case_of

from pfem_petsc import Case, Simulation
from pfem_petsc.preflight.forecast import checkpoint_bytes
from pfem_petsc.preflight.inspection import warnings_before
from pfem_petsc.preflight.parts import count_parts
from pfem_petsc.preflight.rigidity import global_rigidity, unbraced_nodes

pytestmark = pytest.mark.parallel


@pytest.mark.parametrize("name", TRUSSES)
def test_mechanisms_and_self_stress(comm, shared_tmp_path, name):
    points, bars, fixed, (unknowns, rigid, mechanisms, stresses, loose) = TRUSSES[name]
    model = Simulation(case_of(shared_tmp_path, comm, points, bars, fixed), comm, check_only=True).model
    found = global_rigidity(model)
    assert found[:1] + found[2:5] == (unknowns, rigid, mechanisms, stresses)
    # Maxwell's rule: bars - unknowns = self-stresses - free motions
    assert len(bars) - found.unknowns == found.self_stresses - found.mechanisms - found.rigid_motions
    assert unbraced_nodes(model)[0] == loose


def test_unbraced_node_is_named(comm, shared_tmp_path):
    points, bars, _, _ = TRUSSES["square with a whip"]
    simulation = Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True)
    (text,) = warnings_before(simulation.case, simulation.model, simulation.plan)
    assert text.startswith("1 node can move freely")
    assert text.endswith("the first is node 4")


def test_parts(comm, shared_tmp_path):
    """Rings of bars whose numbers wander, one of them apart."""
    random = np.random.default_rng(4)
    sizes = [60, 41, 7]
    numbers = random.permutation(sum(sizes))
    points = random.random((sum(sizes), 3))
    bars, at = [], 0
    for size in sizes:
        ring = numbers[at : at + size]
        bars += list(zip(ring, np.roll(ring, 1), strict=True))
        at += size
    model = Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True).model
    assert count_parts(model.mesh) == (3, 7, int(numbers[-7:].min()))
    simulation = Simulation(case_of(shared_tmp_path, comm, points, bars), comm, check_only=True)
    texts = warnings_before(simulation.case, simulation.model, simulation.plan)
    assert any("in 3 parts that no bar connects" in text for text in texts)


@pytest.mark.parametrize(
    ("override", "texts"),
    [
        ("material.steel.young_modulus=210000", ["material.steel.young_modulus = 210000 Pa", "5.172 m/s"]),
        ("material.steel.density=7.85e-9 time.step=auto", ["material.steel.density = 7.85e-09 kg/m3"]),
        ("material.steel.yield_stress=1e12", ["material.steel.yield_stress = 1e+12 Pa"]),
        ("material.steel.kinematic_hardening=0.0", ["material.steel yields without hardening", "depend on the mesh"]),
        ("material.steel.softening=[[0,1.0,1.0]]", ["material.steel.softening", "the reference temperature"]),
        ("section.default.area=100.0", ["section.default.area = 100 m2"]),
        ("initial.velocity=[6000,0,0]", ["node ", "starts at 6.000 km/s, faster than waves"]),
        ("wall.0.normal=[1,0,0] wall.0.point=[-30,0,0]", ["no node moves towards wall 'wall'"]),
    ],
)
def test_odd_values_are_told(comm, override, texts):
    simulation = Simulation(Case.load("ring_impact", override.split()), comm, check_only=True)
    told = warnings_before(simulation.case, simulation.model, simulation.plan)
    assert told
    for text in texts:
        assert text in told[0]


@pytest.mark.slow
def test_ground_accelerations_in_other_units_are_told(comm):
    overrides = ["stage.1.support.0.acceleration=[[0.0,0,0,0],[0.5,300.0,0,0],[1.0,0,0,0]]"]
    _, told = Simulation(Case.load("dome_earthquake", overrides), comm, check_only=True).inspect()
    (text,) = [text for text in told if "acceleration" in text]
    assert "stage[1].support[0].acceleration reaches 300 m/s2, 30.6 g" in text and "scale = 0.01" in text
    _, told = Simulation(
        Case.load("dome_earthquake", ["gravity.acceleration=[0,0,-9810]"]), comm, check_only=True
    ).inspect()
    assert [text for text in told if "gravity.acceleration reaches 9810 m/s2" in text] == told
    assert Simulation(Case.load("dome_earthquake"), comm, check_only=True).inspect()[1] == []


def test_far_from_the_origin(comm, shared_tmp_path):
    points, bars, _, _ = TRUSSES["tetrahedron"]
    simulation = Simulation(case_of(shared_tmp_path, comm, np.add(points, 1e7), bars), comm, check_only=True)
    (text,) = warnings_before(simulation.case, simulation.model, simulation.plan)
    assert "away from the origin" in text


@pytest.mark.parametrize("name", ["rod_impact", "ring_impact", "lattice_drop", "pendulum", "tumbling_lattice"])
def test_sound_cases_have_no_warnings(comm, name):
    overrides = ["mesh.cells=[3,3,3]", "node_set.top.nearest=[0.03,0.03,0.03]"] if name == "lattice_drop" else []
    simulation = Simulation(Case.load(name, overrides), comm, check_only=True)
    assert warnings_before(simulation.case, simulation.model, simulation.plan) == []


@pytest.mark.parametrize(
    "moves", ["velocity=[0,0,0.5]", "mass=1.0, velocity=[0,0,0.5]", "motion=[[0,0,0,0],[1,0,0,0.5]]"]
)
def test_wall_that_moves_may_push_against_another(comm, moves):
    """A truss at rest between a wall that rises and one that stands."""
    walls = f"wall=[{{type='plane', point=[0,0,-0.1], normal=[0,0,1], {moves}}}, "
    walls += "{type='plane', point=[0,0,0.9], normal=[0,0,-1]}]"
    case = Case.load("lattice_drop", ["mesh.cells=[2,2,2]", "initial.velocity=[0,0,0]", walls])
    simulation = Simulation(case, comm, check_only=True)
    assert not any("no node moves" in text for text in warnings_before(case, simulation.model, simulation.plan))


def test_memory_that_the_machine_lacks(comm, monkeypatch):
    from pfem_petsc.preflight import forecast

    simulation = Simulation(Case.load("rod_impact"), comm, check_only=True)
    assert forecast.memory_warning(simulation.case, simulation.model, simulation.plan) == []
    monkeypatch.setattr(forecast, "memory_of_machine", lambda: 1e8)
    (text,) = forecast.memory_warning(simulation.case, simulation.model, simulation.plan)
    assert "and it has 100 MB" in text


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("rod_impact", ["mesh.elements=2000", "time.step=1e-4", "time.end=0.05"]),
        ("ring_impact", ["time.end=0.1", "output.history_every=3"]),
        ("lattice_drop", ["mesh.cells=[8,8,8]", "time.end=1e-4"]),
        ("rod_impact", ["output.fields_every=0", "time.end=30"]),
    ],
)
def test_files_are_as_large_as_forecast(comm, shared_tmp_path, name, overrides):
    case = Case.load(name, [*overrides, "output.checkpoint_every=100"])
    simulation = Simulation(case, comm, output=shared_tmp_path / "out", quiet=True)
    from pfem_petsc.preflight.forecast import result_bytes
    from pfem_petsc.run.recorder import Recorder

    columns, fields = Recorder(simulation.stepper).columns, simulation.outputs.fields
    forecast = result_bytes(case, simulation.mesh, simulation.plan.steps, fields.points, fields.cells, columns)
    assert simulation.run() == 0
    comm.Barrier()
    assert (shared_tmp_path / "out" / "result.vtkhdf").stat().st_size == pytest.approx(forecast, rel=0.25)
    held = (shared_tmp_path / "out" / "checkpoint.h5").stat().st_size
    assert held == pytest.approx(checkpoint_bytes(simulation.model), rel=0.5)


@pytest.mark.parametrize(
    ("scheme", "warns"),
    [
        ("newmark', beta=0.25, gamma=0.5", True),
        ("newmark'", False),
        ("energy_momentum'", True),
        ("generalized_alpha', rho_inf=1.0", True),
        ("generalized_alpha'", False),
        ("central_differences'", True),
        ("chung_lee', beta=1.0", True),
        ("hulbert_chung'", False),
        ("houbolt'", False),
    ],
)
def test_jumps_of_velocity_are_warned_of_where_they_stay(comm, scheme, warns):
    time = f"time={{integrator='{scheme}, step=1e-3, end=0.1}}"
    for interpolation in ("linear", "smooth"):
        moved = (
            f"support=[{{node_set='hinge', fix='xyz', motion=[[0,0,0,0],[1,1,0,0]], interpolation='{interpolation}'}}]"
        )
        simulation = Simulation(Case.load("pendulum", [time, moved]), comm, check_only=True)
        told = warnings_before(simulation.case, simulation.model, simulation.plan)
        found = [line for line in told if "velocity jumps at each of the 2 rows" in line]
        assert len(found) == (warns and interpolation == "linear")


@pytest.mark.parametrize(
    ("scale", "area", "told"), [(1.0, 1e-4, False), (90.0, 1e-4, False), (1e3, 1e-4, True), (1e3, 1e2, False)]
)
def test_a_mesh_in_millimetres_is_told(comm, shared_tmp_path, scale, area, told):
    """A tower of bars of 1 m to 1.4 m with areas in square metres, in metres and in millimetres."""
    points = scale * np.array(CUBE)
    case = case_of(shared_tmp_path, comm, points, CUBE_EDGES)
    data = case.to_dict()
    for section in data["section"].values():
        section["area"] = area
    simulation = Simulation(Case.from_dict(data), comm, check_only=True)
    texts = [
        text
        for text in warnings_before(simulation.case, simulation.model, simulation.plan)
        if "is the mesh in millimetres?" in text
    ]
    assert len(texts) == told
    assert not told or "a bar of 1.000 km is 100,000 times as long as it is thick (area = 0.0001 m2)" in texts[0]


@pytest.mark.parametrize(("point", "told"), [([1.0, 1.0, 1.9], False), ([0.0, 0.0, 3.5], True)])
def test_a_node_far_from_the_point_it_is_asked_for_is_told(comm, shared_tmp_path, point, told):
    data = case_of(shared_tmp_path, comm, CUBE, CUBE_EDGES).to_dict()
    data["node_set"] = {"top": {"nearest": point}}
    simulation = Simulation(Case.from_dict(data), comm, check_only=True)
    text = simulation.inspect()[0].get("node set top", "")
    assert bool(text) == told
    assert not told or text.startswith("the nearest node is node 4, 2.500 m away from the point, more than")


@pytest.mark.parallel
def test_warnings_of_later_stages(comm):
    """What depends on the tables of a stage is reported for each, and what does not for the first alone."""
    time = {"integrator": "newmark", "step": 1e-4, "end": 1e-3, "beta": 0.25, "gamma": 0.5}
    jumps = [[0.0, 0.0, 0.0, 0.0], [0.5, 0.1, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
    base = {"node_set": "base", "fix": "x"}
    case = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
        "node_set": {"base": {"indices": [0]}, "all": {"all": True}},
        "material": {"m": {"young_modulus": 1e6, "density": 0.01}},
        "section": {"s": {"area": 1e-2, "material": "m"}},
        "support": [{"node_set": "all", "fix": "yz"}, base],
        "stage": [
            {"name": "one", "time": time},
            {"name": "two", "time": time, "initial": {"velocity": [1e5, 0.0, 0.0]}},
            {
                "name": "three",
                "time": time,
                "support": [{"node_set": "all", "fix": "yz"}, base | {"motion": jumps, "interpolation": "linear"}],
            },
        ],
    }
    simulation = Simulation(Case.from_dict(case), comm, check_only=True)
    _, told = simulation.inspect()
    assert sum("density = 0.01" in text for text in told) == 1
    (two,) = [text for text in told if text.startswith("stage 'two': ")]
    assert "faster than waves" in two
    (three,) = [text for text in told if text.startswith("stage 'three': ")]
    assert "support[1]" in three and "the velocity jumps" in three
