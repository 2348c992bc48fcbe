"""Section 5.3, a circular truss against a rigid wall, and section 6, the conclusions."""

from __future__ import annotations

import numpy as np

from .claims import FITTED, NOT, PARTLY, REPRODUCED, ROUGH, SHORT, SMOOTH, Claim, Measures, listed, pick, verdict
from .measures import RingImpact, spread
from .schemes import PAPER
from .studies import BAR_STEPS, OTHER_RINGS, REFINED, RING_STEPS, refined_key, ring_key

REFLECTION, SECOND = 0.035, 0.12  # what the paper reads off: end of the first contact, second impact [s]
NEAR = {REFLECTION: 0.001, SECOND: 0.005}  # [s]
IDENTICAL = 0.05  # of the range of a displacement: curves this near are practically identical
CLEAR = 3.0  # times as far: diverged
SMALL = 0.02  # of the energy: small damping


def phases_text(ring: RingImpact, chaotic: bool = False, most: int = 5) -> str:
    """Contact phases in milliseconds; of a chaotic run the first and the number of the others."""
    if chaotic:
        (start, end), more = ring.phases[0], len(ring.phases) - 1
        return f"{start * 1e3:.1f}–{end * 1e3:.1f}, then {'none' if more == 0 else 'one' if more == 1 else 'several'}"
    shown = ", ".join(f"{a * 1e3:.1f}–{b * 1e3:.1f}" for a, b in ring.phases[:most])
    return shown + (f", and {len(ring.phases) - most} more" if len(ring.phases) > most else "")


def _told(m: Measures, name: str, step: str, factor: float = 1.0, digits: int = 3) -> str:
    """A measure of all schemes; of chaotic ones with one digit."""
    parts = []
    for scheme in PAPER:
        value = getattr(m.ring[scheme, step], name) * factor
        parts.append(f"{SHORT[scheme]} " + (f"about {value:.1g}" if scheme in m.chaotic else f"{value:.{digits}f}"))
    return ", ".join(parts)


def _distances(m: Measures, step: str, probe: str) -> dict[str, float]:
    """Of each scheme's displacement of a node from that by central differences [m]."""
    reference = m.runs[ring_key("central_differences", m.reading, step)]
    return {
        s: spread(m.runs[ring_key(s, m.reading, step)], reference, probe) for s in PAPER if s != "central_differences"
    }


def ring_claims(m: Measures) -> list[Claim]:
    """Judge the statements of section 5.3."""
    far = {step: _distances(m, step, "impact") for step in RING_STEPS}
    return [
        _converge(far),
        _diverge(far),
        _identical(m, far),
        _chung_lee(m),
        _reflection(m),
        *(_once(m, scheme) for scheme in ROUGH),
        _compared(
            m,
            "strain",
            "strains are larger",
            "Largest strain: {}. A false release throws the struck node back, and its bars are strained by more than "
            "the wall would.",
            larger=True,
        ),
        _compared(
            m,
            "dissipated",
            "more energy is stored and dissipated",
            "Plastic work over the initial energy: {}.",
            larger=True,
        ),
        _compared(
            m,
            "touching",
            "the contact is shorter",
            "Time in contact [ms]: {}. Which contact is meant (the first, or the sum), the paper does not say.",
            larger=False,
            factor=1e3,
            digits=1,
        ),
        _permanent(m),
    ]


def _converge(far: dict[str, dict[str, float]]) -> Claim:
    # a motion that false releases make chaotic may be somewhat nearer by chance
    nearer = {s: far["0.05"][s] < 0.5 * far["0.5"][s] or far["0.05"][s] < 1e-3 for s in far["0.5"]}
    return Claim(
        "5.3, Figs. 12, 13",
        "The results of the methods tend to converge for the smaller step.",
        "Root mean square distance of node 1's displacement from that by central differences: Δt = 0.5 ms: "
        f"{listed(far['0.5'], '.2g')} m; 0.05 ms: {listed(far['0.05'], '.2g')} m.",
        verdict(nearer.values()),
    )


def _diverge(far: dict[str, dict[str, float]]) -> Claim:
    clear = [min(d[s] for s in ROUGH) > CLEAR * max(d[s] for s in d if s not in ROUGH) for d in far.values()]
    text = "; ".join(
        f"Δt = {step} ms: {min(d[s] for s in ROUGH) / max(d[s] for s in d if s not in ROUGH):.1f}"
        for step, d in far.items()
    )
    return Claim(
        "5.3, Figs. 12, 13",
        "Houbolt and Wilson diverge from the other methods.",
        "The nearer of the two is farther from central differences than the farthest of the others by a factor of: "
        f"{text}.",
        verdict(clear),
    )


