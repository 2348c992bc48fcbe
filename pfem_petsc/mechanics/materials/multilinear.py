"""Bar with a monotone curve of straight pieces from a table; it unloads elastically and hardens isotropically.

The table gives total strain and stress. Over the plastic strain a = strain - stress/E the yield stress R(a) consists of
straight pieces, constant after the last row, and the return mapping is solved exactly, piece by piece. After a reversal
the bar yields at the largest stress so far (isotropic hardening), on the same curve.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from ...case.base import Finite, listed
from ..compiled import inlined
from ._plastic import isotropic_law
from .base import MaterialKeys, yield_texts

__all__ = ["LAW", "Parameters", "curve", "find", "scale"]

_ELASTIC = 1e-3  # relative tolerance of the first row's strain, whose plastic part is then taken as zero

Row = Annotated[tuple[Finite, Finite], listed]


class Parameters(MaterialKeys):
    """Keys of a material with a curve from a table."""

    curve: Annotated[tuple[Row, ...], listed, Field(min_length=1)]
    """rows [total strain, stress] [-, Pa] from the yield point on, with stresses that do not fall"""

    @model_validator(mode="after")
    def _monotone(self) -> Parameters:
        strain, stress = self.curve[0]
        if not stress > 0.0:
            raise ValueError(f"curve[0]: the first row is the yield point; its stress {stress:g} Pa must be positive")
        elastic = stress / self.young_modulus
        if abs(strain - elastic) > _ELASTIC * elastic:
            raise ValueError(
                f"curve[0]: the first row is the end of the elastic line, at the strain stress/young_modulus = "
                f"{elastic:.6g}; it has {strain:g}"
            )
        plastic = self._plastic()
        for k in range(1, len(plastic)):
            if not self.curve[k][1] >= self.curve[k - 1][1]:
                raise ValueError(f"curve[{k}]: the stress decreases; it must not decrease from row to row")
            if not plastic[k] > plastic[k - 1]:
                raise ValueError(
                    f"curve[{k}]: the plastic strain, strain - stress/young_modulus, must increase from row to row; it "
                    f"is {plastic[k]:.6g} after {plastic[k - 1]:.6g}"
                )
        return self

    def _plastic(self) -> list[float]:
        return [0.0, *(strain - stress / self.young_modulus for strain, stress in self.curve[1:])]

    def pack(self) -> tuple:
        """Return (E, 0, factor of R, rows (a, R, dR/da, int R) [-, Pa, Pa, J/m3])."""
        plastic = np.array(self._plastic())
        stress = np.array([row[1] for row in self.curve])
        slope = np.append(np.diff(stress) / np.diff(plastic), 0.0)
        work = np.append(0.0, np.cumsum(0.5 * np.diff(plastic) * (stress[1:] + stress[:-1])))
        rows = np.ascontiguousarray(np.column_stack((plastic, stress, slope, work)))
        return float(self.young_modulus), 0.0, 1.0, rows

    def suspicions(self, key: str, hint: str) -> list[str]:
        """Return messages about an unrealistic strain at yield, and about yielding without hardening."""
        texts = yield_texts(key, hint, "curve", self.curve[0][1], self.young_modulus)
        if len(self.curve) == 1:
            texts.append(
                f"{key}.curve has one row, so {key} yields without hardening: plastic strain localises in one bar of a "
                "row, and results depend on the mesh; add rows"
            )
        return texts


@inlined
def piece(accumulated, rows):
    """Return the row from which the curve is straight at a."""
    k = len(rows) - 1
    while k > 0 and accumulated < rows[k, 0]:
        k -= 1
    return k


@inlined
def curve(accumulated, p):
    """Return R, dR/da, and the densities R(0) a and int(R - R(0)); p = (E, 0, factor, rows)."""
    rows = p[3]
    k = piece(accumulated, rows)
    beyond = accumulated - rows[k, 0]
    strength = rows[k, 1] + rows[k, 2] * beyond
    heat = rows[0, 1] * accumulated
    work = rows[k, 3] + 0.5 * (rows[k, 1] + strength) * beyond
    return p[2] * strength, p[2] * rows[k, 2], p[2] * heat, p[2] * (work - heat)


@inlined
def find(size, excess, stiffness, accumulated, p):
    """Return the plastic strain x of a step: |s_trial| - E x = R(a + x), piece by piece."""
    rows, factor = p[3], p[2]
    k = piece(accumulated, rows)
    at, left = accumulated, excess
    while True:
        slope = stiffness + factor * rows[k, 2]
        if k == len(rows) - 1 or left <= slope * (rows[k + 1, 0] - at):
            return at - accumulated + left / slope
        left -= slope * (rows[k + 1, 0] - at)
        k += 1
        at = rows[k, 0]


@inlined
def scale(p, modulus, strength):
    """Return the parameters at a temperature."""
    return modulus * p[0], p[1], strength * p[2], p[3]


LAW = isotropic_law(curve, scale, find)
