"""Section 5.1: a rod on a rigid wall."""

from __future__ import annotations

import numpy as np

from .claims import EXPLICIT, NOT, OPEN, PARTLY, ROUGH, SHORT, SMOOTH, Claim, Measures, listed, pick, verdict
from .exact import ROD
from .measures import REST, tip_velocity
from .schemes import PAPER, SCHEMES
from .studies import rod_key

SIMILAR = 0.1  # of the speed of arrival: undershoots that differ by less are alike
JUMP = 0.05  # of the speed of arrival: what is left of a jump after its decay
QUICK = 5  # steps within which a jump is over
CLEAR = 2.0  # times as much: clearly more


def rod_claims(m: Measures) -> list[Claim]:
    """Judge the statements of section 5.1."""
    rod = m.rod
    excess = pick(rod, PAPER, "excess")
    rest = pick(rod, PAPER, "rest_steps")
    held = pick(rod, PAPER, "held")  # NaN for runs that end before
    undershoot = pick(rod, PAPER, "undershoot")
    peak, rough = pick(rod, PAPER, "peak"), pick(rod, PAPER, "roughness")
    rms = pick(rod, PAPER, "rebound_rms")
    return [
        Claim(
            "5.1, Fig. 3",
            "The impact causes a jump of the velocity of the node that hits.",
            f"From v₀ to rest (below 1 % of v₀) in {listed(rest, 'd')} steps; at most "
            f"{np.nanmax([*held.values()]):.0e} v₀ afterwards.",
            verdict(value < JUMP for value in held.values()),
        ),
        _explicit_calmer(excess),
        Claim(
            "5.1, Fig. 3",
            "Houbolt's velocities are strongly perturbed near the impact, as a consequence of being multistep.",
            f"Variation beyond the jump {excess['houbolt']:.2f} v₀, where the schemes that the paper recommends have "
            f"at most {max(excess[s] for s in SMOOTH):.2f}; undershoot {undershoot['houbolt']:.2f} v₀, "
            f"{rod['houbolt'].releases} contacts.",
            verdict([excess["houbolt"] > CLEAR * max(excess[s] for s in SMOOTH), rod["houbolt"].releases > 1]),
        ),
        Claim(
            "5.1, Fig. 3",
            "Chung & Lee and Newmark behave alike: a short jump, then the analytical response.",
            f"Undershoot {undershoot['chung_lee']:.2f} and {undershoot['newmark']:.2f} v₀, over in {rest['chung_lee']} "
            f"and {rest['newmark']} steps.",
            verdict(
                [
                    abs(undershoot["chung_lee"] - undershoot["newmark"]) < SIMILAR,
                    max(rest["chung_lee"], rest["newmark"]) <= QUICK,
                ]
            ),
        ),
        Claim(
            "5.1, Fig. 3",
            "Moura & Souza's method oscillates less, but takes longer than Newmark's to calm down.",
            "The source of their scheme was not found. The stand-in was chosen because it does this (undershoot "
            f"{undershoot['souza_moura']:.2f} v₀ and {rest['souza_moura']} steps, Newmark "
            f"{undershoot['newmark']:.2f} v₀ and {rest['newmark']}), so its agreement proves nothing.",
            OPEN,
        ),
        _wilson_worst(m),
        _second_segment(m),
        *(_third_segment(rms, scheme) for scheme in ROUGH),
        Claim(
            "5.1, Fig. 4",
            "Very high spurious oscillations of the contact force with Houbolt and Wilson.",
            f"Largest force over the exact one: {listed(peak)}; standard deviation in contact: {listed(rough)}. The "
            "first peak of the others is that of the tip's own mass, ℓ/(2ch) = 2.5, which every scheme has that "
            "stops it in a step.",
            verdict(rough[s] > CLEAR * max(v for o, v in rough.items() if o not in ROUGH) for s in ROUGH),
        ),
        Claim(
            "5.1, Figs. 3, 4",
            "Explicit methods and Newmark's are more convenient for impact.",
            f"Contacts, where one is right: {listed(pick(rod, PAPER, 'releases'), 'd')}. "
            f"The price of Newmark's: energy left {listed(pick(rod, PAPER, 'energy'), '.3f')} of the initial.",
            verdict(
                [
                    *(rod[s].releases == 1 for s in (*SMOOTH, "souza_moura")),
                    *(rod[s].releases > 1 for s in ROUGH),
                ]
            ),
        ),
        _mean_velocity(m),
    ]


