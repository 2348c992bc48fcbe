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
from paper_reproduction.measures import measure_rod
from paper_reproduction.running import read, run_all
from paper_reproduction.schemes import LIKELY, LUMPED, PAPER, SCHEMES

ROOT = Path(__file__).resolve().parents[2]

READINGS = (LIKELY, LUMPED)
RODS = {(reading, scheme): studies.rod_key(scheme, reading) for reading in READINGS for scheme in PAPER}
REFUSED = studies.bar_key("hulbert_chung", LIKELY, "2", False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The quick runs, by name."""
    folder = tmp_path_factory.mktemp("paper")
    wanted = {*RODS.values(), REFUSED}
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


def test_exact_solutions():
    assert (ROD.impact, ROD.duration, ROD.force) == pytest.approx((0.1, 2.0, 0.5))
    assert BAR.force == pytest.approx(133.5e3, rel=1e-3)
    assert BAR.duration == pytest.approx(98.9e-6, rel=1e-3)
    assert PLASTIC_BAR.force == pytest.approx(60.48e3, rel=1e-3)
    np.testing.assert_allclose(ROD.mean_velocity(np.array([0.0, 0.6, 1.1, 3.0])), [0.5, 0.25, 0.0, -0.5])


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
def test_run_that_ends_early_is_measured_as_far_as_it_went(runs, measures):
    """Wilson with theta = 1.4 and lumped mass chatters until a bar is driven through zero length."""
    assert runs[RODS[LUMPED, "wilson"]].failure
    assert measures[LUMPED].rod["wilson"].peak > 8.0
    assert np.isnan(measures[LUMPED].rod["wilson"].mean_rebound)


@pytest.mark.slow
def test_step_above_the_limit_is_refused_and_said(runs):
    run = runs[REFUSED]
    assert not run.history
    assert "1.91497e-06" in run.failure


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


def test_text_of_the_page_is_that_of_its_template():
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    parts = re.split(r"\$\w+", document.TEMPLATE.read_text(encoding="utf-8"))
    assert len(parts) > 10
    assert re.fullmatch(".*?".join(re.escape(part) for part in parts), page, flags=re.DOTALL)


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
