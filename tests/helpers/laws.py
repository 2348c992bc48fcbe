"""Material laws with a set of keys each, and their integration along strain paths by SciPy, from their equations."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

YOUNG, DENSITY = 200e9, 7850.0
STATIC = {"kinematic_hardening": 2e9, "isotropic_hardening": 1e9, "saturation_stress": 100e6, "saturation_rate": 30.0}
KEYS = {
    "voce": {"yield_stress": 250e6, **STATIC},
    "ludwik": {
        "yield_stress": 250e6, "strength_coefficient": 400e6, "hardening_exponent": 0.3, "kinematic_hardening": 1e9
    },
    "ramberg_osgood": {"proof_stress": 300e6, "exponent": 8.0},
    "multilinear": {"curve": [[0.00125, 250e6], [0.004, 290e6], [0.01, 300e6], [0.05, 380e6]]},
    "cowper_symonds": {"yield_stress": 250e6, **STATIC, "rate_reference": 40.4, "rate_exponent": 5.0},
    "perzyna": {"yield_stress": 250e6, **STATIC, "fluidity": 50.0, "overstress_exponent": 2.0},
    "johnson_cook": {
        "yield_stress": 250e6,
        "strength_coefficient": 400e6,
        "hardening_exponent": 0.3,
        "rate_coefficient": 0.05,
        "melting_temperature": 1500.0,
        "thermal_exponent": 0.8,
        "specific_heat": 450.0,
    },
}  # fmt: skip
RATES = ("cowper_symonds", "perzyna", "johnson_cook")
SOFTENING = [[0.0, 1.0, 1.0], [100.0, 0.9, 0.8], [400.0, 0.6, 0.3]]


def make(name, **keys):
    """Parameters and law of a material."""
    module = importlib.import_module(f"pfem_petsc.mechanics.materials.{name}")
    material = module.Parameters(**{"young_modulus": YOUNG, "density": DENSITY, **KEYS.get(name, {}), **keys})
    return material, material.choose(module.LAW)


def follow(name, path, steps, temperature=0.0, **keys):
    """Stress, tangent, internal variables and densities after each step of a strain path, and works by mean stress."""
    material, law = make(name, **keys)
    p, q, before, stress, work, rows = material.numbers(), (0.0,) * len(law.internal), 0.0, 0.0, 0.0, []
    for strain, h in zip(path, steps, strict=True):
        rate = (strain - before) / h if law.rate else 0.0
        if law.mean_stress is not None:
            work += law.mean_stress(stress, before, strain, rate, h, temperature, p, q)[0] * (strain - before)
        stress, tangent, q, densities = law.response(strain, rate, h, temperature, p, q)
        rows.append((stress, tangent, q, densities, work))
        before = strain
    return rows


def yield_stress(name, a, keys):
    """The static yield stress at an accumulated plastic strain."""
    if name == "ludwik" or name == "johnson_cook":
        return keys["yield_stress"] + keys["strength_coefficient"] * a ** keys["hardening_exponent"]
    if name == "ramberg_osgood":
        return keys["proof_stress"] * (a / keys.get("proof_strain", 0.002)) ** (1.0 / keys["exponent"])
    if name == "multilinear":
        strain, stress = np.array(keys["curve"]).T
        return float(np.interp(a, strain - stress / YOUNG, stress))
    risen = keys["isotropic_hardening"] * a + keys["saturation_stress"] * (1.0 - math.exp(-keys["saturation_rate"] * a))
    return keys["yield_stress"] + risen


def flow_stress(name, a, speed, temperature, keys):
    """The flow stress at a plastic strain rate and a temperature above reference."""
    static = yield_stress(name, a, keys)
    if name == "cowper_symonds":
        return static * (1.0 + (speed / keys["rate_reference"]) ** (1.0 / keys["rate_exponent"]))
    if name == "perzyna":
        return static + keys["yield_stress"] * (speed / keys["fluidity"]) ** (1.0 / keys["overstress_exponent"])
    if name == "johnson_cook":
        fast = max(speed / keys.get("rate_reference", 1.0), 1.0)
        cold = 1.0 - min(max(temperature / keys["melting_temperature"], 0.0), 1.0) ** keys["thermal_exponent"]
        return static * (1.0 + keys["rate_coefficient"] * math.log(fast)) * cold
    return static


@dataclass
class Twin:
    """A bar of a law by its equations, solved by SciPy; ``work`` is the plastic one [J/m3]."""

    name: str
    keys: dict
    before: float = 0.0
    stress: float = 0.0
    plastic: float = 0.0
    a: float = 0.0
    work: float = 0.0

    @property
    def heat(self):
        """Rise of temperature over plastic work."""
        return 0.9 / (DENSITY * self.keys["specific_heat"]) if "specific_heat" in self.keys else 0.0

    def step(self, strain, h, temperature=0.0):
        """The bar after a step of ``h`` seconds."""
        hardening = self.keys.get("kinematic_hardening", 0.0)
        stiffness = YOUNG + hardening
        plastic, a, work = self.plastic, self.a, self.work
        trial = YOUNG * (strain - plastic) - hardening * plastic
        size, sign = abs(trial), math.copysign(1.0, trial)
        static = flow_stress(self.name, a, 0.0, temperature + self.heat * work, self.keys)
        if size > static:
            start = max(static, sign * (YOUNG * (self.before - plastic) - hardening * plastic))

            def done(x):
                return 0.5 * (start + size - stiffness * x) * x

            def lack(x):
                now = temperature + self.heat * (work + done(x))
                return size - stiffness * x - flow_stress(self.name, a + x, x / h, now, self.keys)

            x = brentq(lack, 0.0, size / stiffness, xtol=1e-24, rtol=1e-15, maxiter=500)
            plastic, a, work = plastic + sign * x, a + x, work + done(x)
        return replace(self, before=strain, stress=YOUNG * (strain - plastic), plastic=plastic, a=a, work=work)


def integrated(name, path, steps, temperature=0.0, **more):
    """Stress, plastic strain, accumulated plastic strain, plastic work and rise of temperature after each step."""
    bar, rows = Twin(name, KEYS[name] | more), []
    for strain, h in zip(path, steps, strict=True):
        bar = bar.step(strain, h, temperature)
        rows.append((bar.stress, bar.plastic, bar.a, bar.work, bar.heat * bar.work))
    return np.array(rows)


def cycles(seed=1):
    """A cyclic strain path with changing step sizes, with steps at rest and steps that reverse the stress."""
    ends = (0.004, 0.001, 0.006, -0.005, 0.002, -0.009, 0.012)
    parts, before = [], 0.0
    for end, count in zip(ends, (13, 5, 7, 30, 3, 11, 2), strict=True):
        parts.append(np.linspace(before, end, count + 1)[1:])
        before = end
    path = np.concatenate((*parts, [before, before, before - 0.0015]))
    chance = np.random.default_rng(seed)
    return path, 10.0 ** chance.uniform(-6.0, -1.0, len(path))
