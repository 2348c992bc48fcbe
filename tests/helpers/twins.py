"""Plain twins of the compiled loops over bars and laws, by NumPy and SciPy."""

from __future__ import annotations

import cmath
import importlib
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

STRAINS = {
    "engineering": (lambda s: s - 1.0, lambda s: np.ones_like(s)),
    "green": (lambda s: 0.5 * (s * s - 1.0), lambda s: s),
    "logarithmic": (np.log, lambda s: 1.0 / s),
}


@dataclass
class Law:
    """A bar material; ``yield_stress`` None is elastic."""

    young_modulus: float
    yield_stress: float | None = None
    isotropic: float = 0.0
    kinematic: float = 0.0
    strain: str = "engineering"

    def case(self, **more) -> dict:
        """Its table in a case."""
        table = {"young_modulus": self.young_modulus, "density": 1.0, "strain": self.strain, **more}
        if self.yield_stress is not None:
            table |= {"yield_stress": self.yield_stress}
            table |= {"isotropic_hardening": self.isotropic, "kinematic_hardening": self.kinematic}
        return table

    def mapped(self, strain, plastic, accumulated):
        """Stress, plastic and accumulated plastic strain after a strain."""
        stress = self.young_modulus * (strain - plastic)
        if self.yield_stress is None:
            return stress, plastic + 0.0 * strain, accumulated + 0.0 * strain
        relative = stress - self.kinematic * plastic
        sign = np.sign(relative)
        excess = sign * relative - (self.yield_stress + self.isotropic * accumulated)
        step = np.where(excess > 0.0, excess, 0.0) / (self.young_modulus + self.isotropic + self.kinematic)
        return stress - self.young_modulus * sign * step, plastic + sign * step, accumulated + step


