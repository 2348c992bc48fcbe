"""Abaqus and CalculiX input files, converted and run, against closed forms."""

import numpy as np
import pytest
from helpers.files import written

from pfem_petsc import Case, Simulation
from pfem_petsc.formats import read_whole, write_whole
from pfem_petsc.mesh.tools import scaled
from pfem_petsc.mesh.whole import skeleton
from pfem_petsc.output.result import open_result

YOUNG, AREA, DENSITY = 2.1e11, 1e-3, 7850.0
MATERIAL = f"*MATERIAL, NAME=ST\n*ELASTIC\n{YOUNG}, 0.3\n*DENSITY\n{DENSITY}\n*EXPANSION\n1.2e-5\n"
LINE = f"""*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 2, 0, 0
*ELEMENT, TYPE=T3D2, ELSET=E
1, 1, 2
2, 2, 3
*NSET, NSET=ENDS
1, 3
*NSET, NSET=MIDDLE
2
*SOLID SECTION, ELSET=E, MATERIAL=ST
{AREA}
{MATERIAL}*BOUNDARY
ENDS, PINNED
MIDDLE, 2, 3
"""
"""Two bars in a line, with one free component in the middle."""
STEP = "*STEP, NLGEOM\n*STATIC\n1., 1.\n{}*END STEP\n"


def converted(folder, text, scale=1.0):
    """The case of an input file, as `mesh convert` makes it, and the warnings."""
    mesh = scaled(read_whole(written(folder, text)), scale)
    warnings, mesh.warnings = mesh.warnings, []
    path = write_whole(folder / "a.vtu", mesh)
    return Case.from_toml(skeleton(mesh, path, folder / "a.toml"), folder), [
        w.partition("a.inp: ")[2] for w in warnings
    ]


def ran(folder, text, told=(), scale=1.0):
    case, warnings = converted(folder, text, scale)
    assert warnings == list(told)
    assert Simulation(case, output=folder / "out", quiet=True).run() == 0
    return open_result(folder / "out")


@pytest.mark.parametrize("kind", ["T2D2", "B21"])
def test_plane_elements_have_no_third_direction(tmp_path, kind):
    text = f"""*NODE
1, 0, 0
2, 1, 0.1
3, 2, 0
*ELEMENT, TYPE={kind}, ELSET=E
1, 1, 2
2, 2, 3
*NSET, NSET=FEET
1, 3
{MATERIAL}*SOLID SECTION, ELSET=E, MATERIAL=ST
{AREA}
*BOUNDARY
FEET, 1, 2
*STEP
*FREQUENCY
2
*END STEP
"""
    told = ["2 elements B21: beams are read as bars, without bending stiffness"] * (kind == "B21")
    found = ran(tmp_path, text, [*told, "the case holds 3 nodes of plane elements along z"]).modes.frequency
    length, rise = np.hypot(1.0, 0.1), 0.1
    expected = [np.sqrt(2.0 * YOUNG / DENSITY) * d / length**2 / (2.0 * np.pi) for d in (rise, 1.0)]
    assert found == pytest.approx(expected, rel=1e-9) and expected == pytest.approx([115.26, 1152.6], rel=1e-4)


def test_prescribed_displacements(tmp_path):
    """They replace what the model holds, over the load factor; each bar has half the strain of the line."""
    step = "*BOUNDARY\n3, 1, 1, 2e-3\n"
    result = ran(tmp_path, LINE + STEP.format(step))
    assert result.field("axial_force", -1) == pytest.approx([YOUNG * AREA * 1e-3] * 2, rel=1e-9)
    assert result.history["probe/node_3/reaction"][-1, 0] == pytest.approx([YOUNG * AREA * 1e-3, 0, 0], rel=1e-9)


def test_temperatures(tmp_path):
    """Bars have the mean of their nodes above the initial temperature, 50 and 25 K; a clamped line has their mean."""
    more = "*INITIAL CONDITIONS, TYPE=TEMPERATURE\nENDS, 20.\nMIDDLE, 20.\n"
    step = "*TEMPERATURE\nENDS, 20.\n1, 70.\nMIDDLE, 70.\n"
    force = ran(tmp_path, LINE + more + STEP.format(step)).field("axial_force", -1)
    mean = 1.2e-5 * (50.0 + 25.0) / 2.0
    assert force == pytest.approx([-YOUNG * AREA * mean] * 2, rel=1e-9)