def _identical(m: Measures, far: dict[str, dict[str, float]]) -> Claim:
    parts, same = [], []
    for step in RING_STEPS:
        x = m.runs[ring_key("central_differences", m.reading, step)].history["probe/impact/position"][:, 0, 0]
        share = far[step]["newmark"] / float(np.ptp(x))
        two = _distances(m, step, "opposite")["newmark"]
        same.append(share < IDENTICAL)
        parts.append(
            f"Δt = {step} ms: contact {phases_text(m.ring['central_differences', step])} and "
            f"{phases_text(m.ring['newmark', step])} ms; distance {far[step]['newmark']:.4f} m of node 1 "
            f"({share:.0%} of its range), {two:.4f} m of node 2"
        )
    return Claim(
        "5.3, Figs. 12, 13",
        "At both steps central differences and Newmark are practically identical.",
        "; ".join(parts)
        + ". Node 2 is not affected in the time shown, so the agreement of all schemes on it is not significant.",
        verdict(same),
    )


def _chung_lee(m: Measures) -> Claim:
    lost = {step: m.ring["chung_lee_1", step].kept - m.ring["chung_lee", step].kept for step in RING_STEPS}
    text = ", ".join(f"{value:.2%} (Δt = {step} ms)" for step, value in lost.items())
    damped, free = (m.bars[scheme, "2", False].energy for scheme in ("chung_lee", "chung_lee_1"))
    return Claim(
        "5.3, Figs. 12, 13",
        "Chung & Lee has small numerical damping controlled by a free parameter.",
        f"β = 28/27 against the undamped β = 1: {text} more of the initial energy is lost in 0.2 s; in the elastic "
        f"bars of 5.2 at Δt = 2 µs, {damped:.3f} of it is left against {free:.3f}. Numerical damping ratio (β − "
        "1)Ω³/2.",
        verdict([*(abs(value) < SMALL for value in lost.values()), lost["0.5"] > 0]),
    )


def _reflection(m: Measures) -> Claim:
    good = []
    for scheme in (*SMOOTH, "souza_moura"):
        for step in RING_STEPS:
            phases = m.ring[scheme, step].phases
            good.append(
                len(phases) > 1
                and abs(phases[0][1] - REFLECTION) <= NEAR[REFLECTION]
                and abs(phases[1][0] - SECOND) <= NEAR[SECOND]
            )
    text = "; ".join(f"{SHORT[s]} {phases_text(m.ring[s, '0.05'])}" for s in (*SMOOTH, "souza_moura"))
    return Claim(
        "5.3",
        "Explicit methods and Newmark: reflection at 0.035 s, second impact near 0.12 s.",
        f"Contact, Δt = 0.05 ms [ms]: {text}. The geometry was chosen because it does this, so it proves nothing "
        "about the paper; the agreement of all these schemes and both steps was a criterion of the choice.",
        FITTED if all(good) else PARTLY if any(good) else NOT,
    )


def _once(m: Measures, scheme: str) -> Claim:
    text = "; ".join(
        f"{phases_text(m.ring[scheme, step], scheme in m.chaotic)} (Δt = {step} ms)" for step in RING_STEPS
    )
    counts = [len(m.ring[scheme, step].phases) for step in RING_STEPS]
    others = [len(m.other_ring[ring, scheme].phases) for ring in OTHER_RINGS]
    chaotic = (
        " The motion is chaotic: a speed that differs in the tenth digit gives other contacts."
        if scheme in m.chaotic
        else ""
    )
    return Claim(
        "5.3",
        f"{SHORT[scheme]} impacts only once.",
        f"Contact [ms]: {text}.{chaotic} In three other geometries there are {min(others)} to {max(others)} contacts.",
        verdict(count == 1 for count in counts),
    )


def _compared(
    m: Measures, name: str, statement: str, text: str, *, larger: bool, factor: float = 1.0, digits: int = 3
) -> Claim:
    """A measure that is to be larger, or smaller, with every explicit method and Newmark than with the other two.

    ``text`` has a place for the measured values.
    """
    sign = 1.0 if larger else -1.0
    holds = []
    for step in RING_STEPS:
        smooth = [sign * getattr(m.ring[s, step], name) for s in PAPER if s not in ROUGH]
        rough = [sign * getattr(m.ring[s, step], name) for s in ROUGH]
        holds.append(min(smooth) > max(rough))
    values = "; ".join(f"Δt = {step} ms: {_told(m, name, step, factor, digits)}" for step in RING_STEPS)
    return Claim("5.3", f"With explicit methods and Newmark {statement}.", text.format(values), verdict(holds))


def _permanent(m: Measures) -> Claim:
    ring = m.ring["central_differences", "0.05"]
    return Claim(
        "5.3, Fig. 14",
        "By permanent deformation the structure does not return to its initial configuration.",
        f"At 0.2 s: plastic strain up to {ring.left:.3f} ({ring.plastic_strain:.2f} on the way), the ring "
        f"{ring.shortened:.2f} m shorter along its flight, {ring.dissipated:.0%} of the energy in plastic work.",
        verdict([ring.left > 0.01, ring.dissipated > 0.01]),
    )


