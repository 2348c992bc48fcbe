"""A case as read: values, defaults, overrides, and the text from which an equal case is read."""

import pickle
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pfem_petsc.case.editing import apply_overrides
from pfem_petsc.case.schema import Case
from pfem_petsc.case.toml import built_in_cases, parse_toml, table_text
from pfem_petsc.errors import InputError


def test_values_and_defaults(case_file):
    case = Case.load(case_file)
    assert (case.name, case.title, case.source, case.folder) == ("rod", "rod", str(case_file), case_file.parent)
    assert (case.mesh.generator, case.mesh.file) == ("rod", None)
    assert (case.mesh.parameters.length, case.mesh.parameters.elements) == (1.0, 4)
    assert case.node_set["tip"].nearest == (1.0, 0.0, 0.0)
    assert case.node_set["base"].indices == (0,)
    steel = case.material["steel"]
    assert (steel.young_modulus, steel.law, steel.damping, steel.strain) == (210e9, None, 0.0, "engineering")
    assert (case.section["strut"].area, case.section["strut"].bars) == (1e-4, None)
    assert case.initial == [] and case.temperature == [] and case.gravity is None
    assert (case.support[0].fix, case.support[0].motion, case.support[0].velocity) == ("yz", None, None)
    assert (case.load[0].force, case.load[0].table) == ((1.0, 0.0, 0.0), ((0.0, 0.0), (1.0, 1.0)))
    wall = case.wall[0]
    assert (wall.name, wall.type, wall.node_set, wall.point) == ("stop", "plane", None, (1.1, 0.0, 0.0))
    assert (case.time.step, case.time.end, case.time.mass, case.time.safety) == (1e-6, 1e-3, "lumped", 0.9)
    output = case.output
    assert (output.fields_every, output.history_every, output.checkpoint_every) == (10, 1, 0)
    assert (output.fields, output.precision, output.probe[0].name) == (None, "float64", "tip")
    solver = case.solver
    assert (solver.linear, solver.operator, solver.rtol, solver.atol, solver.max_newton) == (
        ("auto", "auto", 1e-9, None, 50)
    )


def test_integer_is_a_number_but_stays_a_float(case_file):
    case = Case.load(case_file, ["time.end=2", "wall.0.point=[2, 0, 0]"])
    assert isinstance(case.time.end, float)
    assert all(isinstance(x, float) for x in case.wall[0].point)


def test_walls_are_named_by_place(case_file):
    plain = "{type = 'plane', point = [2.0, 0.0, 0.0], normal = [-1.0, 0.0, 0.0]}"
    case = Case.load(case_file, [f"wall.1={plain}", f"wall.2={plain}"])
    assert [wall.name for wall in case.wall] == ["stop", "wall2", "wall3"]


def test_initial_velocity_of_all_then_of_sets(case_file):
    case = Case.load(
        case_file,
        ["initial.on.0={node_set = 'tip', velocity = [2.0, 0.0, 0.0]}", "initial.velocity=[1.0, 0.0, 0.0]"],
    )
    assert [(entry.node_set, entry.velocity[0]) for entry in case.initial] == [(None, 1.0), ("tip", 2.0)]
    assert case.initial[1].centre is None


def test_scheme_parameters(case_file):
    default = Case.load(case_file, ["time.integrator=newmark"]).time.scheme
    assert (default.beta, default.gamma) == (1.0, 1.5)
    assert Case.load(case_file, ["time.integrator=newmark", "time.beta=0.25"]).time.scheme.beta == 0.25
    assert Case.load(case_file, ["time.integrator=wilson"]).time.scheme.theta == 1.4
    assert Case.load(case_file, ["time.integrator=chung_lee"]).time.scheme.beta == pytest.approx(28 / 27, rel=1e-15)
    assert Case.load(case_file, ["time.step=auto"]).time.step == "auto"


def test_mesh_file_is_relative_to_the_case(case_file, case_text):
    case_file.write_text(case_text.replace('generator = "rod"\nlength = 1.0\nelements = 4', 'file = "../ring.msh"'))
    case = Case.load(case_file)
    assert case.mesh.file == (case_file.parent.parent / "ring.msh").resolve()
    assert Case.from_toml(case.to_toml(), "/elsewhere") == case