def test_initial_stresses(tmp_path):
    """Of single bars: rest lengths 1/(1 + s/E), so that both have the strain 2/(sum of these) - 1 in equilibrium."""
    more = "*INITIAL CONDITIONS, TYPE=STRESS\nE, 1e8\n2, 3e8\n"
    force = ran(tmp_path, LINE + more + STEP.format("")).field("axial_force", -1)
    rest = [1.0 / (1.0 + s / YOUNG) for s in (1e8, 3e8)]
    assert force == pytest.approx([YOUNG * AREA * (2.0 / sum(rest) - 1.0)] * 2, rel=1e-9)
    assert force[0] == pytest.approx(2e8 * AREA, rel=1e-3)


def test_stresses_of_integration_points(tmp_path):
    """As CalculiX has them, by components along the axes: t S t along the bar, the mean of the points."""
    text = LINE.replace("2, 1, 0, 0\n3, 2, 0, 0", "2, 3, 4, 0\n3, 6, 8, 0") + "*INITIAL CONDITIONS, TYPE=STRESS\n"
    text += "1, 1, 1e8, 2e8, 9e8, 5e7, 9e8, 9e8\n1, 2, 1e8, 2e8, 0., 0., 0., 0.\n"
    case, told = converted(tmp_path, text)
    assert told == [] and case.section["E_1"].prestress is None and case.section["E_1"].area == AREA
    assert case.section["E_2"].prestress == pytest.approx(0.36e8 + 1.28e8 + 0.48 * 5e7)


def test_bars_without_compression(tmp_path):
    """The one in tension carries all of the force."""
    text = LINE.replace("*DENSITY", "*NO COMPRESSION\n*DENSITY")
    force = ran(tmp_path, text + STEP.format("*CLOAD\n2, 1, 5e3\n")).field("axial_force", -1)
    assert force == pytest.approx([5e3, 0.0], rel=1e-9)
    _, told = converted(tmp_path, LINE.replace("*DENSITY", "*NO TENSION\n*DENSITY"))
    assert told == ["line 17: *NO TENSION: left out: there is no law of bars that carry compression alone"]


def test_masses_and_springs(tmp_path):
    """omega^2 = (2 E A/l + k + c) / (rho A l + m) with springs to the ground (SPRING1) and between nodes (SPRINGA)."""
    more = """*ELEMENT, TYPE=MASS, ELSET=M
11, 2
12, 2
*MASS, ELSET=M
3.5,
*ELEMENT, TYPE=SPRING1, ELSET=G
21, 2
*SPRING, ELSET=G
1
4e8
*ELEMENT, TYPE=SPRINGA, ELSET=A
31, 1, 2
*SPRING, ELSET=A

6.e8
*STEP
*FREQUENCY
1
*END STEP
"""
    result = ran(tmp_path, LINE + more)
    stiffness, mass = 2.0 * YOUNG * AREA + 4e8 + 6e8, DENSITY * AREA + 7.0
    assert result.modes.frequency[0] == pytest.approx(np.sqrt(stiffness / mass) / (2.0 * np.pi), rel=1e-9)


def test_nodes_of_instances(tmp_path):
    """Masses, springs and dashpots of the assembly; springs in one direction that is that of their line."""
    text = """*PART, NAME=P
*NODE
1, 0, 0, 0
2, 1, 0, 0
*ELEMENT, TYPE=T3D2, ELSET=E
1, 1, 2
*END PART
*ASSEMBLY, NAME=A
*INSTANCE, NAME=I, PART=P
*END INSTANCE
*INSTANCE, NAME=J, PART=P
3., 0., 0.
*END INSTANCE
*ELEMENT, TYPE=MASS, ELSET=M
1, J.2
*MASS, ELSET=M
5.
*ELEMENT, TYPE=SPRING2, ELSET=S
2, I.2, J.1
*SPRING, ELSET=S
1, 1
7.
*ELEMENT, TYPE=DASHPOTA, ELSET=D
3, I.2, J.1
*DASHPOT, ELSET=D

9.
*END ASSEMBLY
"""
    case, told = converted(tmp_path, text)
    assert told == []
    nodes = {name: case.node_set[name].group for name in case.node_set}
    assert [(mass.node_set, mass.value) for mass in case.point_mass] == [("mass", 5.0)] and "mass" in nodes
    assert case.spring[0].between == ("node_I.2", "node_J.1") == case.dashpot[0].between
    assert (case.spring[0].stiffness, case.dashpot[0].coefficient) == (7.0, 9.0)


