"""Material laws with nonlinear hardening, rates and softening for random cases."""

from __future__ import annotations

import random
from typing import Any

__all__ = ["draw_laws"]

LAWS = ("voce", "ludwik", "ramberg_osgood", "multilinear", "cowper_symonds", "perzyna", "johnson_cook")
HARDENING = ("isotropic_hardening", "kinematic_hardening")


def draw_laws(chance: random.Random, case: dict[str, Any], end: float) -> None:
    """Change the law of a material or let it soften, drawn on its own so that other cases stay as they are."""
    if chance.random() > 0.12:
        return
    table = case["material"][chance.choice(sorted(case["material"]))]
    if "law" in table:  # drawn elsewhere
        return
    if "temperature" not in case and chance.random() < 0.3:
        case["temperature"] = [{"table": [[0.0, 0.0], [end * chance.uniform(0.1, 1.0), chance.uniform(-60.0, 60.0)]]}]
    softens = "temperature" in case and chance.random() < 0.7
    if not softens or chance.random() < 0.5:
        name = chance.choice(LAWS)
        yields = table.pop("yield_stress", None) or table["young_modulus"] * 10 ** chance.uniform(-3, -1.7)
        for key in HARDENING:
            table.pop(key, None)
        table |= {"law": name, **_keys(chance, name, table, yields)}
        softens = softens and name != "johnson_cook"
    yields = table.get("law") or "yield_stress" in table
    if softens and not (yields and case["time"]["integrator"] == "energy_momentum"):
        rows = sorted(chance.uniform(-60.0, 60.0) for _ in range(chance.randint(1, 4)))
        table["softening"] = [[row, chance.uniform(0.3, 1.0), chance.uniform(0.3, 1.1)] for row in rows]


def _keys(chance: random.Random, name: str, table: dict[str, Any], yields: float) -> dict[str, Any]:
    young = table["young_modulus"]
    power = {"strength_coefficient": yields * chance.uniform(0.5, 5.0), "hardening_exponent": chance.uniform(0.05, 1.0)}
    if name == "ramberg_osgood":
        return {"proof_stress": yields, "exponent": chance.uniform(1.0, 20.0)}
    if name == "multilinear":
        rows, stress, plastic = [[yields / young, yields]], yields, 0.0
        for _ in range(chance.randint(0, 4)):
            stress, plastic = stress + yields * chance.uniform(0.0, 0.3), plastic + chance.uniform(1e-3, 0.02)
            rows.append([plastic + stress / young, stress])
        return {"curve": rows}
    if name == "ludwik":
        return {"yield_stress": yields, **power}
    rate = 10 ** chance.uniform(-2, 3)
    if name == "johnson_cook":
        heating = {"melting_temperature": chance.uniform(100.0, 1500.0), "thermal_exponent": chance.uniform(0.5, 1.5)}
        if chance.random() < 0.6:  # so that a plastic strain of one heats by about the melting temperature
            heating["specific_heat"] = yields / (table["density"] * heating["melting_temperature"])
        rates = {"rate_coefficient": chance.uniform(0.0, 0.1), "rate_reference": rate}
        return {"yield_stress": yields, **power, **rates, **heating}
    keys = {"yield_stress": yields, "saturation_stress": yields * chance.uniform(0.0, 2.0)}
    keys |= {"saturation_rate": 10 ** chance.uniform(0, 2.5)}
    for key in HARDENING:
        if chance.random() < 0.5:
            keys[key] = young * 10 ** chance.uniform(-3, -0.3)
    if name == "cowper_symonds":
        keys |= {"rate_reference": rate, "rate_exponent": chance.uniform(1.0, 8.0)}
    if name == "perzyna":
        keys |= {"fluidity": rate, "overstress_exponent": chance.uniform(1.0, 8.0)}
    return keys
