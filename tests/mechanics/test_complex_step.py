"""Tangents of all laws and strain measures against complex step: those that the compiled loops use, from their code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.twins import KEYS, SIZE, SOFTENING, Complex, cycles, derivative, make, patch, real

from pfem_petsc.case.tables import Section
from pfem_petsc.mechanics import rupture
from pfem_petsc.mechanics.bars import bar_shapes
from pfem_petsc.mechanics.elements import MEASURES, Bar, make_element

REST, AREA = 0.3, 2e-4
STRUT = {"yield_stress": 200e6}
MORE = {
    "elastic": {},
    "elastoplastic": {"yield_stress": 250e6, "isotropic_hardening": 1e9, "kinematic_hardening": 2e9},
    "cable": {"yield_stress": 200e6, "isotropic_hardening": 5e9},
    "damage": {"young_modulus": 30e9, "tensile_strength": 3e6, "fracture_energy": 100.0},
    "compaction": {
        "yield_stress": 100e6, "kinematic_hardening": 1e9, "compaction_strain": 0.004, "compaction_modulus": 50e9
    },
    "strut": STRUT,
}  # fmt: skip
RADII = {"slender": 3e-3, "middle": 0.3 / 45.0, "stocky": 1.5e-2}  # slenderness 200, 90 (snaps), 40
BARS = {
    **{name: (name, KEYS.get(name, MORE.get(name)), 1.0) for name in (*MORE, *KEYS) if name != "strut"},
    **{f"{name} strut": ("strut", STRUT, radius) for name, radius in RADII.items()},
    "crooked strut": ("strut", STRUT | {"imperfection": 2e-3}, RADII["slender"]),
    "damped damage": ("damage", MORE["damage"] | {"stiffness_damping": 1e-4}, 1.0),
    "damped strut": ("strut", STRUT | {"stiffness_damping": 1e-4}, RADII["slender"]),
    "damped perzyna": ("perzyna", {"stiffness_damping": 1e-4}, 1.0),
    **{
        f"softened {name}": (name, MORE.get(name, {}) | {"softening": SOFTENING}, 1.0)
        for name in ("elastic", "elastoplastic", "voce", "ludwik", "multilinear", "cowper_symonds")
    },
}
WARMTH = 130.0  # K


def prepared(kind):
    """Law of a bar, the numbers that it reads, and Young's modulus."""
    name, keys, radius = BARS[kind]
    material, law = make(name, **keys)
    section = Section(area=AREA if radius == 1.0 else math.pi * radius**2, material="m", shape="round")
    shapes = bar_shapes(section, np.array([REST]), np.array([section.area]))
    numbers = material.numbers()
    return law, (*numbers, *(float(v[0]) for v in material.pack_bars(shapes))), material.young_modulus


def path(kind):
    """Lengths and steps: loading and unloading in cycles at rates over five decades; a bar at rest, with reversals."""
    strains, steps = cycles(4)
    if "damage" in kind:
        strains = 0.3 * strains  # parted at 2.2e-4, in the second half
        strains = np.concatenate([0.03 * strains, strains])
        steps = np.concatenate([steps, steps])
    return REST * (1.0 + strains), steps


@pytest.fixture
def complex_functions(monkeypatch):
    patch(monkeypatch)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("kind", BARS)
def test_stiffness_is_the_derivative_of_the_axial_force(complex_functions, kind, measure):
    law, p, young = prepared(kind)
    stiffness = make_element(law, MEASURES[measure]).stiffness
    strain_of, scale = MEASURES[measure], young * AREA / REST
    q, before, tangents = (0.0,) * len(law.internal), 0.0, []
    for length, h in zip(*path(kind), strict=True):
        length, h = float(length), float(h)
        step = h if law.rate else 0.0
        bar = Bar(REST, 1e-4, WARMTH, AREA, p, before, 0.0, q)
        axial, _, _ = stiffness((length, 0.0, 0.0), bar, step)
        varied = stiffness((Complex(length, SIZE), 0.0, 0.0), bar, step)
        force = varied[1] / varied[2]
        assert axial == pytest.approx(derivative(force), rel=1e-12, abs=1e-12 * scale), (length, h, q)
        strain = strain_of(length / REST)[0] - 1e-4
        rate = (strain - before) / h if law.rate else 0.0
        stress, _, q, _ = law.response(strain, rate, step, WARMTH, p, q)
        assert real(force) == pytest.approx(AREA * stress * strain_of(length / REST)[1], rel=1e-14, abs=1e-14 * scale)
        before = strain
        tangents.append(axial / scale)
    if kind != "elastic":
        assert min(tangents) < 0.9 < 1.1 * max(tangents)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("kind", [kind for kind in BARS if "softened" not in kind or "elastic" in kind.split()])
def test_stiffness_of_the_conserving_force(complex_functions, kind, measure):
    law, p, young = prepared(kind)
    pair = make_element(law, MEASURES[measure]).step_stiffness
    strain_of, scale = MEASURES[measure], young * AREA / REST
    q, before, kept = (0.0,) * len(law.internal), REST, 0.0
    for length, h in zip(*path(kind), strict=True):
        length, h = float(length), float(h)
        step = h if law.rate else 0.0
        given = (REST, 0.0, WARMTH), Bar(REST, 0.0, WARMTH, AREA, p, 0.0, kept, q), step
        _, slope, _ = pair((before, 0.0, 0.0), (length, 0.0, 0.0), *given)
        varied, _, _ = pair((before, 0.0, 0.0), (Complex(length, SIZE), 0.0, 0.0), *given)
        # the mean stress is a quotient by the change of strain
        noise = 1e-12 + 1e-14 * REST / max(abs(length - before), 1e-3 * REST)
        assert slope * REST == pytest.approx(derivative(varied) * REST, rel=noise, abs=noise * scale), (length, h, q)
        strains = [strain_of(x / REST)[0] for x in (before, length)]
        rate = (strains[1] - strains[0]) / h if law.rate else 0.0
        kept, _, q, _ = law.response(strains[1], rate, step, WARMTH, p, q)
        before = length


@pytest.mark.parametrize("kind", ["elastic", "voce", "perzyna", "damage", "slender strut", "damped damage"])
def test_stiffness_of_bars_that_break(complex_functions, kind):
    """Bars of which a share is left, that lose a part of it in the step, and broken ones."""
    law, p, young = prepared(kind)
    law = rupture.breakable.__wrapped__(law)
    limits = (math.inf, 0.003 if "damage" not in kind else 1e-4, *(math.inf,) * 4, 0.25)  # in four steps
    stiffness = make_element(law, MEASURES["logarithmic"]).stiffness
    q, before, scale, shares = (0.0,) * len(law.internal), 0.0, young * AREA / REST, []
    for length, h in zip(*path(kind), strict=True):
        length, h = float(length), float(h)
        step = h if law.rate else 0.0
        numbers = (*limits, *p)
        bar = Bar(REST, 0.0, 0.0, AREA, numbers, before, 0.0, q)
        axial, _, _ = stiffness((length, 0.0, 0.0), bar, step)
        _, over, inverse = stiffness((Complex(length, SIZE), 0.0, 0.0), bar, step)
        force = over / inverse if q[law.rupture] < 1.0 else 0.0
        assert axial == pytest.approx(derivative(force), rel=1e-12, abs=1e-12 * scale), (length, h, q)
        shares.append(q[law.rupture])
        strain = math.log(length / REST)
        _, _, q, _ = law.response(strain, (strain - before) / h if law.rate else 0.0, step, 0.0, numbers, q)
        before = strain
    assert set(shares) == {0.0, 0.25, 0.5, 0.75, 1.0}