@dataclass
class WholeTruss:
    """A mesh in its own numbering with one section: points (n, 3), bars (b, 2), plastic states (b,)."""

    points: np.ndarray
    bars: np.ndarray
    area: float
    law: Law
    plastic: np.ndarray
    accumulated: np.ndarray

    @property
    def rest(self) -> np.ndarray:
        return np.linalg.norm(self.points[self.bars[:, 1]] - self.points[self.bars[:, 0]], axis=1)

    def response(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Per bar, at positions (n, 3): strain, stress, axial force, direction, plastic state."""
        d = x[self.bars[:, 1]] - x[self.bars[:, 0]]
        length = np.sqrt((d * d).sum(axis=1))
        measure, slope = STRAINS[self.law.strain]
        strain = measure(length / self.rest)
        stress, plastic, accumulated = self.law.mapped(strain, self.plastic, self.accumulated)
        return {
            "strain": strain,
            "stress": stress,
            "axial_force": self.area * stress * slope(length / self.rest),
            "direction": d / length[:, None],
            "plastic_strain": plastic,
            "accumulated": accumulated,
        }

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Internal force (n, 3) at positions (n, 3)."""
        bar = self.response(x)
        pull = bar["axial_force"][:, None] * bar["direction"]
        f = np.zeros(x.shape)
        np.add.at(f, self.bars[:, 0], -pull)
        np.add.at(f, self.bars[:, 1], pull)
        return f


def whole_truss(model, area: float, law: Law) -> WholeTruss:
    """The twin of a model's mesh, the same on every rank. Collective."""
    mesh = model.mesh
    points = np.zeros((mesh.n_nodes, 3))
    points[mesh.node_ids[: mesh.n_owned]] = mesh.points[: mesh.n_owned]
    bars = np.zeros((mesh.n_bars, 2), dtype=np.int64)
    for block in mesh.blocks:
        counted = slice(block.start, block.counted)
        bars[mesh.bar_ids[counted]] = mesh.node_ids[mesh.bars[counted]]
    points, bars = model.comm.allreduce(points), model.comm.allreduce(bars)
    return WholeTruss(points, bars, area, law, np.zeros(len(bars)), np.zeros(len(bars)))


def shaken(truss: WholeTruss, size: float, seed: int = 3) -> np.ndarray:
    """Positions (n, 3) moved at random by up to ``size`` [m]."""
    return truss.points + np.random.default_rng(seed).uniform(-size, size, truss.points.shape)


@dataclass(frozen=True)
class Strut:
    """Nonaka's strut, its equations solved in the stress by bisection, with complex numbers for both signs.

    A round bar; the state is (plastic strain, accumulated, hinge angle)."""

    young: float
    yields: float
    slenderness: float
    imperfection: float = 0.0
    radius: float = 1e-2

    @property
    def area(self):
        return math.pi * self.radius**2

    @property
    def inertia(self):
        return 0.25 * math.pi * self.radius**4

    @property
    def length(self):
        return 0.5 * self.slenderness * self.radius

    @property
    def euler(self):
        return math.pi**2 * self.young * self.inertia / (self.area * self.length**2)

    @property
    def full_moment(self):
        return 4.0 / 3.0 * self.radius**3 * self.yields

    def start(self):
        angle = 4.0 * self.imperfection
        return angle * angle / 8.0, 0.0, angle

    def wave(self, stress):
        """Half the length times (P/(E I))^(1/2), imaginary in tension."""
        return 0.5 * self.length * cmath.sqrt(-stress * self.area / (self.young * self.inertia))

    def bowing(self, stress, angle):
        """Shortening over the length: half the mean square of the slope of (angle/2) cos(k x)/cos(k l/2)."""
        if stress == 0.0:
            return angle * angle / 8.0
        z = self.wave(stress)
        return angle * angle / 16.0 * (1.0 / cmath.cos(z) ** 2 + cmath.tan(z) / z)

    def moment(self, stress, angle):
        """Of the force about midspan over the full plastic moment, at a deflection of (angle l/4) tan(z)/z."""
        if stress == 0.0:
            return 0.0
        z = self.wave(stress)
        deflection = 0.25 * angle * self.length * cmath.tan(z) / z
        return -stress * self.area * deflection / self.full_moment

    def angle(self, stress, sign):
        """On the yield condition."""
        return (1.0 + sign * stress / self.yields) / (sign * self.moment(stress, 1.0))

    def step(self, strain, state):
        """Stress, state and tangent at a strain, without snaps."""
        plastic, accumulated, angle = state
        share = self.full_moment / (self.yields * self.area * self.length)  # of the hinge angle

        def elastic(stress):
            return stress / self.young + plastic - self.bowing(stress, angle) - strain

        limit = min(self.euler, self.yields)
        if angle == 0.0:
            stress = self.young * (strain - plastic)
            if stress < -self.euler <= 0.0 and self.euler < self.yields:
                slope = 2.0 * math.sqrt(plastic - strain - self.euler / self.young)
                bent = self.full_moment * (1.0 - self.euler / self.yields)
                # M = P times the deflection s/k
                if self.euler * self.area * slope * self.length / math.pi <= bent:
                    return -self.euler, state, 0.0
                stress = -2.0 * self.yields
            elif abs(stress) <= self.yields:
                return stress, state, self.young
        else:
            stress = self.bisected(elastic, -self.euler * (1.0 - 1e-15), 2.0 * self.yields)
            if abs(self.moment(stress, angle).real) + abs(stress) / self.yields <= 1.0:
                return stress, state, self.tangent(elastic, stress)
        sign = 1.0 if stress < 0.0 else -1.0  # the hinge opens, or closes

        def hinged(stress):
            turned = self.angle(stress, sign)
            change = -sign * share * sign * (turned - angle)
            return stress / self.young + plastic + change - self.bowing(stress, turned) - strain

        if sign > 0.0:
            stress = -self.bisected(lambda s: hinged(-s), 1e-9 * limit, limit * (1.0 - 1e-14))
        elif hinged(self.yields * (1.0 - 1e-15)).real <= 0.0:
            new = strain - self.yields / self.young
            return self.yields, (new, accumulated + new - plastic, 0.0), 0.0
        else:
            stress = self.bisected(hinged, 1e-9 * limit, self.yields * (1.0 - 1e-15))
        turned = self.angle(stress, sign).real
        flow = share * abs(turned - angle)
        return stress, (plastic - sign * flow, accumulated + flow, turned), self.tangent(hinged, stress)

    @staticmethod
    def bisected(function, low, high):
        """Root of an increasing function."""
        for _ in range(200):
            middle = 0.5 * (low + high)
            value = function(middle)
            low, high = (middle, high) if complex(value).real < 0.0 else (low, middle)
        return 0.5 * (low + high)

    @staticmethod
    def tangent(function, stress):
        """d(stress)/d(strain) from the residual, by a complex step in the stress."""
        step = 1e-6 * abs(stress)
        return 2.0 * step / complex(function(stress + step) - function(stress - step)).real


def solid(strut):
    """Keys of its material and its section."""
    material = {"law": "strut", "young_modulus": strut.young, "yield_stress": strut.yields, "density": 7850.0}
    if strut.imperfection:
        material["imperfection"] = strut.imperfection
    return material, {"area": strut.area, "shape": "round"}


YOUNG, DENSITY = 200e9, 7850.0
STATIC = {"kinematic_hardening": 2e9, "isotropic_hardening": 1e9, "saturation_stress": 100e6, "saturation_rate": 30.0}
KEYS = {
    "elastoplastic": {"yield_stress": 250e6, "isotropic_hardening": 1e9, "kinematic_hardening": 2e9},
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
            work += law.mean_stress(stress, before, strain, h, temperature, p, q)[0] * (strain - before)
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
    saturated = 1.0 - math.exp(-keys.get("saturation_rate", 0.0) * a)
    return keys["yield_stress"] + keys["isotropic_hardening"] * a + keys.get("saturation_stress", 0.0) * saturated


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


AREA, STEP, STEPS = 1e-4, 1e-5, 100
PARAMETERS = {"newmark": {"beta": 0.25, "gamma": 0.5}}  # the trapezoidal rule


def one_bar(law, integrator, measure="engineering", speed=70.0, steps=STEPS, elements=1, solver=None, **keys):
    """A bar of 1 m along x: its foot is held, its tip is thrown."""
    material = {"law": law, "young_modulus": YOUNG, "density": DENSITY, "strain": measure, **KEYS.get(law, {}), **keys}
    table = {
        "mesh": {"generator": "rod", "length": 1.0, "elements": elements},
        "node_set": {"foot": {"nearest": [0.0, 0.0, 0.0]}, "tip": {"nearest": [1.0, 0.0, 0.0]}},
        "material": {"it": material},
        "section": {"it": {"area": AREA, "material": "it"}},
        "initial": {"on": [{"node_set": "tip", "velocity": [speed, 0.0, 0.0]}]},
        "support": [{"node_set": "foot", "fix": "xyz"}],
        "time": {"integrator": integrator, "step": STEP, "end": STEP * steps, **PARAMETERS.get(integrator, {})},
        "solver": {"rtol": 1e-13, **(solver or {})},
        "output": {"fields_every": steps, "fields": ["stress"], "probe": [{"name": "tip", "node_set": "tip"}]},
    }
    return table


def pulled(law, strain, method="newton", **keys):
    """A bar whose tip is moved, in a static analysis."""
    case = one_bar(law, "newmark", **keys)
    for key in ("time", "initial"):
        del case[key]
    case["static"] = {"method": method, "step": 0.2}
    case["node_set"]["all"] = {"all": True}
    moved = {"node_set": "tip", "fix": "x", "motion": [[0.0, 0.0, 0.0, 0.0], [1.0, strain, 0.0, 0.0]]}
    case["support"] = [{"node_set": "foot", "fix": "x"}, {"node_set": "all", "fix": "yz"}, moved]
    return case
