"""Sections, supports, loads and steps in Abaqus input files."""

import numpy as np
import pytest
from helpers.files import FLAT, MESHES, written

from pfem_petsc import Case, Truss
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole
from pfem_petsc.mesh.whole import skeleton

SECTIONS = {
    "*BEAM SECTION, SECTION=CIRC, ELSET=E, MATERIAL=M\n2.\n": {"area": 4 * np.pi, "shape": "round"},
    "*BEAM SECTION, SECTION=RECT, ELSET=E, MATERIAL=M\n2., 3.\n": {"area": 6.0},
    "*BEAM SECTION, SECTION=BOX, ELSET=E, MATERIAL=M\n4., 5., 1., 1., 1., 1.\n": {"area": 14.0},
    "*BEAM GENERAL SECTION, SECTION=GENERAL, ELSET=E\n7., 1., 0., 1., 1.\n": {"area": 7.0},
    "*BEAM SECTION, SECTION=I, ELSET=E, MATERIAL=M\n1., 2., 3.\n": {},
}


@pytest.mark.parametrize("text", SECTIONS)
def test_sections_of_beams(tmp_path, text):
    base = "*NODE\n1,0\n2,1\n*ELEMENT, TYPE=T3D2, ELSET=E\n1,1,2\n"
    mesh = read_whole(written(tmp_path, base + text))
    (section,) = mesh.tables["section"].values()
    expected = SECTIONS[text]
    assert {key: value for key, value in section.items() if key not in ("bars", "material")} == pytest.approx(expected)
    assert ("area" in mesh.bar_fields) == bool(expected)
    assert bool(mesh.warnings) == (not expected)


def test_numbers_that_no_case_takes_are_left_out(tmp_path):
    """A case for the mesh has the values of steel and the usual area in their place, and says so."""
    mesh = read_whole(
        written(
            tmp_path,
            "*NODE\n1,0\n2,1\n*ELEMENT, TYPE=T3D2, ELSET=E\n1,1,2\n*SOLID SECTION, ELSET=E, MATERIAL=M\n-2.\n"
            "*MATERIAL, NAME=M\n*ELASTIC\n-2e11, .3\n*DENSITY\n0.\n",
        )
    )
    assert [text.rpartition("*")[2] for text in mesh.warnings[:3]] == [
        "ELASTIC: -2e+11 is not positive: left out",
        "DENSITY: 0 is not positive: left out",
        "SOLID SECTION: no area is known from the data line",
    ]
    text = skeleton(mesh, tmp_path / "a.inp", tmp_path / "a.toml")
    assert "material.M.young_modulus" in text and "material.M.density" in text and "section.E.area" in text
    assert Case.from_toml(text, tmp_path).section["E"].area == 1e-4


