"""The fields of a snapshot: the selection of a case, and their values."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..fields import FIELDS, Field, cell_fields

if TYPE_CHECKING:
    from ..integrators.base import State
    from ..stepping.model import Model

__all__ = ["Fields", "Snapshot"]


class Snapshot:
    """The data from which fields are computed.

    Attributes
    ----------
    model : Model
    state : State
    start : (owned, 3) positions in the mesh [m]
    acceleration : returns the acceleration to record (owned, 3) [m/s2]; collective with consistent mass
    """

    def __init__(self, model: Model, state: State, acceleration: Callable[[], np.ndarray] | None = None) -> None:
        self.model, self.state, self.acceleration = model, state, acceleration
        self.start = model.mesh.points[: model.mesh.n_owned]

    @cached_property
    def bars(self) -> dict[str, np.ndarray]:
        """Name to (local bars,): strain, stress, axial force, internal variables."""
        return self.model.bars.fields(self.state.x)

    def temperature(self) -> np.ndarray:
        """(local bars,) temperature above reference [K], zero if the case has none."""
        temperatures = self.model.temperatures
        return temperatures.values if temperatures.any else 0.0 * self.bars["strain"]


class Fields:
    """Fields of the nodes and bars of this rank.

    Attributes
    ----------
    points, cells : names of the fields that the case selects; by default all that it has, except internal variables of
        material laws other than the plastic strain

    Parameters
    ----------
    model : Model
    names : of fields in place of those that the case selects; a case with stages has the same in all of them
    """

    def __init__(self, model: Model, names: Collection[str] | None = None) -> None:
        self.model = model
        wanted = model.case.output.fields if names is None else names
        taken = [field for field in FIELDS if (field.default(model) if wanted is None else field.name in wanted)]
        self._points = [field for field in taken if field.place == "nodes"]
        self._cells = [field for field in taken if field.place == "bars"]
        for name, unit in model.bars.internal.items():
            if wanted is not None and name in wanted and name not in cell_fields():
                self._cells.append(Field(name, "bars", unit, lambda now, name=name: now.bars[name]))
        self.points = [field.name for field in self._points]
        self.cells = [field.name for field in self._cells]

    def at_nodes(self, state: State, acceleration: Callable[[], np.ndarray]) -> dict[str, np.ndarray]:
        """Return name to (owned, 3). Collective if ``acceleration`` is."""
        now = Snapshot(self.model, state, acceleration)
        return {field.name: field.value(now) for field in self._points}

    def at_bars(self, state: State) -> dict[str, np.ndarray]:
        """Return name to (local bars,)."""
        now = Snapshot(self.model, state)
        return {field.name: field.value(now) for field in self._cells}
