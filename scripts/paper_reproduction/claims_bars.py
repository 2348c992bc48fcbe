"""Section 5.2: two bars collide, elastic and elastoplastic."""

from __future__ import annotations

from .claims import EXPLICIT, PARTLY, REPRODUCED, ROUGH, SHORT, SMOOTH, Claim, Measures, listed, pick, verdict
from .exact import BAR, PLASTIC_BAR
from .measures import REST, RodImpact
from .schemes import PAPER
from .studies import BAR_ELEMENTS, BAR_STEPS

AROUND = 0.05  # of 5.13 m/s: means within this oscillate around it
CLEAR = 2.0  # times as much: clearly more
SAME = 0.02  # of the exact force: medians within this are practically identical; contact times within twice as much


def _panel(m: Measures, step: str, plastic: bool) -> dict[str, RodImpact]:
    return {scheme: m.bars[scheme, step, plastic] for scheme in PAPER}


def _both(m: Measures, name: str, plastic: bool, form: str = ".2f", unit: str = "") -> str:
    """A measure of all schemes at both steps."""
    return "; ".join(
        f"Δt = {step} µs: {listed(pick(_panel(m, step, plastic), PAPER, name), form, unit)}" for step in BAR_STEPS
    )


def bar_claims(m: Measures) -> list[Claim]:
    """Judge the statements of section 5.2."""
    return [
        _around(m),
        _vibration(m),
        _jump(m),
        _explicit_calmer(m),
        _closer(m),
        _newmark_like_explicit(m),
        _plastic_perturbs(m),
        _plastic_longer(m),
        _opposite(m),
        _forces(m),
        _plastic_smaller(m),
    ]


def _around(m: Measures) -> Claim:
    means = {key: bar.mean_rebound * BAR.speed for key, bar in m.bars.items() if key[0] in PAPER}
    elastic = {key: value for key, value in means.items() if not key[2]}
    near = [abs(value / 5.13 + 1.0) < AROUND for value in elastic.values()]
    small = {scheme: -elastic[scheme, "0.5", False] for scheme in PAPER}
    large = {scheme: -elastic[scheme, "2", False] for scheme in PAPER}
    plastic = [-value for key, value in means.items() if key[2]]
    return Claim(
        "5.2, Figs. 7, 8",
        "After the separation the velocity of the impact point oscillates around 5.13 m/s.",
        f"Elastic (Fig. 7), mean of the tip's velocity: Δt = 0.5 µs: {listed(small)} m/s; Δt = 2 µs: {listed(large)} "
        f"m/s; Newmark's is low because of numerical damping. Elastoplastic (Fig. 8): {min(plastic):.2f} to "
        f"{max(plastic):.2f} m/s, since the plastic work is lost.",
        verdict([*near, min(plastic) > 4.9]),
    )


def _vibration(m: Measures) -> Claim:
    spread = [m.refined_bar[False, n].rebound_std for n in BAR_ELEMENTS]
    falls = spread == sorted(spread, reverse=True)
    text = ", ".join(f"{value:.3f} v₀ with {n} bars" for n, value in zip(BAR_ELEMENTS, spread))
    return Claim(
        "5.2, Figs. 7, 8",
        "This is the bar's vibration after the impact, which the simplified analytical solution does not represent.",
        f"There is a vibration, but it is a property of the mesh: its standard deviation is {text}. The exact elastic "
        "bar leaves the wall stress-free, so the analytical solution is complete.",
        PARTLY if falls else REPRODUCED,
    )


def _jump(m: Measures) -> Claim:
    held = [bar.held for key, bar in m.bars.items() if key[0] in PAPER and not key[2]]
    return Claim(
        "5.2, Figs. 7, 8",
        "The impact causes a velocity jump at the contact node.",
        f"Steps to rest, elastic: {_both(m, 'rest_steps', False, 'd')}. In mid contact at most {max(held):.0e} v₀.",
        verdict(value < REST for value in held),
    )


