"""Sections, supports, loads and steps in Abaqus input files."""

import math

import numpy as np
import pytest
from helpers.files import FLAT, MESHES, written
from mpi4py import MPI

from pfem_petsc import Case, Simulation, Truss, open_result
from pfem_petsc.errors import InputError
from pfem_petsc.formats import read_whole
from pfem_petsc.mesh.whole import skeleton

BEAM = "*BEAM SECTION, ELSET=E, MATERIAL=M, SECTION="
SECTIONS = {
    f"{BEAM}CIRC\n2.\n": {"area": 4 * np.pi, "shape": "round"},
    f"{BEAM}CIRC\n2., 3.\n": {"area": 1.5 * np.pi},  # of CalculiX: the axes of an ellipse
    f"{BEAM}PIPE\n2., 0.5\n": {"area": np.pi * (4.0 - 2.25), "shape": "tube", "thickness": 0.5},
    f"{BEAM}THICK PIPE\n2., 0.5\n": {"area": np.pi * (4.0 - 2.25), "shape": "tube", "thickness": 0.5},
    f"{BEAM}RECT\n2., 3.\n": {"area": 6.0},
    f"{BEAM}RECTANGULAR\n2., 3.\n0., 0., -1.\n": {"area": 6.0},
    f"{BEAM}RECT\n2.\n": {"area": 4.0},
    f"{BEAM}BOX\n4., 5., 1., 1., 1., 1.\n": {"area": 14.0},
    f"{BEAM}L\n0.1, 0.1, 0.01, 0.01\n": {"area": 0.0019},
    f"{BEAM}I\n0.1, 0.2, 0.1, 0.1, 0.01, 0.01, 0.008\n": {"area": 0.00344},
    f"{BEAM}I\n0.1, 0.2, , 0.1, , 0.01, 0.008\n": {"area": 0.001 + 0.19 * 0.008},  # a T
    f"{BEAM}HEX\n2., 0.3\n": {"area": 1.5 * np.sqrt(3.0) * (4.0 - (2.0 - 0.6 / np.sqrt(3.0)) ** 2)},
    f"{BEAM}TRAPEZOID\n4., 3., 2., 1.\n": {"area": 9.0},
    f"{BEAM}ARBITRARY\n3, 0., 0., 3., 0., 0.1\n3., 4., 0.2\n0., 4., 0.3\n": {"area": 0.3 + 0.8 + 0.9},
    "*BEAM GENERAL SECTION, SECTION=GENERAL, ELSET=E\n7., 1., 0., 1., 1.\n": {"area": 7.0},
    "*FRAME SECTION, SECTION=PIPE, ELSET=E\n2., 0.5\n": {"area": np.pi * 1.75, "shape": "tube", "thickness": 0.5},
    f"{BEAM}I\n1., 2., 3.\n": {},
    f"{BEAM}ELBOW\n1., 2., 3.\n": {},
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
    ("deck", "area", "told"),
    [
        ("*ELEMENT, TYPE=B31, ELSET=E\n1,1,2\n*STEP\n", np.pi, ""),
        ("*ELEMENT, TYPE=B31R, ELSET=E\n1,1,2\n*STEP\n", np.pi / 4, ""),
        ("*ELEMENT, TYPE=B31, ELSET=E\n1,1,2\n*STEP\n*STATIC, SOLVER=SPOOLES\n", np.pi / 4, ""),
        ("*ELEMENT, TYPE=B31, ELSET=E\n1,1,2\n*STEP\n*EL FILE\nS\n", np.pi, "CIRC is read with a radius, as in Abaqus"),
    ],
)
def test_circles_of_calculix_have_diameters(tmp_path, deck, area, told):
    mesh = read_whole(written(tmp_path, f"*NODE\n1,0\n2,1\n{BEAM}CIRC\n1.\n{deck}*END STEP\n"))
    assert mesh.bar_fields["area"].tolist() == pytest.approx([area])
    assert any("CIRC" in text for text in mesh.warnings) == bool(told) and any(told in text for text in mesh.warnings)


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
        "Top": {"node_set": "Top", "fix": "xyz"},
    }
    assert mesh.tables["load"] == {
        "node_21": {"node_set": "node_21", "force": [0.0, 0.0, -15.0]},
        "Top": {"node_set": "Top", "force": [2.0, 0.0, 0.0]},
    }
    assert mesh.tables["gravity"]["gravity"]["acceleration"] == pytest.approx([2.0, 0.0, -9.81])
    assert mesh.node_groups["node_10"].tolist() == [1] and mesh.node_groups["node_21"].tolist() == [3]
    told = [text.partition("a.inp: ")[2] for text in mesh.warnings[1:]]
    assert told == [
        "line 54: *BOUNDARY: 'Top, 1, 3, 0.5' is held where it is: no *STATIC or *DYNAMIC step moves it",
        "line 59: *CLOAD: 'Top, 4, 1.' is left out: only forces along x, y and z are read",
        "line 64: *DLOAD: 'LEGS, P1, 1.' is left out: only GRAV is read of distributed loads",
        "line 63: *DLOAD: 'LEGS, GRAV, 1., 1., 0., 0.' is left out: the gravity of a case acts on all bars",
        "line 68: *STEP: left out with all that follows: only the first step is read",
    ]
    case = Case(Truss.read(tmp_path / "a.inp").tables, mesh=Truss.read(tmp_path / "a.inp"), static={"step": 1.0})
    assert [support.fix for support in case.support] == ["xyz", "xyz", "y", "xyz"]
    assert case.node_set["node_21"].group == "node_21"


