"""Cases that are made and changed as objects: validated at once, with the messages of case files."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from pydantic import ValidationError

from pfem_petsc import Case, InputError
from pfem_petsc.case.editing import tables_of
from pfem_petsc.case.toml import built_in_cases

STAGED = """
[mesh]
generator = "rod"
length = 1.0
elements = 3
[node_set.start]
group = "start"
[node_set.end]
group = "end"
[material.steel]
young_modulus = 2e11
density = 7800.0
[section.all]
area = 1e-4
material = "steel"
[[support]]
node_set = "start"
fix = "xyz"
[[stage]]
name = "pull"
static = { step = 0.5 }
load = [{ node_set = "end", force = [1e3, 0, 0] }]
[[stage]]
name = "swing"
time = { integrator = "newmark", step = 1e-4, end = 1e-3 }
output = { fields_every = 5 }
"""


@pytest.fixture
def case(case_file):
    return Case.from_file(case_file)


def file_message(case_file, *overrides):
    with pytest.raises(InputError) as caught:
        Case.load(case_file, overrides)
    return str(caught.value).replace(" (given by --set)", "")


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("time.step", -1.0, "-1.0"),
        ("time.step", "1 ms", '"1 ms"'),
        ("time.stepp", 1.0, "1.0"),
        ("time.integrator", "newmrk", '"newmrk"'),
        ("wall[0].normal", [0.0, 0.0], "[0.0, 0.0]"),
        ("load[0].node_set", "tipp", '"tipp"'),
        ("mesh.elements", 2.5, "2.5"),
        ("section.strut.material", "gold", '"gold"'),
        ("output.fields", ["speed"], '["speed"]'),
    ],
)
def test_refused_with_the_message_of_a_file(case, case_file, key, value, text):
    before = case.to_toml()
    with pytest.raises(InputError) as caught:
        case.update({key: value})
    assert str(caught.value) == file_message(case_file, f"{key}={text}")
    assert caught.value.exit_status == 2
    assert case.to_toml() == before


def test_attributes_are_validated_and_stay_references(case, case_file):
    time, wall, material = case.time, case.wall[0], case.material["steel"]
    time.step = 1e-3
    wall.point = np.array([2.0, 0.0, 0.0])
    material.young_modulus = 3
    assert case.time is time and case.wall[0] is wall and case.material["steel"] is material
    assert (time.step, wall.point, material.young_modulus) == (1e-3, (2.0, 0.0, 0.0), 3.0)
    assert case == Case.load(case_file, ["time.step=1e-3", "wall.0.point=[2,0,0]", "material.steel.young_modulus=3"])
    with pytest.raises(InputError, match=r"material.steel.density = -1.0: expected a value > 0 \(mass density"):
        material.density = -1.0
    assert material.density == Case.load(case_file).material["steel"].density
    with pytest.raises(InputError, match="gravty: a case has no table of this name, did you mean 'gravity'"):
        case.gravty = {}
    with pytest.raises(InputError, match="nodal masses are point_mass"):
        case.mass = []


def test_parameters_of_schemes_and_generators_are_attributes(case):
    case.update({"time.integrator": "newmark", "time.step": 0.01})
    case.time.beta = 0.25
    assert (case.time.beta, case.time.scheme.beta, case.time.gamma) == (0.25, 0.25, 1.5)
    assert {"beta", "gamma", "step"} <= set(dir(case.time)) and "elements" in dir(case.mesh)
    case.mesh.elements += 1
    assert case.mesh.elements == case.mesh.parameters.elements == 5
    with pytest.raises(InputError, match="time.beta: a key of chung_lee, newmark, not of houbolt"):
        case.time.integrator = "houbolt"
    case.update({"time.integrator": "houbolt", "time.beta": None})
    assert not hasattr(case.time, "beta")
    del case.time.mass
    with pytest.raises(InputError, match="time.step: this key is missing"):
        case.time.step = None


def test_defaults_that_were_not_given_follow(case):
    """Newmark's beta is not given, so that another scheme may follow; to_dict would have it as a key."""
    case.time.integrator = "newmark"
    case.time.integrator = "wilson"
    assert case.time.theta == 1.4


