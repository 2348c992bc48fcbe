"""The reproduction of the paper: its runs, measures, verdicts, figure and document, on the quickest of its runs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import integrator_tables
import numpy as np
import pytest
from paper_reproduction import claims, document, figures, studies
from paper_reproduction.claims_rod import rod_claims
from paper_reproduction.exact import BAR, PLASTIC_BAR, ROD
from paper_reproduction.measures import contact_episodes, measure_ring, measure_rod
from paper_reproduction.running import read, run_all
from paper_reproduction.schemes import LIKELY, LUMPED, PAPER, SCHEMES

ROOT = Path(__file__).resolve().parents[2]

READINGS = (LIKELY, LUMPED)
RODS = {(reading, scheme): studies.rod_key(scheme, reading) for reading in READINGS for scheme in PAPER}
BARS = [studies.bar_key("central_differences", LIKELY, "0.5", plastic) for plastic in (False, True)]
REFUSED = studies.bar_key("hulbert_chung", LIKELY, "2", False)
RINGS = {s: studies.ring_key(s, LUMPED, "0.5") for s in ("central_differences", "chung_lee", "newmark", "houbolt")}
PHASES = {
    (scheme, phase): studies.phase_key(scheme, LIKELY, phase) for scheme in ("houbolt", "wilson") for phase in (0, 5)
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The quick runs, by name."""
    folder = tmp_path_factory.mktemp("paper")
    wanted = {*RODS.values(), *BARS, REFUSED, *RINGS.values(), *PHASES.values()}
    run_all([study for study in studies.all_studies() if study.key in wanted], folder, 2)
    return {key: read(key, folder) for key in wanted}


@pytest.fixture(scope="module")
def measures(runs):
    """Of the rods, by reading."""
    return {
        reading: claims.Measures(runs, reading, rod={s: measure_rod(runs[RODS[reading, s]], ROD) for s in PAPER})
        for reading in READINGS
    }


def numbers(text):
    return np.array([float(n) for n in re.findall(r"-?\d+\.\d+|-?\b\d+\b", text)])


def test_episodes():
    assert contact_episodes(np.arange(6.0), np.array([0, 1, 1, 0, 0, 2])) == [(1.0, 2.0), (5.0, 5.0)]
    assert contact_episodes(np.arange(2.0), np.zeros(2)) == []


def test_exact_solutions():
    assert (ROD.impact, ROD.duration, ROD.force) == pytest.approx((0.1, 2.0, 0.5))
    assert BAR.force == pytest.approx(133.5e3, rel=1e-3)
    assert BAR.duration == pytest.approx(98.9e-6, rel=1e-3)
    assert PLASTIC_BAR.force == pytest.approx(60.48e3, rel=1e-3)
    np.testing.assert_allclose(ROD.mean_velocity(np.array([0.0, 0.6, 1.1, 3.0])), [0.5, 0.25, 0.0, -0.5])


def test_study_names_are_distinct():
    names = [study.key for study in studies.all_studies()]
    assert len(set(names)) == len(names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "end", "peak", "releases", "rebound", "energy", "undershoot"),
    [
        ("central_differences", 2.13, 2.50, 1, 0.958, 0.975, 0.0),
        ("chung_lee", 2.14, 2.41, 1, 0.958, 0.974, 0.446),
        ("newmark", 2.11, 2.69, 1, 0.884, 0.806, 0.5),
        ("houbolt", 2.13, 5.20, 2, 0.950, 0.947, 0.833),
    ],
)
def test_rod_with_lumped_mass(measures, scheme, end, peak, releases, rebound, energy, undershoot):
    """Close to the values at v0 = 0.1: the problem is linear, only the moment of impact within a step differs."""
    rod = measures[LUMPED].rod[scheme]
    assert rod.end == pytest.approx(end, abs=0.011)
    assert rod.releases == releases
    assert (rod.peak, rod.median, rod.undershoot) == pytest.approx((peak, 1.0, undershoot), abs=0.01)
    assert (-rod.whole_rebound, rod.energy) == pytest.approx((rebound, energy), abs=2e-3)


@pytest.mark.slow
def test_rod_with_consistent_mass(measures):
    """Independent values: excess 6.6 and 3.8, energy 0.973 (Wilson) and 0.957 (Houbolt)."""
    wilson, houbolt = (measures[LIKELY].rod[scheme] for scheme in ("wilson", "houbolt"))
    assert (wilson.excess, houbolt.excess) == pytest.approx((6.6, 3.8), abs=0.06)
    assert (wilson.energy, houbolt.energy) == pytest.approx((0.973, 0.957), abs=2e-3)
    assert wilson.held < 2e-3
    assert measures[LIKELY].rod["central_differences"] == measures[LUMPED].rod["central_differences"]


@pytest.mark.slow
def test_run_that_ends_early_is_measured_as_far_as_it_went(runs, measures):
    """Wilson with theta = 1.4 and lumped mass chatters until a bar is driven through zero length."""
    assert runs[RODS[LUMPED, "wilson"]].failure
    assert measures[LUMPED].rod["wilson"].peak > 8.0
    assert np.isnan(measures[LUMPED].rod["wilson"].mean_rebound)