def test_gravity_of_several_sets(tmp_path):
    """Sets that have all bars together, each once."""
    step = "*STEP, NLGEOM\n*STATIC\n*DLOAD\nLEGS, GRAV, 2., 0., 0., -1.\nBase, GRAV, 2., 0., 0., -1.\n*END STEP\n"
    mesh = read_whole(written(tmp_path, FLAT.partition("*STEP")[0] + step))
    assert mesh.tables["gravity"]["gravity"]["acceleration"] == [0.0, 0.0, -2.0] and len(mesh.warnings) == 1


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
    assert mesh.warnings[0].startswith(f"{tmp_path}/a.inp: left out *TIE, *MPC; nodes that they connect")
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
    (
        "*FREQUENCY\ninf",
        {"modes": {"count": 10, "kind": "vibration"}},
        "line 47: *FREQUENCY: a limit of the frequencies is not supported: modes.count = 10",
    ),
    ("*BUCKLE\n3,", {"modes": {"count": 3, "kind": "buckling", "linear": True}}, ""),
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
        path := written(tmp_path, FLAT.replace("*STEP\n", f"*BOUNDARY\nFeet, PINNED\n*STEP, NLGEOM\n{procedure}\n"))
    )
    assert mesh.tables.get("analysis", {}) == tables
    assert [text.partition("a.inp: ")[2] for text in mesh.warnings[1:]] == [told] * bool(told)
    text = skeleton(mesh, path, tmp_path / "a.toml")
    assert ("which is an explicit one of a millisecond" in text) == (not tables)
    case = Case.from_toml(text, tmp_path)
    assert (case.static is not None, case.modes is not None) == ("static" in tables, "modes" in tables)
    assert [probe.node_set for probe in case.output.probe] == ["node_21"] * (set(tables) != {"modes"})
    assert read_whole(path, fields=()).warnings == mesh.warnings[:1]  # a run takes the mesh alone


def test_what_is_left_out_is_named(tmp_path):
    more = "*CREEP\n1., 1., 1.\n*INITIAL CONDITIONS, TYPE=VELOCITY\n21, 3, -1.\n*STEP, LOAD=2"
    text = FLAT.replace("*STEP", more).replace("*CLOAD", "*STATIC\n*CLOAD, AMPLITUDE=ramp, FOLLOWER")
    text += "*OUTPUT, FIELD\n*STEP\n*FREQUENCY\n5\n*END STEP\n*STEP\n*DYNAMIC\n1., 1.\n*END STEP\n"
    path = written(tmp_path, text)
    told = [text.partition("a.inp: ")[2] for text in read_whole(path).warnings]
    assert told == [
        "line 48: *STEP: LOAD is left out: it is not read",
        "line 50: *CLOAD: FOLLOWER is left out: it is not read",
        "line 32: *ELASTIC: values at 20 degrees are taken for all temperatures",
        "line 50: *CLOAD: AMPLITUDE=ramp is left out: there is none of this name",
        "line 47: *INITIAL CONDITIONS: '21, 3, -1.' is left out: it has no effect without *DYNAMIC",
        "left out *CREEP: keywords that are not read",
        "line 54: *STEP: left out with all that follows: only the first step is read",
        "line 48: *STEP has no NLGEOM: the case has large displacements, as all cases do",
    ]
    assert len(read_whole(path, fields=()).warnings) == 3  # a run takes the mesh alone