def test_case_travels_between_ranks(case_file):
    case = Case.load(case_file)
    copy = pickle.loads(pickle.dumps(case))
    assert copy == case
    assert (copy.name, copy.folder) == (case.name, case.folder)


def test_equality_sees_every_table(case_file):
    case = Case.load(case_file)
    for override in ("time.end=1.0", "wall.0.name=floor", "solver.rtol=1e-6", "title=other", "load.0.force=[2,0,0]"):
        assert Case.load(case_file, [override]) != case


@pytest.mark.parametrize("name", built_in_cases())
def test_built_in_case_reads_back_equal(name):
    case = Case.load(name)
    assert case.name == name
    assert case.title != name
    assert Case.from_toml(case.to_toml(), case.folder) == case


def test_byte_order_mark_is_no_part_of_a_case(case_file):
    text = case_file.read_text()
    case = Case.load(case_file)
    case_file.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert Case.load(case_file) == case


NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**63), 2**63 - 1)
VALUES = st.recursive(
    NAMES | NUMBERS | st.booleans(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4),
    max_leaves=20,
)


@pytest.mark.slow
@given(st.dictionaries(NAMES, VALUES, max_size=5))
def test_tables_read_back_equal(table):
    read = tomllib.loads(table_text(table))
    assert read == table
    assert repr(read) == repr(tomllib.loads(table_text(read)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("time.step=1e-5", {"time": {"step": 1e-5}}),
        ("time.step = 1e-5 ", {"time": {"step": 1e-5}}),
        ("time.integrator=newmark", {"time": {"integrator": "newmark"}}),
        ('title="a = b"', {"title": "a = b"}),
        ("title=a = b", {"title": "a = b"}),
        ('title=""', {"title": ""}),
        ("title=", {}),
        ("wall.0.point=", {}),
        ("title=1\nx = 2", {"title": "1\nx = 2"}),
        ("wall.0.point=[1, 2.0, 3]", {"wall": [{"point": [1, 2.0, 3]}]}),
        ("wall[0].name=a", {"wall": [{"name": "a"}]}),
        ("output.probe.0.name=a", {"output": {"probe": [{"name": "a"}]}}),
        ("node_set.0.all=true", {"node_set": {"0": {"all": True}}}),
        ('node_set."a.b".all=true', {"node_set": {"a.b": {"all": True}}}),
    ],
)
def test_override_makes_what_is_missing(text, expected):
    data = {}
    apply_overrides(data, [text])
    assert data == expected


def test_override_changes_only_its_key():
    data = {"wall": [{"point": [1.0, 0.0, 0.0], "name": "a"}, {"name": "b"}]}
    apply_overrides(data, ["wall.0.point.1=5.0", "wall.1.name=c", "wall.2.name=d"])
    assert data == {"wall": [{"point": [1.0, 5.0, 0.0], "name": "a"}, {"name": "c"}, {"name": "d"}]}


def test_override_without_a_value_takes_the_key_out():
    data = {"time": {"beta": 0.25, "step": 0.1}, "wall": [{"name": "a", "mass": 1.0}, {}], "gravity": {}}
    apply_overrides(data, ["time.beta=", "wall.0.mass= ", "wall.1=", "gravity=", "time.step.unit=", "wall.7.name="])
    assert data == {"time": {"step": 0.1}, "wall": [{"name": "a"}]}


def test_override_by_the_name_of_an_entry():
    """The same as by its index, in lists of the case and of its stages, with names that entries have by default."""
    rows = [{"name": "a.b"}, {}, {"name": "7"}, {"name": "lid"}, {"name": "lid"}]
    stages = [{"wall": [{}], "support": [{"name": "foot"}]}, {"name": "x"}]
    data = {"wall": rows, "stage": stages}
    texts = ['wall."a.b".mass=1', "wall.wall2.mass=2", "wall[2].mass=3", "stage.stage1.wall.wall1.mass=4"]
    texts += ["stage.x.time.step=0.1", "stage.stage1.support.foot.fix=x", "stage.stage1.support.foot.name="]
    paths = apply_overrides(data, texts)
    assert paths[0] == ("wall", 0, "mass") and paths[3] == ("stage", 0, "wall", 0, "mass")
    assert [wall.get("mass") for wall in data["wall"]] == [1, 2, 3, None, None]
    assert data["stage"] == [{"wall": [{"mass": 4}], "support": [{"fix": "x"}]}, {"name": "x", "time": {"step": 0.1}}]
    with pytest.raises(InputError, match="2 entries of wall have the name 'lid': give an index, 3 or 4"):
        apply_overrides(data, ["wall.lid.mass=1"])


