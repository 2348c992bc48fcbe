"""What names and expressions select of the columns of a history."""

import numpy as np
import pytest

from pfem_petsc.errors import InputError
from pfem_petsc.output.table import select
from pfem_petsc.output.units import dimensions, powers_of, product, simplest, text_of

TIME = np.linspace(0.0, 1.0, 5)
GROUND = np.stack([0.1 * np.sin(TIME), 0.0 * TIME, 0.0 * TIME], axis=1)
ROOF = np.stack([GROUND + [5.0, 0.0, 3.0] + [[0.01 * k, 0.0, 0.0] for k in range(5)], GROUND + [9.0, 0.0, 3.0]], axis=1)
FORCE = np.stack([3.0 * TIME, 0.0 * TIME, -8.0 * TIME], axis=1)
BARS = np.stack([TIME, -2.0 * TIME, 5.0 + TIME], axis=1)
HISTORY = {
    "time": TIME,
    "step": np.arange(5),
    "kinetic_energy": 2.0 * TIME,
    "probe/ground/position": GROUND[:, None],
    "probe/roof/position": ROOF,
    "probe/roof/reaction": ROOF,
    "probe/roof - top/position": ROOF + 1.0,
    "wall/plate/force": FORCE,
    "wall/plate-2/force": 7.0 * FORCE,
    "wall/plate/position": FORCE,
    "bar/legs/axial_force": BARS,
    "bar/legs/strain": BARS,
}
DX = "probe/roof/displacement.x"


def test_displacement_relative_to_the_ground():
    """Of two nodes, one of which moves by 0.01 m a row against the ground: their mean by half of this."""
    for minus in (" - ", "-", " -", "- "):
        found = select(HISTORY, f"{DX}{minus}probe/ground/displacement.x")
        np.testing.assert_allclose(found.values, 0.005 * np.arange(5), atol=1e-15)
        assert (found.unit, found.single) == ("m", False)
    vectors = select(HISTORY, "probe/roof/displacement - probe/ground/displacement")
    np.testing.assert_allclose(vectors.values, np.outer(0.005 * np.arange(5), [1.0, 0.0, 0.0]), atol=1e-15)
    assert vectors.vector and vectors.sources == ("probe/roof/position", "probe/ground/position")
    node = select(HISTORY, "probe/roof/displacement[0].x - probe/ground/displacement[0].x")
    np.testing.assert_allclose(node.values, 0.01 * np.arange(5), atol=1e-15)


