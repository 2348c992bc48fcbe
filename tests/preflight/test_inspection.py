"""Checks before a run against counts by hand (Maxwell's rule), and forecasts against the actual run."""

import numpy as np
import pytest
from helpers.runs import inspected
from helpers.small_models import CUBE, CUBE_EDGES, TRUSSES, case_of

from pfem_petsc import Case, Simulation, Truss, preflight
from pfem_petsc.output.units import engineering


def test_two_free_bodies_have_no_mechanisms(comm, shared_tmp_path):
    """Two tetrahedra and a bar: 6, 6 and 5 rigid motions, of which 6 are those of the whole; one of them held: 11."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    points = np.concatenate([corners, corners + 5.0, [[9.0, 0, 0], [9.0, 1, 0]]])
    edges = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    mesh = Truss(points, np.concatenate([edges, edges + 4, [[8, 9]]]))
    data = {
        "node_set": {"held": {"indices": [0, 1, 2]}},
        "material": {"it": {"young_modulus": 1e9, "density": 1e3}},
        "section": {"it": {"area": 1e-4, "material": "it"}},
        "time": {"integrator": "central_differences", "step": 1e-6, "end": 1e-6},
    }
    told = {}
    for name, more in (("free", {}), ("held", {"support": [{"node_set": "held", "fix": "xyz"}]})):
        simulation = Simulation(Case({**data, **more}, mesh=mesh), comm, output=shared_tmp_path / name, check_only=True)
        told[name] = simulation.inspect()[0]["rigidity"]
    free = "30 free directions, 6 rigid motions, 11 of parts against each other, 0 mechanisms, 0 states of self-stress"
    assert told["free"] == free
    assert told["held"].startswith("21 free directions, 0 rigid motions, 11 of parts against each other, 0 mechanisms")


@pytest.mark.parallel
@pytest.mark.parametrize("name", TRUSSES)
def test_mechanisms_and_self_stress(comm, shared_tmp_path, name):
    points, bars, fixed, (unknowns, rigid, mechanisms, stresses, loose) = TRUSSES[name]
    entries, warnings = inspected(case_of(shared_tmp_path, comm, points, bars, fixed), comm)
    found = [int(part.split()[0]) for part in entries["rigidity"].split(";")[0].split(", ")]
    assert found == [unknowns, rigid, mechanisms, stresses]
    # Maxwell's rule: bars - unknowns = self-stresses - free motions
    assert len(bars) - unknowns == stresses - mechanisms - rigid
    free = [text for text in warnings if "can move freely" in text]
    assert [text.startswith(f"{loose} node") for text in free] == [True] * bool(loose)
    assert name != "square with a whip" or "the first is node 4. Was the mesh subdivided?" in free[0]


@pytest.mark.parallel
@pytest.mark.parametrize(
    ("override", "texts"),
    [
        ("material.steel.young_modulus=210000", ["material.steel.young_modulus = 210000 Pa", "5.172 m/s"]),
        ("material.steel.density=7.85e-9 time.step=auto", ["material.steel.density = 7.85e-09 kg/m3"]),
        ("material.steel.yield_stress=1e12", ["material.steel.yield_stress = 1e+12 Pa"]),
        ("material.steel.kinematic_hardening=0.0", ["material.steel yields without hardening", "depend on the mesh"]),
        ("section.default.area=100.0", ["section.default: area = 100 m2"]),
        ("initial.velocity=[6000,0,0]", ["node ", "starts at 6.000 km/s, faster than waves"]),
        ("wall.0.normal=[1,0,0] wall.0.point=[-30,0,0]", ["no node moves towards wall 'wall'"]),
    ],
)
def test_odd_values_are_told(comm, override, texts):
    _, told = inspected(Case.load("ring_impact", override.split()), comm)
    assert all(text in told[0] for text in texts)


@pytest.mark.parametrize("told", [True, False])
def test_damping_on_ground_that_moves_on(comm, told):
    """A ground at a constant velocity V loads by a V alone; beside an acceleration of 8 m/s2 that is little."""
    rows = [1.0, 0.0, 0.0] if told else [[0.0, 0.0, 0.0, 0.0], [0.1, 0.8, 0.0, 0.0], [0.2, 0.0, 0.0, 0.0]]
    case = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
        "node_set": {"ground": {"group": "start"}},
        "material": {"m": {"young_modulus": 1e9, "density": 1e3}},
        "damping": {"ratio": 0.02, "frequencies": [1.0]},
        "section": {"s": {"area": 1e-4, "material": "m"}},
        "support": [{"node_set": "ground", "fix": "xyz", "velocity": rows}],
        "time": {"integrator": "newmark", "step": 1e-3, "end": 0.2},
    }
    _, warnings = inspected(Case.from_dict(case), comm)
    assert any("damping acts on absolute velocities" in text for text in warnings) == told


def test_far_from_the_origin(comm, shared_tmp_path):
    points, bars, _, _ = TRUSSES["tetrahedron"]
    _, (text,) = inspected(case_of(shared_tmp_path, comm, np.add(points, 1e7), bars), comm)
    assert "away from the origin" in text


@pytest.mark.parametrize(
    "name", ["rod_impact", "ring_impact", "lattice_drop", "pendulum", "tumbling_lattice", "dome_earthquake"]
)
def test_sound_cases_have_no_warnings(comm, name):
    overrides = ["mesh.cells=[3,3,3]", "node_set.top.nearest=[0.03,0.03,0.03]"] if name == "lattice_drop" else []
    assert inspected(Case.load(name, overrides), comm)[1] == []


@pytest.mark.parametrize(
    "moves", ["velocity=[0,0,0.5]", "mass=1.0, velocity=[0,0,0.5]", "motion=[[0,0,0,0],[1,0,0,0.5]]"]
)
def test_wall_that_moves_may_push_against_another(comm, moves):
    """A truss at rest between a wall that rises and one that stands."""
    walls = f"wall=[{{type='plane', point=[0,0,-0.1], normal=[0,0,1], {moves}}}, "
    walls += "{type='plane', point=[0,0,0.9], normal=[0,0,-1]}]"
    case = Case.load("lattice_drop", ["mesh.cells=[2,2,2]", "initial.velocity=[0,0,0]", walls])
    assert not any("no node moves" in text for text in inspected(case, comm)[1])


def test_gaps_of_a_static_analysis_close_per_load_factor(comm):
    """A wall that rises by 0.25 m a unit of the load factor has no speed."""
    wall = "wall=[{name='w', type='plane', point=[0,0,-0.1], normal=[0,0,1], velocity=[0,0,0.25]}]"
    data = Case.load("lattice_drop", ["mesh.cells=[2,2,2]", wall]).to_dict()
    del data["time"], data["initial"]
    entries, _ = inspected(Case.from_dict(data | {"static": {"step": 0.5, "end": 2.0}}), comm)
    told = next(text for label, text in entries.items() if label.endswith("w") and "gap" in text)
    assert "closing at up to 250.0 mm per unit of the load factor" in told


def test_memory_that_the_machine_lacks(comm, monkeypatch):
    simulation = Simulation(Case.load("rod_impact"), comm, check_only=True)
    assert simulation.inspect()[1] == []
    monkeypatch.setattr(preflight, "memory_of_machine", lambda: 1e8)
    (text,) = simulation.inspect()[1]
    assert "and it has 100 MB" in text


def test_a_run_needs_at_least_the_memory_that_is_used_before_it(comm, monkeypatch):
    simulation = Simulation(Case.load("rod_impact"), comm, check_only=True)
    monkeypatch.setattr(preflight, "_used", lambda: 5e9)
    used = engineering(5e9 * comm.size, "B", 3)
    assert simulation.summary()["memory"] == f"{used} used so far, on all ranks"
    assert simulation.inspect()[0]["memory needed"] == f"about {used} by the end of the run, on all ranks"


@pytest.mark.parallel
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
    forecasts = simulation.inspect()[0]
    assert simulation.run() == 0
    comm.Barrier()
    for file, label, close in (("result.vtkhdf", "result file", 0.25), ("checkpoint.h5", "checkpoints", 0.5)):
        number, unit = forecasts[label].split("about ")[1].split()
        expected = float(number) * {"kB": 1e3, "MB": 1e6}[unit]
        assert (shared_tmp_path / "out" / file).stat().st_size == pytest.approx(expected, rel=close)


@pytest.mark.parametrize(
    ("scale", "area", "told"), [(1.0, 1e-4, False), (90.0, 1e-4, False), (1e3, 1e-4, True), (1e3, 1e2, False)]
)
def test_a_mesh_in_millimetres_is_told(comm, shared_tmp_path, scale, area, told):
    """A tower of bars of 1 m to 1.4 m with areas in square metres, in metres and in millimetres."""
    points = scale * np.array(CUBE)
    section = {"default": {"area": area, "material": "steel"}}
    _, texts = inspected(case_of(shared_tmp_path, comm, points, CUBE_EDGES, section=section), comm)
    texts = [text for text in texts if "is the mesh in millimetres?" in text]
    assert len(texts) == told
    assert not told or "a bar of 1.000 km is 100,000 times as long as it is thick (area = 0.0001 m2)" in texts[0]


@pytest.mark.parallel
def test_warnings_of_later_stages(comm):
    """What depends on the tables of a stage is reported for each, and what does not for the first alone."""
    time = {"integrator": "newmark", "step": 1e-4, "end": 1e-3, "beta": 0.25, "gamma": 0.5}
    case = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": 4},
        "node_set": {"base": {"indices": [0]}, "all": {"all": True}},
        "material": {"m": {"young_modulus": 1e6, "density": 0.01}},
        "section": {"s": {"area": 1e-2, "material": "m"}},
        "support": [{"node_set": "all", "fix": "yz"}, {"node_set": "base", "fix": "x"}],
        "stage": [
            {"name": "one", "time": time},
            {"name": "two", "time": time, "initial": {"velocity": [1e5, 0.0, 0.0]}},
        ],
    }
    _, told = inspected(Case.from_dict(case), comm)
    assert sum("density = 0.01" in text for text in told) == 1
    (two,) = [text for text in told if text.startswith("stage 'two': ")]
    assert "faster than waves" in two
