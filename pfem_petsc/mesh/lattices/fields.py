"""Expressions of a lattice at points: cell fields of its bars, and what is kept of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from .expressions import Expression
from .keys import COORDINATES
from .mesh_fields import MeshField
from .numbering import Places

if TYPE_CHECKING:
    from ..generators.lattice import Parameters

__all__ = ["Fields"]


class Fields:
    """The expressions of a lattice, at points.

    Parameters
    ----------
    keys : of the lattice
    """

    def __init__(self, keys: Parameters) -> None:
        self._fields = {name: MeshField(name, field) for name, field in (keys.fields or {}).items()}
        names = (*COORDINATES, *self._fields)
        self._of_bars = {name: Expression(text, names) for name, text in (keys.bar_fields or {}).items()}
        self._keep = Expression(keys.keep, names) if keys.keep is not None else None
        self._map = [Expression(text, names) for text in keys.map or ()]

    def of_bars(self, name: str, middles: np.ndarray) -> np.ndarray:
        """Return the values (n,) of a cell field at the middles (n, 3) [m] of bars."""
        return _values(self._of_bars[name], self._fields, middles, f"mesh.bar_fields.{name}")

    def kept(self, points: np.ndarray) -> np.ndarray:
        """Return which nodes (n,) at points (n, 3) [m] are kept."""
        if self._keep is None:
            return np.ones(len(points), bool)
        return _values(self._keep, self._fields, points, "mesh.keep") != 0.0

    def mapped(self, points: np.ndarray, _numbers: np.ndarray, _places: Places) -> np.ndarray:
        """Return where nodes at points (n, 3) [m] go: a move of a block."""
        moved = [_values(text, self._fields, points, f"mesh.map[{axis}]") for axis, text in enumerate(self._map)]
        return np.stack(moved, axis=1)


def _values(expression: Expression, fields: Mapping[str, MeshField], points: np.ndarray, key: str) -> np.ndarray:
    """Return the values (n,) of an expression at points (n, 3) [m].

    Raises
    ------
    InputError
        If the expression has no finite value somewhere; names the ``key``.
    """
    variables = dict(zip(COORDINATES, points.T))
    variables |= {name: field(points) for name, field in fields.items() if name in expression.used}
    values = expression(variables)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        where = ", ".join(f"{x:.6g}" for x in points[bad[0]])
        raise InputError(f"{key} = {expression.text!r} has no finite value at ({where}) m")
    return values
