"""Writes docs/paper.md from its template, with tables of measured numbers and judged statements."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from string import Template

from pages import markdown

from .claims import FITTED, NOT, OPEN, PARTLY, REPRODUCED, Claim, Measures
from .claims_bars import bar_claims
from .claims_ring import conclusion_claims, phases_text, ring_claims
from .claims_rod import phase_rows, rod_claims
from .exact import BAR, PLASTIC_BAR, ROD, Rod
from .measures import RodImpact
from .schemes import IN_TABLES, SCHEMES
from .studies import BAR_STEPS, OTHER_RINGS, OTHER_SCHEMES, RING_STEPS, bar_key, rod_key

TEMPLATE = Path(__file__).with_name("paper.md")


def all_claims(m: Measures) -> dict[str, list[Claim]]:
    """Judged statements by section of the paper."""
    return {
        "rod_claims": rod_claims(m),
        "bar_claims": bar_claims(m),
        "ring_claims": ring_claims(m),
        "conclusion_claims": conclusion_claims(m),
    }


def write_document(readings: list[Measures], file: Path) -> dict[str, Counter]:
    """Write the document from the measures under all readings, the most likely first; verdicts by reading."""
    m = readings[0]
    judged = [all_claims(measures) for measures in readings]
    verdicts = {
        measures.reading.name: Counter(claim.verdict for section in claims.values() for claim in section)
        for measures, claims in zip(readings, judged, strict=True)
    }
    names = [measures.reading.name for measures in readings]
    values = {section: _claims_table([claims[section] for claims in judged], names) for section in judged[0]}
    values["summary"] = _summary(verdicts)
    values["phases"] = _phases_table(readings)
    values["rod_table"] = _rod_table(readings)
    for plastic in (False, True):
        for step in BAR_STEPS:
            kind = "plastic" if plastic else "elastic"
            values[f"{kind}_{step.replace('.', '')}"] = _bar_table(readings, step, plastic)
    for step in RING_STEPS:
        values[f"ring_{step.replace('.', '')}"] = _ring_table(readings, step)
    values["other_rings"] = _other_rings(m)
    values["elastic_force"] = f"{BAR.force / 1e3:.2f}"
    values["plastic_force"] = f"{PLASTIC_BAR.force / 1e3:.2f}"
    values["bar_duration"] = f"{BAR.duration * 1e6:.2f}"
    text = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(values)
    file.write_text(text, encoding="utf-8")
    return verdicts


def _summary(verdicts: dict[str, Counter]) -> str:
    order = (REPRODUCED, PARTLY, NOT, FITTED, OPEN)
    rows = [[name, *(str(counts[verdict]) for verdict in order)] for name, counts in verdicts.items()]
    return markdown(["reading", *order], rows)


def _lines(readings: list[Measures]) -> list[tuple[str, Measures, str]]:
    """Label, measures and scheme of the lines of a table: explicit schemes once, implicit ones with each mass."""
    lines = []
    for scheme in IN_TABLES:
        for measures in readings:
            mass = measures.reading.mass(scheme)
            if measures is readings[0] or mass != readings[0].reading.mass(scheme):
                lines.append((f"{SCHEMES[scheme].name}, {mass}", measures, scheme))
    return lines


def _claims_table(claims: list[list[Claim]], names: list[str]) -> str:
    rows = []
    for readings in zip(*claims, strict=True):
        first = readings[0]
        rows.append([first.where, first.statement, first.measured, *(f"**{claim.verdict}**" for claim in readings)])
    return markdown(["Where", "The paper", f"Measured here ({names[0]})", "Verdict", *names[1:]], rows)


def _phases_table(readings: list[Measures]) -> str:
    rows = [row for measures in readings for row in phase_rows(measures)]
    distinct = dict.fromkeys(map(tuple, rows))
    head = ["scheme", "mass", "variation beyond the jump", "F max", "contacts", "energy left", "not finished"]
    return markdown(head, distinct)


def impact_row(name: str, bar: RodImpact, exact: Rod) -> list[str]:
    """Cells of a line of the tables of rods and bars."""
    since = (bar.end - exact.impact) / exact.duration
    return [
        name,
        f"{since:.3f}",
        str(bar.releases),
        f"{bar.peak:.2f}",
        f"{bar.median:.3f}",
        f"{bar.undershoot:.2f}",
        f"{-bar.whole_rebound:.3f}",
        f"{bar.energy:.3f}",
    ]


_HEAD = ["scheme", "contact end", "contacts", "F max", "F median", "undershoot", "rebound", "energy left"]


def _rod_table(readings: list[Measures]) -> str:
    rows = []
    for name, m, scheme in _lines(readings):
        row, run = impact_row(name, m.rod[scheme], ROD), m.runs[rod_key(scheme, m.reading)]
        if run.failure:
            row[1], row[4], row[6:] = f"ended at t = {run.time[-1]:.2f}", "", ["", ""]
        rows.append(row)
    return markdown(_HEAD, [["exact", "1", "1", "1", "1", "0", "1", "1"], *rows])


def _bar_table(readings: list[Measures], step: str, plastic: bool) -> str:
    exact = PLASTIC_BAR if plastic else BAR
    rows = []
    for name, m, scheme in _lines(readings):
        if (scheme, step, plastic) in m.bars:
            rows.append(impact_row(name, m.bars[scheme, step, plastic], exact))
        else:
            reason = m.runs[bar_key(scheme, m.reading, step, plastic)].failure
            rows.append([name, "refused: " + _limit(reason), *[""] * 6])
    return markdown(_HEAD, rows)


def _limit(reason: str) -> str:
    """Of a refusal by the program, the part that gives the limit."""
    words = reason.split()
    (limit,) = [words[i + 1] for i, word in enumerate(words) if word == "beyond"]
    return f"unstable beyond Δt = {float(limit) * 1e6:.3f} µs"


def _ring_table(readings: list[Measures], step: str) -> str:
    rows = []
    for name, m, scheme in _lines(readings):
        ring, chaotic = m.ring[scheme, step], scheme in m.chaotic
        values = (ring.strain, ring.left, ring.dissipated, ring.kept)
        shown = [f"about {value:.1g}" if chaotic else f"{value:.3f}" for value in values]
        rows.append([name, phases_text(ring, chaotic), *shown])
    return markdown(["scheme", "contact [ms]", "largest strain", "plastic strain left", "plastic work", "energy"], rows)


def _other_rings(m: Measures) -> str:
    rows = []
    for ring, (outer, inner, *_) in OTHER_RINGS.items():
        for scheme in OTHER_SCHEMES:
            found, rough = m.other_ring[ring, scheme], scheme in m.chaotic
            name = f"{ring}, radii {outer:g} and {inner:g} m"
            strain = f"about {found.strain:.1g}" if rough else f"{found.strain:.3f}"
            rows.append([name, SCHEMES[scheme].name, phases_text(found, rough), strain])
    return markdown(["ring", "scheme", "contact [ms]", "largest strain"], rows)
