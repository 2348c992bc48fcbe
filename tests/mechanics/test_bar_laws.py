"""Cable, strut, damage and compaction, one bar each: closed forms, paths, work."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.twins import Strut, solid

from pfem_petsc.case.tables import Section
from pfem_petsc.mechanics.bars import bar_shapes
from pfem_petsc.mechanics.materials import cable, compaction, damage, strut
from pfem_petsc.mechanics.materials.base import UnsuitableBarError

YOUNG = 200e9
STRUTS = [Strut(YOUNG, 200e6, *rest) for rest in ((40.0, 0.0), (200.0, 0.0), (40.0, 2e-3), (160.0, 1e-3))]


def packed(parameters, section, length):
    """Numbers that the response of one bar reads."""
    shapes = bar_shapes(section, np.array([length]), np.array([section.area]))
    return (*parameters.pack(), *(float(values[0]) for values in parameters.pack_bars(shapes)))


def of_strut(bar):
    material, section = solid(bar)
    return packed(strut.Parameters(**material), Section(material="m", **section), bar.length)


ROUND = Section(area=1e-4, material="m", shape="round")
SOFT = damage.Parameters(young_modulus=30e9, density=2400.0, tensile_strength=3e6, fracture_energy=100.0)
LAWS = {
    "cable": (cable, packed(cable.Parameters(young_modulus=YOUNG, density=1.0), ROUND, 1.0), 2e-3),
    "plastic cable": (
        cable,
        packed(
            cable.Parameters(young_modulus=YOUNG, density=1.0, yield_stress=200e6, isotropic_hardening=5e9), ROUND, 1.0
        ),
        4e-3,
    ),
    "damage": (damage, packed(SOFT, ROUND, 0.3), 4e-4),
    "compaction": (
        compaction,
        packed(
            compaction.Parameters(
                young_modulus=YOUNG,
                density=1.0,
                yield_stress=100e6,
                kinematic_hardening=1e9,
                compaction_strain=0.1,
                compaction_modulus=50e9,
            ),
            ROUND,
            1.0,
        ),
        0.15,
    ),
    "stocky strut": (strut, of_strut(STRUTS[0]), 8e-3),
    "slender strut": (strut, of_strut(STRUTS[1]), 8e-3),
    "crooked strut": (strut, of_strut(STRUTS[2]), 8e-3),
    "snapping strut": (strut, of_strut(Strut(YOUNG, 200e6, 90.0)), 8e-3),
}
CYCLE = (0.3, -0.4, 1.0, -1.0, 0.2, -0.9, 1.2, -1.3)


def follow(law, p, strains, q=None):
    """Stresses, tangents, energies and internal variables along strains."""
    q, found = q or (0.0,) * len(law.LAW.internal), []
    for strain in strains:
        stress, tangent, q, energies = law.response(float(strain), 0.0, 0.0, 0.0, p, q)
        found.append((stress, tangent, sum(energies), q))
    return found


def work(law, p, q, begin, end, slack, depth=0):
    """Integral of the stress on a way from a state, by Gauss's rule on halves of halves: kinks and jumps are enclosed.

    A kink beside an end, which Gauss's points miss, is seen by the rule that has the tangents at the ends.
    """

    def at(x):
        return law.response(begin + 0.5 * (1.0 + x) * (end - begin), 0.0, 0.0, 0.0, p, q)

    half, ends = 0.5 * (end - begin), (at(-1.0), at(1.0))
    total = half * float(_WEIGHTS @ [at(x)[0] for x in _POINTS.tolist()])
    rough = half * (ends[0][0] + ends[1][0]) + half * half / 3.0 * (ends[0][1] - ends[1][1])
    if depth > 44 or abs(total - rough) <= slack:  # the kink that is missed is a thousand times less
        return total
    middle = 0.5 * (begin + end)
    return work(law, p, q, begin, middle, slack, depth + 1) + work(law, p, q, middle, end, slack, depth + 1)


_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(7)


@pytest.mark.parametrize("name", LAWS)
def test_work_is_energy_and_dissipation(name):
    """On a cycle, to 1e-12 of what is dissipated and stored."""
    law, p, size = LAWS[name]
    q, strain, done, heat = (0.0,) * len(law.LAW.internal), 0.0, 0.0, 0.0
    for target in size * np.array(CYCLE):
        done += work(law, p, q, strain, float(target), 1e-13 * YOUNG * size**2)
        stress, _, q, energies = law.response(float(target), 0.0, 0.0, 0.0, p, q)
        strain = float(target)
        assert done == pytest.approx(sum(energies), rel=1e-12, abs=1e-4), target
        assert energies[0] >= 0.0 and sum(energies[1:2]) >= heat  # what is stored by hardening comes third
        heat = sum(energies[1:2])
    assert name == "cable" or heat > 0.0


@pytest.mark.parametrize("name", LAWS)
def test_response_does_not_depend_on_steps(name):
    law, p, size = LAWS[name]
    ends = size * np.array([0.0, *CYCLE])
    coarse = follow(law, p, ends[1:])
    fine = follow(law, p, np.concatenate([np.linspace(a, b, 38)[1:] for a, b in zip(ends, ends[1:], strict=False)]))
    for one, many in zip(coarse, fine[36::37], strict=True):
        assert one[0] == pytest.approx(many[0], rel=1e-10, abs=1e-10 * YOUNG * size)
        assert one[2] == pytest.approx(many[2], rel=1e-10)
        assert one[3] == pytest.approx(many[3], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_tangent_is_the_derivative(name):
    """Central differences away from kinks, where tangents on both sides agree."""
    law, p, size = LAWS[name]
    q, checked = (0.0,) * len(law.LAW.internal), 0
    ends = size * np.array([0.0, *CYCLE])
    h = 1e-6 * size
    for strain in np.concatenate([np.linspace(a, b, 14)[1:] for a, b in zip(ends, ends[1:], strict=False)]).tolist():
        below, here, above = (law.response(strain + d, 0.0, 0.0, 0.0, p, q) for d in (-h, 0.0, h))
        if max(abs(below[1] - here[1]), abs(above[1] - here[1])) < 1e-3 * abs(here[1]) + 1e-9 * YOUNG:
            assert here[1] == pytest.approx((above[0] - below[0]) / (2.0 * h), rel=1e-4, abs=1e-6 * YOUNG)
            checked += 1
        q = here[2]
    assert checked > 80


@pytest.mark.parametrize("bar", STRUTS, ids=lambda bar: f"{bar.slenderness:g}-{bar.imperfection:g}")
def test_strut_cycle(bar):
    """Against the equations in the stress, by bisection: stress, plastic strain, angle and tangent of each step."""
    p, state = of_strut(bar), bar.start()
    q = (0.0,) * 4
    ends = 8e-3 * np.array([0.0, *CYCLE])
    for strain in np.concatenate([np.linspace(a, b, 8)[1:] for a, b in zip(ends, ends[1:], strict=False)]).tolist():
        expected, state, tangent = bar.step(strain, state)
        stress, stiffness, q, _ = strut.response(strain, 0.0, 0.0, 0.0, p, q)
        assert stress == pytest.approx(expected, rel=1e-10, abs=1e-10 * bar.yields), strain
        angle = bar.start()[2]
        assert (q[0] + bar.start()[0], q[1], q[2] + angle) == pytest.approx(state, rel=1e-9, abs=1e-11), strain
        assert stiffness == pytest.approx(tangent, rel=1e-6, abs=1e-7 * YOUNG), strain
    assert q[1] > 1e-3


def test_strut_is_a_beam_with_a_hinge():
    """Shortening, moment and energy of a deflection that satisfies E I y'' = -P y, by quadrature along the strut."""
    bar = STRUTS[1]
    p, strain = of_strut(bar), -6e-3
    stress, _, q, (elastic, heat) = strut.response(strain, 0.0, 0.0, 0.0, p, (0.0,) * 4)
    k = math.sqrt(-stress * bar.area / (bar.young * bar.inertia))
    points, weights = np.polynomial.legendre.leggauss(40)
    x, w = 0.25 * bar.length * (1.0 + points), 0.25 * bar.length * weights
    slope = 0.5 * q[2] / math.cos(0.5 * k * bar.length)
    shortening = float(w @ (slope * np.cos(k * x)) ** 2) / bar.length
    assert stress / bar.young + q[0] - shortening == pytest.approx(strain, rel=1e-10)
    bending = bar.young * bar.inertia * float(w @ (slope * k * np.sin(k * x)) ** 2)
    volume = bar.area * bar.length
    assert elastic == pytest.approx(0.5 * stress**2 / bar.young + bending / volume, rel=1e-9)
    moment = bar.young * bar.inertia * slope * k * math.sin(0.5 * k * bar.length)
    assert moment / bar.full_moment - stress / bar.yields == pytest.approx(1.0, rel=1e-12)
    # all that is dissipated is the plastic moment and force times angle and shortening of the hinge
    assert heat == pytest.approx(bar.full_moment * q[2] / volume, rel=1e-12)


@pytest.mark.parametrize("slenderness", [30.0, 70.0, 99.0, 99.5, 130.0, 300.0])
def test_strength_is_the_smaller_of_yield_and_euler(slenderness):
    bar = Strut(YOUNG, 200e6, slenderness)
    stresses = [row[0] for row in follow(strut, of_strut(bar), np.linspace(0.0, -4e-3, 4001))]
    assert min(stresses) == pytest.approx(-min(bar.euler, bar.yields), rel=2e-3)
    assert min(stresses) >= -min(bar.euler, bar.yields) * (1.0 + 1e-14)
    assert stresses[-1] > 0.6 * min(stresses)  # it softens


def test_strut_straightens_and_yields_in_tension():
    bar = STRUTS[1]
    (_, _, _, bent), (stress, tangent, _, q) = follow(strut, of_strut(bar), [-6e-3, 6e-3])
    assert bent[2] > 0.1 and abs(q[2]) < 1e-15
    assert stress == pytest.approx(bar.yields, rel=1e-15) and tangent == 0.0
    assert q[0] == pytest.approx(6e-3 - bar.yields / YOUNG, rel=1e-12)
    again = [row[0] for row in follow(strut, of_strut(bar), np.linspace(6e-3, 0.0, 500), q)]
    assert min(again) == pytest.approx(-bar.euler, rel=1e-12)


def test_snap_sets_energy_free():
    """At the yield stress, a straight strut of middle slenderness: the stress jumps, and the difference is heat."""
    bar = Strut(YOUNG, 200e6, 90.0)
    p, first = of_strut(bar), -bar.yields / YOUNG
    before, after = (strut.response(first * (1.0 + d), 0.0, 0.0, 0.0, p, (0.0,) * 4) for d in (-1e-9, 1e-9))
    assert before[0] == pytest.approx(-bar.yields, rel=1e-8) and after[0] > 0.9 * before[0]
    assert before[2] == (0.0,) * 4 and after[2][3] > 0.0
    lost = before[3][0] - after[3][0]
    assert after[3][1] == pytest.approx(lost, rel=1e-6)  # nothing is supplied at one strain
    assert after[3][1] == pytest.approx(bar.yields * after[2][1] + after[2][3], rel=1e-12)


def test_sections():
    length, area = np.array([2.0]), np.array([3e-4])
    solid_bar = bar_shapes(Section(area=3e-4, material="m", shape="round"), length, area)
    assert solid_bar.second_moment[0] == pytest.approx(3e-4**2 / (4.0 * math.pi), rel=1e-14)
    tube = bar_shapes(
        Section(area=3e-4, material="m", shape="tube", thickness=2e-3, effective_length=0.7), length, area
    )
    outer = tube.radius[0]
    assert math.pi * (outer**2 - (outer - 2e-3) ** 2) == pytest.approx(3e-4, rel=1e-13)
    assert tube.second_moment[0] == pytest.approx(0.25 * math.pi * (outer**4 - (outer - 2e-3) ** 4), rel=1e-13)
    assert tube.effective_length[0] == 1.4
    given = bar_shapes(Section(area=3e-4, material="m", second_moment=float(tube.second_moment[0])), length, area)
    assert given.radius[0] == pytest.approx(outer, rel=1e-12)
    assert given.plastic_modulus[0] == pytest.approx(tube.plastic_modulus[0], rel=1e-10)
    flat = bar_shapes(Section(area=2e-4, material="m", second_moment=0.02 * 0.01**3 / 12.0), length, np.array([2e-4]))
    assert flat.plastic_modulus[0] == pytest.approx(0.02 * 0.01**2 / 4.0, rel=1e-12)  # 20 mm x 10 mm


def test_strut_without_a_shape_is_refused():
    with pytest.raises(UnsuitableBarError, match="give the section a shape"):
        packed(
            strut.Parameters(young_modulus=YOUNG, density=1.0, yield_stress=1e8),
            Section(area=1e-4, material="m"),
            1.0,
        )


def test_cable_takes_up_slack():
    """Yields to 3e-3, is slack below the plastic strain, pulls again there."""
    law, p, _ = LAWS["plastic cable"]
    flow = (YOUNG * 3e-3 - 200e6) / (YOUNG + 5e9)
    rows = follow(law, p, [3e-3, 0.5 * flow, flow + 1e-4, -1.0, flow + 2e-4])
    assert [row[0] for row in rows] == pytest.approx([200e6 + 5e9 * flow, 0.0, 2e7, 0.0, 4e7], rel=1e-10)
    assert [row[3][1] for row in rows] == [0.0, 1.0, 0.0, 1.0, 0.0]
    assert rows[1][1] == 0.0 and rows[1][2] == pytest.approx(200e6 * flow + 0.5 * 5e9 * flow**2, rel=1e-12)


@pytest.mark.parametrize("length", [0.01, 0.1, 0.6])
def test_fracture_energy_does_not_depend_on_the_length(length):
    p = packed(SOFT, ROUND, length)
    parted = 2.0 * 100.0 / (3e6 * length)
    middle = 0.5 * (1e-4 + parted)
    rows = follow(damage, p, [1e-4, middle, 0.4 * middle, -1e-4, parted, 2.0 * parted])
    assert [row[0] for row in rows[:3]] == pytest.approx([3e6, 1.5e6, 0.6e6], rel=1e-12)  # the last to the origin
    assert rows[3][0] == -30e9 * 1e-4  # the crack is closed
    assert abs(rows[4][0]) < 1e-9 * 3e6 and rows[5][0] == 0.0
    assert rows[5][2] * length == pytest.approx(100.0, rel=1e-12)


def test_bars_that_snap_back_are_refused():
    """2 E G/f^2 = 0.6667 m."""
    packed(SOFT, ROUND, 0.6666)
    with pytest.raises(UnsuitableBarError, match=r"0\.667 m is too much .*: bars of 0\.666667 m and more"):
        packed(SOFT, ROUND, 0.667)


def test_compaction_adds_a_spring():
    law, p, _ = LAWS["compaction"]
    flow = (YOUNG * 0.12 - 100e6) / (YOUNG + 1e9)
    ((stress, tangent, *_),) = follow(law, p, [-0.12])
    assert stress == pytest.approx(-100e6 - 1e9 * flow - 50e9 * 0.02, rel=1e-12)
    assert tangent == pytest.approx(YOUNG * 1e9 / (YOUNG + 1e9) + 50e9, rel=1e-12)
