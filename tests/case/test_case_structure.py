"""Files that are no case: syntax errors, missing files, values where tables are expected."""

import pytest

from pfem_petsc.case.schema import Case
from pfem_petsc.errors import InputError


@pytest.mark.parametrize(
    ("value", "told"), [("[", "TOML"), ("[" * 100_000, "nested too deep"), ("= 1", "line 2, column 10")]
)
def test_syntax_error_names_the_place(tmp_path, value, told):
    path = tmp_path / "broken.toml"
    path.write_text(f"[mesh]\nlength = {value}\n")
    with pytest.raises(InputError, match=rf"{path}: .*{told}"):
        Case.load(path)


@pytest.mark.parametrize("headings", [("[support]", "[[support]]"), ("[[support]]", "[support]")])
def test_headings_of_a_table_and_of_a_list(case_text, headings):
    text = case_text + "".join(f'\n{heading}\nnode_set = "tip"\nfix = "x"\n' for heading in headings)
    with pytest.raises(InputError, match=r"\[support\] stands beside \[\[support\]\], which each entry"):
        Case.from_toml(text)


def test_file_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"rod_impct: .*did you mean 'rod_impact'"):
        Case.load("rod_impct")
    with pytest.raises(InputError, match=r"nothing\.toml: .*built-in cases are .*rod_impact"):
        Case.load(tmp_path / "nothing.toml")
    with pytest.raises(InputError, match=r"this is a folder; name a case file .* results by -o"):
        Case.load(tmp_path)
    with pytest.raises(InputError, match="cannot be read"):
        Case.load("zero\0byte")
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b'title = "\xe9"\n')
    with pytest.raises(InputError, match=r"line 1: this is not UTF-8 text"):
        Case.load(latin)


def test_mesh_file_takes_no_generator_keys(case_text):
    text = case_text.replace('generator = "rod"', 'file = "a.msh"')
    with pytest.raises(InputError, match=r"mesh\.length: .*a mesh from a file takes no other keys"):
        Case.from_toml(text)


def test_parameter_of_another_scheme_is_refused_with_the_way_out():
    data = Case.load("rod_impact", ["time.integrator=newmark", "time.beta=0.25"]).to_dict()
    with pytest.raises(
        InputError, match=r"time.beta: a key of chung_lee, newmark, not of houbolt, .*; --set time.beta= removes it"
    ):
        Case.from_dict(data, overrides=["time.integrator=houbolt"])
    taken_out = ["time.integrator=houbolt", "time.beta=", "time.gamma="]
    assert Case.from_dict(data, overrides=taken_out).time.integrator == "houbolt"
    data["time"]["integrator"] = "houbolt"
    with pytest.raises(
        InputError, match=r"time.beta: a key of chung_lee, newmark, not of houbolt, which takes no parameters(\n|$)"
    ):
        Case.from_dict(data)


@pytest.mark.parametrize("given", ["rod_impact", "mesh = 1", [1.0], None, 3])
def test_what_is_no_table_is_refused_with_what_reads_it(given):
    with pytest.raises(InputError, match=r"^case: expected nested tables, got .*; Case\.load reads a case file"):
        Case.from_dict(given)


@pytest.mark.parametrize("given", ["rod_impact", {"title": "a table"}, None])
def test_a_simulation_is_of_a_case(given):
    from pfem_petsc import Simulation

    with pytest.raises(InputError, match=r"expected a Case, got .*Case\.load .*Case\.from_dict"):
        Simulation(given)


def test_numbers_as_keys_of_a_table_are_refused_with_the_table():
    case = {"support": [{"node_set": "every", "fix": "x", "motion": {1: 2}}]}
    with pytest.raises(InputError, match=r"support\[0\].motion = {1 = 2}"):
        Case.from_dict(case)


def test_ranges_stand_for_lists():
    data = Case.load("rod_impact").to_dict()
    data["node_set"]["tip"] = {"indices": range(2, 8, 2)}
    assert Case.from_dict(data).node_set["tip"].indices == (2, 4, 6)


def test_set_makes_the_first_of_a_list_of_constraints():
    """``constraint.0`` where the case has none is refused for its kind, not for the key."""
    with pytest.raises(
        InputError,
        match=r"constraint\[0\]\.kind = \"thether\" \(given by --set\): unknown value; none is built in, docs",
    ):
        Case.load("rod_impact", ["constraint.0.kind=thether"])