def test_supports_and_loads(tmp_path):
    """Of sets, labels and instances; degrees of freedom in ranges; what a case cannot have is told."""
    step = """*BOUNDARY
feet, 1, 2
Feet, 3
7, ENCASTRE
10, YSYMM
21, 4, 6
*STEP
*BOUNDARY
Top, 1, 3, 0.5
*CLOAD
21, 3, -1.D1
Top, 1, 2.
21, 3, -5.
Top, 4, 1.
*DLOAD
ALLE, GRAV, 9.81, 0., 0., -1.
, GRAV, 1., 2., 0., 0.
LEGS, GRAV, 1., 1., 0., 0.
LEGS, P1, 1.
*NODE
99, 0, 0, 0
*END STEP
*STEP
*CLOAD
21, 1, 77.
"""
    text = FLAT.partition("*STEP")[0].replace("*MATERIAL", "*ELSET, ELSET=ALLE\nBase, LEGS\n*MATERIAL") + step
    mesh = read_whole(written(tmp_path, text))
    assert len(mesh.points) == 4
    assert mesh.tables["support"] == {
        "Feet": {"node_set": "Feet", "fix": "xyz"},
        "node_7": {"node_set": "node_7", "fix": "xyz"},
        "node_10": {"node_set": "node_10", "fix": "y"},
    }
    assert mesh.tables["load"] == {
        "node_21": {"node_set": "node_21", "force": [0.0, 0.0, -15.0]},
        "Top": {"node_set": "Top", "force": [2.0, 0.0, 0.0]},
    }
    assert mesh.tables["gravity"]["gravity"]["acceleration"] == pytest.approx([2.0, 0.0, -9.81])
    assert mesh.node_groups["node_10"].tolist() == [1] and mesh.node_groups["node_21"].tolist() == [3]
    told = [text.partition("a.inp: ")[2] for text in mesh.warnings[1:]]
    assert told == [
        "line 54: *BOUNDARY: 'Top, 1, 3, 0.5' is left out: prescribed displacements are those of the case",
        "line 59: *CLOAD: 'Top, 4, 1.' is left out: only forces along x, y and z are read",
        "line 63: *DLOAD: 'LEGS, GRAV, 1., 1., 0., 0.' is left out: the gravity of a case acts on all bars",
        "line 64: *DLOAD: 'LEGS, P1, 1.' is left out: only GRAV is read of distributed loads",
        "line 68: *STEP: left out with all that follows: only the first step is read",
    ]
    case = Case(Truss.read(tmp_path / "a.inp").tables, mesh=Truss.read(tmp_path / "a.inp"), static={"step": 1.0})
    assert [support.fix for support in case.support] == ["xyz", "xyz", "y"]
    assert case.node_set["node_21"].group == "node_21"


def test_conditions_of_an_assembly(tmp_path):
    mesh = read_whole(MESHES / "tower.inp")
    assert mesh.tables["support"] == {"Feet": {"node_set": "Feet", "fix": "xyz"}}
    assert mesh.tables["load"] == {"Head": {"node_set": "Head", "force": [250.0, 0.0, -1000.0]}}
    text = (MESHES / "tower.inp").read_text().replace("Feet, PINNED", "Storey-2.13, 2, 3\nStorey-1.11, XASYMM")
    mesh = read_whole(written(tmp_path, text))
    assert (
        mesh.tables["support"]["node_Storey-2.13"]["fix"] == "yz" == mesh.tables["support"]["node_Storey-1.11"]["fix"]
    )
    assert mesh.node_groups["node_Storey-2.13"].tolist() == [14] and mesh.warnings == []
    with pytest.raises(InputError, match="line 79: .*BOUNDARY: 'Foot' is neither a number nor an existing node set"):
        read_whole(written(tmp_path, (MESHES / "tower.inp").read_text().replace("Feet, PIN", "Foot, PIN")))


def test_nodes_of_element_sets_and_constraints(tmp_path):
    more = "*NSET, NSET=of legs, ELSET=LEGS\n*TIE, NAME=t\na, b\n*MPC\n*TIE, NAME=u\nc, d\n*MATERIAL"
    mesh = read_whole(written(tmp_path, FLAT.replace("*MATERIAL", more)))
    assert mesh.node_groups["of legs"].tolist() == [0, 1, 2, 3]
    assert mesh.warnings[-1].startswith(f"{tmp_path}/a.inp: left out *TIE, *MPC; nodes that they connect")
    with pytest.raises(InputError, match="'LEX' is neither a number nor an existing element set"):
        read_whole(written(tmp_path, FLAT.replace("*MATERIAL", more.replace("LEGS", "LEX"))))


def test_plastic_curves_that_no_law_has_are_told(tmp_path):
    for lines in ("*PLASTIC\n2., 0.1\n", "*PLASTIC\n2., 0.\n1., 0.1\n", "*PLASTIC, HARDENING=JOHNSON COOK\n2., 0.\n"):
        mesh = read_whole(written(tmp_path, FLAT.replace("*DENSITY", f"{lines}*DENSITY")))
        assert "yield_stress" not in mesh.tables["material"]["Steel"]
        assert any("*PLASTIC" in warning and "left out" in warning for warning in mesh.warnings)
    mesh = read_whole(written(tmp_path, FLAT.replace("*DENSITY", "*PLASTIC\n2.E8\n*DENSITY")))
    assert mesh.tables["material"]["Steel"]["yield_stress"] == 2e8


