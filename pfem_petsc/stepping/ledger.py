"""The energy ledger: every term by its own formula, so that their balance is a check and not a definition.

For a scheme whose balance holds at the ends of steps (``at_ends``), works follow the trapezoidal rule: with dx = x1 - x0,
external work = (e0 + e1) dx/2, contact work (r0 + r1) dx/2, damping dissipation (C v0 + C v1) dx/2, and the numerical
dissipation is what inertia and internal force work beyond the change of their energies:
(M a0 + M a1) dx/2 - dT + (f0 + f1) dx/2 - dU - dD + dH, with the work dH of changing temperatures. For the others the forces of the one balance work over the whole step.
The sum of all changes is then the work of the residual, zero up to the solver's tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mechanics.bars import StrainEnergy

__all__ = ["Ledger", "Moment"]

TERMS = ("external_work", "contact_work", "damping_dissipation", "numerical_dissipation", "thermal_work")


@dataclass
class Moment:
    """What the ledger needs of a moment; arrays (owned, 3), forces in N."""

    x: np.ndarray
    kinetic: float
    energy: StrainEnergy
    inertial: np.ndarray
    internal: np.ndarray
    damping: np.ndarray
    external: np.ndarray
    contact: np.ndarray


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.dot(a.ravel(), b.ravel()))


class Ledger:
    """Accumulates this rank's share of works and dissipations.

    Attributes
    ----------
    work : (5,) sums since the start [J]: external (supports included), contact, damping, numerical, thermal
    """

    def __init__(self, stepper) -> None:
        self.stepper = stepper
        self.model = stepper.model
        self.work = np.zeros(len(TERMS))
        self._before = self._moment()
        if self.model.temperatures.varying:
            self._stress = self.model.bars.fields(stepper.state.x)["stress"]
            self._thermal = self.model.bars.thermal.copy()

    def update(self) -> None:
        """Book the step just made."""
        after = self._moment()
        before, self._before = self._before, after
        dx = after.x - before.x
        stored = after.kinetic - before.kinetic + sum(after.energy[:3]) - sum(before.energy[:3])
        heating = self._heating()
        if self.stepper.scheme.at_ends:

            def work(name):
                return 0.5 * _dot(getattr(before, name) + getattr(after, name), dx)
        else:
            balanced = self._balanced(before)

            def work(name):
                return _dot(balanced[name], dx)

        self.work[0] += work("external")
        self.work[1] += work("contact")
        self.work[2] += work("damping")
        self.work[3] += work("inertial") + work("internal") + heating - stored
        self.work[4] += heating

    def _heating(self) -> float:
        """Work that a changing temperature does on the counted bars: -A l0 (s0 + s1)/2 (change of thermal strain)."""
        model = self.model
        if not model.temperatures.varying:
            return 0.0
        stress = model.bars.fields(self.stepper.state.x)["stress"]
        before, self._stress = self._stress, stress
        change = model.bars.thermal - self._thermal
        self._thermal = model.bars.thermal.copy()
        total = 0.0
        for block in model.bars.blocks:
            part = slice(block.start, block.counted)
            mean = 0.5 * (before[part] + stress[part])
            total -= block.area * float((model.bars.rest[part] * mean * change[part]).sum())
        return total

    @property
    def kinetic(self) -> float:
        """Kinetic energy of this rank's nodes [J]."""
        return self._before.kinetic

    @property
    def momentum(self) -> np.ndarray:
        """M v of this rank's nodes (owned, 3) [kg m/s]."""
        return self._momentum

    def _moment(self) -> Moment:
        state, inertia = self.stepper.state, self.model.inertia
        owned = self.model.mesh.n_owned
        shape = state.v.shape
        self._momentum = inertia.mass_times(state.v, np.empty(shape))
        return Moment(
            x=state.position.copy(),
            kinetic=0.5 * _dot(self._momentum, state.v),
            energy=self.stepper.energy,
            inertial=inertia.mass_times(state.a, np.empty(shape)),
            internal=state.f[:owned].copy(),
            damping=inertia.damping_times(state.v, np.empty(shape)),
            external=state.external + state.support,
            contact=state.contact,
        )

    def _balanced(self, before: Moment) -> dict[str, np.ndarray]:
        """The forces of the last balance, where it does not hold at the ends of steps."""
        stepper, inertia, balance = self.stepper, self.model.inertia, self.stepper.balance
        state, u = stepper.state, stepper.solution.u
        owned = self.model.mesh.n_owned
        a = balance.alpha * u
        if balance.a_hat is not None:
            a = a + balance.a_hat
        v = balance.eta * u + balance.v_hat
        internal = (1.0 - balance.weight) * before.internal
        if balance.weight:
            internal = internal + balance.weight * stepper.solution.internal[:owned]
        return {
            "inertial": inertia.mass_times(a, np.empty(a.shape)),
            "internal": internal,
            "damping": inertia.damping_times(v, np.empty(a.shape)),
            "external": state.external + state.support,
            "contact": state.contact,
        }
