"""Abaqus input files as people and programs write them: nodes, elements, sets, parts, included files, refusals."""

import numpy as np
import pytest
from helpers.files import FLAT, MESHES, written

from pfem_petsc import Truss
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole

CHAIN = """*Node
 1, 0., 0., 0.
 2, 1., 0., 0.
 3, 2., 0., 0.
*Element, type={}
 1, 1, 2
 2, 2, 3
"""
"""Two bars along the x axis."""


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
    text = f"""*Part, name=P
*End Part
*Assembly, name=A
*Instance, name=I, part=P
{CHAIN.format("B31")}*Nset, nset=Set-1
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


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("10, 1.D+0, 0., 0.", "10, 1.0x, 0., 0.", r"line 6: \*NODE: '1.0x' is not a number"),
        ("10, 1.D+0, 0., 0.", "10. 1. 0. 0.", r"line 6: \*NODE: '10. 1. 0. 0.' is not a number"),
        ("10, 1.D+0, 0., 0.", "10.5, 1, 0., 0.", r"line 4: \*NODE: 10.5 is not the label of a node"),
        ("10, 1.D+0, 0., 0.", "-10, 1, 0., 0.", r"line 4: \*NODE: -10 is not the label of a node"),
        ("10, 1.D+0, 0., 0.", "1, 1, 0., 0.", r"\*NODE: node 1 is listed more than once, at different positions"),
        ("10, 1.D+0, 0., 0.", "10, 1, 2, 3, 4, 5, 6, 7, 8", r"line 6: \*NODE: .* has 9 values; expected 1 to 7"),
        ("2, 10, 7", "2, 10", r"line 14: \*ELEMENT: '2, 10' has 2 values; expected 3 with commas"),
        ("2, 10, 7", "2, 10, 7, 1", r"line 14: \*ELEMENT: '2, 10, 7, 1' has 4 values; expected 3 with commas"),
        ("2, 10, 7", "2, 10, 8", r"line 11: \*ELEMENT: node 8 of element 2 is not defined"),
        ("2, 10, 7", "1, 10, 7", r"\*ELEMENT: element 1 is listed more than once"),
        ("TYPE=t3d2,\n   ELSET=Base", "ELSET=Base", r"line 11: \*ELEMENT: the parameter TYPE= is missing"),
        ("NSET=Top", "NAME=Top", r"line 21: \*NSET: the parameter NSET= is missing"),
        ("top, FEET", "top, FEED", r"line 25: \*NSET: 'FEED' is neither a number nor an existing node set"),
        ("top, FEET", "every one", r"line 25: \*NSET: 'every one' is neither a number nor an existing node set"),
        ("1, 11, 5", "11, 1, 5", r"line 29: \*ELSET: 11, 1, 5 are not first, last and step"),
        ("1, 11, 5", "1, 11, 5, 7", r"line 30: \*ELSET: .* has 4 values; expected 2 to 3"),
        ("ELSET=legs", "ELSET=lex", r"line 42: \*SOLID SECTION: there is no element set lex"),
        ("*Node, nset=ALL", "*Node, SYSTEM=C", r"SYSTEM=C is not read: write the nodes in Cartesian"),
        ("*NSET, NSET=Feet, GENERATE", "*NGEN", r"line 23: \*NGEN is not read: write the nodes and elements one by"),
        (
            "*NSET, NSET=Top",
            "*SYSTEM\n0, 0, 1\n*NSET, NSET=Top",
            r"line 21: \*SYSTEM is not read: write .* global coord",
        ),
        (
            "*HEADING",
            "*PARAMETER\nE = 1.",
            r"line 1: \*PARAMETER is not read: write the values in the place of the names",
        ),
        (
            "*NSET, NSET=Top",
            "*ELEMENT, TYPE=MASS\n3, All\n*NSET, NSET=Top",
            r"line 22: \*ELEMENT: .*; expected 2 labels",
        ),
        ("*NSET, NSET=Top", "*INSTANCE, NAME=I, PART=P\n*END INSTANCE\n*NSET, NSET=Top", r"there is no part P"),
        ("*NSET, NSET=Top", "*NSET, NSET=Top, INSTANCE=J", r"line 21: \*NSET: there is no instance J"),
        ("*HEADING\n A", "A", r"line 1: 'A tripod, written by hand' precedes the first \*KEYWORD"),
        ("*HEADING", "*", r"line 1: '\*' is no keyword"),
        (FLAT, "", "a.inp: has no trusses or beams, which would be bars"),
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


MIXED = """*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 1., 1., 0.
4, 0., 1., 0.
5, 0.5, 1.5, 1.
*ELEMENT, TYPE=S4, ELSET=PLATE
1, 1, 2, 3, 4
*ELEMENT, TYPE=T3D2, ELSET=RODS
2, 3, 5
3, 4, 5
*ELSET, ELSET=BOTH
PLATE, RODS
*ELSET, ELSET=FIRST
1
*NSET, NSET=CORNERS, ELSET=PLATE
*NSET, NSET=FOOT
1
*SOLID SECTION, ELSET=PLATE, MATERIAL=M
*SOLID SECTION, ELSET=BOTH, MATERIAL=M
0.01
"""


def test_sets_and_sections_without_bars_are_left_out(tmp_path):
    """A set of which one element is a bar is the group of these; one that does not exist is an error."""
    mesh = read_whole(written(tmp_path, MIXED))
    assert members(mesh.bar_groups) == {"RODS": [0, 1], "BOTH": [0, 1]} and mesh.node_groups == {}
    assert list(mesh.tables["section"]) == ["BOTH"] and mesh.bar_fields["area"].tolist() == [0.01, 0.01]
    assert [text.partition("a.inp: ")[2] for text in mesh.warnings] == [
        "left out elements of the types S4",
        "line 16: *NSET: nodes of elements that are left out are not read",
        "left out the node sets CORNERS, FOOT: no bar ends at their nodes",
        "left out the element sets PLATE, FIRST: none of their elements is a bar",
        "left out the sections of PLATE: none of their elements is a bar",
        "left out 2 nodes where no bar ends (labels 1, 2)",
    ]
    with pytest.raises(InputError, match=r"line 19: \*SOLID SECTION: there is no element set PLATES"):
        read_whole(written(tmp_path, MIXED.replace("SECTION, ELSET=PLATE,", "SECTION, ELSET=PLATES,")))


def test_names_in_quotes(tmp_path):
    """They may have blanks, commas and, after a dot, those of instances; blanks in keywords do not matter."""
    text = f"""*Part, name=P
{CHAIN.format("T3D2")}*Nset, nset="feet set"
 1, 3