def _explicit_calmer(m: Measures) -> Claim:
    parts = []
    for step in BAR_STEPS:
        excess = pick(_panel(m, step, False), PAPER, "excess")
        implicit = min(value for scheme, value in excess.items() if scheme not in EXPLICIT)
        parts.append(max(excess[scheme] for scheme in EXPLICIT) < implicit)
        parts.append(excess["central_differences"] < 0.1 * implicit)
    return Claim(
        "5.2, Figs. 7, 8",
        "Explicit algorithms, central differences above all, eliminate the oscillations at impact of the implicit "
        "ones.",
        f"Variation of the tip's velocity beyond the jump [v₀], elastic: {_both(m, 'excess', False)}. Central "
        "differences eliminate them; Chung & Lee's overshoot is about Newmark's.",
        verdict(parts),
    )


def _closer(m: Measures) -> Claim:
    """Both steps, at the impact and after the rebound: four parts."""
    parts, texts = [], []
    for step in BAR_STEPS:
        panel = _panel(m, step, False)
        for name in ("excess", "rebound_rms"):
            measured = pick(panel, PAPER, name)
            implicit = min(value for scheme, value in measured.items() if scheme not in EXPLICIT)
            parts.append(max(measured[scheme] for scheme in EXPLICIT) < implicit)
            if name == "rebound_rms":
                texts.append(f"Δt = {step} µs: {listed(measured)}")
    return Claim(
        "5.2, Figs. 7, 8",
        "Their results are therefore closer to the analytical response than those of the implicit algorithms.",
        "At the impact see the line above. After the rebound, root mean square distance of the tip's velocity from the "
        f"exact one [v₀], elastic: {'; '.join(texts)}. The vibration that explicit schemes leave in the bar counts "
        "against them there; the numerical damping of implicit schemes removes it, together with energy.",
        verdict(parts),
    )


def _newmark_like_explicit(m: Measures) -> Claim:
    parts = []
    for step in BAR_STEPS:
        panel = _panel(m, step, False)
        newmark = panel["newmark"]
        parts += [abs(newmark.excess - panel[scheme].excess) < 0.2 for scheme in EXPLICIT]
        parts.append(min(panel[s].excess for s in ROUGH) > 1.3 * newmark.excess)
        parts.append(min(panel[s].rebound_std for s in ROUGH) > CLEAR * max(panel[s].rebound_std for s in SMOOTH))
    return Claim(
        "5.2, Figs. 7, 8",
        "Newmark behaves like the explicit methods; Houbolt and Wilson have spurious oscillations, above all after the "
        "rebound.",
        "At the impact (numbers above) Newmark overshoots like Chung & Lee, and not like central differences, which do "
        "not overshoot; Houbolt overshoots more at both steps, Wilson at Δt = 2 µs. After the rebound Houbolt and "
        f"Wilson are no rougher: standard deviation of the tip's velocity [v₀]: {_both(m, 'rebound_std', False)}.",
        verdict(parts),
    )


def _plastic_perturbs(m: Measures) -> Claim:
    def longer(scheme: str) -> int:
        return max(m.bars[scheme, s, True].rest_steps - m.bars[scheme, s, False].rest_steps for s in BAR_STEPS)

    text = "; ".join(
        f"{SHORT[scheme]} "
        + ", ".join(
            f"{m.bars[scheme, s, False].rest_steps} → {m.bars[scheme, s, True].rest_steps} ({s} µs)" for s in BAR_STEPS
        )
        for scheme in PAPER
    )
    return Claim(
        "5.2, Figs. 7, 8",
        "With yielding, Houbolt and Wilson are strongly perturbed at the moment of impact.",
        f"Steps until the tip is at rest, elastic → elastoplastic: {text}. False releases and new impacts go on for "
        "longer, because the yielded end of the bar pushes back less.",
        verdict([*(longer(s) > 5 for s in ROUGH), max(longer(s) for s in PAPER if s not in ROUGH) <= 1]),
    )


