"""The fields of snapshots, one entry each: name, place of its values, unit, and their computation.

Internal variables of a case's material laws are fields too; they are named by the laws and not here.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

STATUS = ("intact", "broken", "slack")
"""Meaning of the numbers 0, 1, 2 of the field ``status``."""


def _always(model: Any) -> bool:
    return True


class Field(NamedTuple):
    """One field.

    Attributes
    ----------
    place : ``nodes``, values (owned, 3), or ``bars``, values (local bars,)
    unit : SI unit, empty for a pure number
    value : returns its values from a :class:`~pfem_petsc.fields.Snapshot`, which no later step changes; called by all
        ranks
    default : whether it is written if a case does not name fields, from a :class:`~pfem_petsc.stepping.model.Model`
    """

    name: str
    place: str
    unit: str
    value: Callable[[Any], np.ndarray]
    default: Callable[[Any], bool] = _always


# to add a field, add one entry here
FIELDS = [
    Field("displacement", "nodes", "m", lambda now: now.state.position - now.start),
    Field("velocity", "nodes", "m/s", lambda now: now.state.v.copy()),
    Field("acceleration", "nodes", "m/s²", lambda now: now.acceleration().copy()),
    Field("contact_force", "nodes", "N", lambda now: now.state.contact.copy()),
    Field("strain", "bars", "", lambda now: now.bars["strain"]),
    Field("stress", "bars", "Pa", lambda now: now.bars["stress"]),
    Field("axial_force", "bars", "N", lambda now: now.bars["axial_force"]),
    Field("plastic_strain", "bars", "", lambda now: now.bars["plastic_strain"]),
    Field("rest_length", "bars", "m", lambda now: now.model.bars.rest.copy(), lambda model: model.rest_lengths.found),
    Field("temperature", "bars", "K", lambda now: now.temperature(), lambda model: model.temperatures.any),
    Field("status", "bars", "", lambda now: now.model.bars.status(), lambda model: model.bars.has_status),
]


def point_fields() -> list[str]:
    """Return the names of the fields at nodes."""
    return [field.name for field in FIELDS if field.place == "nodes"]


def cell_fields() -> list[str]:
    """Return the names of the fields at bars."""
    return [field.name for field in FIELDS if field.place == "bars"]


class Snapshot:
    """The data from which fields are computed.

    Attributes
    ----------
    model : Model
    state : State
    start : (owned, 3) positions in the mesh [m]
    acceleration : returns the acceleration to record (owned, 3) [m/s2]; collective with consistent mass
    """

    def __init__(self, model: Any, state: Any, acceleration: Callable[[], np.ndarray] | None = None) -> None:
        self.model, self.state, self.acceleration = model, state, acceleration
        self.start = model.mesh.points[: model.mesh.n_owned]

    @cached_property
    def bars(self) -> dict[str, np.ndarray]:
        """Name to (local bars,): strain, stress, axial force, internal variables."""
        return self.model.bars.fields(self.state.x)

    def temperature(self) -> np.ndarray:
        """(local bars,) temperature above reference [K], zero if the case has none."""
        temperatures = self.model.temperatures
        return temperatures.values.copy() if temperatures.any else 0.0 * self.bars["strain"]


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

    def __init__(self, model: Any, names: Collection[str] | None = None) -> None:
        self.model = model
        wanted = model.case.output.fields if names is None else names
        self._fields = [field for field in FIELDS if (field.default(model) if wanted is None else field.name in wanted)]
        for name, unit in model.bars.internal.items():
            if wanted is not None and name in wanted and name not in cell_fields():
                self._fields.append(Field(name, "bars", unit, lambda now, name=name: now.bars[name]))
        self.points = [field.name for field in self._fields if field.place == "nodes"]
        self.cells = [field.name for field in self._fields if field.place == "bars"]

    def at(self, place: str, now: Snapshot) -> dict[str, np.ndarray]:
        """Return name to values at ``nodes`` (owned, 3), or ``bars`` (local bars,); collective with consistent mass."""
        return {field.name: field.value(now) for field in self._fields if field.place == place}
