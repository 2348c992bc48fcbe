"""The fields of snapshots, one entry each: name, place of its values, unit, and their computation.

Internal variables of a case's material laws are fields too; they are named by the laws and not here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["FIELDS", "STATUS", "Field", "cell_fields", "point_fields"]

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
    value : returns its values from a :class:`~pfem_petsc.recording.recorder.Snapshot`; called by all ranks
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
    Field("velocity", "nodes", "m/s", lambda now: now.state.v),
    Field("acceleration", "nodes", "m/s²", lambda now: now.acceleration()),
    Field("contact_force", "nodes", "N", lambda now: now.state.contact),
    Field("strain", "bars", "", lambda now: now.bars["strain"]),
    Field("stress", "bars", "Pa", lambda now: now.bars["stress"]),
    Field("axial_force", "bars", "N", lambda now: now.bars["axial_force"]),
    Field("plastic_strain", "bars", "", lambda now: now.bars["plastic_strain"]),
    Field("temperature", "bars", "K", lambda now: now.temperature(), lambda model: model.temperatures.any),
    Field("status", "bars", "", lambda now: now.model.bars.status(), lambda model: model.bars.has_status),
]


def point_fields() -> list[str]:
    """Return the names of the fields at nodes."""
    return [field.name for field in FIELDS if field.place == "nodes"]


def cell_fields() -> list[str]:
    """Return the names of the fields at bars."""
    return [field.name for field in FIELDS if field.place == "bars"]