def test_lists_and_named_tables(case):
    walls, first = case.wall, case.wall[0]
    case.wall.append({"name": "second", "type": "plane", "point": (0, 0, 0), "normal": (1, 0, 0)})
    case.wall.insert(0, {"name": "zeroth", "type": "plane", "point": (0, 0, 0), "normal": (1, 0, 0)})
    assert case.wall is walls and case.wall[1] is first and len(case.wall) == 3
    first.point = (9.0, 0.0, 0.0)
    assert case.wall[1].point == (9.0, 0.0, 0.0)
    gone = case.wall.pop(0)
    with pytest.raises(ValidationError, match="frozen"):
        gone.name = "other"
    case.wall = case.wall[:1]
    assert [wall.name for wall in case.wall] == [first.name]
    case.material["b"] = case.material["steel"]
    case.material["b"].density = 5.0
    assert case.material["steel"].density != 5.0
    with pytest.raises(InputError, match="there is no material of this name"):
        del case.material["steel"]
    case.section["strut"].material = "b"
    case.material.pop("steel")
    assert list(case.material) == ["b"]
    case.gravity = {"acceleration": [0, 0, -9.81]}
    case.gravity = None
    assert case.gravity is None
    case.initial = {"velocity": [1, 0, 0]}
    case.initial.append({"node_set": "tip", "velocity": [2, 0, 0]})
    case.initial[1].velocity = (3, 0, 0)
    assert [entry.velocity[0] for entry in case.initial] == [1.0, 3.0]
    assert Case.from_toml(case.to_toml()) == case


def test_copies_are_independent(case):
    case.wall[0].name = "w"
    copies = [case.copy(), copy.copy(case), copy.deepcopy(case), pickle.loads(pickle.dumps(case))]
    case.time.end = 7.0
    case.wall[0].name = "v"
    for other in copies:
        assert other.time.end != 7.0 and other.wall[0].name == "w"
        other.time.end = 8.0
        assert other.time.end == 8.0 and case.time.end == 7.0
    changed = case.copy({"time.end": 9.0})
    assert (changed.time.end, case.time.end) == (9.0, 7.0)
    assert repr(changed) == repr(case)


def test_copies_and_updates_take_what_the_constructor_takes(case):
    renamed = case.copy({"name": "short", "time.end": 2.0})
    assert (renamed.name, renamed.time.end, case.name) == ("short", 2.0, "rod")
    assert case.copy({"time.end": 2.0}, name="b", title="B").title == "B"
    renamed.update(name="again", point_mass=[{"node_set": "tip", "value": 3.0}])
    renamed.update({"point_mass[0].value": 4.0})
    assert (renamed.name, renamed.point_mass[0].value) == ("again", 4.0)
    with pytest.raises(InputError, match=r"time\.end = -1"):
        renamed.update({"name": "lost", "time.end": -1})
    for wrong in ("", 5, None, "/tmp/a", "../a"):
        with pytest.raises(InputError, match="name = .*: expected"):
            renamed.name = wrong
        with pytest.raises(InputError, match="name = .*: expected"):
            renamed.copy({"name": wrong})
    assert renamed.name == "again"
    with pytest.raises(InputError, match="the case of a simulation cannot be changed"):
        case.copy(fixed=True).name = "other"
    for key in ("folder", "source", "overrides"):
        with pytest.raises(InputError, match=f"{key}: unknown key; it is an argument of Case"):
            case.copy({key: "x"})
    with pytest.raises(InputError, match="name: unknown key; the name of a case is that of its file"):
        Case.from_toml('name = "x"\n' + case.to_toml())