def phase_rows(m: Measures) -> list[list[str]]:
    """Rows of the table of the study of phases: range of the measures over the phases."""
    rows = []
    for scheme, phases in m.phases.items():
        ended = [rod for rod in phases if rod is not None]
        row = [SCHEMES[scheme].name, m.reading.mass(scheme)]
        for name, form in (("excess", ".2f"), ("peak", ".2f"), ("releases", "d"), ("energy", ".3f")):
            values = [getattr(rod, name) for rod in ended]
            row.append(f"{min(values):{form}} – {max(values):{form}}" if values else "")
        rows.append([*row, str(len(phases) - len(ended))])
    return rows


def _explicit_calmer(excess: dict[str, float]) -> Claim:
    implicit = min(value for scheme, value in excess.items() if scheme not in EXPLICIT)
    return Claim(
        "5.1, Fig. 3",
        "Explicit algorithms, central differences above all, oscillate much less on impact than implicit ones.",
        f"Variation of the tip's velocity beyond the jump, in the first 20 steps: {listed(excess)} v₀. True of central "
        "differences, which go to rest without any overshoot; Chung & Lee's velocity formula is Newmark's (exactly "
        "so at β = 1), and overshoots as much.",
        verdict(excess[scheme] < implicit / CLEAR for scheme in EXPLICIT),
    )


def _wilson_worst(m: Measures) -> Claim:
    wilson, houbolt = m.rod["wilson"], m.rod["houbolt"]
    run = m.runs[rod_key("wilson", m.reading)]
    worst = wilson.excess > houbolt.excess and wilson.peak > houbolt.peak
    decays = not run.failure and wilson.held < REST
    late = (
        f"at most {wilson.held:.1e} v₀ between 30 % and 90 % of the exact contact"
        if not run.failure
        else f"it does not calm down: at t = {run.time[-1]:.2f} a bar is driven through zero length"
    )
    return Claim(
        "5.1, Fig. 3",
        "Wilson-θ performs worst; small oscillations around the analytical response decrease with time.",
        f"θ = 1.4: variation {wilson.excess:.1f} against Houbolt's {houbolt.excess:.1f} v₀, force up to "
        f"{wilson.peak:.1f} against {houbolt.peak:.1f} times the exact one, {wilson.releases} contacts; {late}.",
        verdict([worst, decays]),
    )


def _second_segment(m: Measures) -> Claim:
    held = {scheme: m.rod[scheme].held for scheme in PAPER}
    others = [value for scheme, value in held.items() if scheme != "wilson"]
    wilson = "ended before" if np.isnan(held["wilson"]) else f"{held['wilson']:.0e} v₀"
    return Claim(
        "5.1, Fig. 3",
        "Except for Wilson, all results coincide in the second segment (contact).",
        f"Speed of the tip between 30 % and 90 % of the exact contact: at most {max(others):.0e} v₀; Wilson: {wilson}.",
        verdict(value < REST for value in others),
    )


def _third_segment(rms: dict[str, float], scheme: str) -> Claim:
    smooth = {other: value for other, value in rms.items() if other not in ROUGH}
    name = SHORT[scheme]
    if np.isnan(rms[scheme]):
        judged, text = NOT, f"{name} does not get there: a bar is driven through zero length during contact."
    else:
        judged = verdict(rms[scheme] < value for value in smooth.values())
        text = (
            "Root mean square distance of the tip's velocity from the exact one after the rebound: "
            f"{listed({scheme: rms[scheme], **smooth}, '.3f')} v₀. Newmark's numerical damping removes the vibration "
            "together with the energy."
        )
    return Claim("5.1, Fig. 3", f"{name} is better in the third segment, after the rebound.", text, judged)


def _mean_velocity(m: Measures) -> Claim:
    """The momentum of the rod against both readings of the analytical curve."""
    run = m.runs[rod_key("central_differences", m.reading)]
    mean = run.history["momentum"][:, 0] / run.history["momentum"][0, 0] * ROD.speed
    linear = float(np.abs(mean - ROD.mean_velocity(run.time)).max() / ROD.speed)
    quarter = float(np.interp(ROD.impact + 0.25 * ROD.duration, run.time, mean) / ROD.speed)
    tip = float(np.interp(ROD.impact + 0.25 * ROD.duration, run.time, tip_velocity(run)) / ROD.speed)
    return Claim(
        "5.1",
        "The analytical solution is the average velocity of the body, not that of the free edge.",
        "The exact solution of the wave equation gives the edge the velocities v₀, 0, −v₀, which is the curve that is "
        "drawn; the body's mean velocity is the same before and after contact, but falls linearly during it "
        f"(measured: within {linear:.1%} of v₀ of that line; a quarter into contact the mean is {quarter:.2f} v₀, "
        f"the edge {tip:.2f} v₀).",
        PARTLY if abs(quarter - 0.5) < 0.05 and abs(tip) < REST else NOT,
    )