def test_conditions_of_the_step_replace_those_of_the_model(tmp_path):
    """With OP=NEW all, otherwise those of the same components."""
    text = FLAT.replace("*STEP\n", "*BOUNDARY\nFeet, PINNED\n*STEP, NLGEOM\n*STATIC\n*BOUNDARY\n7, 1, 1, 0.5\n")
    mesh = read_whole(written(tmp_path, text))
    held = [(keys["fix"], mesh.node_groups[keys["node_set"]].tolist()) for keys in mesh.tables["support"].values()]
    assert held == [("x", [0, 1]), ("yz", [0, 1, 2]), ("x", [2])]
    assert [keys.get("motion") for keys in mesh.tables["support"].values()] == [
        None,
        None,
        [[0, 0, 0, 0], [1, 0.5, 0, 0]],
    ]
    mesh = read_whole(written(tmp_path, text.replace("*STATIC\n*BOUNDARY", "*STATIC\n*BOUNDARY, OP=NEW")))
    assert [(keys["node_set"], keys["fix"]) for keys in mesh.tables["support"].values()] == [("node_7", "x")]


def test_motions_of_dynamic_steps(tmp_path):
    """A velocity is one, an acceleration has rows; without an amplitude, a displacement would be sudden."""
    step = "*STEP\n*DYNAMIC, EXPLICIT\n, 2.\n*BOUNDARY, TYPE={}\n21, 1, 1, 3.\n21, 3, 3, 4.\n"
    for kind, expected in (
        ("VELOCITY", {"velocity": [3.0, 0.0, 4.0]}),
        ("ACCELERATION", {"acceleration": [[0.0, 3.0, 0.0, 4.0], [2.0, 3.0, 0.0, 4.0]]}),
        ("DISPLACEMENT", {}),
    ):
        mesh = read_whole(written(tmp_path, FLAT.replace("*STEP\n", step.format(kind))))
        assert mesh.tables["support"]["node_21"] == {"node_set": "node_21", "fix": "xz", **expected}
        told = [text for text in mesh.warnings if "held where it is: at once in a dynamic step" in text]
        assert len(told) == (not expected)


ARCH = """*NODE
1, 0, 0, 0
2, 1, 0, 0.1
3, 2, 0, 0
*ELEMENT, TYPE=T3D2, ELSET=E
1, 1, 2
2, 2, 3
*NSET, NSET=FEET
1, 3
*NSET, NSET=APEX
2
*SOLID SECTION, ELSET=E, MATERIAL=ST
1e-3
*MATERIAL, NAME=ST
*ELASTIC
2.1e11, 0.3
*DENSITY
7850.
*BOUNDARY
FEET, 1, 3
APEX, 2, 2
*STEP
*BUCKLE
1
*CLOAD
APEX, 3, -FORCE
*END STEP
"""


@pytest.mark.parametrize("load", ["7e4", "7", "7e6"])
def test_buckling_of_a_deck_is_a_linear_perturbation(load, tmp_path):
    """lambda P = 2 E A tan^2 a sin a for every P, also for those that the arch cannot carry."""
    path = written(tmp_path, ARCH.replace("FORCE", load))
    mesh = read_whole(path)
    case = Case.from_toml(skeleton(mesh, path, tmp_path / "a.toml"), tmp_path)
    with Simulation(case, MPI.COMM_SELF, output=tmp_path / "out", quiet=True) as simulation:
        simulation.run()
    factor = open_result(tmp_path / "out").modes.load_factor[0]
    assert factor * float(load) == pytest.approx(2 * 2.1e8 * 0.1**3 / math.hypot(1.0, 0.1), rel=1e-10)