def conclusion_claims(m: Measures) -> list[Claim]:
    """Judge the statements of section 6."""
    errors = [abs(bar.median - 1.0) for (scheme, _, _), bar in m.bars.items() if scheme in (*SMOOTH, "souza_moura")]
    late = [
        abs(bar.duration / 98.9e-6 - 1.0)
        for (scheme, _, plastic), bar in m.bars.items()
        if scheme in (*SMOOTH, "souza_moura") and not plastic
    ]
    return [
        Claim(
            "6",
            "Results are satisfactory for most of the algorithms.",
            f"Median contact force within {max(errors):.1%}, elastic duration within {max(late):.1%} of the exact "
            "ones with the four methods that the paper recommends, at both steps.",
            verdict([max(errors) < 0.03, max(late) < 0.05]),
        ),
        _consistency(m),
        Claim(
            "6",
            "Chung & Lee, Souza & Moura, Newmark and central differences are highly recommended for impact; Houbolt "
            "and Wilson are unsatisfactory.",
            f"False releases in the rod's contact: {listed(pick(m.rod, PAPER, 'releases'), 'd')} contacts where one is "
            f"right; force roughness {listed(pick(m.rod, PAPER, 'roughness'))}. Two reservations: Newmark with γ = "
            "3/2 is first order, loses much energy, and stops rotation; Souza & Moura's scheme cannot be judged.",
            PARTLY if max(m.rod[s].releases for s in SMOOTH) == 1 < min(m.rod[s].releases for s in ROUGH) else NOT,
        ),
        _small_steps(m),
        _efficiency(m),
    ]


def _consistency(m: Measures) -> Claim:
    rows, falls = [], []
    for scheme in PAPER:
        rods = [m.refined_rod[scheme, n] for n in REFINED]
        failures = [n for n in REFINED if m.runs[refined_key("rod", scheme, m.reading, n)].failure]
        if failures:
            falls.append(False)
            rows.append(
                f"{SHORT[scheme]}: a bar is driven through zero length with {', '.join(map(str, failures))} bars"
            )
            continue
        energy = [1.0 - rod.energy for rod in rods]
        late = [abs(rod.duration / 2.0 - 1.0) for rod in rods]
        falls.append(energy[-1] < energy[0] and min(energy) > -1e-3 and late[-1] < 0.01)
        rows.append(
            f"{SHORT[scheme]}: energy lost {energy[0]:.1%} → {energy[-1]:.2%}, duration off by {late[0]:.1%} → "
            f"{late[-1]:.1%}, rebound {-rods[0].whole_rebound:.3f} → {-rods[-1].whole_rebound:.3f} v₀"
        )
    return Claim(
        "6",
        "The algorithms have appropriate characteristics of consistency, convergence and stability.",
        f"Rod, {REFINED[0]} → {REFINED[-1]} bars with the step in proportion: {'; '.join(rows)}.",
        verdict(falls),
    )


def _small_steps(m: Measures) -> Claim:
    energy = {step: {s: m.bars[s, step, False].energy for s in PAPER} for step in BAR_STEPS}
    less = [s for s in PAPER if energy["2"][s] < energy["0.5"][s] - 0.02]
    return Claim(
        "6",
        "A small Δt is needed in some cases, against numerical damping that can result in phase error.",
        f"Elastic bars, energy left: Δt = 0.5 µs: {listed(energy['0.5'], '.3f')}; Δt = 2 µs: "
        f"{listed(energy['2'], '.3f')}. Newmark's period error is Ω²/3 (12 % at ten steps a period), with a damping "
        "ratio of Ω/2.",
        REPRODUCED if "newmark" in less else NOT,
    )


def _efficiency(m: Measures) -> Claim:
    """Cost as the number of linear systems, which depends neither on the machine nor on the size of these examples."""
    systems = {}
    for step in RING_STEPS:
        for scheme in PAPER:
            run = m.runs[ring_key(scheme, m.reading, step)]
            systems[scheme, step] = float(run.history["newton_iterations"].sum() / (len(run.time) - 1))
    implicit = [s for s in PAPER if max(systems[s, step] for step in RING_STEPS) > 0.0]
    text = "; ".join(
        f"Δt = {step} ms: " + ", ".join(f"{SHORT[s]} {systems[s, step]:.1f}" for s in implicit) for step in RING_STEPS
    )
    errors = pick(m.rod, PAPER, "excess")
    return Claim(
        "Abstract",
        "The algorithms are distinguished by the accuracy and efficiency of the solution, which numerical simulations "
        "evaluate.",
        "Accuracy differs, see above. The paper states no cost. Here a step of an explicit scheme is one evaluation of "
        "the forces, and a step of an implicit one in example 5.3 is this many linear systems with their Hessians: "
        f"{text}. The paper's steps are below the explicit limit, where this cost buys nothing; larger steps would be "
        "the reason for implicit schemes, and the paper does not use them.",
        verdict(
            [
                max(errors.values()) > CLEAR * min(errors.values()),
                min(systems[s, step] for s in implicit for step in RING_STEPS) > 1.0,
            ]
        ),
    )