@pytest.mark.slow
def test_phase_of_the_impact_changes_the_order_of_schemes(runs):
    """What Houbolt's method does in the first steps depends on where in the step the impact falls."""
    excess = {}
    for (scheme, phase), key in PHASES.items():
        gap = ROD.gap + phase / studies.PHASES * studies.PHASE_SPEED * studies.ROD_STEP
        exact = replace(ROD, speed=studies.PHASE_SPEED, gap=gap)
        excess[scheme, phase] = measure_rod(runs[key], exact).excess
    assert excess["houbolt", 0] > 2.0 * excess["houbolt", 5]
    assert min(excess["wilson", phase] for phase in (0, 5)) > 2.0


@pytest.mark.slow
def test_bars(runs):
    elastic, plastic = (measure_rod(runs[key], exact) for key, exact in zip(BARS, (BAR, PLASTIC_BAR)))
    assert elastic.median == pytest.approx(1.0, abs=5e-3)
    assert elastic.duration == pytest.approx(98.9e-6, rel=0.035)
    assert plastic.median == pytest.approx(1.0, abs=0.02)
    assert plastic.end == pytest.approx(173e-6, abs=1e-6)
    assert plastic.dissipated == pytest.approx(0.896, abs=0.01)
    assert plastic.whole_rebound > elastic.whole_rebound


@pytest.mark.slow
def test_step_above_the_limit_is_refused_and_said(runs):
    run = runs[REFUSED]
    assert not run.history
    assert "1.91497e-06" in run.failure


@pytest.mark.slow
def test_ring(runs):
    """Explicit schemes and Newmark hit twice, for long; Houbolt leaves after the first step of contact."""
    ring = {scheme: measure_ring(runs[key]) for scheme, key in RINGS.items()}
    for scheme in ("central_differences", "chung_lee", "newmark"):
        (start, end), (again, left) = ring[scheme].phases
        assert (start, end, again) == pytest.approx((5e-3, 35e-3, 122.5e-3), abs=1.1e-3)
        assert left == pytest.approx(155e-3, abs=5e-3)
        assert ring[scheme].left == pytest.approx(0.145, abs=3e-3)
        assert ring[scheme].thrown < 1e-9
    for scheme in ("houbolt",):
        start, end = ring[scheme].phases[0]
        assert (start, end) == pytest.approx((5e-3, 5.5e-3), abs=1e-6)
        assert ring[scheme].thrown > 0.03
        assert len(ring[scheme].phases) > 2


@pytest.mark.slow
def test_verdicts(measures):
    """Those of section 5.1 under both readings, and that they follow the measurements."""
    verdicts = {reading: [claim.verdict for claim in rod_claims(measures[reading])] for reading in READINGS}
    yes, partly, no = claims.REPRODUCED, claims.PARTLY, claims.NOT
    assert verdicts[LIKELY] == [yes, partly, yes, yes, claims.OPEN, yes, yes, yes, partly, yes, yes, partly]
    assert verdicts[LUMPED] == [partly, partly, yes, yes, claims.OPEN, partly, yes, partly, no, yes, yes, partly]
    calm = replace(measures[LIKELY].rod["houbolt"], excess=0.1, roughness=0.05, releases=1, peak=1.0)
    changed = replace(measures[LIKELY], rod={**measures[LIKELY].rod, "houbolt": calm})
    flipped = [new.verdict != old for new, old in zip(rod_claims(changed), verdicts[LIKELY])]
    assert np.flatnonzero(flipped).tolist() == [2, 9, 10]


@pytest.mark.slow
def test_figure(runs, tmp_path):
    figures.draw_rod(runs, tmp_path / "figure.png", False)
    from PIL import Image

    picture = np.asarray(Image.open(tmp_path / "figure.png").convert("RGB"))
    assert picture.shape[1] > 1000
    assert picture.std() > 10.0
    assert (tmp_path / "figure.png").stat().st_size < 150e3


@pytest.mark.slow
def test_document_has_the_measured_numbers(measures):
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    table = text[text.index("| exact | 1 | 1 |") :]
    for scheme in PAPER:
        name = f"{SCHEMES[scheme].name}, {LIKELY.mass(scheme)}"
        cells = document.impact_row(name, measures[LIKELY].rod[scheme], ROD)
        (line,) = [line for line in table.splitlines()[:20] if line.startswith(f"| {cells[0]} |")]
        np.testing.assert_allclose(
            numbers(line.split("|", 2)[2]), [float(cell) for cell in cells[1:]], atol=6e-3, err_msg=line
        )
    assert "$" not in text


def test_pictures_of_the_document_are_there():
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    pictures = re.findall(r"\]\((images/[^)]+)\)", text)
    assert len(pictures) == 10
    for picture in pictures:
        assert 10e3 < (ROOT / "docs" / picture).stat().st_size < 150e3


@pytest.mark.slow
@pytest.mark.parametrize("name", list(integrator_tables.TABLES))
def test_tables_of_integrators_are_up_to_date(name):
    text = integrator_tables.DOCUMENT.read_text(encoding="utf-8")
    start = text.index(f"<!-- table {name} -->")
    old = text[start : text.index("<!-- end -->", start)].strip().splitlines()[2:]
    new = integrator_tables.TABLES[name]().splitlines()
    assert [line.split("|")[1] for line in old] == [line.split("|")[1] for line in new]
    values = [numbers("\n".join(line.split("|", 2)[2] for line in lines)) for lines in (old, new)]
    np.testing.assert_allclose(*values, atol=2e-3)