def test_dashpots_and_initial_velocities(tmp_path):
    """v = v0 exp(-c t/m) of a mass without stiffness; the dashpot acts in the one direction that is free."""
    more = """*ELEMENT, TYPE=DASHPOT1, ELSET=D
21, 2
*DASHPOT, ELSET=D
1
2.
*INITIAL CONDITIONS, TYPE=VELOCITY
2, 1, 3.
*STEP, NLGEOM=YES
*DYNAMIC
2e-3, 0.1
*CLOAD
2, 1, 0.
*END STEP
"""
    text = LINE.replace(f"{YOUNG}, 0.3", "1e-6, 0.3").replace(f"{DENSITY}\n", "1e3\n")
    told = ["line 32: *DYNAMIC: step = 0.002 s is the first increment, for all steps"]
    result = ran(tmp_path, text + more, told)
    assert result.history["probe/node_2/velocity"][-1, 0, 0] == pytest.approx(3.0 * np.exp(-2.0 * 0.1), rel=1e-5)


def test_general_sections_have_their_material(tmp_path):
    section = (
        "*BEAM GENERAL SECTION, ELSET=E, SECTION=GENERAL, DENSITY=2700.\n2e-4, 1., 0., 1., 1.\n{}7e10, 2.6e10, 2e-5\n"
    )
    expected = {"E": {"young_modulus": 7e10, "density": 2700.0, "thermal_expansion": 2e-5}}
    plain = LINE.replace(f"*SOLID SECTION, ELSET=E, MATERIAL=ST\n{AREA}\n{MATERIAL}", section)
    for direction in ("0., 1., 0.\n", "\n"):
        mesh = read_whole(written(tmp_path, plain.format(direction)))
        assert mesh.tables["material"] == expected
    result = ran(tmp_path, plain.format("0., 1., 0.\n") + STEP.format("*CLOAD\n2, 1, 100.\n"))
    moved = result.history["probe/node_2/position"][-1, 0, 0] - 1.0
    assert moved == pytest.approx(100.0 / (2.0 * 7e10 * 2e-4), rel=1e-6)


def test_amplitudes(tmp_path):
    """Of a static step over the load factor, of a dynamic one over time; temperatures are multiplied as they are."""
    more = (
        "*AMPLITUDE, NAME=Saw\n0., 0., 0.5, 1., 1., 0.5\n*AMPLITUDE, NAME=S, DEFINITION=SMOOTH STEP\n0., 0., 1., 1.\n"
    )
    step = "*CLOAD, AMPLITUDE=saw\n2, 1, 4.\n*CLOAD, AMPLITUDE=S\n2, 1, 4.\n*BOUNDARY, AMPLITUDE=SAW\n3, 1, 1, 2e-3\n"
    step += "*DLOAD, AMPLITUDE=SAW\nE, GRAV, 10., 0., 0., -1.\n*TEMPERATURE, AMPLITUDE=SAW\nMIDDLE, 30.\n"
    for procedure, times in (("*STATIC\n0.1, 2.", [0.0, 0.25, 0.5]), ("*DYNAMIC\n0.1, 2.", [0.0, 0.5, 1.0])):
        text = LINE + more + f"*STEP, NLGEOM\n{procedure}\n{step}*END STEP\n"
        case, told = converted(tmp_path, text)
        assert told[0] == "line 33: *CLOAD: AMPLITUDE=S is left out: only tables of factors are read"
        first, second = case.load
        assert np.allclose(first.table, np.column_stack([times, [0.0, 1.0, 0.5]])) and second.table is None
        (motion,) = [support.motion for support in case.support if support.motion]
        assert np.allclose(motion, [[t, f * 2e-3, 0, 0] for t, f in zip(times, [0.0, 1.0, 0.5])])
        assert np.allclose(case.gravity.acceleration, [[t, 0, 0, -10.0 * f] for t, f in zip(times, [0.0, 1.0, 0.5])])
        (heat,) = case.temperature
        assert np.allclose(heat.table, np.column_stack([times, [0.0, 15.0, 7.5]]))


