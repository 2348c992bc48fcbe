"""Abaqus input files as people and programs write them."""

from pathlib import Path

import numpy as np
import pytest

from pfem_petsc import Case, Truss
from pfem_petsc.errors import InputError
from pfem_petsc.mesh.readers import read_whole
from pfem_petsc.mesh.skeleton import skeleton

MESHES = Path(__file__).parents[2] / "meshes"

FLAT = """*HEADING
 A tripod, written by hand
**
*Node, nset=ALL
1, 0., 0.
10, 1.D+0, 0., 0.
  7,5.0d-1 , 1.0, 0.0,
** a comment between data lines

21, .5, , 1.25E0
*ELEMENT, TYPE=t3d2,
   ELSET=Base
1, 1, 10
2, 10, 7

5, 7, 1
*Element, type=T3D2, elset=LEGS
11, 1, 21
12, 21, 10
20, 7, 21
*NSET, NSET=Top
21,
*NSET, NSET=Feet, GENERATE
1, 10
*NSET, NSET = every one
top, FEET
*NSET, NSET=Top
7
*ELSET, ELSET=some, GENERATE
1, 11, 5
*MATERIAL, NAME=Steel
*ELASTIC, TYPE=ISOTROPIC
210.E9, .3, 20.
205.E9, .3, 100.
*DENSITY
7850.,
*EXPANSION
1.2e-5
*Damping, alpha=2., beta=1.E-5
*SOLID SECTION, ELSET=base, MATERIAL=STEEL
1.D-4,
*SOLID SECTION, ELSET=legs, MATERIAL=steel
2.E-4
*STEP
*CLOAD
21, 3, -1.
*END STEP
"""


def written(folder, text, name="a.inp"):
    (folder / name).write_text(text)
    return folder / name


def members(groups):
    return {name: numbers.tolist() for name, numbers in groups.items()}


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_written_by_hand(tmp_path, ends):
    """Small letters and capitals, comments, blank lines, continued keywords, exponents with D, labels with gaps."""
    path = tmp_path / "a.inp"
    path.write_bytes(("\ufeff" + FLAT).replace("\n", ends).encode())
    mesh = read_whole(path)
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 0, 1.25]]
    assert mesh.bars.tolist() == [[0, 1], [1, 2], [2, 0], [0, 3], [3, 1], [2, 3]]
    assert members(mesh.node_groups) == {
        "ALL": [0, 1, 2, 3],
        "Top": [2, 3],
        "Feet": [0, 1, 2],
        "every one": [0, 1, 2, 3],
        "node_21": [3],  # of *CLOAD
    }
    assert members(mesh.bar_groups) == {"Base": [0, 1, 2], "LEGS": [3, 4, 5], "some": [0, 3]}
    assert mesh.bar_fields["area"].tolist() == [1e-4] * 3 + [2e-4] * 3
    steel = {"young_modulus": 210e9, "density": 7850.0, "thermal_expansion": 1.2e-5, "damping": 15700.0}
    assert mesh.tables["material"] == {"Steel": steel | {"stiffness_damping": 1e-5}}
    assert mesh.tables["section"]["LEGS"] == {"bars": "LEGS", "area": 2e-4, "material": "Steel"}
    (warning,) = mesh.warnings
    assert warning == f"{path}: line 32: *ELASTIC: values at 20 degrees are taken for all temperatures"


def test_parts_and_instances(tmp_path):
    """Two storeys of one part, the second one turned by 90 degrees about the axis, in millimetres."""
    mesh = read_whole(MESHES / "tower.inp")
    assert (len(mesh.points), len(mesh.bars)) == (16, 26)
    lower, upper = mesh.points[:8], mesh.points[8:]
    turned = lower @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + [0.0, 0.0, 1000.0]
    np.testing.assert_allclose(upper, turned, atol=1e-9)
    assert members(mesh.node_groups) == {"Feet": [0, 1, 2, 3], "Head": [12, 13, 14, 15]}
    groups = members(mesh.bar_groups)
    assert groups["Storey-2.Legs"] == [13, 14, 15, 16] and groups["Legs"] == [0, 1, 2, 3, 13, 14, 15, 16]
    assert set(groups) == {f"{of}{name}" for of in ("", "Storey-1.", "Storey-2.") for name in ("Legs", "Braces")}
    assert mesh.bar_fields["area"][[0, 4, 13, 25]].tolist() == [314.159265, 78.5, 314.159265, 78.5]
    (material,) = mesh.tables["material"].values()
    np.testing.assert_allclose(material["curve"], [[250 / 2.1e5, 250.0], [0.1 + 400 / 2.1e5, 400.0]])
    truss = Truss.read(MESHES / "tower.inp", clean=1e-6)
    assert (truss.n_nodes, truss.n_bars, truss.warnings) == (12, 26, [])