@pytest.mark.parametrize(
    ("text", "expected", "unit"),
    [
        ("-wall/plate/force.z/1.2e-3", 8.0 * TIME / 1.2e-3, None),  # a number may be anything
        ("-wall/plate/force.z/1.2e-3[m2]", 8.0 * TIME / 1.2e-3, "Pa"),
        ("wall/plate/force.norm*2[1]", 2.0 * np.sqrt(73.0) * TIME, "N"),
        ("-kinetic_energy", -2.0 * TIME, "J"),
        ("wall/plate-2/force.x-wall/plate/force.x", 18.0 * TIME, "N"),  # the longest name, whatever it contains
        ("(wall/plate-2/force - wall/plate/force).z", -48.0 * TIME, "N"),
        ("(wall/plate/force + wall/plate/force).norm / 2", np.sqrt(73.0) * TIME, None),
        ("probe/roof - top/position.x - probe/roof/position.x", np.ones(5), "m"),
        ("probe/roof/position.z * 2 - 1", 2.0 * ROOF[:, 0, 2] - 1.0, None),
        ("probe/roof/position.z - 1", ROOF[:, 0, 2] - 1.0, "m"),
        ("1 - 2 - time", -1.0 - TIME, "s"),
        ("12 / 2 / 3 * time", 2.0 * TIME, None),
        ("2 * (time - 1[s]) + 3 * time", 5.0 * TIME - 2.0, None),
        ("+time*.5e+1", 5.0 * TIME, None),
        ("kinetic_energy / wall/plate/force.x", np.where(TIME > 0.0, 2.0 / 3.0, np.nan), "m"),
        ("kinetic_energy / time", np.where(TIME > 0.0, 2.0, np.nan), "W"),
        ("wall/plate/force.x * probe/ground/displacement.x", 0.3 * TIME * np.sin(TIME), "J"),
        ("wall/plate/force.x/6[kg] - 1[m/s2]", 0.5 * TIME - 1.0, "m/s²"),
        ("wall/plate/force.x/9.81[m/s2]/2[kg]", 3.0 * TIME / 19.62, ""),
        ("probe/roof/reaction.z", ROOF[:, :, 2].sum(axis=1), "N"),
        ("probe/roof/reaction/time", None, None),
        ("wall/plate/displacement.z", -8.0 * TIME, "m"),
        ("kinetic_energy/displacement", 2.0 * TIME, "J"),
        ("kinetic_energy/ displacement", None, None),
        ("step", np.arange(5), ""),
        ("step * kinetic_energy", np.arange(5) * 2.0 * TIME, "J"),
        ("bar/legs/axial_force[1]", -2.0 * TIME, "N"),
        ("bar/legs/axial_force.max", 5.0 + TIME, "N"),
        ("bar/legs/axial_force.min", -2.0 * TIME, "N"),
        ("bar/legs/axial_force * 1[1]", BARS.mean(axis=1), "N"),
        ("bar/legs/axial_force / bar/legs/strain", np.ones(5), "N"),
    ],
)
def test_arithmetic(text, expected, unit):
    if expected is None:
        if "reaction" in text:  # a vector over a number
            values = ROOF.sum(axis=1)[1:] / TIME[1:, None]
            np.testing.assert_allclose(select(HISTORY, text).values[1:], values)
        else:
            with pytest.raises(InputError, match="no column 'displacement'"):
                select(HISTORY, text)
        return
    found = select(HISTORY, text)
    np.testing.assert_allclose(found.values, expected, rtol=1e-14, atol=1e-14)
    assert (found.unit, found.vector) == (unit, False)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("probe/roof/position - time", "one is a vector and the other is not"),
        ("probe/roof/position - probe/grund/position", "no column 'probe/grund/position', did you mean"),
        ("wall/plat/force.z/1.2e-3", "no column 'wall/plat/force', did you mean 'wall/plate/force'"),
        ("wall/plate/force.w", "no column 'wall/plate/force.w'"),
        ("time - kinetic_energy", "the units s and J differ"),
        ("time + step", "the units s and 1 differ"),
        ("time / wall/plate/force", "a vector is multiplied and divided by numbers only"),
        ("wall/plate/force * wall/plate/force", "a vector is multiplied and divided by numbers only"),
        ("time.x", "'time' is a number and has no components"),
        ("(time + time).x", "'it' is a number and has no components"),
        ("probe/roof/position[2].x", r"has probe/roof/position\[0\].x"),
        ("bar/legs/strain[3]", r"has bar/legs/strain\[0\], bar/legs/strain\[1\], bar/legs/strain\[2\]"),
        ("wall/plate/force.max", "least or largest of several bars"),
        ("2 * 3", "names no column"),
        ("", "the expression is empty"),
        (" + ".join(["time"] * 300), "2097 letters, at most 2000 are read"),
        (f"{'(' * 900}time{')' * 900}", "parentheses and signs within each other are too many"),
        ("time +", "a column or a number is missing"),
        ("(time", "a '\\)' is missing"),
        ("time)", "expected \\+, -, \\* or / before '\\)'"),
        ("time time", "expected \\+, -, \\* or / before 'time'"),
        ("time ** 2", "a column or a number is missing at '\\* 2'"),
        ("time * 3[furlong]", "'furlong' is not a unit"),
        ("__import__('os')", "no column '__import__'"),
        ("2 * abs(time)", r"'abs\(...\)': there are no functions; expressions have \+ - \* /"),
        ("time.__class__", "no column 'time.__class__'"),
    ],
)
def test_what_is_no_expression(text, why):
    with pytest.raises(InputError, match=why):
        select(HISTORY, text)


@pytest.mark.parametrize(
    "unit", ["", "N", "kg m/s", "kg m²/s", "m/s²", "1/s²", "Pa", "N s", "J", "N m", "J/(m s)", "m³", "m^4/s"]
)
def test_units_read_back(unit):
    assert text_of(powers_of(unit)) == unit


def test_stress_over_area_is_a_force():
    assert simplest(product((powers_of("Pa"), 1), (powers_of("m2"), 1))) == "N"


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("N s2/(m kg)", ""),
        ("N/kg", "m/s²"),
        ("N s/kg", "m/s"),
        ("kg m/s2", "N"),
        ("kg m2/s3", "W"),
        ("J/m3", "Pa"),
        ("J/m2", "N/m"),
        ("W s", "J"),
        ("N Hz", "N Hz"),
        ("W/Hz", "J"),
        ("kg m/s", "kg m/s"),
        ("m2/s2", "m²/s²"),
        ("J/kg", "J/kg"),
        ("Pa/K", "Pa/K"),
        ("J/rad", "J/rad"),
    ],
)
def test_units_are_shown_by_their_simplest_name(unit, expected):
    assert simplest(powers_of(unit)) == expected
    assert dimensions(powers_of(unit)) == dimensions(powers_of(expected))