*Nset, nset="top, 1"
 2,
*Elset, elset="tie, 1"
 1,
*Elset, elset=every
 "tie, 1", 2
*SolidSection, elset="tie, 1", material="mild, steel"
 1e-4,
*EndPart
*Assembly, name=A
*Instance, name=P-1, part=P
*End Instance
*End Assembly
*Material, name="mild, steel"
*Elastic
 2e11,
*Boundary
P-1."feet set", PINNED
"P-1.top, 1", 2, 3
*Step, nlgeom
*Cload
P-1."top, 1", 1, 5.
*End Step
"""
    mesh = read_whole(written(tmp_path, text))
    assert members(mesh.node_groups) == {"feet set": [0, 2], "top, 1": [1]}
    assert members(mesh.bar_groups) == {"tie, 1": [0], "every": [0, 1]}
    assert mesh.tables["section"]["tie, 1"]["material"] == "mild, steel" and "mild, steel" in mesh.tables["material"]
    held = [(keys["node_set"], keys["fix"]) for keys in mesh.tables["support"].values()]
    assert held == [("feet set", "xyz"), ("top, 1", "yz")] and list(mesh.tables["load"]) == ["top, 1"]


@pytest.mark.parametrize(
    ("last", "told"),
    [
        ("21, 3, -1.\n", "ends without *END STEP: it may have been cut off"),
        ("ELSET=legs, MATERI", "line 42: *SOLID SECTION: MATERI is left out: it is not read"),
        ("*SOLID SECTION, ELSET=legs, MATERIAL=steel\n2.E-", "line 43: *SOLID SECTION: '2.E-' is not a number"),
        ("ELSET=legs, MATERIAL=steel\n2", "ends within the line '2': it may have been cut off"),
        ("1, 11, 5\n*MATERIAL, NAME=Steel\n*ELAST", "left out *ELAST: keywords that are not read"),
    ],
)
def test_files_that_are_cut_off(tmp_path, last, told):
    """Of what is missing, everything that is seen is told; whole files have no such warning."""
    text = FLAT[: FLAT.index(last) + len(last)]
    try:
        warnings = read_whole(written(tmp_path, text)).warnings
    except InputError as error:
        warnings = [str(error)]
    assert any(told in warning for warning in warnings)
    assert not any("cut off" in warning for warning in read_whole(written(tmp_path, FLAT)).warnings)