def test_units(tmp_path):
    """In millimetres, newtons, MPa and tonnes, the same line as in metres."""
    text = (
        LINE.replace("2, 1, 0, 0\n3, 2", "2, 1000, 0, 0\n3, 2000")
        .replace(str(YOUNG), "2.1e5")
        .replace(f"{AREA}\n", "1e3\n")
    )
    text = text.replace(f"{DENSITY}\n", "7.85e-9\n")
    more = """*ELEMENT, TYPE=MASS, ELSET=M
11, 2
*MASS, ELSET=M
2e-3,
*ELEMENT, TYPE=SPRING1, ELSET=G
21, 2
*SPRING, ELSET=G
1
5e3
*INITIAL CONDITIONS, TYPE=STRESS
E, 100.
*INITIAL CONDITIONS, TYPE=VELOCITY
2, 1, 7.
"""
    case, _ = converted(
        tmp_path, text + more + "*STEP, NLGEOM\n*DYNAMIC\n1e-3, 1.\n*BOUNDARY, TYPE=VELOCITY\n3, 1, 1, 2.\n", 1e-3
    )
    assert (case.point_mass[0].value, case.spring[0].stiffness) == (2.0, (5e6, 0.0, 0.0))
    assert (case.section["E"].prestress, case.section["E"].area) == (1e8, 1e-3)
    assert [row.velocity for row in case.initial if row.node_set] == [(7e-3, 0.0, 0.0)]
    assert [support.velocity for support in case.support if support.velocity] == [(2e-3, 0.0, 0.0)]
    assert (case.material["ST"].young_modulus, case.material["ST"].density) == (2.1e11, 7850.0)


def test_what_cannot_be_is_told(tmp_path):
    more = """*INITIAL CONDITIONS, TYPE=STRESS
1, high
*INITIAL CONDITIONS, TYPE=FIELD
2, 1.
*ELEMENT, TYPE=SPRING2, ELSET=S
21, 1, 2
22, 2, 3
*SPRING, ELSET=S
2, 2
1e3
*ELEMENT, TYPE=SPRINGA, ELSET=N
23, 1, 2
*SPRING, ELSET=N, NONLINEAR
0., 0.
1., 1.
*ELEMENT, TYPE=MASS
24, 2
*STEP, INC=100, LOAD=3
*STATIC
*BOUNDARY, TYPE=VELOCITY
3, 1, 1, 2.
*BOUNDARY
3, 11, 11, 2.
*END STEP
"""
    case, told = converted(tmp_path, LINE + more)
    assert told == [
        "line 41: *STEP: LOAD is left out: it is not read",
        "line 25: *INITIAL CONDITIONS: '1, high' is left out: expected elements and their stress",
        "line 44: *BOUNDARY: '3, 1, 1, 2.' is held where it is: TYPE=VELOCITY is not read in a static step",
        "line 46: *BOUNDARY: '3, 11, 11, 2.' is left out: expected degrees of freedom from 1 to 6, and a number",
        "line 31: *SPRING: left out 2 elements: those of a case act along the line between their nodes",
        "line 36: *SPRING: left out 1 elements: NONLINEAR is not read",
        "left out 1 masses, springs or dashpots without *MASS, *SPRING or *DASHPOT",
        "line 26: *INITIAL CONDITIONS, TYPE=FIELD is left out: it is not read",
        "line 41: *STEP has no NLGEOM: the case has large displacements, as all cases do",
    ]
    assert case.spring == [] and case.support[0].node_set == "ENDS"