STEPS = [
    ("*STATIC\n0.1, 2., 1e-5, 0.5", {"static": {"step": 0.05, "max_step": 0.25, "min_step": 5e-6}}, ""),
    ("*STATIC", {"static": {"step": 1.0}}, ""),
    ("*STATIC, DIRECT\n0.25, 1.", {"static": {"step": 0.25}}, ""),
    ("*STATIC, RIKS\n0.05, 1., , , 3.", {"static": {"method": "arc_length", "step": 0.05, "end": 3.0}}, ""),
    ("*DYNAMIC, EXPLICIT\n, 2e-3", {"time": {"integrator": "central_differences", "step": "auto", "end": 2e-3}}, ""),
    (
        "*DYNAMIC\n1e-4, 0.02",
        {"time": {"integrator": "generalized_alpha", "step": 1e-4, "end": 0.02}},
        "line 47: *DYNAMIC: step = 0.0001 s is the first increment, for all steps",
    ),
    ("*DYNAMIC", {}, "line 47: *DYNAMIC: the period is missing: the first step is left out"),
    ("*FREQUENCY, EIGENSOLVER=LANCZOS\n6,", {"modes": {"count": 6, "kind": "vibration"}}, ""),
    ("*BUCKLE\n3,", {"static": {"step": 1.0}, "modes": {"count": 3, "kind": "buckling"}}, ""),
    (
        "*HEAT TRANSFER\n1., 1.",
        {},
        "line 47: *HEAT TRANSFER: the first step is left out: the program has no *HEAT TRANSFER",
    ),
]


@pytest.mark.parametrize("procedure, tables, told", STEPS)
def test_the_first_step_is_the_analysis(tmp_path, procedure, tables, told):
    """It makes a valid case with the loads, which a probe watches; what the program lacks is told."""
    mesh = read_whole(
        path := written(tmp_path, FLAT.replace("*STEP\n", f"*BOUNDARY\nFeet, PINNED\n*STEP\n{procedure}\n"))
    )
    assert mesh.tables.get("analysis", {}) == tables
    assert [text.partition("a.inp: ")[2] for text in mesh.warnings[1:]] == [told] * bool(told)
    text = skeleton(mesh, path, tmp_path / "a.toml")
    assert ("which is an explicit one of a millisecond" in text) == (not tables)
    case = Case.from_toml(text, tmp_path)
    assert (case.static is not None, case.modes is not None) == ("static" in tables, "modes" in tables)
    assert [probe.node_set for probe in case.output.probe] == ["node_21"] * (set(tables) != {"modes"})
    assert read_whole(path, fields=()).warnings == mesh.warnings[:1]  # a run takes the mesh alone


def test_keywords_that_are_left_out_are_named(tmp_path):
    more = "*AMPLITUDE, NAME=ramp\n0., 0., 1., 1.\n*INITIAL CONDITIONS, TYPE=VELOCITY\n21, 3, -1.\n*STEP"
    text = FLAT.replace("*STEP", more).replace("*CLOAD", "*STATIC\n*CLOAD, AMPLITUDE=ramp")
    text += "*OUTPUT, FIELD\n*STEP\n*FREQUENCY\n5\n*END STEP\n*STEP\n*DYNAMIC\n1., 1.\n*END STEP\n"
    told = [text.partition("a.inp: ")[2] for text in read_whole(written(tmp_path, text)).warnings[1:]]
    assert told == [
        "line 50: *CLOAD: AMPLITUDE=ramp is left out: give the table over time in the case",
        "left out *AMPLITUDE, *INITIAL CONDITIONS: keywords that are not read",
        "line 54: *STEP: left out with all that follows: only the first step is read",
    ]