def test_names_of_entries_in_changes_and_messages(case_file):
    case = Case.load(case_file, ["wall.stop.friction=0.25", "output.probe.tip.name=end"])
    assert case.wall[0].friction == 0.25 and case.output.probe[0].name == "end"
    assert case.copy({"wall.stop.friction": 0.5}).wall[0].friction == 0.5
    case.update({"output.probe.end.name": "top", "wall.stop": None})
    assert case.output.probe[0].name == "top" and not case.wall
    with pytest.raises(InputError, match=r"wall\[0\].friction = -1 \(given by --set\)"):
        Case.load(case_file, ["wall.stop.friction=-1"])
    with pytest.raises(InputError, match="wall.top.friction: no entry of wall has the name 'top'"):
        Case.load(case_file).copy({"wall.top.friction": 0.5})


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a = 1\n\tstep = 1 s\n", "  2 |  step = 1 s\n                ^"),
        ("a = [1,\r\n\r\n 2\r\nb = 3", "  3 |  2\n  4 | b = 3\n      ^"),
        ("a = 'x\n\n", "  1 | a = 'x\n            ^"),
        ("a = [1, 2", "  1 | a = [1, 2\n               ^"),
        ("", None),
    ],
)
def test_a_syntax_error_shows_its_line(text, shown):
    if shown is None:
        assert parse_toml(text, "x.toml") == {}
        return
    with pytest.raises(InputError, match="^x.toml: this is not valid TOML: ") as refused:
        parse_toml(text, "x.toml")
    assert str(refused.value).partition("\n")[2] == shown


def test_of_a_long_line_the_part_with_the_error_is_shown():
    with pytest.raises(InputError) as refused:
        parse_toml(f"a = [{'1, ' * 500}?, {'2, ' * 500}]", "x.toml")
    _, line, mark = str(refused.value).split("\n")
    assert len(line) < 120 and line[mark.index("^")] == "?"


def test_given_tables_stay_as_they_are(case_text):
    data = tomllib.loads(case_text)
    assert Case.from_dict(data, overrides=["time.end=2.0"]).time.end == 2.0
    assert data == tomllib.loads(case_text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time.step", "expected KEY=VALUE"),
        ("=1", "expected KEY=VALUE"),
        ("time..step=1", "expected KEY=VALUE"),
        ("time.=1", "expected KEY=VALUE"),
        ("wall[x].name=1", "expected KEY=VALUE"),
        ("wall[0]name=1", "expected KEY=VALUE"),
        ("wall.3.name=a", "'3' is not an index of this list: 0 to 1"),
        ("load.first.force=[1,0,0]", "'first' is not an index of this list"),
        ("wall.first.name=a", "no entry of wall has the name 'first'; known: stop; or give an index, 0 to 1"),
        ("wall.stp.mass=", "no entry of wall has the name 'stp', did you mean 'stop'; or give an index"),
        ("wall.0.point=[1, 2", "text that begins with [ must be in quotes: Unclosed array\n  [1, 2\n       ^"),
        ('title="three', 'must be in quotes: Unterminated string\n  "three\n        ^'),
        ("time.step.unit=s", "time.step is a value, not a table"),
        ("time.step=.1", ".1 is not a number in TOML, write 0.1"),
        ("time.step=-0,3e-2", "write -0.3e-2"),
        ("time.end=2.", "write 2.0"),
    ],
)
def test_override_that_leads_nowhere(case_file, text, words):
    with pytest.raises(InputError) as refused:
        Case.load(case_file, [text])
    assert str(refused.value).startswith(f"--set {text}: ")
    assert words in str(refused.value)


def test_default_title_is_the_name():
    case = Case.load("rod_impact")
    assert case.title == "Elastic rod against a rigid wall"
    assert case.folder.samefile(Path(case.source).parent)
