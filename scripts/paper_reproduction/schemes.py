"""The integrators of the comparison: names, settings and line styles, and the readings of data missing in the paper."""

from __future__ import annotations

from typing import Any, NamedTuple


class Integrator(NamedTuple):
    """One line of the comparison.

    Attributes
    ----------
    name : label in figures and tables
    overrides : settings of the case that choose it
    colour, dash, width : of its curves; no colour where it is in tables only
    """

    name: str
    overrides: tuple[str, ...]
    colour: str = ""
    dash: str = "-"
    width: float = 1.3

    @property
    def style(self) -> dict[str, Any]:
        """Of its curves."""
        return {"color": self.colour, "linestyle": self.dash, "linewidth": self.width}


def _set(integrator: str, *parameters: str) -> tuple[str, ...]:
    return (f"time.integrator={integrator}", *(f"time.{parameter}" for parameter in parameters))


# In the order in which curves are drawn: the roughest first, so that the others stay visible.
SCHEMES: dict[str, Integrator] = {
    "wilson": Integrator("Wilson, θ = 1.4", _set("wilson", "theta=1.4"), "#e09f1f"),
    "houbolt": Integrator("Houbolt", _set("houbolt"), "#8a4fbf"),
    "souza_moura": Integrator("stand-in for Souza & Moura", _set("souza_moura"), "#3aa7c9"),
    "chung_lee": Integrator("Chung & Lee, β = 28/27", _set("chung_lee"), "#2a9d5c"),
    "newmark": Integrator("Newmark (Hu), β = 1, γ = 3/2", _set("newmark"), "#d9482b", "--"),
    "central_differences": Integrator("Central differences", _set("central_differences"), "#2563b0", ":", 1.6),
    # beyond the paper, or beyond what it can have used
    "wilson_1.6": Integrator("Wilson, θ = 1.6", _set("wilson", "theta=1.6")),
    "chung_lee_1": Integrator("Chung & Lee, β = 1", _set("chung_lee", "beta=1.0")),
    "hulbert_chung": Integrator("Hulbert & Chung, ρ_b = 0", _set("hulbert_chung", "rho_b=0.0")),
    "noh_bathe": Integrator("Noh & Bathe, p = 0.54", _set("noh_bathe")),
    "generalized_alpha": Integrator("Generalised-α, ρ∞ = 0.8", _set("generalized_alpha")),
    "hht_alpha": Integrator("HHT-α, α = −0.05", _set("hht_alpha")),
    "bathe": Integrator("Bathe, ρ∞ = 0", _set("bathe")),
    "energy_momentum": Integrator("Energy-momentum", _set("energy_momentum")),
}
PAPER = ("central_differences", "newmark", "chung_lee", "souza_moura", "houbolt", "wilson")
IN_TABLES = (*PAPER, *(scheme for scheme in SCHEMES if scheme not in PAPER))
EXPLICIT = ("central_differences", "chung_lee", "souza_moura", "chung_lee_1", "hulbert_chung", "noh_bathe")


class Reading(NamedTuple):
    """An assumption about the mass matrix, which the paper does not state for each scheme.

    Attributes
    ----------
    key : of its runs
    name : in tables
    consistent : whether the implicit schemes have consistent mass; the explicit ones have lumped mass in all readings
    """

    key: str
    name: str
    consistent: bool

    def mass(self, scheme: str) -> str:
        """Mass matrix of a scheme."""
        return "consistent" if self.consistent and scheme not in EXPLICIT else "lumped"

    def overrides(self, scheme: str) -> tuple[str, ...]:
        """Settings of the case that choose the mass matrix of a scheme."""
        return (f"time.mass={self.mass(scheme)}",)


LIKELY = Reading("likely", "consistent mass for implicit schemes", consistent=True)
LUMPED = Reading("lumped", "lumped mass throughout", consistent=False)
READINGS = (LIKELY, LUMPED)