def test_case_of_tables_by_name(case, case_file):
    tables = case.to_dict()
    assert Case(tables) == Case(**tables) == case
    assert Case(tables, title="other", name="n").title == "other"
    assert Case({**tables, "wall": list(case.wall), "time": case.time}) == case
    arrays = {"generator": "arrays", "points": np.eye(2, 3), "bars": np.array([[0, 1]])}
    assert Case(tables, mesh=arrays).mesh.parameters.truss.n_nodes == 2
    with pytest.raises(InputError, match="unknown key, did you mean 'material'"):
        Case(tables, meterial={})
    with pytest.raises(InputError, match="expected nested tables, got 3"):
        Case(3)


def test_stages_change_where_their_tables_are():
    case = Case.from_toml(STAGED)
    case.stage[1].time.step = 2e-4
    case.stage[1].material["steel"].density = 7000.0  # of the case
    case.stage[1].load[0].force = (2e3, 0, 0)  # of the first stage, in force in the second
    case.stage[0].gravity = {"acceleration": [0, 0, -9.81]}
    assert [stage.material["steel"].density for stage in (case, *case.stages)] == [7000.0] * 3
    assert [stage.load[0].force[0] for stage in case.stages] == [2e3, 2e3]
    assert case.stage[0].gravity.acceleration == case.stage[1].gravity.acceleration == (0.0, 0.0, -9.81)
    assert case.gravity is None and case.stage[0].given == ("load", "gravity")
    case.stage[1].name = "swinging"
    assert case.to_dict()["stage"][1]["name"] == "swinging"
    with pytest.raises(InputError, match="another stage has this name"):
        case.stage[1].name = "pull"
    case.name = "two"
    assert repr(case) == "<Case two: case>"
    case.output.history_every = 3
    assert [stage.output.history_every for stage in case.stages] == [3, 3]
    assert [stage.output.fields_every for stage in case.stages] == [10, 5]
    with pytest.raises(InputError, match=r"stage\[1\]\.time\.end = -1"):
        case.stage[1].time.end = -1
    assert Case.from_toml(case.to_toml()) == case


@pytest.mark.parametrize("name", built_in_cases())
def test_given_tables_make_the_same_case(name):
    case = Case.load(name)
    assert Case.from_dict(tables_of(case, given=True), name=name, folder=case.folder) == case


def test_rows_of_files_stay_when_the_file_is_gone(case, case_file):
    record = case_file.with_name("factors.csv")
    record.write_text("t, factor\n0, 0\n1, 2\n")
    case.update({"load[0].table": None, "load[0].table_file": "factors.csv"})
    assert case.load[0].table == ((0.0, 0.0), (1.0, 2.0))
    record.unlink()
    case.time.end = 2e-3
    assert case.load[0].table == ((0.0, 0.0), (1.0, 2.0))
    with pytest.raises(InputError, match=r"load\[0\]: expected at most one of the keys table_file"):
        case.load[0].table_file = "factors.csv"


def test_tables_show_what_they_have(case):
    assert repr(case.mesh) == "Mesh(generator='rod', parameters=Parameters(length=1.0, elements=4))"
    assert repr(case) == "<Case rod: rod>"


def test_prestress_of_a_stage_is_changed_in_the_stage():
    case = Case.from_toml(STAGED + "section = { all = { pretension = 1e3 } }\n")
    assert Case.from_dict(tables_of(case, given=True)) == case
    case.stage[1].section["all"].pretension = 2e3
    case.stage[0].section["all"].area = 2e-4  # of the case
    assert [each.section["all"].area for each in (case, *case.stages)] == [2e-4] * 3
    assert [each.section["all"].pretension for each in (case, *case.stages)] == [None, None, 2e3]
    with pytest.raises(InputError, match=r"stage\[1\]\.section\.all.*: a stage can only change the prestress"):
        case.stage[1].section["all"].area = 1.0
    assert Case.from_toml(case.to_toml()) == case


def test_items_of_lists_that_are_tuples(case):
    """Probes and vectors are tuples in the objects of a case; their items are changed as those of lists."""
    case.output.probe[0].name = "end"
    case.update({"wall[0].point[0]": 1.5})
    assert case.output.probe[0].name == "end" and case.wall[0].point == (1.5, 0.0, 0.0)
    case.update({"output.probe[0]": None})
    assert not case.output.probe