def _plastic_longer(m: Measures) -> Claim:
    elastic, plastic = (m.bars["central_differences", "0.5", kind] for kind in (False, True))
    longer = [
        m.bars[s, step, True].duration > 1.2 * m.bars[s, step, False].duration for s in PAPER for step in BAR_STEPS
    ]
    return Claim(
        "5.2, Fig. 8",
        "By the loss of energy, the contact lasts longer than in the elastic case, and the velocity of return differs.",
        f"Contact {plastic.duration * 1e6:.1f} against {elastic.duration * 1e6:.1f} µs (central differences, 0.5 µs; "
        f"the same with all schemes); the centre of mass returns with {-plastic.whole_rebound:.2f} against "
        f"{-elastic.whole_rebound:.2f} v₀; {plastic.dissipated:.0%} of the energy becomes plastic work.",
        verdict([*longer, plastic.whole_rebound > elastic.whole_rebound]),
    )


def _opposite(m: Measures) -> Claim:
    plastic = [m.bars[s, step, True] for s in PAPER for step in BAR_STEPS]
    return Claim(
        "5.2, Fig. 8",
        "After the separation the bars move back, with oscillations of the velocity.",
        f"Mean tip velocity {min(b.mean_rebound for b in plastic):.2f} to {max(b.mean_rebound for b in plastic):.2f} "
        f"v₀, standard deviation {min(b.rebound_std for b in plastic):.2f} to "
        f"{max(b.rebound_std for b in plastic):.2f} v₀.",
        verdict(b.mean_rebound < -b.rebound_std < 0 for b in plastic),
    )


def _forces(m: Measures) -> Claim:
    """Identical forces and diverging ones, in four figures."""
    parts = []
    for plastic in (False, True):
        for step in BAR_STEPS:
            panel = _panel(m, step, plastic)
            medians, ends = ([getattr(panel[s], name) for s in SMOOTH] for name in ("median", "duration"))
            parts.append(max(medians) - min(medians) < SAME and max(ends) < (1.0 + 2.0 * SAME) * min(ends))
            rough = pick(panel, PAPER, "roughness")
            parts.append(min(rough[s] for s in ROUGH) > CLEAR * max(rough[s] for s in SMOOTH))
    return Claim(
        "5.2, Figs. 9, 10",
        "Newmark, central differences and Chung & Lee give practically identical contact forces; Houbolt and Wilson "
        "diverge from the analytical one.",
        "The first three: median force within "
        f"{_median_error(m):.1%} of the exact {BAR.force / 1e3:.1f} and {PLASTIC_BAR.force / 1e3:.2f} kN, contact "
        f"times within {_duration_spread(m):.1%} of each other. At Δt = 2 µs Newmark's force falls off early. Houbolt "
        "and Wilson: standard deviation of the force in contact, over the exact force, elastic: "
        f"{_both(m, 'roughness', False)}; elastoplastic: {_both(m, 'roughness', True)}. At Δt = 2 µs elastic Houbolt "
        "is no rougher than Newmark.",
        verdict(parts),
    )


def _median_error(m: Measures) -> float:
    return max(abs(bar.median - 1.0) for key, bar in m.bars.items() if key[0] in SMOOTH)


def _duration_spread(m: Measures) -> float:
    spreads = []
    for plastic in (False, True):
        for step in BAR_STEPS:
            ends = [_panel(m, step, plastic)[s].duration for s in SMOOTH]
            spreads.append(max(ends) / min(ends) - 1.0)
    return max(spreads)


def _plastic_smaller(m: Measures) -> Claim:
    elastic, plastic = (m.bars["central_differences", "0.5", kind] for kind in (False, True))
    ratio = plastic.median * PLASTIC_BAR.force / (elastic.median * BAR.force)
    return Claim(
        "5.2, Figs. 9, 10",
        "With the elastoplastic bar contact forces, acceleration levels and contact time are smaller.",
        f"Force {plastic.median * PLASTIC_BAR.force / 1e3:.1f} against {elastic.median * BAR.force / 1e3:.1f} kN "
        f"({ratio:.2f}), and with it the acceleration of the bar, F/m; but the contact is "
        f"{plastic.duration / elastic.duration:.2f} times as long, as the paper itself says of Fig. 8.",
        verdict([ratio < 1, plastic.duration < elastic.duration]),
    )