def test_instances_with_content_of_their_own_and_sets_of_the_same_name(tmp_path):
    """As CAE writes independent instances; the set of the assembly has its name, that of the instance a longer one."""
    text = """*Part, name=P
*End Part
*Assembly, name=A
*Instance, name=I, part=P
*Node
 1, 0., 0., 0.
 2, 1., 0., 0.
 3, 2., 0., 0.
*Element, type=B31
 1, 1, 2
 2, 2, 3
*Nset, nset=Set-1
 1,
*Elset, elset=_PickedSet2, internal
 1, 2
*Beam Section, elset=_PickedSet2, material=M, section=PIPE
 10., 1.
 0.,0.,-1.
*End Instance
*Nset, nset=Set-1, instance=I
 3
*Nset, nset=both
 I.Set-1, I.2
*End Assembly
*Material, name=M
*Elastic
 5.
*Plastic, hardening=KINEMATIC
 2., 0.
 3., 0.5
"""
    mesh = read_whole(written(tmp_path, text))
    assert members(mesh.node_groups) == {"Set-1": [2], "both": [0, 1], "I.Set-1": [0]}
    np.testing.assert_allclose(mesh.bar_fields["area"], np.pi * (10.0**2 - 9.0**2))
    (section,) = mesh.tables["section"].values()
    assert (section["shape"], section["thickness"], section["bars"]) == ("tube", 1.0, "_PickedSet2")
    assert mesh.tables["material"]["M"] == {"young_modulus": 5.0, "yield_stress": 2.0, "kinematic_hardening": 2.0}
    assert mesh.warnings == [f"{tmp_path}/a.inp: 2 elements B31: beams are read as bars, without bending stiffness"]


def test_included_files(tmp_path):
    """Whole keywords, data lines alone, and by INPUT of a keyword; names are relative to the first file."""
    (tmp_path / "sub").mkdir()
    written(tmp_path, "1, 0, 0, 0\n2, 1, 0, 0\n", "nodes.txt")
    written(tmp_path, "*INCLUDE, INPUT=sub/bars.txt\n3, 0, 1, 0\n", "sub/more.inc")
    written(tmp_path, "10, 1, 2\n", "sub/bars.txt")
    text = "*NODE, INPUT=nodes.txt\n*NODE\n*INCLUDE, INPUT=sub/three.inc\n*ELEMENT, TYPE=T3D2\n"
    text += "*INCLUDE, INPUT=sub/bars.txt\n11, 2, 3\n"
    written(tmp_path, "3, 0, 1, 0\n", "sub/three.inc")
    mesh = read_whole(written(tmp_path, text))
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.bars.tolist() == [[0, 1], [1, 2]]
    written(tmp_path, "3, 0, 1, x\n", "sub/three.inc")
    with pytest.raises(InputError, match=r"sub/three.inc: line 1: \*NODE: 'x' is not a number"):
        read_whole(tmp_path / "a.inp")
    written(tmp_path, "*INCLUDE, INPUT=a.inp\n", "sub/three.inc")
    with pytest.raises(InputError, match=r"sub/three.inc: line 1: \*INCLUDE: a.inp includes itself"):
        read_whole(tmp_path / "a.inp")
    (tmp_path / "nodes.txt").unlink()
    with pytest.raises(InputError, match=r"a.inp: line 1: \*NODE: there is no file .*/nodes.txt"):
        read_whole(tmp_path / "a.inp")


def test_other_elements(tmp_path):
    """Quadratic bars are bars between their ends; solids and their nodes are left out; all is told."""
    text = """*NODE
1, 0, 0, 0
2, .5, 0, 0
3, 1, 0, 0
4, 1, 1, 0
5, 1, .4, 0
9, 9, 9, 9
*ELEMENT, TYPE=T3D3, ELSET=E
1, 1, 2, 3
*ELEMENT, TYPE=C3D8R, ELSET=E
5, 1, 2, 3, 4, 1, 2, 3, 4
*ELEMENT, TYPE=B32, ELSET=E
2, 3, 4, 5
*ELSET, ELSET=F
1, 5
*SOLID SECTION, ELSET=E

"""
    mesh = read_whole(written(tmp_path, text))
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]] and mesh.bars.tolist() == [[0, 1], [1, 2]]
    assert members(mesh.bar_groups) == {"E": [0, 1], "F": [0]}
    assert mesh.bar_fields["area"].tolist() == [1.0, 1.0]  # the default of a truss
    assert [text.replace(str(tmp_path), "") for text in mesh.warnings] == [
        "/a.inp: 1 elements T3D3: trusses with three nodes are read as bars between their ends",
        "/a.inp: 1 elements B32: beams with three nodes are read as bars between their ends, without bending stiffness",
        "/a.inp: left out elements of the types C3D8R",
        "/a.inp: left out 3 nodes where no bar ends (labels 2, 5, 9)",
    ]


