"""Plain NumPy twins of the compiled loops over bars: whole meshes, complex positions for derivatives to rounding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEP = 1e-40  # of complex-step derivatives: nothing is subtracted, so the smaller the better

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
        """Stress, plastic and accumulated plastic strain after a strain; real parts decide about yielding."""
        stress = self.young_modulus * (strain - plastic)
        if self.yield_stress is None:
            return stress, plastic + 0.0 * strain, accumulated + 0.0 * strain
        relative = stress - self.kinematic * plastic
        sign = np.sign(relative.real)
        excess = sign * relative - (self.yield_stress + self.isotropic * accumulated)
        step = np.where(excess.real > 0.0, excess, 0.0) / (self.young_modulus + self.isotropic + self.kinematic)
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
        """Per bar, at positions (n, 3), real or complex: strain, stress, axial force, direction, plastic state."""
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
        """Internal force (n, 3) at positions (n, 3), real or complex."""
        bar = self.response(x)
        pull = bar["axial_force"][:, None] * bar["direction"]
        f = np.zeros(x.shape, dtype=pull.dtype)
        np.add.at(f, self.bars[:, 0], -pull)
        np.add.at(f, self.bars[:, 1], pull)
        return f

    def stiffness(self, x: np.ndarray) -> np.ndarray:
        """K_t (3n, 3n), each column by a complex step."""
        k = np.empty((x.size, x.size))
        for column in range(x.size):
            z = x.astype(complex).ravel()
            z[column] += 1j * STEP
            k[:, column] = self.forces(z.reshape(x.shape)).imag.ravel() / STEP
        return k

    def lumped_mass(self, density: float) -> np.ndarray:
        """(n,) [kg]."""
        half = np.repeat(0.5 * density * self.area * self.rest, 2)
        return np.bincount(self.bars.ravel(), half, len(self.points))

    def consistent_mass(self, density: float) -> np.ndarray:
        """(n, n) [kg], the same for each direction."""
        m = np.zeros((len(self.points), len(self.points)))
        for (a, b), whole in zip(self.bars, density * self.area * self.rest):
            m[np.ix_([a, b], [a, b])] += whole / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
        return m


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
