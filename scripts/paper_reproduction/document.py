"""Write docs/paper.md: the template, with tables of measured numbers and judged statements."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from string import Template

from .claims import Claim, Measures
from .claims_bars import bar_claims
from .claims_ring import conclusion_claims, phases_text, ring_claims
from .claims_rod import rod_claims
from .exact import BAR, PLASTIC_BAR, ROD, Rod
from .measures import RodImpact
from .schemes import IN_TABLES, SCHEMES
from .studies import BAR_STEPS, OTHER_RINGS, OTHER_SCHEMES, RING_STEPS, bar_key, rod_key

__all__ = ["all_claims", "impact_row", "write_document"]

TEMPLATE = Path(__file__).with_name("paper.md")


def all_claims(m: Measures) -> dict[str, list[Claim]]:
    """Judged statements by section of the paper."""
    return {
        "rod_claims": rod_claims(m),
        "bar_claims": bar_claims(m),
        "ring_claims": ring_claims(m),
        "conclusion_claims": conclusion_claims(m),
    }


def write_document(m: Measures, file: Path) -> Counter:
    """Write the document; gives how many statements have which verdict."""
    claims = all_claims(m)
    verdicts = Counter(claim.verdict for section in claims.values() for claim in section)
    count = sum(verdicts.values())
    values = {section: _claims_table(found) for section, found in claims.items()}
    values["summary"] = f"Of {count} statements: " + ", ".join(
        f"{n} {verdict}" for verdict, n in verdicts.most_common()
    )
    values["rod_table"] = _rod_table(m)
    for plastic in (False, True):
        for step in BAR_STEPS:
            kind = "plastic" if plastic else "elastic"
            values[f"{kind}_{step.replace('.', '')}"] = _bar_table(m, step, plastic)
    for step in RING_STEPS:
        values[f"ring_{step.replace('.', '')}"] = _ring_table(m, step)
    values["other_rings"] = _other_rings(m)
    values["elastic_force"] = f"{BAR.force / 1e3:.2f}"
    values["plastic_force"] = f"{PLASTIC_BAR.force / 1e3:.2f}"
    values["bar_duration"] = f"{BAR.duration * 1e6:.2f}"
    text = Template(TEMPLATE.read_text(encoding="utf-8")).substitute(values)
    file.write_text(text, encoding="utf-8")
    return verdicts


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _claims_table(claims: list[Claim]) -> str:
    rows = [[c.where, c.statement, c.measured, f"**{c.verdict}**"] for c in claims]
    return _table(["Where", "The paper", "Measured here", "Verdict"], rows)


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


def _rod_table(m: Measures) -> str:
    rows = []
    for scheme in IN_TABLES:
        row, run = impact_row(SCHEMES[scheme].name, m.rod[scheme], ROD), m.runs[rod_key(scheme)]
        if run.failure:
            row[1], row[4], row[6:] = f"ended at t = {run.time[-1]:.2f}", "", ["", ""]
        rows.append(row)
    return _table(_HEAD, [["exact", "1", "1", "1", "1", "0", "1", "1"], *rows])


def _bar_table(m: Measures, step: str, plastic: bool) -> str:
    exact = PLASTIC_BAR if plastic else BAR
    rows = []
    for scheme in IN_TABLES:
        entry = SCHEMES[scheme]
        if (scheme, step, plastic) in m.bars:
            rows.append(impact_row(entry.name, m.bars[scheme, step, plastic], exact))
        else:
            reason = m.runs[bar_key(scheme, step, plastic)].failure
            rows.append([entry.name, "refused: " + _limit(reason), *[""] * 6])
    return _table(_HEAD, rows)


def _limit(reason: str) -> str:
    """Of a refusal by the program, the part that gives the limit."""
    words = reason.split()
    (limit,) = [words[i + 1] for i, word in enumerate(words) if word == "beyond"]
    return f"unstable beyond Δt = {float(limit) * 1e6:.3f} µs"


def _ring_table(m: Measures, step: str) -> str:
    rows = []
    for scheme in IN_TABLES:
        entry, ring = SCHEMES[scheme], m.ring[scheme, step]
        rows.append(
            [
                entry.name,
                phases_text(ring),
                f"{ring.strain:.3f}",
                f"{ring.left:.3f}",
                f"{ring.dissipated:.3f}",
                f"{ring.kept:.3f}",
            ]
        )
    return _table(["scheme", "contact [ms]", "largest strain", "plastic strain left", "plastic work", "energy"], rows)


def _other_rings(m: Measures) -> str:
    rows = []
    for ring, (outer, inner, *_) in OTHER_RINGS.items():
        for scheme in OTHER_SCHEMES:
            found = m.other_ring[ring, scheme]
            name = f"{ring}, radii {outer:g} and {inner:g} m"
            rows.append([name, SCHEMES[scheme].name, phases_text(found), f"{found.strain:.3f}", f"{found.kept:.3f}"])
    return _table(["ring", "scheme", "contact [ms]", "largest strain", "energy"], rows)