def test_third_nodes_that_are_not_between(tmp_path):
    text = "*NODE\n1, 0\n2, 0, 1\n3, 1\n*ELEMENT, TYPE=T3D3\n7, 1, 2, 3\n"
    with pytest.raises(InputError, match=r"line 5: \*ELEMENT: no node of element 7 is between the other two"):
        read_whole(written(tmp_path, text))


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


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("10, 1.D+0, 0., 0.", "10, 1.0x, 0., 0.", r"line 6: \*NODE: '1.0x' is not a number"),
        ("10, 1.D+0, 0., 0.", "10. 1. 0. 0.", r"line 6: \*NODE: '10. 1. 0. 0.' is not a number"),
        ("10, 1.D+0, 0., 0.", "10.5, 1, 0., 0.", r"line 4: \*NODE: 10.5 is not the label of a node"),
        ("10, 1.D+0, 0., 0.", "-10, 1, 0., 0.", r"line 4: \*NODE: -10 is not the label of a node"),
        ("10, 1.D+0, 0., 0.", "1, 1, 0., 0.", r"\*NODE: node 1 is listed more than once, at different positions"),
        ("10, 1.D+0, 0., 0.", "10, 1, 2, 3, 4, 5, 6, 7, 8", r"line 6: \*NODE: .* has 9 values; expected 1 to 7"),
        ("2, 10, 7", "2, 10", r"line 14: \*ELEMENT: '2, 10' has 2 values; expected 3 to 5 with commas"),
        ("2, 10, 7", "2, 10, 8", r"line 11: \*ELEMENT: node 8 of element 2 is not defined"),
        ("2, 10, 7", "1, 10, 7", r"\*ELEMENT: element 1 is listed more than once"),
        ("TYPE=t3d2,\n   ELSET=Base", "ELSET=Base", r"line 11: \*ELEMENT: the parameter TYPE= is missing"),
        ("NSET=Top", "NAME=Top", r"line 21: \*NSET: the parameter NSET= is missing"),
        ("top, FEET", "top, FEED", r"line 25: \*NSET: 'FEED' is neither a number nor an existing node set"),
        ("top, FEET", "every one", r"line 25: \*NSET: set every one includes itself"),
        ("1, 11, 5", "11, 1, 5", r"line 29: \*ELSET: 11, 1, 5 are not first, last and step"),
        ("1, 11, 5", "1, 11, 5, 7", r"line 30: \*ELSET: .* has 4 values; expected 2 to 3"),
        ("ELSET=legs", "ELSET=lex", r"line 42: \*SOLID SECTION: there is no element set lex"),
        ("*Node, nset=ALL", "*Node, SYSTEM=C", r"SYSTEM=C is not read: write the nodes in Cartesian"),
        ("*NSET, NSET=Feet, GENERATE", "*NGEN", r"line 23: \*NGEN is not read: write the nodes and elements one by"),
        ("*NSET, NSET=Top", "*INSTANCE, NAME=I, PART=P\n*END INSTANCE\n*NSET, NSET=Top", r"there is no part P"),
        ("*NSET, NSET=Top", "*NSET, NSET=Top, INSTANCE=J", r"line 21: \*NSET: there is no instance J"),
        ("*HEADING\n A", "A", r"line 1: 'A tripod, written by hand' precedes the first \*KEYWORD"),
        ("*HEADING", "*", r"line 1: '\*' is no keyword"),
    ],
)
def test_one_thing_wrong(tmp_path, old, new, text):
    assert old in FLAT
    with pytest.raises(InputError, match=text) as caught:
        read_whole(written(tmp_path, FLAT.replace(old, new, 1)))
    assert f"{tmp_path}/a.inp" in str(caught.value)


def test_members_that_are_not_there_are_told(tmp_path):
    mesh = read_whole(written(tmp_path, FLAT.replace("*NSET, NSET=Top\n21,", "*NSET, NSET=Top\n21, 22, 23")))
    assert mesh.warnings[0].endswith("2 members of node sets are not there, and are left out")


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
        "left out the steps after the first one: *FREQUENCY, *DYNAMIC",
    ]
